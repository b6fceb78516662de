"""rsl_rl's normalisers, kept on the device: no branch waits for a tensor's value, and memory stays where it is.

Moments are float64: after many rows a change is lost in float32. Over several processes they are those of the joint batch.

Shapes: `row` rows of a batch, a row may have any shape.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from rsl_rl.modules import EmpiricalDiscountedVariationNormalization, EmpiricalNormalization
from torch import Tensor

from tgdsl.rl.train.ranks import num_processes, summed


class Normalisation(EmpiricalNormalization):
    """rsl_rl's empirical normalisation, bounded: clamp((x − mean)/(std + eps), ±clip)."""

    _mean: Tensor
    _var: Tensor
    _std: Tensor
    count: Tensor

    def __init__(self, shape: int | list[int], eps: float = 1e-2, until: int | None = None, clip: float = float("inf")):
        super().__init__(shape, eps, until)
        self.clip = float(clip)
        for name in ("_mean", "_var", "_std"):
            self.register_buffer(name, getattr(self, name).double())

    def forward(self, x: Tensor) -> Tensor:
        """Return rows normalised, (row, feature)."""
        return ((x - self._mean.to(x.dtype)) / (self._std + self.eps).to(x.dtype)).clamp(-self.clip, self.clip)

    @torch.jit.unused
    def update(self, x: Float[Tensor, "row ..."]) -> None:
        """Take a batch into account."""
        if not self.training:
            return
        with torch.no_grad():
            num = x.shape[0] * num_processes()
            mean = x.sum(dim=0, keepdim=True, dtype=torch.float64)
            summed(mean)
            mean /= num
            var = (x - mean.to(x.dtype)).square().sum(dim=0, keepdim=True, dtype=torch.float64)
            summed(var)
            var /= num
            self._take(num, mean.view_as(self._mean), var.view_as(self._var))

    def _take(self, num: int, mean: Tensor, var: Tensor) -> None:
        """Take a batch's mean and variance into account, in place."""
        is_open = torch.ones_like(self.count, dtype=torch.bool) if self.until is None else self.count < self.until
        rate = is_open * (num / (self.count + num).to(mean.dtype))
        delta = mean - self._mean
        self._mean += rate * delta
        self._var += rate * (var - self._var + delta * (mean - self._mean))
        self._std.copy_(self._var.sqrt())
        self.count += num * is_open


class RewardNormalisation(EmpiricalDiscountedVariationNormalization):
    """rsl_rl's normalisation of intrinsic rewards: divided by the standard deviation of their discounted sums."""

    def __init__(self, num_envs: int, eps: float = 1e-2, gamma: float = 0.99, until: int | None = None):
        super().__init__([], eps, gamma, until)
        self.emp_norm = Normalisation([], eps, until)
        self.gamma = gamma
        self.register_buffer("total", torch.zeros(num_envs), persistent=False)

    def forward(self, rew: Float[Tensor, " row"]) -> Float[Tensor, " row"]:
        """Return rewards normalised; those of learning are taken into account first."""
        total: Tensor = self.total  # pyright: ignore[reportAssignmentType]
        if self.training:
            total.mul_(self.gamma).add_(rew)
            self.emp_norm.update(total)
        std = self.emp_norm._std.to(rew.dtype)
        return torch.where(std > 0, rew / std, rew).view_as(rew)
