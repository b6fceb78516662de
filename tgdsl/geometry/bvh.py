"""Signed distance to a triangle mesh by nearest-point queries over a bounding-volume hierarchy, with NVIDIA Warp.

Warp's queries run in float32. They only choose the nearest face; its nearest point, the distance and the gradient are then
computed in float64, about the middle of the mesh. Faces too thin for float32 stand in a second hierarchy, of boxes, and are
compared in float64. So float32 enters through near ties alone: the distance is good to 1e-6 of the mesh's size.

A point is inside where the mesh's generalized winding number exceeds 1/2 (Jacobson et al., *Robust Inside-Outside
Segmentation using Generalized Winding Numbers*, 2013; approximated after Barill et al., 2018). On closed meshes the sign is
exact, at edges and corners too. Closed parts that overlap form a union, but the nearest triangle may lie inside it.
- A hole reads as if a smooth membrane closed it. Across it the distance jumps from +d to −d, d being that to the nearest face.
- A flat sheet encloses nothing, nor do two coincident sides: the distance is positive on both sides.
- Points outside the bounding box are outside. A mesh turned inside out is outside everywhere.

Shapes: `v` vertices, `f` faces, `t` thin faces.
"""

# pyright: reportInvalidTypeForm=false
from __future__ import annotations

import contextlib
import functools
import itertools
import math
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import TgdslError
from tgdsl.geometry.planes import Vec, split

ON_SURFACE = 1e-7  # points nearer than this fraction of the mesh's size are on the surface: their gradient is the face's normal
SIGN_OFFSET = 2e-6
"""The winding number is evaluated at least this fraction of the mesh's size off the surface, well clear of rounding."""
SEARCH_ERROR = 2e-6
"""Error that float32's search may make, as a fraction of the mesh's size; faces too thin for it are compared in float64."""


class TriangleMesh:
    """Triangles to ask distances of, with one hierarchy per device, built when a point on that device first asks.

    Copies and pickles hold the triangles and build again. The mesh must outlive whatever was compiled with it. Vertices are in
    the mesh's frame [m], faces counter-clockwise seen from outside, at least one with an area.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]):
        """Raise `TgdslError` if Warp is missing."""
        _warp()
        self.vertices, self.faces, self.key = vertices, faces, next(_KEYS)  # the key names the mesh to the operator
        corners = vertices.astype(np.float64)[faces]
        corners = corners[np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0]
        lower, upper = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self._middle, self._half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        self._corners = corners - self._middle
        self._thin = _thin(self._corners, SEARCH_ERROR * float(np.linalg.norm(upper - lower)))
        self._built: dict[str, tuple[Any, ...]] = {}
        _MESHES[self.key] = self

    def __reduce__(self) -> tuple[type[TriangleMesh], tuple[np.ndarray, np.ndarray]]:
        return TriangleMesh, (self.vertices, self.faces)

    def _on(self, device: Any) -> tuple[Any, ...]:
        """Return Warp's mesh, the corners of its faces, the boxes of the thin ones, and their faces; all about the middle."""
        if str(device) not in self._built:
            wp = _warp()
            corners = self._corners.reshape(-1, 3)
            points = wp.array(corners.astype(np.float32), dtype=wp.vec3, device=device)
            indices = wp.array(np.arange(len(points), dtype=np.int32), device=device)
            bounds = [end(self._corners[self._thin], axis=1).astype(np.float32) for end in (np.min, np.max)]
            self._built[str(device)] = (
                wp.Mesh(points, indices, support_winding_number=True),
                wp.array(corners, dtype=wp.vec3d, device=device),
                wp.Bvh(*(wp.array(end, dtype=wp.vec3, device=device) for end in bounds)) if len(self._thin) else None,
                wp.array(self._thin.astype(np.int32), dtype=wp.int32, device=device),
            )
            wp.synchronize_device(device)
        return self._built[str(device)]

    def _launch(self, point: Tensor, own: int, which: Tensor, max_distance: float, out: tuple[Tensor, Tensor]) -> None:
        """Write distance and gradient of the points whose `which` is `own`; of all if `which` is empty."""
        with _quiet() as wp:
            mesh, corners, boxes, faces = self._on(wp.device_from_torch(point.device))
            inputs = [mesh.id, corners, boxes.id if boxes else 0, faces, wp.vec3d(*self._middle), wp.vec3d(*self._half)]
            inputs += [max_distance, own, wp.from_torch(which, dtype=wp.int32), wp.from_torch(point, dtype=wp.vec3d)]
            inputs += [wp.from_torch(out[0], dtype=wp.float64), wp.from_torch(out[1], dtype=wp.vec3d)]
            stream = wp.stream_from_torch(point.device) if point.is_cuda else None
            wp.launch(_kernel(wp), dim=len(point), inputs=inputs, device=mesh.device, stream=stream)


_NODE_OPERATIONS, _FACE_OPERATIONS = 40, 100
"""Approximate operations per opened box of the hierarchy, and per face whose nearest point is computed."""


def query_operations(point: Tensor, which: Tensor, keys: Sequence[int]) -> int:
    """Return about how many elementary operations `mesh_distance` takes: two descents of the hierarchy for each point.

    One is for the nearest face, one for the winding number; each opens about two boxes per level, and eight faces.
    """
    num_faces = max(len(_MESHES[key].faces) for key in keys)
    return 2 * len(point) * round(2 * math.log2(num_faces + 1) * _NODE_OPERATIONS + 8 * _FACE_OPERATIONS)


_SCHEMA = "(Tensor point, Tensor which, int[] keys, float max_distance) -> (Tensor, Tensor)"
_KEYS = itertools.count()
_MESHES: weakref.WeakValueDictionary[int, TriangleMesh] = weakref.WeakValueDictionary()


def nearest(
    point: Vec, meshes: Sequence[TriangleMesh], max_distance: float, which: Int[Tensor, "*point"] | None = None
) -> tuple[Tensor, Vec]:
    """Return the signed distance [m] of points to a mesh, negative inside, and its outward unit gradient.

    The derivative of the distance is the gradient; the gradient itself has none. Points outside that are farther than
    `max_distance` [m] read it; their gradient is (1, 0, 0), and the derivative 0. Inside there is no limit. NaN reads NaN.
    With several meshes `which` is the index of each point's mesh.
    """
    stacked = torch.stack(point, dim=-1)
    flat = stacked.reshape(-1, 3).to(torch.float64).contiguous()
    mesh_of_point = flat.new_empty(0) if which is None else which.expand(point[0].shape).reshape(-1)
    keys = [mesh.key for mesh in meshes]
    distance, gradient = torch.ops.tgdsl.mesh_distance(flat, mesh_of_point.to(torch.int32), keys, max_distance)
    return distance.to(stacked.dtype).reshape(point[0].shape), split(gradient.to(stacked.dtype).reshape(stacked.shape))


@torch.library.custom_op("tgdsl::mesh_distance", mutates_args=(), schema=_SCHEMA)
def mesh_distance(point: Tensor, which: Tensor, keys: list[int], max_distance: float) -> tuple[Tensor, Tensor]:
    """Return distances (n,) and gradients (n, 3) of float64 points (n, 3); the meshes go by their keys."""
    out = _empty(point, which, keys, max_distance)
    for slot, key in enumerate(keys):
        mesh = _MESHES.get(key)
        if mesh is None:
            raise TgdslError("this function was compiled with a mesh that no longer exists; keep the TriangleMesh alive")
        if len(point):
            mesh._launch(point.detach().contiguous(), slot, which.contiguous(), max_distance, out)
    return out


@mesh_distance.register_fake
def _empty(point: Tensor, which: Tensor, keys: list[int], max_distance: float) -> tuple[Tensor, Tensor]:
    return point.new_empty(point.shape[0]), point.new_empty(point.shape)


def _save(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(*output)
    ctx.max_distance = inputs[3]


def _backward(ctx: Any, of_distance: Tensor, of_gradient: Tensor | None) -> tuple[Tensor, None, None, None]:
    distance, gradient = ctx.saved_tensors
    is_near = distance.abs() != ctx.max_distance  # not <: NaN stays NaN
    return torch.where(is_near, of_distance, 0.0)[:, None] * gradient, None, None, None


mesh_distance.register_autograd(_backward, setup_context=_save)


def _thin(corners: Float[np.ndarray, "f 3 3"], tolerance: float) -> Int[np.ndarray, " t"]:
    """Return the faces on which float32 may misplace the nearest point by more than a tolerance [m]."""
    # With longest edge L and height h, Warp's point is off along the face by (L/h)² L of float32's precision, at most by L.
    edges = np.roll(corners, -1, axis=1) - corners
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    aspect = longest**2 / np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return np.flatnonzero(np.minimum(np.finfo(np.float32).eps * aspect**2, 1.0) * longest > tolerance)


def _warp() -> Any:
    try:
        import warp
    except ImportError as error:
        raise TgdslError('distances to meshes need NVIDIA Warp: pip install "tgdsl[raycast]"') from error
    return warp


@contextlib.contextmanager
def _quiet() -> Iterator[Any]:
    """Yield Warp with its log messages below errors off."""
    wp = _warp()
    log_level = wp.config.log_level
    wp.config.log_level = max(log_level, wp.LOG_ERROR)
    try:
        wp.init()
        yield wp
    finally:
        wp.config.log_level = log_level


@functools.cache
@no_type_check
def _kernel(wp: Any) -> Any:
    """Return the kernel: one thread per point."""
    on_surface, sign_offset = wp.constant(wp.float64(ON_SURFACE)), wp.constant(wp.float64(SIGN_OFFSET))

    @wp.func
    def away_from(face: wp.int32, corners: Any, p: wp.vec3d):
        """From a face's closest point to a point (Ericson, *Real-Time Collision Detection*, 5.1.5)."""
        a, b, c, zero = corners[3 * face], corners[3 * face + 1], corners[3 * face + 2], wp.float64(0.0)
        ab, ac, ap, bp, cp = b - a, c - a, p - a, p - b, p - c
        d1, d2, d3, d4, d5, d6 = wp.dot(ab, ap), wp.dot(ac, ap), wp.dot(ab, bp), wp.dot(ac, bp), wp.dot(ab, cp), wp.dot(ac, cp)
        if d1 <= zero and d2 <= zero:
            return ap
        if d3 >= zero and d4 <= d3:
            return bp
        if d6 >= zero and d5 <= d6:
            return cp
        va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
        if vc <= zero and d1 >= zero and d3 <= zero:
            return ap - ab * (d1 / (d1 - d3))
        if vb <= zero and d2 >= zero and d6 <= zero:
            return ap - ac * (d2 / (d2 - d6))
        if va <= zero and d4 >= d3 and d5 >= d6:
            return bp - (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
        return ap - ab * (vb / (va + vb + vc)) - ac * (vc / (va + vb + vc))

    @wp.func
    def nearest_face(
        mesh: wp.uint64, corners: Any, boxes: wp.uint64, faces: Any, p: wp.vec3d, size: wp.float64, reach: wp.float64
    ):
        """The nearest face, −1 if none is within reach, and the vector from it to the point."""
        face, best, length = wp.int32(-1), wp.vec3d(), wp.float64(reach)
        slack = wp.float64(1e-5) * size
        hit = wp.mesh_query_point_no_sign(mesh, wp.vec3(p), wp.float32(wp.float64(1.00001) * reach + slack))
        if hit.result:
            away = away_from(hit.face, corners, p)
            if wp.length(away) < length:
                face, best, length = wp.int32(hit.face), away, wp.length(away)
        if boxes != wp.uint64(0):
            near = wp.bvh_query_sphere(boxes, wp.vec3(p), wp.float32(wp.float64(1.00001) * length + slack))
            item = wp.int32(0)
            while wp.bvh_query_next(near, item):
                away = away_from(faces[item], corners, p)
                if wp.length(away) < length:
                    face, best, length = wp.int32(faces[item]), away, wp.length(away)
        return face, best

    # fmt: off
    @wp.kernel(enable_backward=False)
    def query(
        mesh: wp.uint64, corners: wp.array(dtype=wp.vec3d), boxes: wp.uint64, faces: wp.array(dtype=wp.int32),
        middle: wp.vec3d, half: wp.vec3d, max_distance: wp.float64, own: wp.int32, which: wp.array(dtype=wp.int32),
        points: wp.array(dtype=wp.vec3d), distance: wp.array(dtype=wp.float64), gradient: wp.array(dtype=wp.vec3d),
    ):
        # fmt: on
        i = wp.tid()
        if which.shape[0] > 0:  # noqa: SIM102 (both sides of Warp's `and` are evaluated)
            if which[i] != own:
                return
        p = points[i] - middle
        size, zero, one = wp.float64(2.0) * wp.length(half), wp.float64(0.0), wp.float64(1.0)
        face, away = nearest_face(mesh, corners, boxes, faces, p, size, max_distance)
        length, sign, probe, direction = max_distance, one, p, wp.vec3d(one, zero, zero)
        is_decided = wp.abs(p[0]) > half[0] or wp.abs(p[1]) > half[1] or wp.abs(p[2]) > half[2]
        if face < 0 and not is_decided:
            inside = wp.mesh_query_point_sign_winding_number(mesh, wp.vec3(p), wp.inf)
            is_decided = True
            if inside.result and inside.sign < 0.0:
                sign = -one
                face, away = nearest_face(mesh, corners, boxes, faces, p, size, size)
        if face >= 0:
            length = wp.length(away)
            direction = away / length
            probe = p + wp.max(sign_offset * size - length, zero) * direction
            if length < on_surface * size:
                k = 3 * face
                direction = wp.normalize(wp.cross(corners[k + 1] - corners[k], corners[k + 2] - corners[k]))
                sign = wp.where(wp.dot(away, direction) < zero, -one, one)
                direction = sign * direction
                is_decided = True
        if not is_decided:
            hit = wp.mesh_query_point_sign_winding_number(mesh, wp.vec3(probe), wp.inf)
            sign = wp.where(hit.result and hit.sign < 0.0, -one, one)
        distance[i] = wp.where(wp.isnan(p), wp.float64(wp.nan), sign * length)
        gradient[i] = wp.where(wp.isnan(p), wp.vec3d(wp.float64(wp.nan)), wp.where(face >= 0, sign, one) * direction)

    return query
