"""Files of exported steps: torch.export's, AOTInductor's and ONNX."""

from __future__ import annotations

import logging
import warnings
import zipfile
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_path
from tgdsl.module.export.program import without_strides
from tgdsl.module.export.signature import ENTRY, Signature
from tgdsl.tensors.torch_internals import write_package

Format = Literal["pt2", "aoti", "onnx"]
ENDINGS: dict[Format, str] = {"pt2": ".pt2", "aoti": ".aoti.pt2", "onnx": ".onnx"}
OPSET = 20


def format_of(path: Path, to: str | None) -> Format:
    """Return the format of a file, by its name's ending if it is not given.

    Raises:
        TgdslError: If there is no such format, the name has another ending, or what writes it is not installed.
    """
    result = to or next((name for name in reversed(ENDINGS) if path.name.endswith(ENDINGS[name])), None)
    if result not in ENDINGS:
        raise TgdslError(
            f"found {to or path.name!r}, expected one of {', '.join(ENDINGS)}, or a file's name with .pt2 or .onnx"
        )
    ending = ".onnx" if result == "onnx" else ".pt2"
    if path.suffix != ending:
        raise TgdslError(f"{path}: the format {result} has the ending {ending}")
    if result == "onnx" and not (find_spec("onnx") and find_spec("onnxscript")):
        raise TgdslError('ONNX files need onnx and onnxscript: pip install "tgdsl[export]"')
    return result


def write(program: torch.export.ExportedProgram, signature: Signature, path: Path, to: Format, options: dict[str, Any]) -> None:
    """Write an exported step.

    Args:
        program: Its graph.
        signature: What goes in and comes out.
        path: The file.
        to: Its format.
        options: What Inductor is asked for, see `TactileModule.inductor_options`.

    Raises:
        FileError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        if to == "onnx":
            inputs, outputs = ([port.name for port in ports] for ports in (signature.inputs, signature.outputs))
            write_onnx(without_strides(program), inputs, outputs, {Path(ENTRY).stem: signature.to_json()}, temporary)
        elif to == "pt2":
            torch.export.save(program, str(temporary), extra_files={ENTRY: signature.to_json()})
        else:
            metadata = {Path(ENTRY).stem: signature.to_json()}
            write_package(program, temporary, {**options, "aot_inductor.metadata": metadata})
            with zipfile.ZipFile(temporary, "a") as archive:
                folder = archive.namelist()[0].partition("/")[0]
                archive.writestr(f"{folder}/extra/{ENTRY}", signature.to_json())


def write_onnx(
    program: torch.export.ExportedProgram,
    inputs: Sequence[str],
    outputs: Sequence[str],
    metadata: dict[str, str],
    path: Path,
) -> None:
    """Write a graph as ONNX.

    Args:
        program: The graph.
        inputs: Names of its inputs, in order.
        outputs: Names of its outputs, in order.
        metadata: Texts that the file holds, by name.
        path: The file.
    """
    import onnx

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # that torchvision is not installed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch's own use of a part of torch that it has deprecated
        converted: Any = torch.onnx.export(
            program,
            input_names=inputs,
            output_names=outputs,
            opset_version=OPSET,
            dynamo=True,
            optimize=False,  # it takes x + 1e-24 for x
            verbose=False,
        )
    model = converted.model_proto
    onnx.helper.set_model_props(model, metadata)
    onnx.save(model, str(path))
