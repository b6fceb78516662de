"""The search for the geom that each probe is deepest in, and what is felt there: on a GPU one kernel does it.

Shapes: `env` environments, `taxel` probes, `pair` pairs, `object` felt objects.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.quantities.contact_depth.query import Felt, FeltObject, Motion, Pairs, Probes, feel, measure
from tgdsl.quantities.contact_depth.search_tables import SHAPES, Deepest, Tables, geom_tables
from tgdsl.quantities.contacts.contacts import Contacts
from tgdsl.tensors.operations import Operation

THRESHOLD = 5
"""Geoms from which on the kernel is used: with four boxes Inductor's code is as fast, 1.6 million probes in 0.08 ms."""
Reach = Float[Tensor, "object *env taxel"]


def is_searchable(shapes: Collection[str], needs: Collection[str]) -> bool:
    """Return whether the kernel can answer: enough geoms, all of shapes that it knows, and nothing but normal and motion."""
    is_known = all(shape in SHAPES for shape in shapes) and all(need in ("normal", "motion", "contacts") for need in needs)
    return is_known and len(shapes) >= THRESHOLD


def search(
    pairs: Pairs,
    probes: Probes,
    objects: Sequence[FeltObject],
    known: Mapping[str, Tensor],
    reach: Reach,
    needs: Collection[str],
    contacts: Contacts | None = None,
) -> Felt | None:
    """Return what `query.feel` would, found by one kernel; None where that cannot run.

    Args:
        pairs: Relative poses of all pairs of the plan.
        probes: The probes.
        objects: The objects that are felt, the first of equals first; they are searchable.
        known: Their tables by name, as `Tables` has them: `pair`, and the others where they are the same at all calls.
        reach: As `query.feel` has it.
        needs: As `query.feel` has them.
        contacts: Handed through.
    """
    if not DEEPEST.takes_kernel(pairs, probes, objects, known, reach):
        return None
    found = DEEPEST.kernel(pairs, probes, objects, known, reach)
    velocity = angular = None
    if "motion" in needs and pairs.motion is not None:
        own, is_met = found.pair.clamp(min=0).long(), found.pair >= 0
        motion = (*pairs.motion.linear, *pairs.motion.angular)
        x, y, z, u, v, w = (torch.where(is_met, part.gather(1, own), 0.0) for part in motion)
        velocity, angular = planes.add((x, y, z), planes.cross((u, v, w), probes.pos)), (u, v, w)
    normal = found.normal if "normal" in needs else None
    return Felt(found.depth, normal, velocity, angular, {}, {}, contacts, {}, {}, {}, {})


def deepest(pairs: Pairs, probes: Probes, objects: Sequence[FeltObject], known: Mapping[str, Tensor], reach: Reach) -> Deepest:
    """Return what the probes are deepest in.

    Args:
        pairs: Relative poses of all pairs of the plan; the gate holds.
        probes: The probes.
        objects: The objects that are felt, the first of equals first.
        known: As `search` has it, as `reach`.
        reach: Radius of each probe towards each object [m].
    """
    own = torch.stack([pair - target.first_pair for pair, target in zip(known["pair"], objects, strict=True)])
    near = measure(pairs, Probes(probes.pos, own), objects)
    # What moves along x by the number of its pair tells which pair is felt.
    number = torch.arange(1, pairs.offset[0].shape[1] + 1, dtype=reach.dtype, device=reach.device).expand_as(pairs.offset[0])
    still = torch.zeros_like(number)
    motion = Motion((number, still, still), (still, still, still), (still, still, still))
    felt = feel(pairs._replace(motion=motion), probes, near, reach, ("normal", "motion"))
    assert felt.normal is not None and felt.velocity is not None
    return Deepest(felt.depth, felt.normal, felt.velocity[0].int() - 1)


def _by_kernel(
    pairs: Pairs, probes: Probes, objects: Sequence[FeltObject], known: Mapping[str, Tensor], reach: Reach
) -> Deepest:
    from tgdsl.quantities.contact_depth.deepest_kernel import find

    spheres, geoms = (known["spheres"], known["geoms"]) if "geoms" in known else geom_tables(objects)
    return find(pairs, probes.pos, Tables(known["pair"], spheres, geoms), reach)


def _inputs(
    pairs: Pairs, probes: Probes, objects: Sequence[FeltObject], known: Mapping[str, Tensor], reach: Reach
) -> list[Tensor]:
    motion = () if pairs.motion is None else (*pairs.motion.linear, *pairs.motion.angular)
    geoms = [part for target in objects for part in (target.size, target.pos, target.rotation)]
    return [*pairs.offset, *pairs.rotation, *motion, *probes.pos, reach, *geoms]


DEEPEST = Operation("deepest", deepest, _by_kernel, _inputs)
