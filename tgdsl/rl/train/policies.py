"""Learned policies as files: TorchScript for `tgdsl play --policy`, with a card in it that says what the policy is."""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from tgdsl.files.write import atomic_write
from tgdsl.module.module import TactileModule
from tgdsl.rl.playing.policy import CARD
from tgdsl.rl.train.folder import taxel_csv
from tgdsl.rl.train.iteration import Learning

if TYPE_CHECKING:
    from tgdsl.rl.train.learner import Learner

KEPT = ("task", "overrides", "seed", "processes", "device", "module", "taxels", "sensors", "scene", "versions", "spec")
"""What a card says of what a run was made from."""


def card_of(
    learner: Learning,
    run: Mapping[str, Any],
    seconds: float,
    command: str,
    groups: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Return what is to be known of a policy, as plain values."""
    algorithm = getattr(learner, "algorithm", None)
    std = dict(algorithm.actor.named_parameters()).get("distribution.std_param") if algorithm else None
    return {
        "groups": dict(groups or {name: learner.env.groups[name] for name in learner.groups["actor"]}),
        "joints": list(learner.env.joint_names),
        "iterations": learner.iteration,
        "samples": learner.samples,
        "minutes": round(seconds / 60.0, 2),
        "command": command,
        "score": None,
        **{name: run[name] for name in KEPT},
        "std": None if std is None else std.tolist(),
    }


def write_policy(learner: Learner, card: Mapping[str, Any], file: Path) -> None:
    """Write a policy without exploration, and its card beside it as JSON, for people.

    Raises:
        FileError: If it cannot be written.
    """
    write_module(lambda: learner.algorithm.get_policy().as_jit(), learner.env.touch, card, file)


def write_module(scripted: Callable[[], Any], touch: TactileModule, card: Mapping[str, Any], file: Path) -> None:
    """Write a policy, and its card beside it.

    Raises:
        FileError: If it cannot be written.
    """
    content = io.BytesIO()
    text = json.dumps(card, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript itself
        torch.jit.save(scripted(), content, _extra_files={CARD: text, "taxels.csv": taxel_csv(touch)})
    atomic_write(file, content.getvalue())
    atomic_write(file.with_suffix(".json"), text.encode())
