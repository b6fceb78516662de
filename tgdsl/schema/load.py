"""From a document's text to its Spec: all mistakes are reported in one run, each at its place."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path as FilePath
from typing import Any, TypeVar, get_type_hints

from pydantic import BaseModel

from tgdsl.errors import LowerError, Problem, SpecError, TgdslError, did_you_mean
from tgdsl.fields.materials import Material
from tgdsl.fields.models import Usual
from tgdsl.files import find
from tgdsl.observations.observations import PROPRIOCEPTION
from tgdsl.plan.scene import Collider
from tgdsl.schema.document import Spec, document_model
from tgdsl.schema.objects import CollidersSpec
from tgdsl.schema.placement import LayoutSpec
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Path, Source, from_mapping, parse
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.noise import PROFILES, NoiseSpec, resolve_noise
from tgdsl.sensors.noise.pipeline import knobs_of

S = TypeVar("S", bound=BaseModel)
GIVEN = "<scene>"  # the robot's model of a document that names none, where a scene is given
ROBOT = "a robot or scene file, which a document names: `robot: {model: …}`"
# descriptions of files that are not YAML documents, by ending
NO_DOCUMENTS = {
    ".safetensors": "an artefact, which `tgdsl.load` reads",
    ".pt": "a policy or checkpoint",
    **dict.fromkeys((".xml", ".mjcf", ".urdf", ".xacro", ".usd", ".usda", ".usdc", ".usdz"), ROBOT),
}


@dataclass(kw_only=True)
class Section:
    """A document, or its layout, as read, and its mistakes so far."""

    source: Source  # its text's values and places
    folder: FilePath  # folder that file names in it are relative to
    problems: list[Problem]  # mistakes found so far, of the document and its layout; later stages add theirs
    prefix: Path = ()  # path of the section in the source, such as of an inline layout in its document

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path."""
        return self.source.problem((*self.prefix, *path), what, hint, on_key)

    def note(self, path: Path, problem: str | LowerError, hint: str = "", on_key: bool = False) -> None:
        """Note a mistake at a path; a `LowerError` at the field that it names."""
        if isinstance(problem, LowerError):
            path, problem, hint = (*path, *([problem.field] if problem.field else [])), problem.what, problem.hint
        self.problems.append(self.problem(path, problem, hint, on_key))

    def raw(self, path: Path) -> Any:
        """Return the plain value at a path, or None."""
        return self.source.get((*self.prefix, *path))


@dataclass(kw_only=True)
class LoadedLayout(Section):
    """A layout, as read."""

    spec: LayoutSpec


@dataclass(kw_only=True)
class Loaded(Section):
    """A document, as read. With `problems`, faulty entries are left out of `spec`."""

    spec: Spec
    layout: LoadedLayout | None = None  # None if it could not be read, or if the document `is_without_layout`

    @property
    def robot_file(self) -> FilePath | None:
        """The robot's model file, if it exists."""
        return find.robot_file(self.spec.robot.model, self.folder)

    @property
    def is_without_layout(self) -> bool:
        """Whether it has no layout and needs none: none of its sensors reads taxels, and all are on bodies of the robot."""
        sensors = self.spec.sensors.values()
        is_none = self.layout is None and self.spec.robot.layout is None and bool(sensors)
        return is_none and not any(sensor.needs_taxels for sensor in sensors)

    @property
    def resolution(self) -> str | None:
        """The resolution to compile: the document's, or the layout's only one."""
        if self.spec.resolution is not None or self.layout is None:
            return self.spec.resolution
        names = list(self.layout.spec.resolutions)
        return names[0] if len(names) == 1 else None

    def raise_problems(self) -> None:
        """Raise all mistakes found so far, if any."""
        if self.problems:
            raise SpecError(self.problems)


def load(
    document: str | PathLike[str] | Mapping[str, Any],
    overrides: Mapping[str, Any] | None = None,
    kinds: tuple[Kind, ...] = KINDS,
    needs_sensors: bool = True,
    sensors: Collection[str] | None = None,
    has_scene: bool = False,
) -> Loaded:
    """Read a document and its layout, with the problems found so far: call `raise_problems` when all stages have added theirs.

    File names in a mapping are relative to the working folder. `overrides` are set first, by dotted path, as YAML text or
    plain. `sensors` names the sensors to keep, with the sensors that they read; default: all. `has_scene`: a scene is given,
    and the document needs no model.

    Raises:
        SpecError: If the document is too faulty for further stages.
        TgdslError: If the document is neither a file's name nor a mapping.
    """
    if not isinstance(document, (str, PathLike, Mapping)):
        raise TgdslError(f"a document is a YAML file's name or a mapping, found {type(document).__name__}")
    if isinstance(document, Mapping):
        source, folder = from_mapping(document, "<mapping>"), FilePath.cwd()
    else:
        source, folder = read_source(FilePath(document), str(document)), FilePath(document).parent
    if isinstance(source.value, dict) and "task" in source.value and "sensors" not in source.value:
        hint = f"its sensors are in {source.value['document']}: name that file" if "document" in source.value else ""
        raise SpecError([source.problem(("task",), "this is a task's document, expected one of sensors", hint, on_key=True)])
    for dotted, value in (overrides or {}).items():
        source.set(dotted, value)
    if has_scene and source.get(("robot", "model")) is None:
        source.set("robot.model", GIVEN)
    if sensors is not None:
        source.keep("sensors", _with_upstream(source.get(("sensors",)), sensors, kinds))
    problems = list(source.problems)
    required = ("tgdsl", "robot", "sensors") if needs_sensors else ("tgdsl", "robot")
    spec = validate(source, (), document_model(kinds, needs_sensors), problems, required)
    problems = source.hinted(problems)
    if spec is None:
        raise SpecError(problems)
    loaded = Loaded(spec=spec, source=source, folder=folder, problems=problems)
    loaded.layout = _layout(loaded)
    _check_references(loaded, kinds)
    warn_of_unusual(source, spec)
    if loaded.layout is not None and loaded.layout.source is not source:
        warn_of_unusual(loaded.layout.source, loaded.layout.spec)
    return loaded


def _with_upstream(written: Any, names: Collection[str], kinds: Sequence[Kind]) -> Collection[str]:
    """Return the names of some sensors and of all sensors that they read, according to the document, valid or not."""
    by_name, result, waiting = {kind.name: kind for kind in kinds}, dict.fromkeys(names), list(names)
    sensors = written if isinstance(written, dict) else {}
    kind_of = {name: by_name.get(str(s.get("kind"))) if isinstance(s, dict) else None for name, s in sensors.items()}
    while waiting:
        name = waiting.pop()
        kind = kind_of.get(name)
        if kind is None or not kind.reads:
            continue
        named = sensors[name].get(kind.reads)
        every = [other for other, k in kind_of.items() if k is not None and k.provides]
        read = [other for other in (named if isinstance(named, list) else every) if other in sensors and other not in result]
        result |= dict.fromkeys(read)
        waiting += read
    return list(result)


def read_source(path: FilePath, name: str = "") -> Source:
    """Read a YAML file's values and their places; `name` is its name in messages, by default its path."""
    return _source(_content(path, name or str(path)), name or str(path))


def _content(path: FilePath, name: str) -> bytes:
    if "\n" in name:
        problem = "found YAML text, expected a file's name, or a mapping: `yaml.safe_load(text)`"
        raise SpecError([Problem("<text>", 0, 0, "", problem)])
    if path.suffix.lower() in NO_DOCUMENTS:
        raise SpecError([Problem(name, 0, 0, "", f"this is {NO_DOCUMENTS[path.suffix.lower()]}, expected a YAML document")])
    try:
        return path.read_bytes()
    except OSError as error:
        raise SpecError([Problem(name, 0, 0, "", f"cannot read this file: {error.strerror}")]) from error


def _source(content: bytes, name: str) -> Source:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise SpecError([Problem(name, 0, 0, "", f"not UTF-8 text: byte {error.start} is {error.reason}")]) from error
    source = parse(text, name)
    if source.value is None:
        raise SpecError(source.problems or [Problem(name, 1, 1, "", "the document is empty")])
    return source


def read_spec(document: FilePath | Mapping[str, Any], model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read one model with the `required` keys from a file or a mapping; return it with the places of its values."""
    if isinstance(document, Mapping):
        return parse_spec(document, "<mapping>", model, required)
    return parse_spec(_content(document, str(document)), str(document), model, required)


def parse_spec(content: bytes | Mapping[str, Any], name: str, model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read a model as `read_spec` does, from a file's content or a mapping; mistakes are reported under `name`."""
    source = from_mapping(content, name) if isinstance(content, Mapping) else _source(content, name)
    problems = list(source.problems)
    spec = validate(source, (), model, problems, required=required)
    if problems or spec is None:
        raise SpecError(problems)
    return spec, source


def load_layout(path: FilePath) -> LoadedLayout:
    """Read a layout file.

    Raises:
        SpecError: All its mistakes.
    """
    spec, source = read_spec(path, LayoutSpec, ("resolutions",))
    return LoadedLayout(spec=spec, source=source, folder=path.parent, problems=[])


def load_colliders(file: FilePath) -> tuple[Collider, ...]:
    """Return the primitive colliders of a robot's links, body by body, from the file next to its model."""
    spec, _ = read_spec(file, CollidersSpec, ("tgdsl", "bodies"))
    return tuple(
        Collider(body, part.type, part.size, part.pos, part.quat, part.core)
        for body, parts in spec.bodies.items()
        for part in parts
    )


def _layout(loaded: Loaded) -> LoadedLayout | None:
    written = loaded.spec.robot.layout
    source, prefix, folder = loaded.source, ("robot", "layout"), loaded.folder
    if written is None or isinstance(written, str):
        path = _layout_file(loaded, written)
        if path is None:
            return None
        # Its name in messages is relative to the same folder as the document's.
        name = str(path) if written is None else str(FilePath(loaded.source.file).parent / written)
        try:
            source, prefix, folder = read_source(path, name), (), path.parent
        except SpecError as error:
            loaded.problems += error.problems
            return None
        loaded.problems += source.problems
    spec = validate(source, prefix, LayoutSpec, loaded.problems, required=("resolutions",))
    if spec is None:
        return None
    return LoadedLayout(spec=spec, source=source, folder=folder, problems=loaded.problems, prefix=prefix)


def _layout_file(loaded: Loaded, wanted: str | None) -> FilePath | None:
    if wanted is not None:
        path = loaded.folder / wanted
        if find.is_file(path):
            return path
        loaded.note(("robot", "layout"), f'there is no file "{wanted}"', "paths are relative to this document")
        return None
    model_file = find.robot_names().get(loaded.spec.robot.model)
    if model_file is not None and (path := find.layout_file(model_file)) is not None:
        return path
    if not loaded.is_without_layout:
        loaded.note(("robot",), 'missing key "layout"', "only robots given by name bring their own layout", on_key=True)
    return None


def _check_references(loaded: Loaded, kinds: tuple[Kind, ...]) -> None:
    """Note broken references within the document, and knobs that a kind does not have."""
    by_name, objects = {kind.name: kind for kind in kinds}, _names(loaded, "objects")
    for name, sensor in loaded.spec.sensors.items():
        for i, target in enumerate(sensor.objects):
            path: Path = ("sensors", name, "feels", i)
            if objects is not None and target not in objects:
                loaded.note(path, f'unknown object "{target}"', did_you_mean(target, objects, "objects"))
            elif target in sensor.objects[:i]:
                loaded.note(path, f'object "{target}" is listed twice', "name it once")
        _check_noise(loaded, name, sensor.noise, by_name.get(getattr(sensor, "kind", "")))
    _check_observations(loaded)
    _check_resolution(loaded)


def _names(loaded: Loaded, key: str) -> list[str] | None:
    """Return the entries' names, faulty entries included; None if the section is not a mapping."""
    result = loaded.source.value.get(key, {})
    return list(result) if isinstance(result, dict) else None


def _check_observations(loaded: Loaded) -> None:
    """Note sensors with the name of a proprioceptive reading, and observations of unknown sensors."""
    sensors = _names(loaded, "sensors") or []
    for name in PROPRIOCEPTION.keys() & set(sensors):
        problem = f'"{name}" is the name of a reading that no sensor makes'
        loaded.note(("sensors", name), problem, "give the sensor another name", on_key=True)
    for group in _names(loaded, "observations") or []:
        terms = loaded.raw(("observations", group))
        for i, term in enumerate(terms if isinstance(terms, list) else []):
            target = term.get("of") if isinstance(term, dict) else None
            if isinstance(target, str) and target.split("/")[0] not in sensors:
                hint = did_you_mean(target, sensors, "sensors")
                if target in PROPRIOCEPTION:
                    hint = f"no sensor makes it: {{type: {target}}} observes it"
                loaded.note(("observations", group, i, "of"), f'unknown sensor "{target}"', hint)


def _check_resolution(loaded: Loaded) -> None:
    """Note an unknown resolution, or a missing one."""
    named, path = loaded.resolution, ("resolution",)
    if loaded.is_without_layout and named is not None:
        problem = f'there is no layout, which could have a resolution "{named}"'
        loaded.note(path, problem, "leave it out, or give the robot a layout")
    elif loaded.layout is not None:
        resolutions = list(loaded.layout.raw(("resolutions",)) or {})
        if named is None and loaded.raw(path) is None:
            loaded.note((), 'missing key "resolution"', f"the layout has {', '.join(resolutions)}", on_key=True)
        elif named is not None and named not in resolutions:
            loaded.note(path, f'unknown resolution "{named}"', did_you_mean(named, resolutions, "resolutions"))


def _check_noise(loaded: Loaded, name: str, noise: str | NoiseSpec, kind: Kind | None) -> None:
    """Note mistakes of a sensor's noise: unknown profiles, and knobs that its kind does not have."""
    path: Path = ("sensors", name, "noise")
    chain = _profiles(loaded, path, noise)
    if chain is None or kind is None:
        return
    inline = noise if isinstance(noise, NoiseSpec) else None
    base, links = resolve_noise(noise, kind.name, loaded.spec.noise)
    kind_knobs = knobs_of(kind.knobs)
    for pattern, knobs in [("", base), *links]:
        for knob in (knob for knob in knobs.active() if knob not in kind_knobs):
            problem, hint = f'"{kind.name}" has no knob "{knob}"', f"it has {', '.join(sorted(kind_knobs)) or 'none'}"
            if inline is not None and (pattern in inline.links if pattern else knob in inline.model_fields_set):
                loaded.note((*path, "links", pattern, knob) if pattern else (*path, knob), problem, hint)
            else:
                loaded.note(path, f"{problem} (in the profile {' → '.join(chain)})", hint)


def _profiles(loaded: Loaded, path: Path, noise: str | NoiseSpec) -> list[str] | None:
    """Return the chain of profiles of a sensor's noise; None after a mistake, which is noted."""
    written, chain = _names(loaded, "noise"), []
    place, name = (path, noise) if isinstance(noise, str) else ((*path, "like"), noise.like)
    while True:
        if name in chain:
            loaded.note(place, "noise profiles lead in a circle", " → ".join([*chain, name]))
            return None
        chain.append(name)
        if name not in loaded.spec.noise:
            if name in PROFILES and (written is None or name not in written):
                return chain
            if written is not None and name not in written:
                hint = did_you_mean(name, [*written, *PROFILES], "noise profiles")
                loaded.note(place, f'unknown noise profile "{name}"', hint)
            return None
        place, name = ("noise", name, "like"), loaded.spec.noise[name].like


def warn_of_unusual(source: Source, spec: BaseModel) -> None:
    """Warn of each unusual value of a document, read as `spec`, at its place."""
    messages = {}
    for path, usual, value in _marked(spec, (), None):
        if (problem := usual.doubt(value)) is not None:
            path = _place(source, path)
            messages[path, problem] = str(source.problem(path, *problem))
    for message in messages.values():
        warnings.warn(message, stacklevel=4)


def _place(source: Source, path: Path) -> Path:
    """Return a value's path in the file, where a number may abbreviate a range, and a region a list of one."""
    shorter = [path[:i] + path[i + 1 :] for i, part in enumerate(path) if isinstance(part, int)]
    nearer = [path[:i] for i in range(len(path) - 1, 0, -1)]
    return next((place for place in (path, *reversed(shorter), *nearer) if source.get(place) is not None), ())


def _marked(value: object, path: Path, mark: Usual | None) -> Iterator[tuple[Path, Usual, float]]:
    """Yield the places, marks and values of all marked numbers."""
    if isinstance(value, (int, float)) and mark is not None:
        yield path, mark, float(value)
    elif isinstance(value, BaseModel):
        for name, field in type(value).model_fields.items():
            yield from _marked(getattr(value, name), (*path, name), _mark(field.metadata))
    elif isinstance(value, Material):
        for name, hint in get_type_hints(type(value), include_extras=True).items():
            yield from _marked(getattr(value, name), (*path, name), _mark(getattr(hint, "__metadata__", ())))
    elif isinstance(value, (tuple, list)):
        for i, part in enumerate(value):
            yield from _marked(part, (*path, i), mark)
    elif isinstance(value, Mapping):
        for name, part in value.items():
            yield from _marked(part, (*path, name), mark)


def _mark(metadata: Sequence[object]) -> Usual | None:
    return next((part for part in metadata if isinstance(part, Usual)), None)
