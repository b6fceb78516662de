"""From the state of a scene to contact depths."""

from __future__ import annotations

import torch
from torch import Tensor

from tgdsl.geometry.planes import vec
from tgdsl.quantities.base import Scene, pairs_for
from tgdsl.quantities.contact_depth.part import ContactDepthPart, DepthUse
from tgdsl.quantities.contact_depth.query import ObjectDistance, Probes, Target, measure, penetration
from tgdsl.quantities.contact_depth.request import Penetration
from tgdsl.quantities.contact_depth.search import search
from tgdsl.quantities.geoms.gathering import object_geoms
from tgdsl.tensors.env_ids import may_look

FAR = 1e6
"""Numbers of poses up to this [m] have distances that are numbers, in float32 too."""


def gather(part: ContactDepthPart[Tensor], scene: Scene) -> tuple[Penetration, ...]:
    """Return what each use asks for. Distances are found once per query."""
    targets = {
        i: Target(target, object_geoms(geoms, target, scene))
        for i, (target, geoms) in enumerate(zip(scene.objects, part.geoms, strict=True))
        if geoms is not None
    }
    measured: dict[int, tuple[ObjectDistance, ...]] = {}
    found, are_closed = [], _are_closed(scene)
    for use in part.uses:
        query = part.queries[use.query]
        probes, own = Probes(vec(query.pos.unbind()), query.pair), [targets[o] for o in query.objects]
        if are_closed and use.is_gated and not {"distance", "frame"} & {*use.wants}:  # as right after a reset
            found.append(penetration(pairs_for(scene, True), probes, (), use.reach[:0], use.wants))
            continue
        answer = _searched(use, probes, own, scene)
        if answer is None:
            if use.query not in measured:
                measured[use.query] = measure(pairs_for(scene, True), probes, own)
            near = [measured[use.query][o] for o in use.objects]
            answer = penetration(pairs_for(scene, use.is_gated), probes, near, _reach(use, scene), use.wants)
        found.append(answer)
    return tuple(found)


def _are_closed(scene: Scene) -> bool:
    """Return whether no pair is in contact, and nothing is so far away or no number that a closed gate would not hide it.

    False where the values are not to be looked at: on a GPU, in code that is traced, and where derivatives are wanted.
    """
    pairs = scene.pairs
    if pairs is None or pairs.gate is None or not may_look(pairs.gate) or not bool((pairs.gate == -torch.inf).all()):
        return False
    sizes = scene.tensors.get("object_size", pairs.gate[:, :0])
    return bool((torch.stack([*pairs.rotation, *pairs.offset]).abs() < FAR).all() and sizes.isfinite().all())


def _searched(use: DepthUse[Tensor], probes: Probes, targets: list[Target], scene: Scene) -> Penetration | None:
    """Return the answer of a kernel's search; None where it cannot run."""
    if use.search is None:
        return None
    tables = {name: value for name in ("pair", "spheres", "geoms") if (value := getattr(use.search, name)) is not None}
    own = [targets[o] for o in use.objects]
    return search(pairs_for(scene, use.is_gated), probes, own, tables, _reach(use, scene), use.wants)


def _reach(use: DepthUse[Tensor], scene: Scene) -> Tensor:
    """Return how far each probe feels each object [m]: (object, taxel), or (object, env, taxel) with noise."""
    if not use.radius_noise:
        return use.reach
    radius, shift = use.reach[:, None], scene.radius_shifts[use.radius_noise]
    return torch.where(radius > -torch.inf, torch.clamp(radius + shift, min=0), -torch.inf)
