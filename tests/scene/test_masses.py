"""A document's objects have the masses of their densities; the scene's bodies keep their masses."""

import mujoco
import numpy as np
import pytest
import trimesh

import tgdsl
from tgdsl.scene.scene import Choice, SceneModels

SCENE = """
<mujoco>
  <compiler {options}/>
  {default}
  <worldbody>
    <body name="pad" pos="0 0 .1"><inertial pos="0 0 .01" quat=".9 .1 .3 .2" mass=".3" diaginertia=".02 .03 .025"/>
      <joint type="hinge"/><geom type="sphere" size=".05" group="3"/>
      <body name="pin"><joint type="hinge" axis="1 0 0"/><geom type="capsule" size=".02 .03" group="3" density="900"/>
        <geom type="box" size=".02 .03 .01" pos="0 .1 0" quat=".8 .3 .1 .2" density="500" mass=".01" group="2"/></body></body>
    <body name="held" pos="1 0 0"><freejoint/><geom type="sphere" size=".03" density="400" group="3"/></body>
  </worldbody>
</mujoco>
"""
OPTIONS = {
    "none": "",
    "groups": "inertiagrouprange='2 4'",
    "given": "inertiafromgeom='false'",
    "from geoms": "inertiafromgeom='true' inertiagrouprange='2 3'",
    "total": "settotalmass='7'",
    "bounds": "boundmass='.4' boundinertia='.01'",
    "all": "inertiafromgeom='true' boundmass='.4' boundinertia='.01' settotalmass='7' balanceinertia='true'",
    "radians": "angle='radian'",
    "aligned": "alignfree='true'",
}
LEAKS = (
    "<default><geom type='capsule' size='.1 .2' density='7' mass='2' friction='3 1 1' margin='.1' gap='.05' contype='5' "
    "conaffinity='9' condim='6' priority='2' solmix='3' solref='.1 2' solimp='.1 .2 .3 .4 3' group='3' rgba='1 0 0 1' "
    "shellinertia='true' fluidshape='ellipsoid'/><joint damping='3' armature='2'/></default>"
)
BALL = {"type": "sphere", "size": [0.02], "density": 500, "pos": [0.01, 0, 0.02]}
BOX = {"type": "box", "size": [0.01, 0.02, 0.03], "density": 300, "quat": [0.8, 0.3, 0.1, 0.2]}
MASSES = (500 * 4 / 3 * np.pi * 0.02**3, 300 * 8 * 0.01 * 0.02 * 0.03)
EXACT = 1e-9


def scene_of(folder, options="", default="", **objects):
    """Return the models of a compiled document's scene, and the model of the scene file."""
    text = SCENE.format(options=options, default=default)
    if "false" in options:  # MuJoCo then needs an inertia for each moving body
        for joint in ("<freejoint/>", '<joint type="hinge" axis="1 0 0"/>'):
            text = text.replace(joint, f"{joint}<inertial pos='0 0 .01' mass='.3' diaginertia='.02 .03 .025'/>")
    (folder / "scene.xml").write_text(text)
    points = [{"pos": [0, 0, 0.05], "normal": [0, 0, 1], "radius": 0.001}]
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "scene.xml"), "layout": layout},
            "objects": objects,
            "sensors": {"force": {"kind": "kinematic_taxel", "links": "pad", "feels": list(objects)}},
        }
    )
    return SceneModels(touch.plan.scene), mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))


@pytest.fixture(autouse=True)
def cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.filterwarnings("ignore:.*settotalmass")
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_masses_do_not_depend_on_the_compilers_options(tmp_path, options):
    """Closed form: a ball off its body's origin, or a box. Other bodies weigh the same as without objects."""
    target = {"variants": [BALL, BOX], "pos": [0, 0, 1]}
    scenes, alone = scene_of(tmp_path, options, item=target, still={"geom": BALL, "joint": "fixed"})
    for variant, mass in enumerate(MASSES):
        model = scenes.model({"item": Choice(variant)})
        item = model.body("item")
        assert item.mass[0] == pytest.approx(mass, rel=EXACT)
        np.testing.assert_allclose(item.ipos, (0.01, 0, 0.02) if variant == 0 else (0, 0, 0), atol=3e-6)
        ball, box = np.full(3, 0.4 * 0.02**2), np.array([0.02**2 + 0.03**2, 0.01**2 + 0.03**2, 0.01**2 + 0.02**2]) / 3
        np.testing.assert_allclose(np.sort(item.inertia), np.sort(mass * (ball, box)[variant]), rtol=EXACT)
        assert model.body("still").mass[0] == pytest.approx(MASSES[0], rel=EXACT)
        for name in ("pad", "pin", "held"):
            body, expected = model.body(name), alone.body(name)
            np.testing.assert_allclose(
                [*body.mass, *body.inertia], [*expected.mass, *expected.inertia], rtol=EXACT, err_msg=name
            )
            np.testing.assert_allclose([*body.ipos, *body.iquat], [*expected.ipos, *expected.iquat], atol=EXACT, err_msg=name)


@pytest.mark.parametrize("options", ["", "inertiagrouprange='2 3'"])
def test_new_geoms_of_a_scenes_body_give_its_mass(tmp_path, options):
    """The body has no inertia element, so its new geoms give its mass, whatever their group."""
    scenes, _ = scene_of(tmp_path, options, held={"body": "held", "variants": [BALL, {"geoms": [BALL, BOX]}]})
    masses = [scenes.model({"held": Choice(v)}).body("held").mass[0] for v in (0, 1)]
    np.testing.assert_allclose(masses, [MASSES[0], sum(MASSES)], rtol=EXACT)


def test_new_geoms_of_a_body_with_an_inertia_element_leave_it(tmp_path):
    scenes, _ = scene_of(tmp_path, "inertiafromgeom='false'", held={"body": "held", "variants": [BALL, BOX]})
    for variant in (0, 1):
        body = scenes.model({"held": Choice(variant)}).body("held")
        np.testing.assert_allclose([*body.mass, *np.sort(body.inertia)], [0.3, 0.02, 0.025, 0.03], rtol=EXACT)


def test_a_mesh_has_the_mass_of_its_density(tmp_path):
    trimesh.creation.box((0.02, 0.04, 0.06)).export(tmp_path / "brick.stl")
    brick = {"mesh": str(tmp_path / "brick.stl"), "density": 300, "scale": 1.0}
    scenes, _ = scene_of(tmp_path, "inertiafromgeom='false'", item={"geom": brick, "pos": [0, 0, 1]})
    assert scenes.model({}).body("item").mass[0] == pytest.approx(MASSES[1], rel=1e-5)


def test_the_scenes_defaults_do_not_apply_to_objects(tmp_path):
    """Every parameter of the object's geom is as in a model without defaults; its joint is MuJoCo's free joint."""
    scenes, _ = scene_of(tmp_path, default=LEAKS, item={"geom": BALL, "pos": [0, 0, 1]})
    plain, model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"), scenes.model({})
    geom = int(model.body("item").geomadr[0])
    names = ("condim", "contype", "conaffinity", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap", "group")
    for name in (*names, "rgba", "fluid", "matid"):
        np.testing.assert_array_equal(getattr(model, f"geom_{name}")[geom], getattr(plain, f"geom_{name}")[0], err_msg=name)
    assert model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
    assert model.body("item").mass[0] == pytest.approx(MASSES[0], rel=EXACT)
    first = int(model.body("item").dofadr[0])
    assert not model.dof_damping[first : first + 6].any() and not model.dof_armature[first : first + 6].any()
