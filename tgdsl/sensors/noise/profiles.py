"""The knobs of all stages together, and the profiles that name a set of them.

Any number may be a range `[low, high]`: each environment then draws its own at reset, uniformly. An amplitude is in the unit of
the reading and may be a mapping from its quantities: `white_noise: {force: 5e-3, torque: 1e-4}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, ClassVar

from pydantic import Tag, create_model

from tgdsl.fields.models import TEXT_OR_OTHER, SpecModel, Text
from tgdsl.sensors.noise.spec import ZERO
from tgdsl.sensors.noise.stages import STAGES


class Knobs(*(stage.Knobs for stage in reversed(STAGES))):  # pydantic collects fields from the last base on
    """All knobs; the defaults are neutral."""

    plain: ClassVar[type[Knobs]]
    """The model with these knobs and nothing else."""

    def over(self, base: Knobs) -> Knobs:
        """Return other knobs, overridden by the fields that were set here."""
        model = max(self.plain, base.plain, key=lambda model: len(model.model_fields))
        values = {
            name: getattr(knobs, name)
            for knobs in (base, self)
            for name in knobs.plain.model_fields
            if name in knobs.model_fields_set
        }
        return model.model_construct(_fields_set=set(values), **{**model.defaults(), **values})

    def active(self) -> tuple[str, ...]:
        """Return the names of the knobs that are not at their neutral value, in the order of the stages."""
        neutral = self.plain.defaults()
        return tuple(name for name, value in neutral.items() if _plain(getattr(self, name)) != _plain(value))

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the neutral values of all knobs."""
        return {name: field.default for name, field in cls.plain.model_fields.items()}


Knobs.plain = Knobs


class NoiseSpec(Knobs):
    """Knobs of a sensor on top of a profile, and other knobs on some links."""

    like: Text = "clean"
    """Profile that gives the default of each knob."""
    links: dict[str, Knobs] = {}
    """Knobs of some links, by name, wildcard or group; of several that match, the later one counts."""


NoiseField = Annotated[Text | Annotated[NoiseSpec, Tag("other")], TEXT_OR_OTHER]  # a profile's name, or knobs in line


@cache
def noise_model(more: tuple[type[SpecModel], ...]) -> type[NoiseSpec]:
    """Return `NoiseSpec` with more knobs."""
    if not more:
        return NoiseSpec
    parts: tuple[Any, ...] = tuple(reversed(more))
    knobs: Any = create_model("Knobs", __base__=(*parts, Knobs), __doc__=Knobs.__doc__)
    knobs.plain = knobs
    links = (dict[str, knobs], NoiseSpec.model_fields["links"])
    spec: Any = create_model("NoiseSpec", __base__=(*parts, NoiseSpec), __doc__=NoiseSpec.__doc__, links=links)
    spec.plain = knobs
    return spec


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: part for name, part in value.items() if part != ZERO}
    return tuple(_plain(part) for part in value) if isinstance(value, tuple) else value


_COMMON: dict[str, Any] = {
    "radius_noise": 3e-4,
    "dead_probability": 0.05,
    "gain": [0.85, 1.15],
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
}
_FORCES: dict[str, Any] = {**_COMMON, "white_noise": 5e-3, "drift": 1e-4, "quantization": 1e-2}

PROFILES: dict[str, dict[str, Knobs]] = {
    "clean": {},
    "noisy": {
        "contact": Knobs.model_validate({"release_threshold": 2e-4, "dead_probability": 0.05}),
        "contact_depth": Knobs.model_validate({**_COMMON, "white_noise": 2e-4, "quantization": 1e-4}),
        "kinematic_taxel": Knobs.model_validate(_FORCES),
        "force_taxel": Knobs.model_validate({**_FORCES, "radius_noise": 0.0}),
        "proximity": Knobs.model_validate(
            {**_COMMON, "radius_noise": 6e-4, "white_noise": 1e-2, "drift": 1e-3, "quantization": 1e-2}
        ),
        "elastomer": Knobs.model_validate({**_COMMON, "white_noise": 1e-4, "drift": 1e-5, "quantization": 1e-4}),
    },
}
"""Built-in profiles: knobs by sensor kind, none for a kind not named. `noisy` is the paper's noisy condition (Chung et al.,
*Tactile Genesis*, appendix, table of sensor imperfection parameters). `force_taxel`, which is not in the paper, takes the
values of its forces, without radius noise: its sum is the solver's at any radius."""


def resolve_noise(
    noise: str | NoiseSpec, kind: str, named: Mapping[str, NoiseSpec], seen: tuple[str, ...] = ()
) -> tuple[Knobs, tuple[tuple[str, Knobs], ...]]:
    """Return the knobs of a sensor, and of some links by pattern; of several that match a link, the last one counts.

    Args:
        noise: A profile of the document, a built-in one, or knobs in line.
        kind: The sensor's kind.
        named: The profiles of the document.
        seen: Profiles that led here.

    Raises:
        KeyError: If there is no profile of that name, or profiles refer to one another in a circle.
    """
    if isinstance(noise, str):
        if noise in seen:
            raise KeyError(noise)
        if noise not in named:
            return PROFILES[noise].get(kind, Knobs()), ()
        return resolve_noise(named[noise], kind, named, (*seen, noise))
    base, links = resolve_noise(noise.like, kind, named, seen)
    return noise.over(base), (*links, *noise.links.items())


def built_in(noise: str | NoiseSpec, named: Mapping[str, NoiseSpec]) -> str:
    """Return the built-in profile at the end of the chain of `like`, which must not be a circle."""
    while not isinstance(noise, str) or noise in named:
        noise = named[noise] if isinstance(noise, str) else noise.like
    return noise
