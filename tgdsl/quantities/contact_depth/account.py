"""What an account of a module says of contact depths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.contact_depth.part import ContactDepthPart
from tgdsl.quantities.geoms import tables
from tgdsl.quantities.pairs import PairedObject

Part = ContactDepthPart[np.ndarray]


def explain(part: Part, use: int, objects: Sequence[PairedObject]) -> list[str]:
    """Return what a use asks for, of what, and when."""
    own = part.uses[use]
    query = part.queries[own.query]
    gate = "where MuJoCo has the pair in contact" if own.is_gated else "wherever a probe reaches"
    extra = " with " + " and ".join(own.wants) if own.wants else ""
    felt = [_shown(part, query.objects[o], objects) for o in own.objects]
    return [f"depth of {query.pos.shape[1]} probes (query {own.query}){extra} in {', '.join(felt) or 'nothing'}, {gate}"]


def _shown(part: Part, o: int, objects: Sequence[PairedObject]) -> str:
    """Return an object's name and geoms."""
    table, target = part.geoms[o], objects[o]
    if table is None:
        return target.name
    variants = [f"{target.num_variants} variants"] if target.num_variants > 1 else []
    size = ["its size given per environment"] if target.is_sized else []
    return f"{target.name} ({', '.join([*table.shapes, *variants, *size])})"


def account(part: Part, objects: Sequence[PairedObject]) -> dict[str, list[str]]:
    """Return what was measured of each baked grid."""
    lines = []
    for target, table in zip(objects, part.geoms, strict=True):
        if table is not None:
            name, count = target.name, target.num_variants
            lines += tables.account(table, [f"{name}, variant {i}" if count > 1 else name for i in range(count)])
    return {"meshes": lines} if lines else {}
