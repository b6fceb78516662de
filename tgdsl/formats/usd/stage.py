"""An opened USD stage: composition errors, units and up-axis, transforms in metres with Z up, names, dropped elements."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from tgdsl.errors import RobotError, listed

Prim = Any  # a `pxr.Usd.Prim`: usd-core has no type stubs, and is only there if it is installed
Matrix = Float[np.ndarray, "4 4"]  # a homogeneous transform of column vectors
SHEAR = 1e-5  # cosine between the axes of a prim from which on it counts as sheared: transforms are often authored in float32
IMPLIED = {
    "MjcSceneAPI": ("NewtonSceneAPI",),
    "MjcSiteAPI": ("NewtonSiteAPI",),
    "MjcCollisionAPI": ("NewtonCollisionAPI",),
    "MjcMeshCollisionAPI": ("NewtonMeshCollisionAPI",),
    "MjcJointAPI": ("NewtonJointAPI",),
    "MjcMaterialAPI": ("NewtonMaterialAPI",),
    "MjcEqualityJointAPI": ("NewtonMimicAPI",),
    "NewtonMeshCollisionAPI": ("NewtonCollisionAPI", "PhysicsMeshCollisionAPI"),
    "NewtonCollisionAPI": ("PhysicsCollisionAPI",),
    "NewtonArticulationRootAPI": ("PhysicsArticulationRootAPI",),
    "NewtonMassAPI": ("PhysicsMassAPI",),
    "NewtonMaterialAPI": ("PhysicsMaterialAPI",),
}
"""Built-in API schemas of each schema (MjcPhysics of mujoco-usd-converter 0.8, newton-usd-schemas 0.6); usd-core knows them
only with the schema's plugin."""
IMPLIED_PHYSICS = frozenset(name for names in IMPLIED.values() for name in names if name.startswith("Physics"))
NAMESPACE = "tgdsl:"  # namespace of the custom attributes that hold MJCF's values
NAME_ATTRIBUTE = f"{NAMESPACE}name"  # a custom string attribute of a prim: the name that it has in MJCF


def usd_modules() -> Any:
    """Return usd-core's modules by their names; only this function imports them."""
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdUtils, Vt
    except ImportError as error:
        raise RobotError("USD files need usd-core, which is not installed: pip install usd-core") from error
    return SimpleNamespace(
        Gf=Gf, Sdf=Sdf, Tf=Tf, Usd=Usd, UsdGeom=UsdGeom, UsdPhysics=UsdPhysics, UsdShade=UsdShade, UsdUtils=UsdUtils, Vt=Vt
    )


@dataclass(frozen=True, eq=False)
class Stage:
    """A composed stage."""

    file: Path  # the file that it came from
    usd: Any  # the `pxr.Usd.Stage`
    pxr: Any  # the modules of usd-core
    dropped: dict[str, list[str]] = field(default_factory=dict)  # paths of prims by message about a dropped part, in order
    read: set[tuple[str, str]] = field(default_factory=set)  # paths of prims and names of properties that were read

    @cached_property
    def metres_per_unit(self) -> float:
        """Length of the stage's unit [m]."""
        return float(self.pxr.UsdGeom.GetStageMetersPerUnit(self.usd))

    @cached_property
    def kilograms_per_unit(self) -> float:
        """Mass of the stage's unit [kg]."""
        return float(self.pxr.UsdPhysics.GetStageKilogramsPerUnit(self.usd))

    @cached_property
    def bodies(self) -> dict[str, Prim]:
        prims = {str(prim.GetPath()): prim for prim in self.prims if self.has(prim, "PhysicsRigidBodyAPI")}
        return {path: prim for path, prim in prims.items() if self.value(prim, "physics:rigidBodyEnabled")}

    @cached_property
    def owners(self) -> dict[str, str | None]:
        """Path of the rigid body that each prim moves with, by the prim's path; None is the world."""
        owners: dict[str, str | None] = {"/": None}
        for prim in self.prims:
            path = str(prim.GetPath())
            owners[path] = path if path in self.bodies else owners[path.rpartition("/")[0] or "/"]
        return owners

    @cached_property
    def kinematic(self) -> dict[str, bool]:
        return {path: bool(self.value(prim, "physics:kinematicEnabled")) for path, prim in self.bodies.items()}

    @cached_property
    def body_frames(self) -> dict[str, Matrix]:
        """World poses of the bodies [m]."""
        return {path: self.frame(prim)[0] for path, prim in self.bodies.items()}

    def in_body(self, pose: Matrix, body: str | None) -> Matrix:
        return pose if body is None else np.linalg.inv(self.body_frames[body]) @ pose

    @cached_property
    def _schemas(self) -> dict[str, frozenset[str]]:
        return {}

    @cached_property
    def scenes(self) -> tuple[Prim, ...]:
        return tuple(prim for prim in self.prims if prim.IsA(self.pxr.UsdPhysics.Scene))

    def compiler(self, name: str) -> Any:
        """Return a setting of MuJoCo's compiler, or None if no scene has it."""
        return self.authored(self.scenes[0], f"mjc:compiler:{name}") if self.scenes else None

    @cached_property
    def mobility_roots(self) -> tuple[str, ...]:
        return tuple(str(prim.GetPath()) for prim in self.prims if self.authored(prim, "newton:jointsAddMobility"))

    @cached_property
    def prims(self) -> tuple[Prim, ...]:
        usd = self.pxr.Usd
        return tuple(usd.PrimRange(self.usd.GetPseudoRoot(), usd.TraverseInstanceProxies()))[1:]

    @cached_property
    def world_from_stage(self) -> Matrix:
        """From the stage's own space and unit to metres with Z up."""
        matrix = np.eye(4)
        if self.pxr.UsdGeom.GetStageUpAxis(self.usd) == self.pxr.UsdGeom.Tokens.y:
            matrix[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        matrix[:3, :3] *= self.metres_per_unit
        return matrix

    @cached_property
    def _time(self) -> Any:
        # Attributes with only time samples start at the first.
        return self.pxr.Usd.TimeCode.EarliestTime()

    @cached_property
    def _poses(self) -> Any:
        return self.pxr.UsdGeom.XformCache(self._time)

    def value(self, prim: Prim, name: str) -> Any:
        """Return an attribute's value, the schema's own where none is authored, or None where there is no such attribute."""
        attribute, twin = prim.GetAttribute(name), prim.GetAttribute(f"{NAMESPACE}{name}")
        self.note(prim, name, f"{NAMESPACE}{name}")
        value = attribute.Get(self._time) if attribute else None
        if value is None:
            value = self._fallback(prim, name)
        exact = twin.Get(self._time) if twin and value is not None else None
        return value if exact is None or not _is_rounded(exact, value) else exact

    def authored(self, prim: Prim, name: str) -> Any:
        attribute = prim.GetAttribute(name)
        self.note(prim, name)
        return self.value(prim, name) if attribute and attribute.HasAuthoredValue() else None

    def targets(self, prim: Prim, name: str) -> list[str]:
        """Return the paths that a relationship names, with forwarded relationships resolved."""
        self.note(prim, name)
        relationship = prim.GetRelationship(name)
        return [str(path) for path in relationship.GetForwardedTargets()] if relationship else []

    def note(self, prim: Prim, *names: str) -> None:
        path = str(prim.GetPath())
        self.read.update((path, name) for name in names)

    def schemas(self, prim: Prim) -> frozenset[str]:
        """Return all API schemas of a prim: applied ones, known to usd-core or not, and the ones that they imply."""
        path = str(prim.GetPath())
        if path not in self._schemas:
            names = [*prim.GetPrimTypeInfo().GetAppliedAPISchemas(), *prim.GetAppliedSchemas()]
            for name in names:  # grows
                names += [implied for implied in IMPLIED.get(name, ()) if implied not in names]
            self._schemas[path] = frozenset(names)
        return self._schemas[path]

    def has(self, prim: Prim, schema: str) -> bool:
        return schema in self.schemas(prim)

    def _fallback(self, prim: Prim, name: str) -> Any:
        """Return the value that a schema gives an attribute which the prim only has by implication."""
        registry = self.pxr.Usd.SchemaRegistry()
        for schema in self.schemas(prim) & IMPLIED_PHYSICS:
            definition = registry.FindAppliedAPIPrimDefinition(schema)
            if definition and name in definition.GetPropertyNames():
                return definition.GetAttributeFallbackValue(name)
        return None

    def number(self, prim: Prim, name: str, default: float = 0.0) -> float:
        """Return the value of a scalar attribute."""
        value = self.value(prim, name)
        if value is not None and np.isnan(value):
            raise self.error(prim, f"{name} is not a number")
        return default if value is None else float(value)

    def pose(self, prim: Prim) -> Matrix:
        """Return the transform from a prim's space to the world in metres with Z up, scale and shear included."""
        matrix = np.eye(4) if prim.IsPseudoRoot() else np.array(self._poses.GetLocalToWorldTransform(prim), dtype=np.float64).T
        if not np.isfinite(matrix).all():
            raise self.error(prim, "its transform is not finite")
        return self.world_from_stage @ matrix

    def frame(self, prim: Prim) -> tuple[Matrix, Float[np.ndarray, " 3"]]:
        """Return a prim's rigid frame in the world [m] and the scale [m per unit of its space] along its axes."""
        pose = self.pose(prim)
        split = rotation_and_scale(pose[:3, :3])
        if split is None:
            raise self.error(prim, "its transform is sheared or flat, so that it has no rigid frame")
        rigid = pose.copy()
        rigid[:3, :3], scale = split
        return rigid, scale

    def error(self, prim: Prim, what: str) -> RobotError:
        return RobotError(f"{self.file}: {prim.GetPath()}: {what}")

    def drop(self, what: str, prim: Prim) -> None:
        paths = self.dropped.setdefault(what, [])
        if (path := str(prim.GetPath())) not in paths:
            paths.append(path)


def is_within(path: str, root: str) -> bool:
    return path == root or path.startswith(f"{root}/")


def _is_rounded(exact: Any, value: Any) -> bool:
    """Return whether a value in float32 is what one in double rounds to."""
    if isinstance(value, float):
        return isinstance(exact, float) and bool(np.float32(exact) == np.float32(value))
    try:
        return bool(type(value)(exact) == value)
    except TypeError:  # another program wrote something else under this name
        return False


def rotation_and_scale(linear: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, " 3"]] | None:
    """Decompose a linear map into a rotation and a scale along the axes (negative for a reflection); None if it shears."""
    lengths = np.linalg.norm(linear, axis=0)
    if not (lengths > 0).all():
        return None
    axes = linear / lengths
    if np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR:
        return None
    u, _, v = np.linalg.svd(axes)  # the nearest orthogonal matrix: authored rotations are rounded
    rotation = u @ v
    return (rotation, lengths) if np.linalg.det(rotation) > 0 else (-rotation, -lengths)


@contextmanager
def open_stage(path: Path) -> Iterator[Stage]:
    """Open a stage, with all that it refers to; at the end warn once of each kind of thing that was dropped."""
    modules = usd_modules()
    printed = modules.UsdUtils.CoalescingDiagnosticDelegate()
    try:
        if not path.is_file():
            raise RobotError(f"{path}: there is no such file")
        try:
            usd = modules.Usd.Stage.Open(str(path))
        except modules.Tf.ErrorException as error:
            lines = [line.partition(" : ")[2].strip("' ") for line in str(error).splitlines() if " : " in line]
            reason = " ".join("; ".join(dict.fromkeys(lines)).split())  # without file names and lines of USD's sources
            raise RobotError(f"{path}: not a USD file: {reason}") from error
        errors = usd.GetCompositionErrors()  # references, payloads or sublayers that do not resolve: USD only prints a line
        if problems := sorted({f"{e.rootSite.path}: {' '.join(str(e).split()).rstrip('.')}" for e in errors}):
            raise RobotError(f"{path}: {listed(problems)}")
        stage = Stage(path, usd, modules)
        yield stage
        for problem, paths in stage.dropped.items():
            warnings.warn(f"{path}: {problem}: {listed(paths)}", stacklevel=4)
        for diagnostic in printed.TakeUncoalescedDiagnostics():
            warnings.warn(f"{path}: USD: {' '.join(diagnostic.commentary.split())}", stacklevel=4)
    finally:
        printed.TakeUncoalescedDiagnostics()  # the delegate prints any left when it is deleted
        del printed


@dataclass(frozen=True)
class Names:
    """Names in MJCF of what a stage holds, by the paths of the prims."""

    bodies: dict[str, str]  # of bodies
    geoms: dict[str, str]  # of geoms
    sites: dict[str, str]  # of sites
    joints: dict[str, str]  # of all joints
    moving: dict[str, str]  # of the joints of the tree that are not fixed
    scalars: dict[str, str]  # of its hinges and slides
    tendons: dict[str, str] = field(default_factory=dict)  # of tendons


def unique_names(stage: Stage, prims: Iterable[Prim], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return a name for each prim path: the authored `tgdsl:name`, or the shortest unique end of the path."""
    prims, taken = list(prims), Counter(reserved)
    names: dict[str, str] = {}
    for prim in prims:
        name = stage.authored(prim, NAME_ATTRIBUTE)
        if name and taken[str(name)]:
            stage.drop(f"duplicate names in {NAME_ATTRIBUTE} were dropped", prim)
        elif name:
            names[str(prim.GetPath())] = str(name)
            taken[str(name)] += 1
    parts = {path: path.strip("/").split("/") for prim in prims if (path := str(prim.GetPath())) not in names}
    depth = dict.fromkeys(parts, 1)
    while True:
        ends = {path: "_".join(parts[path][-depth[path] :]) for path in parts}
        counts = taken + Counter(ends.values())
        longer = [path for path in parts if counts[ends[path]] > 1 and depth[path] < len(parts[path])]
        if not longer:
            break
        for path in longer:
            depth[path] += 1
    for path, name in ends.items():  # only pairs like `/a/b_c` and `/a_b/c` still share one
        free, number = name, 1
        while taken[free]:
            number += 1
            free = f"{name}_{number}"
        names[path] = free
        taken[free] += 1
    return names


IRRELEVANT_NAMESPACES = (
    *("primvars:", "xformOp:", "material:binding", "inputs:", "outputs:", "info:", "ui:", "model:", "skel:", "light:"),
    *("collection:", "render:", "omni:", "semantic:", "semantics:", "userDocBrief", "proxyPrim", "userProperties:blender"),
)
"""Looks, display, transforms (which are composed by USD itself), rendering, editors' own."""
IRRELEVANT = frozenset(
    (
        *("xformOpOrder", "visibility", "purpose", "extent", "extentsHint", "doubleSided", "orientation", "normals"),
        *("subdivisionScheme", "interpolateBoundary", "faceVaryingLinearInterpolation", "triangleSubdivisionRule"),
        *("cornerIndices", "cornerSharpnesses", "creaseIndices", "creaseLengths", "creaseSharpnesses", "holeIndices"),
        *("points", "faceVertexCounts", "faceVertexIndices", "velocities", "accelerations", "familyName", "elementType"),
        *("physics:simulationOwner", "physics:startsAsleep", "mjc:compiler:saveInertial", "mjc:compiler:useThread"),
    )
)
"""Attributes and relationships that change nothing that is simulated; geometry is read, or refused, as a whole."""
MASS = tuple(
    f"{schema}:{name}"
    for schema, names in {
        "physics": ("mass", "density", "centerOfMass", "diagonalInertia", "principalAxes", "rigidBodyEnabled"),
        "newton": ("inertia", "massModel", "shellThickness"),
    }.items()
    for name in names
)
"""What a body or collider weighs."""
NEUTRAL: dict[str, tuple[Any, ...]] = {
    "newton:contactStiffness": (-math.inf,),
    "newton:contactDamping": (-math.inf,),
    "newton:contactFrictionGain": (-math.inf,),
    "newton:contactAdhesion": (-math.inf,),
    "newton:limitStiffness": (-math.inf,),
    "newton:limitDamping": (-math.inf,),
    "newton:velocityLimit": (math.inf,),
    "newton:delaySteps": (0,),
    "newton:ki": (0.0,),
    "newton:hydroelasticEnabled": (False,),
    "physxJoint:maxJointVelocity": (math.inf,),
}
"""Values that say nothing, of attributes that MuJoCo has nothing for."""
KNOWN_SCHEMAS = frozenset(
    (
        *("PhysicsRigidBodyAPI", "PhysicsMassAPI", "PhysicsCollisionAPI", "PhysicsMeshCollisionAPI", "PhysicsMaterialAPI"),
        *("PhysicsFilteredPairsAPI", "PhysicsArticulationRootAPI", "PhysicsDriveAPI", "PhysicsLimitAPI", "CollectionAPI"),
        *("MjcSceneAPI", "MjcSiteAPI", "MjcImageableAPI", "MjcCollisionAPI", "MjcMeshCollisionAPI", "MjcJointAPI"),
        *("MjcMaterialAPI", "MjcEqualityAPI", "MjcEqualityConnectAPI", "MjcEqualityWeldAPI", "MjcEqualityJointAPI"),
        *("NewtonSceneAPI", "NewtonArticulationRootAPI", "NewtonJointAPI", "NewtonMassAPI", "NewtonCollisionAPI"),
        *("NewtonMeshCollisionAPI", "NewtonSiteAPI", "NewtonMaterialAPI", "NewtonMimicAPI", "NewtonPDControlAPI"),
        *("NewtonPIDControlAPI", "NewtonActuatorControlBaseAPI", "NewtonActuatorClampingBaseAPI"),
        *("NewtonMaxEffortClampingAPI",),
        *("MaterialBindingAPI", "GeomModelAPI", "ModelAPI", "VisibilityAPI", "XformCommonAPI", "PrimvarsAPI", "MotionAPI"),
        *("AccessibilityAPI", "ColorSpaceAPI", "ClipsAPI", "AssetPreviewsAPI", "CoordSysAPI", "NodeDefAPI", "ConnectableAPI"),
        *("SemanticsAPI", "SemanticsLabelsAPI", "NodeGraphNodeAPI", "SceneGraphPrimAPI", "SkelBindingAPI", "LightAPI"),
    )
)
"""API schemas that are read, or that say nothing of physics."""
SILENT_SCHEMAS = ("Physx", "Mujoco", "Isaac", "Omni")
"""Prefixes of schemas that have no effect by themselves; their attributes are checked one by one."""
KNOWN_TYPES = frozenset(
    (
        *("", "Xform", "Scope", "Mesh", "Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane"),
        *("Points", "PointInstancer", "BasisCurves", "NurbsCurves", "NurbsPatch", "HermiteCurves", "TetMesh"),
        *("Material", "PhysicsScene", "PhysicsCollisionGroup", "PhysicsJoint", "PhysicsRevoluteJoint"),
        *("PhysicsPrismaticJoint", "PhysicsSphericalJoint", "PhysicsFixedJoint", "PhysicsDistanceJoint"),
        *("MjcActuator", "MjcKeyframe", "MjcTendon", "NewtonActuator"),
    )
)
"""Types of prims whose properties are checked."""
DRAWN_TYPES = ("Shader", "NodeGraph", "GeomSubset", "Camera", "Skel", "Render", "Backdrop", "BlendShape", "Volume", "Field")
"""Prefixes of types that only affect rendering: their properties are not checked."""


def note_unread(stage: Stage) -> None:
    """Record authored properties that were not read, for the warnings on closing. Nothing may be read after this."""
    for prim in stage.prims:
        kind = str(prim.GetTypeName())
        if kind.startswith(DRAWN_TYPES) or kind.endswith("Light"):
            continue
        is_collider, is_joint = stage.has(prim, "PhysicsCollisionAPI"), prim.IsA(stage.pxr.UsdPhysics.Joint)
        switches = (("physics:jointEnabled", is_joint), ("physics:collisionEnabled", is_collider))
        if any(is_there and stage.value(prim, name) is False for name, is_there in switches):
            continue  # a disabled joint or collider has no effect
        if stage.owners[str(prim.GetPath())] is None:  # the world's parts have no mass
            stage.note(prim, *MASS)
        if kind not in KNOWN_TYPES:
            stage.drop(f"prims of type {kind} were dropped", prim)
            continue
        for schema in sorted(stage.schemas(prim)):
            base = schema.partition(":")[0]
            if base not in KNOWN_SCHEMAS and not base.startswith(SILENT_SCHEMAS):
                stage.drop(f"the API schema {base} was dropped", prim)
        for name in _unread(stage, prim):
            stage.drop(f"{name} was dropped, which means nothing here", prim)


def _unread(stage: Stage, prim: Prim) -> Iterator[str]:
    """Yield the names of a prim's authored properties that nobody has read."""
    path = str(prim.GetPath())
    for authored in prim.GetAuthoredProperties():
        name = str(authored.GetName())
        if name in IRRELEVANT or name.startswith(IRRELEVANT_NAMESPACES) or (path, name) in stage.read:
            continue
        if hasattr(authored, "GetForwardedTargets"):
            if authored.GetForwardedTargets():
                yield name
        elif authored.HasAuthoredValue() and authored.Get() not in NEUTRAL.get(name, ()):
            yield name
