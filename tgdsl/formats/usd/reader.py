"""USD in: a UsdPhysics stage becomes MJCF.

The semantics are those of the UsdPhysics schemas. Where MuJoCo leaves a choice:

- A body's frame is its prim's, without scale; its name is the end of the prim's path, or the custom attribute `tgdsl:name`.
- Position zero is where the frames of a joint meet. If the authored poses or the drives' targets differ from it, the keyframe
  `authored` has them.
- A drive becomes a `position` actuator, or a `velocity` actuator if it has no stiffness, named after its joint. A drive
  without gains exerts no force and gives none. What `tgdsl:damping` says is the joint's own is taken off the drive's.
- Sliding friction is a material's dynamic friction, or its static friction if only that is authored; MuJoCo takes the greater
  of two, and its own default where no material is bound.
- `physxJoint:armature` and `physxJoint:jointFriction` (a torque or force) are read where they are authored.
- A joint that closes a loop becomes an equality constraint between sites.
- Colliders are in group 0 if they are visible and in group 3 if not, other visuals in group 2. Materials' looks, subdivision,
  holes of meshes and what is not drawn by default are left out; whatever else is dropped is warned of.
- Custom attributes `tgdsl:` that `export` writes are read back, in SI units and radians whatever those of the stage.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import RobotError
from tgdsl.formats.model import Model
from tgdsl.formats.usd.articulation import SpanningTree, TreeNode, spanning_tree
from tgdsl.formats.usd.custom_attributes import OPTION, read_custom, read_mjcf_attributes, read_option_flags
from tgdsl.formats.usd.elements import (
    MeshAssets,
    add_actuators_and_key,
    add_geom,
    add_joint_element,
    add_loop_constraint,
    add_site,
    floats_text,
    with_pose,
)
from tgdsl.formats.usd.filters import exclusions
from tgdsl.formats.usd.geoms import Gprim, Site, read_gprims, read_sites
from tgdsl.formats.usd.joints import FRAME_TOLERANCE, Joint, read_joints
from tgdsl.formats.usd.mass import Inertial, inertial_of
from tgdsl.formats.usd.stage import Matrix, Prim, Stage, open_stage, unique_names

GRAVITY = 9.81
"""What a stage's scene means by earth gravity [m/s²]."""


@dataclass(frozen=True, eq=False)
class _Robot:
    """All that a stage holds.

    Attributes:
        bodies: Prims of the rigid bodies, by path.
        frames: Their world poses [m].
        joints: All joints.
        geoms: All geoms.
        sites: All sites.
        inertials: Mass and inertia of each body that has one.
        tree: Parent and joint of each body.
        kinematic: Whether each body is kinematic.
        names: Name of each body, then of each geom, of each joint and of each site, by path.
        free: Name of each floating body's joint, or empty, by the body's path.
    """

    bodies: dict[str, Prim]
    frames: dict[str, Matrix]
    joints: list[Joint]
    geoms: list[Gprim]
    sites: list[Site]
    inertials: dict[str, Inertial | None]
    tree: SpanningTree
    kinematic: dict[str, bool]
    names: tuple[dict[str, str], dict[str, str], dict[str, str], dict[str, str]]
    free: dict[str, str]


def read_usd(path: Path) -> Model:
    """Read and compile a UsdPhysics stage.

    Raises:
        RobotError: As `usd_to_mjcf`.
        ValueError: If MuJoCo cannot compile it.
    """
    text = usd_to_mjcf(path)
    spec = mujoco.MjSpec.from_string(text)
    return Model(path, spec, spec.compile(), is_urdf=False, mjcf=text)


def usd_to_mjcf(path: Path) -> str:
    """Return a UsdPhysics stage as one self-contained MJCF text, in SI with Z up.

    Raises:
        RobotError: If usd-core is missing, the file is not USD, something that it refers to is missing, or it holds
            something that MuJoCo cannot express.
    """
    with open_stage(path) as stage:
        robot = _read(stage)
        _check(stage, robot)
        return ET.tostring(_mjcf_root(stage, robot), encoding="unicode")


def _read(stage: Stage) -> _Robot:
    physics = stage.pxr.UsdPhysics
    bodies = {
        str(prim.GetPath()): prim
        for prim in stage.prims
        if prim.HasAPI(physics.RigidBodyAPI) and stage.value(prim, "physics:rigidBodyEnabled")
    }
    if not bodies:
        raise RobotError(f"{stage.file}: /: no prim has an enabled PhysicsRigidBodyAPI: there is no robot in it")
    owners: dict[str, str | None] = {"/": None}
    for prim in stage.prims:
        path = str(prim.GetPath())
        owners[path] = path if path in bodies else owners[path.rpartition("/")[0] or "/"]
    frames = {path: stage.frame(prim)[0] for path, prim in bodies.items()}
    joints, geoms = read_joints(stage, owners, frames), read_gprims(stage, owners, frames)
    sites = read_sites(stage, owners, frames)
    inertials = {
        path: inertial_of(stage, prim, [geom for geom in geoms if geom.body == path], frames[path])
        for path, prim in bodies.items()
    }
    kinematic = {path: bool(stage.value(prim, "physics:kinematicEnabled")) for path, prim in bodies.items()}
    roots = [str(prim.GetPath()) for prim in stage.prims if prim.HasAPI(physics.ArticulationRootAPI)]
    names = (
        unique_names(stage, bodies.values(), ["world"]),
        unique_names(stage, {geom.path: geom.prim for geom in geoms}.values()),
        unique_names(stage, [joint.prim for joint in joints]),
        unique_names(stage, [site.prim for site in sites]),
    )
    tree = spanning_tree(kinematic, joints, roots)
    free = {path: str(read_custom(stage, prim, "freejoint") or "") for path, prim in bodies.items()}
    return _Robot(bodies, frames, joints, geoms, sites, inertials, tree, kinematic, names, free)


def _check(stage: Stage, robot: _Robot) -> None:
    """Refuse what MuJoCo would refuse without naming the prim, and take note of what it cannot start with."""
    for path, node in robot.tree.nodes.items():
        prim = robot.bodies[path]
        is_moving = not robot.kinematic[path] and (node.joint is None or node.joint.kind != "fixed")
        if is_moving and not _has_mass(robot, path):
            raise stage.error(prim, "the body can move, but has neither mass nor colliders")
        for name in ("velocity", "angularVelocity"):
            if any(stage.value(prim, f"physics:{name}")):
                stage.drop("initial velocities were dropped", prim)
        if node.joint is not None and _authored(robot, node.joint)[2] > FRAME_TOLERANCE:
            stage.drop("in the authored poses the frames of joints do not meet; MuJoCo will join them", node.joint.prim)
    for geom in robot.geoms:
        if geom.shape.kind == "plane" and geom.body is not None and not robot.kinematic[geom.body]:
            raise stage.error(geom.prim, "a plane can only belong to the world or to a kinematic body")


def _has_mass(robot: _Robot, path: str) -> bool:
    """Return whether a body, or one that is welded below it, has mass."""
    welded = (node for node in robot.tree.children(path) if node.joint is not None and node.joint.kind == "fixed")
    return robot.inertials[path] is not None or any(_has_mass(robot, node.body) for node in welded)


def _authored(robot: _Robot, joint: Joint) -> tuple[Matrix, float, float]:
    world = tuple(np.eye(4) if body is None else robot.frames[body] for body in joint.bodies)
    return joint.authored((world[0], world[1]))


def _mjcf_root(stage: Stage, robot: _Robot) -> ET.Element:
    root = ET.Element("mujoco", model=stage.file.stem)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    option = ET.SubElement(root, "option")
    flags = _option(stage, option)
    meshes = MeshAssets(ET.SubElement(root, "asset"))
    world = ET.SubElement(root, "worldbody")
    elements: dict[str | None, ET.Element] = {None: world}
    _add_geoms(robot, None, world, meshes)
    for node in robot.tree.children(None):
        _add_body(robot, node, world, meshes, elements)
    contact = ET.SubElement(root, "contact")
    for pair in exclusions(stage, robot.joints, robot.geoms):
        first, second = sorted("world" if path is None else robot.names[0][path] for path in pair)
        ET.SubElement(contact, "exclude", body1=first, body2=second)
    if any(node.joint and node.parent and not node.joint.is_filtering for node in robot.tree.nodes.values()):
        # MuJoCo never collides a parent with its child; here it should, and who should not is listed above.
        flags["filterparent"] = "disable"
    if flags:
        ET.SubElement(option, "flag", flags)
    equality, actuator = ET.SubElement(root, "equality"), ET.SubElement(root, "actuator")
    for joint in robot.tree.loops:
        _add_loop_constraint(stage, robot, joint, elements, equality)
    motions = [(node, _authored(robot, node.joint) if node.joint else None) for node in _depth_first(robot.tree)]
    add_actuators_and_key(ET.SubElement(root, "keyframe"), actuator, motions, robot.frames, robot.kinematic, robot.names[2])
    for empty in [element for element in root if len(element) == 0 and not element.attrib]:
        root.remove(empty)
    return root


def _depth_first(tree: SpanningTree, parent: str | None = None) -> list[TreeNode]:
    """Return all nodes in MuJoCo's order."""
    return [node for child in tree.children(parent) for node in (child, *_depth_first(tree, child.body))]


def _option(stage: Stage, option: ET.Element) -> dict[str, str]:
    """Set gravity and the solver's settings as the first scene has them; return its flags."""
    scenes = [prim for prim in stage.prims if prim.IsA(stage.pxr.UsdPhysics.Scene)]
    for scene in scenes[1:]:
        stage.drop("physics scenes after the first one were dropped", scene)
    if not scenes:
        return {}
    option.attrib |= {"gravity": _gravity(stage, scenes[0]), **read_mjcf_attributes(stage, scenes[0], OPTION)}
    return read_option_flags(stage, scenes[0])


def _gravity(stage: Stage, scene: Prim) -> str:
    """Return gravity [m/s²]."""
    direction = np.array(stage.value(scene, "physics:gravityDirection"), dtype=np.float64)
    size = stage.number(scene, "physics:gravityMagnitude", -math.inf)
    size = GRAVITY if size < 0 else size * stage.metres_per_unit
    if not np.isfinite(direction).all() or not math.isfinite(size):
        raise stage.error(scene, "gravity is not finite")
    if not direction.any():
        return floats_text([0.0, 0.0, -size])
    return floats_text(stage.world_from_stage[:3, :3] @ direction / stage.metres_per_unit / np.linalg.norm(direction) * size)


def _add_body(
    robot: _Robot, node: TreeNode, parent: ET.Element, meshes: MeshAssets, elements: dict[str | None, ET.Element]
) -> None:
    pose = robot.frames[node.body] if node.joint is None else node.joint.pose(node.is_swapped)
    element = with_pose(ET.SubElement(parent, "body", name=robot.names[0][node.body]), pose)
    elements[node.body] = element
    if robot.kinematic[node.body]:
        element.set("mocap", "true")
    else:
        add_joint_element(element, node, robot.names[2], robot.free[node.body])
    if (inertial := robot.inertials[node.body]) is not None:
        moments, axes = inertial.principal()
        ET.SubElement(
            element,
            "inertial",
            pos=floats_text(inertial.centre),
            quat=floats_text(axes.as_quat(canonical=True, scalar_first=True)),
            mass=floats_text([inertial.mass]),
            diaginertia=floats_text(moments),
        )
    _add_geoms(robot, node.body, element, meshes)
    for child in robot.tree.children(node.body):
        _add_body(robot, child, element, meshes, elements)


def _add_geoms(robot: _Robot, body: str | None, element: ET.Element, meshes: MeshAssets) -> None:
    names, taken = robot.names[1], set(robot.names[1].values())
    written: set[str] = set()
    for geom in robot.geoms:
        if geom.body == body:
            name = names[geom.path]
            if geom.path in written:  # a visible mesh that collides as a box or ball: this is how it looks
                name = next(f"{name}_visual{i or ''}" for i in range(len(taken) + 1) if f"{name}_visual{i or ''}" not in taken)
                taken.add(name)
            written.add(geom.path)
            add_geom(element, name, geom, meshes)
    for site in robot.sites:
        if site.body == body:
            add_site(element, robot.names[3][str(site.prim.GetPath())], site)


def _add_loop_constraint(
    stage: Stage, robot: _Robot, joint: Joint, elements: Mapping[str | None, ET.Element], equality: ET.Element
) -> None:
    if all(body is None or robot.kinematic[body] for body in joint.bodies):
        stage.drop("joints between bodies that no force can move were dropped", joint.prim)
        return
    if joint.kind == "slide":
        raise stage.error(joint.prim, "a prismatic joint closes a loop, for which MuJoCo has no constraint")
    if joint.range or joint.drive or joint.armature or joint.friction:
        stage.drop("limits, drives, armature and friction of joints that close a loop were dropped", joint.prim)
    taken = {site.get("name", "") for element in elements.values() for site in element.iter("site")}
    ends = (elements[joint.bodies[0]], elements[joint.bodies[1]])
    add_loop_constraint(equality, ends, joint, robot.names[2][joint.path], taken)
