"""A log of a real XHand1 as a recording: the links' poses follow from its joint angles, and each fingertip is a load cell.

A log has no poses of the hand's base and of objects. They come from the scene, so neither may move: an object is a fixture
bolted down near the hand. See `calibration.recordings` for the format.

Shapes: `step` readings of the log; `body` and `joint` as in the module's inputs.
"""

from __future__ import annotations

import mujoco
import numpy as np

from tgdsl.calibration.hand.loads import FORCE_CHANNELS
from tgdsl.calibration.recordings import Arrays
from tgdsl.errors import Problem, SpecError, listed
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.runtime.xhand1.log.log import HandLog
from tgdsl.runtime.xhand1.motion import joint_ids
from tgdsl.runtime.xhand1.observe import finger_of
from tgdsl.scene.scene import scene_model


def recording_of(log: HandLog, touch: TactileModule) -> Arrays:
    """Return a log as a recording for a module.

    Its targets are the force readings whose taxels are all on one fingertip: the sum over these taxels [N].

    Raises:
        SpecError: If an object or the hand's base moves, the log's forces are counts, or no reading is such a force.
        MotionError: If the scene's robot is no whole XHand1.
    """
    model = scene_model(touch.plan.scene)
    joints, bodies = joint_ids(model), [model.body(name).id for name in touch.inputs.names["body"]]
    mistakes = []
    if moving := [model.body(body).name for body in bodies if not set(_joints_above(model, body)) <= set(joints.tolist())]:
        hint = "weld it to the world where it was, or write a recording with its poses"
        mistakes.append((f"a log lacks the poses of {listed(moving)}, which can move", hint))
    if log.calibration is None or log.calibration.units != "N":
        hint = "record with --calibration; `tgdsl calibrate hand` fits one"
        mistakes.append(("the log's forces are counts, expected newtons", hint))
    targets = {output.name: finger for output in touch.outputs if (finger := _finger_of(output)) is not None}
    if not targets:
        problem = "no reading is the force on the taxels of one fingertip, which is all that a log has"
        mistakes.append((problem, f"the document has {listed([output.name for output in touch.outputs])}"))
    if mistakes:
        raise SpecError([Problem(str(log.path), 0, 0, "", problem, hint) for problem, hint in mistakes])
    assert log.calibration is not None
    time, position = log.received_at - log.received_at[0], log.column("position").astype(np.float64)
    force = log.calibration.apply(log.column("total_force"))
    pos, quat = _poses(model, model.jnt_qposadr[joints], position, bodies)
    names = np.array([model.joint(joint).name for joint in joints])
    arrays = {"time": time, "body_pos": pos, "body_quat": quat, "joint_pos": position, "joints": names}
    for name, finger in targets.items():
        arrays |= {f"target:{name}": force[:, None, finger], f"clock:{name}": time}
        arrays |= {f"rows:{name}": np.array("sum"), f"unit:{name}": np.array("N")}
        arrays[f"channels:{name}"] = np.array(FORCE_CHANNELS)
    return arrays


def _joints_above(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the joints that move a body."""
    joints: list[int] = []
    while body:
        first = model.body_jntadr[body]
        joints += range(first, first + model.body_jntnum[body])
        body = model.body_parentid[body]
    return joints


def _finger_of(output: Output) -> int | None:
    """Return the fingertip that all taxels of a force reading are on."""
    is_force = output.rows == "taxel" and set(FORCE_CHANNELS) <= set(output.channels) and len(output.shape) == 2
    return finger_of(output.bodies[0]) if is_force and len(output.bodies) == 1 else None


def _poses(
    model: mujoco.MjModel, qpos_id: np.ndarray, position: np.ndarray, bodies: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (step, body, 3) [m] and quaternions (step, body, 4) of bodies at joint angles [rad]."""
    data = mujoco.MjData(model)
    pos, quat = np.empty((len(position), len(bodies), 3)), np.empty((len(position), len(bodies), 4))
    for step, angles in enumerate(position):
        data.qpos[qpos_id] = angles
        mujoco.mj_kinematics(model, data)
        pos[step], quat[step] = data.xpos[bodies], data.xquat[bodies]
    return pos, quat
