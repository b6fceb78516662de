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
- What `usd_export` notes in attributes `tgdsl:` is read back, in SI units and radians whatever those of the stage.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tgdsl.errors import RobotError
from tgdsl.files.write import atomic_write_all
from tgdsl.formats.usd.filters import exclusions
from tgdsl.formats.usd.geoms import Geom, Site, read_geoms, read_sites
from tgdsl.formats.usd.joints import MEETING, Joint, read_joints
from tgdsl.formats.usd.mass import Inertial, inertial_of
from tgdsl.formats.usd.notes import OPTION, read_flags, read_note, read_notes
from tgdsl.formats.usd.stage import Matrix, Prim, Stage, opened, unique_names
from tgdsl.formats.usd.tree import Link, Tree, spanning_tree
from tgdsl.formats.usd.xml import MeshAssets, add_geom, add_key, add_loop, add_motion, add_site, numbers, posed

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""Endings of USD files."""
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
        tree: Which body hangs on which.
        kinematic: Whether each body is kinematic.
        names: Name of each body, then of each geom, of each joint and of each site, by path.
        free: Name of each floating body's joint, or empty, by the body's path.
    """

    bodies: dict[str, Prim]
    frames: dict[str, Matrix]
    joints: list[Joint]
    geoms: list[Geom]
    sites: list[Site]
    inertials: dict[str, Inertial | None]
    tree: Tree
    kinematic: dict[str, bool]
    names: tuple[dict[str, str], dict[str, str], dict[str, str], dict[str, str]]
    free: dict[str, str]


def usd_to_mjcf(path: Path) -> str:
    """Return a UsdPhysics stage as one self-contained MJCF text, in SI with Z up.

    Raises:
        RobotError: If usd-core is missing, the file is not USD, something that it refers to is missing, or it holds
            something that MuJoCo cannot express.
    """
    with opened(path) as stage:
        robot = _read(stage)
        _check(stage, robot)
        return ET.tostring(_written(stage, robot), encoding="unicode")


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
    joints, geoms = read_joints(stage, owners, frames), read_geoms(stage, owners, frames)
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
    free = {path: str(read_note(stage, prim, "freejoint") or "") for path, prim in bodies.items()}
    return _Robot(bodies, frames, joints, geoms, sites, inertials, tree, kinematic, names, free)


def _check(stage: Stage, robot: _Robot) -> None:
    """Refuse what MuJoCo would refuse without naming the prim, and take note of what it cannot start with."""
    for path, link in robot.tree.links.items():
        prim = robot.bodies[path]
        is_moving = not robot.kinematic[path] and (link.joint is None or link.joint.kind != "fixed")
        if is_moving and not _has_mass(robot, path):
            raise stage.error(prim, "the body can move, but has neither mass nor colliders")
        for name in ("velocity", "angularVelocity"):
            if any(stage.value(prim, f"physics:{name}")):
                stage.drop("initial velocities were dropped", prim)
        if link.joint is not None and _authored(robot, link.joint)[2] > MEETING:
            stage.drop("in the authored poses the frames of joints do not meet; MuJoCo will join them", link.joint.prim)
    for geom in robot.geoms:
        if geom.shape.kind == "plane" and geom.body is not None and not robot.kinematic[geom.body]:
            raise stage.error(geom.prim, "a plane can only belong to the world or to a kinematic body")


def _has_mass(robot: _Robot, path: str) -> bool:
    """Return whether a body, or one that is welded below it, has mass."""
    welded = (link for link in robot.tree.children(path) if link.joint is not None and link.joint.kind == "fixed")
    return robot.inertials[path] is not None or any(_has_mass(robot, link.body) for link in welded)


def _authored(robot: _Robot, joint: Joint) -> tuple[Matrix, float, float]:
    world = tuple(np.eye(4) if body is None else robot.frames[body] for body in joint.bodies)
    return joint.authored((world[0], world[1]))


def _written(stage: Stage, robot: _Robot) -> ET.Element:
    root = ET.Element("mujoco", model=stage.file.stem)
    ET.SubElement(root, "compiler", angle="radian", autolimits="true")
    option = ET.SubElement(root, "option")
    flags = _option(stage, option)
    meshes = MeshAssets(ET.SubElement(root, "asset"))
    world = ET.SubElement(root, "worldbody")
    elements: dict[str | None, ET.Element] = {None: world}
    _add_geoms(robot, None, world, meshes)
    for link in robot.tree.children(None):
        _add_body(robot, link, world, meshes, elements)
    contact = ET.SubElement(root, "contact")
    for pair in exclusions(stage, robot.joints, robot.geoms):
        first, second = sorted("world" if path is None else robot.names[0][path] for path in pair)
        ET.SubElement(contact, "exclude", body1=first, body2=second)
    if any(link.joint and link.parent and not link.joint.is_filtering for link in robot.tree.links.values()):
        # MuJoCo never collides a parent with its child; here it should, and who should not is listed above.
        flags["filterparent"] = "disable"
    if flags:
        ET.SubElement(option, "flag", flags)
    equality, actuator = ET.SubElement(root, "equality"), ET.SubElement(root, "actuator")
    for joint in robot.tree.loops:
        _add_loop(stage, robot, joint, elements, equality)
    motions = [(link, _authored(robot, link.joint) if link.joint else None) for link in _depth_first(robot.tree)]
    add_key(ET.SubElement(root, "keyframe"), actuator, motions, robot.frames, robot.kinematic, robot.names[2])
    for empty in [element for element in root if len(element) == 0 and not element.attrib]:
        root.remove(empty)
    return root


def _depth_first(tree: Tree, parent: str | None = None) -> list[Link]:
    """Return all links in MuJoCo's order."""
    return [link for child in tree.children(parent) for link in (child, *_depth_first(tree, child.body))]


def _option(stage: Stage, option: ET.Element) -> dict[str, str]:
    """Set gravity and the solver's settings as the first scene has them; return its flags."""
    scenes = [prim for prim in stage.prims if prim.IsA(stage.pxr.UsdPhysics.Scene)]
    for scene in scenes[1:]:
        stage.drop("physics scenes after the first one were dropped", scene)
    if not scenes:
        return {}
    option.attrib |= {"gravity": _gravity(stage, scenes[0]), **read_notes(stage, scenes[0], OPTION)}
    return read_flags(stage, scenes[0])


def _gravity(stage: Stage, scene: Prim) -> str:
    """Return gravity [m/s²]."""
    direction = np.array(stage.value(scene, "physics:gravityDirection"), dtype=np.float64)
    size = stage.number(scene, "physics:gravityMagnitude", -math.inf)
    size = GRAVITY if size < 0 else size * stage.metres
    if not np.isfinite(direction).all() or not math.isfinite(size):
        raise stage.error(scene, "gravity is not finite")
    if not direction.any():
        return numbers([0.0, 0.0, -size])
    return numbers(stage.world[:3, :3] @ direction / stage.metres / np.linalg.norm(direction) * size)


def _add_body(
    robot: _Robot, link: Link, parent: ET.Element, meshes: MeshAssets, elements: dict[str | None, ET.Element]
) -> None:
    pose = robot.frames[link.body] if link.joint is None else link.joint.pose(link.is_swapped)
    element = posed(ET.SubElement(parent, "body", name=robot.names[0][link.body]), pose)
    elements[link.body] = element
    if robot.kinematic[link.body]:
        element.set("mocap", "true")
    else:
        add_motion(element, link, robot.names[2], robot.free[link.body])
    if (inertial := robot.inertials[link.body]) is not None:
        moments, axes = inertial.principal()
        ET.SubElement(
            element,
            "inertial",
            pos=numbers(inertial.centre),
            quat=numbers(axes.as_quat(canonical=True, scalar_first=True)),
            mass=numbers([inertial.mass]),
            diaginertia=numbers(moments),
        )
    _add_geoms(robot, link.body, element, meshes)
    for child in robot.tree.children(link.body):
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


def _add_loop(
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
    add_loop(equality, ends, joint, robot.names[2][joint.path], taken)


def write_mjcf(text: str, out: Path) -> None:
    """Write MJCF with its inline meshes as `.obj` files in the folder `<stem>_assets` beside it.

    Nothing half-written is left behind.

    Args:
        text: What `usd_to_mjcf` returns.
        out: The MJCF file. It is replaced if it is there, and so are meshes of the same names; other files are left alone.

    Raises:
        FileError: If it cannot be written.
    """
    root, out = ET.fromstring(text), Path(out)
    folder, contents = out.with_name(f"{out.stem}_assets"), {}
    names: list[str] = []
    for mesh in root.iterfind("asset/mesh[@vertex]"):
        name = _file_name(mesh.get("name", ""), names)
        contents[folder / name] = _wavefront(mesh.attrib.pop("vertex"), mesh.attrib.pop("face")).encode()
        mesh.set("file", name)
    if names:
        root.findall("compiler")[0].set("meshdir", folder.name)
    ET.indent(root)
    contents[out] = (ET.tostring(root, encoding="unicode") + "\n").encode()
    atomic_write_all(contents)


def _file_name(name: str, taken: list[str]) -> str:
    """Return a file name for a mesh, and take it; names that only differ in case are one on some file systems."""
    stem = re.sub(r"[^\w.-]", "_", name) or "mesh"
    file, number = f"{stem}.obj", 1
    while file.lower() in map(str.lower, taken):
        number += 1
        file = f"{stem}_{number}.obj"
    taken.append(file)
    return file


def _wavefront(vertices: str, faces: str) -> str:
    points, corners = vertices.split(), [int(index) + 1 for index in faces.split()]
    lines = [f"v {' '.join(points[i : i + 3])}" for i in range(0, len(points), 3)]
    lines += [f"f {' '.join(map(str, corners[i : i + 3]))}" for i in range(0, len(corners), 3)]
    return "\n".join([*lines, ""])
