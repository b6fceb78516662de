"""A gait that feels nothing and spins a screwdriver all the same: each joint goes to and fro, in a phase of its own.

tgdsl play examples/tasks/screwdriver.yaml --actions examples/tasks/screwdriver_gait.py:gait

Found by the cross-entropy method on the round handle. It is what an open loop can do: with all that is random 3.9 rad/s on
average over five seconds, what is lost counted as at rest from then on: 5 with the round handle, 4 with the thick, 1.5 with the
square and 5 with the waisted one; tilted by eleven degrees, and one in six is lost within that time.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from tgdsl import TouchEnv

FREQUENCY = 1.83
"""[Hz]"""
MIDDLE = (2.074, 0.563, 1.02, 0.218, 1.045, 1.525, 1.171, 1.524)
"""Of each joint's target: thumb, index finger, middle finger [rad]."""
SINE = (0.154, 0.523, -0.268, -0.456, 0.569, 0.035, 0.075, -0.558)
"""Share of each that goes with the sine of the phase [rad]."""
COSINE = (0.227, 0.439, 0.468, 0.223, 0.075, -0.481, -0.713, 0.341)
"""Share of each that goes with its cosine [rad]."""
BEGIN = 0.4
"""For how long it takes over from the grasp [s]."""


def gait(env: TouchEnv, obs: Mapping[str, Tensor]) -> Tensor:
    """Return the actions that bring targets to where the gait has them now."""
    start = env.actuation.start
    middle, sine, cosine = (torch.tensor(own, dtype=start.dtype, device=start.device) for own in (MIDDLE, SINE, COSINE))
    time = (env.steps * env.control_step).to(start)[:, None]
    phase = 2.0 * math.pi * FREQUENCY * time
    wanted = middle + sine * phase.sin() + cosine * phase.cos()
    return (time / BEGIN).clamp(max=1.0) * (wanted - start) / env.actuation.scale
