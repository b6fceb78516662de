"""What a document says of a contact audio sensor."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Discriminator, Field, StrictInt, Tag, model_validator

from tgdsl.fields.models import Frequency, NonNegative, Number, Positive, Quantity, SpecModel, Usual
from tgdsl.modal.spec import ShapeModes
from tgdsl.sensors.base import Alternative, ProbeSpec

Time = Annotated[float, Quantity("time", gt=0.0)]


class ModeSpec(SpecModel):
    """One mode of vibration."""

    frequency: Annotated[Frequency, Usual("frequency", low=1.0, high=1e5)]
    """Its frequency, f [Hz]."""
    decay: Positive
    """Rate at which its amplitude decays, d [1/s]; it falls by 60 dB in 6.91/d."""
    gain: Number = 1.0
    """Amplitude of what is heard per impulse, g [1/kg]."""


def _as_shape(found: Any) -> Any:
    return {"material": found} if isinstance(found, str) else found


def _tag(value: Any) -> str:
    return "a list of modes" if isinstance(value, (list, tuple)) else "of the shape"


ListedModes = Annotated[tuple[ModeSpec, ...], Field(min_length=1)]
ModesField = Annotated[
    Annotated[ListedModes, Tag("a list of modes")] | Annotated[ShapeModes, Tag("of the shape")],
    Discriminator(_tag),
    BeforeValidator(_as_shape, json_schema_input_type=str | ListedModes | ShapeModes),
]
"""What a user may write for the modes of a body: a list of them, `{material: steel, …}` for those of its shape, or `steel`."""


class ContactAudioSpec(ProbeSpec):
    """What bodies sound like that are struck and scraped."""

    kind: Literal["contact_audio"]
    """Sound of each body that is struck or scraped: blocks of samples [m/s], or energies by band [m²/s²]."""
    of: Literal["link", "object"] = "link"
    """Whose bodies ring: the links of the sensor, struck by the objects it feels, or these objects, struck by the links."""
    modes: ModesField
    """Modes of what rings: a list of frequency, decay and gain; `{material: steel}` or `steel` for those of its shape."""
    bodies: dict[str, ModesField] = {}
    """Other modes, by names of links (of objects with `of: object`) or shell wildcards; the first that matches counts."""
    gains: Literal["mean", "contact"] = "mean"
    """How strongly a contact strikes each mode: `mean`, by its gain, wherever it is; `contact`, by its mode shape there and
    along the contact's normal too, over that in the mean. That needs modes of the shape."""
    samples: Annotated[StrictInt, Field(ge=1)] = 16
    """Samples per physics step, K: the sample rate is K over the time step."""
    substeps: Annotated[StrictInt, Field(ge=1)] = 1
    """Physics steps per call: a reading holds the blocks of all of them, one after the other."""
    timestep: Annotated[Time | None, Usual("time", low=1e-5, high=0.1)] = None
    """Time that a physics step takes [s]; default: that of the scene."""
    settling: Annotated[Time, Usual("time", low=1e-4, high=1.0)] = 0.02
    """Time in which a load counts as steady, τ [s]: what presses more slowly makes no sound. For `model: physical` alone."""
    loudest: Annotated[StrictInt, Field(ge=1)] | None = None
    """Most modes of each body that are computed, those that ring with most energy, g²/4d; default: all that are heard."""
    scrape: NonNegative = 1e-5
    """Noise of sliding, m_s [kg]: with a normal force of 1 N at 1 m/s, variance of the impulses of one second [N²·s²]."""
    outputs: Literal["samples", "bands"] = "samples"
    """`samples` to hear, one after the other; or `bands`: energy in third octaves, once per physics step."""
    scale: Literal["linear", "decibel"] | None = None
    """Of `bands`: `linear` [m²/s²], the default, or `decibel`, 10 lg(1 + E/E₀) with E₀ = (1 µm/s)²."""
    model: Literal["physical", "force", "paper"] = "physical"
    """`physical`: impulses of collisions; `force`: the force drives the modes, so that a contact excites what is slower than it
    lasts; `paper`: the two-pole response as printed, and impulses of each rise of the force, however many steps it takes."""
    slots: Annotated[StrictInt, Field(ge=1)] = 4
    """Contacts per pair of body and object that are read one by one."""
    needs_taxels: ClassVar[bool] = False
    is_on_taxels: ClassVar[bool] = False

    @model_validator(mode="after")
    def _is_used(self) -> ContactAudioSpec:
        if self.scale is not None and self.outputs != "bands":
            raise ValueError("`scale` has no effect without `outputs: bands`; remove it")
        if self.model != "physical" and "settling" in self.model_fields_set:
            raise ValueError(f"`settling` has no effect with `model: {self.model}`; remove it")
        return self


def alternatives(spec: ContactAudioSpec) -> list[Alternative]:
    """Return fewer samples, fewer modes, all modes, and twice as many samples.

    Samples at common times are the same whatever their number, but for the modes that it holds. Of the paper's response they
    are not, and so not compared.
    """
    given = [spec.modes, *spec.bodies.values()]
    most = max(own.count if isinstance(own, ShapeModes) else len(own) for own in given)
    few = sorted({num for num in (1, most // 4, most // 2) if 0 < num < most})
    modes = [Alternative("the loudest mode" if num == 1 else f"the loudest {num} modes", {"loudest": num}) for num in few]
    modes.append(Alternative("all modes", {"loudest": None}))
    if spec.model == "paper":
        return modes
    coarse = [spec.samples // part for part in (4, 2) if spec.samples % part == 0]
    fewer = [Alternative(f"{num} samples", {"samples": num}, is_other=True) for num in coarse]
    # What errors are measured against has all modes, also where somebody wrote that fewer are computed.
    finest = Alternative(f"{2 * spec.samples} samples", {"samples": 2 * spec.samples, "loudest": None}, is_other=True)
    return [*fewer, *modes, finest]
