"""Signed distance to a triangle mesh by nearest-point queries over a bounding-volume hierarchy, with NVIDIA Warp.

Warp's mesh queries run in float32. They only choose the nearest face; the nearest point of that face, the distance and the
gradient are then computed in float64, about the middle of the mesh. So float32 enters through ties between faces alone:
the distance is good to about 1e-6 of the mesh's size for points nearby, whatever the precision of the points.

A point is inside where the mesh's generalized winding number exceeds 1/2 (Jacobson, Kavan, Sorkine-Hornung, *Robust
Inside-Outside Segmentation using Generalized Winding Numbers*, 2013; Warp approximates it as Barill et al., *Fast Winding
Numbers for Soups and Clouds*, 2018). On closed meshes the sign is exact, at edges and corners too; overlapping closed parts
form a union, although the distance stays that to the nearest triangle, which may lie inside it. Open meshes:

- A hole reads as if a smooth membrane closed it. Across the membrane the distance jumps from +d to −d, d being the
  distance to the rim; everywhere else the field is that of the closed mesh.
- A sheet encloses nothing: where it is flat, or where both orientations coincide, the distance is positive on both sides.
- Points outside the bounding box are outside. A mesh turned inside out is outside everywhere.

Shapes: `v` vertices, `f` faces, `p` pieces of faces, `n` points.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import weakref
from collections.abc import Iterator
from typing import Any, NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.geometry.planes import Vec, split, vec

ON_SURFACE = 1e-7
"""Points nearer than this fraction of the mesh's size are on the surface: their gradient is the face's normal."""
SIGN_OFFSET = 2e-6
"""The winding number is evaluated at least this fraction of the mesh's size off the surface, well clear of rounding."""
SEARCH_ERROR = 2e-6
"""Error of the search that is tolerated, as a fraction of the mesh's size; faces too thin for it are split."""
THINNEST = 1e-7
"""Faces whose height is below this fraction of the mesh's size are left to their neighbours."""
MAX_PIECES = 2_000_000
"""Splitting stops at this number of pieces."""


class TriangleMesh:
    """Triangles to ask distances of, with one hierarchy per device, built when a point on that device first asks.

    Copies and pickles hold the triangles and build anew. The mesh must outlive whatever was compiled with it.

    Attributes:
        vertices: Positions in the mesh's frame [m].
        faces: Vertex indices, counter-clockwise seen from outside.
        key: Names the mesh to the operator; unique in the process.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]):
        """Raise `TgdslError` if Warp is missing, if indices or positions are invalid, or if no face has an area."""
        _warp()
        if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise TgdslError(f"mesh: faces name vertices {faces.min()} to {faces.max()}; there are {len(vertices)}")
        if not np.isfinite(vertices).all():
            raise TgdslError("mesh: vertices must be finite")
        self.vertices, self.faces = vertices, faces
        self.key = next(_KEYS)
        corners = vertices.astype(np.float64)[faces]
        if not len(corners):
            raise TgdslError("mesh: no faces")
        lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self._middle, self._half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        self._size = float(np.linalg.norm(upper - lower))
        self._corners = corners - self._middle
        self._pieces, self._face = _split(self._corners, self._size)
        if not len(self._pieces):
            raise TgdslError("mesh: no face has an area")
        self._built: dict[str, _Built] = {}
        _MESHES[self.key] = self

    def __reduce__(self) -> tuple[type[TriangleMesh], tuple[np.ndarray, np.ndarray]]:
        return TriangleMesh, (self.vertices, self.faces)

    def _on(self, device: Any) -> _Built:
        if str(device) not in self._built:
            wp = _warp()
            points = wp.array(self._pieces.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
            indices = wp.array(np.arange(3 * len(self._pieces), dtype=np.int32), dtype=wp.int32, device=device)
            self._built[str(device)] = _Built(
                wp.Mesh(points, indices, support_winding_number=True),
                wp.array(self._face.astype(np.int32), dtype=wp.int32, device=device),
                wp.array(self._corners.reshape(-1, 3), dtype=wp.vec3d, device=device),
            )
            wp.synchronize_device(device)
        return self._built[str(device)]

    def _launch(self, point: Tensor, max_distance: float, distance: Tensor, gradient: Tensor) -> None:
        wp = _warp()
        with _quiet():
            built = self._on(wp.device_from_torch(point.device))
            arrays = [
                wp.from_torch(point, dtype=wp.vec3d),
                wp.from_torch(distance, dtype=wp.float64),
                wp.from_torch(gradient, dtype=wp.vec3d),
            ]
            box = [wp.vec3d(*self._middle), wp.vec3d(*self._half)]
            wp.launch(
                _kernel(),
                dim=len(point),
                inputs=[built.mesh.id, built.face, built.corners, *box, max_distance, *arrays],
                device=built.mesh.device,
                stream=wp.stream_from_torch(point.device) if point.is_cuda else None,
            )


class _Built(NamedTuple):
    """A mesh on a device, centred: Warp's mesh of the pieces, the face of each piece, the corners of each face."""

    mesh: Any
    face: Any
    corners: Any


_KEYS = itertools.count()
_MESHES: weakref.WeakValueDictionary[int, TriangleMesh] = weakref.WeakValueDictionary()


def nearest(point: Vec, mesh: TriangleMesh, max_distance: float) -> tuple[Tensor, Vec]:
    """Return the signed distance [m] of points to a mesh, negative inside, and its outward unit gradient.

    The derivative of the distance is the gradient; the gradient itself has none.

    Args:
        point: Positions in the mesh's frame [m], planes of one shape.
        mesh: The mesh.
        max_distance: Points farther than this [m] read it, negative if inside; their gradient is (1, 0, 0), and the
            derivative 0. A small one is fast. NaN points read NaN.
    """
    stacked = torch.stack(point, dim=-1)
    flat = stacked.reshape(-1, 3).to(torch.float64).contiguous()
    distance, gradient = torch.ops.tgdsl.mesh_distance(flat, mesh.key, max_distance)
    direction = split(gradient.to(stacked.dtype).reshape(stacked.shape))
    return distance.to(stacked.dtype).reshape(stacked.shape[:-1]), vec(direction)


@torch.library.custom_op("tgdsl::mesh_distance", mutates_args=())
def mesh_distance(point: Tensor, key: int, max_distance: float) -> tuple[Tensor, Tensor]:
    """Return distances (n,) and gradients (n, 3) of float64 points (n, 3); the mesh goes by its key."""
    mesh = _MESHES.get(key)
    if mesh is None:
        raise TgdslError("this function was compiled with a mesh that no longer exists; keep the TriangleMesh alive")
    distance, gradient = point.new_empty(len(point)), torch.empty_like(point)
    if len(point):
        mesh._launch(point.detach(), max_distance, distance, gradient)
    return distance, gradient


@mesh_distance.register_fake
def _shapes(point: Tensor, key: int, max_distance: float) -> tuple[Tensor, Tensor]:
    return point.new_empty(point.shape[0]), torch.empty_like(point)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    distance, gradient = output
    ctx.mark_non_differentiable(gradient)
    ctx.save_for_backward(distance, gradient)
    ctx.max_distance = inputs[2]


def _backward(ctx: Any, of_distance: Tensor, of_gradient: Tensor | None) -> tuple[Tensor, None, None]:
    distance, gradient = ctx.saved_tensors
    is_near = distance.abs() != ctx.max_distance  # not <: NaN stays NaN
    return torch.where(is_near, of_distance, 0.0)[:, None] * gradient, None, None


mesh_distance.register_autograd(_backward, setup_context=_save)


def _split(corners: Float[np.ndarray, "f 3 3"], size: float) -> tuple[Float[np.ndarray, "p 3 3"], Int[np.ndarray, " p"]]:
    """Bisect the longest edges of thin faces until float32 finds nearest points well enough; return pieces and their faces.

    Along a triangle with longest edge L and height h, Warp's nearest point is off by some (L/h)² L of float32's precision,
    and by no more than L.
    """
    face, num_pieces = np.arange(len(corners)), 0
    done: list[tuple[np.ndarray, np.ndarray]] = []
    while len(corners):
        edges = np.roll(corners, -1, axis=1) - corners
        lengths = np.linalg.norm(edges, axis=2)
        longest, length = lengths.argmax(axis=1), lengths.max(axis=1)
        height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / np.maximum(length, np.finfo(float).tiny)
        if not done:
            is_kept = height > THINNEST * size
            corners, face, longest, length, height = (a[is_kept] for a in (corners, face, longest, length, height))
        aspect = length / np.maximum(height, np.finfo(float).tiny)
        error = np.minimum(np.finfo(np.float32).eps * aspect**2, 1.0) * length
        is_thin = (error > SEARCH_ERROR * size) & (num_pieces + 2 * len(corners) < MAX_PIECES)
        num_pieces += int((~is_thin).sum())
        done.append((corners[~is_thin], face[~is_thin]))
        order = (longest[is_thin, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[is_thin], order[..., None], axis=1).transpose(1, 0, 2)
        middle = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        face = np.tile(face[is_thin], 2)
    return np.concatenate([part for part, _ in done]), np.concatenate([part for _, part in done])


def _warp() -> Any:
    try:
        import warp
    except ImportError as error:
        raise TgdslError('distances to meshes need NVIDIA Warp: pip install "tgdsl[raycast]"') from error
    return warp


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep Warp from announcing itself and the kernels it loads."""
    wp = _warp()
    before = wp.config.log_level
    wp.config.log_level = max(before, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = before


@functools.cache
@no_type_check
def _closest() -> Any:
    """Return Warp's function for the closest point of a triangle (Ericson, *Real-Time Collision Detection*, 5.1.5)."""
    wp = _warp()

    @wp.func
    def closest(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d):
        zero = wp.float64(0.0)
        ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
        d1, d2, d3, d4, d5, d6 = wp.dot(ab, ap), wp.dot(ac, ap), wp.dot(ab, bp), wp.dot(ac, bp), wp.dot(ab, cp), wp.dot(ac, cp)
        if d1 <= zero and d2 <= zero:
            return a
        if d3 >= zero and d4 <= d3:
            return b
        if d6 >= zero and d5 <= d6:
            return c
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        if vc <= zero and d1 >= zero and d3 <= zero:
            return a + ab * (d1 / (d1 - d3))
        if vb <= zero and d2 >= zero and d6 <= zero:
            return a + ac * (d2 / (d2 - d6))
        if va <= zero and d4 >= d3 and d5 >= d6:
            return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
        return a + ab * (vb / (va + vb + vc)) + ac * (vc / (va + vb + vc))

    return closest


@functools.cache
@no_type_check
def _kernel() -> Any:
    """Return the kernel: one thread per point."""
    wp = _warp()
    closest = _closest()
    on_surface, sign_offset = wp.constant(wp.float64(ON_SURFACE)), wp.constant(wp.float64(SIGN_OFFSET))

    # fmt: off
    @wp.kernel(enable_backward=False)
    def query(
        mesh: wp.uint64, face: wp.array(dtype=wp.int32), corners: wp.array(dtype=wp.vec3d), middle: wp.vec3d, half: wp.vec3d,
        max_distance: wp.float64, points: wp.array(dtype=wp.vec3d),
        distance: wp.array(dtype=wp.float64), gradient: wp.array(dtype=wp.vec3d),
    ):
        # fmt: on
        i = wp.tid()
        p = points[i] - middle
        size = wp.float64(2.0) * wp.length(half)
        length, sign, probe = max_distance, wp.float64(1.0), p
        direction = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
        is_outside = wp.abs(p[0]) > half[0] or wp.abs(p[1]) > half[1] or wp.abs(p[2]) > half[2]
        reach = wp.float32(max_distance * wp.float64(1.00001) + wp.float64(0.00001) * size)
        found = wp.mesh_query_point_no_sign(mesh, wp.vec3(p), reach)
        if found.result:
            k = 3 * face[found.face]
            away = p - closest(corners[k], corners[k + 1], corners[k + 2], p)
            if wp.length(away) < max_distance:
                length = wp.length(away)
                direction = away / length
                probe = p + wp.max(sign_offset * size - length, wp.float64(0.0)) * direction
                if length < on_surface * size:
                    direction = wp.normalize(wp.cross(corners[k + 1] - corners[k], corners[k + 2] - corners[k]))
                    sign = wp.where(wp.dot(away, direction) < wp.float64(0.0), wp.float64(-1.0), sign)
                    direction = sign * direction
                    is_outside = True
        if not is_outside:
            sign = wp.float64(wp.mesh_query_point_sign_winding_number(mesh, wp.vec3(probe), wp.inf).sign)
        distance[i] = sign * length
        gradient[i] = wp.where(length < max_distance, sign, wp.float64(1.0)) * direction
        if wp.isnan(p):
            distance[i] = wp.float64(wp.nan)
            gradient[i] = wp.vec3d(wp.float64(wp.nan))

    return query
