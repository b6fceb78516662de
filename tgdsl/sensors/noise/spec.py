"""The knobs of a sensor's noise, and the profiles that name a set of them. `stages` has what each does.

Any number may be a range `[low, high]`: each environment then draws its own at reset, uniformly. An amplitude is in the unit of
the reading and may be a mapping from its quantities: `white_noise: {force: 5e-3, torque: 1e-4}`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Annotated, Any, ClassVar

from pydantic import Tag, create_model, model_validator

from tgdsl.fields.models import TEXT_OR_OTHER, Range, RangeOf, SpecModel, Text, Usual

Amplitude = Mapping[str, Range]  # a range for each quantity of a reading, or under `ALL` for every one
ALL = "*"


class AmplitudeOf(RangeOf):
    """Marks a range that may also be a mapping from quantities to ranges."""

    def _read(self, found: object) -> Any:
        if not isinstance(found, Mapping):
            return {ALL: super()._read(found)}
        ranges = {}
        for name, part in found.items():
            try:
                ranges[str(name)] = super()._read(part)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from error
        return ranges

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return a range, or a mapping of ranges."""
        one = super().__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [*one["anyOf"], {"type": "object", "additionalProperties": one}]}


AnyAmplitude = Annotated[Amplitude, AmplitudeOf("number")]
NonNegativeAmplitude = Annotated[Amplitude, AmplitudeOf("number", ge=0.0)]
Factor = Annotated[Range, RangeOf("number", gt=0.0)]
LengthRange = Annotated[Range, RangeOf("length", ge=0.0)]
TimeRange = Annotated[Range, RangeOf("time", ge=0.0)]
Share = Annotated[Range, RangeOf("number", ge=0.0, le=1.0)]
ZERO: Range = (0.0, 0.0)
NO_AMPLITUDE: Amplitude = {ALL: ZERO}


def quantity(channel: str) -> str:
    """Return what a channel is a component of: `force` of `force_x`, else its own name; a distance is named by its object."""
    is_component = channel[-2:] in ("_x", "_y", "_z") and not channel.startswith("distance_")
    return channel[:-2] if is_component else channel


def range_of(value: Range | Amplitude, channel: str) -> Range:
    """Return a number's range for a channel; 0 of quantities that an amplitude lacks."""
    return value if isinstance(value, tuple) else value.get(quantity(channel), value.get(ALL, ZERO))


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

    radius_noise: Annotated[LengthRange, Usual("length", high=0.1)] = ZERO
    """ρ, half-width of the uniform disturbance of each probe's radius, drawn at each reading [m]."""
    gain: tuple[Factor, Factor] = ((1.0, 1.0), (1.0, 1.0))
    """Lowest and highest gain: each probe draws its own at reset."""
    hysteresis: Hysteresis | None = None
    """Viscoelastic memory."""
    crosstalk: Crosstalk | None = None
    """Mixing of neighbouring taxels."""
    read_delay: Annotated[TimeRange, Usual("time", high=1.0)] = ZERO
    """Age of the signal that is read [s]; between two calls the signal counts as linear."""
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
    release_threshold: Annotated[LengthRange | None, Usual("length", high=0.1)] = None
    """Depth below which a `contact` taxel switches off again [m]; default: the sensor's own."""
    plain: ClassVar[type[Knobs]]
    """The model with these knobs and nothing else."""

    @model_validator(mode="after")
    def _ordered(self) -> Knobs:
        if self.gain[0][0] > self.gain[1][1]:
            raise ValueError(f"gain [{self.gain[0][0]:g}, {self.gain[1][1]:g}] is not ordered, expected [low, high]")
        return self

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
    parts: tuple[Any, ...] = tuple(reversed(more))  # pydantic collects fields from the last base on
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


BASE = frozenset({"read_delay", "jitter", "bias", "white_noise", "drift", "quantization"})  # knobs of every kind
PROBE = BASE | {"radius_noise"}  # knobs of a kind that reads distances
TAXEL = PROBE | {"gain", "dead_probability", "dead_range", "hysteresis"}  # knobs of a kind that reads contact
FORCE = TAXEL | {"crosstalk"}  # knobs of a kind whose taxels read forces

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
