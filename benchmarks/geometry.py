"""Measure distance queries of primitives and meshes: error, time per probe and bytes.

    python benchmarks/geometry.py prepare shapes.npz      # surfaces, grids and true distances, on a CPU
    python benchmarks/geometry.py measure shapes.npz --device cuda --out docs

The truth is libigl's exact distance to the mesh in float64. The row "analytic" shows how far a primitive is from its mesh.
Points are uniform in a band of 5 mm around the surface; no grid was chosen by them. Errors are of the distance and of the
gradient's direction. The time per point is the median of compiled calls (raycast: eager) on 2^18 points.
"""

from __future__ import annotations

import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from tgdsl.geometry.bvh import TriangleMesh, nearest
from tgdsl.geometry.grid import METHODS, one_grid
from tgdsl.geometry.planes import split, vec
from tgdsl.geometry.shapes import SHAPES

MARGIN = 5e-3
NUM_ERROR, NUM_TIME = 20_000, 1 << 18
TOLERANCES = (2e-4, 5e-5, 2e-5)
PRIMITIVES = {"box": (0.02, 0.015, 0.03), "cylinder": (0.015, 0.03, 0.0), "ellipsoid": (0.02, 0.012, 0.03)}


@dataclass(frozen=True)
class Prepare:
    """Create the shapes, bake the grids and compute the true distances."""

    file: tyro.conf.Positional[Path]
    """The .npz file to write."""

    def run(self) -> None:
        """Prepare all shapes."""
        import igl

        from tgdsl.quantities.bake import bake
        from tgdsl.surfaces.surface import Surface

        arrays: dict[str, np.ndarray] = {}
        for name, mesh in meshes().items():
            vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
            surface = Surface(vertices, faces, np.zeros(len(faces), dtype=np.int64), ((name,),))
            points = band(surface, np.random.default_rng(1))
            squared, _, nearest_point = igl.point_mesh_squared_distance(points, vertices, faces)[:3]
            winding = np.asarray(igl.winding_number(vertices, faces, points)).reshape(-1)
            distance = np.where(winding > 0.5, -1.0, 1.0) * np.sqrt(squared)
            offset = points - nearest_point
            keep = (np.abs(distance) <= MARGIN) & (np.abs(distance) > 1e-7)
            arrays |= {f"{name}/points": points[keep], f"{name}/distance": distance[keep]}
            arrays[f"{name}/normal"] = (offset / distance[:, None])[keep]
            arrays |= {f"{name}/vertices": vertices, f"{name}/faces": faces}
            for tolerance in TOLERANCES:
                start = time.perf_counter()
                baked = bake(surface, MARGIN, tolerance)
                metadata = {**dataclasses.asdict(baked.errors), "method": baked.method, "cell": baked.cell}
                seconds = time.perf_counter() - start
                print(f"{name}: {tolerance * 1e3:g} mm → {baked.method}, {baked.values.nbytes} bytes, {seconds:.1f} s")
                key = f"{name}/{tolerance:g}"
                arrays |= {
                    f"{key}/values": baked.values,
                    f"{key}/origin": baked.origin,
                    f"{key}/about": np.array(json.dumps(metadata)),
                }
        np.savez_compressed(self.file, **arrays)  # type: ignore[arg-type]


def meshes() -> dict[str, Any]:
    """Return the shapes as meshes [m]."""
    import trimesh

    box, cylinder, ellipsoid = (PRIMITIVES[name] for name in ("box", "cylinder", "ellipsoid"))
    rounded = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    direction = np.asarray(rounded.vertices)
    core = np.clip(direction * 1e3, -0.015, 0.015)
    rounded.vertices = core + 0.005 * direction
    shaft = trimesh.creation.cylinder(0.003, 0.09, sections=64).apply_translation((0, 0, 0.075))
    grip = trimesh.creation.capsule(0.06, 0.012, count=[48, 48]).apply_translation((0, 0, -0.03))
    return {
        "box": trimesh.creation.box(2 * np.array(box)),
        "cylinder": trimesh.creation.cylinder(cylinder[0], 2 * cylinder[1], sections=512),
        "ellipsoid": trimesh.creation.icosphere(subdivisions=6).apply_scale(ellipsoid),
        "rounded cube": rounded,
        "screwdriver": trimesh.util.concatenate([grip, shaft]),
        "thin plate": trimesh.creation.box((0.06, 0.04, 0.001)),
    }


def band(surface: Any, rng: np.random.Generator) -> np.ndarray:
    """Return random points in the band around a surface."""
    faces = rng.choice(len(surface.faces), NUM_ERROR, p=surface.face_areas / surface.face_areas.sum())
    weights = rng.dirichlet((1, 1, 1), NUM_ERROR)
    on_surface = np.einsum("ni,nij->nj", weights, surface.corners[faces])
    direction = rng.normal(size=(NUM_ERROR, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return on_surface + direction * rng.uniform(0, MARGIN, (NUM_ERROR, 1))


@dataclass(frozen=True)
class Measure:
    """Measure error and time of every query."""

    file: tyro.conf.Positional[Path]
    """The file of `prepare`."""
    device: str = "cpu"
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path(".")
    """Folder for geometry-DEVICE.md and geometry-DEVICE.png."""
    compiled: bool = True
    """Whether to compile the queries; on a CPU that takes a minute for each tricubic grid."""

    def run(self) -> None:
        """Measure, print, and write table and plot."""
        with np.load(self.file) as archive:
            arrays = dict(archive)
        rows = []
        for name in dict.fromkeys(key.split("/")[0] for key in arrays):
            shape = {key.removeprefix(f"{name}/"): value for key, value in arrays.items() if key.startswith(f"{name}/")}
            for dtype in (torch.float32, torch.float64):
                for way, nbytes, query, is_compiled in queries(name, shape, dtype, self.device):
                    rows.append(row(name, way, nbytes, query, is_compiled and self.compiled, shape, dtype, self.device))
                    print(rows[-1])
        reference = next(r for r in rows if r.shape == "box" and r.way == "analytic").nanoseconds
        write(rows, reference, self.device, self.out)


@dataclass(frozen=True)
class Row:
    """One query of one shape: bytes, errors of distance [m], 95 % quantile of the gradient's angle [°], and time per point."""

    shape: str
    way: str
    dtype: str
    nbytes: int
    worst: float
    rms: float
    angle: float
    nanoseconds: float


Query = Callable[[Any], Any]


def queries(name: str, arrays: dict[str, np.ndarray], dtype: torch.dtype, device: str) -> list[tuple[str, int, Query, bool]]:
    """Return each query's name, bytes, function and whether it is compiled."""
    result: list[tuple[str, int, Query, bool]] = []
    if name in PRIMITIVES:
        size = vec(torch.tensor(part, dtype=dtype, device=device) for part in PRIMITIVES[name])
        result.append(("analytic", 0, lambda p, size=size: SHAPES[name](p, size), True))
    for tolerance in TOLERANCES:
        metadata = json.loads(str(arrays[f"{tolerance:g}/about"]))
        values = torch.tensor(arrays[f"{tolerance:g}/values"], dtype=dtype, device=device)
        origin = torch.tensor(arrays[f"{tolerance:g}/origin"], dtype=dtype, device=device)
        grid = one_grid(values, origin, torch.tensor(metadata["cell"], dtype=dtype, device=device))
        method = METHODS[metadata["method"]]
        label = f"{metadata['method']}, {tolerance * 1e3:g} mm"
        result.append((label, arrays[f"{tolerance:g}/values"].nbytes, lambda p, m=method, g=grid: m(p, g), True))
    mesh = TriangleMesh(arrays["vertices"], arrays["faces"])
    nbytes = arrays["vertices"].size * 4 + arrays["faces"].size * 4
    result.append(("raycast", nbytes, lambda p: nearest(p, [mesh], 2 * MARGIN), False))
    return result


def row(
    name: str,
    way: str,
    nbytes: int,
    query: Query,
    is_compiled: bool,
    shape: dict[str, np.ndarray],
    dtype: torch.dtype,
    device: str,
) -> Row:
    """Measure one query."""
    points = torch.tensor(shape["points"], dtype=dtype, device=device)
    with torch.no_grad():
        distance, gradient = query(split(points))
        error = np.abs(distance.double().cpu().numpy() - shape["distance"])
        cosine = (torch.stack(gradient, dim=-1).double().cpu().numpy() * shape["normal"]).sum(axis=1)
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        torch.compiler.reset()
        call = torch.compile(query, fullgraph=True, dynamic=False) if is_compiled else query
        repeated = points[torch.arange(NUM_TIME, device=device) % len(points)]
        planes = vec(part.contiguous() for part in split(repeated))
        nanoseconds = 1e9 * median_time(lambda: call(planes), device) / NUM_TIME
    values = (float(error.max()), float(np.sqrt((error**2).mean())), float(np.percentile(angle, 95)))
    return Row(name, way, str(dtype).removeprefix("torch."), nbytes, *values, nanoseconds)


def median_time(call: Callable[[], Any], device: str, repeats: int = 9) -> float:
    """Return the median duration of a call [s], after two warm-up calls."""
    times = []
    for i in range(repeats + 2):
        if device == "cuda":
            torch.cuda.synchronize()
        start = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        if i >= 2:
            times.append(time.perf_counter() - start)
    return statistics.median(times)


def write(rows: list[Row], reference: float, device: str, out: Path) -> None:
    """Write the table and the plot."""
    unit = "ns per probe" if device == "cuda" else "time per probe / box, analytic, float32"
    title = "Geometry on one GPU" if device == "cuda" else "Geometry on one CPU"
    lines = [f"# {title}", "", f"| shape | way | dtype | bytes | max error mm | RMS mm | 95 % of normals within | {unit} |"]
    lines.append("|" + "---|" * 8)
    for r in rows:
        cost = r.nanoseconds if device == "cuda" else r.nanoseconds / reference
        lines.append(
            f"| {r.shape} | {r.way} | {r.dtype} | {r.nbytes} | {1e3 * r.worst:.2g} | {1e3 * r.rms:.2g} | {r.angle:.2g}° "
            f"| {cost:.3g} |"
        )
    (out / f"geometry-{device}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    plot(rows, reference, device, out / f"geometry-{device}.png", unit)


def plot(rows: list[Row], reference: float, device: str, path: Path, unit: str) -> None:
    """Draw RMS error against time, float32, one panel per shape."""
    from matplotlib.figure import Figure

    shapes = list(dict.fromkeys(r.shape for r in rows))
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey=True).flat
    colours = {"analytic": "#1b7f4d", "trilinear": "#3b6fb6", "tricubic": "#b5542c", "raycast": "#7a4fa3"}
    for axis, shape in zip(axes, shapes, strict=True):
        for r in (r for r in rows if r.shape == shape and r.dtype == "float32"):
            cost = r.nanoseconds if device == "cuda" else r.nanoseconds / reference
            kind = r.way.split(",")[0]
            axis.scatter(
                cost, 1e3 * max(r.rms, 1e-10), s=30 + 6 * np.sqrt(r.nbytes / 1000), color=colours[kind], alpha=0.7, label=kind
            )
            axis.annotate(
                r.way.removeprefix(kind).strip(", "),
                (cost, 1e3 * max(r.rms, 1e-10)),
                fontsize=7,
                xytext=(5, 4),
                textcoords="offset points",
            )
        axis.set(title=shape, xscale="log", yscale="log")
        axis.grid(alpha=0.25)
    figure.supxlabel(unit)
    figure.supylabel("RMS distance error [mm]; the larger the dot, the more bytes")
    handles = {label: handle for axis in figure.axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), loc="outside upper right", ncols=4, frameon=False)
    figure.savefig(path, dpi=110)


Command = Annotated[Prepare, tyro.conf.subcommand("prepare")] | Annotated[Measure, tyro.conf.subcommand("measure")]

if __name__ == "__main__":
    tyro.cli(Command).run()  # type: ignore[arg-type]
