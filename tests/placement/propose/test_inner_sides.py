"""Inner sides, hands and closing motions of made-up hands, and inner sides of the included robots."""

from functools import cache

import mujoco
import numpy as np
import pytest
from closing_hands import INNER, MADE, arm, one_jaw, parallel_jaws, single_links, slides, spread_fingers, world
from odd_hands import FOUR_BAR

from tgdsl.errors import TgdslError
from tgdsl.files.find import layout_of, robot_path
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import Proposal, closing_motion, propose
from tgdsl.placement.propose.surfaces import Sampler
from tgdsl.schema.load import load_layout
from tgdsl.schema.select import matching

DENSITY = 1e4


def loaded(tmp_path, text: str, name: str = "hand.xml"):
    (tmp_path / name).write_text(text)
    return load_model(tmp_path / name)


@pytest.fixture(scope="module", params=MADE)
def made(request, tmp_path_factory):
    """Return a hand and the layout proposed for it."""
    hand = MADE[request.param]
    return hand, propose(loaded(tmp_path_factory.mktemp("made"), hand.text), DENSITY)


def test_inner_sides_of_made_up_hands_are_found(made):
    hand, proposal = made
    facing = {link.name: link.facing for link in proposal.links}
    assert facing == {name: hand.facing.get(name, INNER) for name in facing}


def with_rotated_frames(text: str, rotation: np.ndarray) -> mujoco.MjSpec:
    """Return a hand with rotated frames of links; all geoms and joints stay in place."""
    spec = mujoco.MjSpec.from_string(text)
    model = spec.compile()
    quat, inverse, product = np.zeros(4), np.zeros(4), np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.ravel())
    mujoco.mju_negQuat(inverse, quat)
    for i in range(1, model.nbody):
        body, is_first = spec.body(model.body(i).name), not model.body_parentid[i]
        mujoco.mju_mulQuat(product, model.body_quat[i], quat)
        if not is_first:
            mujoco.mju_mulQuat(product, inverse, product.copy())
        body.alt.type, body.quat = mujoco.mjtOrientation.mjORIENTATION_QUAT, product
        body.pos = model.body_pos[i] if is_first else rotation.T @ model.body_pos[i]
        for geom in body.geoms:  # frames of geoms are relative to their links
            geom.pos, geom.quat = rotation.T @ geom.pos, inverse
        for joint in body.joints:
            joint.pos, joint.axis = rotation.T @ joint.pos, rotation.T @ joint.axis
    for equality in spec.equalities:
        if equality.type == mujoco.mjtEq.mjEQ_CONNECT:
            equality.data[:3] = rotation.T @ equality.data[:3]
    return spec


@pytest.mark.parametrize(
    ("name", "turn"),
    [
        ("parallel_jaws", (0, 0, 25)),
        ("parallel_jaws", (0, 0, 45)),
        ("spread_fingers", (0, 25, 0)),
        ("five_fingers", (10, 20, 35)),
    ],
)
def test_inner_sides_do_not_depend_on_the_frames_of_links(tmp_path, name, turn):
    """Directions are rounded to hundredths, and an axis within 15 deg replaces a flat side's normal."""
    quat, rotation = np.zeros(4), np.zeros(9)
    mujoco.mju_euler2Quat(quat, np.radians(turn), "xyz")
    mujoco.mju_quat2Mat(rotation, quat)
    rotation, hand = rotation.reshape(3, 3), MADE[name]
    proposal = propose(loaded(tmp_path, with_rotated_frames(hand.text, rotation).to_xml()), DENSITY)
    for link in proposal.links:
        expected = np.array(hand.facing.get(link.name, INNER))
        assert rotation @ link.facing @ expected > np.cos(np.radians(15.2)) * np.linalg.norm(link.facing), link.name
    assert set(proposal.groups["tips"]) == hand.tips


def test_bodies_that_are_not_the_hand_are_left_out(made):
    hand, proposal = made
    assert {name for name, why in proposal.left_out if "--include" in why} == hand.left_out
    assert {name for name, why in proposal.left_out} - hand.left_out <= {"world", "base"}
    assert set(proposal.groups["tips"]) == hand.tips


def test_doubtful_guesses_are_named(made):
    hand, proposal = made
    assert {link.name for link in proposal.links if link.doubt} == hand.doubted


def test_included_links_are_added(tmp_path):
    robot = loaded(tmp_path, world(arm(slides()) + '<body name="f[1]" pos="2 0 0"><geom size=".01"/></body>'))
    for include, names in ((("arm1",), {"arm1"}), (("arm[45]", "f[[]1]"), {"arm4", "arm5", "f[1]"}), (("f[1]",), {"f[1]"})):
        proposal = propose(robot, DENSITY, include=include)
        extra = {link.name: link for link in proposal.links if link.name not in ("gripper", "jaw0", "jaw1")}
        assert extra.keys() == names
        assert {(link.facing, link.doubt) for link in extra.values()} == {(None, "asked for with --include")}
        assert not names & {name for group in proposal.groups.values() for name in group}


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("amr1", '--include: no link matches "amr1"; did you mean "arm1"?'),
        ("frame*", '--include: "frame" can have no taxels: no geoms'),
        ("", '--include: no link matches ""; known links: arm1, arm2, arm3, arm4, arm5, gripper, jaw0, jaw1'),
    ],
)
def test_links_that_cannot_be_included_are_refused(tmp_path, pattern, message):
    robot = loaded(tmp_path, world(arm(slides()) + '<body name="frame"/>'))
    with pytest.raises(TgdslError) as caught:
        propose(robot, DENSITY, include=(pattern,))
    assert str(caught.value) == message


def test_the_command_names_weak_guesses_and_takes_include(tmp_path, here):
    (tmp_path / "hand.xml").write_text(MADE["thumb_away_from_the_left_palm"].text)
    code, output, _ = here(tmp_path, "layout", "new", "hand.xml")
    text = (tmp_path / "layout.yaml").read_text()
    assert code == 0
    assert "weak guess of the inner side: thumb" in output and "away from the palm" in output
    assert "inner side guessed from how the joints close; weak: as it curls, its tip goes" in text
    (tmp_path / "hand.xml").write_text(MADE["arm_and_slides"].text)
    code, output, _ = here(tmp_path, "layout", "new", "hand.xml", "--force", "--include", "arm5", "arm1")
    text = (tmp_path / "layout.yaml").read_text()
    assert code == 0
    assert "left out: arm2, arm3, arm4: before the link from which the fingers part; --include adds it\n" in output
    assert "all around: arm1, arm5: asked for with --include\n" in output
    assert "# Left out: arm2, arm3, arm4: before" in text and text.count("asked for with --include: all around\n") == 2


@cache
def proposed(robot: str) -> Proposal:
    """Return the proposal for an included robot."""
    return propose(load_model(robot_path(robot)), DENSITY)


@pytest.mark.parametrize("robot", ["xhand1", pytest.param("sharpa", marks=pytest.mark.slow)])
def test_included_robots_face_their_pads(robot):
    """The guess for each link agrees within 45 deg with its pad's direction in the robot's layout."""
    layout = load_layout(layout_of(robot)).spec
    facing = {link.name: link.facing for link in proposed(robot).links}
    for pattern, placement in layout.resolutions["med"].items():
        for name in matching(pattern, list(load_model(robot_path(robot)).bodies)):
            pad, guess = -np.array(placement.direction), np.array(facing[name])
            assert pad @ guess / np.linalg.norm(pad) / np.linalg.norm(guess) > np.cos(np.radians(45.0)), name


def test_groups_and_sides_of_the_xhand1_match_its_layout():
    proposal, stem = proposed("xhand1"), "right_hand"
    tips = ("thumb_rota_link2", "index_rota_link2", "mid_link2", "ring_link2", "pinky_link2")
    assert proposal.groups["tips"] == tuple(f"{stem}_{tip}" for tip in tips)
    assert proposal.groups["palm"] == (f"{stem}_link",)
    facing = {link.name.removeprefix(f"{stem}_"): link.facing for link in proposal.links}
    assert facing["thumb_rota_link2"] == (0, 0, 1)
    assert {facing[name] for name in ("link", "index_rota_link2", "mid_link1", "mid_link2", "pinky_link2")} == {(1, 0, 0)}


@pytest.mark.parametrize("pos", ["0 0 .1", "2 -1 .5"])
def test_a_palm_faces_the_fingers_that_stand_on_it(tmp_path, pos):
    """Two fingers and a thumb opposite of them: the two curl alike, and all three can close into the palm."""
    finger = """<body name="{0}" pos="{1} 0.015" euler="0 0 {2}"><joint axis="0 -1 0" range="-30 90"/>
        <geom type="capsule" fromto="0 0 .004 0 0 .04" size=".008"/>
        <body name="{0}_tip" pos="0 0 .045"><joint axis="0 -1 0" range="-30 90"/>
          <geom type="capsule" fromto="0 0 0 0 0 .03" size=".008"/></body></body>"""
    places = (("a", ".035 .02", 0), ("b", ".035 -.02", 0), ("thumb", "-.035 0", 180))
    fingers = "".join(finger.format(*place) for place in places)
    palm = f'<body name="palm" pos="{pos}"><geom type="box" size=".04 .04 .01"/>{fingers}</body>'
    facing = {link.name: link.facing for link in propose(loaded(tmp_path, world(palm)), DENSITY).links}
    assert facing == {"palm": (0, 0, 1)} | {name: (-1, 0, 0) for name in facing if name != "palm"} and len(facing) == 7


def test_slides_close_to_where_they_meet(tmp_path):
    assert closing_motion(loaded(tmp_path, world(slides()))) == {"slide0": (0.04, 0.0), "slide1": (0.04, 0.0)}
    robot = loaded(tmp_path, world(arm(slides("open"))))
    assert closing_motion(robot) == {"slide0": (0.0, -0.04), "slide1": (0.0, -0.04)}


def test_a_thumb_closes_as_it_curls(tmp_path):
    for side, sign in (("right", 1), ("left", -1)):
        motion = closing_motion(loaded(tmp_path, MADE[f"thumb_away_from_the_{side}_palm"].text))
        assert len(motion) == 15
        for name, ends in motion.items():
            expected = (0.0, sign * np.radians(50.0)) if name.startswith("thumb") else (0.0, np.radians(90.0))
            np.testing.assert_allclose(ends, expected, rtol=0, atol=1e-12)


def test_mimic_joints_close_with_their_leader(tmp_path):
    motion = closing_motion(loaded(tmp_path, parallel_jaws()))
    for name, (opened, closed) in motion.items():
        expected = -45.0 if name.endswith("_level") else 45.0
        np.testing.assert_allclose((opened, np.degrees(closed)), (0.0, expected), rtol=0, atol=1e-3)
    assert len(motion) == 6


def test_mimic_joints_against_their_limits_close_separately(tmp_path):
    """A mimic of −1 would move slides of opposite axes the same way, past the second one's limits."""
    mimic = '<equality><joint joint1="slide1" joint2="slide0" polycoef="0 -1 0 0 0"/></equality></mujoco>'
    robot = loaded(tmp_path, world(slides()).replace("</mujoco>", mimic))
    assert closing_motion(robot) == {"slide0": (0.04, 0.0), "slide1": (0.04, 0.0)}
    assert {link.name: link.facing for link in propose(robot, DENSITY).links if link.name != "gripper"} == dict.fromkeys(
        ("jaw0", "jaw1"), INNER
    )


def test_loops_hold_while_closing(tmp_path):
    """Both poses satisfy MuJoCo's residuals of the loops; the pads close to half their distance and face each other."""
    text = FOUR_BAR
    for side in ("left", "right"):
        for part in ("driver", "finger", "rocker"):
            start = text.index("<joint", text.index(f'name="{side}_{part}"'))
            text = f'{text[:start]}<joint name="{side}_{part}"{text[start + 6 :]}'
    coupled = '<joint joint1="right_driver" joint2="left_driver" polycoef="0 1 0 0 0"/></equality>'
    for variant in (text, text.replace("</equality>", coupled)):
        robot = loaded(tmp_path, variant)
        motion = closing_motion(robot)
        assert motion.keys() == {f"{side}_{part}" for side in ("left", "right") for part in ("driver", "finger", "rocker")}
        model = robot.compiled
        data, apart = mujoco.MjData(model), []
        for end in (0, 1):
            for name, ends in motion.items():
                data.joint(name).qpos[:] = ends[end]
            mujoco.mj_forward(model, data)
            is_loop = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
            assert is_loop.any() and np.abs(data.efc_pos[: data.nefc][is_loop]).max() < 1e-4
            apart.append(float(np.linalg.norm(data.body("left_pad").xpos - data.body("right_pad").xpos)))
        assert apart[1] < 0.5 * apart[0]
        facing = {link.name: link.facing for link in propose(robot, DENSITY).links}
        assert {facing[name] for name in ("left_pad", "right_pad", "left_finger", "right_finger")} == {INNER}
        assert facing["base"] == (0, 0, 1)


def test_an_arm_alone_closes_nothing(tmp_path):
    robot = loaded(tmp_path, world(arm("")))
    assert closing_motion(robot) == {}
    proposal = propose(robot, DENSITY)
    assert len(proposal.links) == 5 and {link.facing for link in proposal.links} == {None}


@pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])
def test_one_jaw_closes_against_a_fixed_one(tmp_path, side):
    """It closes to upright, wherever in its range it starts."""
    for span, ref, ends in (("0 70", 0, (70.0, 0.0)), ("-40 40", -40, (40.0, -40.0)), ("0 70", 30, (0.0, 70.0))):
        text = one_jaw(span, ref, side)
        if ref == 30:  # opposite axis, opened by 40 deg at the start
            turn = 180 if side > 0 else 0
            text = text.replace(f'euler="0 0 {turn}"', f'euler="0 {40 * side} {turn}"').replace('axis="0 -1 0"', 'axis="0 1 0"')
        motion = closing_motion(loaded(tmp_path, world(text)))
        np.testing.assert_allclose(motion["hinge"], np.radians(ends), rtol=0, atol=1e-12)


def test_an_elbow_that_folds_is_no_jaw(tmp_path):
    """A forearm folds by 150 deg onto an upper arm of the same length."""
    forearm = '<body name="fore" pos="0 0 .1"><joint axis="0 1 0" range="0 150"/><geom type="box" size=".01 .01 .04" pos="0 0 .05"/></body>'
    upper = f'<body name="upper" pos="0 0 .05"><joint axis="0 1 0" range="-20 90"/><geom type="box" size=".01 .01 .04" pos="0 0 .05"/>{forearm}</body>'
    robot = loaded(tmp_path, world(f'<body name="base"><geom size=".02"/>{upper}</body>'))
    assert closing_motion(robot) == {}


def test_joints_that_spread_fingers_close_nothing(tmp_path):
    motion = closing_motion(loaded(tmp_path, spread_fingers()))
    assert motion.keys() == {f"{finger}_{joint}" for finger in "abc" for joint in ("flex", "level")}
    for name, ends in motion.items():
        expected = np.radians(60.0 if name.endswith("flex") else -60.0)
        np.testing.assert_allclose(ends, (0.0, expected), rtol=0, atol=1e-4)


def test_servos_give_ranges_of_joints_without_limits(tmp_path):
    """A servo's setpoints are radians of its shaft, here geared by 2; they hold even if the joint goes farther."""
    expected = {f"{finger}_hinge": tuple(np.radians((60.0, 0.0))) for finger in "abc"}
    servos = "".join(f'<position joint="{n}_hinge" kp="3" gear="2" ctrlrange="0 {2 * np.radians(60.0)}"/>' for n in "abc")
    for joint in ('ref="40"', 'ref="40" range="-30 60"'):
        motion = closing_motion(loaded(tmp_path, single_links(joint, f"<actuator>{servos}</actuator>")))
        assert motion.keys() == expected.keys()
        np.testing.assert_allclose([*motion.values()], [*expected.values()], rtol=0, atol=1e-12)
    assert closing_motion(loaded(tmp_path, single_links('ref="40"'))) == {}


@pytest.mark.parametrize("limits", ["", 'range="0 0"'], ids=["none", "nothing"])
def test_fingers_without_limits_close_where_their_tips_meet(tmp_path, limits):
    """Upright links around a palm face each other by a weak guess; their closing range is unknown."""
    robot = loaded(tmp_path, single_links(limits))
    proposal = propose(robot, DENSITY)
    assert {link.name: link.facing for link in proposal.links} == {"palm": (0, 0, 1), "a": INNER, "b": INNER, "c": INNER}
    doubt = "no joint of the hand has limits: its hinges are assumed to turn by 30 deg to either side"
    assert {link.doubt for link in proposal.links if link.name != "palm"} == {doubt}
    assert closing_motion(robot) == {}


def test_radians_read_as_degrees_are_recognised(tmp_path, here):
    """The command notes it, and the motion keeps MuJoCo's limits."""
    (tmp_path / "meant.xml").write_text(single_links('range="0 1.05" ref="0.7"', '<compiler angle="radian"/>'))
    (tmp_path / "hand.xml").write_text(MADE["radians_read_as_degrees"].text)
    meant, misread = (load_model(tmp_path / name) for name in ("meant.xml", "hand.xml"))
    assert [propose(model, DENSITY).is_misread for model in (meant, misread)] == [False, True]
    ends = closing_motion(misread)
    assert ends.keys() == {f"{finger}_hinge" for finger in "abc"}
    np.testing.assert_allclose([*ends.values()], [np.radians((1.05, 0.0))] * 3, rtol=0, atol=1e-12)
    code, output, _ = here(tmp_path, "layout", "new", "hand.xml")
    line = "no hinge of this robot turns by more than 6.28 degrees: its limits look like radians"
    assert code == 0 and f"limits: {line}" in output and f"# Note: {line}" in (tmp_path / "layout.yaml").read_text()


def test_a_covered_tip_is_no_part_of_a_hand(tmp_path):
    """It is listed as left out, and the link before it is the tip."""
    text = MADE["single_links"].text.replace(
        '<geom type="box" size=".005 .008 .03" pos="0 0 .035"/></body>',
        '<geom type="box" size=".005 .008 .03" pos="0 0 .035"/><body name="core" pos="0 0 .03"><joint axis="0 1 0" range="0 90"/>'
        '<geom type="box" size=".002 .002 .002"/></body></body>',
        1,
    )
    proposal = propose(loaded(tmp_path, text), DENSITY)
    assert proposal.left_out == (("core", "all of it is inside other links in the initial state"),)
    assert set(proposal.groups["tips"]) == set("abc") and "core" not in {link.name for link in proposal.links}
    assert {link.facing for link in proposal.links if link.name in "abc"} == {INNER}


def test_only_links_with_taxels_are_sampled(tmp_path, monkeypatch):
    sampled, original = list[str](), Sampler.sampled
    monkeypatch.setattr(Sampler, "sampled", lambda own, name, radius: sampled.append(name) or original(own, name, radius))
    robot = loaded(tmp_path, world(arm(slides())))
    assert sampled == []
    propose(robot, DENSITY, include=("arm2",))
    assert sorted(sampled) == ["arm2", "gripper", "jaw0", "jaw1"]
    closing_motion(robot)
    assert len(sampled) == 4


def test_a_knuckle_that_bends_and_spreads_closes_by_bending(tmp_path):
    """Both joints belong to one body."""
    text = MADE["five_fingers"].text
    index = text.index("<joint", text.index('name="f0_1"'))
    robot = loaded(tmp_path, f'{text[:index]}<joint name="spread" axis="1 0 0" range="-20 20"/>{text[index:]}')
    motion = closing_motion(robot)
    assert motion.keys() == closing_motion(loaded(tmp_path, text)).keys() and "spread" not in motion


def test_a_tip_that_rolls_about_its_middle_closes_nothing(tmp_path):
    text = world(slides())
    for name in ("jaw0", "jaw1"):
        index = text.index("</body>", text.index(f'name="{name}"'))
        roller = f'<body name="{name}_tip" pos="0 0 .07"><joint name="{name}_roll" axis="0 0 1" range="-90 80"/><geom type="box" size=".004 .004 .01"/></body>'
        text = text[:index] + roller + text[index:]
    assert closing_motion(loaded(tmp_path, text)).keys() == {"slide0", "slide1"}


def hand_with_thumb(thumb: str, finger_range: str = "0 90") -> str:
    """Return a palm with two curling fingers and a thumb."""
    finger = (
        '<body name="{0}a" pos=".03 {1} .01"><joint name="{0}a" axis="0 1 0" range="{2}"/><geom type="cylinder" fromto="0 0 0 0 0 .04" size=".007"/>'
        '<body name="{0}b" pos="0 0 .05"><joint name="{0}b" axis="0 1 0" range="{2}"/><geom type="cylinder" fromto="0 0 0 0 0 .03" size=".007"/>{3}'
        "</body></body>"
    )
    marker = '<body name="{}" pos="0 0 .04"><geom type="sphere" size=".0003"/></body>'
    fingers = "".join(
        finger.format(name, y, finger_range, marker.format(f"{name}_end")) for name, y in (("f", 0.02), ("g", -0.02))
    )
    palm = '<body name="palm"><geom type="box" size=".04 .04 .008"/>'
    return f"<mujoco><worldbody>{palm}{fingers}{thumb}</body></worldbody></mujoco>"


THUMB = """<body name="t0" pos="-.03 0 .01"><joint name="t0" axis="0 1 0" range="-90 0"/>
  <geom type="cylinder" fromto="0 0 0 0 0 .04" size=".007"/>
  <body name="t1" pos="0 0 .05"><joint name="t1" axis="0 1 0" range="-90 0"/><geom type="cylinder" fromto="0 0 0 0 0 .02" size=".007"/>
    <body name="t2" pos="0 0 .03"><joint name="t2" axis="{}" range="{}"/>
      <geom type="cylinder" fromto="0 0 0 0 0 .03" size=".007"/></body></body></body>"""


def test_a_side_across_the_links_hinge_is_weak(tmp_path):
    """The last link faces along x, where the joint before it moves it; its own hinge swings it along y."""
    across = propose(loaded(tmp_path, hand_with_thumb(THUMB.format("1 0 0", "-20 20"))), DENSITY)
    sides = {link.name: (link.facing, link.doubt) for link in across.links}
    facing, doubt = sides["t2"]
    assert np.abs(facing)[0] == 1.0
    assert doubt == "its own hinge carries it across the side that it faces"
    assert {sides[name][1] for name in ("fa", "fb", "ga", "gb")} == {""}
    along = propose(loaded(tmp_path, hand_with_thumb(THUMB.format("0 1 0", "-90 0")), "other.xml"), DENSITY)
    assert {link.name: link.doubt for link in along.links}["t2"] == ""


@pytest.mark.parametrize(("radius", "area"), [(".0003", "0.011"), (".001", "0.13")])
def test_markers_are_no_tips(tmp_path, radius, area):
    """A ball's surface is 4 π r²; the links before the markers are the tips, whatever the markers' names."""
    text = hand_with_thumb(THUMB.format("0 1 0", "-90 0")).replace(".0003", radius)
    proposal = propose(loaded(tmp_path, text), DENSITY)
    assert set(proposal.groups["tips"]) == {"fb", "gb", "t2"}
    reasons = dict(proposal.left_out)
    assert reasons["f_end"] == reasons["g_end"] == f"a marker: its surface is {area} cm²"


def test_a_thumb_faces_where_it_bends_not_along_its_hinges(tmp_path):
    """The first hinge swings the thumb along y; the others, about y, bend it along x."""
    thumb = THUMB.format("0 1 0", "0 90").replace('axis="0 1 0" range="-90 0"', 'axis="0 1 0" range="0 90"')
    thumb = thumb.replace(
        '-.03 0 .01"><joint name="t0" axis="0 1 0" range="0 90"/>', '-.03 .04 .01"><joint name="t0" axis="1 0 0" range="0 60"/>'
    )
    links = {link.name: link for link in propose(loaded(tmp_path, hand_with_thumb(thumb)), DENSITY).links}
    assert {links[name].facing for name in ("t0", "t1", "t2")} == {(1.0, 0.0, 0.0)}
    assert {links[name].doubt for name in ("t0", "t1", "t2")} == {""}


def fingers_along_x(bent: float, joints: str) -> str:
    """Return a palm with three fingers along x that bend toward z, with brackets below their hinges.

    Args:
        bent: How far each link is bent at the start [deg].
        joints: Joints of a bracket and of its finger, separated by `|`; `{0}` is the finger's number.
    """
    first, second = joints.split("|")
    fingers = "".join(
        f"""<body name="f{i}" pos=".04 {y} 0" euler="0 {-bent} 0">{first.format(i)}<geom type="box" size=".012 .008 .006" pos=".01 0 -.02"/>
        <body name="g{i}" pos=".05 0 0" euler="0 {-bent} 0">{second.format(i)}<geom type="cylinder" fromto="0 0 0 .04 0 0" size=".007"/>
        </body></body>"""
        for i, y in enumerate((-0.03, 0.0, 0.03))
    )
    return (
        f'<mujoco><worldbody><body name="palm"><geom type="box" size=".04 .04 .008"/>{fingers}</body></worldbody>{{}}</mujoco>'
    )


def test_a_palm_faces_where_bones_move_not_brackets(tmp_path):
    """A bracket 10 mm before and 20 mm below its hinge moves along x as the finger bends toward z."""
    joints = '<joint axis="0 -1 0" range="-20 100"/>|<joint axis="0 -1 0" range="-20 100"/>'
    links = propose(loaded(tmp_path, fingers_along_x(0.0, joints).format("")), DENSITY).links
    assert {link.name: link.facing for link in links}["palm"] == (0.0, 0.0, 1.0)


def test_a_single_drive_closes_to_where_tips_meet(tmp_path):
    """The links start bent by 70 degrees, and the drive straightens them."""
    joints = '<joint name="f{0}" axis="0 1 0" range="0 70"/>|<joint name="g{0}" axis="0 1 0" range="0 70"/>'
    bound = "".join(f'<joint joint1="{name}" joint2="f0"/>' for name in ("f1", "f2", "g0", "g1", "g2"))
    text = fingers_along_x(70.0, joints).format(f"<equality>{bound}</equality>")
    robot = loaded(tmp_path, text)
    assert closing_motion(robot)["f0"] == pytest.approx((np.radians(70), 0.0))
    facing = {link.name: link.facing for link in propose(robot, DENSITY).links}
    assert {facing[name] for name in ("palm", "g0", "g1", "g2")} == {(0.0, 0.0, 1.0)}


def test_a_wrist_that_turns_all_around_is_no_jaw(tmp_path):
    text = world(one_jaw("-180 180"))
    links = propose(loaded(tmp_path, text), DENSITY).links
    assert {link.facing for link in links} == {None}


@pytest.mark.parametrize("limits", ["-30 90", "-40 60", "0 30"])
def test_rounding_of_limits_decides_nothing(tmp_path, limits):
    """Typical limits, each also with float32 rounding."""
    low, high = map(float, limits.split())
    sides = set()
    for i, (one, two) in enumerate([(0, 0), (1e-7, -1e-7), (-1e-7, 1e-7)]):
        text = hand_with_thumb(THUMB.format("0 1 0", "-90 0"), f"{low * (1 + one)!r} {high * (1 + two)!r}")
        links = propose(loaded(tmp_path, text, f"hand{i}.xml"), DENSITY).links
        sides.add(tuple((link.name, link.facing, link.doubt) for link in links))
    assert len(sides) == 1


def test_counts_do_not_depend_on_the_last_bits_of_an_area(tmp_path):
    """Boxes of 40 cm² hold 2.5 taxels at 0.0625/cm²; areas are only accurate to about 1e-7."""
    counts = set()
    for i, scale in enumerate((1.0, 1 + 1e-7, 1 - 1e-7, 1 + 3e-8, 1 - 3e-8)):
        geom = f'<geom type="box" size="{0.01 * scale!r} {0.02 * scale!r} {0.01 * scale!r}"/>'
        bodies = "".join(f'<body name="{n}" pos="{x} 0 0"><joint/>{geom}</body>' for n, x in (("a", 0.1), ("b", -0.1)))
        links = propose(loaded(tmp_path, f"<mujoco><worldbody>{bodies}</worldbody></mujoco>", f"{i}.xml"), 625.0).links
        counts.add(tuple(tuple(link.counts.values()) for link in links))
    assert len(counts) == 1
