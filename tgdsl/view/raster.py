"""A rasteriser: an orthographic camera, a z-buffer and diffuse shading, in NumPy; no GL, no display.

Shapes: `face` triangles, `h` and `w` rows and columns of pixels, row 0 at the bottom.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray
_FRAGMENTS = 100_000  # drawn at a time, to bound memory


class Camera(NamedTuple):
    """An orthographic camera: world unit vectors to the right and top of its image and to the viewer; the point it looks at."""

    right: Float[Array, " 3"]
    up: Float[Array, " 3"]
    toward: Float[Array, " 3"]
    centre: Float[Array, " 3"]

    def project(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return image x, image y and nearness to the camera [m], from the centre."""
        return (points - self.centre) @ np.stack([self.right, self.up, self.toward]).T


class Viewport(NamedTuple):
    """The pixels that a part of a camera's image fills."""

    camera: Camera
    corner: Float[Array, " 2"]  # the lower left pixel on the camera's image [m]
    scale: float  # pixels per metre
    width: int
    height: int

    def project(self, points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
        """Return column [pixel], row [pixel] and nearness to the camera [m]."""
        placed = self.camera.project(points)
        placed[..., :2] = (placed[..., :2] - self.corner) * self.scale
        return placed


class Mesh(NamedTuple):
    """Triangles in the world: corners [m], unit normals at the corners, and the body of each."""

    corners: Float[Array, "face 3 3"]
    normals: Float[Array, "face 3 3"]
    body: Int[Array, " face"]


class Fragments(NamedTuple):
    """What each pixel shows: nearness to the camera [m] (−inf: nothing), the face, and its barycentric weights there."""

    nearness: Float[Array, "h w"]
    face: Int[Array, "h w"]
    weights: Float[Array, "h w 3"]


def viewport_for(camera: Camera, box: Float[Array, "2 2"], width: int, height: int) -> Viewport:
    """Return the viewport that shows a part of the camera's image, lower and upper corner [m], as large as it can."""
    scale = min(width / (box[1, 0] - box[0, 0]), height / (box[1, 1] - box[0, 1]))
    return Viewport(camera, box.mean(axis=0) - np.array([width, height]) / 2 / scale, scale, width, height)


def rasterise(corners: Float[Array, "face 3 3"], width: int, height: int) -> Fragments:
    """Return what each pixel shows of triangles whose corners are (column [pixel], row [pixel], nearness [m])."""
    face, row, left, right = _scanlines(corners, width, height)
    count = right - left + 1
    fragments = Fragments(np.full(height * width, -np.inf), np.full(height * width, -1), np.zeros((height * width, 3)))
    chunk = np.cumsum(count) // _FRAGMENTS
    for run in np.split(np.arange(len(face)), np.flatnonzero(np.diff(chunk)) + 1):
        column = np.arange(count[run].sum()) - np.repeat(np.cumsum(count[run]) - count[run] - left[run], count[run])
        _draw(fragments, corners, np.repeat(face[run], count[run]), np.repeat(row[run], count[run]), column, width)
    return Fragments(*(part.reshape(height, width, *part.shape[1:]) for part in fragments))


def _draw(fragments: Fragments, corners: Array, face: Array, row: Array, column: Array, width: int) -> None:
    """Draw triangles at some pixels where they are nearer than the present fragments."""
    is_next = np.diff(face, prepend=face[:1]) > 0  # faces ascend
    drawn, index = np.concatenate([face[:1], face[is_next]]), np.cumsum(is_next)
    start = corners[drawn, 0, :2]
    (x, y), (x_end, y_end) = (corners[drawn, 1, :2] - start).T, (corners[drawn, 2, :2] - start).T
    area = x * y_end - x_end * y
    area = np.where(area == 0, np.inf, area)  # seen edge-on: its first corner stands for it
    u, v = (np.stack([column, row], axis=-1) - start[index]).T
    second = (u * (y_end / area)[index] - v * (x_end / area)[index], v * (x / area)[index] - u * (y / area)[index])
    weights = np.clip(np.stack([1 - second[0] - second[1], *second], axis=-1), 0, 1)
    nearness = (weights * corners[face, :, 2]).sum(axis=1)
    pixel = row * width + column
    np.maximum.at(fragments.nearness, pixel, nearness)
    won = nearness == fragments.nearness[pixel]
    fragments.face[pixel[won]] = face[won]
    fragments.weights[pixel[won]] = weights[won]


def _scanlines(corners: Array, width: int, height: int) -> tuple[Array, Array, Array, Array]:
    """Return face, row, first and last column of each run of pixels, at least one, that a triangle covers in a row."""
    low = np.maximum(np.ceil(corners[:, :, 1].min(axis=1)), 0).astype(int)
    high = np.minimum(np.floor(corners[:, :, 1].max(axis=1)), height - 1).astype(int)
    count = np.maximum(high - low + 1, 0)
    face = np.repeat(np.arange(len(corners)), count)
    row = np.repeat(low, count) + np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    left, right = np.full(len(face), np.inf), np.full(len(face), -np.inf)
    for first, second in ((0, 1), (1, 2), (2, 0)):
        (x, y), (x_end, y_end) = corners[face, first, :2].T, corners[face, second, :2].T
        rise = np.where(y_end == y, np.nan, y_end - y)
        part = (row - y) / rise
        crossing = np.where((part >= 0) & (part <= 1), x + part * (x_end - x), np.nan)
        left, right = np.fmin(left, crossing), np.fmax(right, crossing)
    left, right = np.where(left > right, 1, left), np.where(left > right, 0, right)
    first = np.maximum(np.ceil(left - 1e-9), 0).astype(int)
    last = np.minimum(np.floor(right + 1e-9), width - 1).astype(int)
    is_run = last >= first
    return face[is_run], row[is_run], first[is_run], last[is_run]


def shade(image: Array, fragments: Fragments, mesh: Mesh, colour: Array, viewport: Viewport, opacity: float = 1.0) -> Array:
    """Return the image with a mesh drawn over it: lit from the upper right, edges in depth drawn dark."""
    drawn, camera = fragments.face >= 0, viewport.camera
    face, weights = fragments.face[drawn], fragments.weights[drawn]
    normal = np.einsum("pi,pij->pj", weights, mesh.normals[face])
    normal *= np.where(normal @ camera.toward < 0, -1, 1)[:, None]
    lit = 0.55 + 0.5 * np.clip(normal @ light_direction(camera), 0, 1)
    image[drawn] += opacity * (np.minimum(colour[face] * lit[:, None], 1) - image[drawn])
    near, edge = np.where(drawn, fragments.nearness, -1.0), max(6 / viewport.scale, 0.002)
    is_edge = np.zeros(near.shape, dtype=bool)
    is_edge[:-1] = np.abs(np.diff(near, axis=0)) > edge
    is_edge[:, :-1] |= np.abs(np.diff(near, axis=1)) > edge
    image[is_edge] *= 0.62
    return image


def light_direction(camera: Camera) -> Float[Array, " 3"]:
    """Return the direction to the light: behind the camera, to the upper right."""
    return unit(0.85 * camera.toward + 0.4 * camera.up + 0.35 * camera.right, camera.toward)


def downsample(image: Float[Array, "h w 3"], factor: int) -> Array:
    """Return an image with `factor` times fewer rows and columns; each pixel is the mean of `factor`² pixels."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))


def unit(vector: Array, otherwise: Array) -> Array:
    """Return a vector at unit length, or another one where it vanishes."""
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-9 else otherwise
