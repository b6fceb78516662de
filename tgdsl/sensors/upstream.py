"""A kind's request to other sensors of its document, answered after those are evaluated.

A kind that provides planes for others lists them in `Kind.provides`; `Lowered.provides` has the planes of one sensor, and
`forward` returns them with its channels. A kind that reads others puts an `Upstream` into `Lowered.upstream`, and names in
`Kind.reads` the field of its spec that has their names. At each call or substep the named sensors are evaluated first, once
for all readers. The kind gets in `gathered[Upstream]` all planes that their `forward` returned at the same call or substep,
before noise, rate and history, by the sensors' names. Users' readings stay the same.

A sensor that is read has as many substeps as its reader. Unknown names, circles, and sensors whose kind does not provide the
planes are located errors. If sizes depend on the sensors read or on the scene's time step, a kind has `Kind.fit`,
`(spec, lowered, fitting) → Lowered`, called after those sensors were lowered and fitted.

Shapes: `env` environments, `row` rows of the sensor that is read, `sample` samples of a block.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from tgdsl.quantities.base import Request

SAMPLES, PLACE = "sound/samples", "sound/place"
"""Planes of a sensor that makes sound.

`sound/samples` (env, sample, row): sound pressure at 1 m from each row [Pa]; `Lowered.sound` samples, evenly spaced since the
(sub)step before, the last one at the instant of the state. `sound/place` (env, 3, row): position of the source in the world at
the instant of the state [m], in the dtype of the state. Float64 references return (sample, row) and (3, row).
"""
SOUND = frozenset({SAMPLES, PLACE})


@dataclass(frozen=True, eq=False)
class Upstream(Request[Mapping[str, Mapping[str, Tensor]]]):
    """Requests planes of other sensors at the same call or substep, before their noise: by sensor, then by plane."""

    sensors: tuple[str, ...] = ()  # names of the sensors; empty: all whose kinds provide the planes, in the document's order
    planes: frozenset[str] = frozenset()  # planes that each must provide
    what: str = ""  # noun for them in an error: "sound"
