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
from tgdsl.formats.usd.shapes import Shape, quaternion
from tgdsl.formats.usd.stage import Matrix

AXIS_ARM = 0.05
"""Distance between the two connect constraints along the axis of a revolute joint that closes a loop [m]."""
REST_TOLERANCE = 1e-6
"""Largest authored position without a keyframe [rad or m]: it is rounding of float32."""
VISIBLE, VISUAL, HIDDEN = "0", "2", "3"
"""Groups of geoms: colliders that are visible, visuals that do not collide, colliders that are not visible."""


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
        if geom.friction is not None:
            more = geom.mjcf_attributes.get("friction", "").split()[1:]
            element.set("friction", " ".join([*floats_text([geom.friction]).split(), *more]))
    else:
        for attribute, value in {"group": VISUAL, "contype": "0", "conaffinity": "0", "mass": "0"}.items():
            element.set(attribute, value)
    if geom.color is not None:
        element.set("rgba", floats_text(geom.color))


def add_site(body: ET.Element, name: str, site: Site) -> None:
    """Add a site to its body."""
    with_pose(ET.SubElement(body, "site", {"name": name} | site.mjcf_attributes), site.pose)


def add_joint_element(body: ET.Element, node: TreeNode, names: Mapping[str, str], free: str) -> None:
    """Add a body's joint to its parent: none if it is fixed, a free joint named `free` if it floats."""
    joint = node.joint
    if joint is None:
        ET.SubElement(body, "freejoint", {"name": free} if free else {})
        return
    if joint.kind == "fixed":
        return
    frame = joint.frames[0 if node.is_swapped else 1]
    element = ET.SubElement(body, "joint", name=names[joint.path], type=joint.kind, pos=floats_text(frame[:3, 3]))
    if joint.kind != "ball":
        # Positions count body 1 against body 0; where body 0 is the child, it turns the other way.
        element.set("axis", floats_text(frame[:3, :3] @ joint.axis * (-1 if node.is_swapped else 1)))
        if joint.range is not None:
            element.set("range", floats_text(joint.range))
    for attribute, value in {"damping": joint.damping, "armature": joint.armature, "frictionloss": joint.friction}.items():
        if value:
            element.set(attribute, floats_text([value]))
    element.attrib |= joint.mjcf_attributes


def add_loop_constraint(
    equality: ET.Element, ends: tuple[ET.Element, ET.Element], joint: Joint, name: str, taken: Iterable[str] = ()
) -> None:
    """Add the equality constraint of a joint that closes a loop: position zero of the model need not close it.

    Args:
        equality: Where constraints go.
        ends: Elements of body 0 and body 1.
        joint: The joint: ball, fixed or hinge.
        name: Its name.
        taken: Names of the sites that are there.
    """
    taken = set(taken)
    for end in range(2 if joint.kind == "hinge" else 1):
        sites = []
        for side in (0, 1):
            site = f"{name}_{end}{side}"
            while site in taken:
                site += "_"
            place = joint.frames[side].copy()
            place[:3, 3] += place[:3, :3] @ joint.axis * AXIS_ARM * end
            with_pose(ET.SubElement(ends[side], "site", name=site, size="0.001", group="4"), place)
            sites.append(site)
        tag = "weld" if joint.kind == "fixed" else "connect"
        ET.SubElement(equality, tag, name=f"{name}_{end}" if joint.kind == "hinge" else name, site1=sites[0], site2=sites[1])


def add_actuators_and_key(
    keyframe: ET.Element,
    actuator: ET.Element,
    motions: Iterable[tuple[TreeNode, tuple[Matrix, float, float] | None]],
    frames: Mapping[str, Matrix],
    kinematic: Mapping[str, bool],
    names: Mapping[str, str],
) -> None:
    """Add all actuators, and the keyframe `authored` if the authored poses or the drives' targets are not MuJoCo's defaults.

    Args:
        keyframe: Where keyframes go.
        actuator: Where actuators go.
        motions: All nodes in MuJoCo's order, each with what `Joint.authored` says of its joint.
        frames: World poses of all bodies [m].
        kinematic: Whether each body is kinematic.
        names: Names of the joints.
    """
    motions = list(motions)
    qpos, is_needed = _authored_qpos(motions, frames, kinematic)
    joints = [node.joint for node, _ in motions if node.joint is not None]
    driven = [(joint.drive, names[joint.path]) for joint in joints if joint.drive is not None]
    ctrl = [_add_actuator(actuator, drive, name) for drive, name in sorted(driven, key=lambda pair: pair[0].order)]
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
        if joint.kind in ("hinge", "slide"):
            qpos.append(authored[1])
            is_needed |= abs(authored[1]) > REST_TOLERANCE
        elif joint.kind == "ball":
            turn = quaternion(_child_turn(node, joint, authored[0]))
            qpos += [*turn]
            is_needed |= bool(np.abs(turn[1:]).max() > REST_TOLERANCE)
    return qpos, is_needed


def _child_turn(node: TreeNode, joint: Joint, apart: Matrix) -> Matrix:
    """Return a ball joint's rotation as MuJoCo counts it: in the child's axes at position zero."""
    frame, turn = joint.frames[0 if node.is_swapped else 1], np.eye(4)
    own = apart[:3, :3].T if node.is_swapped else apart[:3, :3]
    turn[:3, :3] = frame[:3, :3] @ own @ frame[:3, :3].T
    return turn


def _add_actuator(actuator: ET.Element, drive: Drive, joint: str) -> float:
    """Add the actuator that is a drive of a joint, and return its control at the drive's target."""
    attributes, gear = {"name": drive.actuator or joint, "joint": joint}, drive.gear
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
        ET.SubElement(actuator, "velocity", attributes, kv=kv)
        return drive.target_velocity * gear
    if not drive.target_velocity:
        ET.SubElement(actuator, "position", attributes, kp=kp, kv=kv)
        return drive.target * gear
    # A spring whose damper pulls towards a speed: a position actuator with a constant force.
    bias = floats_text([damping * drive.target_velocity * gear, -stiffness, -damping])
    ET.SubElement(actuator, "general", attributes, gainprm=kp, biastype="affine", biasprm=bias)
    return drive.target * gear
