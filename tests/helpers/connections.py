"""Modules of the small XHand1, a calibration, and controls that close its fingers, for connections."""

import numpy as np

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.runtime.connect import Connection
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.wire.errors import (
    WatchdogError,
)

TERMS = [
    {"type": "agg_force", "of": "depth", "scale": 2000},
    {"type": "agg_force", "of": "depth", "scale": 2000, "axes": "xyz"},
]
TURN = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""The sensor's z is the link's x, which presses; its y is against the link's."""
SCALE = np.array([[0.5, 0.4, 0.6], [0.3, 0.2, 0.5], [0.5, 0.5, 0.5], [0.4, 0.4, 0.4], [1.0, 1.0, 1.0]])
NEWTON = Calibration(
    "N", SCALE, np.tile(TURN, (5, 1, 1)), np.tile([0.0, 0.1, 0.2], (5, 1)), np.tile([3.0, -2.5, 7.0], (5, 1)), "", 5.0
)
SQUEEZE = np.linspace(0.1, 0.35, 12).astype(np.float32)


def instant(touch: TactileModule) -> MotionLimits:
    """Return limits that let a set-point go to its target at once, and a busy machine be late."""
    model = tgdsl.simulate(touch, 1).model
    return MotionLimits.of_robot(model, speed=1e9, current_limit=300, kp=100, watchdog_s=1.0)


def ramp(num_steps: int) -> list[np.ndarray]:
    return [SQUEEZE * np.float32(min(1, 2 * i / num_steps)) for i in range(num_steps)]


def steps(env: Connection, num_steps: int) -> None:
    for _ in range(num_steps):
        env.step()


def stepped(env: Connection, control) -> bool:
    """Step, and return whether the watchdog let it: on a machine that stood still it does not, and the hand goes on from there."""
    try:
        env.step(control)
    except WatchdogError:
        env.resume()
        return False
    return True
