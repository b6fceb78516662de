"""An open-loop gait that spins a screwdriver without touch: each joint swings with its own amplitude and phase.

tgdsl play examples/tasks/screwdriver.yaml --actions examples/tasks/screwdriver_gait.py:gait

Found by the cross-entropy method on the round handle. With all randomisation it reaches 3.9 rad/s on average over
five seconds: 5 with the round handle, 4 with the thick, 1.5 with the square and 5 with the waisted one. A handle that is lost
counts as at rest from then on, and one in six is lost within that time. It tilts by eleven degrees.
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
    middle, sine, cosine = (torch.tensor(part, dtype=start.dtype, device=start.device) for part in (MIDDLE, SINE, COSINE))
    time = (env.steps * env.control_step).to(start)[:, None]
    phase = 2.0 * math.pi * FREQUENCY * time
    target = middle + sine * phase.sin() + cosine * phase.cos()
    return (time / BEGIN).clamp(max=1.0) * (target - start) / env.actuation.scale
