"""What the students of one stack saw and asked for in a rollout, and in which environments.

Shapes: `env` environments, `step` control steps, `student` students of the stack, `row` environments of each.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Shaped
from torch import Tensor

from tgdsl.rl.students.keys import StudentKey
from tgdsl.rl.students.spec import DistillSpec
from tgdsl.rl.students.stack import Stack
from tgdsl.rl.students.student import Architecture


class Rollout:
    """Students of one stack, and where they are.

    Attributes:
        stack: The students.
        keys: Who they are.
        seen: Groups of observations of each.
        first: Environment in which the first one's block begins; the others' follow.
        rows: Environments of each.
        memory: What they remember now, (student, row, memory).
        begun: What they remembered when the rollout began.
        x: What they saw in it, (step, student, row, feature).
        before: What they asked for in it, (step, student, row, joint).
    """

    def __init__(
        self,
        networks: Architecture,
        keys: Sequence[StudentKey],
        seen: Sequence[Sequence[str]],
        first: int,
        rows: int,
        spec: DistillSpec,
        device: torch.device,
    ):
        self.keys, self.seen, self.first, self.rows = keys, seen, first, rows
        self.stack = Stack(networks, [key.seed for key in keys], spec.learning_rate, spec.max_grad_norm, device)
        shape = (len(keys), rows)
        self.memory, self.begun = (torch.zeros((*shape, self.stack.memory), device=device) for _ in range(2))
        self.x = torch.zeros((spec.steps, *shape, networks.num_features), device=device)
        self.before = torch.zeros((spec.steps, *shape, networks.actions), device=device)

    @property
    def envs(self) -> slice:
        """Their environments."""
        return slice(self.first, self.first + self.rows * len(self.keys))

    def split(self, values: Tensor, dim: int = 0) -> Tensor:
        """Return what is of each environment, (…, env, …), as (…, student, row, …)."""
        own = values.narrow(dim, self.first, self.rows * len(self.keys))
        return own.unflatten(dim, (len(self.keys), self.rows))

    def inputs(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return what each student sees: of its own environments its own groups, (student, row, feature)."""
        blocks = [slice(self.first + i * self.rows, self.first + (i + 1) * self.rows) for i in range(len(self.keys))]
        each = zip(blocks, self.seen, strict=True)
        return torch.stack([torch.cat([obs[name][block] for name in names], dim=1) for block, names in each])


def joined(values: Shaped[Tensor, "step student row feature"]) -> Shaped[Tensor, "student rows feature"]:
    """Return the rows of all steps side by side."""
    return values.transpose(0, 1).flatten(1, 2)
