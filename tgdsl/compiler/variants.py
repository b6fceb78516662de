"""Objects that differ between environments: their variants as geoms of the scene, and places that the variants share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tgdsl.compiler.robot import Model
from tgdsl.errors import RobotError
from tgdsl.plan import Asset, SceneGeom, SceneObject
from tgdsl.scene import Choice, geom_name, muted_mujoco, portable, with_choices
from tgdsl.schema.files import is_file
from tgdsl.schema.objects import MeshGeom, ObjectSpec, PrimitiveGeom

Report = Callable[[tuple[str | int, ...], str, str], None]
"""Called with the place of a mistake below the object, what it is, and a hint."""


@dataclass
class Meshes:
    """Mesh files that variants name, by the keys that the scene has for them."""

    assets: dict[str, Asset] = field(default_factory=dict)
    contents: dict[str, bytes] = field(default_factory=dict)

    def add(self, path: Path) -> str:
        """Read a file and return its key."""
        content = path.read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        key = f"{digest[:32]}{path.suffix.lower()}"
        self.assets[key], self.contents[key] = Asset(key, portable(path), digest), content
        return key


def aligned(rows: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], list[list[int | None]]]:
    """Give the members of several rows common columns, each for one kind, the order within each row kept.

    Args:
        rows: The kinds of each row's members.

    Returns:
        The kind of each column; and for each row the index of its member in each column, None where it has none.
    """
    columns: list[str] = []
    tables: list[list[int | None]] = []
    for row in rows:
        table: list[int | None] = [None] * len(columns)
        after = 0
        for member, kind in enumerate(row):
            place = next((i for i in range(after, len(columns)) if columns[i] == kind), None)
            if place is None:
                place = len(columns)
                columns.append(kind)
                for other in (*tables, table):
                    other.append(None)
            table[place], after = member, place + 1
        tables.append(table)
    return tuple(columns), tables


def scene_object(name: str, target: ObjectSpec, folder: Path, meshes: Meshes, report: Report) -> SceneObject:
    """Return an object's variants as geoms of the scene; mesh files are looked up from the document's folder."""
    compounds = target.compounds
    types, tables = aligned([[geom.type if isinstance(geom, PrimitiveGeom) else "mesh" for geom in c] for c in compounds])
    variants = []
    for v, (compound, table) in enumerate(zip(compounds, tables, strict=True)):
        geoms = [_scene_geom(geom, folder, meshes, lambda what, v=v: report(("variants", v), what, "")) for geom in compound]
        variants.append(tuple(None if i is None else geoms[i] for i in table))
    return SceneObject(name, target.body, types, tuple(variants), target.size == "per_env")


def _scene_geom(
    geom: PrimitiveGeom | MeshGeom, folder: Path, meshes: Meshes, report: Callable[[str], None]
) -> SceneGeom | None:
    if isinstance(geom, PrimitiveGeom):
        return SceneGeom(geom.size, geom.pos, geom.quat, geom.density, "", 1.0)
    path = (folder / geom.mesh).resolve()
    if not is_file(path):
        report(f'there is no file "{geom.mesh}"')
        return None
    return SceneGeom((), geom.pos, geom.quat, geom.density, meshes.add(path), geom.scale)


def variant_scenes(scene: Model, target: SceneObject, contents: Mapping[str, bytes]) -> list[tuple[Model, tuple[str, ...]]]:
    """Return the scene with each variant of an object, and the names of the geoms that the variant has.

    Raises:
        RobotError: If MuJoCo cannot compile it.
    """
    found = []
    for variant, geoms in enumerate(target.variants):
        spec = scene.spec.copy()
        spec.assets = {**spec.assets, **contents}
        try:
            with muted_mujoco():
                spec = with_choices(spec, [target], {target.name: Choice(variant)})
                model = Model(scene.file, spec, spec.compile(), scene.is_urdf)
        except ValueError as error:
            message = " ".join(str(error).split())
            raise RobotError(f"{scene.file}: object {target.name}, variant {variant}: {message}") from error
        found.append((model, tuple(geom_name(target, i) for i, geom in enumerate(geoms) if geom is not None)))
    return found
