"""A kinematic taxel's law of depth and velocity: by hand, and as a Winkler foundation under a ball.

A box comes down on a probe at the origin of its link, 4 mm deep; its face looks down, so the contact's normal is −z.
"""

from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.comparison import Values, field
from oracles.forces import MASS, PAPER, G
from oracles.setups.scenes import BOX, folder, module, pad, probed, resting, state, wrench
from tgdsl.runtime.connect import simulate

DEPTH, STIFFNESS, DAMPING, SHEAR, SPIN, EXPONENT = 0.004, 500.0, 1.0, 2.0, 2.0, 1.2
"""Depth of the box [m]; the paper's k_n, c_n, k_t, k_ω and α."""
POWER = DEPTH**EXPONENT
ABOVE: dict[str, Any] = {"pos": [0, 0, 0.03 - DEPTH]}
oracle = field("forces: depth and velocity", "kinematic_taxel")
SOURCE = "Chung et al., appendix, KinematicTaxel; the sign of friction by Coulomb's law"
FORCES = ("force_x", "force_y", "force_z")
CHANNELS = (*FORCES, "torque_x", "torque_y", "torque_z")
law = partial(oracle, source=SOURCE, quantity="force [N], torque [N·m] []", rtol=1e-12, atol=1e-12)
SIX = [(x, y, 0.0) for x in (-0.01, 0, 0.01) for y in (0, 0.012)]
"""Probes under the box."""
STILL: dict[str, Any] = {"normal_damping": 0, "shear_damping": 0, "outputs": ["force"]}


def read(probe: Any = (0.0, 0.0, 0.0), sensor: dict[str, Any] | None = None, **item: Any) -> np.ndarray:
    """Return a probe's force [N], and torque [N·m] on request, for a moving box 4 mm deep."""
    touch = probed([probe], BOX, kind="kinematic_taxel", **(sensor or {}))
    return touch(state(touch, **{**ABOVE, **item}))["s"][0, 0].numpy()


def _both(sensor: dict[str, Any] | None = None, **item: Any) -> tuple[np.ndarray, np.ndarray | None]:
    ours, paper = (read(sensor={**(sensor or {}), **model}, **item) for model in ({}, {"model": "paper"}))
    return ours, None if np.allclose(ours, paper, rtol=1e-9, atol=1e-12) else paper


@law("A box at rest pushes the sensor away", "f = k_n d^α m", at=CHANNELS)
def pressing():
    return [0, 0, -STIFFNESS * POWER, 0, 0, 0], *_both()


@law("Normal damping at {speed:g} m/s", "f_n = (k_n − c_n v·m) d^α", at=FORCES, each=[-3.0, 3.0])
def approaching(speed: float):
    return [0, 0, (-STIFFNESS + DAMPING * speed) * POWER], *_both({"outputs": ["force"]}, linvel=[0, 0, speed])


@law("Friction on the sensor points along the object's motion", "f_t = k_t v_t", at=FORCES, defects=(3,))
def dragging():
    return [SHEAR * 0.1, -SHEAR * 0.2, -STIFFNESS * POWER], *_both({"outputs": ["force"]}, linvel=[0.1, -0.2, 0])


@law("Spin twists the sensor along with the object", "τ = k_ω (ω·m) m", at=CHANNELS, defects=(3,))
def spinning():
    return [0, 0, -STIFFNESS * POWER, 0, 0, 3 * SPIN], *_both(angvel=[0, 0, 3])


@law("Rolling is motion of the surface, not spin", "v = ω × r", at=CHANNELS, defects=(3,))
def rolling():
    return [SHEAR * 2 * -(0.03 - DEPTH), 0, -STIFFNESS * POWER, 0, 0, 0], *_both(angvel=[0, 2, 0])


@oracle(
    "Torque about the {about}", "{equation}", SOURCE, "torque [N·m]", at=["x", "y", "z"], atol=1e-12, defects=(4,),
    each=[("link", "τ = x × f + k_ω (ω·m) m"), ("taxel", "τ = k_ω (ω·m) m")],
)  # fmt: skip
def lever(about: str, equation: str):
    probe = (0.01, -0.005, 0.0)
    reading = read(probe, {"torque_about": about}, linvel=[0.1, 0.2, 0], angvel=[0, 0, 3])
    return np.array([0, 0, 3 * SPIN]) + (np.cross(probe, reading[:3]) if about == "link" else 0.0), reading[3:]


@oracle(
    "Friction ends at the cone, model {model}", "|f_t| = min(k_t v, μ f_n)", "Coulomb's law", "force [N]", "speed [m/s]",
    is_log=True, rtol=1e-12, series=FORCES, defects=(2,), each=["tgdsl"], also=["paper"],
)  # fmt: skip
def cone(model: str = "tgdsl", friction: float = 0.4):
    speeds = np.array([0.01, 0.1, 1.0, 100.0])
    sensor = {"outputs": ["force"], "model": model}
    ours, free = (
        np.stack([read(sensor={**sensor, **cone}, linvel=[0.6 * v, -0.8 * v, 0]) for v in speeds], axis=1)
        for cone in ({"friction_cone": friction}, {})
    )
    sign = -1 if model == "paper" else 1
    exact = np.minimum(SHEAR * speeds, friction * STIFFNESS * POWER) * sign
    exact = np.stack([0.6 * exact, -0.8 * exact, np.full(4, -STIFFNESS * POWER)])
    return Values(exact, ours, free if model == "tgdsl" else None, at=speeds)


@oracle(
    "A pad sums to the law of its taxels, not to the load", "|f_j| = k_n d_j^α", SOURCE, "force [N]", "taxel", at=range(36),
    rtol=1e-12,
)  # fmt: skip
def flat_pad():
    line = np.linspace(-0.025, 0.025, 6)
    probes = np.array([(x, y, 0) for x in line for y in line])
    touch = probed(probes, BOX, kind="kinematic_taxel", outputs=["force"])
    ours = np.linalg.norm(touch(state(touch, **ABOVE))["s"][0].numpy(), axis=1)
    gap = np.maximum(np.abs(probes[:, :2]) - 0.02, 0)
    depth = np.maximum(0.01 - np.linalg.norm(np.column_stack([gap, np.full(36, 0.01 - DEPTH)]), axis=1), 0)
    return STIFFNESS * depth**EXPONENT, ours


@oracle(
    "Winkler: a ball on a dense pad, α = {alpha:g}", "F = k 2πB δ^(α+1)/((α+1) A)", "Johnson 1985, 4.3, of a power law",
    "force [N]", "depth [m]", is_log=True, rtol=0.02, defects=(1,), each=[1.0, 1.2], also=[1.5],
)  # fmt: skip
def winkler(alpha: float):
    # Probes of radius R below the skin, a taxel on each area A. Of one at r from the axis the geometric depth is
    # d = R + B − √(r² + (R + B − δ)²) = δ − r²/2B' with B' = R + B where δ ≪ B'; d = 0 at r² = 2B'δ, and over the disc
    # ∫ d^α 2πr dr/A = 2πB' ∫₀^δ d^α dd/A. The probes' own radius thus counts with the ball's.
    reach, ball, pitch = 0.0005, 0.02, 1.25e-4
    line = np.arange(-40, 41) * pitch
    x, y = np.meshgrid(line, line)
    inside = np.hypot(x, y) < 0.0049
    probes = np.column_stack([x[inside], y[inside], np.full(inside.sum(), -reach)])
    geom = f'<geom type="sphere" size="{ball}"/>'
    touch = probed(probes, geom, radius=reach, kind="kinematic_taxel", depth_exponent=alpha, **STILL)
    depths = np.array([1e-4, 2e-4, 4e-4])
    forces = [-float(touch(state(touch, pos=[0, 0, ball - depth]))["s"][0, :, 2].sum()) for depth in depths]
    exact = STIFFNESS * 2 * np.pi * (ball + reach) * depths ** (alpha + 1) / ((alpha + 1) * pitch**2)
    return Values(exact, forces, at=depths)


@oracle(
    "Winkler: the power of a ball's force is α + 1, α = {alpha:g}; Hertz has 1.5", "d log F/d log δ = α + 1",
    "Johnson 1985, 4.3, of a power law", "exponent [1]", at=["0.1 to 0.2 mm", "0.2 to 0.4 mm"], atol=0.02, each=[1.2],
    also=[1.0, 1.5],
)  # fmt: skip
def winkler_exponent(alpha: float):
    force = winkler(alpha)
    return alpha + 1.0, np.diff(np.log(force.ours)) / np.diff(np.log(force.at))


def balanced(probes: Any, forces: Any, normals: Any = ((0, 0, -1),), item: Any = None, **sensor: Any) -> tuple[Any, Any]:
    """Return balanced and unbalanced readings of a pad with these contacts of the solver [N]."""
    item = {**ABOVE} if item is None else item
    with folder() as where:
        touch = module(where, probes, BOX, kind="kinematic_taxel", balance="solver", slots=4, **sensor)
        plain = module(where, probes, BOX, kind="kinematic_taxel", **sensor)
    scene = state(touch, **item)
    for name in ("pos", "force", "torque", "normal"):
        setattr(scene, f"contact_{name}", torch.zeros(1, 1, 4, 3, dtype=torch.float64))
    scene.contact_force[0, 0, : len(forces)] = torch.tensor(forces, dtype=torch.float64)
    scene.contact_normal[0, 0, : len(forces)] = torch.tensor(normals, dtype=torch.float64)
    scene.contact_netforce = scene.contact_force.sum(dim=2)
    return touch(scene)["s"][0].numpy(), plain(state(plain, **item))["s"][0].numpy()


@oracle(
    "A resting cube weighs what it weighs on balanced taxels", "Σ f_z = −m g", "balance of forces", "force [N]", at=["f_z"],
    atol=1e-4, defects=(1,),
)  # fmt: skip
def balanced_weight():
    ours, paper = (
        float(touch(scene)["s"][0, :, 2].sum())
        for touch, scene in (resting(kind="kinematic_taxel", balance="solver"), resting(**PAPER))
    )
    return -MASS * G, ours, paper


@oracle(
    "Balanced taxels press with the solver's force, model {model}", "f_n = f_n,law Σ f_c·m/Σ f_n,law", "by definition",
    "force [N]", "taxel", at=range(6), rtol=1e-12, each=["tgdsl"], also=["paper"],
)  # fmt: skip
def balanced_shares(model: str = "tgdsl"):
    dragged = {**ABOVE, "linvel": [0.1, -0.3, 0.2], "angvel": [0, 0, 2]}
    ours, plain = balanced(SIX, [[0.3, 0, -1.5], [0, 0.2, -0.5]], [[0, 0, -1]] * 2, dragged, model=model)
    return plain[:, 2] * (-2.0 / plain[:, 2].sum()), ours[:, 2]


@oracle(
    "A sliding cube presses balanced taxels with the solver's normal force", "Σ f_z = Σ f_c·m", "MuJoCo's contact forces",
    "force [N]", at=["f_z"], rtol=1e-3,
)  # fmt: skip
def balanced_sliding(friction: float = 0.3):
    with folder() as where:
        touch = pad(
            where, kind="kinematic_taxel", balance="solver", friction=friction,
            qvel="0.1 0 0 0 0 0", gravity=f"{friction * G} 0 -{G}", place="pos='-.008 0 .0299'",
        )  # fmt: skip
        sim = simulate(touch, 1, substeps=100, keyframe="start")
        sim.step()
    scene = sim.state()
    return wrench(touch, scene)[0][2], touch(scene)["s"][0].numpy()[:, 2].sum()
