"""The task in_palm_rotate for mjlab: an XHand1 turns a cube on its palm, and feels it with 199 taxels.

    python -m mjlab.scripts.train Tgdsl-In-Palm-Rotate --env.scene.num-envs 4096

As in `tgdsl.rl.tasks.in_palm_rotate`, a goal is a quarter turn further about the vertical. Terms: `spin`, `success`, `tilt`,
`object_distance`, `drop`, `action_rate`, with the weights of examples/tasks/in_palm_rotate.yaml. There is one object, a cube;
drives are ideal, and only the cube's place is random.

Shapes: `env` environments, `feature` numbers of an observation.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import math
from typing import Any

import mujoco
import torch
from jaxtyping import Bool, Float
from mjlab.actuator.xml_actuator import XmlActuatorCfg
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnvCfg, mdp
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.observation_manager import ObservationGroupCfg, ObservationTermCfg
from mjlab.managers.reward_manager import RewardTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.managers.termination_manager import TerminationTermCfg
from mjlab.rl import RslRlModelCfg, RslRlOnPolicyRunnerCfg, RslRlPpoAlgorithmCfg
from mjlab.scene import SceneCfg
from mjlab.sim import MujocoCfg, SimulationCfg
from mjlab.tasks.registry import register_mjlab_task
from torch import Tensor

from tgdsl.adapters.mjlab import TouchSensorCfg, observation
from tgdsl.files.find import robot_names
from tgdsl.rl import rotations

NAME = "Tgdsl-In-Palm-Rotate"
JOINTS = ("right_hand_thumb_.*", "right_hand_mid_.*")
START = {"thumb_bend_joint": 1.2, "thumb_rota_joint1": -0.3, "thumb_rota_joint2": 0.1, "index_bend_joint": 0.0}
START |= {f"{finger}_joint{i}": angle for finger in ("index", "mid", "ring", "pinky") for i, angle in ((1, 0.2), (2, 0.1))}
"""Joint angles at the start [rad]."""
PALM_POS, PALM_QUAT = (0.0, 0.0, 0.06), (0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5))
CUBE_POS = (0.0724, -0.0014, 0.1036)
QUARTER, TOLERANCE, MAX_TILT, MAX_SPIN, FREE_DISTANCE, DROP_DISTANCE = 0.5 * math.pi, 0.1, 0.4, 4.0, 0.02, 0.07


def hand_spec() -> mujoco.MjSpec:
    """Return the hand, on its back."""
    spec = mujoco.MjSpec.from_file(str(robot_names()["xhand1"]))
    palm = spec.body("right_hand_link")
    palm.pos, palm.quat = PALM_POS, PALM_QUAT
    return spec


def with_cube(spec: mujoco.MjSpec, pos: tuple[float, ...]) -> mujoco.MjSpec:
    """Add the cube to a scene, at a position [m]."""
    body = spec.worldbody.add_body(name="item", pos=pos)
    body.add_freejoint(name="item")
    contact = {"condim": 4, "friction": (0.8, 0.002, 0.0001), "priority": 1}
    body.add_geom(name="item", type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.02, 0.02, 0.02), density=300, **contact)
    return spec


def cube_spec() -> mujoco.MjSpec:
    """Return the cube."""
    return with_cube(mujoco.MjSpec(), (0.0, 0.0, 0.0))


def scene_spec() -> mujoco.MjSpec:
    """Return hand and cube in one scene, from which touch is compiled."""
    return with_cube(hand_spec(), CUBE_POS)


DOCUMENT = {
    "tgdsl": 1,
    "robot": {"model": "xhand1"},
    "objects": {"item": {"body": "item"}},
    "resolution": "med",
    "sensors": {"touch": {"kind": "kinematic_taxel", "links": "hand", "feels": ["item"], "normal_stiffness": 500}},
    "observations": {"policy": [{"type": "force_torque", "of": "touch"}]},
}


class Turning:
    """How far the cube of each environment has turned since it was put down: `angle`, `rate`, `tilt`, and goals `reached`."""

    def __init__(self, env: Any):
        self._env, pose = env, pose_of(env)
        self.start, self.quat = pose.clone(), pose[:, 3:].clone()
        self.up = torch.tensor([0.0, 0.0, 1.0], device=env.device).expand(env.num_envs, 3)
        self.angle, self.rate, self.tilt, self.reached = torch.zeros((4, env.num_envs), device=env.device)
        self.is_reached = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)

    def begin(self, env_ids: Tensor) -> None:
        """Begin an episode in some environments, where their cubes are now."""
        pose = pose_of(self._env)
        self.start[env_ids], self.quat[env_ids] = pose[env_ids], pose[env_ids, 3:]
        for value in (self.angle, self.rate, self.tilt, self.reached):
            value[env_ids] = 0.0

    def advance(self) -> None:
        """Take a control step into account."""
        quat = pose_of(self._env)[:, 3:]
        step = rotations.twist(rotations.product(quat, rotations.inverse(self.quat)), self.up)
        self.angle += step
        self.rate.copy_(step / self._env.step_dt)
        self.tilt.copy_(rotations.swing(rotations.product(quat, rotations.inverse(self.start[:, 3:])), self.up))
        self.is_reached.copy_((self.goal - self.angle < TOLERANCE) & (self.tilt < MAX_TILT))
        self.reached += self.is_reached
        self.quat.copy_(quat)

    @property
    def goal(self) -> Float[Tensor, " env"]:
        """The angle of the next goal [rad]."""
        return (self.reached + 1.0) * QUARTER

    @property
    def distance(self) -> Float[Tensor, " env"]:
        """Distance from where the cube was put down [m]."""
        return torch.linalg.vector_norm(pose_of(self._env)[:, :3] - self.start[:, :3], dim=1)


def pose_of(env: Any) -> Float[Tensor, "env 7"]:
    """Return each cube's position [m] and quaternion, of now."""
    return env.sim.data.qpos[:, env.scene["object"].indexing.free_joint_q_adr]


def turning(env: Any) -> Turning:
    """Return the environments' only `Turning`, made when it is first asked for."""
    if "turning" not in env.extras:
        env.extras["turning"] = Turning(env)
    return env.extras["turning"]


def begin(env: Any, env_ids: Tensor) -> None:
    """Begin episodes: an event at resets, after the cube was put down."""
    turning(env).begin(env_ids)


def spin(env: Any) -> Float[Tensor, " env"]:
    """Angular velocity about the vertical, at most 4 rad/s; the first term, which takes the step into account."""
    turning(env).advance()
    return turning(env).rate.clamp(max=MAX_SPIN)


def success(env: Any) -> Float[Tensor, " env"]:
    """Goal reached."""
    return turning(env).is_reached.float()


def tilt(env: Any) -> Float[Tensor, " env"]:
    """Tilt of the cube [rad]."""
    return turning(env).tilt


def object_distance(env: Any) -> Float[Tensor, " env"]:
    """Distance of the cube from where it was put down beyond 2 cm [m]."""
    return (turning(env).distance - FREE_DISTANCE).clamp(min=0.0)


def drop(env: Any) -> Bool[Tensor, " env"]:
    """Cube dropped: it is further than 7 cm from where it was put down."""
    return turning(env).distance > DROP_DISTANCE


def goal(env: Any) -> Float[Tensor, "env feature"]:
    """The goal's orientation in the world, six numbers, and the angle from there to the cube's [rad]."""
    turns = turning(env)
    quat = rotations.product(rotations.about(turns.up, turns.goal), turns.start[:, 3:])
    return torch.cat([rotations.six_numbers(quat), rotations.between(quat, pose_of(env)[:, 3:])[:, None]], dim=1)


def env_cfg() -> ManagerBasedRlEnvCfg:
    """Return the environments."""
    model = hand_spec().compile()
    moved = [model.joint(i) for i in range(model.njnt) if model.joint(i).name.startswith(tuple(j[:-2] for j in JOINTS))]
    middle = {joint.name: float(joint.range.mean()) for joint in moved}
    scale = {joint.name: float(joint.range[1] - joint.range.mean()) for joint in moved}
    start = {f"right_hand_{name}": angle for name, angle in START.items()}
    hand = EntityCfg(
        spec_fn=hand_spec,
        articulation=EntityArticulationInfoCfg(actuators=(XmlActuatorCfg(target_names_expr=(".*",)),)),
        init_state=EntityCfg.InitialStateCfg(joint_pos=start),
    )
    cube = EntityCfg(spec_fn=cube_spec, init_state=EntityCfg.InitialStateCfg(pos=CUBE_POS, joint_pos={}, joint_vel={}))
    robot = SceneEntityCfg("robot", joint_names=JOINTS)
    terms = {
        "joint_pos": ObservationTermCfg(func=mdp.joint_pos_rel, params={"asset_cfg": robot}),
        "joint_vel": ObservationTermCfg(func=mdp.joint_vel_rel, params={"asset_cfg": robot}),
        "action": ObservationTermCfg(func=mdp.last_action),
        "touch": ObservationTermCfg(func=observation, params={"sensor": "touch", "group": "policy"}),
        "goal": ObservationTermCfg(func=goal),
    }
    place = {"x": (-0.02, 0.02), "y": (-0.02, 0.02), "yaw": (-math.radians(15), math.radians(15))}
    still = {"position_range": (0.0, 0.0), "velocity_range": (0.0, 0.0), "asset_cfg": SceneEntityCfg("robot")}
    return ManagerBasedRlEnvCfg(
        scene=SceneCfg(
            num_envs=1,
            env_spacing=0.5,
            entities={"robot": hand, "object": cube},
            sensors=(TouchSensorCfg(name="touch", document=DOCUMENT, scene_fn=scene_spec),),
        ),
        observations={"actor": ObservationGroupCfg(terms), "critic": ObservationGroupCfg(dict(terms))},
        actions={
            "joints": JointPositionActionCfg(
                entity_name="robot", actuator_names=JOINTS, scale=scale, offset=middle, use_default_offset=False
            )
        },
        events={
            "hand": EventTermCfg(func=mdp.reset_joints_by_offset, mode="reset", params=still),
            "place": EventTermCfg(
                func=mdp.reset_root_state_uniform,
                mode="reset",
                params={"pose_range": place, "asset_cfg": SceneEntityCfg("object")},
            ),
            "begin": EventTermCfg(func=begin, mode="reset"),
        },
        rewards={
            "spin": RewardTermCfg(func=spin, weight=2.0),
            "success": RewardTermCfg(func=success, weight=150.0),
            "tilt": RewardTermCfg(func=tilt, weight=-1.0),
            "object_distance": RewardTermCfg(func=object_distance, weight=-20.0),
            "drop": RewardTermCfg(func=mdp.is_terminated, weight=-100.0),
            "action_rate": RewardTermCfg(func=mdp.action_rate_l2, weight=-5e-4),
        },
        terminations={"time_out": TerminationTermCfg(func=mdp.time_out, time_out=True), "drop": TerminationTermCfg(func=drop)},
        sim=SimulationCfg(
            nconmax=64, njmax=256, mujoco=MujocoCfg(timestep=0.005, cone="elliptic", impratio=10.0, iterations=10)
        ),
        decimation=5,
        episode_length_s=10.0,
    )


def rl_cfg() -> RslRlOnPolicyRunnerCfg:
    """Return how mjlab's script learns it."""
    distribution = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "scalar"}
    return RslRlOnPolicyRunnerCfg(
        actor=RslRlModelCfg(
            hidden_dims=(512, 256, 128), activation="elu", obs_normalization=True, distribution_cfg=distribution
        ),
        critic=RslRlModelCfg(hidden_dims=(512, 256, 128), activation="elu", obs_normalization=True),
        algorithm=RslRlPpoAlgorithmCfg(gamma=0.99),
        experiment_name="tgdsl_in_palm_rotate",
        num_steps_per_env=16,
        max_iterations=3000,
        clip_actions=1.0,
        logger="tensorboard",
    )


register_mjlab_task(NAME, env_cfg(), env_cfg(), rl_cfg())
