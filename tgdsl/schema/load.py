"""From a document's text to its Spec: every mistake is found in one run and reported at its place."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from tgdsl.errors import Problem, SpecError, TgdslError
from tgdsl.files import find
from tgdsl.schema import yaml
from tgdsl.schema.document import document_model
from tgdsl.schema.loaded import Loaded, LoadedLayout
from tgdsl.schema.placement import LayoutSpec
from tgdsl.schema.references import reference_problems
from tgdsl.schema.unusual import warn_of_unusual
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Source
from tgdsl.sensors import KINDS, Kind

S = TypeVar("S", bound=BaseModel)
ROBOT = "a robot or scene file, which a document names: `robot: {model: …}`"
NO_DOCUMENTS = {
    ".safetensors": "an artefact, which `tgdsl.load` reads",
    ".pt": "a policy or checkpoint",
    **dict.fromkeys((".xml", ".mjcf", ".urdf", ".xacro", ".usd", ".usda", ".usdc", ".usdz"), ROBOT),
}
"""What files are that are no YAML documents, by their endings."""


def load(
    document: str | PathLike[str] | Mapping[str, Any],
    overrides: Mapping[str, Any] | None = None,
    kinds: tuple[Kind, ...] = KINDS,
    needs_sensors: bool = True,
    sensors: Collection[str] | None = None,
) -> Loaded:
    """Read a document and its layout.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        overrides: Values to set first by dotted path, as YAML text or plain, such as `{"resolution": "high"}`.
        kinds: The sensor kinds that the document may use.
        needs_sensors: Whether it is a mistake to have none.
        sensors: Names of those that are wanted, the others being left out but for those that they read; default: all.

    Returns:
        The document with the problems found so far: call `raise_problems` when all stages have added theirs.

    Raises:
        SpecError: If so much is wrong that no further stage can look at it.
        TgdslError: If the document is neither a file's name nor a mapping.
    """
    if not isinstance(document, (str, PathLike, Mapping)):
        raise TgdslError(f"a document is a YAML file's name or a mapping, found {type(document).__name__}")
    if isinstance(document, Mapping):
        source, folder = yaml.from_mapping(document, "<mapping>"), Path.cwd()
    else:
        source, folder = _read_file(Path(document), str(document)), Path(document).parent
    if source.value is None:
        raise SpecError(source.problems)
    if isinstance(source.value, dict) and "task" in source.value and "sensors" not in source.value:
        what = "this is a task's document, expected one of sensors"
        hint = f"its own is {source.value['document']}" if "document" in source.value else ""
        raise SpecError([source.problem(("task",), what, hint, on_key=True)])
    for dotted, value in (overrides or {}).items():
        source.set(dotted, value)
    if sensors is not None:
        source.keep("sensors", _with_upstream(source.value.get("sensors"), sensors, kinds))
    model = document_model(kinds, needs_sensors)
    problems = list(source.problems)
    required = ("tgdsl", "robot", "sensors") if needs_sensors else ("tgdsl", "robot")
    spec = validate(source, (), model, problems, required)
    if spec is None:
        raise SpecError(problems)
    loaded = Loaded(spec, source, folder, None, problems)  # type: ignore[arg-type]
    loaded.layout = _layout(loaded)
    problems += reference_problems(loaded, kinds)
    warn_of_unusual(source, spec)
    if loaded.layout is not None and loaded.layout.source is not source:
        warn_of_unusual(loaded.layout.source, loaded.layout.spec)
    return loaded


def _with_upstream(written: Any, wanted: Collection[str], kinds: Sequence[Kind]) -> Collection[str]:
    """Return the names of sensors that are wanted and of all that they read, as the document has it, right or wrong."""
    by_name, found, waiting = {kind.name: kind for kind in kinds}, dict.fromkeys(wanted), list(wanted)
    own = written if isinstance(written, dict) else {}
    kind_of = {name: by_name.get(str(s.get("kind"))) if isinstance(s, dict) else None for name, s in own.items()}
    while waiting:
        name = waiting.pop()
        kind = kind_of.get(name)
        if kind is None or not kind.reads:
            continue
        named = own[name].get(kind.reads)
        every = [other for other, k in kind_of.items() if k is not None and k.provides]
        read = [other for other in (named if isinstance(named, list) else every) if other in own and other not in found]
        found |= dict.fromkeys(read)
        waiting += read
    return list(found)


def load_layout(path: Path) -> LoadedLayout:
    """Read a layout file by itself.

    Raises:
        SpecError: All its mistakes.
    """
    spec, source = read_spec(path, LayoutSpec, ("resolutions",))
    return LoadedLayout(spec, source, (), path.parent)


def read_spec(path: Path, model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read a file that holds one model and nothing else, and where its values stand.

    Args:
        path: The file.
        model: What it holds.
        required: Keys that it must have.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    return parse_spec(_content(path, str(path)), str(path), model, required)


def parse_spec(content: bytes, name: str, model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read what `read_spec` reads from a file's content, whose mistakes then go by a name.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    source = _source(content, name)
    problems = list(source.problems)
    spec = validate(source, (), model, problems, required=required)
    if problems or not isinstance(spec, model):
        raise SpecError(problems)
    return spec, source


def read_source(path: Path) -> Source:
    """Read a file's values and where they stand, as YAML; what they mean is not looked at.

    Raises:
        SpecError: If it cannot be read, or is no YAML.
    """
    return _read_file(path, str(path))


def _read_file(path: Path, name: str) -> Source:
    return _source(_content(path, name), name)


def _content(path: Path, name: str) -> bytes:
    """Return what is in a file, or as much of it as shows that it is too large."""
    if "\n" in name:
        raise SpecError(
            [Problem("<text>", 0, 0, "", "found YAML text, expected a file's name, or a mapping: `yaml.safe_load(text)`")]
        )
    if path.suffix.lower() in NO_DOCUMENTS:
        raise SpecError([Problem(name, 0, 0, "", f"this is {NO_DOCUMENTS[path.suffix.lower()]}, expected a YAML document")])
    try:
        with path.open("rb") as file:
            return file.read(yaml.MAX_BYTES + 1)
    except OSError as error:
        raise SpecError([Problem(name, 0, 0, "", f"cannot read this file: {error.strerror}")]) from error


def _source(content: bytes, name: str) -> Source:
    if large := yaml.too_large(content, name):
        raise SpecError([large])
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise SpecError([Problem(name, 0, 0, "", f"not UTF-8 text: byte {error.start} is {error.reason}")]) from error
    source = yaml.parse(text, name)
    if source.value is None:
        raise SpecError(source.problems or [Problem(name, 1, 1, "", "the document is empty")])
    return source


def _layout(loaded: Loaded) -> LoadedLayout | None:
    wanted = loaded.spec.robot.layout
    source, prefix, folder = loaded.source, ("robot", "layout"), loaded.folder
    if wanted is None or isinstance(wanted, str):
        path = _layout_file(loaded, wanted)
        if path is None:
            return None
        try:
            source, prefix, folder = _read_file(path, _display_name(path, loaded, wanted)), (), path.parent
        except SpecError as error:
            loaded.problems += error.problems
            return None
        loaded.problems += source.problems
    spec = validate(source, prefix, LayoutSpec, loaded.problems, required=("resolutions",))
    return LoadedLayout(spec, source, prefix, folder) if isinstance(spec, LayoutSpec) else None


def _layout_file(loaded: Loaded, wanted: str | None) -> Path | None:
    if wanted is not None:
        path = loaded.folder / wanted
        if find.is_file(path):
            return path
        hint = "paths are relative to this document"
        loaded.problems.append(loaded.source.problem(("robot", "layout"), f'there is no file "{wanted}"', hint))
        return None
    known = find.robot_names().get(loaded.spec.robot.model)
    if known is not None and (path := find.layout_file(known)) is not None:
        return path
    if loaded.is_without_layout:
        return None
    loaded.problems.append(
        loaded.source.problem(
            ("robot",), 'missing key "layout"', "only robots given by name bring their own layout", on_key=True
        )
    )
    return None


def _display_name(path: Path, loaded: Loaded, wanted: str | None) -> str:
    """Return the name a layout file has in messages: as the user would type it from where the document's name counts."""
    return str(path) if wanted is None else str(Path(loaded.source.file).parent / wanted)
