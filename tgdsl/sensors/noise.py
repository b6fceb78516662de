"""Imperfections of a sensor: the knobs of the paper's noise model, and the profiles that name a set of them.

The knobs are part of the grammar; their effect is not built yet, so a knob away from its neutral value is refused by name.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, StrictInt, model_validator

from tgdsl.fields import Length, NonNegative, Number, Positive, Radius, SpecModel, Time

Probability = Annotated[float, Field(ge=0.0, le=1.0)]


class Hysteresis(SpecModel):
    """Viscoelastic memory of the substrate: one Maxwell branch."""

    strength: NonNegative
    """Overshoot after a step, as a share of the step."""
    time_constant: Time
    """Time constant of the decay [s]."""


class Crosstalk(SpecModel):
    """Mixing of neighbouring taxels."""

    strength: Probability
    """Share of each reading that comes from the neighbourhood."""
    sigma: Length
    """Standard deviation of the Gaussian neighbourhood [m]."""


class NoiseSpec(SpecModel):
    """All knobs; the defaults are neutral. Amplitudes are in the unit of the reading that they disturb."""

    read_delay: Annotated[StrictInt, Field(ge=0)] = 0
    """Age of a reading [steps]."""
    jitter: Annotated[StrictInt, Field(ge=0)] = 0
    """Largest additional age, uniformly distributed [steps]."""
    white_noise: NonNegative = 0.0
    """Standard deviation of additive Gaussian noise [unit of the reading]."""
    bias: Number = 0.0
    """Constant offset [unit of the reading]."""
    drift: NonNegative = 0.0
    """Standard deviation of the random walk's step [unit of the reading per step]."""
    quantization: NonNegative = 0.0
    """Step of the quantiser [unit of the reading]; 0: none."""
    radius_noise: Radius = 0.0
    """Half-width of the uniform disturbance of the probe radius [m]."""
    gain: tuple[Positive, Positive] = (1.0, 1.0)
    """Range of each probe's gain, drawn at reset."""
    dead_probability: Probability = 0.0
    """Chance that a taxel is dead for an episode."""
    dead_range: tuple[Number, Number] = (0.0, 0.0)
    """Range of a dead taxel's stuck reading [unit of the reading]."""
    hysteresis: Hysteresis | None = None
    """Viscoelastic memory."""
    crosstalk: Crosstalk | None = None
    """Mixing of neighbouring taxels."""

    @model_validator(mode="after")
    def _ordered(self) -> NoiseSpec:
        for name in ("gain", "dead_range"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name} [{low:g}, {high:g}] is not ordered, expected [low, high]")
        return self

    def active_knobs(self) -> tuple[str, ...]:
        """Return the names of the knobs that are not at their neutral value."""
        neutral = NoiseSpec()
        return tuple(name for name in type(self).model_fields if getattr(self, name) != getattr(neutral, name))


_COMMON = {"radius_noise": 3e-4, "dead_probability": 0.05, "gain": (0.85, 1.15)}
_LAG = Hysteresis(strength=0.5, time_constant=0.05)

PROFILES: dict[str, dict[str, NoiseSpec]] = {
    "clean": {},
    "noisy": {
        "contact": NoiseSpec(dead_probability=0.05),
        "contact_depth": NoiseSpec(white_noise=2e-4, quantization=1e-4, hysteresis=_LAG, **_COMMON),
        "kinematic_taxel": NoiseSpec(white_noise=5e-3, drift=1e-4, quantization=1e-2, hysteresis=_LAG, **_COMMON),
    },
}
"""Built-in profiles: knobs by sensor kind (neutral for a kind not named). `noisy` is the paper's noisy condition (Chung et
al., *Tactile Genesis*, appendix, table of sensor imperfection parameters)."""


def resolve_noise(noise: str | NoiseSpec, kind: str, named: dict[str, NoiseSpec]) -> NoiseSpec:
    """Return the knobs of one sensor: in line, of a profile of the document, or of a built-in profile.

    Raises:
        KeyError: If there is no profile of that name.
    """
    if isinstance(noise, NoiseSpec):
        return noise
    if noise in named:
        return named[noise]
    return PROFILES[noise].get(kind, NoiseSpec())
