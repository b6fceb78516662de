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
    """Return all that a run goes on from; all processes are asked."""
    env = learner.env
    state = {
        "resets": env.resets.cpu().clone(),
        "steps": env.steps.cpu().clone(),
        "touch": {name: getattr(env.touch.memory.clock, name).cpu().clone() for name in _counted(env)},
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
    """Write a checkpoint, to the disk.

    Raises:
        FileError: If it cannot be written; then the file that was there is as it was.
    """
    content = io.BytesIO()
    torch.save(_slim(state) if is_slim else dict(state), content)
    with atomic_open(file) as opened:
        opened.write(content.getbuffer())
        opened.flush()
        os.fsync(opened.fileno())


def read_checkpoint(file: Path) -> dict[str, Any]:
    """Return what a checkpoint holds, on the CPU.

    Raises:
        CheckpointError: If it cannot be read, or is none.
    """
    if not file.is_file():
        raise CheckpointError(f"{file}: there is no checkpoint")
    try:
        opened = file.open("rb")
    except OSError as error:
        raise CheckpointError(f"{file}: cannot read this file: {error.strerror or error}") from error
    with opened:
        try:
            state = torch.load(opened, map_location="cpu", weights_only=True)
        except Exception as error:  # whatever torch and pickle raise, OSError too
            cut = f"{file.stat().st_size:,} bytes that are cut off, or of something else"
            raise _no_checkpoint(file, "a file of something else" if zipfile.is_zipfile(file) else cut) from error
    if not isinstance(state, dict) or "format" not in state:
        raise _no_checkpoint(file, "a file of something else")
    if state["format"] != FORMAT:
        raise _no_checkpoint(file, f"a checkpoint of format {state['format']}, not {FORMAT}, of another version of tgdsl")
    if missing := sorted(KEYS - state.keys()):
        raise _no_checkpoint(file, f"a checkpoint without {', '.join(missing)}")
    return state


def _no_checkpoint(file: Path, found: str) -> CheckpointError:
    hint = "put back a copy of one, or begin again with another --out"
    return CheckpointError(f"{file}: found {found}, expected a checkpoint of `tgdsl train` or `tgdsl distill`; {hint}")


def restore(learner: Learning, state: Mapping[str, Any], file: Path) -> None:
    """Have a learner go on from a checkpoint; what its physics was has gone.

    Raises:
        CheckpointError: If it is of other groups or networks.
    """
    rank = learner.ranks.rank
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
    process_state = state["processes"][rank] if rank < len(state["processes"]) else None
    if process_state is not None and process_state["resets"].shape == learner.env.resets.shape:
        _count_on(learner.env, [process_state])
        learner.go_on(process_state["steps"].to(learner.env.device))
    else:
        _count_on(learner.env, state["processes"])
    if process_state is None:
        return
    torch.set_rng_state(process_state["cpu"])
    if process_state["cuda"] is not None and learner.env.device.type == "cuda":
        torch.cuda.set_rng_state(process_state["cuda"], learner.env.device)


def not_finite(state: Any, networks: Mapping[str, Sequence[str]], sizes: Mapping[str, int], path: str = "") -> str:
    """Return the name of the first tensor of a state that holds something else than finite numbers; none: nothing.

    Of moments of observations with the groups that these are of.
    """
    if isinstance(state, Mapping):
        parts = (not_finite(part, networks, sizes, f"{path}.{name}".lstrip(".")) for name, part in state.items())
        return next(filter(None, parts), "")
    if isinstance(state, list | tuple):
        return next(filter(None, (not_finite(part, networks, sizes, f"{path}.{i}") for i, part in enumerate(state))), "")
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
    counts = {"resets": env.resets} | {name: getattr(env.touch.memory.clock, name) for name in _counted(env)}
    for name, count in counts.items():
        counters = [each["resets"] if name == "resets" else each.get("touch", {}).get(name) for each in processes]
        present = [value for value in counters if value is not None]  # an earlier checkpoint has none of touch
        if len(present) == 1 and present[0].shape == count.shape:
            count.copy_(present[0])
        elif present:
            count.fill_(max(int(value.max()) for value in present))


def _counted(env: TouchEnv) -> tuple[str, ...]:
    return ("step", "episode") if env.touch.memory.clock.num_envs else ()


def _slim(state: Mapping[str, Any]) -> dict[str, Any]:
    """Return a state whose optimisers' moments are rounded; optimisers widen them again."""
    if "stacks" in state:
        stacks = [dict(own) | {"optimiser": _rounded(own["optimiser"])} for own in state["stacks"]]
        return dict(state) | {"stacks": stacks}
    if "algorithm" not in state:
        return dict(state)
    algorithm = dict(state["algorithm"])
    for name in [name for name in algorithm if name.endswith("optimizer_state_dict")]:
        algorithm[name] = _rounded(algorithm[name])
    return dict(state) | {"algorithm": algorithm}


def _rounded(optimiser: Mapping[str, Any]) -> dict[str, Any]:
    """Return an optimiser's state with its moments in bfloat16."""
    moments = {
        i: {key: value.bfloat16() if key.startswith("exp_avg") else value for key, value in moments.items()}
        for i, moments in optimiser["state"].items()
    }
    return dict(optimiser) | {"state": moments}
