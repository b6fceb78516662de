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
from tgdsl.rl.playing.onnx_policy import write_onnx_policy
from tgdsl.rl.playing.policy import CARD, TAXELS
from tgdsl.rl.train.folder import taxel_csv
from tgdsl.rl.train.iteration import Learning

if TYPE_CHECKING:
    from tgdsl.rl.train.learner import Learner
    from tgdsl.rl.train.model import EncodedModel

KEPT = ("task", "overrides", "seed", "processes", "device", "module", "taxels", "sensors", "scene", "versions", "spec")
"""What a card says of what a run was made from."""


def card_of(
    learner: Learning,
    run: Mapping[str, Any],
    seconds: float,
    command: str,
    groups: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """Return what is to be known of a policy, as plain values.

    Args:
        learner: Who has learned.
        run: What its run was made from.
        seconds: How long it has learned [s].
        command: How to learn it again.
        groups: Groups of observations that it takes, with their sizes; default: those of the actor.
    """
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
    """Write a policy without exploration, as TorchScript and ONNX, and its card beside it as JSON, for people.

    Raises:
        FileError: If it cannot be written.
    """
    policy: EncodedModel = learner.algorithm.get_policy()  # pyright: ignore[reportAssignmentType]
    write_module(policy.as_jit, learner.env.touch, card, file)
    write_onnx_policy(policy.as_onnx(verbose=False), texts_of(learner.env.touch, card), file.with_suffix(".onnx"))


def write_module(scripted: Callable[[], Any], touch: TactileModule, card: Mapping[str, Any], file: Path) -> None:
    """Write a policy, and its card beside it.

    Args:
        scripted: Returns the policy as TorchScript.
        touch: The module whose taxels it feels with.
        card: What is to be known of it.
        file: The file.

    Raises:
        FileError: If it cannot be written.
    """
    content, texts = io.BytesIO(), texts_of(touch, card)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript itself
        torch.jit.save(scripted(), content, _extra_files=dict(texts))
    atomic_write(file, content.getvalue())
    atomic_write(file.with_suffix(".json"), texts[CARD].encode())


def texts_of(touch: TactileModule, card: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts that a policy's file holds, by name: its card, and the taxels that it feels with."""
    return {CARD: json.dumps(card, indent=2, ensure_ascii=False, allow_nan=False) + "\n", TAXELS: taxel_csv(touch)}
