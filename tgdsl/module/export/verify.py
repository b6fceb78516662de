"""Does an exported file compute what the module computes?

Shapes: `env` environments.
"""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import ArtifactError, TgdslError, listed
from tgdsl.module.export import standalone
from tgdsl.module.export.program import Signature, read_signature
from tgdsl.module.module import TactileModule

BATCHES, NUM_CALLS, RESET_EVERY = (1, 7, 64), 100, 9
TOLERANCE = 1e-5  # largest difference over the largest magnitude of a channel, as for the kinds' own float32
SPREAD = 0.015  # standard deviation of bodies' positions [m]: many taxels touch


@dataclass(frozen=True)
class Verdict:
    """How far an exported file is from the module."""

    differences: Mapping[int, Mapping[str, float]]  # largest, over the largest magnitude of the channel, by batch and output
    refuses_other_dtypes: bool  # whether tensors of a wrong dtype are refused

    @property
    def worst(self) -> float:
        """The largest difference of all."""
        return max((value for row in self.differences.values() for value in row.values()), default=0.0)

    @property
    def is_equal(self) -> bool:
        """Whether all differences are within `TOLERANCE`, and wrong dtypes refused."""
        return self.worst <= TOLERANCE and self.refuses_other_dtypes


def verify(path: Path, touch: TactileModule, num_calls: int = NUM_CALLS, progress: Progress = silent) -> Verdict:
    """Compare an exported file with its module, on the CPU, on random states, in a process that cannot import tgdsl.

    The module is seeded as at the export. Memory is carried from call to call, and some environments begin an episode at every
    ninth call.
    """
    signature = read_signature(path)
    if signature.taxels_id != touch.taxels_id:
        raise ArtifactError(f"{path}: its taxels are other ones than the module's; export it again")
    if path.suffix == ".onnx" and not find_spec("onnxruntime"):
        raise TgdslError('to run ONNX files takes onnxruntime: pip install "tgdsl[export]"')
    with tempfile.TemporaryDirectory() as folder:
        records = [_record(signature, touch, num_envs, num_calls, Path(folder), progress) for num_envs in BATCHES]
        progress(f"calling the file, {num_calls} times with {listed([str(num) for num in BATCHES])} environments")
        command = [sys.executable, "-I", standalone.__file__, str(path.absolute()), *map(str, records)]
        run = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if run.returncode:
        raise ArtifactError(f"{path}: cannot be run: {run.stderr.strip()}")
    answer = json.loads(run.stdout.splitlines()[-1])
    return Verdict(dict(zip(BATCHES, answer["differences"], strict=True)), answer["refuses"])


def _record(
    signature: Signature, touch: TactileModule, num_envs: int, num_calls: int, folder: Path, progress: Progress
) -> Path:
    """Write what the module reads of random states, and the states."""
    arrays: dict[str, np.ndarray] = {"num_calls": np.array(num_calls), "num_envs": np.array(num_envs)}
    dtypes = {port.name: getattr(torch, port.dtype) for port in signature.inputs}
    memory, generator = touch.initial_memory(num_envs, signature.dt), torch.Generator().manual_seed(num_envs)
    for call in range(num_calls):
        progress(f"calling the module with {num_envs} environments: {call + 1} of {num_calls}")
        state = touch.example_state(num_envs, call, dtypes["body_pos"], SPREAD)
        state = dataclasses.replace(state, dt=signature.dt)
        reset = (torch.rand(num_envs, generator=generator) < 0.3) & (call % RESET_EVERY == RESET_EVERY - 1)
        with torch.no_grad():
            tensors = touch.incoming.tensors(state, touch.dtype, touch.device)
            readings, memory = touch.step(state, memory, reset)
            observations = touch.observe(readings) if touch.plan.observations else {}
        values = {**tensors, "reset": reset} | {f"reading/{name}": value for name, value in readings.items()}
        values |= {f"observation/{name}": value for name, value in observations.items()}
        arrays |= {f"{call}/{name}": value.numpy() for name, value in values.items()}
    file = folder / f"{num_envs}.npz"
    np.savez(file, allow_pickle=False, **arrays)
    return file
