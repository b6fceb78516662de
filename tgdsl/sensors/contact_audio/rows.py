"""What rings, and its modes that are heard at the sample rate.

Shapes: `row` bodies or objects that ring, `mode` modes of the one with most.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import LowerError, listed
from tgdsl.layout.layout import Layout
from tgdsl.modal.modes import Modes, ModeShapes
from tgdsl.modal.spec import ShapeModes
from tgdsl.sensors.base import Axis, body_axis
from tgdsl.sensors.contact_audio.bands import band_numbers
from tgdsl.sensors.contact_audio.operators import HIGHEST, highest
from tgdsl.sensors.contact_audio.spec import ContactAudioSpec, ModesField
from tgdsl.surfaces.surface import Surface

SurfaceByName = Callable[[str], Surface]
"""Returns the surface of something that rings, by its name."""


class Ringing(NamedTuple):
    """The modes of all rows that are computed; those that a row has fewer of than another are 0.

    Attributes:
        frequency: [Hz].
        decay: [1/s].
        gain: [1/kg].
        bands: Numbers of the third octaves from the lowest mode that is heard to the highest, whether computed or not.
        notes: What was left out, and why; and how exact mode shapes are, if those are wanted.
        shapes: Mode shapes of each row; none if they are not wanted.
    """

    frequency: Float[np.ndarray, "row mode"]
    decay: Float[np.ndarray, "row mode"]
    gain: Float[np.ndarray, "row mode"]
    bands: Sequence[int]
    notes: tuple[str, ...]
    shapes: tuple[ModeShapes, ...] = ()


def axis_of(spec: ContactAudioSpec, layout: Layout) -> Axis:
    """Return what rings: the bodies that carry the sensor, or the objects."""
    return body_axis(layout) if spec.of == "link" else Axis("object", len(spec.feels), {"object": spec.feels})


def names_of(spec: ContactAudioSpec, layout: Layout) -> list[tuple[str, tuple[str, ...]]]:
    """Return of each row the name of its link or object, and all that it can be chosen by."""
    if spec.of == "object":
        return [(name, (name,)) for name in spec.feels]
    own = [[link.name for link in layout.links if link.body == body] for body in layout.bodies]
    return [(names[0], (*names, body)) for names, body in zip(own, layout.bodies, strict=True)]


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
        modes = _modes_of(_given(spec, names), name, surface, below, progress)
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
        for table, own in ((frequency, modes.frequency), (decay, modes.decay), (gain, modes.gain)):
            table[i, :count] = own[is_kept]
    shapes = []
    for (name, _), (modes, is_kept) in zip(rows, each, strict=True):
        if spec.gains == "contact" and modes.shapes is not None:
            shapes.append(modes.shapes.of(is_kept))
            notes.append(f"{name}: {_describe(shapes[-1])}")
    return Ringing(frequency, decay, gain, bands, tuple(notes), tuple(shapes))


def _loudest(modes: Modes, is_heard: np.ndarray, count: int | None) -> np.ndarray:
    """Return which modes are computed: of those that are heard the ones that ring with most energy, ∫s² dt = g²/4d of f ≫ d."""
    if count is None or count >= is_heard.sum():
        return is_heard
    energy = np.where(is_heard, modes.gain**2 / modes.decay, -1.0)
    is_kept = np.zeros_like(is_heard)
    is_kept[np.argsort(-energy, kind="stable")[:count]] = True
    return is_kept


def _describe(shapes: ModeShapes) -> str:
    num = " × ".join(str(count) for count in shapes.num.tolist())
    return f"mode shapes on {num} nodes; interpolated within {shapes.error.max():.1%} of a mode's mean on the surface"


def _given(spec: ContactAudioSpec, names: tuple[str, ...]) -> ModesField:
    own = (modes for pattern, modes in spec.bodies.items() if any(fnmatchcase(name, pattern) for name in names))
    return next(own, spec.modes)


def _dropped(frequency: np.ndarray) -> str:
    shown = listed([f"{own:.5g} Hz" for own in frequency.tolist()], 8)
    return f"{'a mode is' if len(frequency) == 1 else 'modes are'} left out, {shown}"


def _unheard(name: str, modes: Modes, spec: ContactAudioSpec, step: float) -> LowerError:
    """Return the error of a body that has no mode below the largest frequency."""
    if not len(modes.frequency):
        return LowerError(f'"{name}" has no mode below {highest(spec.samples, step):.5g} Hz', "samples", "take more samples")
    lowest = float(modes.frequency.min())
    problem = f'the lowest mode of "{name}" is at {lowest:.5g} Hz, and {spec.samples} samples of a step of {step:g} s hold '
    needed = math.ceil(lowest * step / HIGHEST * (1 - 1e-12))
    return LowerError(f"{problem}{highest(spec.samples, step):.5g} Hz", "samples", f"it needs `samples: {needed}`")


def _modes_of(given: ModesField, name: str, surface: SurfaceByName, below: float, progress: Progress) -> Modes:
    """Return the modes of a body.

    Args:
        given: What the document says of them.
        name: What the body is called in messages.
        surface: Returns its surface in its frame; called if the modes follow from its shape.
        below: Frequency beyond which a mode is not heard [Hz]. Those that are listed are returned all the same.
        progress: Called with a line of text for each long job.

    Raises:
        LowerError: If its shape gives none.
    """
    if isinstance(given, ShapeModes):
        from tgdsl.modal.analysis import analysed

        return analysed(name, surface(name), given, below, progress)
    ordered = sorted(given, key=lambda mode: mode.frequency)
    return Modes(
        frequency=np.array([mode.frequency for mode in ordered]),
        decay=np.array([mode.decay for mode in ordered]),
        gain=np.array([mode.gain for mode in ordered]),
    )
