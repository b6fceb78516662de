"""Robots and scenes in and out: which reader or writer a file's ending stands for."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping
from pathlib import Path

import mujoco

from tgdsl.errors import RobotError, listed
from tgdsl.formats.mjcf import read_mjcf
from tgdsl.formats.model import Model
from tgdsl.formats.urdf import read_urdf
from tgdsl.scene.mujoco_warnings import located_warnings

Reader = Callable[[Path], Model]
"""Reads and compiles a file; `load_model` names the file in what it raises that is MuJoCo's or the system's."""
Writer = Callable[[Model, Path], None]  # writes a compiled model to a file


def _read_usd(path: Path) -> Model:
    from tgdsl.formats.usd.reader import read_usd

    return read_usd(path)


def _write_usd(model: Model, out: Path) -> None:
    from tgdsl.formats.usd.write import write_usd

    write_usd(model, out)


READERS: Mapping[str, Reader] = {".urdf": read_urdf, **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), _read_usd)}
"""By a file's ending, in lower case; any other file is XML, whose root element tells."""


def _refuse_part(path: Path) -> Model:
    raise RobotError(f"{path}: a part that models <include>, and no model; name the file that includes it")


MJCF = (".xml", ".mjcf")  # endings of files that MuJoCo reports errors for, even where they are no XML
ROOTS: Mapping[str, Reader] = {"robot": read_urdf, "mujocoinclude": _refuse_part}
"""By the root element of XML; any other is MJCF's."""
WRITERS: Mapping[str, Writer] = dict.fromkeys((".usda", ".usdc", ".usd"), _write_usd)  # by a file's ending


def load_model(path: Path) -> Model:
    """Read and compile an MJCF, URDF or USD file.

    Raises:
        RobotError: If it cannot be read or compiled, with MuJoCo's own account of the element at fault, or the prim's path.
    """
    try:
        with located_warnings(path):
            suffix = path.suffix.lower()
            if suffix in READERS:
                return READERS[suffix](path)
            root = _root_element(path)
            if not root and suffix not in MJCF and path.is_file():
                raise RobotError(f"{path}: this is no robot or scene file, expected MJCF, URDF or USD")
            return ROOTS.get(root, read_mjcf)(path)
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise RobotError(f"{path}: {' '.join(str(error).split())}") from error


def export_model(model_file: Path, out: Path) -> None:
    """Write a robot or scene file in another format; the same input gives the same bytes.

    Warns of each thing of the model that the format does not hold, after the file is written.

    Args:
        model_file: An MJCF or URDF file.
        out: The file to write; its ending says in which format. A USD stage is text as `.usda`, binary as `.usdc` and `.usd`.

    Raises:
        RobotError: If the model cannot be read, the format cannot express it, or the file cannot be written.
    """
    if out.suffix not in WRITERS:
        raise RobotError(f"{out}: USD files end in {listed(tuple(WRITERS))}")
    WRITERS[out.suffix](load_model(model_file), out)


def _root_element(path: Path) -> str:
    """Return the name of an XML file's root element, or nothing if it is not XML."""
    try:
        with path.open("rb") as file:  # `iterparse` of a path would leave the file open
            for _, element in ET.iterparse(file, events=("start",)):
                return element.tag
    except (ET.ParseError, OSError):
        return ""
    return ""
