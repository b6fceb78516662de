"""Hands without keyframes close on an object: any kind of drive presses at least two links."""

import functools
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from closing_hands import finger, hinged_jaws, world
from odd_hands import CAPSULES, FOUR_BAR, TENDON
from unscripted_hands import GRIPPER, URDF

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.closing.closing import GRIP, MOST, START, Closing, closing_of
from tgdsl.runtime.rollout import controls_between, rollout

BALL = {"geom": {"type": "sphere", "size": [0.012]}}
HANDS = {
    "gripper.xml": GRIPPER,
    "tendon.xml": TENDON,
    "three fingers.urdf": URDF,
    "capsules.xml": CAPSULES,
    "four_bar.xml": FOUR_BAR,
}
BALL_RADII = {"capsules.xml": 0.02, "tendon.xml": 0.016}
"""Radii of balls that fit between fingers and palm; the tendon hand would press one of 12 mm 3 mm into its palm [m]."""
SECONDS = 1.0
HELD_ATOL = 2e-3
"""How far soft constraints let held joints move under the forces of a grip [rad, m]."""
SOLVER_RTOL = 0.02
"""The grip is at rest except for the drag of the object."""


def module(folder: Path, name: str, text: str, objects: dict | None = None, scene: str = "") -> tgdsl.TactileModule:
    """Compile a hand with a contact sensor on each body with geoms."""
    (folder / name).write_text(text)
    objects = objects or {"ball": BALL}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / name)},
        "objects": objects,
        "sensors": {"load": {"kind": "link_contact", "links": "*", "feels": list(objects)}},
    }
    if scene:
        (folder / "scene.xml").write_text(scene)
        document["scene"] = {"model": str(folder / "scene.xml")}
    return tgdsl.compile(document, dtype=torch.float64)


def closed(touch: tgdsl.TactileModule, num_envs: int = 1) -> tuple[Closing, BatchSimulation, torch.Tensor]:
    """Close the hand; return its closing, the final simulation, and the force on each link (env, link) [N]."""
    closing = closing_of(touch)
    assert isinstance(closing, Closing), closing
    sim = BatchSimulation(touch, num_envs, substeps=5, keyframe=START, prepare=closing.prepare)
    controls = controls_between(closing.targets(sim.model.nu), SECONDS, sim.control_step)
    for step in rollout(touch, sim, controls):
        assert all(torch.isfinite(reading).all() for reading in step.readings.values())
    sim.forward()
    return closing, sim, touch(sim.state())["load"][..., 1:].norm(dim=-1)


@pytest.fixture(scope="module")
def closed_on_ball(tmp_path_factory) -> Callable[[str], tuple[Closing, BatchSimulation, torch.Tensor]]:
    """Close a hand of `HANDS` on a ball; results are cached."""

    @functools.cache
    def close(name: str) -> tuple[Closing, BatchSimulation, torch.Tensor]:
        ball = {"geom": {"type": "sphere", "size": [BALL_RADII.get(name, 0.012)]}}
        return closed(module(tmp_path_factory.mktemp("hand"), name, HANDS[name], {"ball": ball}))

    return close


def forces_on(sim: BatchSimulation, body: str, env: int = 0) -> dict[str, float]:
    """Return the normal forces between a body and others, from MuJoCo's function [N]."""
    model, force, forces = sim.env_model(env), np.zeros(6), dict[str, float]()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = sim.qpos[env], sim.qvel[env], sim.ctrl[env]
    mujoco.mj_forward(model, data)
    for i, contact in enumerate(data.contact):
        names = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
        if body in names:
            mujoco.mj_contactForce(model, data, i, force)
            other = names[1 - names.index(body)]
            forces[other] = forces.get(other, 0.0) + float(force[0])
    return forces


@pytest.mark.slow
@pytest.mark.parametrize("name", HANDS)
def test_at_least_two_links_are_pressed(closed_on_ball, name):
    closing, sim, load = closed_on_ball(name)
    pressed = {link for link, force in forces_on(sim, "ball").items() if force > 0}
    assert len(pressed) >= 2 and (load[0] > 0).sum() >= 2
    assert torch.isfinite(sim.qpos).all() and closing.target == "ball" and closing.place is not None
    depth = -min(contact.dist for contact in _contacts(sim))
    assert depth < 0.2 * BALL_RADII.get(name, 0.012)  # soft contacts can bear the forces


def _contacts(sim: BatchSimulation):
    data = mujoco.MjData(sim.model)
    data.qpos[:] = sim.qpos[0]
    mujoco.mj_fwdPosition(sim.model, data)
    return list(data.contact)


@pytest.mark.slow
def test_a_gripper_presses_in_proportion_to_the_weight_and_its_arm_stays(closed_on_ball):
    """By virtual work, a servo that both jaws follow gives each half its force; the arm's motor is at zero."""
    closing, sim, _ = closed_on_ball("gripper.xml")
    assert str(closing) == "the hand closes on `ball`, put between the fingers, without gravity; 1 of 1 joints"
    np.testing.assert_allclose(closing.place[:2], 0.0, atol=1e-9)  # midway between the jaws
    mass = float(sim.model.body("ball").mass[0])
    forces = forces_on(sim, "ball")
    assert forces.keys() == {"left", "right"}
    assert sum(forces.values()) == pytest.approx(GRIP * mass * 9.81, rel=SOLVER_RTOL)
    for joint in ("lift", "turn"):
        assert abs(float(sim.qpos[0, sim.joints[joint].qpos])) < HELD_ATOL
    assert float(sim.qpos[0, sim.joints["left slide"].qpos]) == pytest.approx(0.012, abs=1e-3)  # the ball's radius
    assert closing.resting == (0, 1) and not sim.ctrl[0, :2].any()


def test_a_hinge_presses_with_the_weight_between_its_tips_middle_and_far_end(tmp_path):
    ball = {"type": "sphere", "size": [0.012], "density": 500}
    closing = closing_of(module(tmp_path, "jaws.xml", world(hinged_jaws()), {"ball": {"geom": ball}}))
    force = GRIP * 9.81 * 500 * 4 / 3 * np.pi * 0.012**3
    for servo in closing.servos:
        assert np.hypot(0.01, 0.04) < servo.limit / force < np.linalg.norm([0.015, 0.01, 0.07])


@pytest.mark.slow
def test_forces_are_bounded_on_a_heavy_object(tmp_path):
    text = scene("<body name='ball' pos='1 0 0'><freejoint/><geom size='.012' mass='5'/></body>")
    _, sim, _ = closed(module(tmp_path, "gripper.xml", GRIPPER, {"ball": {"body": "ball"}}, text))
    assert 0 < max(forces_on(sim, "ball").values()) < MOST


@pytest.mark.slow
def test_the_same_scene_closes_the_same_way(closed_on_ball, tmp_path):
    _, sim, _ = closed(module(tmp_path, "gripper.xml", GRIPPER))
    assert torch.equal(sim.qpos, closed_on_ball("gripper.xml")[1].qpos)


@pytest.mark.slow
def test_a_floating_hand_stays_where_it_is(closed_on_ball):
    _, sim, _ = closed_on_ball("tendon.xml")
    np.testing.assert_allclose(sim.qpos[0, :3], [0, 0, 0.3], atol=HELD_ATOL)


@pytest.mark.slow
def test_a_urdf_s_second_joints_follow_the_first(closed_on_ball):
    closing, sim, _ = closed_on_ball("three fingers.urdf")
    assert [servo.joint for servo in closing.servos] == ["a_1", "b_1", "thumb_1"] and closing.num_joints == 3
    for name in ("a", "b", "thumb"):
        one, two = (float(sim.qpos[0, sim.joints[f"{name}_{i}"].qpos]) for i in (1, 2))
        assert two == pytest.approx(0.8 * one, abs=0.05)


SCENE = """<mujoco><include file="gripper.xml"/><worldbody>{bodies}</worldbody>{rest}</mujoco>"""


def scene(bodies: str, rest: str = "") -> str:
    return SCENE.format(bodies=bodies, rest=rest)


@pytest.mark.slow
def test_an_object_between_the_fingers_stays_there(tmp_path):
    text = scene(
        "<body name='egg' pos='.002 .003 .435'><freejoint/><geom type='ellipsoid' size='.01 .012 .014' mass='.02'/></body>"
    )
    closing, _, load = closed(module(tmp_path, "gripper.xml", GRIPPER, {"egg": {"body": "egg"}}, text))
    assert closing.place is None
    assert str(closing) == "the hand closes on `egg`, where the scene has it; 1 of 1 joints"
    np.testing.assert_allclose(closing.start[-7:-4], [0.002, 0.003, 0.435])
    assert (load[0] > 0).sum() == 2


@pytest.mark.slow
def test_the_first_object_that_fits_is_the_target(tmp_path):
    bodies = "<body name='table' pos='0 0 -1'><geom type='box' size='.3 .3 .01'/></body>"
    bodies += "<body name='crate' pos='1 0 .3'><freejoint/><geom type='box' size='.3 .3 .3' mass='5'/></body>"
    bodies += "<body name='pen' pos='2 0 .3'><freejoint/><geom type='capsule' size='.004 .05' mass='.01'/></body>"
    objects = {name: {"body": name} for name in ("table", "crate", "pen")}
    touch = module(tmp_path, "gripper.xml", GRIPPER, objects, scene(bodies))
    closing = closing_of(touch)
    assert isinstance(closing, Closing) and closing.target == "pen"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bodies", "name", "why"),
    [
        (
            "<body name='table' pos='0 0 -1'><geom type='box' size='.3 .3 .01'/></body>",
            "table",
            "table is fixed out of its reach",
        ),
        (
            "<body name='crate' pos='1 0 .3'><freejoint/><geom type='box' size='.3 .3 .3'/></body>",
            "crate",
            "crate does not fit between its fingers",
        ),
    ],
)
def test_a_reason_says_why_it_does_not_close_on_an_object(tmp_path, bodies, name, why):
    assert closing_of(module(tmp_path, "gripper.xml", GRIPPER, {name: {"body": name}}, scene(bodies))) == why


@pytest.mark.slow
def test_a_fixed_object_within_reach_is_pressed(tmp_path):
    text = scene("<body name='post' pos='0 0 .44'><geom type='cylinder' size='.01 .02'/></body>")
    closing, _, load = closed(module(tmp_path, "gripper.xml", GRIPPER, {"post": {"body": "post"}}, text))
    assert closing.place is None and closing.body is None and (load[0] > 0).sum() == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("joint", "why"),
    [
        ("", "it has no hinge and no slide"),
        ("<joint type='hinge' axis='0 1 0' range='-60 60'/>", "which way its joints close is not clear"),
    ],
)
def test_a_reason_says_why_a_hand_does_not_close(tmp_path, joint, why):
    text = f"<mujoco><worldbody><body name='pad'>{joint}<geom type='box' size='.03 .03 .01'/></body></worldbody></mujoco>"
    assert closing_of(module(tmp_path, "pad.xml", text)) == why


def test_servos_ignore_the_scenes_defaults(tmp_path):
    ball, ends = {"ball": {"geom": {"type": "sphere", "size": [0.012]}}}, []
    plain = GRIPPER.replace('<position name="grip" joint="left slide" kp="200" ctrlrange="0 .04"/>', "")
    defaults = plain.replace("<default>", '<default><general gear="3" ctrllimited="true" forcerange="-1 1" biasprm="1 2 3"/>')
    assert plain != GRIPPER and defaults != plain
    for name, text in (("plain", plain), ("defaults", defaults)):
        _, sim, _ = closed(module(tmp_path, f"{name}.xml", text.replace('<motor name="up" joint="lift"/>', ""), ball))
        ends.append(sim.qpos[0].numpy())
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)


def test_ranges_in_radians_read_as_degrees_are_warned_of(tmp_path):
    text = world(hinged_jaws())
    misread = text.replace('range="0 40"', 'range="0 .7"')
    assert misread != text
    ball = {"ball": {"geom": {"type": "sphere", "size": [0.012]}}}
    with pytest.warns(UserWarning, match='no hinge turns by more than 2π degrees: is `angle="radian"` missing'):
        closing_of(module(tmp_path, "misread.xml", misread, ball))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        closing_of(module(tmp_path, "hand.xml", text, ball))


@pytest.mark.slow
def test_a_hand_closes_on_different_objects_per_environment(tmp_path):
    variants = [{"type": "sphere", "size": [0.012]}, {"type": "box", "size": [0.01, 0.011, 0.012]}]
    touch = module(tmp_path, "gripper.xml", GRIPPER, {"thing": {"variants": variants}})
    _, sim, load = closed(touch, num_envs=2)
    assert ((load > 0).sum(dim=1) == 2).all()
    assert [set(forces_on(sim, "thing", env)) for env in range(2)] == [{"left", "right"}] * 2


@pytest.mark.slow
def test_other_actuators_and_disabled_groups_stay_unchanged(tmp_path):
    bodies = (
        "<body name='fan' pos='1 0 0'><joint name='spin' axis='0 0 1' damping='.01'/><geom type='box' size='.1 .1 .01'/></body>"
    )
    rest = "<option actuatorgroupdisable='0 3'/><actuator><velocity joint='spin' kv='1' group='2'/><motor joint='spin' group='3'/></actuator>"
    objects = {"ball": BALL, "fan": {"body": "fan"}}
    touch = module(tmp_path, "gripper.xml", GRIPPER, objects, scene(bodies, rest))
    closing, sim, _ = closed(touch)
    groups = sim.model.actuator_group.tolist()
    is_off = [bool(sim.model.opt.disableactuator >> group & 1) for group in groups]
    assert closing.resting == (0, 1) and is_off == [True, True, False, True, False]
    assert closing.target == "ball"


def fan(groups) -> str:
    """Return a scene with a fan that has a motor in each group."""
    motors = "".join(f"<velocity joint='spin' kv='.01' group='{group}'/>" for group in groups)
    body = (
        "<body name='fan' pos='1 0 0'><joint name='spin' axis='0 0 1' damping='.01'/><geom type='box' size='.1 .1 .01'/></body>"
    )
    return scene(body, f"<actuator>{motors}</actuator>")


@pytest.mark.slow
@pytest.mark.parametrize("disabled", ["30", "7"])
def test_one_free_or_disabled_group_is_enough(tmp_path, disabled):
    """The hand's actuators rest in it, and the servos are in a group that MuJoCo cannot disable."""
    groups = range(30) if disabled == "30" else range(31)
    text = fan(groups).replace(
        "</mujoco>", f"<option actuatorgroupdisable='{disabled}'/></mujoco>" if disabled == "7" else "</mujoco>"
    )
    closing, sim, load = closed(module(tmp_path, "gripper.xml", GRIPPER, {"ball": BALL, "fan": {"body": "fan"}}, text))
    is_off = [bool(group < 31 and sim.model.opt.disableactuator >> group & 1) for group in sim.model.actuator_group.tolist()]
    assert closing.resting == (0, 1)
    assert is_off == [True, True, *(group == 7 and disabled == "7" for group in groups), False]
    assert (load[0] > 0).sum() >= 2


def test_no_free_actuator_group_is_an_error(tmp_path):
    closing = closing_of(module(tmp_path, "gripper.xml", GRIPPER, {"ball": BALL, "fan": {"body": "fan"}}, fan(range(31))))
    assert isinstance(closing, Closing)
    spec = mujoco.MjSpec.from_file(str(tmp_path / "scene.xml"))
    with pytest.raises(SimulationError, match=r"not the hand's are in all 31 groups, .* leave one of the groups 0 to 30 free"):
        closing.prepare(spec)


# Two fingers of three joints: the second follows the first, and the third the second.
CHAINED = world(
    finger("left", ".03 0 .05", "0 0 180") + finger("right", "-.03 0 .05") + '<geom type="box" size=".05 .02 .015"/>'
)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(2, 3), (3, 2)])
def test_a_joint_that_follows_a_follower_closes_too(tmp_path, order):
    equalities = "".join(
        f"<joint joint1='{side}_j{i}' joint2='{side}_j{i - 1}' polycoef='{0.1 if i == 3 else 0} {0.5 * (i - 1)} 0 0 0'/>"
        for side in ("left", "right")
        for i in order
    )
    text = CHAINED.replace("</mujoco>", f"<equality>{equalities}</equality></mujoco>")
    touch = module(tmp_path, "chained.xml", text)
    closing = closing_of(touch)
    assert isinstance(closing, Closing)
    assert sorted(servo.joint for servo in closing.servos) == ["left_j1", "right_j1"]
    assert sorted(closing.slack) == ["left_j2", "left_j3", "right_j2", "right_j3"] and not closing.held
    model = BatchSimulation(touch, 1, keyframe=START, prepare=closing.prepare).model
    for side in ("left", "right"):
        one, two, three = (closing.start[model.joint(f"{side}_j{i}").qposadr[0]] for i in (1, 2, 3))
        assert two == pytest.approx(0.5 * one) and three == pytest.approx(0.1 + two)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["xhand1", "sharpa"])
def test_hands_with_many_fingers_close(robot):
    document = {
        "tgdsl": 1,
        "robot": {"model": robot},
        "resolution": "low",
        "objects": {"ball": {"geom": {"type": "sphere", "size": [0.02]}}},
        "sensors": {"load": {"kind": "link_contact", "links": "hand", "feels": ["ball"]}},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        closing, sim, load = closed(tgdsl.compile(document, dtype=torch.float64))
    assert (load[0] > 0).sum() >= 2 and load.max() < MOST
    assert sum(force > 0 for force in forces_on(sim, "ball").values()) >= 2
    assert len(closing.servos) >= 10 and torch.isfinite(sim.qpos).all()
