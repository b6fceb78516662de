"""Names in a document that must be names of something in it: objects, sensors, noise profiles, the resolution."""

from __future__ import annotations

from tgdsl.errors import Problem, did_you_mean
from tgdsl.observations.proprioception import PROPRIOCEPTION
from tgdsl.schema.loaded import Loaded
from tgdsl.schema.yaml import Path
from tgdsl.sensors import Kind
from tgdsl.sensors.noise import PROFILES, NoiseSpec, resolve_noise
from tgdsl.sensors.noise.pipeline import knobs_of


def reference_problems(loaded: Loaded, kinds: tuple[Kind, ...]) -> list[Problem]:
    """Return references within the document that lead nowhere, and knobs that a kind does not have."""
    by_name = {kind.name: kind for kind in kinds}
    problems: list[Problem] = []
    for name, sensor in loaded.spec.sensors.items():
        problems += _object_problems(loaded, name, sensor.objects)
        problems += _noise_problems(loaded, name, sensor.noise, by_name.get(getattr(sensor, "kind", "")))
    return problems + _observation_problems(loaded) + _resolution_problems(loaded)


def _names(loaded: Loaded, key: str) -> list[str] | None:
    result = loaded.source.value.get(key, {})
    return list(result) if isinstance(result, dict) else None


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
        problem = f'"{name}" is the name of a reading that no sensor makes'
        problems.append(source.problem(("sensors", name), problem, "give the sensor another name", on_key=True))
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
    if loaded.is_without_layout and loaded.resolution is not None:
        problem = f'there is no layout, which could have a resolution "{loaded.resolution}"'
        return [loaded.source.problem(("resolution",), problem, "leave it out, or give the robot a layout")]
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
    known = knobs_of(kind.knobs)
    for pattern, knobs in [("", base), *links]:
        for knob in (knob for knob in knobs.active() if knob not in known):
            what = f'"{kind.name}" has no knob "{knob}"'
            hint = f"it has {', '.join(sorted(known)) or 'none'}"
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
