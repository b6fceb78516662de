"""From a document's text to its Spec: every mistake is found in one run and reported at its place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path as FilePath
from typing import Any, TypeVar

from pydantic import BaseModel

from tgdsl.errors import Problem, SpecError, TgdslError, did_you_mean
from tgdsl.files import find
from tgdsl.observations.proprioception import PROPRIOCEPTION
from tgdsl.schema import yaml
from tgdsl.schema.document import Spec, document_model
from tgdsl.schema.placement import LayoutSpec
from tgdsl.schema.unusual import warn_of_unusual
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Path, Source
from tgdsl.sensors import KINDS, Kind
from tgdsl.sensors.noise import PROFILES, NoiseSpec, resolve_noise

S = TypeVar("S", bound=BaseModel)


@dataclass
class LoadedLayout:
    """A layout, as found and as read. The paths of its problems start at `prefix`, which is not empty if it is in line."""

    spec: LayoutSpec
    source: Source
    prefix: Path
    folder: FilePath

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path of the layout."""
        return self.source.problem((*self.prefix, *path), what, hint, on_key)

    def raw(self, path: Path) -> Any:
        """Return the plain value at a path of the layout, or None."""
        return self.source.get((*self.prefix, *path))


@dataclass
class Loaded:
    """A document, as found and as read. With `problems`, faulty entries are left out of `spec`.

    Attributes:
        spec: The document.
        source: Its text's values and places.
        folder: Folder that file names in it are relative to.
        layout: Its layout; None if that could not be read.
        problems: Mistakes found so far; later stages add theirs.
    """

    spec: Spec
    source: Source
    folder: FilePath
    layout: LoadedLayout | None
    problems: list[Problem]

    @property
    def robot_file(self) -> FilePath | None:
        """The robot's model file, if it exists."""
        return find.robot_file(self.spec.robot.model, self.folder)

    @property
    def resolution(self) -> str | None:
        """The resolution that is compiled: the one named, or the only one."""
        if self.spec.resolution is not None or self.layout is None:
            return self.spec.resolution
        names = list(self.layout.spec.resolutions)
        return names[0] if len(names) == 1 else None

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path of the document."""
        return self.source.problem(path, what, hint, on_key)

    def raw(self, path: Path) -> Any:
        """Return the plain value at a path of the document, or None."""
        return self.source.get(path)

    def raise_problems(self) -> None:
        """Raise all mistakes found so far, if any."""
        if self.problems:
            raise SpecError(self.problems)


def load(
    document: str | PathLike[str] | Mapping[str, Any],
    overrides: Mapping[str, Any] | None = None,
    kinds: tuple[Kind, ...] = KINDS,
    needs_sensors: bool = True,
) -> Loaded:
    """Read a document and its layout.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        overrides: Values to set first by dotted path, as YAML text or plain, such as `{"resolution": "high"}`.
        kinds: The sensor kinds that the document may use.
        needs_sensors: Whether it is a mistake to have none.

    Returns:
        The document with the problems found so far: call `raise_problems` when all stages have added theirs.

    Raises:
        SpecError: If so much is wrong that no further stage can look at it.
        TgdslError: If the document is neither a file's name nor a mapping.
    """
    if not isinstance(document, (str, PathLike, Mapping)):
        raise TgdslError(f"a document is a YAML file's name or a mapping, found {type(document).__name__}")
    if isinstance(document, Mapping):
        source, folder = yaml.from_mapping(document, "<mapping>"), FilePath.cwd()
    else:
        source, folder = _read_file(FilePath(document), str(document)), FilePath(document).parent
    if source.value is None:
        raise SpecError(source.problems)
    for dotted, value in (overrides or {}).items():
        source.set(dotted, value)
    model = document_model(kinds, needs_sensors)
    problems = list(source.problems)
    required = ("tgdsl", "robot", "sensors") if needs_sensors else ("tgdsl", "robot")
    spec = validate(source, (), model, problems, required)
    if spec is None:
        raise SpecError(problems)
    loaded = Loaded(spec, source, folder, None, problems)  # type: ignore[arg-type]
    loaded.layout = _layout(loaded)
    problems += _name_problems(loaded, kinds)
    warn_of_unusual(source, spec)
    if loaded.layout is not None and loaded.layout.source is not source:
        warn_of_unusual(loaded.layout.source, loaded.layout.spec)
    return loaded


def load_layout(path: FilePath) -> LoadedLayout:
    """Read a layout file by itself.

    Raises:
        SpecError: All its mistakes.
    """
    spec, source = read_spec(path, LayoutSpec, ("resolutions",))
    return LoadedLayout(spec, source, (), path.parent)


def read_spec(path: FilePath, model: type[S], required: tuple[str, ...]) -> tuple[S, Source]:
    """Read a file that holds one model and nothing else, and where its values stand.

    Args:
        path: The file.
        model: What it holds.
        required: Keys that it must have.

    Raises:
        SpecError: All its mistakes, each at its place.
    """
    source = _read_file(path, str(path))
    problems = list(source.problems)
    spec = validate(source, (), model, problems, required=required)
    if problems or not isinstance(spec, model):
        raise SpecError(problems)
    return spec, source


def _read_file(path: FilePath, name: str) -> Source:
    try:
        with path.open("rb") as file:
            content = file.read(yaml.MAX_BYTES + 1)
        if large := yaml.too_large(content, name):
            raise SpecError([large])
        text = content.decode("utf-8")
    except OSError as error:
        raise SpecError([Problem(name, 0, 0, "", f"cannot read this file: {error.strerror}")]) from error
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


def _layout_file(loaded: Loaded, wanted: str | None) -> FilePath | None:
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
    loaded.problems.append(
        loaded.source.problem(
            ("robot",), 'missing key "layout"', "only robots given by name bring their own layout", on_key=True
        )
    )
    return None


def _display_name(path: FilePath, loaded: Loaded, wanted: str | None) -> str:
    """Return the name a layout file has in messages: as the user would type it from where the document's name counts."""
    return str(path) if wanted is None else str(FilePath(loaded.source.file).parent / wanted)


def _name_problems(loaded: Loaded, kinds: tuple[Kind, ...]) -> list[Problem]:
    """Return references within the document that lead nowhere, and knobs that a kind does not have."""
    by_name = {kind.name: kind for kind in kinds}
    problems: list[Problem] = []
    for name, sensor in loaded.spec.sensors.items():
        problems += _object_problems(loaded, name, sensor.feels)
        problems += _noise_problems(loaded, name, sensor.noise, by_name.get(getattr(sensor, "kind", "")))
    return problems + _observation_problems(loaded) + _resolution_problems(loaded)


def _names(loaded: Loaded, key: str) -> list[str] | None:
    """Return the names that the document gives, also those of faulty entries; None if that cannot be told."""
    found = loaded.source.value.get(key, {})
    return list(found) if isinstance(found, dict) else None


def _object_problems(loaded: Loaded, sensor: str, feels: tuple[str, ...]) -> list[Problem]:
    """Return what is wrong with the objects that a sensor feels: unknown ones, and those that are listed twice."""
    objects, problems = _names(loaded, "objects"), []
    for i, target in enumerate(feels):
        path: Path = ("sensors", sensor, "feels", i)
        if objects is not None and target not in objects:
            hint = did_you_mean(target, objects, "objects")
            problems.append(loaded.source.problem(path, f'unknown object "{target}"', hint))
        elif target in feels[:i]:
            problems.append(loaded.source.problem(path, f'object "{target}" is listed twice', "name it once"))
    return problems


def _observation_problems(loaded: Loaded) -> list[Problem]:
    """Return sensors that have the name of a reading that none makes, and observations of sensors that are not there."""
    source, sensors, problems = loaded.source, _names(loaded, "sensors") or [], []
    for name in PROPRIOCEPTION.keys() & set(sensors):
        what = f'"{name}" is the name of a reading that no sensor makes'
        problems.append(source.problem(("sensors", name), what, "give the sensor another name", on_key=True))
    for group in _names(loaded, "observations") or []:
        terms = source.get(("observations", group))
        for i, term in enumerate(terms if isinstance(terms, list) else []):
            target = term.get("of") if isinstance(term, dict) else None
            if isinstance(target, str) and target.split("/")[0] not in sensors:
                hint = did_you_mean(target, sensors, "sensors")
                if target in PROPRIOCEPTION:
                    hint = f"no sensor makes it: {{type: {target}}} observes it"
                problems.append(source.problem(("observations", group, i, "of"), f'unknown sensor "{target}"', hint))
    return problems


def _resolution_problems(loaded: Loaded) -> list[Problem]:
    """Return that the resolution is not one of the layout's, or that one must be named."""
    if loaded.layout is None:
        return []
    resolutions = list(loaded.layout.source.get((*loaded.layout.prefix, "resolutions")) or {})
    if loaded.resolution is None and loaded.source.get(("resolution",)) is None:
        hint = f"the layout has {', '.join(resolutions)}"
        return [loaded.source.problem((), 'missing key "resolution"', hint, on_key=True)]
    if loaded.resolution is not None and loaded.resolution not in resolutions:
        hint = did_you_mean(loaded.resolution, resolutions, "resolutions")
        return [loaded.source.problem(("resolution",), f'unknown resolution "{loaded.resolution}"', hint)]
    return []


def _noise_problems(loaded: Loaded, name: str, noise: str | NoiseSpec, kind: Kind | None) -> list[Problem]:
    """Return what is wrong with a sensor's noise: profiles that do not exist, and knobs that its kind does not have."""
    path: Path = ("sensors", name, "noise")
    chain, problem = _profiles(loaded, path, noise)
    if problem is not None:
        return [problem]
    if chain is None or kind is None:
        return []  # the profile itself, or all of them, have a mistake, which is reported there
    problems = []
    own = noise if isinstance(noise, NoiseSpec) else None
    base, links = resolve_noise(noise, kind.name, loaded.spec.noise)
    for pattern, knobs in [("", base), *links]:
        for knob in (knob for knob in knobs.active() if knob not in kind.knobs):
            what = f'"{kind.name}" has no knob "{knob}"'
            hint = f"it has {', '.join(sorted(kind.knobs))}"
            place = (*path, "links", pattern, knob) if pattern else (*path, knob)
            is_own = own is not None and (pattern in own.links if pattern else knob in own.model_fields_set)
            where = "" if is_own else f" (in the profile {' → '.join(chain)})"
            problems.append(loaded.source.problem(place if is_own else path, what + where, hint))
    return problems


def _profiles(loaded: Loaded, path: Path, noise: str | NoiseSpec) -> tuple[list[str] | None, Problem | None]:
    """Return the profiles that a sensor's noise leads to, one after the other; None if one of them has a mistake of its own."""
    found = loaded.source.value.get("noise", {})
    written = list(found) if isinstance(found, dict) else None
    chain: list[str] = []
    place, name = path, noise if isinstance(noise, str) else noise.like
    place = path if isinstance(noise, str) else (*path, "like")
    while True:
        if name in chain:
            return None, loaded.source.problem(place, "noise profiles lead in a circle", " → ".join([*chain, name]))
        chain.append(name)
        if name not in loaded.spec.noise:
            if name in PROFILES and (written is None or name not in written):
                return chain, None
            if written is None or name in written:
                return None, None
            hint = did_you_mean(name, [*written, *PROFILES], "noise profiles")
            return None, loaded.source.problem(place, f'unknown noise profile "{name}"', hint)
        place, name = ("noise", name, "like"), loaded.spec.noise[name].like
