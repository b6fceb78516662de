"""What a kind asks of other sensors of its document: a typed request that names them, answered once they are evaluated.

A kind that makes something for others says by `Kind.provides` which planes its `forward` can return beside its channels, and by
`Lowered.provides` which it does return. A kind that reads others puts an `Upstream` into `Lowered.upstream`, and says by
`Kind.reads` which field of its spec names them. At each call, or substep of a block, the sensors named are evaluated first and
once, whoever else reads them; the kind then gets as `gathered[Upstream]` all that their `forward` returned at this very call or
substep, before noise, rates and history, by the sensors' names. Nothing of it is handed out to users: their readings are what
they were.

A sensor that is read is advanced at as many substeps as the one that reads it. Sensors that read one another in a circle, that
are not there, or whose kind does not provide what is wanted are mistakes of the document, each at its place. As sizes may
follow from what is read, and from the scene's time step, a kind may have `Kind.fit`, `(spec, lowered, fitting) → Lowered`,
which is called once all that it reads is lowered and fitted.

Shapes: `env` environments, `row` rows of the sensor that is read, `sample` samples of a block.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from tgdsl.quantities.base import Request

SAMPLES, PLACE = "sound/samples", "sound/place"
"""Planes of a sensor that makes sound.

`sound/samples` (env, sample, row): sound pressure at 1 m from each row [Pa], the last sample at the instant of the state,
earlier ones evenly since the (sub)step before, `Lowered.sound` of them. `sound/place` (env, 3, row): where it comes from, in
the world, at the instant of the state [m], in the dtype of the state, as `quantities.kinematics` has points of bodies. Float64
references return (sample, row) and (3, row).
"""
SOUND = frozenset({SAMPLES, PLACE})


@dataclass(frozen=True, eq=False)
class Upstream(Request[Mapping[str, Mapping[str, Tensor]]]):
    """Asks what other sensors find at the same call or substep, before their noise: planes by name, by the sensors' names.

    Attributes:
        sensors: Names of the sensors in the document; empty: all whose kinds provide what is wanted, in the document's order.
        planes: Planes that each must provide.
        what: What these are called in an error: "sound".
    """

    sensors: tuple[str, ...] = ()
    planes: frozenset[str] = frozenset()
    what: str = ""
