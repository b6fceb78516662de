"""One example of the arguments of each operation that has a kernel, and what of its result is compared."""

from collections.abc import Callable
from dataclasses import is_dataclass, replace
from typing import Any, NamedTuple

import contact_patches
import heat_steps
import meetings
import moment_fields
import pulling_points
import searches
import shared_contacts
import torch
from torch import Tensor

from tgdsl.geometry.planes import vec
from tgdsl.sensors.elastomer.anchors import StickSlip
from tgdsl.sensors.elastomer.point_anchors import PLANES, Markers, point_sum


class Example(NamedTuple):
    """Arguments of an operation, and how a result is compared.

    Attributes:
        arguments: Returns them in a dtype, the same at each call.
        compared: Returns those parts of a result that are defined, in whatever order its points are.
        tolerances: Largest error of each part, in the units of that part.
    """

    arguments: Callable[[torch.dtype], tuple]
    compared: Callable[[Any, tuple], list[Tensor]]
    tolerances: tuple[float, ...]


def deepest(dtype: torch.dtype) -> tuple:
    pairs, probes, which, targets, reach = searches.made("boxes", dtype)
    felt = [targets[index] for index in which]
    pair = torch.stack([probes.pair[index] + targets[index].object.first_pair for index in which]).int()
    return pairs, probes, felt, {"pair": pair}, reach


def felt_moments(dtype: torch.dtype) -> tuple:
    pairs, pos, source = moment_fields.made("several links", dtype)
    return pairs, source.target.pairs, pos, source


def advance_anchors(dtype: torch.dtype) -> tuple:
    meeting = meetings.made("cubes", dtype)
    stick_slip = StickSlip(*(torch.tensor(part, dtype=torch.float32).to(dtype) for part in (1e-3, 1e-5, 1e-3, 0.4)))
    num = meeting.source.pair.shape[0] * meeting.source.points[0].shape[2]
    rng = torch.Generator().manual_seed(0)
    held = torch.rand(meetings.NUM_ENVS, num, generator=rng).round()
    anchors = [0.003 * torch.randn(meetings.NUM_ENVS, num, generator=rng) * held for _ in range(3)]
    return [meeting], stick_slip, {name: part.to(dtype) for name, part in zip(PLANES, (*anchors, held), strict=True)}


def shear_loads(found: tuple, arguments: tuple) -> list[Tensor]:
    """Return what the points move markers by, and the anchors, which a kernel puts in the place of the old ones."""
    (load,), after = found
    _, _, state = arguments
    places = 0.003 * torch.tensor([[1.0, 0, 0], [0, 1, 0], [0.6, 0, 0.8]]).to(load.pos[0])
    markers = Markers(vec(places.T), vec((places / 0.003).T), places.new_tensor(2000.0), None)
    if load.num_active is not None:  # those that load come first, and the rest means nothing
        is_one = torch.arange(load.pos[0].shape[2], device=places.device) < load.num_active[..., None]
        pos, strength = (vec(torch.where(is_one, part, 0.0) for part in parts) for parts in (load.pos, load.strength))
        load = load._replace(pos=pos, strength=strength, num_active=None)
    return [torch.stack(point_sum(load, markers)), *((after or state)[name] for name in PLANES)]


def link_products(dtype: torch.dtype) -> tuple:
    rng = torch.Generator().manual_seed(0)
    matrices = [torch.randn((size, 3, size), generator=rng).to(dtype) for size in (20, 33, 1, 65)]
    return torch.randn((70, 119), generator=rng).to(dtype), matrices


EXAMPLES = {
    "deepest": Example(deepest, lambda found, _: [found.depth, torch.stack(found.normal), found.pair], (3e-7, 2e-3, 0)),
    "felt_moments": Example(felt_moments, lambda found, _: [found.mass, torch.stack(found.first)], (3e-5, 3e-5)),
    "advance_anchors": Example(advance_anchors, shear_loads, (1e-9, 3e-7, 3e-7, 3e-7, 0)),
    "link_products": Example(link_products, lambda found, _: [found], (1e-4,)),
    "meet": Example(
        lambda dtype: (meetings.made("one link", dtype),),
        # Outside the grid, which all is farther than 3 mm, a kernel says infinitely far.
        lambda found, _: [torch.stack(found.pos), found.distance.clamp(max=0.003) - 0.003],
        (3e-7, 3e-7),
    ),
    "point_sum": Example(
        lambda dtype: in_dtype(pulling_points.given(2, 41, 33, 0.3), dtype), lambda found, _: [torch.stack(found)], (1e-11,)
    ),
    "shared_forces": Example(
        lambda dtype: shared_contacts.arguments(shared_contacts.cases()["several bodies"], dtype),
        lambda found, _: list(found),
        (1e-5, 1e-5, 1e-7),
    ),
    "heat_step": Example(
        lambda dtype: heat_steps.arguments("one object", dtype),
        lambda found, _: [found.cells, found.nodes, torch.stack(found.got), torch.stack(found.nodes_got)],
        (2e-5, 2e-5, 1e-5, 1e-5),
    ),
    "contact_patch": Example(
        lambda dtype: contact_patches.arguments("four slots", dtype),
        lambda found, _: [found.force, found.area, torch.stack(found.pos), torch.stack(found.normal)],
        (2e-5, 2e-8, 2e-5, 2e-5),
    ),
}


def in_dtype(tree: Any, dtype: torch.dtype) -> Any:
    """Return nested tuples with all floats in a dtype."""
    return mapped(lambda part: part.to(dtype) if part.is_floating_point() else part, tree)


def mapped(function: Callable[[Tensor], Tensor], tree: Any) -> Any:
    """Return nested tuples, lists, dictionaries and dataclasses with a function of each tensor in its place."""
    if isinstance(tree, Tensor):
        return function(tree)
    if isinstance(tree, dict):
        return {name: mapped(function, part) for name, part in tree.items()}
    if is_dataclass(tree):
        return replace(tree, **{name: mapped(function, part) for name, part in vars(tree).items()})  # type: ignore[type-var]
    if isinstance(tree, list):
        return [mapped(function, part) for part in tree]
    if isinstance(tree, tuple):
        parts = [mapped(function, part) for part in tree]
        return type(tree)(*parts) if hasattr(tree, "_fields") else tuple(parts)
    return tree
