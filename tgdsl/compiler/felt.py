"""What is felt of an object: its geoms, as primitives with exact distances or as triangle surfaces with a query."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import igl
import numpy as np
import trimesh

from tgdsl.formats.model import Model
from tgdsl.geometry.shapes import SHAPES
from tgdsl.plan.plan import ContactPart
from tgdsl.quantities.contact_depth.bake import bake
from tgdsl.schema.objects import NUM_SIZES, ObjectSpec
from tgdsl.schema.select import matching
from tgdsl.surfaces.geom import Geom
from tgdsl.surfaces.surface import Surface

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
        bodies: Its body and those that are welded to it, by their indices in the scene.
        touched: Geoms of the scene that the solver's contacts with it act on.
    """

    body: str
    variants: tuple[tuple[FeltGeom, ...], ...]
    is_sized: bool
    bodies: tuple[int, ...]
    touched: frozenset[int]


def felt_body(
    body: str,
    target: ObjectSpec,
    scene: Model,
    variants: Sequence[tuple[Model, tuple[str, ...]]],
    others: Collection[str],
    report: Report,
) -> FeltBody:
    """Return what is felt of an object: the geoms that collide, those that are seen, those named, or its own.

    Bodies that are welded to its body from below are part of it, and the solver's contacts with it are those on its geoms that
    collide. A surface that is only seen has none of its own: contacts with it are those of the whole object.

    Args:
        body: Its body.
        target: What the document says of it.
        scene: The scene.
        variants: If it has geoms of its own, the scene with each variant of them, and their names.
        others: The other objects' bodies.
        report: Called with mistakes.
    """
    bodies = scene.rigid_bodies(body, others)
    if target.compounds:
        touched = scene.touchable(body)
        parts = [tuple(geom for geom in model.geoms if geom.name in names) for model, names in variants]
        felt = [_felt(own, body, target, model, report) for own, (model, _) in zip(parts, variants, strict=True)]
    else:
        own = scene.rigid_geoms(bodies)
        chosen = _chosen(own, body, target, report)
        touched = tuple(geom for geom in chosen if geom.is_colliding) or tuple(geom for geom in own if geom.is_colliding)
        felt = [_felt(chosen, body, target, scene, report)]
        parts = [own]
    if target.size == "per_env":
        for geoms in parts:
            if len(geoms) != 1 or geoms[0].shape not in NUM_SIZES:
                found = ", ".join(geom.shape for geom in geoms)
                hint = f"primitives: {', '.join(NUM_SIZES)}"
                report(f'with `size: per_env` the body "{body}" has one geom, a primitive; found {found}', hint)
                break
    return FeltBody(body, tuple(felt), target.size == "per_env", bodies, frozenset(geom.id for geom in touched))


def contact_parts(scene: Model, felt: FeltBody, report: Report) -> tuple[ContactPart, ...]:
    """Return the geoms that contacts with an object act on as MuJoCo's contact sensors can name them.

    Args:
        scene: The scene.
        felt: The object.
        report: Called where a geom has no name that would tell it apart.
    """
    model, first = scene.compiled, felt.bodies[0]
    own = {body: {g.id for g in scene.rigid_geoms((body,)) if g.is_colliding} for body in felt.bodies}
    below = [first]
    for i in range(first + 1, model.nbody if first else 0):
        below += [i] if model.body_parentid[i] in below else []
    if tuple(below) == felt.bodies and set().union(*own.values()) <= felt.touched:
        return (ContactPart("subtree" if len(below) > 1 else "body", felt.body),)
    parts = []
    for body, geoms in own.items():
        if geoms and geoms <= felt.touched and model.body(body).name:
            parts.append(ContactPart("body", model.body(body).name))
            continue
        for geom in (geom for geom in scene.rigid_geoms((body,)) if geom.id in geoms & felt.touched):
            if not geom.name:
                what = f"{geom.shown} has no name of its own, so the solver's contacts on it cannot be told from others"
                report(what, "name it, or its body, in the scene")
            parts.append(ContactPart("geom", geom.name))
    return tuple(parts) or (ContactPart("body", felt.body),)


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


def _chosen(own: tuple[Geom, ...], body: str, target: ObjectSpec, report: Report) -> tuple[Geom, ...]:
    if not own:
        report(f'body "{body}" has no geoms to feel', "")
    if target.surface == "collision":
        return tuple(geom for geom in own if geom.is_colliding) or own
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
