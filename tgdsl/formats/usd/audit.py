"""What is authored in a stage and nobody has read: every attribute, relationship, API schema and type of prim with a meaning.

The readers record what they read (`Stage.read`). What is left is warned of, once for each name. What has no meaning for a
model of physics (looks, display, subdivision, bookkeeping) is listed in the tables below.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from tgdsl.formats.usd.stage import Prim, Stage

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
"""What schemas begin with that say nothing of themselves: only their attributes count, which are looked at one by one."""
KNOWN_TYPES = frozenset(
    (
        *("", "Xform", "Scope", "Mesh", "Cube", "Sphere", "Capsule", "Capsule_1", "Cylinder", "Cylinder_1", "Cone", "Plane"),
        *("Points", "PointInstancer", "BasisCurves", "NurbsCurves", "NurbsPatch", "HermiteCurves", "TetMesh"),
        *("Material", "PhysicsScene", "PhysicsCollisionGroup", "PhysicsJoint", "PhysicsRevoluteJoint"),
        *("PhysicsPrismaticJoint", "PhysicsSphericalJoint", "PhysicsFixedJoint", "PhysicsDistanceJoint"),
        *("MjcActuator", "MjcKeyframe", "MjcTendon", "NewtonActuator"),
    )
)
"""Types of prims whose properties are looked at."""
DRAWN_TYPES = ("Shader", "NodeGraph", "GeomSubset", "Camera", "Skel", "Render", "Backdrop", "BlendShape", "Volume", "Field")
"""What types begin with that are only drawn: their properties are not looked at."""


def note_unread(stage: Stage) -> None:
    """Record what was authored and not read, for the warnings when the stage is closed. Nothing may be read after this."""
    for prim in stage.prims:
        kind = str(prim.GetTypeName())
        if kind.startswith(DRAWN_TYPES) or kind.endswith("Light") or _is_off(stage, prim):
            continue
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


def _is_off(stage: Stage, prim: Prim) -> bool:
    enabled = [("physics:jointEnabled", prim.IsA(stage.pxr.UsdPhysics.Joint))]
    enabled += [("physics:collisionEnabled", stage.has(prim, "PhysicsCollisionAPI"))]
    return any(is_there and stage.value(prim, name) is False for name, is_there in enabled)


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
