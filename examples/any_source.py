"""One script for a simulated, an emulated, a recorded and a real XHand1: only `--source` changes.

python examples/any_source.py --source simulation
python examples/any_source.py --source emulator
python examples/any_source.py --source xhand1:/dev/ttyUSB0 --calibration hand.calibration.yaml
python examples/any_source.py --source press.npz

A real hand is only read here: it moves if `connect` is given `motion=MotionLimits(...)`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import mujoco
import numpy as np
import torch

import tgdsl
from tgdsl.runtime.connect import Connection
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.scene.scene import scene_model

SPEC = Path(__file__).parent / "xhand1_tips.yaml"
CALIBRATION = Path(__file__).parent / "xhand1_calibration.yaml"


def squeeze(model: mujoco.MjModel, num_steps: int) -> Iterator[np.ndarray]:
    """Yield joint angles, in the order of the actuators, that close the hand within 50 steps and hold it closed [rad]."""
    rest, end = model.key("rest").ctrl, model.key("squeeze").ctrl
    for i in range(num_steps):
        yield rest + min(i / 50, 1.0) * (end - rest)


def emulated_limits(model: mujoco.MjModel) -> MotionLimits:
    """Return limits for an emulated hand. Do not use these figures on a real one: what its gains do is not published."""
    return MotionLimits.of_robot(model, speed=10.0, current_limit=300, kp=100, watchdog_s=1.0)


def observations(env: Connection, controls: Iterable[np.ndarray]) -> Iterator[torch.Tensor]:
    """Step a source, whatever it is, and yield what a policy would see, until the controls or a log are over."""
    yield env.observe()["policy"]
    for control in controls:
        if env.is_over:
            return
        env.step(control)
        yield env.observe()["policy"]


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="simulation", help="simulation, emulator, LOG.npz, xhand1 or xhand1:PORT")
    parser.add_argument("--calibration", type=Path, help="what the hand's counts mean; default: of a log its own")
    parser.add_argument("--steps", type=int, default=100, help="control steps of 20 ms")
    options = parser.parse_args()
    touch = tgdsl.compile(SPEC)
    model = scene_model(touch.plan.scene)
    motion = emulated_limits(model) if options.source == "emulator" else None
    calibration = options.calibration or (CALIBRATION if options.source == "emulator" else None)
    with tgdsl.connect(touch, options.source, keyframe="rest", calibration=calibration, motion=motion) as env:
        for i, policy in enumerate(observations(env, squeeze(model, options.steps))):
            if i % 10 == 0:
                thumb, index, middle, ring, pinky = policy.reshape(3, 5).norm(dim=0).tolist()
                print(
                    f"{i * env.control_step:5.2f} s  |force|  {thumb:7.2f} {index:7.2f} {middle:7.2f} {ring:7.2f} {pinky:7.2f}"
                )


if __name__ == "__main__":
    main()
