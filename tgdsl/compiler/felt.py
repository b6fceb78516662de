"""What is felt of an object: its geoms, as primitives with exact distances or as triangle surfaces with a query."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import igl
import numpy as np
import trimesh

from tgdsl.compiler.bake import bake
from tgdsl.compiler.robot import Geom, Model
from tgdsl.geometry.shapes import SHAPES
from tgdsl.geometry.surface import Surface
from tgdsl.schema.objects import NUM_SIZES, ObjectSpec
from tgdsl.schema.select import matching

HULL_POINTS = 2000
"""Points of a convex hull whose distance to the mesh is looked at."""
Report = Callable[[str, str], None]
"""Called with what is wrong with an object, and a hint."""


@dataclass(frozen=True, eq=False)
class FeltGeom:
    """A geom that can be felt.

    Attributes:
        geom: The compiled geom.
        surface: Its triangles in its own frame; None for a primitive.
        mesh: The mesh whose convex hull the surface is, in the same frame; None if it is none.
    """

    geom: Geom
    surface: Surface | None
    mesh: Surface | None = None

    @property
    def shape(self) -> str:
        """The primitive's type, or `mesh`."""
        return self.geom.shape if self.surface is None else "mesh"


@dataclass(frozen=True, eq=False)
class Settled:
    """A felt geom with nothing left to decide.

    Attributes:
        shape: What computes its distance: a primitive's type, an interpolation of a grid, or `raycast`.
        arrays: What that needs besides the geom's size and pose, by name.
        accuracy: What a grid costs, by name; empty for what is exact.
    """

    shape: str
    arrays: Mapping[str, np.ndarray]
    accuracy: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class FeltBody:
    """An object that can be felt.

    Attributes:
        body: Its body.
        variants: The geoms that can be felt of each of its variants; of a single one if it is the same everywhere.
        is_sized: Whether the size of its geom is part of the state.
    """

    body: str
    variants: tuple[tuple[FeltGeom, ...], ...]
    is_sized: bool


def felt_body(body: str, target: ObjectSpec, scenes: Sequence[tuple[Model, tuple[str, ...]]], report: Report) -> FeltBody:
    """Return what is felt of an object: the geoms that collide, those that are seen, those named, or its own.

    Args:
        body: Its body.
        target: What the document says of it.
        scenes: The scene; or, if it has geoms of its own, the scene with each variant of them, and their names.
        report: Called with mistakes.
    """
    variants = []
    for scene, names in scenes:
        own = tuple(geom for geom in scene.geoms if geom.name in names)
        geoms = own if target.compounds else _chosen(body, target, scene, report)
        variants.append(_felt(geoms, body, target, scene, report))
    if target.size == "per_env":
        own = [geom for geom in scenes[0][0].geoms if geom.body == body]
        for felt in variants if target.compounds else [own]:
            if len(felt) != 1 or felt[0].shape not in NUM_SIZES:
                found = ", ".join(geom.shape for geom in felt)
                hint = f"primitives: {', '.join(NUM_SIZES)}"
                report(f'with `size: per_env` the body "{body}" has one geom, a primitive; found {found}', hint)
                break
    return FeltBody(body, tuple(variants), target.size == "per_env")


def _felt(geoms: Sequence[Geom], body: str, target: ObjectSpec, scene: Model, report: Report) -> tuple[FeltGeom, ...]:
    felt = []
    for geom in geoms:
        if geom.shape == "mesh":
            mesh = scene.mesh(geom)
            felt.append(FeltGeom(geom, scene.hull(geom), mesh) if target.surface == "collision" else FeltGeom(geom, mesh))
        elif geom.shape in SHAPES:
            felt.append(FeltGeom(geom, None))
        else:
            what = f'{geom.shown} of body "{body}" is of type {geom.shape}, which cannot be felt'
            report(what, f"types that can: {', '.join(SHAPES)}, mesh")
    return tuple(felt)


def _chosen(body: str, target: ObjectSpec, scene: Model, report: Report) -> tuple[Geom, ...]:
    own = tuple(geom for geom in scene.geoms if geom.body == body)
    if not own:
        report(f'body "{body}" has no geoms to feel', "")
    if target.surface == "collision":
        return scene.touchable(body)
    if target.surface == "visual":
        return tuple(geom for geom in own if not geom.is_colliding) or own
    named = tuple(geom for geom in own if any(matching(target.surface, [name]) for name in geom.names))
    if own and not named:
        names = sorted({name for geom in own for name in geom.names})
        report(f'no geom or mesh of body "{body}" matches "{target.surface}"', f"it has {', '.join(names)}")
    return named


def settle(felt: FeltGeom, target: ObjectSpec, margin: float, name: str) -> Settled:
    """Bake a mesh, or keep its triangles, as the object's query says; a primitive needs neither.

    Args:
        felt: The geom.
        target: What the document says of the object.
        margin: Largest distance from the surface that any sensor asks for [m].
        name: What warnings call the object or link: "object cube".

    Raises:
        BakeError: If no grid within the object's budget holds its tolerance.
    """
    if felt.surface is None:
        return Settled(felt.shape, {}, {})
    _warn_of_hull(felt, margin, name)
    if target.query == "raycast":
        arrays = {"vertices": felt.surface.vertices, "faces": felt.surface.faces, "max_distance": np.asarray(2.0 * margin)}
        return Settled("raycast", arrays, {})
    baked = bake(felt.surface, margin, target.tolerance, target.max_bytes)
    if not baked.is_watertight:
        what = f"{name}: {felt.geom.shown} is not closed; what is inside is decided by its winding number"
        warnings.warn(what, stacklevel=2)
    arrays = {"values": baked.values, "origin": baked.origin, "cell": np.asarray(baked.cell)}
    accuracy = {key: float(value) for key, value in dataclasses.asdict(baked.errors).items()}
    return Settled(baked.method, arrays, {**accuracy, "tolerance": target.tolerance, "cell": baked.cell})


def _warn_of_hull(felt: FeltGeom, margin: float, name: str) -> None:
    """MuJoCo collides convex hulls: say so where a hull stands further off the mesh than any probe reaches."""
    hull = felt.surface
    if hull is None or felt.mesh is None:
        return
    whole = trimesh.Trimesh(hull.vertices, hull.faces, process=False)
    sampled = trimesh.sample.sample_surface(whole, HULL_POINTS, seed=0)[0]
    squared, *_ = igl.point_mesh_squared_distance(np.asarray(sampled), felt.mesh.vertices, felt.mesh.faces)
    depth = float(np.sqrt(np.max(squared)))
    if depth > margin:
        warnings.warn(
            f"{name}: MuJoCo collides the convex hull of {felt.geom.shown}, up to {1e3 * depth:.1f} mm off the mesh, "
            "and that hull is felt; `surface` names what to feel instead",
            stacklevel=2,
        )
