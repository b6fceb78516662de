"""From the state of a scene to points of objects as links see them."""

from __future__ import annotations

from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import vec
from tgdsl.quantities.base import Scene, pairs_for, variant_of
from tgdsl.quantities.geoms.gathering import link_geoms
from tgdsl.quantities.pairs import Pairs
from tgdsl.quantities.points.part import MetObject, PointsPart
from tgdsl.quantities.points.points import ObjectPoints, PointSource


def gather(part: PointsPart[Tensor], scene: Scene) -> tuple[dict[str, ObjectPoints], ...]:
    """Return what each use asks for."""
    found = []
    for use in part.uses:
        pairs = _with_lost(pairs_for(scene, use.is_gated))
        sources = [_source(part, met, scene) for met in use.objects]
        found.append({source.object: ObjectPoints(pairs, source) for source in sources})
    return tuple(found)


def _source(part: PointsPart[Tensor], met: MetObject[Tensor], scene: Scene) -> PointSource:
    """Return the points of an object, and the links that they may meet."""
    cloud = part.clouds[met.cloud]
    target = scene.objects[cloud.object]
    points, area, variant = cloud.points, cloud.area, variant_of(scene, target)
    if variant is not None:
        points, area = points[:, variant], area[variant]
    assert part.surfaces is not None
    places = vec(points[:, :, None].unbind())
    links = link_geoms(part.surfaces, met.link)
    return PointSource(target.name, met.pair, met.taxels, met.tiles, places, area[:, None], links)


def _with_lost(pairs: Pairs) -> Pairs:
    """Return pairs that are nowhere, their offset not-a-number, where their gate is not-a-number."""
    if pairs.gate is None:
        return pairs
    lost = pairs.gate.clamp(min=0.0)  # zero where it is a number
    return pairs._replace(offset=planes.vec(part + lost for part in pairs.offset))
