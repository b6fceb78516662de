"""Networks of actor and critic, their normalisers, and random network distillation: rsl_rl's, kept on the device.

`class_name: tgdsl.rl.train.model:EncodedModel` gives rsl_rl this model, and `tgdsl.rl.train.model:Gaussian` its distribution.
No branch waits for a tensor's value, and memory stays where it is. Moments are float64, as float32 loses small updates after
many rows. Several processes share the moments of the joint batch.

Shapes: `env` environments, `feature` numbers of all groups of a model, side by side, `row` rows of a batch, of any shape.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from rsl_rl.extensions import RandomNetworkDistillation
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP, EmpiricalDiscountedVariationNormalization, EmpiricalNormalization, GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from tgdsl.rl.train.ranks import add_up, num_processes

UNTIL = 10**8  # number of states or rewards after which their normalisation is constant: rsl_rl's


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
            add_up(mean)
            mean /= num
            var = (x - mean.to(x.dtype)).square().sum(dim=0, keepdim=True, dtype=torch.float64)
            add_up(var)
            var /= num
            self.merge(num, mean, var)

    def merge(self, num: int, mean: Float[Tensor, "*feature"], var: Float[Tensor, "*feature"]) -> None:
        """Take the mean and variance of so many rows into account, in place."""
        is_open = torch.ones_like(self.count, dtype=torch.bool) if self.until is None else self.count < self.until
        rate = is_open * (num / (self.count + num).to(mean.dtype))
        delta = mean - self._mean
        self._mean += rate * delta
        self._var += rate * (var - self._var + delta * (mean - self._mean))
        self._std.copy_(self._var.sqrt())
        self.count += num * is_open


class RewardNormalisation(EmpiricalDiscountedVariationNormalization):
    """rsl_rl's normalisation of intrinsic rewards: divided by the standard deviation of their discounted sums."""

    def __init__(self, num_envs: int, until: int):
        super().__init__([], until=until)
        self.emp_norm = Normalisation([], until=until)
        self.register_buffer("total", torch.zeros(num_envs), persistent=False)

    def forward(self, rew: Float[Tensor, " row"]) -> Float[Tensor, " row"]:
        """Return rewards normalised; in training mode they update the moments first."""
        total: Tensor = self.total  # pyright: ignore[reportAssignmentType]
        if self.training:
            total.mul_(self.disc_avg.gamma).add_(rew)
            self.emp_norm.update(total)
        std = self.emp_norm._std.to(rew.dtype)
        return torch.where(std > 0, rew / std, rew).view_as(rew)


class Gaussian(GaussianDistribution):
    """rsl_rl's Gaussian distribution; sampling does not synchronise, while torch's checks the deviations' signs."""

    def sample(self) -> Tensor:
        return torch.randn_like(self.mean) * self.std + self.mean

    def bound(self) -> None:
        """Clamp deviations to their range: beyond it rsl_rl's clamp has no gradient, and they could not return."""
        if self.std_type == "scalar":
            self.std_param.clamp_(*self.std_range)
        else:
            self.log_std_param.clamp_(*self.log_std_range)


class EncodedModel(MLPModel):
    """An `MLPModel` of rsl_rl with a network per group of observations before it."""

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: tuple[int, ...] | list[int] = (512, 256, 128),
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: dict[str, Any] | None = None,
        encoders: Mapping[str, Mapping[str, Any]] | None = None,
        eps: float = 1e-2,
        clip: float = float("inf"),
    ):
        self._sizes = [obs[name].shape[-1] for name in obs_groups[obs_set]]
        encoder_specs = [(encoders or {}).get(name, (encoders or {}).get("*")) for name in obs_groups[obs_set]]
        self._latent = sum(
            encoder["size"] if encoder else size for encoder, size in zip(encoder_specs, self._sizes, strict=True)
        )
        super().__init__(obs, obs_groups, obs_set, output_dim, hidden_dims, activation, obs_normalization, distribution_cfg)
        if obs_normalization:
            self.obs_normalizer = Normalisation(self.obs_dim, eps, clip=clip)
        encoders_of_groups = [
            MLP(size, encoder["size"], list(encoder["hidden"]), activation) if encoder else nn.Identity()
            for encoder, size in zip(encoder_specs, self._sizes, strict=True)
        ]
        self.encoders = nn.ModuleList(encoders_of_groups)

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        return self.embed(torch.cat([obs[name] for name in self.obs_groups], dim=-1))

    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of concatenated groups, (env, feature)."""
        parts = self.obs_normalizer(x).split(self._sizes, dim=-1)
        return torch.cat([encoder(part) for encoder, part in zip(self.encoders, parts, strict=True)], dim=-1)

    def as_jit(self) -> nn.Module:
        """Return the policy without exploration, as TorchScript: takes (env, feature)."""
        exported = Exported(self).cpu()
        return torch.jit.trace(exported, exported.get_dummy_inputs())  # pyright: ignore[reportReturnType]

    def as_onnx(self, verbose: bool) -> nn.Module:
        """Return the policy without exploration, as rsl_rl exports it to ONNX."""
        return Exported(self)

    def _get_latent_dim(self) -> int:
        return self._latent


class Exported(nn.Module):
    """A copy of a model that takes concatenated groups, (env, feature), and returns actions without exploration."""

    input_names = ("obs",)
    output_names = ("actions",)

    def __init__(self, model: EncodedModel):
        super().__init__()
        distribution = model.distribution
        if distribution is not None:
            model.distribution = None  # its last parameters belong to an autograd graph, and cannot be copied
        try:
            self.model = copy.deepcopy(model).eval()
        finally:
            model.distribution = distribution
        self.output = distribution.as_deterministic_output_module() if distribution is not None else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Return actions, (env, joint)."""
        return self.output(self.model.mlp(self.model.embed(x)))

    def get_dummy_inputs(self) -> tuple[Tensor]:
        """Return example inputs."""
        first = next(self.parameters())
        return (torch.zeros((2, self.model.obs_dim), dtype=first.dtype, device=first.device),)


def actor_weights(policy: nn.Module, num_samples: int) -> dict[str, Tensor]:
    """Return the weights of a policy's TorchScript by their names in an `EncodedModel`.

    Of a student, whose moments are not counted, they count as those of `num_samples` observations.
    """
    result = {}
    for name, value in policy.state_dict().items():
        name = re.sub(r"^student\.encoders\.(\d+)\.layers\.", r"encoders.\1.", name.removeprefix("model."))
        result[re.sub(r"^student\.trunk\.", "mlp.", name)] = value
    for name in ("mean", "var"):
        if f"student.{name}" in result:
            value = result[f"obs_normalizer._{name}"] = result.pop(f"student.{name}")[None]
            if name == "var":
                result |= {"obs_normalizer._std": value.sqrt(), "obs_normalizer.count": torch.tensor(num_samples)}
    return result


class Distillation(RandomNetworkDistillation):
    """rsl_rl's `RandomNetworkDistillation` with rewards that do not synchronise."""

    def __init__(self, num_envs: int, eps: float = 1e-2, clip: float = float("inf"), **options: Any):
        super().__init__(**options)
        if self.state_normalization:
            self.state_normalizer = Normalisation([self.num_states], eps, UNTIL, clip).to(self.device)
        if self.reward_normalization:
            self.reward_normalizer = RewardNormalisation(num_envs, until=UNTIL).to(self.device)
        for parameter in self.target.parameters():
            parameter.requires_grad_(False)

    def prediction_error(self, obs: TensorDict) -> Tensor:
        """Return the error of the prediction, normalised, (env,)."""
        with torch.no_grad():
            state = self.state_normalizer(self.get_rnd_state(obs))
            error = torch.linalg.norm(self.target(state) - self.predictor(state), dim=1)
            return self.reward_normalizer(error)

    def next_weight(self) -> float:
        """Count a control step, and return the weight of its rewards."""
        self.update_counter += 1
        scheduler = self.weight_scheduler
        self.weight = (
            self.initial_weight if scheduler is None else scheduler(self.update_counter, **self.weight_scheduler_params)
        )
        return self.weight
