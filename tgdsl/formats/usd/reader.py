"""USD in: a UsdPhysics stage becomes MJCF.

The semantics are those of the UsdPhysics schemas; of MuJoCo's own (`mjc:`) and Newton's (`newton:`) where they are authored,
whose plugins need not be installed. Where several say the same, the most specific counts: `tgdsl:`, `mjc:`, `newton:`,
`physx…:`, UsdPhysics, in this order; who contradicts it is warned of (`mjc/attributes.py`). Exceptions are what a user edits in
a stage that `export` wrote: UsdPhysics' value of a drive, a friction or a mass overrules our exact copy of the old one.

Where MuJoCo leaves a choice:

- A body's frame is its prim's, without scale; its name is the end of the prim's path, or the custom attribute `tgdsl:name`.
- Position zero is where the frames of a joint meet, with `mjc:ref` the position `ref`. If the authored poses or the drives'
  targets differ from where the model starts, the keyframe `authored` has them. Limits are MuJoCo's positions.
- A drive becomes a `position` actuator, or a `velocity` actuator if it has no stiffness, named after its joint. A drive
  without gains exerts no force and gives none. What `tgdsl:damping` says is the joint's own is taken off the drive's;
  `mjc:damping` and `newton:damping` are beside it. A prim MjcActuator or NewtonActuator on the joint is that same actuator,
  said more exactly: the drive is left out, with a warning if it contradicts.
- Several joints between the same two bodies are degrees of freedom of one, where MjcJointAPI or `newton:jointsAddMobility` says
  that joints add mobility; else all but one close a loop.
- Sliding friction is a material's dynamic friction, or its static friction if only that is authored; MuJoCo takes the greater
  of two, and its own default where no material is bound. `newton:contactStiffness` and `contactDamping` are not read: they are
  a force per distance, MuJoCo's `solref` is per effective mass.
- A joint that closes a loop, or has MjcEqualityConnectAPI or MjcEqualityWeldAPI, becomes an equality constraint between sites;
  one that `export` wrote is again between the bodies that it had.
- Whether a parent and its child collide is what their joint says; where it says nothing and the scene has MjcSceneAPI,
  MuJoCo's own filter of parents (`mjc:flag:filterparent`) decides.
- Colliders are in group 0 if they are visible and in group 3 if not, other visuals in group 2; or as `mjc:group` says.
- Materials' looks, subdivision, holes of meshes and what is not drawn by default are left out. Whatever else is authored and
  nobody has read is warned of, by attribute and prim (`audit.py`).
- Custom attributes `tgdsl:` that `export` writes are read back, in SI units and radians whatever those of the stage.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import RobotError
from tgdsl.formats.model import Model
from tgdsl.formats.usd.articulation import SpanningTree, TreeNode, filtered_pairs, spanning_tree
from tgdsl.formats.usd.audit import note_unread
from tgdsl.formats.usd.custom_attributes import read_custom
from tgdsl.formats.usd.elements import (
    MeshAssets,
    add_actuators_and_key,
    add_geom,
    add_joint_element,
    add_loop_constraint,
    add_site,
    floats_text,
    own_drives,
    with_pose,
)
from tgdsl.formats.usd.filters import exclusions
from tgdsl.formats.usd.geoms import Gprim, Site, read_gprims, read_sites
from tgdsl.formats.usd.joints import FRAME_TOLERANCE, Joint, read_joints
from tgdsl.formats.usd.mass import Inertial, inertial_of
from tgdsl.formats.usd.mjc.actuators import Named, read_actuators
from tgdsl.formats.usd.mjc.attributes import BODY, EQUALITY, WELD, read_attributes
from tgdsl.formats.usd.mjc.equalities import add_couplings, add_exact_constraint, add_polynomials, put_in_order
from tgdsl.formats.usd.mjc.keyframes import add_keyframes
from tgdsl.formats.usd.mjc.tendons import add_tendons
from tgdsl.formats.usd.scene import add_scene
from tgdsl.formats.usd.stage import NAME_ATTRIBUTE, Matrix, Prim, Stage, open_stage, unique_names


@dataclass(frozen=True, eq=False)
class _Robot:
    """All that a stage holds.

    Attributes:
        bodies: Prims of the rigid bodies, by path.
        owners: For the path of each prim, that of the rigid body which it moves with; None is the world.
        frames: Their world poses [m].
        joints: All joints.
        geoms: All geoms.
        sites: All sites.
        inertials: Mass and inertia of each body that has one.
        tree: Parent and joint of each body.
        kinematic: Whether each body is kinematic.
        body_attributes: Attributes of each MJCF body.
        names: Name of each body, then of each geom, of each joint and of each site, by path.
        free: Name of each floating body's joint, or empty, by the body's path.
    """

    bodies: dict[str, Prim]
    owners: dict[str, str | None]
    frames: dict[str, Matrix]
    joints: list[Joint]
    geoms: list[Gprim]
    sites: list[Site]
    inertials: dict[str, Inertial | None]
    tree: SpanningTree
    kinematic: dict[str, bool]
    body_attributes: dict[str, dict[str, str]]
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
        root = _mjcf_root(stage, robot)
        note_unread(stage, robot.owners)
        return ET.tostring(root, encoding="unicode")


def _read(stage: Stage) -> _Robot:
    bodies = {
        str(prim.GetPath()): prim
        for prim in stage.prims
        if stage.has(prim, "PhysicsRigidBodyAPI") and stage.value(prim, "physics:rigidBodyEnabled")
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
    attributes = {path: read_attributes(stage, prim, BODY) for path, prim in bodies.items()}
    roots = [str(prim.GetPath()) for prim in stage.prims if stage.has(prim, "PhysicsArticulationRootAPI")]
    names = (
        unique_names(stage, bodies.values(), ["world"]),
        unique_names(stage, {geom.path: geom.prim for geom in geoms}.values()),
        unique_names(stage, [joint.prim for joint in joints]),
        unique_names(stage, [site.prim for site in sites]),
    )
    tree = spanning_tree(kinematic, joints, roots)
    free = {path: str(read_custom(stage, prim, "freejoint") or "") for path, prim in bodies.items()}
    return _Robot(bodies, owners, frames, joints, geoms, sites, inertials, tree, kinematic, attributes, names, free)


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
        poses = [joint.pose(node.is_swapped(joint)) for joint in node.joints]
        is_apart = any(np.abs(pose - poses[0]).max() > FRAME_TOLERANCE for pose in poses)
        if node.joint is not None and (is_apart or _authored(robot, node.joint)[2] > FRAME_TOLERANCE):
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
    first = stage.usd.GetDefaultPrim()
    name = stage.authored(first, NAME_ATTRIBUTE) if first else None
    root = ET.Element("mujoco", model=str(name or stage.file.stem))
    compiler = ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    option = ET.SubElement(root, "option")
    flags = add_scene(stage, option, compiler)
    meshes = MeshAssets(ET.SubElement(root, "asset"))
    world = ET.SubElement(root, "worldbody")
    elements: dict[str | None, ET.Element] = {None: world}
    _add_geoms(robot, None, world, meshes)
    for node in robot.tree.children(None):
        _add_body(robot, node, world, meshes, elements)
    flags |= _add_exclusions(stage, robot, ET.SubElement(root, "contact"), flags)
    if flags:
        ET.SubElement(option, "flag", flags)
    parts = ("equality", "tendon", "actuator", "keyframe")
    equality, tendon, actuator, keyframe = (ET.SubElement(root, part) for part in parts)
    for joint in robot.tree.loops:
        _add_loop_constraint(stage, robot, joint, elements, equality)
    named = _named(robot)
    add_couplings(stage, equality, robot.joints, _scalars(robot))
    named = replace(named, tendons=add_tendons(stage, tendon, replace(named, joints=_scalars(robot))))
    add_polynomials(stage, equality, {"joint": _scalars(robot), "tendon": named.tendons})
    put_in_order(equality)
    nodes = list(robot.tree.nodes.values())
    motions = [(node, _authored(robot, node.joint) if node.joint else None) for node in nodes]
    others = read_actuators(stage, named)
    driven = own_drives(stage, [joint for node in nodes for joint in node.joints], others)
    add_actuators_and_key(keyframe, actuator, motions, robot.frames, robot.kinematic, robot.names[2], driven, others)
    add_keyframes(stage, root, keyframe)
    for empty in [element for element in root if len(element) == 0 and not element.attrib]:
        root.remove(empty)
    return root


def _named(robot: _Robot) -> Named:
    joints = {joint.path for node in robot.tree.nodes.values() for joint in node.joints if joint.kind != "fixed"}
    chosen = {path: name for path, name in robot.names[2].items() if path in joints}
    return Named(chosen, robot.names[0], robot.names[3], robot.names[1], {})


def _scalars(robot: _Robot) -> dict[str, str]:
    """Return the names of the hinges and slides of the tree."""
    joints = [joint for node in robot.tree.nodes.values() for joint in node.joints]
    return {joint.path: robot.names[2][joint.path] for joint in joints if joint.kind in ("hinge", "slide")}


def _add_exclusions(stage: Stage, robot: _Robot, contact: ET.Element, flags: Mapping[str, str]) -> dict[str, str]:
    """Add the pairs of bodies that do not collide; return the flags that this needs.

    MuJoCo never collides a parent with its child. Where a joint says that they do, its filter is off, and all that it would
    have kept apart is listed. What it never collides by itself is not.
    """
    nodes, (welded, parents) = robot.tree.nodes, filtered_pairs(robot.tree)
    is_on = flags.get("filterparent") != "disable"
    filtering = {pair: joint.is_filtering for pair, child in parents.items() if (joint := nodes[child].joint) is not None}
    is_off = is_on and False in filtering.values()
    silent = [pair for pair, said in filtering.items() if said is None] if is_off else ()
    by_itself = welded | parents.keys() if is_on and not is_off else welded
    for pair in exclusions(stage, robot.bodies, robot.joints, robot.geoms, silent):
        if pair not in by_itself:
            first, second = sorted("world" if path is None else robot.names[0][path] for path in pair)
            ET.SubElement(contact, "exclude", body1=first, body2=second)
    return {"filterparent": "disable"} if is_off else {}


def _add_body(
    robot: _Robot, node: TreeNode, parent: ET.Element, meshes: MeshAssets, elements: dict[str | None, ET.Element]
) -> None:
    pose = robot.frames[node.body] if node.joint is None else node.joint.pose(node.is_swapped(node.joint))
    attributes = {"name": robot.names[0][node.body]} | robot.body_attributes[node.body]
    element = with_pose(ET.SubElement(parent, "body", attributes), pose)
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
    if joint.constraint:
        sites = {str(site.prim.GetPath()): (robot.names[3][str(site.prim.GetPath())], site.pose) for site in robot.sites}
        if add_exact_constraint(stage, equality, joint, robot.names[0], sites, robot.names[2][joint.path]):
            return
    if all(body is None or robot.kinematic[body] for body in joint.bodies):
        stage.drop("joints between bodies that no force can move were dropped", joint.prim)
        return
    if joint.kind == "slide" and not joint.constraint:
        raise stage.error(joint.prim, "a prismatic joint closes a loop, for which MuJoCo has no constraint")
    if not joint.is_passive:
        stage.drop("limits, drives, armature and friction of joints that close a loop were dropped", joint.prim)
    taken = {site.get("name", "") for element in elements.values() for site in element.iter("site")}
    attributes = {}
    if joint.constraint:
        attributes = read_attributes(stage, joint.prim, WELD if joint.constraint.startswith("MjcEqualityWeld") else EQUALITY)
        attributes |= {} if joint.is_active else {"active": "false"}
    ends = (elements[joint.bodies[0]], elements[joint.bodies[1]])
    add_loop_constraint(equality, ends, joint, robot.names[2][joint.path], attributes, taken)
