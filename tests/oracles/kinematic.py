"""The law of depth and velocity of a kinematic taxel: by hand, and as a Winkler foundation under a ball.

A box comes down on a probe at the origin of its link, 4 mm deep; its face looks down, so the contact's normal is −z.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch

from oracles.forces import MASS, PAPER, G
from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.scenes import folder, module, pad, probed, settled, state, wrench
from tgdsl.runtime.simulate import simulate

BOX = '<geom type="box" size=".02 .02 .02"/>'
DEPTH, STIFFNESS, DAMPING, SHEAR, SPIN, EXPONENT = 0.004, 500.0, 1.0, 2.0, 2.0, 1.2
"""Depth of the box [m]; the paper's k_n, c_n, k_t, k_ω and α."""
POWER = DEPTH**EXPONENT
ABOVE: dict[str, Any] = {"pos": [0, 0, 0.03 - DEPTH]}
KINDS = ("kinematic_taxel",)
SOURCE = "Chung et al., appendix, KinematicTaxel; the sign of friction by Coulomb's law"
FORCES = ("force_x", "force_y", "force_z")
SIX = [(x, y, 0.0) for x in (-0.01, 0, 0.01) for y in (0, 0.012)]
"""Probes under the box."""
STILL: dict[str, Any] = {"normal_damping": 0, "shear_damping": 0, "spin_damping": 0, "outputs": ["force"]}


def read(probe: Any = (0.0, 0.0, 0.0), sensor: dict[str, Any] | None = None, **item: Any) -> np.ndarray:
    """Return a probe's reading, force [N] and torque [N·m] if it is asked for, of a box 4 mm deep that moves as said."""
    touch = probed([probe], BOX, kind="kinematic_taxel", **(sensor or {}))
    return touch(state(touch, **{**ABOVE, **item}))["s"][0, 0].numpy()


def _law(name: str, equation: str, exact: Any, sensor: dict[str, Any], item: dict[str, Any], **more: Any) -> Comparison:
    """Return a probe's reading by hand; the paper's of the same state."""
    ours, paper = (read(sensor={**sensor, **own}, **item) for own in ({}, {"model": "paper"}))
    names = (*FORCES, "torque_x", "torque_y", "torque_z")[: len(ours)]
    is_other = not np.allclose(ours, paper, rtol=1e-9, atol=1e-12)
    return Comparison(
        name, SOURCE, equation, KINDS, "force [N], torque [N·m]", "", cases(names), array(exact), ours,
        rtol=1e-12, atol=1e-12, paper=paper if is_other else None, **more,
    )  # fmt: skip


def pressing() -> Comparison:
    """Return the force of a box at rest."""
    exact = [0, 0, -STIFFNESS * POWER, 0, 0, 0]
    return _law("A box at rest pushes the sensor away", "f = k_n d^α m", exact, {}, {})


def approaching(speed: float) -> Comparison:
    """Return the normal force of a box that moves along z [m/s]: more where it approaches."""
    exact = [0, 0, (-STIFFNESS + DAMPING * speed) * POWER]
    name = f"Normal damping at {speed:g} m/s"
    return _law(name, "f_n = (k_n − c_n v·m) d^α", exact, {"outputs": ["force"]}, {"linvel": [0, 0, speed]})


def dragging() -> Comparison:
    """Return the friction of a box that slides: along its motion; the paper's points against it."""
    exact = [SHEAR * 0.1, -SHEAR * 0.2, -STIFFNESS * POWER]
    item = {"linvel": [0.1, -0.2, 0]}
    name = "Friction on the sensor points along the object's motion"
    return _law(name, "f_t = k_t v_t", exact, {"outputs": ["force"]}, item, defects=(3,))


def spinning() -> Comparison:
    """Return the torque of a box that spins about the normal: it twists the sensor along; the paper's has the other sign."""
    exact = [0, 0, -STIFFNESS * POWER, 0, 0, 3 * SPIN]
    name = "Spin twists the sensor along with the object"
    return _law(name, "τ = k_ω (ω·m) m", exact, {}, {"angvel": [0, 0, 3]}, defects=(3,))


def rolling() -> Comparison:
    """Return the friction of a box that rolls about a tangent: the surface moves with ω × r, and nothing spins."""
    exact = [SHEAR * 2 * -(0.03 - DEPTH), 0, -STIFFNESS * POWER, 0, 0, 0]
    return _law("Rolling is motion of the surface, not spin", "v = ω × r", exact, {}, {"angvel": [0, 2, 0]}, defects=(3,))


def lever(about: str, probe: tuple[float, float, float] = (0.01, -0.005, 0.0)) -> Comparison:
    """Return the torque about the link's origin, or about the taxel, of a probe off the origin."""
    found = read(probe, {"torque_about": about}, linvel=[0.1, 0.2, 0], angvel=[0, 0, 3])
    spin = np.array([0, 0, 3 * SPIN])
    return Comparison(
        f"Torque about the {about}",
        SOURCE,
        "τ = x × f + k_ω (ω·m) m" if about == "link" else "τ = k_ω (ω·m) m",
        KINDS,
        "torque",
        "N·m",
        cases(("x", "y", "z")),
        spin + (np.cross(probe, found[:3]) if about == "link" else 0.0),
        found[3:],
        atol=1e-12,
        defects=(4,),
    )


def cone(model: str = "tgdsl", friction: float = 0.4) -> Comparison:
    """Return friction over speed: k_t v up to μ f_n, and no more; the paper's has no end."""
    speeds = np.array([0.01, 0.1, 1.0, 100.0])
    sensor = {"friction_cone": friction, "outputs": ["force"], "model": model}
    found = [read(sensor=sensor, linvel=[0.6 * v, -0.8 * v, 0]) for v in speeds]
    free = [read(sensor={"outputs": ["force"], "model": model}, linvel=[0.6 * v, -0.8 * v, 0]) for v in speeds]
    sign = -1 if model == "paper" else 1
    exact = np.minimum(SHEAR * speeds, friction * STIFFNESS * POWER) * sign
    return Comparison(
        f"Friction ends at the cone, model {model}",
        "Coulomb's law",
        "|f_t| = min(k_t v, μ f_n)",
        KINDS,
        "force",
        "N",
        along("speed", "m/s", speeds, is_log=True),
        np.stack([0.6 * exact, -0.8 * exact, np.full(4, -STIFFNESS * POWER)]),
        np.stack(found, axis=1),
        rtol=1e-12,
        paper=np.stack(free, axis=1) if model == "tgdsl" else None,
        series=FORCES,
        defects=(2,),
    )


def flat_pad() -> Comparison:
    """Return the forces of 6 × 6 probes under a flat box: k d^α each, edges and corners as far as they reach."""
    line = np.linspace(-0.025, 0.025, 6)
    probes = np.array([(x, y, 0) for x in line for y in line])
    touch = probed(probes, BOX, kind="kinematic_taxel", outputs=["force"])
    found = np.linalg.norm(touch(state(touch, **ABOVE))["s"][0].numpy(), axis=1)
    gap = np.maximum(np.abs(probes[:, :2]) - 0.02, 0)
    depth = np.maximum(0.01 - np.linalg.norm(np.column_stack([gap, np.full(36, 0.01 - DEPTH)]), axis=1), 0)
    return Comparison(
        "A pad sums to the law of its taxels, not to the load",
        SOURCE,
        "|f_j| = k_n d_j^α",
        KINDS,
        "force",
        "N",
        cases(range(36), "taxel"),
        STIFFNESS * depth**EXPONENT,
        found,
        rtol=1e-12,
    )


def winkler(alpha: float) -> Comparison:
    """Return force against depth δ of a ball of radius B on a dense pad: a power of α + 1, where Hertz has 1.5.

    Probes of radius R below the skin, a taxel on each area A. Of one at r from the axis the geometric depth is
    d = R + B − √(r² + (R + B − δ)²) = δ − r²/2B' with B' = R + B where δ ≪ B'; d = 0 at r² = 2B'δ, and over the disc
    ∫ d^α 2πr dr/A = 2πB' ∫₀^δ d^α dd/A. The probes' own radius thus counts with the ball's.
    """
    reach, ball, pitch = 0.0005, 0.02, 1.25e-4
    line = np.arange(-40, 41) * pitch
    x, y = np.meshgrid(line, line)
    inside = np.hypot(x, y) < 0.0049
    probes = np.column_stack([x[inside], y[inside], np.full(inside.sum(), -reach)])
    geom = f'<geom type="sphere" size="{ball}"/>'
    touch = probed(probes, geom, radius=reach, kind="kinematic_taxel", depth_exponent=alpha, **STILL)
    depths = np.array([1e-4, 2e-4, 4e-4])
    forces = [-float(touch(state(touch, pos=[0, 0, ball - depth]))["s"][0, :, 2].sum()) for depth in depths]
    return Comparison(
        f"Winkler: a ball on a dense pad, α = {alpha:g}",
        "Johnson 1985, 4.3, of a power law",
        "F = k 2πB δ^(α+1)/((α+1) A)",
        KINDS,
        "force",
        "N",
        along("depth", "m", depths, is_log=True),
        STIFFNESS * 2 * np.pi * (ball + reach) * depths ** (alpha + 1) / ((alpha + 1) * pitch**2),
        array(forces),
        rtol=0.02,
        defects=(1,),
    )


def winkler_exponent(alpha: float) -> Comparison:
    """Return the power of depth that a ball's force on a dense pad follows: α + 1."""
    force = winkler(alpha)
    depths = force.over.numbers
    assert depths is not None
    return Comparison(
        f"Winkler: the power of a ball's force is α + 1, α = {alpha:g}; Hertz has 1.5",
        "Johnson 1985, 4.3, of a power law",
        "d log F/d log δ = α + 1",
        KINDS,
        "exponent",
        "1",
        cases(["0.1 to 0.2 mm", "0.2 to 0.4 mm"]),
        array([alpha + 1.0] * 2),
        np.diff(np.log(force.ours)) / np.diff(np.log(depths)),
        atol=0.02,
    )


def balanced(probes: Any, forces: Any, normals: Any = ((0, 0, -1),), item: Any = None, **sensor: Any) -> tuple[Any, Any]:
    """Return readings of a pad whose solver has the given contacts [N], balanced and not."""
    item = {**ABOVE} if item is None else item
    with folder() as where:
        touch = module(where, probes, BOX, kind="kinematic_taxel", balance="solver", slots=4, **sensor)
        plain = module(where, probes, BOX, kind="kinematic_taxel", **sensor)
    scene = state(touch, **item)
    for name in ("pos", "force", "torque", "normal"):
        setattr(scene, f"contact_{name}", torch.zeros(1, 1, 4, 3, dtype=torch.float64))
    assert scene.contact_force is not None and scene.contact_normal is not None
    scene.contact_force[0, 0, : len(forces)] = torch.tensor(forces, dtype=torch.float64)
    scene.contact_normal[0, 0, : len(forces)] = torch.tensor(normals, dtype=torch.float64)
    scene.contact_netforce = scene.contact_force.sum(dim=2)
    return touch(scene)["s"][0].numpy(), plain(state(plain, **item))["s"][0].numpy()


def balanced_weight() -> Comparison:
    """Return what a cube at rest weighs on kinematic taxels that are balanced with the solver's force."""
    with folder() as where:
        found = []
        sensors: tuple[dict[str, Any], ...] = ({"kind": "kinematic_taxel", "balance": "solver"}, PAPER)
        for sensor in sensors:
            touch = pad(where, **sensor)
            found.append(float(touch(settled(touch))["s"][0, :, 2].sum()))
    return Comparison(
        "A resting cube weighs what it weighs on balanced taxels",
        "balance of forces",
        "Σ f_z = −m g",
        KINDS,
        "force",
        "N",
        cases(["f_z"]),
        array(-MASS * G),
        array(found[0]),
        atol=1e-4,
        paper=array(found[1]),
        defects=(1,),
    )


def balanced_shares(model: str = "tgdsl") -> Comparison:
    """Return balanced normal forces of six probes under 2 N: the solver's sum in the law's proportions."""
    dragged = {**ABOVE, "linvel": [0.1, -0.3, 0.2], "angvel": [0, 0, 2]}
    found, plain = balanced(SIX, [[0.3, 0, -1.5], [0, 0.2, -0.5]], [[0, 0, -1]] * 2, dragged, model=model)
    return Comparison(
        f"Balanced taxels press with the solver's force, model {model}",
        "by definition",
        "f_n = f_n,law Σ f_c·m/Σ f_n,law",
        KINDS,
        "force",
        "N",
        cases(range(6), "taxel"),
        plain[:, 2] * (-2.0 / plain[:, 2].sum()),
        found[:, 2],
        rtol=1e-12,
    )


def balanced_sliding(friction: float = 0.3) -> Comparison:
    """Return what a sliding cube presses with on balanced taxels, against the solver's normal forces."""
    with folder() as where:
        touch = pad(
            where, kind="kinematic_taxel", balance="solver", friction=friction,
            qvel="0.1 0 0 0 0 0", gravity=f"{friction * G} 0 -{G}", place="pos='-.008 0 .0299'",
        )  # fmt: skip
        sim = simulate(touch, 1, substeps=100, keyframe="start")
        sim.step()
        scene = sim.state()
        force = touch(scene)["s"][0].numpy()
        net, _ = wrench(touch, scene)
    return Comparison(
        "A sliding cube presses balanced taxels with the solver's normal force",
        "MuJoCo's contact forces",
        "Σ f_z = Σ f_c·m",
        KINDS,
        "force",
        "N",
        cases(["f_z"]),
        array(net[2]),
        array(force[:, 2].sum()),
        rtol=1e-3,
    )


ORACLES: tuple[Oracle, ...] = (
    pressing,
    *(partial(approaching, speed) for speed in (-3.0, 3.0)),
    dragging,
    spinning,
    rolling,
    *(partial(lever, about) for about in ("link", "taxel")),
    cone,
    flat_pad,
    *(partial(winkler, alpha) for alpha in (1.0, 1.2)),
    partial(winkler_exponent, 1.2),
    balanced_weight,
    balanced_shares,
    balanced_sliding,
)
