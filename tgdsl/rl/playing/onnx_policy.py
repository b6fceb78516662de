"""A policy as an ONNX file, for runtimes without torch.

Inputs are `obs` (env, feature), the groups of the card side by side, and of a recurrent policy `memory` (env, memory), zeros
where an episode begins; outputs are `actions` (env, joint), and `next_memory`, which goes in as `memory` at the next step. Any
number of environments will do. Observations are normalised inside.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of all groups, `memory` numbers that a
policy remembers of an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from tgdsl.files.write import atomic_path
from tgdsl.module.export.formats import write_onnx


class Network(Protocol):
    """What acts without exploration, as rsl_rl's `as_onnx` returns it."""

    input_names: Sequence[str]
    output_names: Sequence[str]

    def get_dummy_inputs(self) -> tuple[Tensor, ...]:
        """Return an example of its inputs, of at least two environments."""
        ...


def write_onnx_policy(network: Network, texts: dict[str, str], file: Path) -> None:
    """Write a policy.

    Args:
        network: The policy, an `nn.Module`.
        texts: The card and the table of taxels by the names that they have in the TorchScript file; metadata of this one.
        file: The file.

    Raises:
        FileError: If it cannot be written.
    """
    assert isinstance(network, nn.Module)
    module = network.cpu().eval().requires_grad_(False)
    inputs = network.get_dummy_inputs()
    env = torch.export.Dim("env", min=1)
    with torch.no_grad():
        program = torch.export.export(module, inputs, dynamic_shapes=tuple({0: env} for _ in inputs))
    with atomic_path(file) as temporary:
        write_onnx(program, network.input_names, network.output_names, texts, temporary)
