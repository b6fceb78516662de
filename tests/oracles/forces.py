"""Forces of contacts on taxels: weight, static and kinetic friction, impact and moment of a cube on a pad.

"The paper" is its law of depth and velocity (`kinematic_taxel`, `model: paper`) on the same state.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.scenes import TAXELS, compiled, folder, pad, points, settled, wrench
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.simulate import simulate

G = 9.81
"""Gravity [m/s²]."""
MASS = 0.25
"""Mass of the cube [kg]."""
ROUNDING = 1e-12
"""Sums of float64 forces of about 1 N [N]."""
AT_REST = 1e-5
"""How near to its end a cube that settles has come [N]."""
AXES = ("x", "y", "z")
KINDS = ("force_taxel",)
PAPER: dict[str, Any] = {"kind": "kinematic_taxel", "model": "paper", "outputs": ["force"]}


def total(touch: TactileModule, state: SceneState) -> np.ndarray:
    """Return the sum of the taxels' forces (3,) [N]."""
    return touch(state)["s"][0, :, :3].sum(dim=0).numpy()


def weight(masses: tuple[float, ...] = (0.025, 0.25, 1.0)) -> Comparison:
    """Return what cubes at rest weigh, the sum of the taxels' forces; the paper's does not know the load."""
    ours, paper = [], []
    for mass in masses:
        with folder() as where:
            touch = pad(where, mass=mass)
            ours.append(-total(touch, settled(touch))[2])
            other = pad(where, mass=mass, **PAPER)
            paper.append(-total(other, settled(other))[2])
    return Comparison(
        "A resting cube weighs what it weighs",
        "balance of forces",
        "Σ f_z = −m g",
        KINDS,
        "force",
        "N",
        along("mass", "kg", masses, is_log=True),
        array(masses) * G,
        array(ours),
        atol=AT_REST,
        paper=array(paper),
        defects=(1,),
    )


def solver_force(mass: float = MASS) -> Comparison:
    """Return the sum of the taxels' forces under a resting cube, against the solver's force on the pad."""
    with folder() as where:
        touch = pad(where, mass=mass)
        state = settled(touch)
        exact, _ = wrench(touch, state)
        return Comparison(
            f"The taxels carry the solver's force, {mass:g} kg",
            "MuJoCo's contact forces",
            "Σ f_j = Σ f_c",
            KINDS,
            "force",
            "N",
            cases(AXES),
            exact,
            total(touch, state),
            atol=ROUNDING,
        )


def static_shear(angle: float) -> Comparison:
    """Return what a slope carries of a cube that friction holds, though nothing moves; nan if the cube slides."""
    turn = Rotation.from_euler("y", angle, degrees=True)
    x, _, z = turn.apply([0, 0, 0.03])
    place: dict[str, Any] = {"mount": f"euler='0 {angle} 0'", "place": f"pos='{x} 0 {z}' euler='0 {angle} 0'"}
    with folder() as where:
        touch = pad(where, **place)
        state, later = settled(touch), settled(touch, 1501)
        assert state.body_pos is not None and later.body_pos is not None
        creep = float((later.body_pos - state.body_pos).abs().max()) / 0.002  # [m/s], of the solver's soft friction
        other = pad(where, **place, **PAPER)
        paper = total(other, settled(other))
    theta = np.radians(angle)
    return Comparison(
        f"Static shear: a cube at rest on a slope of {angle:g}°",
        "balance of forces",
        "f_x = m g sin θ, f_z = −m g cos θ",
        KINDS,
        "force",
        "N",
        cases(AXES),
        MASS * G * np.array([np.sin(theta), 0, -np.cos(theta)]),
        total(touch, state) if creep < 0.002 else np.full(3, np.nan),
        atol=2e-3,
        paper=paper,
        defects=(2,),
    )


def _sliding(where: Any, motion: tuple[float, float], **sensor: Any) -> tuple[TactileModule, SceneState, float]:
    """Return a cube that slides with μ = 0.4, gravity along the pad keeping it up, and its speed along the way [m/s]."""
    x, y = motion
    touch = pad(
        where, friction=0.4, gravity=f"{0.4 * G * x} {0.4 * G * y} {-G}",
        qvel=f"{0.05 * x} {0.05 * y} 0 0 0 0", place=f"pos='{-0.008 * x} {-0.008 * y} .0299'", **sensor,
    )  # fmt: skip
    sim = simulate(touch, 1, substeps=100, keyframe="start")
    sim.step()
    return touch, sim.state(), float(sim.qvel[0, :2] @ torch.tensor(motion, dtype=torch.float64))


def sliding(motion: tuple[float, float]) -> Comparison:
    """Return the friction of a sliding cube, along its motion: μ N; the paper's points against it."""
    with folder() as where:
        touch, state, speed = _sliding(where, motion)
        force = total(touch, state)
        other, there, _ = _sliding(where, motion, **PAPER)
        paper = total(other, there)
    moves = speed > 0.02 and force[2] < -0.5 * MASS * G  # a cube on its way chatters
    return Comparison(
        f"Coulomb: a cube that slides along {motion} drags the sensor with it",
        "Coulomb's law",
        "f_t = μ N along the object's motion",
        KINDS,
        "force along the pad",
        "N",
        cases(["x", "y"]),
        0.4 * -force[2] * array(motion),
        force[:2] if moves else np.full(2, np.nan),
        atol=1e-3,
        paper=paper[:2],
        defects=(3,),
    )


def friction_cone(motion: tuple[float, float] = (0.0, 1.0)) -> Comparison:
    """Return how much of each loaded taxel's friction cone is used under a sliding cube, beyond all of it."""
    with folder() as where:
        touch, state, _ = _sliding(where, motion)
        x, y, z = touch(state)["s"][0].numpy().T
    loaded = z < -1e-6
    used = np.maximum(np.hypot(x[loaded], y[loaded]) / (-0.4 * z[loaded]) - 1, 0)
    return Comparison(
        "No taxel leaves its friction cone",
        "Coulomb's law",
        "|f_t| ≤ μ f_n",
        KINDS,
        "|f_t|/μ f_n − 1, where above 0",
        "1",
        cases(np.flatnonzero(loaded).tolist(), "taxel"),
        np.zeros(int(loaded.sum())),
        used if len(used) >= 4 else np.full(len(used), np.nan),
        atol=1e-4,
        defects=(2,),
    )


def impact(step: float = 5e-4, steps: int = 200) -> Comparison:
    """Return the impulse of a cube that falls at 1 m/s and is slowed down: its change of momentum and weight."""
    with folder() as where:
        touch = pad(where, place="pos='0 0 .0305'", qvel="0 0 -1 0 0 0", timestep=step)
        sim = simulate(touch, 1, keyframe="start")
        before, forces = float(sim.qvel[0, 2]), []
        for _ in range(steps):
            sim.step()
            forces.append(float(touch(sim.state())["s"][0, :, 2].sum()))
        change = MASS * (float(sim.qvel[0, 2]) - before)
    hits = change > 0.24 and min(forces) < -10 * MASS * G
    return Comparison(
        "An impact adds up to the change of momentum",
        "balance of momentum",
        "Σ f Δt = m Δv + m g T",
        KINDS,
        "impulse",
        "N·s",
        cases(["f_z"]),
        array(change + MASS * G * steps * step),
        array(-sum(forces) * step if hits else np.nan),
        rtol=1e-2,
    )


def _resting_at(where: Any, place: tuple[float, float, float], iterations: int) -> tuple[TactileModule, SceneState]:
    x, y, angle = place
    touch = pad(where, place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=iterations)
    return touch, settled(touch)


def moment(place: tuple[float, float, float]) -> Comparison:
    """Return the moment of the taxels' forces under a cube at x, y [m], turned by an angle [deg]."""
    with folder() as where:
        touch, state = _resting_at(where, place, 12)
        force = touch(state)["s"][0].numpy()
        _, exact = wrench(touch, state)
    scale = MASS * G * 0.01
    return Comparison(
        f"The taxels carry the solver's moment, cube at {place}",
        "MuJoCo's contact forces",
        "Σ x_j × f_j = Σ x_c × f_c",
        KINDS,
        "moment about the pad's origin",
        "N·m",
        cases(AXES),
        exact,
        np.cross(np.array(TAXELS), force).sum(axis=0),
        atol=1e-4 * scale,
    )


def centre_of_pressure(place: tuple[float, float, float]) -> Comparison:
    """Return where the taxels' forces act: below the cube's centre."""
    with folder() as where:
        touch, state = _resting_at(where, place, 12)
        force = touch(state)["s"][0].numpy()
    centre = (force[:, 2, None] * np.array(TAXELS)[:, :2]).sum(axis=0) / force[:, 2].sum()
    return Comparison(
        f"The centre of pressure is below the cube's centre, at {place}",
        "balance of moments",
        "Σ f_z x/Σ f_z = x of the cube",
        KINDS,
        "position",
        "m",
        cases(["x", "y"]),
        array(place[:2]),
        centre,
        atol=5e-6,
    )


def made_up(touch: TactileModule, pos: Any, force: Any, torque: Any = None, net: Any = None, depth: float = 0.001,
            normal: Any = (0, 0, -1)) -> SceneState:  # fmt: skip
    """Return a state with given contacts on the pad [m], [N], [N·m]; the cube is `depth` above its surface [m]."""
    num, slots = len(pos), touch.inputs.slots
    fields: dict[str, Any] = {
        name: torch.zeros(1, 1, slots, 3, dtype=torch.float64) for name in ("pos", "force", "torque", "normal")
    }
    fields["pos"][0, 0, :num] = torch.tensor(np.array(pos))
    fields["force"][0, 0, :num] = torch.tensor(np.array(force))
    fields["normal"][0, 0, :num] = torch.tensor(np.array(normal, dtype=float))
    if torque is not None:
        fields["torque"][0, 0, :num] = torch.tensor(np.array(torque))
    net = np.sum(force, axis=0) if net is None else net
    rows = [[0.0, 0, 0.03 + depth] if body == "cube" else [0.0, 0, 0] for body in touch.inputs.bodies]
    return SceneState(
        body_pos=torch.tensor([rows], dtype=torch.float64),
        body_quat=torch.tensor([[[1.0, 0, 0, 0]] * len(rows)], dtype=torch.float64),
        contact_found=torch.ones(1, 1),
        contact_netforce=torch.tensor(np.array([[net]])),
        **{f"contact_{name}": value for name, value in fields.items()},
    )


def around_an_edge(num: int = 151) -> Comparison:
    """Return what the taxels carry of a contact whose normal turns away from theirs: a smooth step of the angle's cosine."""
    angles = np.linspace(0, np.pi / 2, num)
    with folder() as where:
        touch, found = pad(where), []
        for angle in angles:
            normal = np.array([-np.sin(angle), 0, -np.cos(angle)])
            force = touch(made_up(touch, [[0.025, 0.005, 0.01]], [normal], normal=normal))["s"][0].numpy()
            found.append(force.sum(axis=0) @ normal)
    t = np.minimum(1, 2 * np.cos(angles) / 0.75)
    return Comparison(
        "A contact that turns around an edge hands its force over",
        "cubic smooth step of cos θ, by definition",
        "f = t²(3 − 2t), t = min(1, 2 cos θ/0.75)",
        KINDS,
        "force along the contact's normal, of 1 N",
        "N",
        along("angle", "rad", angles),
        t**2 * (3 - 2 * t),
        array(found),
        atol=1e-12,
    )


def shared_by_depth() -> Comparison:
    """Return the shares of two taxels at the same distance from a contact, one three times as deep."""
    with folder() as where:
        touch = pad(where, taxels=[(-0.004, 0, 0.01), (0.004, 0, 0.012)], moment_iterations=0)
        found = touch(made_up(touch, [[0.0, 0.0, 0.011]], [[0, 0, -1.0]], depth=0.003))["s"][0, :, 2].numpy()
    return Comparison(
        "Deeper taxels carry more",
        "shares by depth over radius and 1e-3, by definition",
        "f ∝ d/R + 1e-3",
        KINDS,
        "force",
        "N",
        cases(["1 mm deep", "3 mm deep"]),
        array([-0.251 / 1.002, -0.751 / 1.002]),
        found,
        rtol=1e-12,
    )


def torque_carried() -> Comparison:
    """Return the moment that pushing taxels carry of a contact's torque: all that tilts, nothing that twists."""
    with folder() as where:
        touch = pad(where, moment_iterations=12)
        readings = touch(made_up(touch, [[0.0, 0.0, 0.01]], [[0, 0, -1.0]], [[1e-3, -5e-4, 2e-3]]))
    found = np.cross(np.array(TAXELS), readings["s"][0].numpy()).sum(axis=0)
    left = readings["s/residual"][0, 0].numpy()
    return Comparison(
        "A torque is carried as far as pushing can",
        "moments of normal forces have no part along the normal",
        "Σ x × f = (τ_x, τ_y, 0), residual (0, 0, τ_z)",
        KINDS,
        "moment",
        "N·m",
        cases([*(f"carried {a}" for a in AXES), *(f"left {a}" for a in AXES)]),
        array([1e-3, -5e-4, 0, 0, 0, 2e-3]),
        np.concatenate([found, left]),
        atol=1e-9,
    )


OFFSET = """<mujoco><option gravity="0 0 0"/><worldbody><body name="pad"><geom size=".01"/></body>
<body name="cube" pos="0 0 .3"><freejoint/><geom type="box" size=".02 .02 .02" pos=".008 .003 -.002"/></body></worldbody>
<keyframe><key name="start" qvel=".3 -.2 .1 20 -30 25"/></keyframe></mujoco>"""
"""A body that turns, its centre of mass 8.8 mm off its frame's origin."""


def velocity_at_the_origin(step: float = 1e-6) -> Comparison:
    """Return the linear velocity of a turning body that sensors read: its frame's origin's, not its centre of mass's."""
    with folder() as where:
        (where / "scene.xml").write_text(OFFSET, encoding="utf-8")
        layout = {"resolutions": {"r": {"pad": points([(0, 0, 0.01)], 0.004)}}}
        touch = compiled(
            {
                "tgdsl": 1,
                "robot": {"model": str(where / "scene.xml"), "layout": layout},
                "objects": {"cube": {"body": "cube"}},
                "sensors": {"s": {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"]}},
            }
        )
        sim = simulate(touch, 1, substeps=1, keyframe="start", options={"timestep": step})
        states = []
        for _ in range(3):
            sim.step()
            states.append(sim.state())
    row = touch.inputs.bodies.index("cube")
    pos = [state.body_pos[0, row].numpy().copy() for state in states if state.body_pos is not None]
    middle, arm = states[1], np.array([0.008, 0.003, -0.002])
    assert middle.body_linvel is not None and middle.body_angvel is not None and middle.body_quat is not None
    turn = Rotation.from_quat(middle.body_quat[0, row].numpy(), scalar_first=True)
    exact = (pos[2] - pos[0]) / (2 * step)
    return Comparison(
        "Velocities are of the body frame's origin",
        "central difference of the body's places",
        "v = dx/dt; of the centre of mass v + ω × r",
        ("kinematic_taxel", "proximity"),
        "velocity",
        "m/s",
        cases(AXES),
        exact,
        middle.body_linvel[0, row].numpy(),
        atol=1e-5,
        paper=exact + np.cross(middle.body_angvel[0, row].numpy(), turn.apply(arm)),
        defects=(25,),
    )


PLACES = ((0.006, -0.003, 0.0), (0.004, 0.002, 30.0))
ORACLES: tuple[Oracle, ...] = (
    weight,
    solver_force,
    *(partial(static_shear, angle) for angle in (10.0, 25.0)),
    *(partial(sliding, motion) for motion in ((0.0, 1.0), (-1.0, 0.0))),
    friction_cone,
    impact,
    *(partial(moment, place) for place in PLACES),
    partial(centre_of_pressure, PLACES[1]),
    around_an_edge,
    shared_by_depth,
    torque_carried,
    velocity_at_the_origin,
)
