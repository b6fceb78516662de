"""Forces that push an object now and then, so that a policy learns to hold on.

Each environment is pushed at random intervals, uniform in `interval`, from the end of one push to the begin of the next. A push
is a force in world axes, uniform in a box, that acts at the centre of mass of the object's body for `duration`.

Source of forces and intervals: Chung et al., *Tactile Genesis*, appendix, "Domain Randomization", which does not say for how
long a force acts: a control step is our choice.

Shapes: `env` environments.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.fields.models import Quantity, Range, RangeOf, SpecModel
from tgdsl.rl.draws import Draws, whole
from tgdsl.tensors.env_ids import may_be_nonempty, put_rows

ZERO: Range = (0.0, 0.0)
Force = Annotated[Range, RangeOf("force")]
_DRAWN = {"push": 3, "push interval": 1}
"""Numbers of each push by what they are for; drawn together by all, so that they are known before anything is compiled."""


class PushSpec(SpecModel):
    """How strongly and how often an object is pushed."""

    x: Force = ZERO
    """Force along the world's x [N]."""
    y: Force = ZERO
    """Force along the world's y [N]."""
    z: Force = ZERO
    """Force along the world's z [N]."""
    interval: Annotated[Range, RangeOf("time", gt=0.0)] = (2.0, 4.0)
    """Time from the end of one push to the begin of the next, drawn for each [s]."""
    duration: Annotated[float, Quantity("time", gt=0.0)] = 0.025
    """How long a push lasts, rounded up to control steps [s]."""


class Pushes:
    """The pushes of all environments.

    Attributes:
        force: What pushes the object now, in world axes [N].
    """

    force: Float[Tensor, "env 3"]

    def __init__(self, spec: PushSpec, arrays: Mapping[str, Tensor], body: int, control_step: float, draws: Draws):
        """Begin without a push; `reset` draws when the first one comes.

        Args:
            spec: How strongly and how often.
            arrays: A simulation's live tensors (env, …), of which `xfrc_applied` is written.
            body: Index of the body that is pushed.
            control_step: Duration of a control step [s].
            draws: Where random numbers are from.

        Raises:
            SimulationError: If pushes would follow one another within a control step.
        """
        if spec.interval[0] < control_step:
            problem = f"pushes every {spec.interval[0]:g} s, more often than control steps of {control_step:g} s"
            raise SimulationError(f"{problem}; expected an interval of at least one")
        self._applied, self._body, self._draws, self.spec = arrays["xfrc_applied"], body, draws, spec
        num_envs, device, dtype = len(self._applied), self._applied.device, self._applied.dtype
        self.force = torch.zeros((num_envs, 3), device=device, dtype=dtype)
        self._first, self._last = (round(end / control_step) for end in spec.interval)
        self._length = math.ceil(spec.duration / control_step - 1e-9)
        self._low, self._high = (torch.tensor([getattr(spec, a)[i] for a in "xyz"], device=device, dtype=dtype) for i in (0, 1))
        self._left = torch.zeros(num_envs, dtype=torch.int64, device=device)  # control steps until a push begins; ≤ 0 in one
        self._count = torch.zeros_like(self._left)  # of pushes, above them of episodes

    def reset(self, chosen: Bool[Tensor, " env"], episode: Int[Tensor, " env"]) -> None:
        """End pushes of some environments and draw when the first one comes.

        Args:
            chosen: The environments.
            episode: How often each was reset.
        """
        put_rows(self._count, chosen, episode << 32)
        put_rows(self._left, chosen, self._interval(self._draws.shares(_DRAWN, self._count, chosen)["push interval"]))
        for exerted in (self.force, self._applied[:, self._body, :3]):
            put_rows(exerted, chosen, 0.0)

    def advance(self) -> None:
        """Begin and end pushes: once per control step, before its physics."""
        self._left -= 1
        begins, ends = self._left == 0, self._left == -self._length
        if not may_be_nonempty(changes := begins | ends):
            return
        self._count += ends
        shares = self._draws.shares(_DRAWN, self._count, changes)
        put_rows(self._left, ends, self._interval(shares["push interval"]))
        put_rows(self.force, begins, self._low + shares["push"].to(self.force.dtype) * (self._high - self._low))
        put_rows(self.force, ends, 0.0)
        self._applied[:, self._body, :3] = self.force

    def memory(self) -> dict[str, Tensor]:
        """Return the memory by name: live tensors."""
        return {"force": self.force, "left": self._left, "count": self._count}

    def _interval(self, share: Float[Tensor, "env 1"]) -> Int[Tensor, " env"]:
        """Return how many control steps there are before the next push begins."""
        return whole(share, self._first, self._last)[:, 0]
