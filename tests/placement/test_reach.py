"""Taxels that nothing can touch, on made-up hands: closed forms and MuJoCo's distances."""

import mujoco
import numpy as np
import pytest
from covered_hands import HOLLOW, hand, layout, model, shell

from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.formats.usd.write import write_usd
from tgdsl.layout.layout import BURIED, COVERED, NOT_COLLIDED, Layout, by_reason, unfelt_ids
from tgdsl.placement.reach import Colliders, reach, unfelt

MESH_ATOL = 1e-8  # [m] vertices are float32
MUJOCO_ATOL = 2e-6  # [m] MuJoCo's penetration depth converges to its `ccd_tolerance`, 1e-6
SIDES = pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])


def unfelt_taxels(robot: Model, taxels: Layout, ignored: tuple[int, ...] = ()) -> list[tuple[str, str, list[int]]]:
    colliders = Colliders(robot)
    records = unfelt(colliders, taxels, reach(colliders, taxels, ignored))
    return [(record.link, record.reason, record.taxels.tolist()) for record in records]


@SIDES
def test_taxels_in_a_hollow_of_the_hull_are_buried(tmp_path, side):
    """Depths inside an L's hull are known; a taxel deeper than its radius is buried."""
    robot = model(tmp_path, f'<mujoco><asset>{shell("shell", side)}</asset><worldbody><body name="palm"><joint/>'
                            '<geom type="mesh" mesh="shell"/></body></worldbody></mujoco>')  # fmt: skip
    points = [[0.01, side * 0.01, 0.02], [0.01, side * 0.02, 0.02], [0.01, side * 0.03, 0.02], [0, side * 0.01, 0.02]]
    expected = np.array([0.01, HOLLOW, 0, 0])
    colliders, taxels = Colliders(robot), layout({"palm": points})
    within = reach(colliders, taxels)
    np.testing.assert_allclose(within.depth, expected, rtol=0, atol=MESH_ATOL)
    assert within.is_buried.tolist() == [True, True, False, False] and within.is_collided.all() and (within.cover == -1).all()
    (record,) = unfelt(colliders, taxels, within)
    assert str(record) == "palm: 2 of 4 taxels buried in the link's own colliding geoms, up to 10 mm deep, beyond their radius"
    for radius, count in ((HOLLOW - 1e-5, 2), (HOLLOW + 1e-5, 1), (0.01 + 1e-5, 0)):
        assert reach(colliders, layout({"palm": points}, radius)).is_buried.sum() == count


def test_depths_match_mujoco(tmp_path):
    """MuJoCo's distance of a tiny ball at the taxel, less its radius: primitives, a hull, rotated frames."""
    shapes = (
        'type="sphere" size=".02"',
        'type="capsule" size=".01 .02"',
        'type="box" size=".01 .02 .015"',
        'type="cylinder" size=".015 .02"',
        'type="mesh" mesh="shell"',
    )
    rng, ball = np.random.default_rng(0), 1e-3
    for shape in shapes:
        text = f"""<mujoco><option ccd_iterations="200"/><asset>{shell()}</asset><worldbody>
          <body name="link" pos=".1 .2 .3" euler="10 20 30"><joint axis="0 1 0"/>
            <geom {shape} pos=".01 -.02 .01" euler="40 -30 20"/></body>
          <body name="probe" mocap="true"><geom size="{ball}"/></body></worldbody></mujoco>"""
        robot = model(tmp_path, text)
        state = mujoco.MjData(robot.compiled)
        mujoco.mj_forward(robot.compiled, state)
        aabb = robot.compiled.geom_aabb[0]
        local = aabb[:3] + rng.uniform(-1, 1, (150, 3)) * aabb[3:]
        world = state.geom_xpos[0] + local @ state.geom_xmat[0].reshape(3, 3).T
        frame = state.body("link")
        within = reach(Colliders(robot), layout({"link": (world - frame.xpos) @ frame.xmat.reshape(3, 3)}))
        expected = []
        for point in world:
            state.mocap_pos[0] = point
            mujoco.mj_forward(robot.compiled, state)
            expected.append(-mujoco.mj_geomDistance(robot.compiled, state, 1, 0, 1.0, None) - ball)
        inside = np.array(expected) > 1e-4
        assert inside.sum() > 30
        np.testing.assert_allclose(within.depth[inside], np.array(expected)[inside], rtol=0, atol=MUJOCO_ATOL, err_msg=shape)
        assert (within.depth[np.array(expected) < -1e-4] < 0).all()


@SIDES
def test_every_reason_is_named(tmp_path, side):
    """One hand, left and right: hollow, welded plate, finger inside the palm, links not collided, an explicit pair."""
    robot = model(tmp_path, hand(side))
    at = side * np.array([0, 1, 0])
    taxels = layout(
        {
            "palm": [
                [0.01, side * 0.02, 0.02],  # in the hollow
                [0, side * 0.015, 0.02],  # on the outside, 4 mm deep in the welded plate
                [0, side * 0.025, 0.03],  # on the outside, free
                [0.03, side * 0.005, 0.02],  # on the end, inside the finger
            ],
            "plate": [[0.006, 0, 0] + 0 * at, [-0.006, 0, 0] + 0 * at],  # in the palm, 4 mm; free
            "finger": [[0.004, side * 0.003, 0], [0.02, side * 0.003, 0]],  # in the palm; free
            "the tip": [[0.004, 0, 0]],
            "thumb": [[0.01, side * 0.01, 0.02], [0, side * 0.01, 0.02]],
        },
        radius=0.003,
    )
    assert unfelt_taxels(robot, taxels) == [
        ("palm", BURIED, [0, 1]),
        ("palm", COVERED, [3]),
        ("plate", BURIED, [4]),
        ("finger", COVERED, [6]),
        ("the tip", NOT_COLLIDED, [8]),
        ("thumb", BURIED, [9]),
    ]
    colliders = Colliders(robot)
    records = unfelt(colliders, taxels, reach(colliders, taxels))
    assert [str(record) for record in records if record.reason != BURIED] == [
        'palm: 1 of 4 taxels inside "finger" in the initial state',
        'finger: 1 of 2 taxels inside "palm" in the initial state',
        "the tip: 1 of 1 taxels on a body that the simulator does not collide",
    ]
    assert by_reason(records) == "not collided 1, buried 4, covered at rest 2"
    assert unfelt_ids(records).tolist() == [0, 1, 3, 4, 6, 8, 9]


def test_welded_bodies_bury_each_others_taxels(tmp_path):
    """They are one rigid body, so depths are those in the box and in the hull."""
    robot = model(tmp_path, hand())
    taxels = layout({"palm": [[0, 0.015, 0.02]], "plate": [[0.005, 0, 0]]})
    # The plate spans x from −8 to 4 mm, so its near side is 4 mm away. The other point is 3 mm behind the palm's side x = 0.
    np.testing.assert_allclose(reach(Colliders(robot), taxels).depth, [0.004, 0.003], rtol=0, atol=MESH_ATOL)


def test_objects_and_the_ground_cover_nothing(tmp_path):
    """A cube that floats into the palm is an object; the plane through the hand is no link."""
    robot = model(tmp_path, hand().replace('pos="0 0.03 0"><freejoint/>', 'pos="0 0.03 .03"><freejoint/>'))
    inside_the_cube = layout({"palm": [[0, 0.03, 0.03]]})
    assert unfelt_taxels(robot, inside_the_cube) == []
    sliding = model(tmp_path, hand().replace('pos="0 0.03 0"><freejoint/>', 'pos="0 0.03 .03"><joint type="slide"/>'))
    assert unfelt_taxels(sliding, inside_the_cube) == [("palm", COVERED, [0])]
    cube = int(sliding.compiled.body("cube").id)
    assert unfelt_taxels(sliding, inside_the_cube, (cube,)) == []


JAWS = """<mujoco><worldbody>
  <body name="base"><geom type="box" size=".03 .01 .01"/></body>
  <body name="jaw" pos="0 0 .015"><joint type="slide" axis="1 0 0"/><geom type="box" size=".01 .01 .01"/>
    <body><geom type="box" size=".01 .001 .01" pos="0 .01 0"/></body></body>
  <body name="held" mocap="true" pos="0 0 .025"><geom size=".005"/></body>
  <body pos="0 .012 .015"><joint type="hinge"/><geom type="box" size=".002 .004 .002"/></body>
</worldbody></mujoco>"""


def test_links_fixed_to_the_world_cover_each_other(tmp_path):
    """A fixed base and its sliding jaw cover each other; a mocap body covers nothing; unnamed bodies have a number."""
    robot = model(tmp_path, JAWS)
    taxels = layout({"base": [[0, 0, 0.01]], "jaw": [[0, 0, -0.01], [0, 0, 0.01], [0, 0.01, 0]]})
    colliders = Colliders(robot)
    records = unfelt(colliders, taxels, reach(colliders, taxels))
    assert [str(record) for record in records] == [
        'base: 1 of 1 taxels inside "jaw" in the initial state',
        'jaw: 1 of 3 taxels inside "base" in the initial state',
        "jaw: 1 of 3 taxels inside unnamed body 5 in the initial state",
    ]


def test_two_overlapping_solids_can_bury_a_taxel_together(tmp_path):
    """Where two boxes overlap by 2 mm, a taxel is 1 mm deep in each; only a large ball leaves both."""
    text = """<mujoco><worldbody><body name="link"><joint/>
      <geom type="box" size=".011 .02 .02" pos="-.01 0 0"/><geom type="box" size=".011 .02 .02" pos=".01 0 0"/>
      </body></worldbody></mujoco>"""
    robot = model(tmp_path, text)
    middle, edge = [0, 0, 0], [0, 0, 0.018]  # 20 mm and 2 mm from the outside
    for radius, expected in ((0.0015, [True, True]), (0.0025, [True, False]), (0.015, [True, False]), (0.021, [False, False])):
        within = reach(Colliders(robot), layout({"link": [middle, edge]}, radius))
        np.testing.assert_allclose(within.depth, [0.001, 0.001], rtol=0, atol=1e-12)
        assert within.is_buried.tolist() == expected, radius


def test_links_face_to_face_cover_nothing(tmp_path):
    """Boxes share a face at rest, in frames where float64 cannot represent it."""
    text = """<mujoco><worldbody><body name="a" pos=".1 .7 .3" euler="13 29 31"><geom type="box" size=".01 .01 .01"/>
      <body name="b" pos=".02 0 0"><joint/><geom type="box" size=".01 .01 .01"/></body></body></worldbody></mujoco>"""
    taxels = layout({"a": [[0.01, 0, 0], [0.01, 0.01, 0.01]], "b": [[-0.01, 0, 0]]})
    assert unfelt_taxels(model(tmp_path, text), taxels) == []


def test_inactive_taxels_are_not_reported(tmp_path):
    robot = model(tmp_path, hand())
    assert unfelt_taxels(robot, layout({"palm": [[0.01, 0.02, 0.02]], "the tip": [[0, 0, 0]]}, radius=0.0)) == []
    none = layout({"palm": np.zeros((0, 3))})
    assert unfelt_taxels(robot, none) == [] and unfelt_ids(()).tolist() == []


@pytest.mark.parametrize("format", ["urdf", "usd"])
def test_the_same_hand_from_other_formats(tmp_path, format):
    """A box that reaches into its parent, in URDF and in USD written from MJCF."""
    urdf = """<robot name="r"><link name="a"><collision><geometry><box size=".02 .02 .02"/></geometry></collision></link>
      <link name="b"><collision><geometry><box size=".02 .01 .01"/></geometry></collision></link>
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz=".015 0 0"/><axis xyz="0 1 0"/>
      <limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""
    (tmp_path / "r.urdf").write_text(urdf)
    with pytest.warns(UserWarning, match="do not collide: a and b"):
        robot = load_model(tmp_path / "r.urdf")
    if format == "usd":
        text = """<mujoco><worldbody><body name="a"><geom name="ga" type="box" size=".01 .01 .01"/>
          <body name="b" pos=".015 0 0"><joint name="j" axis="0 1 0" range="0 1"/><geom name="gb" type="box" size=".01 .005 .005"/>
          </body></body></worldbody></mujoco>"""
        write_usd(model(tmp_path, text), tmp_path / "r.usda")
        robot = load_model(tmp_path / "r.usda")
    taxels = layout({"a": [[0.01, 0, 0], [-0.01, 0, 0]], "b": [[-0.01, 0, 0], [0.01, 0, 0]]})
    assert unfelt_taxels(robot, taxels) == [("a", COVERED, [0]), ("b", COVERED, [2])]
