"""What commands share: kinds of argument, each with its help, and what becomes of documents, robots, overrides and outputs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tgdsl.console.progress import Progress
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.files.write import check_writable

if TYPE_CHECKING:
    from tgdsl.module.module import TactileModule

FILE = tyro.conf.arg(metavar="FILE")
"""Marks the path of a file."""
OUT = tyro.conf.arg(aliases=["-o"], metavar="FILE")
"""Marks the path of the file that a command writes."""
FOLDER = tyro.conf.arg(metavar="FOLDER")
"""Marks the path of a folder."""
OUT_FOLDER = tyro.conf.arg(aliases=["-o"], metavar="FOLDER")
"""Marks the path of the folder that a command writes."""
OptionalFile = Annotated[Path | None, FILE]
Document = Annotated[tyro.conf.Positional[Path], FILE]
DocumentOrArtefact = Annotated[Document, tyro.conf.arg(help="The YAML document, or an artefact (.safetensors).")]
Robot = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(help="A file (MJCF, URDF, USD), or the name of a robot that tgdsl brings.", metavar="ROBOT"),
]
Task = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="The task's YAML document.", metavar="TASK")]
Replace = Annotated[bool, tyro.conf.arg(help="Replace the file if it is there.")]
Overrides = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        name="set",
        help="Override a value of the document, as in `--set resolution=high`; may be repeated.",
        metavar="KEY=VALUE",
    ),
    tyro.conf.UseAppendAction,
]


def robot_document(hand: str, layout: Path | None) -> Path | dict[str, object]:
    """Return the document that an argument names, or one of just a robot and its layout.

    Raises:
        TgdslError: If it names nothing, or a robot that comes without a layout.
    """
    from tgdsl.files.find import is_file, layout_of, robot_names

    path, names = Path(hand), robot_names()
    if path.suffix in (".yaml", ".yml"):
        if layout is not None:
            raise TgdslError(f"--layout {layout}: a document names its layout itself; try --set robot.layout={layout}")
        return path
    if hand not in names and not is_file(path):
        raise TgdslError(f'there is no document, artefact or robot "{hand}"; {did_you_mean(hand, names, "robots")}')
    layout_file = layout or layout_of(hand)
    if layout_file is None:
        raise TgdslError(f"{hand}: there is no layout.yaml next to this robot; name its layout with --layout")
    return {"tgdsl": 1, "robot": {"model": hand, "layout": str(layout_file)}}


def parsed_overrides(pairs: tuple[str, ...]) -> dict[str, str]:
    """Return `KEY=VALUE` arguments as a mapping; a key that is repeated has its last value and place.

    Raises:
        TgdslError: If one has no equals sign.
    """
    result: dict[str, str] = {}
    for pair in pairs:
        if "=" not in pair:
            raise TgdslError(f'--set {pair}: expected KEY=VALUE, such as "resolution=high"')
        key, _, value = pair.partition("=")
        result.pop(key, None)
        result[key] = value
    return result


def joined_overrides(before: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return older overrides and newer ones, in the order in which they are set.

    Args:
        before: The older ones; those at or below a newer one's key are dropped.
        new: The newer ones.
    """
    unchanged = {key: value for key, value in before.items() if not any(f"{key}.".startswith(f"{other}.") for other in new)}
    return unchanged | dict(new)


def module_of(document: Path, overrides: tuple[str, ...] = (), progress: Progress | None = None) -> TactileModule:
    """Return the module of a document, or of an artefact.

    Args:
        document: The file.
        overrides: `KEY=VALUE` arguments.
        progress: Called with a line of text for each long job.

    Raises:
        TgdslError: If the document or artefact has mistakes, or an artefact is overridden.
    """
    from tgdsl.module.artifact import load
    from tgdsl.tuning.compile import compile

    if document.suffix == ".safetensors":
        if overrides:
            raise TgdslError("an artefact cannot be overridden; compile the document with --set instead")
        return load(document)
    return compile(document, overrides=parsed_overrides(overrides), progress=progress)


def in_working_folder(source: str | Path, suffix: str) -> Path:
    """Return a command's default output: the input's name with another ending, in the working folder."""
    return Path(Path(source).with_suffix(suffix).name)


def refuse_to_replace(out: Path, is_forced: bool) -> None:
    """Raise an error if a file cannot be written, or is there and may not be replaced.

    Raises:
        TgdslError: If so.
    """
    if out.is_file() and not is_forced:
        raise TgdslError(f"{out}: this file is there already; give --force to replace it, or another name")
    check_writable(out)
