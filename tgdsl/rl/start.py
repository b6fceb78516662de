"""The simulation of a task's environments, and the task's setup."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Float

from tgdsl.errors import Problem, SimulationError, SpecError, did_you_mean
from tgdsl.rl.actuation import Actuators
from tgdsl.rl.draws import Draws
from tgdsl.rl.events import event_terms
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensors import TaskSensors
from tgdsl.rl.task import Setup, free_qpos
from tgdsl.runtime.connect import simulator_for
from tgdsl.runtime.connection import keyword_options
from tgdsl.runtime.simulators.model_ids import keyframe_id
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.scene.scene import SceneModels, is_absent
from tgdsl.schema.select import is_plain, matching


def moved_joints(loaded: LoadedTask, sensors: TaskSensors) -> tuple[str, ...]:
    """Return the joints that the policy moves, in the order of the actuators."""
    model = SceneModels(sensors.touch.plan.scene).model({})
    of_actuators = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    joint_names = list(dict.fromkeys(model.joint(int(i)).name for i in of_actuators))
    problems: list[Problem] = []
    for i, pattern in enumerate(loaded.spec.joints):
        if not matching(pattern, joint_names):
            problem = f'no actuated joint {"is called" if is_plain(pattern) else "matches"} "{pattern}"'
            problems.append(loaded.source.problem(("joints", i), problem, did_you_mean(pattern, joint_names, "joints")))
    try:
        keyframe_id(model, loaded.spec.keyframe)
    except SimulationError as error:
        problems.append(loaded.source.problem(("keyframe",), str(error)))
    for pattern in loaded.spec.physics.max_torque:
        if not matching(pattern, joint_names):
            place, problem = ("physics", "max_torque", pattern), f'no actuated joint matches "{pattern}"'
            problems.append(loaded.source.problem(place, problem, did_you_mean(pattern, joint_names, "joints"), on_key=True))
    if problems:
        raise SpecError(problems)
    return tuple(name for name in joint_names if any(matching(pattern, [name]) for pattern in loaded.spec.joints))


def moved_actuators(loaded: LoadedTask, model: mujoco.MjModel, joints: tuple[str, ...]) -> Actuators:
    """Return the actuators of the joints that the policy moves."""
    try:
        return Actuators.of(model, joints)
    except SimulationError as error:
        raise loaded.error(("joints",), str(error)) from error


def make_simulation(
    loaded: LoadedTask,
    sensors: TaskSensors,
    joints: tuple[str, ...],
    num_envs: int,
    device: str,
    simulator: str | None,
    threads: int = 0,
    first_env: int = 0,
) -> Simulation:
    """Simulate the task's scene; environments with faults wait for a reset."""
    spec = loaded.spec
    task_watch = loaded.task.watch(spec)
    links = contact_links(sensors) if any(term.watches_links for term in loaded.terms.values()) else ()
    watch = Watch(
        bodies=tuple(dict.fromkeys((sensors.object, *task_watch.bodies, *links))),
        sites=task_watch.sites,
        joints=tuple(dict.fromkeys((*joints, *task_watch.joints, *sensors.touch.inputs.joints))),
        actuators=task_watch.actuators,
        pairs=task_watch.pairs,
    )
    per_env = [name for term in event_terms(spec.randomise, loaded.terms).values() for name in term.per_env]
    options: dict[str, Any] = {"substeps": spec.physics.substeps, "keyframe": spec.keyframe, "options": spec.physics.options}
    options |= {"watch": watch, "on_fault": "note", "device": device, "per_env": per_env, "threads": threads}
    options |= spec.physics.capacities
    kind = simulator_for(device, simulator)
    keywords = keyword_options(kind.simulate)
    sim = kind.simulate(sensors.touch, num_envs, **{name: value for name, value in options.items() if name in keywords})
    num_variants = sensors.num_variants(spec.object)
    if first_env % num_variants:
        sim.set_objects({spec.object: (np.arange(num_envs) + first_env) % num_variants})
    return sim


def make_setup(
    loaded: LoadedTask, sensors: TaskSensors, sim: Simulation, joints: tuple[str, ...], draws: Draws, first_env: int
) -> Setup:
    """Return the setup of a task without grasps."""
    actuators = moved_actuators(loaded, sim.model, joints)
    num_variants = sensors.num_variants(loaded.spec.object)
    friction, mass = (get(sensors.object).to(sim.qpos).clone() for get in (sim.properties.friction, sim.properties.mass))
    keyframe = sim.qpos[0].double().cpu().numpy()
    heights = [half_height(sim.env_model(i), sensors.object, keyframe) for i in range(min(num_variants, sim.num_envs))]
    heights = torch.tensor(heights, dtype=sim.qpos.dtype)[torch.arange(sim.num_envs) % num_variants].to(sim.qpos.device)
    start, free = sim.qpos[0].repeat(sim.num_envs, 1), free_qpos(sim.model, sensors.object)
    if free is not None:
        plain_model = SceneModels(sensors.touch.plan.scene).model({})
        start[:, free.start + 2] += heights - half_height(plain_model, sensors.object, keyframe)
    return Setup(
        num_envs=sim.num_envs,
        device=sim.qpos.device,
        dtype=sim.qpos.dtype,
        control_step=sim.control_step,
        model=sim.model,
        actuators=actuators,
        low=torch.from_numpy(actuators.low).to(sim.qpos),
        high=torch.from_numpy(actuators.high).to(sim.qpos),
        max_torque=torch.from_numpy(actuators.limit).to(sim.qpos),
        object=sensors.object,
        links=contact_links(sensors),
        qpos=sim.qpos[0].clone(),
        start=start,
        half_height=heights,
        variant=((torch.arange(sim.num_envs) + first_env) % num_variants).to(sim.qpos.device),
        num_variants=num_variants,
        friction=friction,
        mass=mass,
        scene_start=start.clone(),
        scene_friction=friction.clone(),
        scene_mass=mass.clone(),
        draws=draws,
        rows={kind: (name, sensors.touch.rows[name]) for kind, name in sensors.by_kind.items()},
    )


def contact_links(sensors: TaskSensors) -> tuple[str, ...]:
    """Return the bodies of the `link_contact` sensor's rows; none if the task takes none."""
    return tuple(sensors.touch.rows[sensors.contact]["body"].tolist()) if sensors.contact else ()


def half_height(model: mujoco.MjModel, body: str, qpos: Float[np.ndarray, " nq"]) -> float:
    """Return how far a body's colliding geoms reach below its origin in the world [m]; meshes by their bounding boxes."""
    state = mujoco.MjData(model)
    state.qpos[:] = qpos
    mujoco.mj_kinematics(model, state)
    mj_body = model.body(body)
    lowest = state.xpos[mj_body.id, 2]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    for geom in range(int(mj_body.geomadr[0]), int(mj_body.geomadr[0]) + int(mj_body.geomnum[0])):
        if not is_absent(model, geom) and (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            center, half = np.split(model.geom_aabb[geom], 2)
            corners = state.geom_xpos[geom] + (center + signs * half) @ state.geom_xmat[geom].reshape(3, 3).T
            lowest = min(lowest, corners[:, 2].min())
    return float(state.xpos[mj_body.id, 2] - lowest)
