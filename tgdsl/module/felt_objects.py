"""From a Plan's arrays to what is measured against: objects, links' own surfaces, and points of objects that meet them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from tgdsl.geometry.bvh import TriangleMesh
from tgdsl.geometry.grid import METHODS, Grid
from tgdsl.geometry.planes import split, vec
from tgdsl.plan.plan import Inputs, Plan, PlannedObject, PlannedPoints
from tgdsl.quantities.contact_depth.query import FeltObject, RaycastSurface
from tgdsl.quantities.contact_depth.search import is_searchable
from tgdsl.quantities.contact_depth.search_tables import geom_tables
from tgdsl.quantities.points.points import PointSource, point_tiles
from tgdsl.tensors.buffers import Constants


class FeltObjects:
    """What a Plan measures against. Triangles that are queried at run time are kept here; the rest are the Plan's constants."""

    def __init__(self, plan: Plan):
        """Make the triangle meshes."""
        self._plan = plan
        self._raycast = {
            f"objects/{target.name}/{i}": _raycast_surface(plan, target, i)
            for target in plan.objects
            for i, shape in enumerate(target.shapes)
            if shape == "raycast"
        }

    @property
    def kept(self) -> tuple[str, ...]:
        """Paths of the arrays that are no constants: the triangles."""
        return tuple(f"{part}/" for part in self._raycast)

    def searched(self) -> dict[str, np.ndarray]:
        """Return by path what searches are given that is the same at all calls: see `contact_depth.search_tables.Tables`."""
        plan, found = self._plan, {}
        primitives = {name: value for name, value in plan.arrays.items() if name.startswith("objects/") and value.ndim == 3}
        constants = Constants(primitives, torch.float64)
        for i, query in enumerate(plan.queries):
            for a, answer in enumerate(query.answers):
                path, targets = f"queries/{i}/{a}/search", [plan.objects[query.objects[o]] for o in answer.objects]
                if not is_searchable([shape for target in targets for shape in target.shapes], answer.needs):
                    continue
                first = np.array([target.first_pair for target in targets])
                pair = plan.arrays[f"queries/{i}/pair"][list(answer.objects)] + first[:, None]
                found[f"{path}/pair"] = pair.astype(np.int32)
                if all(target.num_variants == 1 and not target.is_sized for target in targets):
                    tables = geom_tables([self.felt(target, constants, {}) for target in targets])
                    found |= {f"{path}/{name}": own.numpy() for name, own in zip(("spheres", "geoms"), tables, strict=True)}
        return found

    def tiles(self) -> dict[str, np.ndarray]:
        """Return by path the tiles of taxels that points of objects act on."""
        found = {}
        for i, query in enumerate(self._plan.queries):
            for a, answer in enumerate(query.answers):
                for k, taxels in enumerate(answer.points.taxels if answer.points is not None else ()):
                    tiles = np.array(point_tiles(taxels, query.num_taxels), dtype=np.int32)
                    found[f"queries/{i}/{a}/points/{k}/tiles"] = tiles.reshape(-1, 3)
        return found

    def felt(self, target: PlannedObject, constants: Constants, tensors: Mapping[str, Tensor]) -> FeltObject:
        """Return an object as each environment has it."""
        variant, path = _variant(self._plan.inputs, target, tensors), f"objects/{target.name}"
        size, is_absent = _chosen(constants, f"{path}/size", variant), None
        if target.is_sized:
            place = self._plan.inputs.objects.index(target.name)
            own = tensors["object_size"][:, place, None].to(size.dtype).expand(-1, size.shape[1], -1)
            absent = None if variant is None else _chosen(constants, f"{path}/is_absent", variant)[..., None] > 0
            size = own if absent is None else torch.where(absent, size, own)
        if variant is not None:
            is_absent = _chosen(constants, f"{path}/is_absent", variant) > 0
        return FeltObject(
            name=target.name,
            first_pair=target.first_pair,
            num_pairs=target.num_pairs,
            shapes=target.shapes,
            is_centred=target.is_centred,
            size=size,
            pos=_chosen(constants, f"{path}/pos", variant),
            rotation=_chosen(constants, f"{path}/rotation", variant),
            is_absent=is_absent,
            variant=variant,
            surfaces=tuple(self._surface(constants, f"{path}/{i}", shape, variant) for i, shape in enumerate(target.shapes)),
        )

    def point_sources(
        self, path: str, planned: PlannedPoints, constants: Constants, tensors: Mapping[str, Tensor]
    ) -> list[PointSource]:
        """Return the points of an answer's objects, and the links that they may meet; their tables are at the path."""
        found = []
        for k, o in enumerate(planned.objects):
            target = self._plan.objects[o]
            table = f"objects/{target.name}/points/{planned.num_points}"
            points, area = constants[f"{table}/points"], constants[f"{table}/area"]
            variant = _variant(self._plan.inputs, target, tensors)
            if variant is not None:
                points, area = points[:, variant], area[variant]
            places = vec(points[:, :, None].unbind())
            pair, link, tiles = (constants[f"{path}/{k}/{name}"] for name in ("pair", "link", "tiles"))
            skin = self._skin(link, constants)
            found.append(PointSource(target.name, pair, planned.taxels[k], tiles, places, area[:, None], skin))
        return found

    def _skin(self, link: Tensor, constants: Constants) -> FeltObject:
        """Return the own surfaces of some links: an object with a case for each."""
        planned = self._plan.skin
        assert planned is not None
        size, pos, rotation = (constants[f"links/{key}"][link] for key in ("size", "pos", "rotation"))
        return FeltObject(
            name="links",
            first_pair=0,
            num_pairs=0,
            shapes=planned.shapes,
            is_centred=planned.is_centred,
            size=size,
            pos=pos,
            rotation=rotation,
            is_absent=constants["links/is_absent"][link] > 0 if len(planned.links) > 1 else None,
            variant=link,
            surfaces=tuple(self._surface(constants, f"links/{i}", shape, link) for i, shape in enumerate(planned.shapes)),
        )

    def _surface(self, constants: Constants, path: str, shape: str, variant: Tensor | None) -> Grid | RaycastSurface | None:
        if shape not in METHODS:
            return self._raycast.get(path)
        values = constants[f"{path}/values"]
        first, num, origin, cell = (
            _chosen(constants, f"{path}/{part}", variant) for part in ("first", "num", "origin", "cell")
        )
        if variant is None:
            return Grid(values, 0, constants.counts(f"{path}/num"), split(origin[:, None]), cell[:, None])
        return Grid(values, first[:, None], split(num[:, None]), split(origin[:, None]), cell[:, None])


def _variant(inputs: Inputs, target: PlannedObject, tensors: Mapping[str, Tensor]) -> Tensor | None:
    """Return which variant each environment has (env,); None if all are alike."""
    return tensors["variant"][:, inputs.objects.index(target.name)].long() if target.num_variants > 1 else None


def _chosen(constants: Constants, path: str, variant: Tensor | None) -> Tensor:
    """Return an array of an object with one row per environment, or a single one if it is the same in all."""
    return constants[path] if variant is None else constants[path][variant]


def _raycast_surface(plan: Plan, target: PlannedObject, i: int) -> RaycastSurface:
    path = f"objects/{target.name}/{i}"
    meshes: dict[tuple[bytes, bytes], TriangleMesh] = {}
    found = []
    for variant in range(target.num_variants):
        vertices, faces = plan.arrays[f"{path}/{variant}/vertices"], plan.arrays[f"{path}/{variant}/faces"]
        key = vertices.tobytes(), faces.tobytes()
        if key not in meshes:
            meshes[key] = TriangleMesh(vertices, faces)
        found.append(meshes[key])
    return RaycastSurface(tuple(found), float(plan.arrays[f"{path}/max_distance"]))
