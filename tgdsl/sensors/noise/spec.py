"""The knobs of a sensor's imperfections, and the profiles that name a set of them. What each does is in `stages`.

Any number may be a range `[low, high]`: each environment then draws its own at reset, uniformly. Amplitudes are in the unit of
the reading, and may be given for each of its quantities: `white_noise: {force: 5e-3, torque: 1e-4}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Tag, model_validator

from tgdsl.fields.models import TEXT_OR_OTHER, Range, RangeOf, SpecModel, Text, Usual

Amplitude = Mapping[str, Range]
"""A range for each quantity of a reading, or under `ALL` for every one."""
ALL = "*"


class AmplitudeOf(RangeOf):
    """Marks a range that may also be a mapping from quantities to ranges."""

    def _read(self, found: object) -> Any:
        if not isinstance(found, Mapping):
            return {ALL: super()._read(found)}
        read = {}
        for name, part in found.items():
            try:
                read[str(name)] = super()._read(part)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        return read

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a range, or a mapping of ranges."""
        one = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [*one["anyOf"], {"type": "object", "additionalProperties": one}]}


class ProbabilityRange(RangeOf):
    """Marks a share from 0 to 1, or a range of it."""

    def __init__(self) -> None:
        super().__init__("number", ge=0.0)

    def _read(self, found: object) -> Any:
        low, high = super()._read(found)
        if high > 1:
            raise ValueError(f"{high:g} is out of range, expected at most 1")
        return low, high

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a number up to 1, or a list of two."""
        one = {"type": "number", "minimum": 0.0, "maximum": 1.0}
        return {"anyOf": [one, {"type": "array", "items": one, "minItems": 2, "maxItems": 2}]}


AnyAmplitude = Annotated[Amplitude, AmplitudeOf("number")]
NonNegativeAmplitude = Annotated[Amplitude, AmplitudeOf("number", ge=0.0)]
TimeRange = Annotated[Range, RangeOf("time", ge=0.0)]
Share = Annotated[Range, ProbabilityRange()]
ZERO: Range = (0.0, 0.0)
NO_AMPLITUDE: Amplitude = {ALL: ZERO}


class Hysteresis(SpecModel):
    """Viscoelastic memory of the substrate: one Maxwell branch."""

    strength: Annotated[Range, RangeOf("number", ge=0.0)]
    """β, overshoot after a step, as a share of the step."""
    time_constant: Annotated[Range, RangeOf("time", gt=0.0), Usual("time", high=3600.0)]
    """τ, time constant of the decay [s]."""


class Crosstalk(SpecModel):
    """Mixing of neighbouring taxels of a link; the sum over its taxels stays what it is."""

    strength: Share
    """χ, share of each taxel's signal that goes to its neighbourhood."""
    sigma: Annotated[Range, RangeOf("length", gt=0.0), Usual("length", high=0.1)]
    """Standard deviation of the Gaussian neighbourhood [m]."""


class Knobs(SpecModel):
    """All knobs; the defaults are neutral."""

    radius_noise: Annotated[Range, RangeOf("length", ge=0.0), Usual("length", high=0.1)] = ZERO
    """ρ, half-width of the uniform disturbance of each probe's radius, drawn at each reading [m]."""
    gain: tuple[Annotated[Range, RangeOf("number", gt=0.0)], Annotated[Range, RangeOf("number", gt=0.0)]] = (
        (1.0, 1.0),
        (1.0, 1.0),
    )
    """Lowest and highest gain: each probe draws its own at reset."""
    hysteresis: Hysteresis | None = None
    """Viscoelastic memory."""
    crosstalk: Crosstalk | None = None
    """Mixing of neighbouring taxels."""
    read_delay: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
    """Age of what is read [s]; between two calls the signal counts as linear."""
    jitter: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
    """Largest additional age, drawn uniformly at each reading for all taxels together [s]."""
    bias: AnyAmplitude = NO_AMPLITUDE
    """Constant offset [unit of the reading]."""
    white_noise: NonNegativeAmplitude = NO_AMPLITUDE
    """σ, standard deviation of additive Gaussian noise [unit of the reading]."""
    drift: NonNegativeAmplitude = NO_AMPLITUDE
    """Standard deviation of the random walk's step at each reading [unit of the reading]; the walk starts at reset."""
    quantization: NonNegativeAmplitude = NO_AMPLITUDE
    """Step of the quantiser [unit of the reading]; 0: none."""
    dead_probability: Share = ZERO
    """Chance that a taxel is dead for an episode."""
    dead_range: tuple[AnyAmplitude, AnyAmplitude] = (NO_AMPLITUDE, NO_AMPLITUDE)
    """Lowest and highest stuck reading of a dead taxel, drawn at reset [unit of the reading]."""
    release_threshold: Annotated[Annotated[Range, RangeOf("length", ge=0.0)] | None, Usual("length", high=0.1)] = None
    """Depth below which a `contact` taxel switches off again [m]; default: the sensor's own."""

    @model_validator(mode="after")
    def _ordered(self) -> Knobs:
        if self.gain[0][0] > self.gain[1][1]:
            raise ValueError(f"gain [{self.gain[0][0]:g}, {self.gain[1][1]:g}] is not ordered, expected [low, high]")
        return self

    def over(self, base: Knobs) -> Knobs:
        """Return the knobs of another with those of this one that were written."""
        own = {name: getattr(self, name) for name in Knobs.model_fields if name in self.model_fields_set}
        values = {name: getattr(base, name) for name in Knobs.model_fields if name in base.model_fields_set}
        return Knobs.model_construct(_fields_set=set(values | own), **{**_defaults(), **values, **own})

    def active(self) -> tuple[str, ...]:
        """Return the names of the knobs that are not at their neutral value, in the order of the stages."""
        return tuple(name for name, neutral in _defaults().items() if _plain(getattr(self, name)) != _plain(neutral))


class NoiseSpec(Knobs):
    """Knobs of a sensor, those of some links apart, upon those of a profile."""

    like: Text = "clean"
    """Profile whose knobs hold where none is given here."""
    links: dict[str, Knobs] = {}
    """Knobs of some links, by name, wildcard or group; of several that match, the later one counts."""


NoiseField = Annotated[Text | Annotated[NoiseSpec, Tag("other")], TEXT_OR_OTHER]
"""A profile's name, or knobs in line."""


def _defaults() -> dict[str, Any]:
    return {name: field.default for name, field in Knobs.model_fields.items()}


def _plain(value: Any) -> Any:
    """Return a knob's value without what makes no difference: a mapping that is zero throughout."""
    if isinstance(value, Mapping):
        return {name: part for name, part in value.items() if part != ZERO}
    return tuple(_plain(part) for part in value) if isinstance(value, tuple) else value


BASE = frozenset({"read_delay", "jitter", "bias", "white_noise", "drift", "quantization"})
"""Knobs of every kind."""
PROBE = BASE | {"radius_noise"}
"""Knobs of a kind that reads distances."""
TAXEL = PROBE | {"gain", "dead_probability", "dead_range", "hysteresis"}
"""Knobs of a kind that feels contact."""
FORCE = TAXEL | {"crosstalk"}
"""Knobs of a kind whose taxels read forces."""

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
*Tactile Genesis*, appendix, table of sensor imperfection parameters). `force_taxel`, which the paper has not, takes the values
of its forces, but for the radius noise: its sum is the solver's at any radius."""


def resolve_noise(
    noise: str | NoiseSpec, kind: str, named: Mapping[str, NoiseSpec], seen: tuple[str, ...] = ()
) -> tuple[Knobs, tuple[tuple[str, Knobs], ...]]:
    """Return the knobs of one sensor, and those of some links by pattern, in the order in which they count.

    Args:
        noise: A profile of the document, a built-in one, or knobs in line.
        kind: The sensor's kind.
        named: The profiles of the document.
        seen: Profiles that led here.

    Raises:
        KeyError: If there is no profile of that name, or profiles lead to one another in a circle.
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
    """Return the built-in profile that a sensor's noise starts from in the end; profiles that lead in a circle have none."""
    while not isinstance(noise, str) or noise in named:
        noise = named[noise] if isinstance(noise, str) else noise.like
    return noise
