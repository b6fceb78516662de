"""From a document's text to its Spec: every mistake is found in one run and reported at its place."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel

from tgdsl.errors import Problem, SpecError, TgdslError
from tgdsl.fields.materials import Material
from tgdsl.fields.models import Usual
from tgdsl.files import find
from tgdsl.schema import yaml
from tgdsl.schema.document import document_model
from tgdsl.schema.loaded import GIVEN, Loaded, LoadedLayout
from tgdsl.schema.placement import LayoutSpec
from tgdsl.schema.references import reference_problems
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Path as Place
from tgdsl.schema.yaml import Source
from tgdsl.sensors import KINDS, Kind


def warn_of_unusual(source: Source, spec: BaseModel) -> None:
    """Warn of each unusual value, at its place.

    Args:
        source: A document, or a file of its own, as found.
        spec: What it was read as.
    """
    found = {}
    for path, usual, value in _marked(spec, ()):
        if (problem := usual.doubt(value)) is not None:
            path = _place(source, path)
            found[path, problem] = str(source.problem(path, *problem))
    for message in found.values():
        warnings.warn(message, stacklevel=4)


def _place(source: Source, path: Place) -> Place:
    """Return where a value stands in the file: a number may stand for a range, and a region for a list of one."""
    shorter = [path[:i] + path[i + 1 :] for i, part in enumerate(path) if isinstance(part, int)]
    for place in (path, *reversed(shorter)):
        if source.get(place) is not None:
            return place
    while path and source.get(path) is None:
        path = path[:-1]
    return path


def _marked(value: object, path: Place) -> Iterator[tuple[Place, Usual, float]]:
    """Yield the numbers of all fields that are marked, their places and marks."""
    if isinstance(value, (BaseModel, Material)):
        for name, metadata in _fields(value):
            inner = getattr(value, name)
            usual = next((part for part in metadata if isinstance(part, Usual)), None)
            if usual is None or isinstance(inner, BaseModel):
                yield from _marked(inner, (*path, name))
            else:
                yield from ((place, usual, number) for place, number in _numbers(inner, (*path, name)))
    elif isinstance(value, (tuple, list)):
        for i, part in enumerate(value):
            yield from _marked(part, (*path, i))
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _marked(part, (*path, name))


def _fields(value: BaseModel | Material) -> Iterator[tuple[str, Sequence[object]]]:
    """Yield the fields of a model, or of a material that it was read as, and what is said of each."""
    if isinstance(value, BaseModel):
        yield from ((name, field.metadata) for name, field in type(value).model_fields.items())
    else:
        hints = get_type_hints(type(value), include_extras=True)
        yield from ((name, getattr(hint, "__metadata__", ())) for name, hint in hints.items())


def _numbers(value: object, path: Place) -> Iterator[tuple[Place, float]]:
    if isinstance(value, (int, float)):
        yield path, float(value)
    elif isinstance(value, (tuple, list)):
        for i, part in enumerate(value):
            yield from _numbers(part, (*path, i))


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
    has_scene: bool = False,
) -> Loaded:
    """Read a document and its layout.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        overrides: Values to set first by dotted path, as YAML text or plain, such as `{"resolution": "high"}`.
        kinds: The sensor kinds that the document may use.
        needs_sensors: Whether it is a mistake to have none.
        sensors: Names of those that are wanted, the others being left out but for those that they read; default: all.
        has_scene: Whether a scene is given: the document then needs no model.

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
        problem = "this is a task's document, expected one of sensors"
        hint = f"its own is {source.value['document']}" if "document" in source.value else ""
        raise SpecError([source.problem(("task",), problem, hint, on_key=True)])
    for dotted, value in (overrides or {}).items():
        source.set(dotted, value)
    if has_scene and source.get(("robot", "model")) is None:
        source.set("robot.model", GIVEN)
    if sensors is not None:
        source.keep("sensors", _with_upstream(source.value.get("sensors"), sensors, kinds))
    model = document_model(kinds, needs_sensors)
    problems = list(source.problems)
    required = ("tgdsl", "robot", "sensors") if needs_sensors else ("tgdsl", "robot")
    spec = validate(source, (), model, problems, required)
    if spec is None:
        raise SpecError(problems)
    loaded = Loaded(spec=spec, source=source, folder=folder, problems=problems)  # type: ignore[arg-type]
    loaded.layout = _layout(loaded)
    problems += reference_problems(loaded, kinds)
    warn_of_unusual(source, spec)
    if loaded.layout is not None and loaded.layout.source is not source:
        warn_of_unusual(loaded.layout.source, loaded.layout.spec)
    return loaded


def _with_upstream(written: Any, wanted: Collection[str], kinds: Sequence[Kind]) -> Collection[str]:
    """Return the names of sensors that are wanted and of all that they read, as the document has it, right or wrong."""
    by_name, result, waiting = {kind.name: kind for kind in kinds}, dict.fromkeys(wanted), list(wanted)
    own = written if isinstance(written, dict) else {}
    kind_of = {name: by_name.get(str(s.get("kind"))) if isinstance(s, dict) else None for name, s in own.items()}
    while waiting:
        name = waiting.pop()
        kind = kind_of.get(name)
        if kind is None or not kind.reads:
            continue
        named = own[name].get(kind.reads)
        every = [other for other, k in kind_of.items() if k is not None and k.provides]
        read = [other for other in (named if isinstance(named, list) else every) if other in own and other not in result]
        result |= dict.fromkeys(read)
        waiting += read
    return list(result)


def load_layout(path: Path) -> LoadedLayout:
    """Read a layout file by itself.

    Raises:
        SpecError: All its mistakes.
    """
    spec, source = read_spec(path, LayoutSpec, ("resolutions",))
    return LoadedLayout(spec=spec, source=source, folder=path.parent, problems=[])


def read_spec(document: Path | Mapping[str, Any], model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read a file that holds one model and nothing else, and where its values stand.

    Args:
        document: The file, or the same as a mapping.
        model: What it holds.
        required: Keys that it must have.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    if isinstance(document, Mapping):
        return parse_spec(document, "<mapping>", model, required)
    return parse_spec(_content(document, str(document)), str(document), model, required)


def parse_spec(content: bytes | Mapping[str, Any], name: str, model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read what `read_spec` reads from a file's content, or from a mapping; mistakes then go by a name.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    source = yaml.from_mapping(content, name) if isinstance(content, Mapping) else _source(content, name)
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
    if not isinstance(spec, LayoutSpec):
        return None
    return LoadedLayout(spec=spec, source=source, folder=folder, problems=loaded.problems, prefix=prefix)


def _layout_file(loaded: Loaded, wanted: str | None) -> Path | None:
    if wanted is not None:
        path = loaded.folder / wanted
        if find.is_file(path):
            return path
        hint = "paths are relative to this document"
        loaded.note(("robot", "layout"), f'there is no file "{wanted}"', hint)
        return None
    known = find.robot_names().get(loaded.spec.robot.model)
    if known is not None and (path := find.layout_file(known)) is not None:
        return path
    if loaded.is_without_layout:
        return None
    loaded.note(("robot",), 'missing key "layout"', "only robots given by name bring their own layout", on_key=True)
    return None


def _display_name(path: Path, loaded: Loaded, wanted: str | None) -> str:
    return str(path) if wanted is None else str(Path(loaded.source.file).parent / wanted)
