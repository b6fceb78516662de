"""Joints of a USD stage, each as one MuJoCo joint: frames, limits, drives and authored positions, in SI and radians."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.formats.usd.attributes import JOINT, read_attributes, read_custom, units, with_limits
from tgdsl.formats.usd.stage import Matrix, Prim, Stage, is_within

INFINITE = 1e30  # limits of this magnitude and more are infinite: the largest float32 is often written for infinity
ROUNDING = 1e-6  # a drive's damping below this share of the joint's own, which was subtracted from it, is rounding of float32
Range = tuple[float, float]
FAR_LIMIT = 1e10  # stands for an infinite limit opposite a finite one: MuJoCo limits both sides or none [rad or m]
FRAME_TOLERANCE = 1e-4  # largest gap between the two frames of a joint in the authored poses [m and rad]
DOFS = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")
"""Degrees of freedom of a generic joint, as its limits and drives are called."""
AXES = {"X": np.array([1.0, 0.0, 0.0]), "Y": np.array([0.0, 1.0, 0.0]), "Z": np.array([0.0, 0.0, 1.0])}
CONSTRAINTS = ("MjcEqualityConnectAPI", "MjcEqualityWeldAPI")
"""Schemas of joints that are equality constraints of MuJoCo, in the tree or not."""
FORCES = ("damping", "armature", "frictionloss", "stiffness", "springdamper")
"""Attributes of an MJCF joint that an equality constraint does not have."""
KINDS = {"PhysicsRevoluteJoint": "hinge", "PhysicsPrismaticJoint": "slide", "PhysicsSphericalJoint": "ball"}
"""MuJoCo's joints by the schemas of UsdPhysics; fixed, generic and distance joints are handled separately."""


@dataclass(frozen=True)
class Drive:
    """A spring and damper that pulls a joint towards a target."""

    stiffness: float  # [N·m/rad or N/m]
    damping: float  # [N·m·s/rad or N·s/m]
    max_force: float  # [N·m or N], or infinity
    target: float = 0.0  # target position [rad or m]
    target_velocity: float = 0.0  # [rad/s or m/s]
    actuator: str = ""  # name of its actuator, or empty: the joint's
    control: Range | None = None  # range of the target, or None if it is free
    gear: float = 1.0  # the actuator's control is the target times this; it enters its gains twice, its force once
    order: float = math.inf  # place of its actuator among the actuators with an order; the others follow


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two bodies, or between one and the world."""

    path: str  # path of its prim
    prim: Prim  # its prim
    kind: str  # `hinge`, `slide`, `ball`, `fixed`, or `free` if it holds nothing
    axis: Float[np.ndarray, " 3"]  # its axis, in the joint frame
    bodies: tuple[str | None, str | None]  # paths of body 0 and body 1; None is the world
    targets: tuple[str, str]  # paths of the prims that it names, which may be below the bodies or static; or empty
    frames: tuple[Matrix, Matrix]  # the joint frame in the frames of body 0 and of body 1 [m]; they coincide at position zero
    range: Range | None  # least and greatest position [rad or m], or None if it has no limits
    drive: Drive | None  # what drives it
    is_excluded: bool  # whether it is excluded from the articulation
    is_filtering: bool | None  # whether the bodies must not collide; None: MuJoCo's filter decides
    is_stackable: bool  # whether its motion adds to other joints between the same two bodies
    constraint: str  # if it is an equality constraint of MuJoCo, its schema; or empty
    is_active: bool  # whether that constraint is active
    mjcf_attributes: dict[str, str]  # more attributes of the MJCF joint, its own damping, armature and dry friction among them

    @property
    def reference(self) -> float:
        """MuJoCo's position where the joint frames meet [rad or m]."""
        return float(self.mjcf_attributes.get("ref", 0.0))

    @property
    def is_passive(self) -> bool:
        forces = (self.mjcf_attributes.get(name, "0").split() for name in FORCES)
        return not (self.range or self.drive or any(float(value) for values in forces for value in values))

    def pose(self, is_swapped: bool) -> Matrix:
        parent, child = self.frames[::-1] if is_swapped else self.frames
        return parent @ np.linalg.inv(child)

    def authored(self, stage: Stage) -> tuple[Matrix, float, float]:
        """Return where frame 1 is in frame 0 as authored, the position [rad or m] and how far off the joint's motion it is."""
        poses = [np.eye(4) if body is None else stage.body_frames[body] for body in self.bodies]
        first, second = (pose @ frame for pose, frame in zip(poses, self.frames, strict=True))
        apart = np.linalg.inv(first) @ second
        turn = Rotation.from_matrix(apart[:3, :3])
        position, off, tilt = 0.0, apart[:3, 3], turn.magnitude()
        if self.kind == "hinge":
            x, y, z, w = turn.as_quat(canonical=True)
            position = 2 * math.atan2(float(self.axis @ [x, y, z]), float(w))
            tilt = (Rotation.from_rotvec(-position * self.axis) * turn).magnitude()
            position = _wrapped(position + self.reference, self.range) - self.reference
        elif self.kind == "slide":
            position = float(self.axis @ off)
            off = off - position * self.axis
        elif self.kind == "ball":
            tilt = 0.0
        return apart, position, max(float(np.linalg.norm(off)), float(tilt))


def _wrapped(angle: float, limits: Range | None) -> float:
    if limits is None:
        return angle
    return min((angle, angle - 2 * math.pi, angle + 2 * math.pi), key=lambda a: max(limits[0] - a, a - limits[1], 0.0))


def read_joints(stage: Stage) -> list[Joint]:
    """Read all enabled joints."""
    joints = []
    for prim in stage.prims:
        kind = str(prim.GetTypeName())
        if not prim.IsA(stage.pxr.UsdPhysics.Joint):
            if kind.endswith("Joint"):
                raise stage.error(
                    prim, f"{kind} is not supported; known joints: revolute, prismatic, spherical, fixed, generic"
                )
            continue
        if stage.value(prim, "physics:jointEnabled") or _constraint(stage, prim):
            joint = _joint(stage, prim)
            if joint.bodies[0] == joint.bodies[1]:
                stage.drop("joints were dropped that join a body to itself, or the world to the world", prim)
            else:
                joints.append(joint)
    return joints


def _joint(stage: Stage, prim: Prim) -> Joint:
    kind, axis, limits, instance = _kind(stage, prim)
    if limits and limits[0] > limits[1]:
        raise stage.error(prim, f"its lower limit {limits[0]!r} is above its upper limit {limits[1]!r}")
    (first, frame0, target0), (second, frame1, target1) = (_side(stage, prim, side) for side in (0, 1))
    attributes = with_limits(stage, read_attributes(stage, prim, JOINT, kind != "slide"), ("actuatorfrc",))
    if kind not in ("hinge", "slide"):
        attributes.pop("ref", None)
    if limits and limits[0] == limits[1]:  # a range without width is a weld at that position
        is_shifted = read_custom(stage, prim, "ref") is None
        place = _moved(kind, axis, limits[0] - (float(attributes.get("ref", 0.0)) if is_shifted else 0.0))
        kind, frame0, limits, attributes = "fixed", frame0 @ place, None, {}
    if read_custom(stage, prim, "ref") and "ref" in attributes:
        # MuJoCo's position is USD's, and starts elsewhere; with `mjc:ref` it starts where the frames meet.
        frame0 = frame0 @ _moved(kind, axis, float(attributes["ref"]))
    _drop_the_rest(stage, prim, instance if kind in ("hinge", "slide") else "")
    drive = None
    if kind in ("hinge", "slide"):
        shared_damping = float(read_custom(stage, prim, "damping") or 0.0)  # only `tgdsl:damping` is part of the drive's
        drive, joint_damping = _read_drive(stage, prim, instance, kind, shared_damping)
        attributes |= {"damping": repr(joint_damping)} if shared_damping else {}
    is_mujoco_scene = bool(stage.scenes) and stage.has(stage.scenes[0], "MjcSceneAPI")
    is_silent = is_mujoco_scene and stage.authored(prim, "physics:collisionEnabled") is None
    paths = (str(prim.GetPath()), target0, target1)
    is_adding = any(is_within(path, root) for root in stage.mobility_roots for path in paths)
    return Joint(
        path=str(prim.GetPath()),
        prim=prim,
        kind=kind,
        axis=axis,
        bodies=(first, second),
        targets=(target0, target1),
        frames=(frame0, frame1),
        range=limits,
        drive=drive,
        is_excluded=bool(stage.value(prim, "physics:excludeFromArticulation")),
        is_filtering=None if is_silent else not stage.value(prim, "physics:collisionEnabled"),
        is_stackable=kind in ("hinge", "slide", "ball") and (is_adding or stage.has(prim, "MjcJointAPI")),
        constraint=_constraint(stage, prim),
        is_active=bool(stage.value(prim, "physics:jointEnabled")),
        mjcf_attributes=attributes,
    )


def _constraint(stage: Stage, prim: Prim) -> str:
    return next((schema for schema in CONSTRAINTS if stage.has(prim, schema)), "")


def _moved(kind: str, axis: Float[np.ndarray, " 3"], position: float) -> Matrix:
    """Return where frame 1 of a hinge or slide is in frame 0."""
    matrix = np.eye(4)
    if kind == "hinge":
        matrix[:3, :3] = Rotation.from_rotvec(position * axis).as_matrix()
    else:
        matrix[:3, 3] = position * axis
    return matrix


def _kind(stage: Stage, prim: Prim) -> tuple[str, Float[np.ndarray, " 3"], Range | None, str]:
    """Return the kind of a joint, its axis, its range [rad or m] and which drive is its own."""
    schema = str(prim.GetTypeName())
    axis = AXES.get(str(stage.value(prim, "physics:axis")), AXES["X"])
    if schema == "PhysicsJoint":
        return _generic(stage, prim)
    if schema == "PhysicsFixedJoint":
        return "fixed", axis, None, ""
    if schema not in KINDS:
        raise stage.error(prim, f"{schema} is not supported: MuJoCo has no such joint")
    kind = KINDS[schema]
    if kind == "ball":
        cone = [stage.number(prim, f"physics:coneAngle{i}Limit", -1.0) for i in (0, 1)]
        if stage.has(prim, "MjcJointAPI") and cone[0] == cone[1] > 0:  # so the schema's own writer puts a ball joint's range
            return kind, axis, (0.0, math.radians(cone[0])), ""
        if max(cone) >= 0:
            stage.drop("cone limits of spherical joints were dropped: MuJoCo limits a ball joint's whole angle", prim)
        return kind, axis, None, ""
    low, high = (stage.number(prim, f"physics:{end}Limit") for end in ("lower", "upper"))
    unit = math.radians(1) if kind == "hinge" else stage.metres_per_unit
    return kind, axis, _range(low, high, unit), "angular" if kind == "hinge" else "linear"


def _generic(stage: Stage, prim: Prim) -> tuple[str, Float[np.ndarray, " 3"], Range | None, str]:
    """Return what a joint that is defined by its limits amounts to."""
    free: dict[str, Range | None] = {}
    for dof in DOFS:
        if not prim.HasAPI(stage.pxr.UsdPhysics.LimitAPI, dof):
            free[dof] = None
            continue
        low, high = (stage.number(prim, f"limit:{dof}:physics:{end}") for end in ("low", "high"))
        if low < high or low == high != 0.0:
            free[dof] = _range(low, high, math.radians(1) if dof.startswith("rot") else stage.metres_per_unit)
    is_unlimited = not any(free.values()) and not prim.HasAPI(stage.pxr.UsdPhysics.LimitAPI, "distance")
    if not free:
        return "fixed", AXES["X"], None, ""
    if len(free) == 1:
        ((dof, limits),) = free.items()
        return ("hinge" if dof.startswith("rot") else "slide"), AXES[dof[-1]], limits, dof
    if is_unlimited and tuple(free) == DOFS:
        return "free", AXES["X"], None, ""
    if is_unlimited and tuple(free) == DOFS[3:]:
        return "ball", AXES["X"], None, ""
    raise stage.error(
        prim, f"a generic joint that leaves {', '.join(free)} free is no single MuJoCo joint (hinge, slide, ball, fixed, free)"
    )


def _range(low: float, high: float, unit: float) -> Range | None:
    ends = tuple(math.copysign(FAR_LIMIT, end) if abs(end) >= INFINITE else end * unit for end in (low, high))
    return None if max(abs(low), abs(high)) >= INFINITE and min(abs(low), abs(high)) >= INFINITE else (ends[0], ends[1])


def _side(stage: Stage, prim: Prim, side: int) -> tuple[str | None, Matrix, str]:
    """Return the body on one side of a joint, the joint frame in it, and the path of the prim that is named, or nothing."""
    targets = stage.targets(prim, f"physics:body{side}")
    if len(targets) > 1:
        raise stage.error(prim, f"physics:body{side} has {len(targets)} targets; expected one at most")
    target = stage.usd.GetPrimAtPath(targets[0]) if targets else stage.usd.GetPseudoRoot()
    if not target or str(target.GetPath()) not in stage.owners:  # USD returns inactive prims too
        raise stage.error(prim, f"physics:body{side} names {targets[0]}, which does not exist")
    body = stage.owners[str(target.GetPath())]
    frame, scale = stage.frame(target)
    local = np.eye(4)
    local[:3, 3] = scale * np.array(stage.value(prim, f"physics:localPos{side}"), dtype=np.float64)
    local[:3, :3] = rotation_of(stage, prim, f"physics:localRot{side}").as_matrix()
    if not np.isfinite(local).all():
        raise stage.error(prim, f"physics:localPos{side} is not finite")
    frame = frame @ local
    return body, stage.in_body(frame, body), targets[0] if targets else ""


def rotation_of(stage: Stage, prim: Prim, name: str) -> Rotation:
    """Return the value of a quaternion attribute."""
    value = stage.value(prim, name)
    quat = np.array([value.GetReal(), *value.GetImaginary()], dtype=np.float64)
    length = np.linalg.norm(quat)
    if not np.isfinite(length) or length == 0:
        raise stage.error(prim, f"{name} is no rotation: {value}")
    return Rotation.from_quat(quat / length, scalar_first=True)


def _drop_the_rest(stage: Stage, prim: Prim, instance: str) -> None:
    """Take note of what a joint has that MuJoCo cannot do."""
    for dof in (*DOFS, "linear", "angular"):
        gains = [stage.number(prim, f"drive:{dof}:physics:{name}") for name in ("stiffness", "damping")]
        if dof != instance and prim.HasAPI(stage.pxr.UsdPhysics.DriveAPI, dof) and any(gains):
            stage.drop(
                "drives were dropped that are not along the one degree of freedom of a revolute or prismatic joint", prim
            )
    for name in ("physics:breakForce", "physics:breakTorque"):
        if stage.number(prim, name, math.inf) < INFINITE:
            stage.drop("joints do not break: their breakForce and breakTorque were dropped", prim)


def _read_drive(stage: Stage, prim: Prim, instance: str, kind: str, joint_damping: float) -> tuple[Drive | None, float]:
    """Return a joint's drive, if it has one that can exert a force, and the joint's own damping."""
    if not prim.HasAPI(stage.pxr.UsdPhysics.DriveAPI, instance):
        return None, joint_damping
    stiffness, damping, max_force, target, velocity = (
        stage.number(prim, f"drive:{instance}:physics:{name}")
        for name in ("stiffness", "damping", "maxForce", "targetPosition", "targetVelocity")
    )
    if not stiffness and not damping:
        return None, joint_damping  # it never exerts a force
    if stage.value(prim, f"drive:{instance}:physics:type") == "acceleration":
        stage.drop("drives were dropped whose gains are per mass (type acceleration), which MuJoCo does not have", prim)
        return None, joint_damping
    unit = units(stage, is_angular=kind == "hinge")
    gain = unit["damping"]
    max_force = math.inf if max_force >= INFINITE else max_force * unit["effort"]
    joint_damping = min(joint_damping, damping * gain)
    servo_damping = damping * gain - joint_damping
    servo_damping = 0.0 if servo_damping < ROUNDING * joint_damping else servo_damping
    if not stiffness and not servo_damping:
        return None, joint_damping
    gear = float(read_custom(stage, prim, "gear") or 1.0)
    of_joint, of_actuator = (read_custom(stage, prim, key) for key in ("actuatorfrcrange", "forcerange"))
    if of_joint is not None and math.isclose(max_force, np.abs(of_joint).max(), rel_tol=ROUNDING):
        # The drive's limit is the smaller of the joint's, which is read with the joint, and the actuator's.
        max_force = math.inf if of_actuator is None else float(of_actuator[1]) * abs(gear)
    control = read_custom(stage, prim, "ctrlrange")
    order = read_custom(stage, prim, "order")
    drive = Drive(
        stiffness * gain,
        servo_damping,
        max_force,
        target * unit["position"],
        velocity * unit["position"],
        str(read_custom(stage, prim, "actuator") or ""),
        None if control is None else (float(control[0]), float(control[1])),
        gear,
        math.inf if order is None else float(order),
    )
    return drive, joint_damping
