"""From a task's `train` to rsl_rl's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tgdsl.errors import did_you_mean
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensed import GROUP
from tgdsl.rl.train.spec import EncoderSpec, RndSpec, TrainSpec

PROPRIO, PRIVILEGED, STATE, PROPS = "proprio", "priv_proprio", "priv_obj_state", "priv_obj_props"
"""What is known of the hand; that and its forces; the object's motion; what it is like."""
MOST_STD = 1e6
"""Bound above of the actions' standard deviation: rsl_rl's."""


def observed(loaded: LoadedTask, groups: Mapping[str, int]) -> dict[str, list[str]]:
    """Return the groups of observations of actor, critic and, if there is one, random network distillation.

    Args:
        loaded: The task's document.
        groups: Size of each group that there is.

    Raises:
        SpecError: If a group that is named is not there, or is empty.
    """
    train = loaded.spec.train
    privileged = [name for name in groups if name not in (PROPRIO, GROUP)]
    actor = _given(loaded, groups, ("actor",)) or [name for name in privileged if name != PROPS]
    result = {"actor": actor, "critic": _given(loaded, groups, ("critic",)) or privileged}
    if train.rnd != "off":
        result["rnd_state"] = _given(loaded, groups, ("rnd", "groups")) or ([STATE] if STATE in groups else actor)
    return result


def config(loaded: LoadedTask, groups: Mapping[str, int], multi_gpu: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return rsl_rl's configuration, for `PPO.construct_algorithm` or an `OnPolicyRunner`.

    Args:
        loaded: The task's document.
        groups: Size of each group of observations that there is.
        multi_gpu: As rsl_rl has it; None: one process.

    Raises:
        SpecError: If a group that is named is not there.
    """
    train = loaded.spec.train
    model = _model(train)
    networks = train.networks
    gaussian = {
        "class_name": "tgdsl.rl.train.model:Gaussian",
        "init_std": networks.initial_std,
        "std_range": (networks.min_std, MOST_STD),
    }
    return {
        "num_steps_per_env": train.steps,
        "save_interval": 1000,
        "obs_groups": observed(loaded, groups),
        "actor": model | {"distribution_cfg": gaussian},
        "critic": dict(model),
        "algorithm": _algorithm(train),
        "multi_gpu": None if multi_gpu is None else dict(multi_gpu),
    }


def _model(train: TrainSpec) -> dict[str, Any]:
    networks = train.networks
    return {
        "class_name": "tgdsl.rl.train.model:EncodedModel",
        "hidden_dims": list(networks.hidden),
        "activation": "elu",
        "obs_normalization": True,
        "encoders": {GROUP: _encoder(networks.touch_encoder), "*": _encoder(networks.encoder)},
        "eps": networks.eps,
        "clip": networks.clip,
    }


def _encoder(spec: EncoderSpec) -> dict[str, Any]:
    return {"hidden": list(spec.hidden), "size": spec.size}


def _algorithm(train: TrainSpec) -> dict[str, Any]:
    return {
        "class_name": "tgdsl.rl.train.ppo:CapturedPPO",
        "num_learning_epochs": train.epochs,
        "num_mini_batches": train.mini_batches,
        "clip_param": train.clip,
        "gamma": train.discount,
        "lam": train.gae,
        "value_loss_coef": train.value,
        "entropy_coef": train.entropy,
        "learning_rate": train.learning_rate,
        "max_grad_norm": train.max_grad_norm,
        "use_clipped_value_loss": train.clip_values,
        "schedule": "adaptive" if train.adaptive else "fixed",
        "desired_kl": train.desired_kl,
        "precision": train.precision,
        "rnd_cfg": None if train.rnd == "off" else _distillation(train.rnd, train),
    }


def _distillation(rnd: RndSpec, train: TrainSpec) -> dict[str, Any]:
    return {
        "weight": rnd.weight,
        "num_outputs": rnd.outputs,
        "predictor_hidden_dims": list(rnd.predictor),
        "target_hidden_dims": list(rnd.target),
        "state_normalization": True,
        "reward_normalization": True,
        "learning_rate": rnd.learning_rate,
        "eps": train.networks.eps,
        "clip": train.networks.clip,
    }


def _given(loaded: LoadedTask, groups: Mapping[str, int], place: tuple[str, ...]) -> list[str]:
    """Return the groups that a document names; none if it names none.

    Raises:
        SpecError: If there is no such group.
    """
    result: Any = loaded.spec.train
    for key in place:
        result = getattr(result, key)
    for i, name in enumerate(result or ()):
        if name not in groups:
            problem = f'there is no group of observations "{name}"'
            raise loaded.error(("train", *place, i), problem, did_you_mean(name, groups, "groups"))
        if groups[name] == 0:
            raise loaded.error(("train", *place, i), f'the group of observations "{name}" is empty')
    return list(result or ())
