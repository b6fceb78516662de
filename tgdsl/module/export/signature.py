"""What goes into an exported step and comes out of it, in order: text beside the program in the same file.

Shapes: `env` environments.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tgdsl.errors import ArtifactError

ENTRY = "tgdsl.json"
"""Name of the text in a .pt2 file, below `extra/`; in an ONNX file it is metadata of the name without the ending."""
FORMAT = 1


@dataclass(frozen=True)
class Port:
    """A tensor that goes in or comes out."""

    # a field of `SceneState`, `substep/<i>/<field>`, `reset`, `memory/<name>`; `reading/<name>`, `observation/<group>`,
    # `next/<name>`
    name: str
    shape: tuple[int, ...]  # its shape after `env`
    dtype: str  # its dtype, such as "float32"
    rest: float | None = None  # what all its numbers are before the first call, if it is memory


@dataclass(frozen=True)
class Signature:
    """All inputs and outputs of a step; each `next/<name>` goes in as `memory/<name>` at the next one."""

    inputs: tuple[Port, ...]  # what goes in, in order
    outputs: tuple[Port, ...]  # what comes out, in order
    dt: float | None  # time between steps that the program is made for [s]; None if nothing depends on it
    taxels_id: str  # see `TactileModule.taxels_id`
    source: str  # document or artefact that it was exported from; empty if it was a module in memory
    overrides: tuple[str, ...]  # what was overridden of the document
    version: str  # of tgdsl
    format: int = FORMAT  # of this text

    def to_json(self) -> str:
        """Return the text."""
        return json.dumps(asdict(self), indent=1)


def read_signature(path: Path) -> Signature:
    """Return the signature of an exported file.

    Raises:
        ArtifactError: If the file is none that tgdsl exported.
    """
    try:
        if path.suffix == ".onnx":
            import onnx

            properties = onnx.load(str(path), load_external_data=False).metadata_props
            text = next(entry.value for entry in properties if entry.key == Path(ENTRY).stem)
        else:
            with zipfile.ZipFile(path) as archive:
                name = next(name for name in archive.namelist() if name.endswith(f"/extra/{ENTRY}"))
                text = archive.read(name).decode()
        values: dict[str, Any] = json.loads(text)
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read: {error.strerror or error}") from error
    except Exception as error:  # what parsers of protobuf and zip raise has no common base
        raise ArtifactError(f"{path}: expected a file that `tgdsl export` wrote (.pt2, .onnx)") from error
    if values.get("format") != FORMAT:
        raise ArtifactError(f"{path}: found format {values.get('format')}, expected {FORMAT}; export it again")
    for side in ("inputs", "outputs"):
        values[side] = tuple(Port(**{**port, "shape": tuple(port["shape"])}) for port in values[side])
    return Signature(**{**values, "overrides": tuple(values["overrides"])})
