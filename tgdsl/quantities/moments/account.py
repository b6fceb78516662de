"""What an account of a module says of moments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tgdsl.quantities.moments.part import FieldTable, MomentsPart
from tgdsl.quantities.pairs import PairedObject

Part = MomentsPart[np.ndarray]


def explain(part: Part, use: int, objects: Sequence[PairedObject]) -> list[str]:
    """Return what a use asks for, and of what."""
    names = [objects[part.tables[i].object].name for i in part.uses[use].tables]
    return [f"moments of {', '.join(names)}" + (" with motion" if part.uses[use].motion else "")]


def account(part: Part, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
    """Return what was measured of each field."""
    lines = []
    for table in part.tables:
        field, num_radii = table.surface, len(table.radii)
        for i, accuracy in enumerate(table.accuracy if isinstance(field, FieldTable) else ()):
            assert isinstance(field, FieldTable)
            size = field.values[0].nbytes * int(field.num[i].prod())
            which = f"variant {i // num_radii}, " if len(table.area) > 1 else ""
            nodes = f"{' × '.join(map(str, field.num[i]))} nodes every {1e3 * accuracy['cell']:.3g} mm, {size} bytes"
            s0, s0_max, s1, s1_max = (
                f"{100 * accuracy[key]:.2g} %" for key in ("mass_rms", "mass_max", "first_rms", "first_max")
            )
            lines += [
                f"{objects[table.object].name}, {which}radius {1e3 * accuracy['radius']:.3g} mm: {nodes}",
                f"  RMS error of S0 {s0} of full scale (largest {s0_max}), of S1 {s1} (largest {s1_max})",
                *_gradients(accuracy),
            ]
    return {"fields of moments": lines} if lines else {}


def _gradients(accuracy: Mapping[str, float]) -> list[str]:
    """Return what was measured of a field's gradients by place, if it was."""
    if "gradient_p999" not in accuracy:
        return []
    p999, largest, first = (f"{100 * accuracy[key]:.2g} %" for key in ("gradient_p999", "gradient_max", "first_gradient_p999"))
    return [f"  gradients: 99.9 % of S0's within {p999} of the largest (largest error {largest}), of S1's within {first}"]
