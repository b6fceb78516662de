"""A policy as an ONNX file, for runtimes without torch.

Inputs are `obs` (env, feature), the groups of the card side by side, and of a recurrent policy `memory` (env, memory), zeros
where an episode begins; outputs are `actions` (env, joint), and `next_memory`, which goes in as `memory` at the next step. Any
number of environments will do. Observations are normalised inside.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of all groups, `memory` numbers that a
policy remembers of an episode.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from tgdsl.files.write import atomic_path
from tgdsl.module.export.formats import write_onnx


def write_onnx_policy(network: Any, texts: dict[str, str], file: Path) -> None:
    """Write a policy."""
    module = network.cpu().eval().requires_grad_(False)
    inputs = network.get_dummy_inputs()
    env = torch.export.Dim("env", min=1)
    with torch.no_grad():
        program = torch.export.export(module, inputs, dynamic_shapes=tuple({0: env} for _ in inputs))
    with atomic_path(file) as temporary:
        write_onnx(program, network.input_names, network.output_names, texts, temporary)
