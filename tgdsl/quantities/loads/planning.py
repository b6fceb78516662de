"""From requests for loads to their part of the Plan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tgdsl.quantities.base import Planning, Use
from tgdsl.quantities.contacts.planning import is_counted
from tgdsl.quantities.loads.part import LoadsPart, LoadsUse
from tgdsl.quantities.loads.request import Loads
from tgdsl.quantities.pairs import Pair


def plan(planning: Planning, uses: Sequence[Use]) -> LoadsPart[np.ndarray]:
    """Return the part of the Plan."""
    return LoadsPart(tuple(_use(planning, use) for use in uses))


def _use(planning: Planning, use: Use) -> LoadsUse[np.ndarray]:
    request = use.request
    assert isinstance(request, Loads)
    names = request.objects
    bodies = tuple(dict.fromkeys(link.body for link in use.links))
    pairs = {pair: i for i, pair in enumerate(planning.contact_pairs)}
    own = [name for name in names if request.of == "object" or not is_counted(planning, name, names)]
    table = [[pairs.get(Pair(body, name), len(pairs)) if name in own else len(pairs) for name in names] for body in bodies]
    return LoadsUse(
        bodies=_places(planning, bodies),
        objects=_places(planning, [planning.sensed[name].body for name in names]),
        pairs=np.array(table, dtype=np.int64).reshape(len(bodies), len(names)),
        center=request.of if request.has_center else "",
    )


def _places(planning: Planning, bodies: Sequence[str]) -> np.ndarray:
    """Return where bodies stand in the state; one that touches nothing has no pose there, and no contacts."""
    return np.array([planning.bodies.index(body) if body in planning.bodies else 0 for body in bodies], dtype=np.int64)
