"""Displacements of an elastomer's markers by hand: a ball pressed on two taxels and moved along them; resolution; curvature.

"The paper" is `model: paper` with `normalize: peak`, the formula as printed.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from oracles.half_space import KINDS
from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.scenes import probed, state
from tgdsl.sensors.elastomer.blocks import responses
from tgdsl.sensors.elastomer.half_space import half_space, patch_radius
from tgdsl.sensors.elastomer.kernels import Gaussian, LinkTaxels, offset
from tgdsl.sensors.elastomer.spec import ElastomerSpec

DEPTH = 5e-4
"""How deep the ball is in the first taxel [m]."""
BALL = '<geom type="sphere" size=".01"/>'
PROBES = [(0.0, 0.0, 0.0), (0.004, 0.003, 0.0)]
APART = np.array([0.004, 0.003, 0.0])
AREA = np.pi * 1e-4
"""Area of a taxel of the scene, a disc of its radius of 10 mm [m²]."""
WEIGHT = AREA / 6e-6
"""The same over the reference area."""
STRENGTH, DILATION, SHEAR, ALPHA = 100.0, 8000.0, 2000.0, 1.2
"""The paper's s_d = s_s, λ_d, λ_s [1/m²] and α."""
ELASTIC: dict[str, Any] = {"kernel": "half_space", "youngs_modulus": 2e5, "poissons_ratio": 0.48, "normal_stiffness": 1e8}
SOURCE = "Chung et al., appendix, ElastomerTaxel"
NAMES = tuple(f"u_{a}, {where}" for where in ("source", "5 mm off") for a in "xyz")


def pressed(way: Any = (0.0, 0.0), probes: Any = PROBES, depth: float = DEPTH, **sensor: Any) -> np.ndarray:
    """Return displacements (taxel, 3) [m] under a ball over the first taxel, some depth into it, then moved along the skin."""
    touch = probed(probes, BALL, kind="elastomer", **sensor)
    touch(state(touch, pos=[0, 0, 0.01 - depth]))
    return touch(state(touch, pos=[*way, 0.01 - depth]))["s"][0].numpy()


def _by_hand(name: str, equation: str, exact: Any, ours: np.ndarray, **more: Any) -> Comparison:
    given = {"over": cases(NAMES), "source": SOURCE, "rtol": 1e-12, "atol": 1e-18, **more}
    source, over = given.pop("source"), given.pop("over")
    return Comparison(name, source, equation, KINDS, "displacement", "m", over, array(exact), ours, **given)


def dilation() -> Comparison:
    """Return what one pressed taxel does to itself and to another: the printed formula, without ḡ, weighted with areas."""
    g = np.exp(-DILATION * 25e-6)
    bulge = np.array([0, 0, DEPTH**ALPHA])
    exact = np.concatenate([WEIGHT * STRENGTH * bulge, WEIGHT * STRENGTH * (APART * DEPTH * g + bulge * g)])
    printed: dict[str, Any] = {"model": "paper", "normalize": "peak"}
    return _by_hand(
        "Dilation of two taxels",
        "u = a s_d (r h g + n h^α g)",
        exact,
        pressed().ravel(),
        paper=pressed(**printed).ravel(),
        defects=(23,),
    )


def dilation_as_printed() -> Comparison:
    """Return the same by `model: paper`, `normalize: peak`: w = h (c g/ḡ + (1 − c) ρ/ρ̄), ε the root of the mean area."""
    ours = pressed(model="paper", normalize="peak", compressibility=0.3, dilation_strength=7)[1]
    eps, g, peak = np.sqrt(AREA), np.exp(-DILATION * 25e-6), np.exp(-0.5) / np.sqrt(2 * DILATION)
    w = DEPTH * (0.3 * g / peak + 0.7 * 2 * eps / (25e-6 + eps**2))
    return _by_hand(
        "Dilation as the paper prints it, model paper",
        "u = s_d (r h (c g/ḡ + (1−c) ρ/ρ̄) + n h^α g)",
        7 * (APART * w + np.array([0, 0, DEPTH**ALPHA * g])),
        ours,
        over=cases(NAMES[3:]),
        defects=(23,),
    )


def peak_of_the_kernel() -> Comparison:
    """Return the largest in-plane displacement of the normalised kernel, over that of the plain one: ḡ."""
    place = np.array([[1 / np.sqrt(2 * DILATION), 0, 0]])
    up, here = np.array([[0, 0, 1.0]]), np.array([[0.0, 0, 0]])
    printed, plain = (
        float(Gaussian(DILATION, SHEAR, 1.0, 1e-3, is_normalized).spread(place, up, here)[0, 0, 0, 0])
        for is_normalized in (True, False)
    )
    return Comparison(
        "The printed kernel is divided by its peak",
        "maximum of r exp(−λr²) at r = 1/√2λ",
        "ḡ = e^(−1/2)/√2λ",
        KINDS,
        "1/ḡ",
        "1/m",
        cases(["at r = 1/√2λ"]),
        array(np.sqrt(2 * DILATION) * np.exp(0.5)),
        array(printed / plain),
        rtol=1e-12,
        defects=(23,),
    )


def normalized_peak() -> Comparison:
    """Return the largest in-plane displacement of the normalised kernel: 1, at r = 1/√2λ."""
    place, up, here = np.array([[1 / np.sqrt(2 * DILATION), 0, 0]]), np.array([[0, 0, 1.0]]), np.array([[0.0, 0, 0]])
    return Comparison(
        "The normalised kernel peaks at 1",
        "maximum of r exp(−λr²) at r = 1/√2λ",
        "max r g/ḡ = 1",
        KINDS,
        "displacement over its strength",
        "1",
        cases(["at r = 1/√2λ"]),
        array(1.0),
        array(Gaussian(DILATION, SHEAR, 1.0, 1e-3, True).spread(place, up, here)[0, 0, 0, 0]),
        rtol=1e-12,
        defects=(23,),
    )


def far_part(eps: float = 1e-3) -> Comparison:
    """Return the in-plane displacement of an incompressible skin, at r = ε and far off, where it falls off as 1/r."""
    here, up, ours = np.array([[0.0, 0, 0]]), np.array([[0, 0, 1.0]]), []
    for r in (eps, 1.0):
        u = Gaussian(DILATION, SHEAR, 0.0, eps, False).spread(np.array([[r, 0, 0]]), up, here)[:, 0, 0, 0]
        ours += u.tolist()
    peak = np.exp(-0.5) / np.sqrt(2 * DILATION)
    return Comparison(
        "The far part of the dilation falls off as 1/r",
        SOURCE,
        "u = ḡ/ρ̄ r/(r² + ε²), ρ̄ = 1/2ε",
        KINDS,
        "displacement over its strength",
        "m",
        cases([f"u_{a} at {r}" for r in ("ε", "1 m") for a in "xyz"]),
        array([peak, 0, 0, peak * 2 * eps, 0, 0]),
        array(ours),
        rtol=1e-5,
    )


def stretch_over_thickness() -> Comparison:
    """Return the far part of the dilation of a skin whose thickness is given."""
    peak = np.exp(-0.5) / np.sqrt(2 * DILATION)
    return _by_hand(
        "The length of the stretch is the thickness",
        "u = a s_d r h ḡ/ρ̄ ρ, ρ = 1/(r² + t²)",
        WEIGHT * APART[:2] * DEPTH * peak * 2 * 2e-3 / (25e-6 + 4e-6),
        pressed(compressibility=0, thickness="2 mm", dilation_strength=1)[1, :2],
        over=cases(NAMES[3:5]),
    )


def shear() -> Comparison:
    """Return what a ball that slides by 0.1 mm does: markers follow its motion."""
    way = (1e-4, -0.5e-4)
    h, g = 0.01 - np.hypot(0.01 - DEPTH, np.hypot(*way)), np.exp(-DILATION * 25e-6)
    t, a = np.array([*way, 0.0]), WEIGHT * STRENGTH
    own = a * (t * h + np.array([0, 0, h**ALPHA]))
    other = a * (APART * h * g + np.array([0, 0, h**ALPHA * g]) + t * h * np.exp(-SHEAR * 25e-6))
    return _by_hand(
        "Shear of two taxels",
        "u = u_dilation + a s_s t h exp(−λ_s r²)",
        np.concatenate([own, other]),
        pressed(way).ravel(),
        rtol=1e-9,
        atol=1e-15,
    )


def capped_shear() -> Comparison:
    """Return the shear of a ball dragged by 5 mm: where friction ends it. Mindlin's ratio of stiffnesses with ν = 1/2."""
    way = np.array([3e-3, 4e-3])
    h = 0.01 - np.hypot(0.01 - 2e-3, 5e-3)
    return _by_hand(
        "Friction caps the shear",
        "|t| ≤ μ h (2−ν)/2(1−ν)",
        WEIGHT * STRENGTH * h * 1.5 * 0.2 * h * np.array([0.6, 0.8]),
        pressed(way, probes=PROBES[:1], depth=2e-3, friction=0.2)[0, :2],
        over=cases(NAMES[:2]),
        source="Mindlin 1949; Johnson 1985, 7.4",
        rtol=1e-9,
        atol=0.0,
    )


def elastic_skin() -> Comparison:
    """Return an elastic skin's markers: pressed in and, for ν < 1/2, towards the load; carried along by a tangential load."""
    way, nu = (5e-5, 0.0), 0.48
    h = 0.01 - np.hypot(0.01 - DEPTH, way[0])
    pressure, pull = 1e8 * h * AREA, 1e8 * 2 * (1 - nu) / (2 - nu) * way[0] * AREA
    g = half_space(np.array([0.0, 5e-3]), 0.0, patch_radius(AREA), 2e5 / (2 * (1 + nu)), nu)
    e = np.array([0.8, 0.6])
    x, y = g.spread[1] * pressure * e + pull * (g.along[1] * np.array([1, 0]) + g.bend[1] * (1.6 * e - [1, 0]))
    other = [x, y, -g.normal[1] * pressure - g.lift[1] * pull * 0.8]
    return _by_hand(
        "An elastic skin under a ball that slides",
        "u = G(r) [τ, p] A, p = K_n h, τ = K_n 2(1−ν)/(2−ν) t",
        [g.along[0] * pull, 0, -g.normal[0] * pressure, *other],
        pressed(way, **ELASTIC).ravel(),
        source="Johnson 1985, 3.18, 3.75 and 7.4",
        rtol=1e-9,
        atol=1e-15,
    )


def standoff(gate: str | None = None) -> Comparison:
    """Return the bulge of a skin of 1.5 mm above the taxels while a ball comes down: from its first touch on."""
    heights = np.array([2e-3, 1.5e-3, 1.4e-3, 7e-4, 1e-5, 0.0, -3e-4])
    touch = probed(PROBES[:1], BALL, kind="elastomer", gate=gate, standoff="1.5 mm", shear_strength=0)
    found = [float(touch(state(touch, pos=[0, 0, 0.01 + height]))["s"][0, 0, 2]) for height in heights]
    return _by_hand(
        "A standoff is felt above the taxels",
        "u_z = a s_d max(0, s − φ)^α",
        WEIGHT * STRENGTH * np.maximum(0.0, 1.5e-3 - heights) ** ALPHA,
        array(found),
        over=along("height", "m", heights),
        rtol=1e-9,
        atol=1e-12,
        defects=(5,),
    )


def sheet(n: int, side: float, curve: float | None = None) -> LinkTaxels:
    """Return a flat n × n pad of some side [m], normals +z; or bent around the y axis to a radius [m]."""
    line = (np.arange(n) + 0.5) / n * side - side / 2
    x, y = (part.reshape(-1) for part in np.meshgrid(line, line, indexing="ij"))
    cell = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), axis=-1).reshape(-1, 2)
    pos, normal = np.stack([x, y, 0 * x], axis=1), np.tile([0.0, 0.0, 1.0], (n * n, 1))
    if curve:
        pos = np.stack([curve * np.sin(x / curve), y, curve * np.cos(x / curve)], axis=1)
        normal = np.stack([np.sin(x / curve), 0 * x, np.cos(x / curve)], axis=1)
    return LinkTaxels(pos, normal, np.full(n * n, (side / n) ** 2), cell, np.ones(n * n, dtype=bool))


def spec(**fields: Any) -> ElastomerSpec:
    """Return an elastomer's spec."""
    return ElastomerSpec.model_validate({"kind": "elastomer", "links": "pad", "feels": ["item"], **fields})


STIFF: dict[str, Any] = {"youngs_modulus": 2e5, "poissons_ratio": 0.45, "normal_stiffness": 1e8}
SKINS: dict[str, dict[str, Any]] = {
    "gaussian": {},
    "half_space": {"kernel": "half_space", **STIFF},
    "bonded_layer": {"kernel": "bonded_layer", "thickness": 4e-3, **STIFF},
}


def _means(n: int, fields: dict[str, Any]) -> list[float]:
    """Return the mean displacements over a pad of n² taxels under a ball, for each part of the response [m]."""
    part = sheet(n, 0.02)
    h = np.maximum(0.0, 1e-3 - (part.pos[:, 0] ** 2 + part.pos[:, 1] ** 2) / (2 * 0.012))
    found, every = responses(spec(**fields), part, None), np.arange(n * n)
    if "kernel" in fields:
        u = np.einsum("klji,li->kj", found["traction"](every), 1e8 * np.stack([0.3 * h, 0.0 * h, -h]))
        parts = [np.abs(u[2]), np.hypot(u[0], u[1])]
    else:
        u = np.einsum("kji,i->kj", found["spread"](every)[:, 0], h)
        parts = [np.hypot(u[0], u[1]), found["bulge"](every)[0, 0] @ h**ALPHA]
        parts += [found["drag"](every)[0, 0] @ h] if "drag" in found else []
    return [float(np.mean(p)) for p in parts]


def resolution(kernel: str) -> Comparison:
    """Return how the mean displacement changes with the number of taxels: not at all; the paper's sums grow with it."""
    nums = (12, 17, 24)
    means = np.array([_means(n, SKINS[kernel]) for n in nums])
    paper = np.array([_means(n, {"model": "paper", "anchors": "taxels"}) for n in nums]) if kernel == "gaussian" else None
    num_parts = means.shape[1]
    return Comparison(
        f"Twice the taxels change nothing, kernel {kernel}",
        "sums are integrals over the area",
        "mean |u| of 17², 24² taxels over that of 12²",
        KINDS,
        "ratio of means",
        "1",
        cases([f"{n}², part {i}" for n in nums[1:] for i in range(num_parts)]),
        np.ones(2 * num_parts),
        (means[1:] / means[0]).ravel(),
        rtol=0.02,
        paper=None if paper is None else (paper[1:, :num_parts] / paper[0, :num_parts]).ravel(),
        defects=(9,),
    )


def paper_grows(n: int = 10) -> Comparison:
    """Return how the paper's sums, `model: paper`, grow with four times the taxels: fourfold."""
    h = np.full(n * n, 1e-3)
    few, many = (responses(spec(model="paper"), sheet(k, 0.02), None)["bulge"](np.arange(k * k))[0, 0] for k in (n, 2 * n))
    return Comparison(
        "The paper's model grows with the number of taxels, model paper",
        "a sum without areas",
        "mean u of 4 N taxels over that of N",
        KINDS,
        "ratio of means",
        "1",
        cases([f"{n}² to {2 * n}²"]),
        array(4.0),
        array(float(np.mean(many @ np.repeat(h, 4)) / np.mean(few @ h))),
        rtol=0.02,
        defects=(9,),
    )


def curved_offsets(radius: float = 8e-3) -> Comparison:
    """Return tangential offsets of neighbours on a cylinder, up to 70° off the middle; the paper's are on one mean plane."""
    step = np.deg2rad(2 * 80 / 8)
    part = sheet(8, 8 * step * radius, curve=radius)
    r = np.linalg.norm(offset(part.pos, part.normal, part.pos), axis=0)
    # Taxels are ordered by rows along the arc, 8 in each: the first of each row is enough.
    first = np.arange(0, 64, 8)
    ours = np.array([r[i, j] for i, j in pairwise(first)])
    plane = np.linalg.norm(part.pos[first[1:], :2] - part.pos[first[:-1], :2], axis=1)
    return Comparison(
        "Offsets on a curved fingertip",
        "chord in a circle's tangent plane",
        "|r| = R sin Δ",
        KINDS,
        "offset of neighbours",
        "m",
        cases([f"{np.rad2deg(step) * (i - 3):.0f}°" for i in range(7)], "place on the arc"),
        np.full(7, radius * np.sin(step)),
        ours,
        rtol=1e-12,
        paper=plane,
        defects=(8,),
    )


ORACLES: tuple[Oracle, ...] = (
    dilation,
    dilation_as_printed,
    peak_of_the_kernel,
    normalized_peak,
    far_part,
    stretch_over_thickness,
    shear,
    capped_shear,
    elastic_skin,
    standoff,
    *(partial(resolution, kernel) for kernel in SKINS),
    paper_grows,
    curved_offsets,
)
