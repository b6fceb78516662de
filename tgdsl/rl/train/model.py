"""Networks of actor and critic: each group of observations is normalised and embedded, and the embeddings are mapped together.

`class_name: tgdsl.rl.train.model:EncodedModel` gives rsl_rl this model, and `tgdsl.rl.train.model:Gaussian` its distribution.

Shapes: `env` environments, `feature` numbers of all groups of a model, side by side.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP, GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from tgdsl.rl.train.normalising import Normalisation


class Gaussian(GaussianDistribution):
    """rsl_rl's Gaussian distribution; to draw from it waits for nothing, where torch's own looks at the deviations' signs."""

    def sample(self) -> Tensor:
        """Draw: the numbers that torch's own would give."""
        return torch.randn_like(self.mean) * self.std + self.mean

    def bound(self) -> None:
        """Put deviations back within their range: beyond it rsl_rl's clamp has no gradient, and they could not return."""
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
        """Return the embeddings of all groups, side by side."""
        return self.embed(torch.cat([obs[name] for name in self.obs_groups], dim=-1))

    def embed(self, x: Tensor) -> Tensor:
        """Return the embeddings of groups that stand side by side, (env, feature)."""
        parts = self.obs_normalizer(x).split(self._sizes, dim=-1)
        return torch.cat([encoder(part) for encoder, part in zip(self.encoders, parts, strict=True)], dim=-1)

    def as_jit(self) -> nn.Module:
        """Return what acts without exploration, as TorchScript: takes (env, feature)."""
        exported = Exported(self).cpu()
        return torch.jit.trace(exported, exported.get_dummy_inputs())  # pyright: ignore[reportReturnType]

    def as_onnx(self, verbose: bool) -> nn.Module:
        """Return what acts without exploration, as rsl_rl exports it to ONNX."""
        return Exported(self)

    def _get_latent_dim(self) -> int:
        return self._latent


class Exported(nn.Module):
    """A copy of a model that takes groups side by side, (env, feature), and returns what it would do without exploration."""

    is_recurrent = False
    input_names = ("obs",)
    output_names = ("actions",)

    def __init__(self, model: EncodedModel):
        super().__init__()
        distribution = model.distribution
        if distribution is not None:
            model.distribution = None  # what it was updated with last belongs to a graph of gradients, and cannot be copied
        try:
            self.model = copy.deepcopy(model).eval()
        finally:
            model.distribution = distribution
        self.output = distribution.as_deterministic_output_module() if distribution is not None else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Return actions, (env, joint)."""
        return self.output(self.model.mlp(self.model.embed(x)))

    def get_dummy_inputs(self) -> tuple[Tensor]:
        """Return an example of what it takes."""
        first = next(self.parameters())
        return (torch.zeros((2, self.model.obs_dim), dtype=first.dtype, device=first.device),)
