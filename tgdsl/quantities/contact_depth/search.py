"""The search for the geom that each probe is deepest in, and what is felt there: on a GPU one kernel does it.

Shapes: `env` environments, `taxel` probes, `pair` pairs, `object` felt targets.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.contact_depth.query import Probes, Target, measure, penetration
from tgdsl.quantities.contact_depth.request import Penetration
from tgdsl.quantities.contact_depth.search_tables import SHAPES, Deepest, Tables, geom_tables
from tgdsl.quantities.pairs import Motion, Pairs
from tgdsl.tensors.operations import Operation

THRESHOLD = 5
"""Geoms from which on the kernel is used: with four boxes Inductor's code is as fast, 1.6 million probes in 0.08 ms."""
Reach = Float[Tensor, "object *env taxel"]


def is_searchable(shapes: Collection[str], wants: Collection[str]) -> bool:
    """Return whether the kernel can answer: enough geoms, all of shapes that it knows, and nothing but normal and motion."""
    is_known = all(shape in SHAPES for shape in shapes) and all(want in ("normal", "motion") for want in wants)
    return is_known and len(shapes) >= THRESHOLD


def search(
    pairs: Pairs,
    probes: Probes,
    targets: Sequence[Target],
    known: Mapping[str, Tensor],
    reach: Reach,
    wants: Collection[str],
) -> Penetration | None:
    """Return what `query.penetration` would, found by one kernel; None where that cannot run.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        targets: The targets that are felt, the first of equals first; they are searchable.
        known: Their tables by name, as `Tables` has them: `pair`, and the others where they are the same at all calls.
        reach: As `query.penetration` has it.
        wants: As `query.penetration` has them.
    """
    if not DEEPEST.takes_kernel(pairs, probes, targets, known, reach):
        return None
    found = DEEPEST.kernel(pairs, probes, targets, known, reach)
    velocity = angular = None
    if "motion" in wants and pairs.motion is not None:
        own, is_met = found.pair.clamp(min=0).long(), found.pair >= 0
        motion = (*pairs.motion.linear, *pairs.motion.angular)
        x, y, z, u, v, w = (torch.where(is_met, part.gather(1, own), 0.0) for part in motion)
        velocity, angular = planes.add((x, y, z), planes.cross((u, v, w), probes.pos)), (u, v, w)
    normal = found.normal if "normal" in wants else None
    return Penetration(probes.pos, found.depth, normal, velocity, angular, {}, {})


def deepest(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    """Return what the probes are deepest in.

    Args:
        pairs: Relative poses of all pairs of the plan; the gate holds.
        probes: The probes.
        targets: The targets that are felt, the first of equals first.
        known: As `search` has it, as `reach`.
        reach: Radius of each probe towards each object [m].
    """
    own = torch.stack([pair - target.object.first_pair for pair, target in zip(known["pair"], targets, strict=True)])
    near = measure(pairs, Probes(probes.pos, own), targets)
    # What moves along x by the number of its pair tells which pair is felt.
    number = torch.arange(1, pairs.offset[0].shape[1] + 1, dtype=reach.dtype, device=reach.device).expand_as(pairs.offset[0])
    still = torch.zeros_like(number)
    motion = Motion((number, still, still), (still, still, still), (still, still, still))
    felt = penetration(pairs._replace(motion=motion), probes, near, reach, ("normal", "motion"))
    assert felt.normal is not None and felt.velocity is not None
    return Deepest(felt.depth, felt.normal, felt.velocity[0].int() - 1)


def _by_kernel(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    from tgdsl.quantities.contact_depth.deepest_kernel import find

    spheres, geoms = (
        (known["spheres"], known["geoms"]) if "geoms" in known else geom_tables([target.geoms for target in targets])
    )
    return find(pairs, probes.pos, Tables(known["pair"], spheres, geoms), reach)


def _inputs(pairs: Pairs, probes: Probes, targets: Sequence[Target], known: Mapping[str, Tensor], reach: Reach) -> list[Tensor]:
    motion = () if pairs.motion is None else (*pairs.motion.linear, *pairs.motion.angular)
    geoms = [part for _, own in targets for part in (own.size, own.pos, own.rotation)]
    return [*pairs.offset, *pairs.rotation, *motion, *probes.pos, reach, *geoms]


DEEPEST = Operation("deepest", deepest, _by_kernel, _inputs)
