"""A step of the modes, and a block of samples as one matrix; constants that depend on the time step, in float64.

    heard = Hᵀ (Re z, Im z, u) + Σ_n ξ_n h(t_n),   z′ = p z + b u + Σ_n ξ_n e(t_n)

with the phasors z of the modes at the start of a step [N·s] and their drives: u, an impulse at the start [N·s], or with
`model: force` the rise of the force [N]; and `GRAINS` noise impulses ξ_n [N·s], each at one of `SLOTS` times t_n of its part of
the step. H and h hold the samples' sines; p, b and e carry phasors and drives to the step's end. All are exact for any step.

A phasor that is turned by the same rounded factor at every step drifts by 3e-8 a step. So in float32 p alternates between its
two neighbours such that its mean is exact: it is rounded up at step n where the fractional part of n (√5 − 1)/2 is below p's
distance from the lower neighbour, in units in the last place. The remaining rounding errors do not add up.

Shapes: `row` bodies that ring, `mode` modes of the one with most, `part` real and imaginary part, `both` the real parts of all
modes, then their imaginary ones, `sample` samples of a block, `band` bands, `grain` impulses of noise, `slot` times of each.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float
from pydantic import BeforeValidator, Discriminator, Field, StrictInt, Tag, model_validator
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, listed
from tgdsl.fields.models import Frequency, NonNegative, Number, Positive, Quantity, SpecModel, Usual
from tgdsl.layout.layout import Layout
from tgdsl.modal.modes import Modes, ModeShapes, ShapeModes
from tgdsl.quantities.contacts import DEFAULT_PATCH_SLOTS
from tgdsl.sensors.base import Alternative, Axis, ProbeSpec, body_axis
from tgdsl.surfaces.surface import Surface
from tgdsl.tensors.fusion import materialised

Time = Annotated[float, Quantity("time", gt=0.0)]


class ModeSpec(SpecModel):
    """One mode of vibration."""

    frequency: Annotated[Frequency, Usual("frequency", low=1.0, high=1e5)]
    """Its frequency, f [Hz]."""
    decay: Positive
    """Rate at which its amplitude decays, d [1/s]; it falls by 60 dB in 6.91/d."""
    gain: Number = 1.0
    """Amplitude of the sound per impulse, g [1/kg]."""


ListedModes = Annotated[tuple[ModeSpec, ...], Field(min_length=1)]
ModesField = Annotated[
    Annotated[ListedModes, Tag("a list of modes")] | Annotated[ShapeModes, Tag("of the shape")],
    Discriminator(lambda value: "a list of modes" if isinstance(value, (list, tuple)) else "of the shape"),
    BeforeValidator(
        lambda found: {"material": found} if isinstance(found, str) else found,
        json_schema_input_type=str | ListedModes | ShapeModes,
    ),
]
"""The modes of a body as a user writes them: a list, or `{material: steel, …}` or `steel` for modes computed from its shape."""


class ContactAudioSpec(ProbeSpec):
    """The sound of bodies that are struck and scraped."""

    kind: Literal["contact_audio"]
    """Sound of each body that is struck or scraped: blocks of samples [m/s], or energies by band [m²/s²]."""
    of: Literal["link", "object"] = "link"
    """Whose bodies ring: the links of the sensor, struck by the objects it feels, or these objects, struck by the links."""
    modes: ModesField
    """Modes of a body: a list of frequency, decay and gain; or `{material: steel}` or `steel`, computed from its shape."""
    bodies: dict[str, ModesField] = {}
    """Other modes, by names of links (of objects with `of: object`) or shell wildcards; the first that matches counts."""
    gains: Literal["mean", "contact"] = "mean"
    """How strongly a contact excites each mode: `mean`, by the mode's gain alone; `contact`, also by its mode shape at the
    contact along the normal, relative to the mean. This needs modes of the shape."""
    samples: Annotated[StrictInt, Field(ge=1)] = 16
    """Samples per physics step, K: the sample rate is K over the time step."""
    substeps: Annotated[StrictInt, Field(ge=1)] = 1
    """Physics steps per call: a reading holds the blocks of all of them, one after the other."""
    timestep: Annotated[Time | None, Usual("time", low=1e-5, high=0.1)] = None
    """Duration of a physics step [s]; default: the scene's time step."""
    settling: Annotated[Time, Usual("time", low=1e-4, high=1.0)] = 0.02
    """Time after which a load counts as steady, τ [s]: a slower press makes no sound. For `model: physical` alone."""
    loudest: Annotated[StrictInt, Field(ge=1)] | None = None
    """Largest number of modes computed for each body, those with most energy, g²/4d; default: all audible ones."""
    scrape: NonNegative = 1e-5
    """Noise of sliding, m_s [kg]: with a normal force of 1 N at 1 m/s, variance of the impulses of one second [N²·s²]."""
    outputs: Literal["samples", "bands"] = "samples"
    """`samples` to hear, one after the other; or `bands`: energy in third octaves, once per physics step."""
    scale: Literal["linear", "decibel"] | None = None
    """Of `bands`: `linear` [m²/s²], the default, or `decibel`, 10 lg(1 + E/E₀) with E₀ = (1 µm/s)²."""
    model: Literal["physical", "force", "paper"] = "physical"
    """`physical`: impulses of collisions; `force`: the force drives the modes, so that a contact excites modes slower than
    itself; `paper`: the two-pole response as printed, and impulses of each rise of the force, however many steps it takes."""
    slots: Annotated[StrictInt, Field(ge=1)] = DEFAULT_PATCH_SLOTS
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

    Samples at common times are equal for any number of samples, except that the sample rate limits the audible modes. With the
    paper's response they are not, so they are not compared.
    """
    fields = [spec.modes, *spec.bodies.values()]
    most = max(field.count if isinstance(field, ShapeModes) else len(field) for field in fields)
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


def numbers(frequency: np.ndarray) -> np.ndarray:
    """Return the number of each frequency's third-octave band; 0 Hz, padding, counts as 1 Hz.

        f_n = 1000 · 10^(n/10) Hz,   edges f_n · 10^(∓1/20)

    Source: IEC 61260-1, base-ten system. Shapes: `row` bodies that ring, `mode` their modes, `band` bands.
    """
    return np.round(10 * np.log10(np.where(frequency > 0, frequency, 1.0) / 1000.0)).astype(np.int64)


def band_numbers(frequency: Float[np.ndarray, " mode"]) -> list[int]:
    """Return all bands from the lowest mode's to the highest mode's."""
    bands = numbers(frequency)
    return list(range(int(bands.min()), int(bands.max()) + 1))


def middle(number: int) -> float:
    """Return a band's middle frequency [Hz]."""
    return 1000.0 * 10.0 ** (number / 10)


def membership(frequency: Float[np.ndarray, "row mode"], bands: Sequence[int]) -> Float[np.ndarray, "row mode band"]:
    """Return 1 for the band that each mode is in, else 0."""
    is_in = numbers(frequency)[..., None] == np.array(bands)
    return (is_in & (frequency > 0)[..., None]).astype(np.float64)


GRAINS = 4  # impulses of noise in a physics step, one in each of as many equal parts: the same for any number of samples
SLOTS = 16  # times in its part of the step at which one of them may arrive
HIGHEST = 0.45  # largest frequency that is heard, in sample rates
Arrays = Mapping[str, np.ndarray]

# Functions, not floats of the module: under dynamic shapes torch.compile makes those inputs of the graph.


def golden() -> float:
    """Return the golden ratio's fraction: modulo 1, its multiples fill the unit interval most evenly of all numbers'."""
    return 0.6180339887498949


def least() -> float:
    """Return up to where a component of a phasor is flushed to zero [N·s]."""
    return 1e-12


def quiet() -> float:
    """Return the energy E₀ that levels are relative to, of 1 µm/s [m²/s²]."""
    return 1e-12


def highest(samples: int, step: float) -> float:
    """Return the largest frequency that blocks of so many samples hold [Hz]."""
    return HIGHEST * samples / step


def strike_phasors(frequency: np.ndarray, samples: int, step: float, is_paper: bool) -> Complex[np.ndarray, "row mode"]:
    """Return the phasor that a unit impulse adds to each mode: 1, or e^(iθ)/sin θ of the two-pole response."""
    if not is_paper:
        return np.ones_like(frequency, dtype=np.complex128)
    angle = 2 * math.pi * frequency * step / samples
    return np.exp(1j * angle) / np.where(np.sin(angle) != 0, np.sin(angle), 1.0)


def radiated() -> float:
    """Return the sound pressure at 1 m per velocity of a surface of 0.01 m², ρc √(A/4π), of air at 20 °C [Pa·s/m]."""
    return 1.204 * 343.2 * 0.028209479177387815  # a float of a module, such as math.pi, is an input of a compiled graph


def operators(constants: Arrays, step: float) -> dict[str, np.ndarray]:
    """Return the constants of a sensor that depend on the time step [s].

    Args:
        constants: `frequency` [Hz], `decay` [1/s], `gain` [1/kg], each (row, mode), 0 where a row has fewer; `samples`;
            `settling` [s]; `scrape` [kg]; `is_paper` for the paper's response; `is_force` where the force drives; `band` (row,
            mode, band) for bands; `shape_value` where each mode has its own drive.
        step: The time step.
    """
    samples, scrape = int(constants["samples"]), float(constants["scrape"])
    is_paper, is_force = "is_paper" in constants, "is_force" in constants
    frequency = constants["frequency"]
    is_heard = (frequency > 0) & (frequency <= highest(samples, step) * (1 + 1e-12))
    rate, gain = -constants["decay"] + 2j * math.pi * frequency, np.where(is_heard, constants["gain"], 0.0)
    times = np.arange(1, samples + 1) * step / samples
    arrival = times[:, None] if is_paper else (np.arange(GRAINS * SLOTS) * step / (GRAINS * SLOTS)).reshape(GRAINS, SLOTS)
    begun = strike_phasors(frequency, samples, step, is_paper)
    over = rate.real / np.where(is_heard, rate.imag, 1.0)
    seen = gain * (1.0 - 1j * over) if is_force else -1j * gain  # heard is Re(seen z)

    def factors(time: np.ndarray) -> np.ndarray:
        shape = (..., *[None] * time.ndim)
        return np.where(is_heard[shape] & (time >= -1e-12 * step), np.exp(rate[shape] * np.maximum(time, 0.0)), 0.0)

    def struck(time: np.ndarray) -> np.ndarray:
        """Return the phasors (row, mode, time) of a unit impulse, or of a force that rises evenly by 1 N in the step."""
        if not is_force:
            return begun[..., None] * factors(time - (step / samples if is_paper else 0.0))
        square = np.where(is_heard, rate, 1.0)[..., None] ** 2
        return np.where(is_heard[..., None], np.expm1(rate[..., None] * time) / (square * step), 0.0)

    retained = math.exp(-step / float(constants["settling"]))
    turn = factors(np.array(step))
    added = struck(np.array([step]))[..., 0]
    result = {
        "kept": np.asarray(retained),
        "leaked": np.asarray(1.0 - retained),
        "step": np.asarray(step),
        "driven": np.concatenate([np.real(added), np.imag(added)], axis=1),
        **{name: _by_parts(name, part) for name, part in _rounded("turn", np.stack([np.real(turn), np.imag(turn)])).items()},
    }
    if scrape > 0:
        result["noise"] = np.asarray(math.sqrt(scrape * step / len(arrival)))
        left = (begun[..., None, None] * factors(step - arrival)).transpose(2, 3, 0, 1)
        result["grain_left"] = np.concatenate([np.real(left), np.imag(left)], axis=3)
    if "band" in constants:
        energy = 0.5 * (gain**2)[..., None] * constants["band"]
        return result | {"energy": np.concatenate([energy, energy], axis=1)}
    free, heard = seen[..., None] * factors(times), np.real(seen[..., None] * struck(times))
    has_each = "shape_value" in constants
    parts = [np.real(free), -np.imag(free), heard if has_each else heard.sum(axis=1, keepdims=True)]
    result["heard"] = np.concatenate(parts, axis=1)
    if scrape > 0:
        response = np.real((seen * begun)[..., None, None, None] * factors(times - arrival[..., None])).transpose(2, 3, 0, 1, 4)
        result["grain_heard"] = response if has_each else response.sum(axis=3)
    return result


def _rounded(name: str, exact: np.ndarray) -> dict[str, np.ndarray]:
    """Return the float32 numbers below and above each number, and how far on the way from one to the other it is."""
    nearest = exact.astype(np.float32)
    low = np.where(nearest > exact, np.nextafter(nearest, np.float32(-np.inf)), nearest)
    high = np.nextafter(low, np.float32(np.inf))
    low, high = low.astype(np.float64), high.astype(np.float64)
    return {f"{name}_low": low, f"{name}_high": high, f"{name}_share": (exact - low) / (high - low)}


def _by_parts(name: str, turn: Float[np.ndarray, "2 row mode"]) -> Float[np.ndarray, "2 row both"]:
    real, imag = turn
    sign = 1.0 if name.endswith("share") else -1.0
    return np.stack([np.concatenate([real, real], axis=-1), np.concatenate([sign * imag, imag], axis=-1)])


def turn_of(constants: Mapping[str, Tensor], count: Tensor) -> Float[Tensor, "2 row both"]:
    """Return p as a step uses it, for both parts of z: exact in float64, rounded down or up in float32.

    Args:
        constants: The module's.
        count: Number of the step, int64; any steps will do that follow one another.
    """
    low, high, share = (constants[f"turn_{name}"] for name in ("low", "high", "share"))
    if low.dtype == torch.float64:
        return low + share * (high - low)
    result = torch.where(torch.frac(count.double() * golden()).to(low.dtype) < share, high, low)
    return result if result.is_cuda else materialised(result)  # on a CPU it is else chosen again for each environment


SurfaceByName = Callable[[str], Surface]  # returns the surface of something that rings, by its name


class Ringing(NamedTuple):
    """The computed modes of all rows, padded with zeros."""

    frequency: Float[np.ndarray, "row mode"]  # [Hz]
    decay: Float[np.ndarray, "row mode"]  # [1/s]
    gain: Float[np.ndarray, "row mode"]  # [1/kg]
    # numbers of the third octaves from the lowest audible mode to the highest, whether computed or not
    bands: Sequence[int]
    notes: tuple[str, ...]  # omitted modes with the reason, and the error of the mode shapes if there are any
    shapes: tuple[ModeShapes, ...] = ()  # mode shapes of each row; empty with `gains: mean`


def axis_of(spec: ContactAudioSpec, layout: Layout) -> Axis:
    """Return what rings: the bodies that carry the sensor, or the objects."""
    return body_axis(layout) if spec.of == "link" else Axis("object", len(spec.feels), {"object": spec.feels})


def names_of(spec: ContactAudioSpec, layout: Layout) -> list[tuple[str, tuple[str, ...]]]:
    """Return for each row the name of its link or object, and all names that select it."""
    if spec.of == "object":
        return [(name, (name,)) for name in spec.feels]
    link_names = [[link.name for link in layout.links if link.body == body] for body in layout.bodies]
    return [(names[0], (*names, body)) for names, body in zip(link_names, layout.bodies, strict=True)]


def ringing(
    spec: ContactAudioSpec, layout: Layout, step: float, surface: SurfaceByName, progress: Progress = silent
) -> Ringing:
    """Return the modes of what rings.

    Args:
        spec: The sensor.
        layout: Its links.
        step: The time step [s].
        surface: Returns surfaces.
        progress: Called with a line of text for each long job.

    Raises:
        LowerError: If a pattern matches nothing, a body has no mode that is heard at the sample rate, or mode shapes are wanted
            of listed modes.
    """
    rows = names_of(spec, layout)
    for pattern in spec.bodies:
        if not any(fnmatchcase(name, pattern) for _, names in rows for name in names):
            problem = f'`bodies`: no {spec.of} of the sensor matches "{pattern}"'
            raise LowerError(problem, field="bodies", hint=f"it has {listed([name for name, _ in rows])}")
    below, each, notes = highest(spec.samples, step), [], []
    for name, names in rows:
        modes = _modes_of(_modes_field(spec, names), name, surface, below, progress)
        is_heard = modes.frequency <= below * (1 + 1e-12)
        if not is_heard.any():
            raise _unheard(name, modes, spec, step)
        if not is_heard.all():
            notes.append(f"{name}: {_dropped(modes.frequency[~is_heard])}: the sample rate is {spec.samples / step:g} Hz")
        if spec.gains == "contact" and modes.shapes is None:
            problem = f'`gains: contact` wants mode shapes, and the modes of "{name}" are listed'
            raise LowerError(problem, "gains", "give `modes: {material: …}`, or `gains: mean`")
        each.append((modes, is_heard))
    for note in notes:
        warnings.warn(f"contact audio of {note}, and frequencies up to {HIGHEST:g} of it are heard", stacklevel=2)
    bands = band_numbers(np.concatenate([modes.frequency[is_heard] for modes, is_heard in each]))
    each = [(modes, _loudest(modes, is_heard, spec.loudest)) for modes, is_heard in each]
    most = max(int(is_kept.sum()) for _, is_kept in each)
    frequency, decay, gain = np.zeros((3, len(rows), most))
    for i, (modes, is_kept) in enumerate(each):
        count = int(is_kept.sum())
        for table, values in ((frequency, modes.frequency), (decay, modes.decay), (gain, modes.gain)):
            table[i, :count] = values[is_kept]
    shapes = []
    for (name, _), (modes, is_kept) in zip(rows, each, strict=True):
        if spec.gains == "contact" and modes.shapes is not None:
            shapes.append(modes.shapes.of(is_kept))
            notes.append(f"{name}: {_describe(shapes[-1])}")
    return Ringing(frequency, decay, gain, bands, tuple(notes), tuple(shapes))


def _loudest(modes: Modes, is_heard: np.ndarray, count: int | None) -> np.ndarray:
    """Return which modes are computed: the audible modes with most energy, ∫s² dt = g²/4d for f ≫ d."""
    if count is None or count >= is_heard.sum():
        return is_heard
    energy = np.where(is_heard, modes.gain**2 / modes.decay, -1.0)
    is_kept = np.zeros_like(is_heard)
    is_kept[np.argsort(-energy, kind="stable")[:count]] = True
    return is_kept


def _describe(shapes: ModeShapes) -> str:
    num = " × ".join(str(count) for count in shapes.num.tolist())
    return f"mode shapes on {num} nodes; interpolated within {shapes.error.max():.1%} of a mode's mean on the surface"


def _modes_field(spec: ContactAudioSpec, names: tuple[str, ...]) -> ModesField:
    matches = (modes for pattern, modes in spec.bodies.items() if any(fnmatchcase(name, pattern) for name in names))
    return next(matches, spec.modes)


def _dropped(frequency: np.ndarray) -> str:
    frequencies = listed([f"{value:.5g} Hz" for value in frequency.tolist()], 8)
    return f"{'a mode is' if len(frequency) == 1 else 'modes are'} left out, {frequencies}"


def _unheard(name: str, modes: Modes, spec: ContactAudioSpec, step: float) -> LowerError:
    """Return the error of a body that has no mode below the largest frequency."""
    if not len(modes.frequency):
        return LowerError(f'"{name}" has no mode below {highest(spec.samples, step):.5g} Hz', "samples", "take more samples")
    lowest = float(modes.frequency.min())
    problem = f'the lowest mode of "{name}" is at {lowest:.5g} Hz, and {spec.samples} samples of a step of {step:g} s hold '
    needed = math.ceil(lowest * step / HIGHEST * (1 - 1e-12))
    return LowerError(f"{problem}{highest(spec.samples, step):.5g} Hz", "samples", f"it needs `samples: {needed}`")


def _modes_of(given: ModesField, name: str, surface: SurfaceByName, below: float, progress: Progress) -> Modes:
    """Return the modes of a body."""
    if isinstance(given, ShapeModes):
        from tgdsl.modal.analysis import analysed

        return analysed(name, surface(name), given, below, progress)
    ordered = sorted(given, key=lambda mode: mode.frequency)
    return Modes(
        frequency=np.array([mode.frequency for mode in ordered]),
        decay=np.array([mode.decay for mode in ordered]),
        gain=np.array([mode.gain for mode in ordered]),
    )
