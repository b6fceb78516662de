"""Compare samplers of `poisson` layouts: the lattice, pymeshlab's filters as pools of candidates, and its Poisson-disk filter.

    python benchmarks/samplers.py

On each colliding link of both right hands, 4 taxels per cm² of its outer surface:

- `gap`: largest distance of the surface from the nearest taxel, over the radius of 4 mm; mean and maximum over links;
- `CV`: standard deviation over mean of the distances of nearest neighbours, mean over links;
- `normals`: share of taxels whose normal differs from the surface's by more than 5°;
- `count`: least and greatest number of taxels, over the requested number;
- `rows`: share of taxels that stay in place, within 2 µm, when vertices are renumbered and faces reordered;
- `time`: time of a hand [s].
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pymeshlab as untyped
from scipy.spatial import KDTree

from tgdsl.formats.robot import load_model
from tgdsl.placement.sample import poisson
from tgdsl.surfaces.meshlab import Shell, outer_shell
from tgdsl.surfaces.region import Region
from tgdsl.surfaces.surface import Surface

pymeshlab: Any = untyped
DENSITY, RADIUS = 4e4, 4e-3
EVERYWHERE = Region(None, (), (), ())
Sampled = tuple[np.ndarray, np.ndarray]


def from_pool(sampler: str) -> Callable[[Shell, int], Sampled]:
    """Return a sampler that chooses taxels from a pool; it returns positions and normals."""

    def taxels(shell: Shell, count: int) -> Sampled:
        pool = poisson.pool(shell, EVERYWHERE, 0, count, None, sampler)
        assert pool is not None
        indices = poisson.choose(pool, count, None)
        return pool.pos[indices], pool.normal[indices]

    return taxels


def poisson_disk(shell: Shell, count: int) -> Sampled:
    """Return samples of pymeshlab's Poisson-disk filter, about as many as requested."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(shell.surface.vertices, shell.surface.faces))
    meshes.generate_sampling_poisson_disk(samplenum=count, exactnumflag=True)
    normal = np.array(meshes.current_mesh().vertex_normal_matrix())
    return np.array(meshes.current_mesh().vertex_matrix()), normal / np.linalg.norm(normal, axis=1, keepdims=True)


SAMPLERS = {"lattice": from_pool("lattice"), "pymeshlab": from_pool("pymeshlab"), "poisson_disk": poisson_disk}


def renumbered(surface: Surface) -> Surface:
    """Return a surface with its vertices renumbered and its faces reordered."""
    draw = np.random.default_rng(0)
    number, order = draw.permutation(len(surface.vertices)), draw.permutation(len(surface.faces))
    faces = np.argsort(number)[surface.faces[order]]
    return Surface(surface.vertices[number], faces, surface.face_geom[order], surface.geoms)


def measure(surface: Surface, name: str) -> tuple[float, ...] | None:
    """Return the columns of a link, or None if it has no outer surface."""
    shell = outer_shell(surface)
    everywhere = poisson.pool(shell, EVERYWHERE, 1, 400, None)
    if everywhere is None:
        return None
    count = max(8, int(DENSITY * everywhere.area))
    start = time.perf_counter()
    pos, normal = SAMPLERS[name](shell, count)
    seconds = time.perf_counter() - start
    _, face, _ = igl.point_mesh_squared_distance(pos, shell.surface.vertices, shell.surface.faces)[:3]
    is_off = (normal * shell.surface.face_normals[np.ravel(face)]).sum(axis=1) < np.cos(np.radians(5))
    gap = KDTree(pos).query(everywhere.pos)[0].max() / RADIUS
    nearest = KDTree(pos).query(pos, k=2)[0][:, 1]
    pos_renumbered, _ = SAMPLERS[name](outer_shell(renumbered(surface)), count)
    stays = (KDTree(pos_renumbered).query(pos)[0] < 2e-6).mean()
    return gap, nearest.std() / nearest.mean(), is_off.mean(), len(pos) / count, stays, seconds


def main() -> None:
    print("| hand | sampler | gap | CV | normals | count | rows | time |\n|---|---|---|---|---|---|---|---|")
    for hand in ("xhand1", "sharpa"):
        model = load_model(Path(__file__).parents[1] / "robots" / hand / f"{hand}_right.xml")
        surfaces = [model.surface(geoms) for body in model.bodies[1:] if (geoms := model.touchable(body))]
        for name in SAMPLERS:
            gap, cv, off, count, stays, seconds = np.array([row for s in surfaces if (row := measure(s, name))]).T
            spread = f"{gap.mean():.2f}, {gap.max():.2f} | {cv.mean():.3f} | {off.mean():.0%}"
            counts = f"{count.min():.2f} to {count.max():.2f} | {stays.mean():.0%} | {seconds.sum():.1f}"
            print(f"| {hand} | `{name}` | {spread} | {counts} |")


if __name__ == "__main__":
    main()
