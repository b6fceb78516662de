"""Drives against closed forms of one hinge without gravity: each imperfection shows in the joint's motion."""

import mujoco
import numpy as np
import pytest
import torch
from paper_drives import PAPER
from warp_cases import warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.rl.actuation import BREAKAWAY_SPEED, ActionSpec, Actuation, Actuators, DriveSpec
from tgdsl.rl.draws import Draws
from tgdsl.runtime.batch.simulation import BatchSimulation

INERTIA, STIFFNESS, LIMIT, DT = 0.01, 2.0, 0.5, 0.001
HINGE = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.001" gravity="0 0 0" integrator="{integrator}"><flag contact="disable"/></option>
  <worldbody>
    <body name="link">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="hinge" axis="0 1 0" range="-2 2" limited="true" damping="{passive}"/>
      <geom name="link" type="sphere" size="0.01"/>
    </body>
    <body name="object" pos="1 0 0"><geom type="sphere" size="0.01"/></body>
  </worldbody>
  <actuator><position name="hinge" joint="hinge" kp="2" kv="{kv}" forcerange="-0.5 0.5" inheritrange="1"/></actuator>
</mujoco>
"""
BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])


def hinge(tmp_path, simulator, num_envs=1, kv=0.0, passive=0.0, substeps=1, drive=None, action=None, integrator="implicitfast"):
    (tmp_path / "hinge.xml").write_text(HINGE.format(kv=kv, passive=passive, integrator=integrator))
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}], "radius": 0.005}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "hinge.xml"), "layout": {"resolutions": {"only": {"link": points}}}},
        "objects": {"object": {"body": "object"}},
        "sensors": {"touch": {"kind": "contact_depth", "links": "link", "feels": ["object"], "gate": "geometric"}},
    }
    sim = simulator(tgdsl.compile(document), num_envs, substeps=substeps)
    actuators = Actuators.of(sim.model, ["hinge"])
    spec = ActionSpec(mode="absolute") if action is None else action
    actuation = Actuation(actuators, sim._arrays, spec, drive or DriveSpec(), Draws(0, num_envs))
    sim.drive = None if actuation.is_ideal else actuation.drive
    everywhere = torch.ones(num_envs, dtype=torch.bool)
    begin(actuation, everywhere, torch.ones(num_envs, dtype=torch.int64))
    return sim, actuation


def begin(actuation, chosen, episode, at_controls=False):
    """Begin episodes as an environment with randomised drives does."""
    actuation.draw(chosen, episode)
    actuation.reset(chosen, episode, at_controls)


def targets(sim, radians) -> torch.Tensor:
    """Return the absolute action whose target is an angle [rad]."""
    return torch.full((sim.num_envs, 1), radians / 2.0)


def acceleration(sim) -> float:
    return float(sim.qvel[0, 0]) / DT


AT_REST = [
    (DriveSpec(), STIFFNESS * 0.1),
    (DriveSpec(gain=(1.3, 1.3)), 1.3 * STIFFNESS * 0.1),
    (DriveSpec(bias=(-0.02, -0.02)), STIFFNESS * 0.08),
    (DriveSpec(deadband=(0.03, 0.03)), STIFFNESS * 0.07),
    (DriveSpec(deadband=(0.11, 0.11)), 0.0),
    (DriveSpec(backlash=(0.04, 0.04)), STIFFNESS * 0.08),
    (DriveSpec(kick=(0.8, 0.8)), 0.8 * STIFFNESS * 0.1),
    (DriveSpec(strength=(0.2, 0.2)), 0.2 * LIMIT),
    (DriveSpec(gain=(1.5, 1.5), strength=(2.0, 2.0)), 1.5 * STIFFNESS * 0.1),
]


@pytest.mark.parametrize(
    ("simulator", "drive", "expected"),
    [*((BatchSimulation, *case) for case in AT_REST), (warp, *AT_REST[0]), (warp, *AT_REST[1])],
)
def test_the_torque_at_rest_sets_the_acceleration(tmp_path, simulator, drive, expected):
    sim, actuation = hinge(tmp_path, simulator, drive=drive)
    actuation.command(targets(sim, 0.1))
    sim.step()
    assert acceleration(sim) == pytest.approx(expected / INERTIA, rel=1e-5, abs=1e-7)
    if not actuation.is_ideal:
        assert float(actuation.torque[0, 0]) == pytest.approx(expected, rel=1e-5, abs=1e-9)


@pytest.mark.parametrize(("strength", "expected"), [(1.0, LIMIT), (1.1, 1.1 * LIMIT), (0.5, 0.5 * LIMIT)])
def test_the_stall_torque_is_the_drawn_one(tmp_path, strength, expected):
    sim, actuation = hinge(tmp_path, BatchSimulation, drive=DriveSpec(strength=(strength, strength)))
    actuation.command(targets(sim, -1.9))
    sim.step()
    assert acceleration(sim) == pytest.approx(-expected / INERTIA, rel=1e-5)


def test_kick_and_noise_stay_within_the_strength(tmp_path):
    drive = DriveSpec(strength=(0.9, 0.9), kick=(1.2, 1.2), torque_noise=0.5)
    sim, actuation = hinge(tmp_path, BatchSimulation, drive=drive)
    actuation.command(targets(sim, -1.9))
    torques = []
    for _ in range(60):
        sim.set_state(qpos=np.array([0.0]), qvel=np.array([0.0]))
        sim.step()
        torques.append(float(actuation.torque[0, 0]))
    assert min(torques) == pytest.approx(-0.9 * LIMIT) and max(torques) > -0.7 * LIMIT


def test_bias_moves_the_target_beyond_the_joints_range(tmp_path):
    sim, actuation = hinge(tmp_path, BatchSimulation, drive=DriveSpec(bias=(0.05, 0.05)))
    sim.set_state(qpos=np.array([1.98]))
    actuation.place(torch.tensor([True]))
    actuation.command(targets(sim, 2.0))
    sim.step()
    assert acceleration(sim) == pytest.approx(STIFFNESS * 0.07 / INERTIA, rel=1e-4)


def test_kick_acts_only_at_rest(tmp_path):
    sim, actuation = hinge(tmp_path, BatchSimulation, drive=DriveSpec(kick=(1.5, 1.5)))
    actuation.command(targets(sim, 0.1))
    speeds = [0.0]
    for _ in range(8):
        position = float(sim.qpos[0, 0])
        sim.step()
        speeds.append(float(sim.qvel[0, 0]))
        factor = 1.5 if abs(speeds[-2]) < BREAKAWAY_SPEED else 1.0
        expected = factor * STIFFNESS * (0.1 - position) / INERTIA * DT
        assert speeds[-1] - speeds[-2] == pytest.approx(expected, rel=2e-4)
    assert abs(speeds[1]) < BREAKAWAY_SPEED < abs(speeds[-1])


def test_backlash_is_crossed_at_each_reversal(tmp_path):
    """A joint without overshoot follows the target up, rests while it crosses the play, then follows it down."""
    sim, actuation = hinge(tmp_path, BatchSimulation, kv=0.3, drive=DriveSpec(backlash=(0.2, 0.2)), substeps=160)
    ends = []
    for target in (0.5, 0.31, 0.0, 0.2, 0.3):
        for _ in range(4):
            actuation.command(targets(sim, target))
            sim.step()
        ends.append(float(sim.qpos[0, 0]))
    # 0.5 − 0.1 going up; at rest down to 0.3; then target + 0.1 going down; at rest up to 0.2; then target − 0.1 going up
    np.testing.assert_allclose(ends, [0.4, 0.4, 0.1, 0.1, 0.2], atol=2e-3)


@pytest.mark.parametrize(
    ("simulator", "late", "noise"),
    [(BatchSimulation, 0, 0.0), (BatchSimulation, 1, 0.0), (BatchSimulation, 3, 1e-9), (warp, 3, 0.0), (warp, 1, 1e-9)],
)
def test_targets_arrive_late_by_whole_control_steps(tmp_path, simulator, late, noise):
    sim, actuation = hinge(tmp_path, simulator, drive=DriveSpec(delay=(late, late), torque_noise=noise), substeps=3)
    for step in range(5):
        actuation.command(targets(sim, 0.1))
        sim.step()
        assert (abs(float(sim.qvel[0, 0])) > 1e-3) == (step >= late)


@BOTH
def test_the_largest_torque_falls_to_zero_at_top_speed(tmp_path, simulator):
    """q̇ = q̇_max (1 − exp(−t/T)) with T = I q̇_max / τ_max, from rest under full torque."""
    sim, actuation = hinge(tmp_path, simulator, drive=DriveSpec(top_speed=4.0))
    actuation.command(targets(sim, 1.9))
    time_constant = INERTIA * 4.0 / LIMIT
    for _ in range(120):
        sim.step()
    expected = 4.0 * (1 - (1 - DT / time_constant) ** 120)
    assert float(sim.qvel[0, 0]) == pytest.approx(expected, rel=1e-4)


def test_the_robots_top_speed_is_torque_over_damping(tmp_path):
    sim, actuation = hinge(tmp_path, BatchSimulation, passive=0.125, drive=DriveSpec(top_speed="robot"))
    actuation.command(targets(sim, 1.9))
    sim.step()
    speed = float(sim.qvel[0, 0])
    sim.step()
    assert float(actuation.torque[0, 0]) == pytest.approx(LIMIT * (1 - speed / 4.0), rel=1e-9)


def test_an_ideal_drive_equals_the_robots_actuator(tmp_path):
    sim, actuation = hinge(tmp_path, BatchSimulation, kv=0.05, substeps=5)
    assert actuation.is_ideal and sim.drive is None
    data = mujoco.MjData(sim.model)
    for step in range(20):
        target = 0.7 * np.sin(step)
        actuation.command(torch.full((1, 1), target / 2, dtype=torch.float64))
        sim.step()
        data.ctrl[0] = target
        mujoco.mj_step(sim.model, data, 5)
    assert float(sim.qpos[0, 0]) == pytest.approx(data.qpos[0], abs=1e-14)


@BOTH
def test_a_drive_with_negligible_noise_moves_as_the_robots_actuator(tmp_path, simulator):
    ends = []
    for drive in (DriveSpec(), DriveSpec(torque_noise=1e-12)):
        sim, actuation = hinge(tmp_path, simulator, kv=0.05, substeps=5, drive=drive)
        for step in range(20):
            actuation.command(targets(sim, 1.5 * np.sin(step)))
            sim.step()
        ends.append(float(sim.qpos[0, 0]))
    assert ends[0] == pytest.approx(ends[1], abs=1e-10 if simulator is BatchSimulation else 1e-4)


def test_relative_actions_add_up_within_the_range_and_are_smoothed(tmp_path):
    _, actuation = hinge(tmp_path, BatchSimulation, action=ActionSpec(scale=0.5, smoothing=0.25))
    expected = 0.0
    for action in (1.0, 1.0, -0.5, 1.0, 1.0, 1.0, 1.0, 1.0):
        actuation.command(torch.full((1, 1), action, dtype=torch.float64))
        expected = 0.75 * np.clip(expected + 0.5 * action, -2, 2) + 0.25 * expected
        assert float(actuation.target[0, 0]) == pytest.approx(expected, abs=1e-12)
    assert expected > 1.9


def test_offsets_are_relative_to_the_target_at_the_start_of_the_episode(tmp_path):
    """Two environments start at 0.3 and −1.8 rad: a ⟼ start + 0.5 a, within ±2. The second restarts from its current angle."""
    sim, actuation = hinge(tmp_path, BatchSimulation, num_envs=2, action=ActionSpec(mode="offset", scale=0.5))
    sim.qpos[:, 0] = torch.tensor([0.3, -1.8])
    begin(actuation, torch.tensor([True, True]), torch.tensor([1, 1]))
    for action in (1.0, -1.0, 0.2):
        actuation.command(torch.full((2, 1), action))
        expected = [0.3 + 0.5 * action, max(-2.0, -1.8 + 0.5 * action)]
        assert actuation.target[:, 0].tolist() == pytest.approx(expected, abs=1e-6)
    sim.qpos[:, 0] = 0.7
    begin(actuation, torch.tensor([False, True]), torch.tensor([1, 2]))
    actuation.command(torch.full((2, 1), -1.0))
    assert actuation.target[:, 0].tolist() == pytest.approx([-0.2, 0.2], abs=1e-6)
    saved = {name: value.clone() for name, value in actuation.memory().items()}
    sim.qpos[:, 0] = -0.4
    begin(actuation, torch.tensor([True, True]), torch.tensor([3, 3]))
    for name, value in actuation.memory().items():
        value.copy_(saved[name])
    actuation.command(torch.zeros(2, 1))
    assert actuation.target[:, 0].tolist() == pytest.approx([0.3, 0.7], abs=1e-6)


def test_half_range_offsets_span_the_joints_range(tmp_path):
    """The range is ±2: from −0.5 rad, actions of −1 to 1 ask for −2.5 to 1.5 rad, clipped at −2."""
    sim, actuation = hinge(tmp_path, BatchSimulation, num_envs=3, action=ActionSpec(mode="offset", scale="half_range"))
    sim.qpos[:, 0] = -0.5
    begin(actuation, torch.ones(3, dtype=torch.bool), torch.ones(3, dtype=torch.int64))
    actuation.command(torch.tensor([[-1.0], [0.5], [1.0]]))
    assert actuation.target[:, 0].tolist() == pytest.approx([-2.0, 0.5, 1.5])
    with pytest.raises(ValueError, match="scale is half_range, but absolute actions have none"):
        ActionSpec(mode="absolute", scale="half_range")
    with pytest.raises(ValueError, match="Input should be 'half_range'"):
        ActionSpec(scale="halfrange")


# Draws


def test_slides_have_their_own_scale_and_no_angular_imperfections():
    """A target 1 cm away pulls the 2 kg slide with k_p · 1 cm, whatever bias, deadband and play the hinge has."""
    joints = '<body><joint name="{0}" type="{0}" axis="0 0 1" range="-1 1" limited="true"/><geom size=".1" mass="2"/></body>'
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><compiler angle="radian"/><option gravity="0 0 0"/><worldbody>'
        + "".join(joints.format(name) for name in ("slide", "hinge"))
        + "</worldbody><actuator>"
        + "".join(f'<position joint="{name}" kp="50" forcerange="-9 9"/>' for name in ("slide", "hinge"))
        + "</actuator></mujoco>"
    )
    actuators = Actuators.of(model, ["slide", "hinge"])
    assert actuators.is_slide.tolist() == [True, False]
    arrays = {name: torch.zeros(3, 2, dtype=torch.float64) for name in ("qpos", "qvel", "ctrl", "qfrc_applied")}
    drive = DriveSpec(bias=(0.05, 0.05), deadband=(0.02, 0.02), backlash=(0.04, 0.04), top_speed=1.0)
    actuation = Actuation(actuators, arrays, ActionSpec(scale=0.1, slide_scale=0.01), drive, Draws(0, 3))
    begin(actuation, torch.ones(3, dtype=torch.bool), torch.ones(3, dtype=torch.int64))
    actuation.command(torch.ones(3, 2))
    torch.testing.assert_close(actuation.target, torch.tensor([[0.01, 0.1]]).double().expand(3, 2))
    actuation.drive()
    torch.testing.assert_close(actuation.torque, 50 * torch.tensor([[0.01, 0.1 + 0.05 - 0.02 - 0.02]]).double().expand(3, 2))
    arrays["qvel"].fill_(2.0)  # beyond the hinge's top speed
    actuation.drive()
    torch.testing.assert_close(actuation.torque, torch.tensor([[0.5, 0.0]]).double().expand(3, 2))
    slide = Actuators.of(model, ["slide"])
    with pytest.raises(
        SimulationError, match=r"action.scale is 0.1 rad, but .* slides alone: slide; expected action.slide_scale"
    ):
        Actuation(slide, arrays, ActionSpec(scale=0.1, slide_scale=0.01), drive, Draws(0, 3))


def drawn_actuation(seed=0, num_envs=64, first_env=0, episode=1, spec=PAPER):
    arrays = {name: torch.zeros(num_envs, 3, dtype=torch.float64) for name in ("qpos", "qvel", "ctrl", "qfrc_applied")}
    model = mujoco.MjModel.from_xml_string(THREE)
    actuation = Actuation(
        Actuators.of(model, ["a", "b", "c"]), arrays, ActionSpec(), spec, Draws(seed, num_envs, first_env=first_env)
    )
    begin(actuation, torch.ones(num_envs, dtype=torch.bool), torch.full((num_envs,), episode))
    return actuation


JOINT = '<body name="{0}"><joint name="{0}" range="-1 1" limited="true"/><geom size="0.1"/></body>'
SERVO = '<position name="{0}" joint="{0}" kp="1" forcerange="-1 1"/>'
THREE = '<mujoco><compiler angle="radian"/><worldbody>{}</worldbody><actuator>{}</actuator></mujoco>'.format(
    "".join(JOINT.format(name) for name in "abc"), "".join(SERVO.format(name) for name in "abc")
)


def test_draws_of_64_environments_equal_those_of_twice_32():
    whole, halves = drawn_actuation(), [drawn_actuation(num_envs=32), drawn_actuation(num_envs=32, first_env=32)]
    for name, value in whole.drawn.items():
        assert torch.equal(value, torch.cat([half.drawn[name] for half in halves])), name
    for actuation in (whole, *halves):
        actuation.drive()
    assert torch.equal(whole.torque, torch.cat([half.torque for half in halves]))


def test_draws_are_uniform_in_their_ranges():
    """Mean and variance of U(a, b) lie within 5 standard errors, and joints are uncorrelated."""
    actuation = drawn_actuation(num_envs=20_000)
    for name in ("gain", "damping", "strength", "bias", "deadband", "backlash", "kick"):
        low, high = getattr(PAPER, name)
        draws, width = actuation.drawn[name].numpy(), high - low
        assert low <= draws.min() and draws.max() <= high
        count = draws.size
        assert abs(draws.mean() - (low + high) / 2) < 5 * width / np.sqrt(12 * count), name
        assert abs(draws.var() - width**2 / 12) < 5 * width**2 / np.sqrt(180 * count), name
        assert np.abs(np.corrcoef(draws.T) - np.eye(3)).max() < 5 / np.sqrt(len(draws)), name
    gain, kick = actuation.drawn["gain"].flatten(), actuation.drawn["kick"].flatten()
    assert abs(np.corrcoef(gain, kick)[0, 1]) < 5 / np.sqrt(len(gain))


def test_noise_is_uniform_and_differs_per_physics_step_episode_and_seed():
    actuation = drawn_actuation(num_envs=20_000, spec=DriveSpec(torque_noise=0.1))
    torques = []
    for _ in range(3):
        actuation.drive()
        torques.append(actuation.torque.flatten().numpy().copy())
    variants = [
        drawn_actuation(num_envs=20_000, episode=2, spec=DriveSpec(torque_noise=0.1)),
        drawn_actuation(seed=1, num_envs=20_000, spec=DriveSpec(torque_noise=0.1)),
    ]
    for variant in variants:
        variant.drive()
        torques.append(variant.torque.flatten().numpy().copy())
    for torque in torques:
        assert np.abs(torque).max() <= 0.1 and abs(torque.mean()) < 5 * 0.1 / np.sqrt(3 * torque.size)
        assert abs(torque.var() - 0.01 / 3) < 5 * 0.01 * np.sqrt(4 / 45 / torque.size)
    assert np.abs(np.corrcoef(torques) - np.eye(5)).max() < 5 / np.sqrt(60_000)


def test_delays_are_whole_steps_and_include_both_bounds():
    delays = drawn_actuation(num_envs=3000, spec=DriveSpec(delay=(1, 3))).drawn["delay"].flatten()
    counts = torch.bincount(delays.to(torch.int64), minlength=4)
    assert counts[0] == 0 and len(counts) == 4
    assert (counts[1:] - 3000).abs().max() < 5 * np.sqrt(9000 * 2 / 9)


def test_only_the_chosen_environments_are_redrawn_and_placed():
    actuation = drawn_actuation(num_envs=4)
    old_draws = {name: value.clone() for name, value in actuation.drawn.items()}
    actuation.command(torch.ones(4, 3, dtype=torch.float64))
    target = actuation.target.clone()
    begin(actuation, torch.tensor([False, True, False, True]), torch.tensor([1, 2, 1, 2]))
    for name, value in actuation.drawn.items():
        assert torch.equal(value[[0, 2]], old_draws[name][[0, 2]])
        assert name == "delay" or not torch.equal(value[[1, 3]], old_draws[name][[1, 3]])
    assert torch.equal(actuation.target[[0, 2]], target[[0, 2]]) and not actuation.target[[1, 3]].any()


@pytest.mark.parametrize(("text", "message"), [
    (THREE, 'the scene has no joint "d"; known joints: a, b, c'),
    (THREE.replace('name="a" joint="a"', 'name="a" joint="b"'), 'joint "a" has 0 actuators, expected one position actuator'),
    (THREE.replace("<position name=\"a\" joint=\"a\" kp=\"1\" forcerange=\"-1 1\"/>", '<motor name="a" joint="a"/>'), 'the actuator of joint "a" is no position servo of gear 1'),
])  # fmt: skip
def test_joints_that_cannot_be_driven_are_named(text, message):
    with pytest.raises(SimulationError) as caught:
        Actuators.of(mujoco.MjModel.from_xml_string(text), ["b", "a", "d"] if "d" in message.split(";")[0][-3:] else ["a"])
    assert str(caught.value).startswith(message)


@BOTH
def test_drives_that_begin_at_controls_press_from_the_first_step(tmp_path, simulator):
    """A hand that already grips begins with targets inside the object: torque is k (w − q) at once, also with play."""
    for drive in (None, DriveSpec(backlash=(0.02, 0.02))):
        sim, actuation = hinge(tmp_path, simulator, num_envs=2, action=ActionSpec(), drive=drive)
        sim.reset(ctrl=[0.1])
        is_begun = torch.tensor([True, False])
        begin(actuation, is_begun, torch.ones(2, dtype=torch.int64), at_controls=True)
        torch.testing.assert_close(actuation.target[:, 0], torch.tensor([0.1, 0.0]).to(actuation.target))
        actuation.command(torch.zeros(2, 1))
        sim.step()
        torch.testing.assert_close(acceleration(sim), STIFFNESS * 0.1 / INERTIA, rtol=1e-3, atol=0)
        assert float(sim.qvel[1, 0]) == 0
        sim.close()
