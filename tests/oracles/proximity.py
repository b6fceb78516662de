"""Moments of the surface within a probe's radius, and readings of `proximity`.

S0 = ∫ (R − |p − q|)₊ dA, S1 = ∫ (R − |p − q|)₊ (p − q) dA over the points p of a surface, q the probe.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.integrate import quad

from oracles.comparison import Values, field
from oracles.setups.scenes import BOX, probed, state
from tgdsl.geometry.planes import split
from tgdsl.quantities.moment_fields import bake_field, moment_sums, sample_cloud, surface_area
from tgdsl.quantities.moment_sums import MomentField, PointCloud, cloud_moments, field_moments, plane_moments
from tgdsl.surfaces.geom import Geom, SurfaceGeom
from tgdsl.surfaces.quadrature import outer_surface
from tgdsl.surfaces.surface import Surface

R = 0.01
"""Radius of the probes [m]."""
TOLERANCE, LIMIT, COARSE = 0.008, 0.01, 0.04
"""Tolerance of a field; allowed error at other points than the compiler's; tolerance of fields in other tests."""
PLANE = '<geom type="plane" size="1 1 .1"/>'
AREA = 6 * 0.04**2
DENSITY = 100 / AREA
STIFFNESS, SLIP = 300.0, 10.0
"""The paper's k_n and k_s."""
SOURCE = "Chung et al., appendix, ProximityTaxel; S0 and S1 by hand"
oracle = field("proximity", "proximity")
CHANNELS = ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z")


def geom_of(shape: str, size: Sequence[Any], pos: Sequence[Any] = (0, 0, 0), surface: Surface | None = None) -> SurfaceGeom:
    """Return an object's geom with a size [m] at a position [m]."""
    whole = np.array([*size, 0, 0][:3], float)
    kind = "mesh" if surface is not None else shape
    return SurfaceGeom(Geom(0, "", "", "body", kind, whole, np.array(pos, float), np.eye(3), True), surface)


def places(count: int = 400, seed: int = 5, extent: float = 0.028) -> np.ndarray:
    """Return points all over a ball, other than the compiler's [m]."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    return extent * np.cbrt(rng.uniform(size=(count, 1))) * way / np.linalg.norm(way, axis=1, keepdims=True)


def sphere_moments(pos: np.ndarray, b: float = 0.02, radius: float = R) -> np.ndarray:
    """Return S0 and S1 (point, 4) of a ball of radius b [m].

    With the distance D of the centre: dA = 2π (b/D) r dr, and p − q has the component (D² + r² − b²)/2D towards it.
    """
    moments = []
    for q in pos:
        d = float(np.linalg.norm(q))
        low, high, mass, toward = abs(d - b), min(radius, d + b), 0.0, 0.0
        if low < high:
            mass = 2 * np.pi * b / d * quad(lambda r: (radius - r) * r, low, high)[0]
            toward = 2 * np.pi * b / d * quad(lambda r: (radius - r) * r * (d**2 + r**2 - b**2) / (2 * d), low, high)[0]  # noqa: B023
        moments.append([mass, *(-toward * q / d)])
    return np.array(moments)


def box_moments(pos: np.ndarray, half: Sequence[Any], radius: float = R, num: int = 120) -> np.ndarray:
    """Return S0 and S1 (point, 4) of a box by midpoint sums over each face."""
    moments = np.zeros((len(pos), 4))
    for axis in range(3):
        u, v = ((axis + k) % 3 for k in (1, 2))
        line = (np.arange(num) + 0.5) / num * 2 - 1
        grid = np.zeros((num * num, 3))
        grid[:, u], grid[:, v] = (part.ravel() for part in np.meshgrid(line * half[u], line * half[v]))
        area = 4 * half[u] * half[v] / num**2
        for sign in (-1, 1):
            grid[:, axis] = sign * half[axis]
            for i, q in enumerate(pos):
                way = grid - q
                weight = area * np.maximum(radius - np.sqrt((way**2).sum(axis=1)), 0)
                moments[i] += [weight.sum(), *(weight @ way)]
    return moments


def rms(moments: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    """Return RMS errors of S0 and S1 over their full scale."""
    error = moments - exact
    full = np.abs(exact[:, 0]).max(), np.linalg.norm(exact[:, 1:4], axis=1).max()
    mean = np.mean(error[:, 0] ** 2), np.mean((error[:, 1:4] ** 2).sum(axis=1))
    return float(np.sqrt(mean[0]) / full[0]), float(np.sqrt(mean[1]) / full[1])


def sums(geoms: list[SurfaceGeom], pos: np.ndarray, radius: float = R, spacing: float = R / 8, channels: int = 4) -> np.ndarray:
    """Return tgdsl's sums over a fine surface (point, channel)."""
    return moment_sums(outer_surface(geoms, spacing).quadrature(spacing), pos, radius, channels, 1)


def field_reads(baked: Any, pos: np.ndarray) -> np.ndarray:
    """Return the readings of a field (point, channel), with slopes if it has them."""
    *num, channels = baked.values.shape
    place, cell = split(torch.tensor(baked.origin)), torch.tensor(baked.cell, dtype=torch.float64)
    flat = torch.tensor(baked.values.reshape(-1, channels), dtype=torch.float64)
    parts: list[torch.Tensor] = []
    for start in range(0, channels, 4):
        field = MomentField(flat[:, start : start + 4], 0, tuple(num), place, cell)
        mass, first = field_moments(split(torch.tensor(pos)), field)
        parts += [mass, *first]
    return torch.stack(parts, dim=1).numpy()


def cloud_reads(cloud: Any, pos: np.ndarray, radius: float = R) -> np.ndarray:
    """Return sums over sampled points (point, 4), as in the paper."""
    grown = np.concatenate([cloud.points, [[1e6] * 3]])
    x, y, z = (torch.tensor(part) for part in grown.T.copy())
    place, cell = split(torch.tensor(cloud.origin)), torch.tensor(cloud.cell, dtype=torch.float64)
    weight = torch.tensor(cloud.weight, dtype=torch.float64)
    whole = PointCloud((x, y, z), weight, torch.tensor(cloud.lists), 0, cloud.num, place, cell)
    mass, first = cloud_moments(split(torch.tensor(pos)), whole, torch.full((len(pos),), radius, dtype=torch.float64))
    return torch.stack([mass, *first], dim=1).numpy()


def over_a_plane(d: float) -> float:
    """Return S0 [m³] of a plane at a distance [m]."""
    return 2 * np.pi * (R**3 / 6 - R * d**2 / 2 + d**3 / 3)


@oracle(
    "Moments of a plane", "S0 = ∫ 2πs (R − √(s² + z²)) ds", "quadrature over the disc", "S0/R³, S1_z/R⁴ [1]", "height [m]",
    rtol=1e-10, atol=1e-14, series=("S0", "S1_z"),
)  # fmt: skip
def plane_integral(heights: tuple[float, ...] = (0.0, 0.003, -0.003, 0.0099, 0.01, 0.02, -0.5)):
    exact, ours = [], []
    for height in heights:
        d = abs(height)
        rim = np.sqrt(max(R**2 - d**2, 0.0))
        area = quad(lambda s: 2 * np.pi * s * (R - np.hypot(s, d)), 0, rim, epsabs=1e-18)[0]  # noqa: B023
        place = split(torch.tensor([0.3, -0.2, height], dtype=torch.float64))
        mass, first = plane_moments(place, torch.tensor(R, dtype=torch.float64))
        exact.append([area / R**3, -height * area / R**4])
        ours.append([float(mass) / R**3, float(first[2]) / R**4 if float(first[0]) == float(first[1]) == 0 else np.nan])
    return Values(np.array(exact).T, np.array(ours).T, at=heights)


@oracle(
    "Moments of a {solid}", "S0, S1", "one-dimensional quadrature over the ball; midpoint sums over the box's faces",
    "RMS error over full scale, over the tolerance [1]",
    at=["S0 of sums", "S1 of sums", "S0 of the field", "S1 of the field"], atol=1.0, each=["ball", "box"], slow=True,
)  # fmt: skip
def solid_moments(solid: str):
    if solid == "ball":
        geom, pos, closed = geom_of("sphere", [0.02]), places(), partial(sphere_moments, b=0.02)
    else:
        half = [0.02, 0.015, 0.01]
        geom, pos, closed = geom_of("box", half), places(150), partial(box_moments, half=half)
    exact = closed(pos)
    by_sums, by_field = rms(sums([geom], pos), exact), rms(field_reads(bake_field([geom], R, TOLERANCE), pos), exact)
    few = rms(cloud_reads(sample_cloud([geom], R, 5_000), pos), exact)
    allowed = np.array([2e-3, 2e-3, LIMIT, LIMIT])
    return 0.0, np.array([*by_sums, *by_field]) / allowed, np.array([*few, *few]) / allowed


@oracle(
    "Sampled points err by the root of their number", "ε ∝ 1/√N", "variance of a sum over independent points",
    "error of 5,000 over that of 100,000 points [1]", at=["S0"], rtol=0.4, slow=True,
)  # fmt: skip
def sampling_noise():
    pos = places(200)
    exact = box_moments(pos, [0.02] * 3)
    few, many = (rms(cloud_reads(sample_cloud([geom_of("box", [0.02] * 3)], R, n), pos), exact)[0] for n in (5_000, 100_000))
    return np.sqrt(20), few / many


def _scalene(a: float, b: float, c: float) -> float:
    """Return the area of an ellipsoid by Gauss–Legendre quadrature of its first fundamental form."""
    node, weight = np.polynomial.legendre.leggauss(200)
    u, v = (node[:, None] + 1) * np.pi / 2, (node + 1) * np.pi
    x, y, z = np.sin(u) * np.cos(v) * b * c, np.sin(u) * np.sin(v) * a * c, np.cos(u) * a * b + 0 * v
    form = np.sin(u) * np.sqrt(x**2 + y**2 + z**2)
    return float(weight @ form @ weight * np.pi / 2 * np.pi)


AREAS: dict[str, tuple[list[float], float]] = {
    "sphere": ([0.025], 4 * np.pi * 0.025**2),
    "capsule": ([0.01, 0.02], 4 * np.pi * 0.01**2 + 2 * np.pi * 0.01 * 0.04),
    "cylinder": ([0.012, 0.02], 2 * np.pi * 0.012**2 + 2 * np.pi * 0.012 * 0.04),
    "box": ([0.01, 0.02, 0.03], 8 * (2 + 3 + 6) * 1e-4),
    "ellipsoid": ([0.01, 0.02, 0.035], _scalene(0.01, 0.02, 0.035)),
    "ellipsoid of revolution": (
        [0.01, 0.01, 0.03],
        2 * np.pi * 0.01**2 * (1 + 3 / np.sqrt(8 / 9) * np.arcsin(np.sqrt(8 / 9))),
    ),
    "ellipsoid, almost a sphere": ([0.02, 0.02 + 1e-9, 0.02], 4 * np.pi * 0.02**2),
}
"""Sizes [m] and areas [m²] of primitives."""


@field("proximity", "proximity", "geometry")(
    "Areas of primitives", "A", "geometry; an ellipsoid by quadrature, one of revolution in closed form",
    "area over the exact one, off 1 over the tolerance [1]", atol=1.0,
)  # fmt: skip
def areas(names: Sequence[str] = tuple(AREAS)):
    ours = [surface_area([geom_of(name.split()[0].rstrip(","), AREAS[name][0], pos=(0.1, -0.2, 0.3))]) for name in names]
    exact = np.array([AREAS[name][1] for name in names])
    allowed = np.array([1e-7 if "almost" in name else 1e-10 for name in names])
    return Values(0.0, (np.array(ours) / exact - 1) / allowed, at=names)


def read(geom: str = PLANE, probe: Any = (0, 0, 0), sensor: Any = None, **item: Any) -> np.ndarray:
    """Return a probe's reading of force [N] and torque [N·m]."""
    values = {"reference_area": AREA, "tolerance": COARSE, **(sensor or {})}
    touch = probed([probe], geom, gate=None, kind="proximity", **values)
    return touch(state(touch, **item))["s"][0, 0].numpy()


reading = partial(
    oracle, source=SOURCE, quantity="force [N], torque [N·m] []", at=CHANNELS, rtol=1e-12, atol=1e-15
)  # fmt: skip


@reading("A plane in front pushes the sensor back", "f = −k ρ S0 n", defects=(3,))
def plane_in_front(d: float = 0.004):
    ours, paper = (read(sensor=model, pos=[0.2, 0.1, d], quat=[0, 1, 0, 0]) for model in ({}, {"model": "paper"}))
    return [0, 0, -STIFFNESS * DENSITY * over_a_plane(d), 0, 0, 0], ours, paper


@reading("A plane at the side twists the sensor, about the {about}", "τ = −k ρ S1 × a", defects=(24,), each=["taxel", "link"])
def plane_at_the_side(about: str, d: float = 0.006):
    quat = [np.sqrt(0.5), 0, -np.sqrt(0.5), 0]  # its normal points to −x
    ours, paper = (
        read(probe=(0.02, 0, 0), sensor={"torque_about": about, **model}, pos=[0.026, 0, 0], quat=quat)
        for model in ({}, {"model": "paper"})
    )
    force, arm = -STIFFNESS * DENSITY * over_a_plane(d), {"taxel": 0.0, "link": 0.02}[about]
    return [0, 0, force, 0, STIFFNESS * DENSITY * d * over_a_plane(d) - arm * force, 0], ours, paper


@oracle(
    "Slip drags the sensor along with the object", "f_t = k_s ρ S0 v_t", SOURCE, "change of force [N], torque [N·m] []",
    at=CHANNELS, atol=1e-12, defects=(3,),
)  # fmt: skip
def slip():
    at: dict[str, Any] = {"pos": [0, 0, -0.026]}
    still, moving = read(BOX, **at), read(BOX, **at, linvel=[0.3, -0.1, 0.7])
    s0 = -still[2] / (STIFFNESS * DENSITY)
    return [SLIP * DENSITY * s0 * 0.3, -SLIP * DENSITY * s0 * 0.1, 0, 0, 0, 0], moving - still
