"""USD in: a UsdPhysics stage becomes MJCF.

The semantics follow the UsdPhysics schemas, and MuJoCo's (`mjc:`) and Newton's (`newton:`) where they are authored; their
plugins need not be installed. Of several values the most specific counts: `tgdsl:`, `mjc:`, `newton:`, `physx…:`, UsdPhysics,
in this order; a contradiction causes a warning (`attributes.py`). Exception: a user's edits of a stage that `export` wrote.
There UsdPhysics' value of a drive, a friction or a mass overrules our exact copy of the old one.

Where MuJoCo leaves a choice:

- A body's frame is its prim's, without scale; its name is the end of the prim's path, or the custom attribute `tgdsl:name`.
- Position zero is where the frames of a joint meet, with `mjc:ref` the position `ref`. If the authored poses or the drives'
  targets differ from where the model starts, the keyframe `authored` has them. Limits are MuJoCo's positions.
- A drive becomes a `position` actuator, or a `velocity` actuator if it has no stiffness, named after its joint. A drive
  without gains exerts no force and becomes no actuator. `tgdsl:damping` is the joint's share of the drive's damping;
  `mjc:damping` and `newton:damping` add to it. A prim MjcActuator or NewtonActuator on the joint is the same actuator with
  more detail: it replaces the drive, with a warning if they contradict.
- Several joints between the same two bodies are degrees of freedom of one, where MjcJointAPI or `newton:jointsAddMobility` says
  that joints add mobility; else one holds the body and the others close loops.
- Sliding friction is a material's dynamic friction, or its static friction if only that is authored; MuJoCo takes the greater
  of two, and its own default where no material is bound. `newton:contactStiffness` and `contactDamping` are not read: they are
  a force per distance, MuJoCo's `solref` is per effective mass.
- A joint that closes a loop, or has MjcEqualityConnectAPI or MjcEqualityWeldAPI, becomes an equality constraint between sites;
  one that `export` wrote connects the original bodies again.
- A joint decides whether its parent and child collide; where it does not and the scene has MjcSceneAPI, MuJoCo's filter of
  parents (`mjc:flag:filterparent`) decides.
- `mjc:group` sets a geom's group; default: 0 for visible colliders, 3 for invisible ones, 2 for other visuals.
- Materials' looks, subdivision, holes of meshes and prims not drawn by default are skipped. Any other unread authored
  attribute causes a warning with its name and prim (`note_unread`).
- Custom attributes `tgdsl:` that `export` writes are read back, in SI units and radians whatever the stage's units.
"""

from __future__ import annotations

import hashlib
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from tgdsl.errors import RobotError
from tgdsl.formats.model import Model
from tgdsl.formats.usd.actuators import read_actuators, read_keyframes, read_tendons, servos_of
from tgdsl.formats.usd.articulation import SpanningTree, TreeNode, exclusions, filtered_pairs
from tgdsl.formats.usd.attributes import BODY, COMPILER, FLAG, FLAGS, OPTION, read_attributes, read_custom, text_of
from tgdsl.formats.usd.equalities import (
    ORDER,
    constraint_attributes,
    read_couplings,
    read_exact_constraint,
    read_polynomials,
)
from tgdsl.formats.usd.geoms import Gprim, Inertial, Site, inertial_of, read_gprims, read_sites
from tgdsl.formats.usd.joints import FRAME_TOLERANCE, Joint, read_joints
from tgdsl.formats.usd.shapes import Shape, quaternion
from tgdsl.formats.usd.stage import NAME_ATTRIBUTE, Matrix, Names, Prim, Stage, note_unread, open_stage, unique_names

AXIS_ARM = 0.05  # distance between the two connect constraints along the axis of a revolute joint that closes a loop [m]
REST_TOLERANCE = 1e-6  # largest authored position without a keyframe [rad or m]: it is rounding of float32
VISIBLE, VISUAL, HIDDEN = "0", "2", "3"  # groups: visible colliders; visuals that do not collide; invisible colliders
FRICTION = (1.0, 0.005, 0.0001)  # MuJoCo's default friction of a geom


def read_usd(path: Path) -> Model:
    """Read and compile a UsdPhysics stage.

    Raises:
        RobotError: As `usd_to_mjcf`.
        ValueError: If MuJoCo cannot compile it.
    """
    text = usd_to_mjcf(path)
    spec = mujoco.MjSpec.from_string(text)
    return Model(path, spec, spec.compile(), is_rounded=False, mjcf=text)


def usd_to_mjcf(path: Path) -> str:
    """Return a UsdPhysics stage as one self-contained MJCF text, in SI with Z up.

    Raises:
        RobotError: If usd-core is missing, the file is not USD, something that it refers to is missing, or it holds
            something that MuJoCo cannot express.
    """
    with open_stage(path) as stage:
        if not stage.bodies:
            raise RobotError(f"{stage.file}: /: no prim has an enabled PhysicsRigidBodyAPI: there is no robot in it")
        robot = _read(stage)
        _check(robot)
        root = _Mjcf(robot).root
        note_unread(stage)
        return ET.tostring(root, encoding="unicode")


@dataclass(frozen=True, eq=False)
class _Robot:
    """What a stage holds: joints, geoms, sites, mass and inertia of each body that has one, tree, and names in MJCF."""

    stage: Stage
    joints: list[Joint]
    geoms: list[Gprim]
    sites: list[Site]
    inertials: dict[str, Inertial | None]
    tree: SpanningTree
    names: Names


def _read(stage: Stage) -> _Robot:
    joints, geoms, sites = read_joints(stage), read_gprims(stage), read_sites(stage)
    inertials = {
        path: inertial_of(stage, prim, [geom for geom in geoms if geom.body == path]) for path, prim in stage.bodies.items()
    }
    tree = SpanningTree(stage, joints)
    kinds = {joint.path: joint.kind for node in tree.nodes.values() for joint in node.joints}
    bodies = unique_names(stage, stage.bodies.values(), ["world"])
    geom_names = unique_names(stage, {geom.path: geom.prim for geom in geoms}.values())
    joint_names = unique_names(stage, [joint.prim for joint in joints])
    names = Names(
        bodies=bodies,
        geoms=geom_names,
        sites=unique_names(stage, [site.prim for site in sites]),
        joints=joint_names,
        moving={path: name for path, name in joint_names.items() if kinds.get(path, "fixed") != "fixed"},
        scalars={path: joint_names[path] for path, kind in kinds.items() if kind in ("hinge", "slide")},
    )
    return _Robot(stage, joints, geoms, sites, inertials, tree, names)


def _check(robot: _Robot) -> None:
    """Refuse what MuJoCo would refuse without naming the prim, and take note of what it cannot start with."""
    stage = robot.stage
    for path, node in robot.tree.nodes.items():
        prim = stage.bodies[path]
        is_moving = not stage.kinematic[path] and (node.joint is None or node.joint.kind != "fixed")
        if is_moving and not _has_mass(robot, path):
            raise stage.error(prim, "the body can move, but has neither mass nor colliders")
        for name in ("velocity", "angularVelocity"):
            if any(stage.value(prim, f"physics:{name}")):
                stage.drop("initial velocities were dropped", prim)
        poses = [joint.pose(node.is_swapped(joint)) for joint in node.joints]
        is_apart = any(np.abs(pose - poses[0]).max() > FRAME_TOLERANCE for pose in poses)
        if node.joint is not None and (is_apart or node.joint.authored(stage)[2] > FRAME_TOLERANCE):
            stage.drop("in the authored poses the frames of joints do not meet; MuJoCo will join them", node.joint.prim)
    for geom in robot.geoms:
        if geom.shape.kind == "plane" and geom.body is not None and not stage.kinematic[geom.body]:
            raise stage.error(geom.prim, "a plane can only belong to the world or to a kinematic body")


def _has_mass(robot: _Robot, path: str) -> bool:
    welded = (node for node in robot.tree.children(path) if node.joint is not None and node.joint.kind == "fixed")
    return robot.inertials[path] is not None or any(_has_mass(robot, node.body) for node in welded)


class _Mjcf:
    """The MJCF of a robot."""

    def __init__(self, robot: _Robot):
        stage = self._stage = robot.stage
        self._robot, self._names = robot, robot.names
        first = stage.usd.GetDefaultPrim()
        name = stage.authored(first, NAME_ATTRIBUTE) if first else None
        self.root = ET.Element("mujoco", model=str(name or stage.file.stem))
        compiler = ET.SubElement(self.root, "compiler", angle="radian", autolimits="true")
        option = ET.SubElement(self.root, "option")
        flags = add_scene(stage, option, compiler)
        self._asset = ET.SubElement(self.root, "asset")
        self._mesh_names: dict[str, str] = {}
        self._elements: dict[str | None, ET.Element] = {None: ET.SubElement(self.root, "worldbody")}
        self._add_geoms(None)
        for node in robot.tree.children(None):
            self._add_body(node)
        flags |= self._add_exclusions(ET.SubElement(self.root, "contact"), flags)
        if flags:
            ET.SubElement(option, "flag", flags)
        self._equality, tendon, actuator, keyframe = (
            ET.SubElement(self.root, part) for part in ("equality", "tendon", "actuator", "keyframe")
        )
        for joint in robot.tree.loops:
            self._add_loop_constraint(joint)
        read_couplings(stage, self._equality, robot.joints, self._names.scalars)
        read_tendons(stage, tendon, self._names)
        read_polynomials(stage, self._equality, self._names)
        # As `export` found them; the others come after.
        self._equality[:] = sorted(self._equality, key=lambda element: float(element.attrib.pop(ORDER, math.inf)))
        self._add_actuators(actuator, keyframe)
        read_keyframes(stage, self.root, keyframe)
        for empty in [element for element in self.root if len(element) == 0 and not element.attrib]:
            self.root.remove(empty)

    def _add_body(self, node: TreeNode) -> None:
        stage, path = self._stage, node.body
        pose = stage.body_frames[path] if node.joint is None else node.joint.pose(node.is_swapped(node.joint))
        attributes = {"name": self._names.bodies[path]} | read_attributes(stage, stage.bodies[path], BODY)
        element = ET.SubElement(self._elements[node.parent], "body", attributes | _pose(pose))
        self._elements[path] = element
        if stage.kinematic[path]:
            element.set("mocap", "true")
        else:
            self._add_joints(element, node)
        if (inertial := self._robot.inertials[path]) is not None:
            moments, axes = inertial.principal()
            ET.SubElement(
                element,
                "inertial",
                pos=text_of(inertial.centre),
                quat=text_of(axes.as_quat(canonical=True, scalar_first=True)),
                mass=text_of([inertial.mass]),
                diaginertia=text_of(moments),
            )
        self._add_geoms(path)
        for child in self._robot.tree.children(path):
            self._add_body(child)

    def _add_joints(self, body: ET.Element, node: TreeNode) -> None:
        """Add a body's joints to its parent: none if it is fixed, a free joint if it floats."""
        if node.joint is None:
            free = str(read_custom(self._stage, self._stage.bodies[node.body], "freejoint") or "")
            ET.SubElement(body, "freejoint", {"name": free} if free else {})
        for joint in node.joints:
            if joint.kind == "fixed":
                continue
            frame = joint.frames[0 if node.is_swapped(joint) else 1]
            attributes = {"name": self._names.joints[joint.path], "type": joint.kind, "pos": text_of(frame[:3, 3])}
            if joint.kind != "ball":
                # Positions count body 1 against body 0; where body 0 is the child, it turns the other way.
                attributes["axis"] = text_of(frame[:3, :3] @ joint.axis * (-1 if node.is_swapped(joint) else 1))
            if joint.range is not None:
                attributes["range"] = text_of(joint.range)
            ET.SubElement(body, "joint", attributes | joint.mjcf_attributes)

    def _add_geoms(self, body: str | None) -> None:
        """Add the geoms and sites of a body, or of the world."""
        element, taken, written = self._elements[body], set(self._names.geoms.values()), set[str]()
        for geom in (geom for geom in self._robot.geoms if geom.body == body):
            name = self._names.geoms[geom.path]
            if geom.path in written:  # a visible mesh that collides as a box or ball: this is how it looks
                name = next(f"{name}_visual{i or ''}" for i in range(len(taken) + 1) if f"{name}_visual{i or ''}" not in taken)
                taken.add(name)
            written.add(geom.path)
            self._add_geom(element, name, geom)
        for site in (site for site in self._robot.sites if site.body == body):
            name = self._names.sites[str(site.prim.GetPath())]
            ET.SubElement(element, "site", {"name": name} | site.mjcf_attributes | _pose(site.pose))

    def _add_geom(self, body: ET.Element, name: str, geom: Gprim) -> None:
        element = ET.SubElement(body, "geom", {"name": name, "type": geom.shape.kind} | _pose(geom.shape.pose))
        if geom.shape.kind == "mesh":
            element.set("mesh", self._mesh(geom.shape, name, geom.mesh))
        else:
            element.set("size", text_of(geom.shape.size))
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
            element.set("rgba", text_of(geom.color))

    def _mesh(self, shape: Shape, name: str, attributes: Mapping[str, str]) -> str:
        """Return the name of a shape's mesh, which is added if it is new: under its custom name, or else the given one."""
        assert shape.vertices is not None and shape.faces is not None
        vertices = np.ascontiguousarray(shape.vertices + 0.0, dtype=np.float32)
        faces = np.ascontiguousarray(shape.faces, dtype=np.int64)
        content = vertices.tobytes() + b"|" + faces.tobytes() + repr(sorted(attributes.items())).encode()
        key, names = hashlib.sha256(content).hexdigest(), self._mesh_names
        if key not in names:
            candidates = (attributes.get("name", name), name, *(f"{name}_{i + 2}" for i in range(len(names))))
            names[key] = next(unique for unique in candidates if unique not in names.values())
            # Masses are given with the bodies; a shell is what MuJoCo never finds wrong with a mesh that is open or flat.
            mesh = ET.SubElement(self._asset, "mesh", {"inertia": "shell", **attributes, "name": names[key]})
            mesh.set("vertex", " ".join(map(str, vertices.reshape(-1))))
            mesh.set("face", " ".join(map(str, faces.reshape(-1).tolist())))
        return names[key]

    def _add_exclusions(self, contact: ET.Element, flags: Mapping[str, str]) -> dict[str, str]:
        """Add the pairs of bodies that do not collide; return the flags that this needs."""
        robot = self._robot
        nodes, (welded, parents) = robot.tree.nodes, filtered_pairs(robot.tree)
        is_on = flags.get("filterparent") != "disable"
        filtering = {pair: joint.is_filtering for pair, child in parents.items() if (joint := nodes[child].joint) is not None}
        is_off = is_on and False in filtering.values()
        silent = [pair for pair, said in filtering.items() if said is None] if is_off else ()
        by_itself = welded | parents.keys() if is_on and not is_off else welded
        for pair in exclusions(self._stage, robot.joints, robot.geoms, silent):
            if pair not in by_itself:
                first, second = sorted("world" if path is None else self._names.bodies[path] for path in pair)
                ET.SubElement(contact, "exclude", body1=first, body2=second)
        return {"filterparent": "disable"} if is_off else {}

    def _add_loop_constraint(self, joint: Joint) -> None:
        """Add the equality constraint of a joint that closes a loop: position zero of the model need not close it."""
        stage, robot = self._stage, self._robot
        if joint.constraint:
            sites = {str(site.prim.GetPath()): site.pose for site in robot.sites}
            if read_exact_constraint(stage, self._equality, joint, self._names, sites):
                return
        if all(body is None or stage.kinematic[body] for body in joint.bodies):
            stage.drop("joints between bodies that no force can move were dropped", joint.prim)
            return
        if joint.kind == "slide" and not joint.constraint:
            raise stage.error(joint.prim, "a prismatic joint closes a loop, for which MuJoCo has no constraint")
        if not joint.is_passive:
            stage.drop("limits, drives, armature and friction of joints that close a loop were dropped", joint.prim)
        name, attributes = self._names.joints[joint.path], constraint_attributes(stage, joint) if joint.constraint else {}
        taken = {site.get("name", "") for site in self._elements[None].iter("site")}
        is_hinge = joint.kind == "hinge" and not joint.constraint
        tag = "weld" if (joint.constraint or joint.kind) in ("MjcEqualityWeldAPI", "fixed") else "connect"
        for end in range(2 if is_hinge else 1):
            ends = {"name": f"{name}_{end}" if is_hinge else name}
            for side in (0, 1):
                site = f"{name}_{end}{side}"
                while site in taken:
                    site += "_"
                place = joint.frames[side].copy()
                place[:3, 3] += place[:3, :3] @ joint.axis * AXIS_ARM * end
                body = self._elements[joint.bodies[side]]
                ET.SubElement(body, "site", {"name": site, "size": "0.001", "group": "4"} | _pose(place))
                ends[f"site{side + 1}"] = site
            ET.SubElement(self._equality, tag, ends | attributes)

    def _add_actuators(self, actuator: ET.Element, keyframe: ET.Element) -> None:
        """Add all actuators, and the keyframe `authored` if the authored poses or the drives' targets are no defaults."""
        nodes = list(self._robot.tree.nodes.values())
        prims = read_actuators(self._stage, self._names)
        servos = servos_of(self._stage, [joint for node in nodes for joint in node.joints], prims, self._names)
        actuators = sorted((*prims, *servos), key=lambda element: element.order)
        for element in actuators:
            ET.SubElement(actuator, element.kind, element.attributes)
        ctrl = [element.control for element in actuators]
        qpos, is_needed = self._authored_qpos(nodes)
        if is_needed or any(ctrl):
            key = ET.SubElement(keyframe, "key", name="authored", qpos=text_of(qpos))
            if ctrl:
                key.set("ctrl", text_of(ctrl))

    def _authored_qpos(self, nodes: list[TreeNode]) -> tuple[list[float], bool]:
        """Return `qpos` in the authored poses, and whether any joint is not at position zero."""
        qpos: list[float] = []
        is_needed = False
        for node in nodes:
            joint = node.joint
            if joint is None:
                if not self._stage.kinematic[node.body]:
                    frame = self._stage.body_frames[node.body]
                    qpos += [*frame[:3, 3], *quaternion(frame)]
                continue
            apart, position, _ = joint.authored(self._stage)
            if node.stacked:
                for stacked in node.joints:
                    qpos += [1.0, 0.0, 0.0, 0.0] if stacked.kind == "ball" else [stacked.reference]
            elif joint.kind in ("hinge", "slide"):
                qpos.append(position + joint.reference)
                is_needed |= abs(position) > REST_TOLERANCE
            elif joint.kind == "ball":  # MuJoCo counts it in the child's axes at position zero
                frame = joint.frames[0 if node.is_swapped(joint) else 1][:3, :3]
                turn = quaternion(frame @ (apart[:3, :3].T if node.is_swapped(joint) else apart[:3, :3]) @ frame.T)
                qpos += [*turn]
                is_needed |= bool(np.abs(turn[1:]).max() > REST_TOLERANCE)
        return qpos, is_needed


def _pose(pose: Matrix) -> dict[str, str]:
    return {"pos": text_of(pose[:3, 3]), "quat": text_of(quaternion(pose))}


def _friction(geom: Gprim) -> str | None:
    """Return a geom's frictions: sliding from its material, torsional and rolling from `tgdsl:friction`, or its material."""
    custom = [float(value) for value in geom.mjcf_attributes.get("friction", "").split()]
    sliding, *rest = geom.friction
    if not custom and geom.friction == (None, None, None):
        return None
    values = [sliding if sliding is not None else (custom or FRICTION)[0]]
    for number, other in enumerate(rest, start=1):
        values.append(custom[number] if len(custom) > number else FRICTION[number] if other is None else other)
    return text_of(values)


GRAVITY = 9.81  # what a stage's scene means by earth gravity [m/s²]
NEWTON_TIMESTEP = 0.001  # NewtonSceneAPI's default [s]


def add_scene(stage: Stage, option: ET.Element, compiler: ET.Element) -> dict[str, str]:
    """Set gravity and the solver's settings as the first scene has them; return its flags."""
    for scene in stage.scenes[1:]:
        stage.drop("physics scenes after the first one were dropped", scene)
    if not stage.scenes:
        return {}
    scene = stage.scenes[0]
    option.attrib |= {"gravity": _gravity(stage, scene), **read_attributes(stage, scene, OPTION)}
    if "timestep" not in option.attrib and "NewtonSceneAPI" in scene.GetPrimTypeInfo().GetAppliedAPISchemas():
        option.set("timestep", text_of(NEWTON_TIMESTEP))
    compiler.attrib |= read_attributes(stage, scene, COMPILER)
    if stage.compiler("inertiaFromGeom") == "true":
        stage.drop("mjc:compiler:inertiaFromGeom is true; masses come from bodies and colliders", scene)
    ends = [stage.compiler(f"inertiaGroupRange:{end}") for end in ("min", "max")]
    if (ends[0] or 0) > 0 or (ends[1] is not None and ends[1] < 5):
        stage.drop("mjc:compiler:inertiaGroupRange was dropped: all colliders have a mass, in whatever group", scene)
    stage.note(scene, "mjc:compiler:angle", "mjc:compiler:autoLimits")  # read where they matter
    flags = {str(name): key for key in FLAGS for name in read_custom(stage, scene, key) or ()}
    for name, value in read_attributes(stage, scene, FLAG).items():
        said = "enable" if value == "true" else "disable"
        if flags.setdefault(name, said) != said:
            stage.drop(f"mjc:flag:{name} was dropped, which contradicts tgdsl:{flags[name]}", scene)
    return flags


def _gravity(stage: Stage, scene: Prim) -> str:
    """Return gravity [m/s²]."""
    direction = np.array(stage.value(scene, "physics:gravityDirection"), dtype=np.float64)
    size = stage.number(scene, "physics:gravityMagnitude", -math.inf)
    size = GRAVITY if size < 0 else size * stage.metres_per_unit
    if not np.isfinite(direction).all() or not math.isfinite(size):
        raise stage.error(scene, "gravity is not finite")
    if not direction.any():
        return text_of([0.0, 0.0, -size])
    world = stage.world_from_stage[:3, :3] @ direction / stage.metres_per_unit / np.linalg.norm(direction) * size
    return text_of((world + 0.0).tolist())
