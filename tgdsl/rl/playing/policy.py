"""A learned policy in a file: TorchScript, as rsl_rl's `export_policy_to_jit` writes it.

Such a file takes groups of observations side by side, (env, feature), and returns actions, (env, joint). Which groups these
are, and in which order, it does not say: they are those of the actor, in the order of the runner's `obs_groups`.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.rl.playing.actor import Actor

ACTOR_GROUPS = ("proprio", "tactile_sensors", "goal")
"""Groups that a policy sees unless others are named: of these, those that there are."""


class PolicyError(TgdslError):
    """A policy that cannot be read, or that is of other sizes than the environments."""


def actor_groups(groups: Mapping[str, int], named: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the groups of observations that a policy takes.

    Args:
        groups: Size of each group that there is.
        named: The groups, in their order; default: those of `ACTOR_GROUPS` that there are.

    Raises:
        PolicyError: If there is no such group.
    """
    for name in named:
        if name not in groups:
            raise PolicyError(f'there is no group of observations "{name}"; {did_you_mean(name, groups, "groups")}')
    return tuple(named) or tuple(name for name in ACTOR_GROUPS if name in groups)


class Policy(Actor):
    """A learned policy that acts in some environments.

    Attributes:
        groups: Groups of observations that it takes, in their order.
    """

    def __init__(
        self, file: Path, groups: Mapping[str, int], num_envs: int, num_actions: int, device: torch.device | str = "cpu"
    ):
        """Read a policy, and see that it fits.

        Args:
            file: The TorchScript file.
            groups: Size of each group of observations that it takes, in its order.
            num_envs: Number of environments.
            num_actions: Number of joints that it moves.
            device: Where it computes.

        Raises:
            PolicyError: If it cannot be read, or does not fit.
        """
        self.groups, self._num_envs = tuple(groups), num_envs
        self._module = _read(file, device)
        total = sum(groups.values())
        taken = f"{' + '.join(f'{name} ({size})' for name, size in groups.items())} = {total}"
        wanted = next((weight.shape[1] for weight in self._module.parameters() if weight.ndim == 2), total)
        if wanted != total:
            raise PolicyError(f"{file}: this policy takes {wanted} numbers, not {taken}; name its groups, in its order")
        try:
            with torch.no_grad():
                made = self._module(torch.zeros((num_envs, total), device=device))
        except Exception as error:  # whatever TorchScript raises
            last = str(error).strip().splitlines()[-1]
            what = f"this policy does not take {taken} numbers of {num_envs} environments"
            raise PolicyError(f"{file}: {what}: {last}") from error
        if not isinstance(made, Tensor) or tuple(made.shape) != (num_envs, num_actions):
            found = f"actions {tuple(made.shape)}" if isinstance(made, Tensor) else f"a {type(made).__name__}"
            raise PolicyError(f"{file}: this policy returns {found}, expected ({num_envs}, {num_actions}): joints are others")
        self.begin(torch.ones(num_envs, dtype=torch.bool))

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actions for observations."""
        with torch.no_grad():
            return self._module(torch.cat([obs[name] for name in self.groups], dim=1))

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        """Forget what is remembered, if all episodes have ended: a recurrent policy of rsl_rl takes one environment alone."""
        if hasattr(self._module, "reset") and bool(ended.all()):
            self._module.reset()


def _read(file: Path, device: torch.device | str) -> torch.jit.ScriptModule:
    """Return the module of a TorchScript file.

    Raises:
        PolicyError: If it cannot be read.
    """
    try:
        content = file.open("rb")
    except OSError as error:
        raise PolicyError(f"{file}: cannot read this file: {error.strerror or error}") from error
    with content, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript itself, which rsl_rl writes
        try:
            return torch.jit.load(content, map_location=device).eval()
        except (RuntimeError, ValueError, OSError) as error:
            what = "this is no TorchScript file, as rsl_rl's `export_policy_to_jit` writes it"
            raise PolicyError(f"{file}: {what}: {str(error).strip().splitlines()[0]}") from error
