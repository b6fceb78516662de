"""Errors that are reported before anything is connected."""

import pytest
import torch
from pressing_hands import CALIBRATION, Blind, press_policy, press_task
from written_teachers import teacher

from tgdsl.errors import HandError, ObservationError, SimulationError, SpecError, TgdslError
from tgdsl.rl.deploying.deploy import DeployError, Deployment
from tgdsl.rl.load import load_task
from tgdsl.rl.playing.policy import PolicyError
from tgdsl.runtime.xhand1.wire.errors import HandDisconnectedError, MotionError

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
PORT = "xhand1:/dev/no-such-port"


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    return press_task(tmp_path_factory.mktemp("press"))


@pytest.fixture(scope="module")
def policy(task):
    return press_policy(task.parent, task, Blind(6))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"source": "gazebo"}, TgdslError, 'unknown source "gazebo"'),
        ({"source": PORT}, DeployError, "student.pt: the task .* draws its goal from its scene, and xhand1:"),
        ({"goal": (9.0,)}, DeployError, "goal: a bend of 9 rad; expected 0.5 to 1.5 rad .`bend` of the task's document"),
        ({"goal": (1.0, 2.0)}, DeployError, r"goal: found 2 numbers, but of the task .* expected 1 \[rad\]"),
        ({"start": "home"}, SimulationError, 'the scene has no keyframe "home"'),
        (
            {"overrides": {"action.scale": "0.1 rad"}},
            PolicyError,
            r"student.pt: this policy was learned with other actions: \{",
        ),
        ({"overrides": {"physics.substeps": 4}}, PolicyError, "was learned with other control steps .s.: 0.02, here 0.016"),
        ({"overrides": {"joints": ["*_mid_*"]}}, PolicyError, "student.pt: this policy moves .*, not right_hand_mid_joint2"),
        ({"overrides": {"touch": "agg_bol"}}, SpecError, "touch"),
        (
            {"groups": ("priv_error", "goal")},
            DeployError,
            "sees priv_error of the task .*, which only a scene knows; on a hand",
        ),
    ],
)
def test_mismatches_are_refused(task, policy, options, error, message):
    with pytest.raises(error, match=message):
        Deployment(task, policy, **options)


def test_a_policy_of_another_task_is_refused(task, policy, tmp_path):
    other = press_task(tmp_path)
    (tmp_path / "press2.py").write_text((tmp_path / "press.py").read_text())
    other.write_text(other.read_text().replace("press.py", "press2.py"))
    with pytest.raises(PolicyError, match=r'learned in the task "press.py:Press", not "press2.py:Press"'):
        Deployment(other, policy)


def test_a_policy_with_other_taxels_is_refused(task, policy, tmp_path):
    other = press_task(tmp_path)
    sensors = (tmp_path / "sensors.yaml").read_text()
    (tmp_path / "sensors.yaml").write_text(sensors.replace("0.026", "0.025"))
    with pytest.raises(PolicyError, match="this policy feels with other taxels"):
        Deployment(other, policy)


@pytest.mark.parametrize("touch", ["depth", "bool"])
def test_readings_that_fingertips_lack_are_refused(task, touch):
    """Such a policy runs in simulation; on a hand, emulated or real, it is refused before connecting."""
    file = teacher(task.parent / f"{touch}.pt", load_task(task, {"touch": touch}), ["proprio", "tactile_sensors", "goal"])
    assert len(list(Deployment(task, file).steps(seconds=0.04))) == 2
    for source, options in (("emulator", {"lockstep": True}), (PORT, {"goal": (1.0,)})):
        with pytest.raises(ObservationError, match=f"{touch} of .*: it has no such reading of links and taxels"):
            next(Deployment(task, file, source, calibration=CALIBRATION, **options).steps())


def test_contact_bits_need_a_threshold(task):
    file = press_policy(task.parent, task, name="bits.pt", touch="agg_bool")
    with pytest.raises(ObservationError, match="its calibration has no `contact_threshold`"):
        next(Deployment(task, file, PORT, goal=(1.0,)).steps())


@pytest.mark.parametrize("source", [PORT, "emulator"])
def test_a_rate_beyond_the_lines_is_refused(task, source):
    """An exchange takes 297 + 2217 bytes of 10 bits at 3 Mbaud; in lockstep the emulator's scene waits."""
    fast = {"physics.substeps": 2, "physics.timestep": "4 ms"}
    file = press_policy(task.parent, task, Blind(6), "fast.pt", **fast)
    with pytest.raises(
        HandError, match=r"control steps of 8 ms \(125 per second\), and an exchange takes 8.38 ms: at most 119"
    ):
        next(Deployment(task, file, source, goal=(1.0,), overrides=fast, calibration=CALIBRATION).steps())
    if source == "emulator":
        deployment = Deployment(task, file, source, overrides=fast, calibration=CALIBRATION, lockstep=True)
        assert next(deployment.steps()).index == 0


def test_control_steps_longer_than_the_watchdog_are_refused(task, policy):
    slow = {"physics.substeps": 25, "physics.timestep": "4 ms"}
    file = press_policy(task.parent, task, Blind(6), "slow.pt", **slow)

    def limits(model):
        from tgdsl.runtime.xhand1.motion import MotionLimits

        return MotionLimits.of_robot(model, speed=1.0, current_limit=100, kp=10)

    with pytest.raises(MotionError, match="a control step of 100 ms, and the watchdog bites after 100 ms"):
        next(Deployment(task, file, PORT, goal=(1.0,), overrides=slow, motion=limits).steps())
    deployment = Deployment(task, policy, PORT, goal=(1.0,), motion=limits)
    assert deployment.moves and not Deployment(task, policy, PORT, goal=(1.0,)).moves
    with pytest.raises(HandDisconnectedError, match="/dev/no-such-port cannot be opened"):
        next(deployment.steps())


@pytest.mark.parametrize("options", [{"episodes": 0}, {"seconds": 0.0}, {"seconds": float("inf")}])
def test_empty_deployments_are_refused(task, policy, options):
    with pytest.raises(DeployError, match="expected at least 1, and more than 0 s"):
        next(Deployment(task, policy).steps(**options))


def test_actions_that_are_not_finite_are_refused(task):
    """The policy divides by zero once its last action, columns 12 to 17 of proprioception, is not 0."""

    class Dividing(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return 1.0 / (x[:, 12:18] == 0).float()

    moments = Deployment(task, press_policy(task.parent, task, Dividing(), "lost.pt")).steps()
    next(moments)
    with pytest.raises(PolicyError, match=r"lost.pt: at control step 1 this policy returns .* expected finite actions"):
        next(moments)
