"""Displacements of an elastomer's markers by hand: a ball pressed on two taxels and moved; resolution; curvature.

"The paper" is `model: paper` with `normalize: peak`, the formula as printed.
"""

from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from oracles.comparison import Values, field
from oracles.setups.scenes import probed, state
from tgdsl.sensors.elastomer.elastic import half_space, patch_radius
from tgdsl.sensors.elastomer.operators import Gaussian, LinkTaxels, offset, responses
from tgdsl.sensors.elastomer.spec import ElastomerSpec

DEPTH = 5e-4
"""How deep the ball is in the first taxel [m]."""
BALL = '<geom type="sphere" size=".01"/>'
PROBES = [(0.0, 0.0, 0.0), (0.004, 0.003, 0.0)]
APART = np.array([0.004, 0.003, 0.0])
AREA = np.pi * 1e-4
"""Area of a taxel of the scene, a disc of its radius of 10 mm [m²]."""
WEIGHT = AREA / 6e-6
"""The area over the reference area."""
STRENGTH, DILATION, SHEAR, ALPHA = 100.0, 8000.0, 2000.0, 1.2
"""The paper's s_d = s_s, λ_d, λ_s [1/m²] and α."""
ELASTIC: dict[str, Any] = {"kernel": "half_space", "youngs_modulus": 2e5, "poissons_ratio": 0.48, "normal_stiffness": 1e8}
SOURCE = "Chung et al., appendix, ElastomerTaxel"
NAMES = tuple(f"u_{a}, {where}" for where in ("source", "5 mm off") for a in "xyz")
PEAK = np.exp(-0.5) / np.sqrt(2 * DILATION)
"""ḡ, the largest of r exp(−λ_d r²) [m]."""
oracle = field("contact mechanics: markers", "elastomer")
by_hand = partial(oracle, source=SOURCE, quantity="displacement [m]")


def pressed(way: Any = (0.0, 0.0), probes: Any = PROBES, depth: float = DEPTH, **sensor: Any) -> np.ndarray:
    """Return displacements (taxel, 3) [m] under a ball pressed into the first taxel, then moved along the skin."""
    touch = probed(probes, BALL, kind="elastomer", **sensor)
    touch(state(touch, pos=[0, 0, 0.01 - depth]))
    return touch(state(touch, pos=[*way, 0.01 - depth]))["s"][0].numpy()


@by_hand("Dilation of two taxels", "u = a s_d (r h g + n h^α g)", at=NAMES, rtol=1e-12, atol=1e-18, defects=(23,))
def dilation():
    g = np.exp(-DILATION * 25e-6)
    bulge = np.array([0, 0, DEPTH**ALPHA])
    exact = np.concatenate([WEIGHT * STRENGTH * bulge, WEIGHT * STRENGTH * (APART * DEPTH * g + bulge * g)])
    return exact, pressed().ravel(), pressed(model="paper", normalize="peak").ravel()


@by_hand(
    "Dilation as the paper prints it, model paper", "u = s_d (r h (c g/ḡ + (1−c) ρ/ρ̄) + n h^α g)", at=NAMES[3:], rtol=1e-12,
    atol=1e-18, defects=(23,),
)  # fmt: skip
def dilation_as_printed():
    ours = pressed(model="paper", normalize="peak", compressibility=0.3, dilation_strength=7)[1]
    eps, g = np.sqrt(AREA), np.exp(-DILATION * 25e-6)  # ε is the root of the mean area
    w = DEPTH * (0.3 * g / PEAK + 0.7 * 2 * eps / (25e-6 + eps**2))
    return 7 * (APART * w + np.array([0, 0, DEPTH**ALPHA * g])), ours


def spread(r: float, compressibility: float, eps: float, is_normalized: bool) -> np.ndarray:
    """Return the displacement (3,) over its strength of a kernel at a distance along the skin [m]."""
    here, up = np.array([[0.0, 0, 0]]), np.array([[0, 0, 1.0]])
    kernel = Gaussian(DILATION, SHEAR, compressibility, eps, is_normalized)
    return kernel.spread(np.array([[r, 0, 0]]), up, here)[:, 0, 0, 0]


@oracle(
    "The printed kernel is divided by its peak", "ḡ = e^(−1/2)/√2λ", "maximum of r exp(−λr²) at r = 1/√2λ", "1/ḡ [1/m]",
    at=["at r = 1/√2λ"], rtol=1e-12, defects=(23,),
)  # fmt: skip
def peak_of_the_kernel():
    printed, plain = (spread(1 / np.sqrt(2 * DILATION), 1.0, 1e-3, is_normalized)[0] for is_normalized in (True, False))
    return np.sqrt(2 * DILATION) * np.exp(0.5), printed / plain


@oracle(
    "The normalised kernel peaks at 1", "max r g/ḡ = 1", "maximum of r exp(−λr²) at r = 1/√2λ",
    "displacement over its strength [1]", at=["at r = 1/√2λ"], rtol=1e-12, defects=(23,),
)  # fmt: skip
def normalized_peak():
    return 1.0, spread(1 / np.sqrt(2 * DILATION), 1.0, 1e-3, True)[0]


@oracle(
    "The far part of the dilation falls off as 1/r", "u = ḡ/ρ̄ r/(r² + ε²), ρ̄ = 1/2ε", SOURCE,
    "displacement over its strength [m]", at=[f"u_{a} at {r}" for r in ("ε", "1 m") for a in "xyz"], rtol=1e-5,
)  # fmt: skip
def far_part(eps: float = 1e-3):
    ours = np.concatenate([spread(r, 0.0, eps, False) for r in (eps, 1.0)])
    return [PEAK, 0, 0, PEAK * 2 * eps, 0, 0], ours


@by_hand(
    "The length of the stretch is the thickness", "u = a s_d r h ḡ/ρ̄ ρ, ρ = 1/(r² + t²)", at=NAMES[3:5], rtol=1e-12, atol=1e-18
)
def stretch_over_thickness():
    ours = pressed(compressibility=0, thickness="2 mm", dilation_strength=1)[1, :2]
    return WEIGHT * APART[:2] * DEPTH * PEAK * 2 * 2e-3 / (25e-6 + 4e-6), ours


@by_hand("Shear of two taxels", "u = u_dilation + a s_s t h exp(−λ_s r²)", at=NAMES, rtol=1e-9, atol=1e-15)
def shear():
    way = (1e-4, -0.5e-4)
    h, g = 0.01 - np.hypot(0.01 - DEPTH, np.hypot(*way)), np.exp(-DILATION * 25e-6)
    t, a = np.array([*way, 0.0]), WEIGHT * STRENGTH
    source = a * (t * h + np.array([0, 0, h**ALPHA]))
    other = a * (APART * h * g + np.array([0, 0, h**ALPHA * g]) + t * h * np.exp(-SHEAR * 25e-6))
    return np.concatenate([source, other]), pressed(way).ravel()


@by_hand("Friction caps the shear", "|t| ≤ μ h (2−ν)/2(1−ν)", source="Mindlin 1949; Johnson 1985, 7.4", at=NAMES[:2], rtol=1e-9)
def capped_shear():
    h = 0.01 - np.hypot(0.01 - 2e-3, 5e-3)
    ours = pressed([3e-3, 4e-3], probes=PROBES[:1], depth=2e-3, friction=0.2)[0, :2]
    return WEIGHT * STRENGTH * h * 1.5 * 0.2 * h * np.array([0.6, 0.8]), ours  # ν = 1/2


@by_hand(
    "An elastic skin under a ball that slides", "u = G(r) [τ, p] A, p = K_n h, τ = K_n 2(1−ν)/(2−ν) t",
    source="Johnson 1985, 3.18, 3.75 and 7.4", at=NAMES, rtol=1e-9, atol=1e-15,
)  # fmt: skip
def elastic_skin():
    way, nu = (5e-5, 0.0), 0.48
    h = 0.01 - np.hypot(0.01 - DEPTH, way[0])
    pressure, pull = 1e8 * h * AREA, 1e8 * 2 * (1 - nu) / (2 - nu) * way[0] * AREA
    g = half_space(np.array([0.0, 5e-3]), 0.0, patch_radius(AREA), 2e5 / (2 * (1 + nu)), nu)
    e = np.array([0.8, 0.6])
    x, y = g.spread[1] * pressure * e + pull * (g.along[1] * np.array([1, 0]) + g.bend[1] * (1.6 * e - [1, 0]))
    other = [x, y, -g.normal[1] * pressure - g.lift[1] * pull * 0.8]
    return [g.along[0] * pull, 0, -g.normal[0] * pressure, *other], pressed(way, **ELASTIC).ravel()


@by_hand(
    "A standoff is felt above the taxels", "u_z = a s_d max(0, s − φ)^α", over="height [m]", rtol=1e-9, atol=1e-12,
    defects=(5,), also=["geometric"],
)  # fmt: skip
def standoff(gate: str | None = None):
    heights = np.array([2e-3, 1.5e-3, 1.4e-3, 7e-4, 1e-5, 0.0, -3e-4])
    touch = probed(PROBES[:1], BALL, kind="elastomer", gate=gate, standoff="1.5 mm", shear_strength=0)
    ours = [float(touch(state(touch, pos=[0, 0, 0.01 + height]))["s"][0, 0, 2]) for height in heights]
    return Values(WEIGHT * STRENGTH * np.maximum(0.0, 1.5e-3 - heights) ** ALPHA, ours, at=heights)


def sheet(n: int, side: float, curve: float | None = None) -> LinkTaxels:
    """Return an n × n pad of a side [m], flat with normals +z, or bent around the y axis to a radius [m]."""
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
    kernels, every = responses(spec(**fields), part, None), np.arange(n * n)
    if "kernel" in fields:
        u = np.einsum("klji,li->kj", kernels["traction"](every), 1e8 * np.stack([0.3 * h, 0.0 * h, -h]))
        parts = [np.abs(u[2]), np.hypot(u[0], u[1])]
    else:
        u = np.einsum("kji,i->kj", kernels["spread"](every)[:, 0], h)
        parts = [np.hypot(u[0], u[1]), kernels["bulge"](every)[0, 0] @ h**ALPHA]
        parts += [kernels["drag"](every)[0, 0] @ h] if "drag" in kernels else []
    return [float(np.mean(p)) for p in parts]


@oracle(
    "Twice the taxels change nothing, kernel {kernel}", "mean |u| of 17², 24² taxels over that of 12²",
    "sums are integrals over the area", "ratio of means [1]", rtol=0.02, defects=(9,), each=list(SKINS),
)  # fmt: skip
def resolution(kernel: str):
    nums = (12, 17, 24)
    means = np.array([_means(n, SKINS[kernel]) for n in nums])
    num_parts, paper = means.shape[1], None
    if kernel == "gaussian":
        sums = np.array([_means(n, {"model": "paper", "anchors": "taxels"}) for n in nums])[:, :num_parts]
        paper = (sums[1:] / sums[0]).ravel()
    labels = [f"{n}², part {i}" for n in nums[1:] for i in range(num_parts)]
    return Values(1.0, (means[1:] / means[0]).ravel(), paper, at=labels)


@oracle(
    "The paper's model grows with the number of taxels, model paper", "mean u of 4 N taxels over that of N",
    "a sum without areas", "ratio of means [1]", at=["10² to 20²"], rtol=0.02, defects=(9,),
)  # fmt: skip
def paper_grows(n: int = 10):
    h = np.full(n * n, 1e-3)
    few, many = (responses(spec(model="paper"), sheet(k, 0.02), None)["bulge"](np.arange(k * k))[0, 0] for k in (n, 2 * n))
    return 4.0, np.mean(many @ np.repeat(h, 4)) / np.mean(few @ h)


@oracle(
    "Offsets on a curved fingertip", "|r| = R sin Δ", "chord in a circle's tangent plane", "offset of neighbours [m]",
    "place on the arc", rtol=1e-12, defects=(8,),
)  # fmt: skip
def curved_offsets(radius: float = 8e-3):
    step = np.deg2rad(2 * 80 / 8)
    part = sheet(8, 8 * step * radius, curve=radius)
    r = np.linalg.norm(offset(part.pos, part.normal, part.pos), axis=0)
    first = np.arange(0, 64, 8)  # of each row along the arc
    ours = [r[i, j] for i, j in pairwise(first)]
    plane = np.linalg.norm(part.pos[first[1:], :2] - part.pos[first[:-1], :2], axis=1)
    return Values(radius * np.sin(step), ours, plane, at=[f"{np.rad2deg(step) * (i - 3):.0f}°" for i in range(7)])
