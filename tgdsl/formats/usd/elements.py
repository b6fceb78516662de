"""MJCF elements of what a USD stage holds, every number with all its digits."""

from __future__ import annotations

import hashlib
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

import numpy as np

from tgdsl.formats.usd.articulation import TreeNode
from tgdsl.formats.usd.drives import Drive
from tgdsl.formats.usd.geoms import Gprim, Site
from tgdsl.formats.usd.joints import Joint
from tgdsl.formats.usd.mjc.actuators import Actuator
from tgdsl.formats.usd.shapes import Shape, quaternion
from tgdsl.formats.usd.stage import Matrix, Stage

AXIS_ARM = 0.05
"""Distance between the two connect constraints along the axis of a revolute joint that closes a loop [m]."""
REST_TOLERANCE = 1e-6
"""Largest authored position without a keyframe [rad or m]: it is rounding of float32."""
VISIBLE, VISUAL, HIDDEN = "0", "2", "3"
"""Groups of geoms: colliders that are visible, visuals that do not collide, what is not visible."""
SAME_GAIN = 1e-5
"""Relative difference up to which a drive, which is in float32, and an actuator are the same servo."""
FRICTION = (1.0, 0.005, 0.0001)
"""MuJoCo's default friction of a geom."""


def floats_text(values: Iterable[float]) -> str:
    """Return numbers as text that reads back as the same float64."""
    return " ".join(repr(float(value) + 0.0) for value in values)


def with_pose(element: ET.Element, pose: Matrix) -> ET.Element:
    """Set an element's pose in its body, or a body's in its parent; return the element."""
    element.set("pos", floats_text(pose[:3, 3]))
    element.set("quat", floats_text(quaternion(pose)))
    return element


class MeshAssets:
    """Mesh assets of a model, without duplicates: meshes are the same if they are in float32, which is MuJoCo's type."""

    def __init__(self, asset: ET.Element):
        self.asset = asset
        self.names: dict[str, str] = {}

    def name(self, shape: Shape, name: str, attributes: Mapping[str, str]) -> str:
        """Return the name of a shape's mesh, which is added if it is new: under its custom name, or else the given one."""
        assert shape.vertices is not None and shape.faces is not None
        vertices = np.ascontiguousarray(shape.vertices + 0.0, dtype=np.float32)
        faces = np.ascontiguousarray(shape.faces, dtype=np.int64)
        key = hashlib.sha256(
            vertices.tobytes() + b"|" + faces.tobytes() + repr(sorted(attributes.items())).encode()
        ).hexdigest()
        if key not in self.names:
            wanted = (attributes.get("name", name), name, *(f"{name}_{i + 2}" for i in range(len(self.names))))
            self.names[key] = next(own for own in wanted if own not in self.names.values())
            # Masses are given with the bodies; a shell is what MuJoCo never finds wrong with a mesh that is open or flat.
            mesh = ET.SubElement(self.asset, "mesh", {"inertia": "shell", **attributes, "name": self.names[key]})
            mesh.set("vertex", " ".join(map(str, vertices.reshape(-1))))
            mesh.set("face", " ".join(map(str, faces.reshape(-1).tolist())))
        return self.names[key]


def add_geom(body: ET.Element, name: str, geom: Gprim, meshes: MeshAssets) -> None:
    """Add a collider or visual to its body."""
    element = ET.SubElement(body, "geom", name=name, type=geom.shape.kind)
    with_pose(element, geom.shape.pose)
    if geom.shape.kind == "mesh":
        element.set("mesh", meshes.name(geom.shape, name, geom.mesh))
    else:
        element.set("size", floats_text(geom.shape.size))
    if geom.is_collider:
        element.set("group", VISIBLE if geom.is_visible else HIDDEN)
        element.attrib |= geom.mjcf_attributes
        if (friction := _friction(geom)) is not None:
            element.set("friction", friction)
    else:
        element.set("group", geom.mjcf_attributes.get("group", VISUAL if geom.is_visible else HIDDEN))
        for attribute in ("contype", "conaffinity", "mass"):
            element.set(attribute, "0")
    if geom.color is not None:
        element.set("rgba", floats_text(geom.color))


def _friction(geom: Gprim) -> str | None:
    """Return the frictions of a geom: sliding as its material says, the others as `tgdsl:friction`, or else its material."""
    own = [float(value) for value in geom.mjcf_attributes.get("friction", "").split()]
    sliding, *others = geom.friction
    if not own and geom.friction == (None, None, None):
        return None
    values = [sliding if sliding is not None else (own or FRICTION)[0]]
    for number, other in enumerate(others, start=1):
        values.append(own[number] if len(own) > number else FRICTION[number] if other is None else other)
    return floats_text(values)


def add_site(body: ET.Element, name: str, site: Site) -> None:
    """Add a site to its body."""
    with_pose(ET.SubElement(body, "site", {"name": name} | site.mjcf_attributes), site.pose)


def add_joint_element(body: ET.Element, node: TreeNode, names: Mapping[str, str], free: str) -> None:
    """Add a body's joints to its parent: none if it is fixed, a free joint named `free` if it floats."""
    if node.joint is None:
        ET.SubElement(body, "freejoint", {"name": free} if free else {})
    for joint in node.joints:
        if joint.kind == "fixed":
            continue
        frame = joint.frames[0 if node.is_swapped(joint) else 1]
        element = ET.SubElement(body, "joint", name=names[joint.path], type=joint.kind, pos=floats_text(frame[:3, 3]))
        if joint.kind != "ball":
            # Positions count body 1 against body 0; where body 0 is the child, it turns the other way.
            element.set("axis", floats_text(frame[:3, :3] @ joint.axis * (-1 if node.is_swapped(joint) else 1)))
        if joint.range is not None:
            element.set("range", floats_text(joint.range))
        element.attrib |= joint.mjcf_attributes


def add_loop_constraint(
    equality: ET.Element,
    ends: tuple[ET.Element, ET.Element],
    joint: Joint,
    name: str,
    attributes: Mapping[str, str],
    taken: Iterable[str] = (),
) -> None:
    """Add the equality constraint of a joint that closes a loop: position zero of the model need not close it.

    Args:
        equality: Where constraints go.
        ends: Elements of body 0 and body 1.
        joint: The joint: ball, fixed or hinge, or one that is MuJoCo's own constraint.
        name: Its name.
        attributes: More attributes of the constraint.
        taken: Names of the sites that are there.
    """
    taken = set(taken)
    is_hinge = joint.kind == "hinge" and not joint.constraint
    tag = "weld" if (joint.constraint or joint.kind) in ("MjcEqualityWeldAPI", "fixed") else "connect"
    for end in range(2 if is_hinge else 1):
        sites = []
        for side in (0, 1):
            site = f"{name}_{end}{side}"
            while site in taken:
                site += "_"
            place = joint.frames[side].copy()
            place[:3, 3] += place[:3, :3] @ joint.axis * AXIS_ARM * end
            with_pose(ET.SubElement(ends[side], "site", name=site, size="0.001", group="4"), place)
            sites.append(site)
        named = {"name": f"{name}_{end}" if is_hinge else name, "site1": sites[0], "site2": sites[1]}
        ET.SubElement(equality, tag, {**named, **attributes})


def own_drives(stage: Stage, joints: Iterable[Joint], actuators: Iterable[Actuator]) -> list[Joint]:
    """Return the joints whose drives are actuators: those without a prim that says the same, and more exactly.

    A drive with `tgdsl:order` is an actuator of its own beside them.

    Args:
        stage: The stage.
        joints: All joints of the tree.
        actuators: Those that are prims.
    """
    result, driven = [], {actuator.joint: actuator for actuator in actuators if actuator.joint}
    for joint in joints:
        if joint.drive is None:
            continue
        other = driven.get(joint.path)
        if other is None or not math.isinf(joint.drive.order):
            result.append(joint)
        elif not _is_same_servo(joint.drive, other):
            stage.drop("drives were dropped, which contradict the actuator prims of their joints", joint.prim)
    return result


def _is_same_servo(drive: Drive, actuator: Actuator) -> bool:
    """Return whether an actuator pulls as a drive does."""
    gain, gear = (float(actuator.attributes.get(name, "1").split()[0]) for name in ("gainprm", "gear"))
    bias = [float(value) for value in actuator.attributes.get("biasprm", "").split()] + [0.0] * 3
    gains = np.array([gain, -bias[1], -bias[2]]) * gear**2
    wanted = np.array([drive.stiffness or drive.damping, drive.stiffness, drive.damping])
    return bool(np.allclose(gains, wanted, rtol=SAME_GAIN))


def add_actuators_and_key(
    keyframe: ET.Element,
    actuator: ET.Element,
    motions: Iterable[tuple[TreeNode, tuple[Matrix, float, float] | None]],
    frames: Mapping[str, Matrix],
    kinematic: Mapping[str, bool],
    names: Mapping[str, str],
    driven: Iterable[Joint],
    others: Iterable[Actuator],
) -> None:
    """Add all actuators, and the keyframe `authored` if the authored poses or the drives' targets are not MuJoCo's defaults.

    Args:
        keyframe: Where keyframes go.
        actuator: Where actuators go.
        motions: All nodes in MuJoCo's order, each with what `Joint.authored` says of its joint.
        frames: World poses of all bodies [m].
        kinematic: Whether each body is kinematic.
        names: Names of the joints.
        driven: Joints whose drives are actuators.
        others: Actuators that are prims.
    """
    qpos, is_needed = _authored_qpos(motions, frames, kinematic)
    others = list(others)
    taken = [other.attributes["name"] for other in others]
    servos = [_servo(joint, names[joint.path], taken) for joint in driven]
    actuators = sorted((*others, *servos), key=lambda own: own.order)
    for own in actuators:
        ET.SubElement(actuator, own.kind, own.attributes)
    ctrl = [own.control for own in actuators]
    if is_needed or any(ctrl):
        key = ET.SubElement(keyframe, "key", name="authored", qpos=floats_text(qpos))
        if ctrl:
            key.set("ctrl", floats_text(ctrl))


def _authored_qpos(
    motions: Iterable[tuple[TreeNode, tuple[Matrix, float, float] | None]],
    frames: Mapping[str, Matrix],
    kinematic: Mapping[str, bool],
) -> tuple[list[float], bool]:
    """Return `qpos` in the authored poses, and whether any joint is not at position zero."""
    qpos: list[float] = []
    is_needed = False
    for node, authored in motions:
        joint = node.joint
        if joint is None or authored is None:
            if not kinematic[node.body]:
                qpos += [*frames[node.body][:3, 3], *quaternion(frames[node.body])]
            continue
        if node.stacked:
            for own in node.joints:
                qpos += [1.0, 0.0, 0.0, 0.0] if own.kind == "ball" else [own.reference]
        elif joint.kind in ("hinge", "slide"):
            qpos.append(authored[1] + joint.reference)
            is_needed |= abs(authored[1]) > REST_TOLERANCE
        elif joint.kind == "ball":
            turn = quaternion(_child_turn(node, joint, authored[0]))
            qpos += [*turn]
            is_needed |= bool(np.abs(turn[1:]).max() > REST_TOLERANCE)
    return qpos, is_needed


def _child_turn(node: TreeNode, joint: Joint, apart: Matrix) -> Matrix:
    """Return a ball joint's rotation as MuJoCo counts it: in the child's axes at position zero."""
    frame, turn = joint.frames[0 if node.is_swapped(joint) else 1], np.eye(4)
    own = apart[:3, :3].T if node.is_swapped(joint) else apart[:3, :3]
    turn[:3, :3] = frame[:3, :3] @ own @ frame[:3, :3].T
    return turn


def _servo(joint: Joint, name: str, taken: list[str]) -> Actuator:
    """Return the actuator that is a joint's drive; its control at the keyframe is the drive's target."""
    drive = joint.drive
    assert drive is not None
    own = drive.actuator or name
    while own in taken:
        own += "_drive"
    taken.append(own)
    attributes, gear = {"name": own, "joint": name}, drive.gear
    if gear != 1.0:
        attributes["gear"] = floats_text([gear])
    if drive.control is not None:
        attributes["ctrlrange"] = floats_text(sorted(end * gear for end in drive.control))
    if not math.isinf(drive.max_force):
        most = drive.max_force / abs(gear)
        attributes["forcerange"] = floats_text([-most, most])
    stiffness, damping = drive.stiffness / gear**2, drive.damping / gear**2
    kp, kv = floats_text([stiffness]), floats_text([damping])
    if not stiffness:
        return Actuator(attributes | {"kv": kv}, joint.path, drive.order, drive.target_velocity * gear, "velocity")
    if not drive.target_velocity:
        return Actuator(attributes | {"kp": kp, "kv": kv}, joint.path, drive.order, drive.target * gear, "position")
    # A spring whose damper pulls towards a speed: a position actuator with a constant force.
    bias = floats_text([damping * drive.target_velocity * gear, -stiffness, -damping])
    attributes |= {"gainprm": kp, "biastype": "affine", "biasprm": bias}
    return Actuator(attributes, joint.path, drive.order, drive.target * gear)
