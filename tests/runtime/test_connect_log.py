"""The example script on the simulation, on the emulator, and on a log recorded from the emulator."""

import math
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import HandError, ObservationError, TgdslError
from tgdsl.runtime.xhand1.calibration import load_calibration
from tgdsl.runtime.xhand1.emulator.simulated import EmulatedSource
from tgdsl.runtime.xhand1.log.log import LogWriter
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.scene.scene import scene_model

EXAMPLES = Path(__file__).parents[2] / "examples"
CALIBRATION = EXAMPLES / "xhand1_calibration.yaml"
STEPS = 70

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(EXAMPLES / "any_source.py"))


@pytest.fixture(scope="module")
def touch(script):
    return tgdsl.compile(script["SPEC"])


def test_one_script_on_simulation_emulator_and_log(script, touch, tmp_path):
    """Emulator and simulation agree within rounding, log and emulator exactly."""
    model = scene_model(touch.plan.scene)
    motion = MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=1.0)
    controls = [np.float32(control) for control in script["squeeze"](model, STEPS)]
    options = {"keyframe": "rest", "calibration": CALIBRATION, "motion": motion, "lockstep": True}
    with tgdsl.connect(touch, "simulation", **options) as env:
        simulated = torch.cat(list(script["observations"](env, controls)))
    calibration, log = load_calibration(CALIBRATION), tmp_path / "press.npz"
    emulated, starts = [], []
    with tgdsl.connect(touch, "emulator", **options) as env, LogWriter(log, calibration=calibration) as writer:
        assert isinstance(env.source, EmulatedSource)
        for policy in script["observations"](env, controls):
            emulated.append(policy)
            writer.add(env.source.sample().reading)
            starts.append(env.source.sample().reading.received_at)
    emulated = torch.cat(emulated)
    assert (simulated[-1].reshape(3, 5).norm(dim=0) > 1).sum() >= 2
    assert ((emulated - simulated).abs() <= 0.05 * (1 + 1e-4)).all()
    step = 1e-6 * math.floor(1e6 * min(np.diff(starts)))  # short enough that no step skips a reading
    with tgdsl.connect(touch, log, control_step=step, lockstep=True) as env:
        replayed = [env.observe()["policy"]]
        while not env.is_over:
            try:
                env.step(controls[0])
            except HandError:  # where the recording itself was late
                continue
            if not torch.equal(env.observe()["policy"], replayed[-1]):
                replayed.append(env.observe()["policy"])
    distinct = [emulated[:1]] + [emulated[i : i + 1] for i in range(1, len(emulated)) if not emulated[i].equal(emulated[i - 1])]
    torch.testing.assert_close(torch.cat(replayed), torch.cat(distinct), rtol=0, atol=0)


def test_the_script_runs_as_a_program(script, monkeypatch, capsys):
    for source in ("simulation", "emulator"):
        monkeypatch.setattr("sys.argv", ["any_source.py", "--source", source, "--steps", "20"])
        script["main"]()
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 3
        assert lines[2].split()[:3] == ["0.40", "s", "|force|"]


def test_a_log_gives_only_the_terms_of_a_hand(touch, tmp_path):
    with pytest.raises(TgdslError):
        tgdsl.connect(touch, tmp_path / "none.npz")
    document = {"tgdsl": 1, "robot": {"model": "xhand1"}, "scene": {"model": str(EXAMPLES / "palm_cube.xml")}}
    fields = {"objects": {"cube": {"body": "cube"}}, "resolution": "low"}
    sensors = {"hand": {"kind": "contact_depth", "links": "hand", "feels": ["cube"]}}
    terms = {"policy": [{"type": "agg_force", "of": "hand"}]}
    whole = tgdsl.compile(document | fields | {"sensors": sensors, "observations": terms})
    log = tmp_path / "short.npz"
    with tgdsl.connect(touch, "emulator", calibration=CALIBRATION) as env, LogWriter(log) as writer:
        assert isinstance(env.source, EmulatedSource)
        writer.add(env.source.sample().reading)
    with pytest.raises(ObservationError, match=r'"hand" is on right_hand_link, .*, where it has no sensor'):
        tgdsl.connect(whole, log)
