"""From a task's `train` to rsl_rl's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tgdsl.errors import did_you_mean
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensed import GROUP

PROPRIO, PRIVILEGED, STATE, PROPS = "proprio", "priv_proprio", "priv_obj_state", "priv_obj_props"
"""What is known of the hand; that and its forces; the object's motion; what it is like."""
MOST_STD = 1e6  # bound above of the actions' standard deviation: rsl_rl's

PPO_OPTIONS = {
    "num_learning_epochs": "epochs",
    "num_mini_batches": "mini_batches",
    "clip_param": "clip",
    "gamma": "discount",
    "lam": "gae",
    "value_loss_coef": "value",
    "entropy_coef": "entropy",
    "learning_rate": "learning_rate",
    "max_grad_norm": "max_grad_norm",
    "use_clipped_value_loss": "clip_values",
    "desired_kl": "desired_kl",
    "precision": "precision",
}
"""Numbers of `train` by rsl_rl's names."""


def observed(loaded: LoadedTask, groups: Mapping[str, int]) -> dict[str, list[str]]:
    """Return the groups of observations of actor, critic and, if there is one, random network distillation."""
    train = loaded.spec.train
    privileged = [name for name in groups if name not in (PROPRIO, GROUP)]
    actor = _given(loaded, groups, ("actor",)) or [name for name in privileged if name != PROPS]
    result = {"actor": actor, "critic": _given(loaded, groups, ("critic",)) or privileged}
    if train.rnd != "off":
        result["rnd_state"] = _given(loaded, groups, ("rnd", "groups")) or ([STATE] if STATE in groups else actor)
    return result


def config(loaded: LoadedTask, groups: Mapping[str, int], multi_gpu: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return rsl_rl's configuration, for `PPO.construct_algorithm` or an `OnPolicyRunner`."""
    train, networks = loaded.spec.train, loaded.spec.train.networks
    encoders = {GROUP: networks.touch_encoder, "*": networks.encoder}
    normalisation = {"eps": networks.eps, "clip": networks.clip}
    model = normalisation | {
        "class_name": "tgdsl.rl.train.model:EncodedModel",
        "hidden_dims": list(networks.hidden),
        "activation": "elu",
        "obs_normalization": True,
        "encoders": {name: {"hidden": list(spec.hidden), "size": spec.size} for name, spec in encoders.items()},
    }
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian", "init_std": networks.initial_std}
    algorithm = {name: getattr(train, own) for name, own in PPO_OPTIONS.items()}
    algorithm |= {"class_name": "tgdsl.rl.train.ppo:CapturedPPO", "schedule": "adaptive" if train.adaptive else "fixed"}
    rnd = (
        None
        if train.rnd == "off"
        else normalisation
        | {
            "weight": train.rnd.weight,
            "num_outputs": train.rnd.outputs,
            "predictor_hidden_dims": list(train.rnd.predictor),
            "target_hidden_dims": list(train.rnd.target),
            "state_normalization": True,
            "reward_normalization": True,
            "learning_rate": train.rnd.learning_rate,
        }
    )
    return {
        "num_steps_per_env": train.steps,
        "save_interval": 1000,
        "obs_groups": observed(loaded, groups),
        "actor": model | {"distribution_cfg": gaussian | {"std_range": (networks.min_std, MOST_STD)}},
        "critic": dict(model),
        "algorithm": algorithm | {"rnd_cfg": rnd},
        "multi_gpu": None if multi_gpu is None else dict(multi_gpu),
    }


def _given(loaded: LoadedTask, groups: Mapping[str, int], place: tuple[str, ...]) -> list[str]:
    """Return the groups that a document names; none if it names none."""
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
