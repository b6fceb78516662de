"""Primitive colliders replace a link's geoms: pairs that collide, and where."""

import mujoco
import numpy as np
import pytest

from tgdsl.errors import RobotError
from tgdsl.plan.scene import Collider
from tgdsl.scene.colliders import collider_name, with_colliders

SCENE = """<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0 .04 0 0 0 .04 0 0 0 .04 .04 .04 .04"/></asset>
  <worldbody>
    <body name="one"><joint name="one" type="slide" axis="1 0 0"/>
      <geom name="one" type="mesh" mesh="wedge" friction=".3 .01 .001" condim="4" {bits}/></body>
    <body name="two" pos="1 0 0"><joint name="two" type="slide" axis="1 0 0"/>
      <geom name="two" type="box" size=".01 .01 .01" {bits}/></body>
    <body name="ball" pos="0 0 1"><freejoint name="ball"/><geom name="ball" type="sphere" size=".01" {ball}/></body>
  </worldbody>{more}
</mujoco>"""
UNTURNED = (1.0, 0.0, 0.0, 0.0)
COLLIDERS = (
    Collider("one", "sphere", (0.02,), (0.0, 0.0, 0.0), UNTURNED, True),
    Collider("one", "capsule", (0.01, 0.05), (0.0, 0.1, 0.0), UNTURNED, False),
    Collider("two", "sphere", (0.02,), (0.0, 0.0, 0.0), UNTURNED, True),
    Collider("two", "box", (0.01, 0.02, 0.03), (0.0, 0.1, 0.0), UNTURNED, False),
)


def model_with_colliders(bits="", ball="", more="", colliders=COLLIDERS):
    return with_colliders(mujoco.MjSpec.from_string(SCENE.format(bits=bits, ball=ball, more=more)), colliders).compile()


def contact_distances(model, **positions):
    """Return names and distances [m] of geoms in contact, with slides and the ball at some positions."""
    data = mujoco.MjData(model)
    for name, value in positions.items():
        first = int(model.joint(name).qposadr[0])
        data.qpos[first : first + np.size(value)] = value
    mujoco.mj_forward(model, data)
    distances = {}
    for i in range(data.ncon):
        names = sorted(model.geom(int(geom)).name for geom in data.contact[i].geom)
        distances["+".join(names)] = float(data.contact[i].dist)
    return distances


def test_objects_collide_with_every_collider():
    """A ball of 10 mm against a sphere of 20 mm, and against a capsule of 10 mm: distances from centres and radii."""
    model = model_with_colliders()
    core, fine = collider_name("one", 0), collider_name("one", 1)
    assert contact_distances(model, ball=[0, 0, 0.029]) == {f"ball+{core}": pytest.approx(-0.001, abs=1e-12)}
    assert contact_distances(model, ball=[0.019, 0.1, 0.02]) == {f"ball+{fine}": pytest.approx(-0.001, abs=1e-12)}
    assert contact_distances(model, ball=[0.035, 0.035, 0.035]) == {}  # inside the mesh, which is only visual


def test_links_collide_only_through_their_cores():
    cores = "+".join((collider_name("one", 0), collider_name("two", 0)))
    assert contact_distances(model_with_colliders(), one=0.961) == {cores: pytest.approx(-0.001, abs=1e-12)}
    fine = [Collider(core.body, core.type, core.size, core.pos, core.quat, False) for core in COLLIDERS]
    assert contact_distances(model_with_colliders(colliders=fine), one=0.961) == {}


def test_links_that_did_not_collide_still_do_not():
    model = model_with_colliders(bits='contype="0" conaffinity="1"')
    assert contact_distances(model, one=0.961) == {}
    assert list(contact_distances(model, ball=[0, 0, 0.029])) == [f"ball+{collider_name('one', 0)}"]


def test_colliders_change_only_the_collision_shapes():
    """Masses, inertias and contact parameters equal the replaced geoms'."""
    plain, model = mujoco.MjModel.from_xml_string(SCENE.format(bits="", ball="", more="")), model_with_colliders()
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "jnt_axis", "qpos0"):
        np.testing.assert_array_equal(getattr(model, field), getattr(plain, field))
    geom = model.geom(collider_name("one", 1))
    np.testing.assert_array_equal(geom.friction, plain.geom("one").friction)
    assert geom.condim == 4 and geom.group == 3
    assert not model.geom("one").contype and not model.geom("one").conaffinity
    np.testing.assert_array_equal(model.geom("one").rgba, plain.geom("one").rgba)


def test_an_empty_list_changes_nothing():
    spec = mujoco.MjSpec.from_string(SCENE.format(bits="", ball="", more=""))
    assert with_colliders(spec, ()) is spec and spec.geom("one").contype == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"ball": 'contype="0" conaffinity="1"'},
            'geom "ball" (body "ball") collides with "one" by its `conaffinity` alone; primitive colliders collide only with geoms'
            " whose `contype` has one of their bits",
        ),
        (
            {"more": '<contact><pair geom1="one" geom2="ball"/></contact>'},
            'the scene has a contact pair of geom "one", whose place primitive colliders take; expected pairs of other geoms',
        ),
        (
            {"bits": 'contype="0" conaffinity="0"'},
            'no geom of body "one" collides, expected one whose place its primitive colliders take',
        ),
        (
            {"colliders": (Collider("three", "sphere", (0.1,), (0.0, 0.0, 0.0), UNTURNED, True),)},
            'the scene has no body "three", which has primitive colliders',
        ),
    ],
)
def test_contacts_that_would_be_lost_are_refused(given, says):
    with pytest.raises(RobotError) as error:
        model_with_colliders(**given)
    assert str(error.value) == says


def test_no_free_collision_bit_is_an_error():
    with pytest.raises(RobotError) as error:
        model_with_colliders(bits=f'contype="{2**31 - 1}"')
    says = "the scene's geoms use all bits of `contype` and `conaffinity`; links with primitive colliders need a free one"
    assert str(error.value) == says


def test_a_geom_that_collides_only_by_its_conaffinity_is_refused():
    """The link's first geom has no `contype` and does not collide with the ball; its second one does."""
    spec = mujoco.MjSpec.from_string(SCENE.format(bits="", ball='contype="0" conaffinity="1"', more=""))
    spec.geom("one").contype = 0
    spec.body("one").add_geom(name="more", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0])
    with pytest.raises(RobotError, match='geom "ball"'):
        with_colliders(spec, COLLIDERS)


def test_sizes_beyond_those_of_the_type_are_zero():
    """As in MuJoCo's models of spheres and capsules."""
    model = model_with_colliders()
    for i, size in enumerate(([0.02, 0, 0], [0.01, 0.05, 0])):
        np.testing.assert_array_equal(model.geom(collider_name("one", i)).size, size)
