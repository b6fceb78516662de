"""Forces of contacts on taxels: weight, static and kinetic friction, impact and moment of a cube on a pad.

"The paper" is its law of depth and velocity (`kinematic_taxel`, `model: paper`) on the same state.
"""

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.comparison import Values, field
from oracles.setups.scenes import TAXELS, compiled, document, folder, pad, points, resting, settled, wrench
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.runtime.connect import simulate

G = 9.81
"""Gravity [m/s²]."""
MASS = 0.25
"""Mass of the cube [kg]."""
ROUNDING = 1e-12
"""Sums of float64 forces of about 1 N [N]."""
AT_REST = 1e-5
"""Remaining error of a cube that settles [N]."""
AXES = ("x", "y", "z")
PLACES = ((0.0, 0.0, 0.0), (0.006, -0.003, 0.0), (0.004, 0.002, 30.0))
"""Poses of the cube on the pad: x, y [m] and the angle about z [deg]."""
oracle = field("forces: contacts", "force_taxel")
PAPER: dict[str, Any] = {"kind": "kinematic_taxel", "model": "paper", "outputs": ["force"]}


def total(touch: TactileModule, state: SceneState) -> np.ndarray:
    """Return the sum of the taxels' forces (3,) [N]."""
    return touch(state)["s"][0, :, :3].sum(dim=0).numpy()


@oracle(
    "A resting cube weighs what it weighs", "Σ f_z = −m g", "balance of forces", "force [N]", "mass [kg]", is_log=True,
    atol=AT_REST, defects=(1,),
)  # fmt: skip
def weight(masses: tuple[float, ...] = (0.025, 0.25, 1.0)):
    ours, paper = ([-total(*resting(mass=mass, **law))[2] for mass in masses] for law in ({}, PAPER))
    return Values(np.array(masses) * G, ours, paper, at=masses)


@oracle(
    "The taxels carry the solver's force, {mass:g} kg", "Σ f_j = Σ f_c", "MuJoCo's contact forces", "force [N]", at=AXES,
    atol=ROUNDING, also=[0.025],
)  # fmt: skip
def solver_force(mass: float = MASS):
    touch, state = resting(mass=mass)
    return wrench(touch, state)[0], total(touch, state)


@oracle(
    "Static shear: a cube at rest on a slope of {angle:g}°", "f_x = m g sin θ, f_z = −m g cos θ", "balance of forces",
    "force [N]", at=AXES, atol=2e-3, defects=(2,), each=[10.0, 25.0],
)  # fmt: skip
def static_shear(angle: float):
    turn = Rotation.from_euler("y", angle, degrees=True)
    x, _, z = turn.apply([0, 0, 0.03])
    place = {"mount": f"euler='0 {angle} 0'", "place": f"pos='{x} 0 {z}' euler='0 {angle} 0'"}
    touch, state = resting(**place)
    creep = float((settled(touch, 1501).body_pos - state.body_pos).abs().max()) / 0.002  # [m/s], of the solver's soft friction
    theta = np.radians(angle)
    ours = total(touch, state) if creep < 0.002 else np.nan
    return MASS * G * np.array([np.sin(theta), 0, -np.cos(theta)]), ours, total(*resting(**place, **PAPER))


def _sliding(motion: tuple[float, float], **sensor: Any) -> tuple[TactileModule, SceneState, float]:
    """Return a cube that slides with μ = 0.4, driven by gravity along the pad, and its speed along its motion [m/s]."""
    x, y = motion
    with folder() as where:
        touch = pad(
            where, friction=0.4, gravity=f"{0.4 * G * x} {0.4 * G * y} {-G}",
            qvel=f"{0.05 * x} {0.05 * y} 0 0 0 0", place=f"pos='{-0.008 * x} {-0.008 * y} .0299'", **sensor,
        )  # fmt: skip
        sim = simulate(touch, 1, substeps=100, keyframe="start")
        sim.step()
    return touch, sim.state(), float(sim.qvel[0, :2] @ torch.tensor(motion, dtype=torch.float64))


@oracle(
    "Coulomb: a cube that slides along {motion} drags the sensor with it", "f_t = μ N along the object's motion",
    "Coulomb's law", "force along the pad [N]", at=["x", "y"], atol=1e-3, defects=(3,), each=[((0.0, 1.0),), ((-1.0, 0.0),)],
)  # fmt: skip
def sliding(motion: tuple[float, float]):
    touch, state, speed = _sliding(motion)
    force, paper = total(touch, state), total(*_sliding(motion, **PAPER)[:2])
    moves = speed > 0.02 and force[2] < -0.5 * MASS * G  # a sliding cube chatters
    return 0.4 * -force[2] * np.array(motion), force[:2] if moves else np.nan, paper[:2]


@oracle(
    "No taxel leaves its friction cone", "|f_t| ≤ μ f_n", "Coulomb's law", "|f_t|/μ f_n − 1, where above 0 [1]", "taxel",
    atol=1e-4, defects=(2,), also=[((-1.0, 0.0),)],
)  # fmt: skip
def friction_cone(motion: tuple[float, float] = (0.0, 1.0)):
    touch, state, _ = _sliding(motion)
    x, y, z = touch(state)["s"][0].numpy().T
    loaded = z < -1e-6
    used = np.maximum(np.hypot(x[loaded], y[loaded]) / (-0.4 * z[loaded]) - 1, 0)
    return Values(0.0, used if len(used) >= 4 else np.nan, at=np.flatnonzero(loaded).tolist())


@oracle(
    "An impact adds up to the change of momentum", "Σ f Δt = m Δv + m g T", "balance of momentum", "impulse [N·s]", at=["f_z"],
    rtol=1e-2,
)  # fmt: skip
def impact(step: float = 5e-4, steps: int = 200):
    with folder() as where:
        touch = pad(where, place="pos='0 0 .0305'", qvel="0 0 -1 0 0 0", timestep=step)
        sim = simulate(touch, 1, keyframe="start")
        before, forces = float(sim.qvel[0, 2]), []
        for _ in range(steps):
            sim.step()
            forces.append(float(touch(sim.state())["s"][0, :, 2].sum()))
        change = MASS * (float(sim.qvel[0, 2]) - before)
    hits = change > 0.24 and min(forces) < -10 * MASS * G
    return change + MASS * G * steps * step, -sum(forces) * step if hits else np.nan


def _resting_at(place: tuple[float, float, float]) -> tuple[TactileModule, SceneState]:
    x, y, angle = place
    return resting(place=f"pos='{x} {y} .03' euler='0 0 {angle}'", moment_iterations=12)


@oracle(
    "The taxels carry the solver's moment, cube at {place}", "Σ x_j × f_j = Σ x_c × f_c", "MuJoCo's contact forces",
    "moment about the pad's origin [N·m]", at=AXES, atol=1e-4 * (MASS * G * 0.01), each=[(place,) for place in PLACES[1:]],
    also=[(PLACES[0],)],
)  # fmt: skip
def moment(place: tuple[float, float, float]):
    touch, state = _resting_at(place)
    return wrench(touch, state)[1], np.cross(np.array(TAXELS), touch(state)["s"][0].numpy()).sum(axis=0)


@oracle(
    "The centre of pressure is below the cube's centre, at {place}", "Σ f_z x/Σ f_z = x of the cube", "balance of moments",
    "position [m]", at=["x", "y"], atol=5e-6, each=[(PLACES[2],)], also=[(PLACES[0],), (PLACES[1],)],
)  # fmt: skip
def centre_of_pressure(place: tuple[float, float, float]):
    touch, state = _resting_at(place)
    force = touch(state)["s"][0, :, 2].numpy()
    return place[:2], (force[:, None] * np.array(TAXELS)[:, :2]).sum(axis=0) / force.sum()


def made_up(touch: TactileModule, pos: Any, force: Any, torque: Any = None, net: Any = None, depth: float = 0.001,
            normal: Any = (0, 0, -1)) -> SceneState:  # fmt: skip
    """Return a state with these contacts on the pad [m], [N], [N·m]; the cube is `depth` above its surface [m]."""
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


@oracle(
    "A contact that turns around an edge hands its force over", "f = t²(3 − 2t), t = min(1, 2 cos θ/0.75)",
    "cubic smooth step of cos θ, by definition", "force along the contact's normal, of 1 N [N]", "angle [rad]", atol=1e-12,
)  # fmt: skip
def around_an_edge(num: int = 151):
    angles = np.linspace(0, np.pi / 2, num)
    with folder() as where:
        touch, ours = pad(where), []
    for angle in angles:
        normal = np.array([-np.sin(angle), 0, -np.cos(angle)])
        force = touch(made_up(touch, [[0.025, 0.005, 0.01]], [normal], normal=normal))["s"][0].numpy()
        ours.append(force.sum(axis=0) @ normal)
    t = np.minimum(1, 2 * np.cos(angles) / 0.75)
    return Values(t**2 * (3 - 2 * t), ours, at=angles)


@oracle(
    "Deeper taxels carry more", "f ∝ d/R + 1e-3", "shares by depth over radius and 1e-3, by definition", "force [N]",
    at=["1 mm deep", "3 mm deep"], rtol=1e-12,
)  # fmt: skip
def shared_by_depth():
    with folder() as where:
        touch = pad(where, taxels=[(-0.004, 0, 0.01), (0.004, 0, 0.012)], moment_iterations=0)
    ours = touch(made_up(touch, [[0.0, 0.0, 0.011]], [[0, 0, -1.0]], depth=0.003))["s"][0, :, 2]
    return [-0.251 / 1.002, -0.751 / 1.002], ours


@oracle(
    "A torque is carried as far as pushing can", "Σ x × f = (τ_x, τ_y, 0), residual (0, 0, τ_z)",
    "moments of normal forces have no part along the normal", "moment [N·m]",
    at=[*(f"carried {a}" for a in AXES), *(f"left {a}" for a in AXES)], atol=1e-9,
)  # fmt: skip
def torque_carried():
    with folder() as where:
        touch = pad(where, moment_iterations=12)
    readings = touch(made_up(touch, [[0.0, 0.0, 0.01]], [[0, 0, -1.0]], [[1e-3, -5e-4, 2e-3]]))
    carried = np.cross(np.array(TAXELS), readings["s"][0].numpy()).sum(axis=0)
    return [1e-3, -5e-4, 0, 0, 0, 2e-3], [*carried, *readings["s/residual"][0, 0].numpy()]


OFFSET = """<mujoco><option gravity="0 0 0"/><worldbody><body name="pad"><geom size=".01"/></body>
<body name="cube" pos="0 0 .3"><freejoint/><geom type="box" size=".02 .02 .02" pos=".008 .003 -.002"/></body></worldbody>
<keyframe><key name="start" qvel=".3 -.2 .1 20 -30 25"/></keyframe></mujoco>"""
"""A rotating body with its centre of mass 8.8 mm off its frame's origin."""


@field("forces: contacts", "kinematic_taxel", "proximity")(
    "Velocities are of the body frame's origin", "v = dx/dt; of the centre of mass v + ω × r",
    "central difference of the body's places", "velocity [m/s]", at=AXES, atol=1e-5, defects=(25,),
)  # fmt: skip
def velocity_at_the_origin(step: float = 1e-6):
    with folder() as where:
        (where / "scene.xml").write_text(OFFSET, encoding="utf-8")
        sensor = {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"]}
        touch = compiled(document(where / "scene.xml", "cube", sensor, points([(0, 0, 0.01)], 0.004)))
        sim = simulate(touch, 1, substeps=1, keyframe="start", options={"timestep": step})
        states = []
        for _ in range(3):
            sim.step()
            states.append(sim.state())
    row = touch.inputs.bodies.index("cube")
    before, middle, after = states
    turn = Rotation.from_quat(middle.body_quat[0, row].numpy(), scalar_first=True)
    exact = (after.body_pos[0, row].numpy() - before.body_pos[0, row].numpy()) / (2 * step)
    around = np.cross(middle.body_angvel[0, row].numpy(), turn.apply([0.008, 0.003, -0.002]))
    return exact, middle.body_linvel[0, row].numpy(), exact + around
