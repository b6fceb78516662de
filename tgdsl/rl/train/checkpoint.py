"""A run's state in one file, from which it goes on; the file is replaced whole, or not at all.

It holds networks, normalisers, optimisers, learning rate, iteration, random generators, and of each environment how often it
was reset, how often it was read and how long its episode has lasted. Of the physics it holds nothing: a run that goes on begins
new episodes, with random numbers that were not drawn before, and whose remaining times are as they were; so the file is small,
and is written in no time. What is lost are the episodes of that moment. Other numbers of environments or processes go on from
it too, with episodes that begin as in a new run.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from tgdsl.errors import TgdslError, listed
from tgdsl.files.write import atomic_open
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.train.iteration import Learning

FORMAT = 1
KEYS = frozenset({"iteration", "samples", "seconds", "groups", "processes"})
"""What checkpoints hold beside networks and optimisers."""


class CheckpointError(TgdslError):
    """A checkpoint that cannot be read, or that is of something else."""


def state_of(learner: Learning, seconds: float) -> dict[str, Any]:
    """Return all that a run goes on from, after so many seconds of learning; all processes call it."""
    env = learner.env
    state = {
        "resets": env.resets.cpu().clone(),
        "steps": env.steps.cpu().clone(),
        "touch": {name: count.cpu().clone() for name, count in _clock(env).items()},
        "cpu": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(env.device) if env.device.type == "cuda" else None,
    }
    return {
        "format": FORMAT,
        "iteration": learner.iteration,
        "samples": learner.samples,
        "seconds": seconds,
        "groups": learner.groups,
        **learner.state_dict(),
        "processes": learner.ranks.gathered(state),
    }


def write_checkpoint(state: Mapping[str, Any], file: Path, is_slim: bool = False) -> None:
    """Write a checkpoint to the disk; if slim, the optimisers' moments, two thirds of it, are rounded to bfloat16."""
    content = io.BytesIO()
    torch.save(_rounded(state) if is_slim else dict(state), content)
    with atomic_open(file) as opened:
        opened.write(content.getbuffer())
        opened.flush()
        os.fsync(opened.fileno())


def read_checkpoint(file: Path) -> dict[str, Any]:
    """Return what a checkpoint holds, on the CPU; raise `CheckpointError` if it cannot be read, or is none."""
    if not file.is_file():
        raise CheckpointError(f"{file}: there is no checkpoint")
    found = "a file of something else"
    try:
        content = io.BytesIO(file.read_bytes())
    except OSError as error:
        raise CheckpointError(f"{file}: cannot read this file: {error.strerror or error}") from error
    try:
        state = torch.load(content, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever torch and pickle raise
        cut = f"{file.stat().st_size:,} bytes that are cut off, or of something else"
        raise _no_checkpoint(file, found if zipfile.is_zipfile(content) else cut) from error
    if not isinstance(state, dict) or "format" not in state:
        raise _no_checkpoint(file, found)
    if state["format"] != FORMAT:
        raise _no_checkpoint(file, f"a checkpoint of format {state['format']}, not {FORMAT}, of another version of tgdsl")
    if missing := sorted(KEYS - state.keys()):
        raise _no_checkpoint(file, f"a checkpoint without {', '.join(missing)}")
    return state


def _no_checkpoint(file: Path, found: str) -> CheckpointError:
    hint = "put back a copy of one, or begin again with another --out"
    return CheckpointError(f"{file}: found {found}, expected a checkpoint of `tgdsl train` or `tgdsl distill`; {hint}")


def restore(learner: Learning, state: Mapping[str, Any], file: Path) -> None:
    """Have a learner of the same groups and networks go on from a checkpoint; `file` is named in errors."""
    env, rank = learner.env, learner.ranks.rank
    names = state["groups"].keys() | learner.groups.keys()
    if state["groups"].keys() ^ learner.groups.keys() == {"rnd_state"}:  # RND was turned on or off
        names -= {"rnd_state"}
    if any(state["groups"].get(name) != learner.groups.get(name) for name in names):
        raise CheckpointError(f"{file}: learned from the groups {state['groups']}, not {learner.groups}")
    try:
        learner.load_state_dict(state)
    except (RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(f"{file}: its networks are of other sizes: {str(error).splitlines()[-1].strip()}") from error
    learner.iteration, learner.samples = state["iteration"], state["samples"]
    ours = state["processes"][rank] if rank < len(state["processes"]) else None
    if ours is not None and ours["resets"].shape == env.resets.shape:
        _count_on(env, [ours])
        learner.go_on(ours["steps"].to(env.device))
    else:
        _count_on(env, state["processes"])
    if ours is None:
        return
    torch.set_rng_state(ours["cpu"])
    if ours["cuda"] is not None and env.device.type == "cuda":
        torch.cuda.set_rng_state(ours["cuda"], env.device)


def not_finite(state: Any, networks: Mapping[str, Sequence[str]], sizes: Mapping[str, int], path: str = "") -> str:
    """Return the name of the first tensor of a state that is not all finite numbers, or nothing.

    Moments of observations are named with their groups: `networks` has the groups of each network, `sizes` the size of each.
    """
    if isinstance(state, Mapping | list | tuple):
        parts = state.items() if isinstance(state, Mapping) else enumerate(state)
        return next(filter(None, (not_finite(part, networks, sizes, f"{path}.{name}".lstrip(".")) for name, part in parts)), "")
    if not isinstance(state, Tensor) or not state.is_floating_point() or bool(state.isfinite().all()):
        return ""
    if "normalizer" not in path and ".seen." not in path:
        return path
    wrong = (~state.isfinite()).reshape(-1, state.shape[-1] if state.ndim else 1).any(dim=0).tolist()
    named = [name for name in networks if f"{name}_state_dict" in path] or list(networks)  # one of rsl_rl's, or students
    columns = [[group for group in networks[name] for _ in range(sizes.get(group, 0))] for name in named]
    result = (group for each in columns if len(each) == len(wrong) for group, is_it in zip(each, wrong, strict=True) if is_it)
    return f"{path}, which observes {listed([*dict.fromkeys(result)])},"


def _count_on(env: TouchEnv, processes: Sequence[Mapping[str, Any]]) -> None:
    """Have environments go on to draw what was not drawn: each from its own counts, or all from the largest of any."""
    for name, count in ({"resets": env.resets} | _clock(env)).items():
        saved = [each["resets"] if name == "resets" else each.get("touch", {}).get(name) for each in processes]
        saved = [value for value in saved if value is not None]  # an earlier checkpoint has none of touch
        if len(saved) == 1 and saved[0].shape == count.shape:
            count.copy_(saved[0])
        elif saved:
            count.fill_(max(int(value.max()) for value in saved))


def _clock(env: TouchEnv) -> dict[str, Tensor]:
    clock: Any = env.touch.memory.clock
    return {"step": clock.step, "episode": clock.episode} if clock.num_envs else {}


def _rounded(part: Any) -> Any:
    if isinstance(part, Mapping):
        return {name: each.bfloat16() if str(name).startswith("exp_avg") else _rounded(each) for name, each in part.items()}
    return [_rounded(each) for each in part] if isinstance(part, list) else part
