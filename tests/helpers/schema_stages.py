"""A small stage that has one prim for each schema of MuJoCo's and Newton's, whose plugins need not be there."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, Vt
from stages import WEDGE, WEDGE_FACES, add_body, add_joint, add_material, add_mesh, add_shape, new_stage

TYPES = {
    bool: Sdf.ValueTypeNames.Bool,
    int: Sdf.ValueTypeNames.Int,
    float: Sdf.ValueTypeNames.Double,
    str: Sdf.ValueTypeNames.Token,
    list: Sdf.ValueTypeNames.DoubleArray,
    tuple: Sdf.ValueTypeNames.IntArray,
}
"""USD's types by those of Python: a list is of floats, a tuple of integers."""
PRIMS = {
    "scene": "/scene",
    "root": "/base",
    "turn": "/turn",
    "rail": "/rail",
    "socket": "/socket",
    "ball": "/link/ball",
    "mesh": "/cart/wedge",
    "rubber": "/rubber",
    "site": "/link/site",
    "seen": "/link/seen",
    "link": "/link",
    "motor": "/motor",
    "key": "/key",
    "connect": "/connect",
    "weld": "/weld",
    "tendon": "/tendon",
    "cable": "/cable",
    "servo": "/servo",
}


def author(prim: Usd.Prim, name: str, value: Any) -> None:
    """Author an attribute as a program without the schema's plugin would."""
    kind = Sdf.ValueTypeNames.Double3 if name.endswith(("magnetic", "wind")) else TYPES[type(value)]
    prim.CreateAttribute(name, kind, custom=False).Set(Vt.IntArray(value) if kind == TYPES[tuple] else value)


def relate(prim: Usd.Prim, name: str, targets: Sequence[str]) -> None:
    prim.CreateRelationship(name, custom=False).SetTargets(list(targets))


def apply(prim: Usd.Prim, *schemas: str) -> None:
    for schema in schemas:
        prim.AddAppliedSchema(schema)


def schema_stage(folder: Path, name: str = "schemas.usda", metres: float = 1.0) -> Usd.Stage:
    """Return the stage: a base, a link that turns, a cart that slides on it, a ball joint, and all that acts on them."""
    stage = new_stage(folder, name, metres=metres)
    apply(UsdPhysics.Scene.Define(stage, "/scene").GetPrim(), "MjcSceneAPI")
    base = add_body(stage, "/base")
    UsdPhysics.ArticulationRootAPI.Apply(base)
    apply(base, "NewtonArticulationRootAPI")
    add_joint(stage, "/fixed", "fixed", (None, "/base"))
    for path in ("/link", "/cart", "/knob"):
        add_body(stage, path)
    joints = [
        add_joint(stage, "/turn", "hinge", ("/base", "/link"), lowerLimit=-60.0, upperLimit=90.0),
        add_joint(stage, "/rail", "slide", ("/link", "/cart"), lowerLimit=-0.5, upperLimit=0.7),
        add_joint(stage, "/socket", "ball", ("/cart", "/knob")),
    ]
    for joint in joints:
        apply(joint, "MjcJointAPI", "NewtonJointAPI")
    ball = add_shape(stage, "/link/ball", UsdGeom.Sphere, radius=0.1)
    apply(ball, "NewtonCollisionAPI", "MjcCollisionAPI")
    apply(add_material(stage, "/rubber", ball, dynamicFriction=0.5), "NewtonMaterialAPI", "MjcMaterialAPI")
    mesh = add_mesh(stage, "/cart/wedge", np.array(WEDGE), WEDGE_FACES)
    apply(mesh, "NewtonMeshCollisionAPI", "MjcMeshCollisionAPI")
    apply(add_shape(stage, "/link/site", UsdGeom.Sphere, (0, 0, 0.3), collides=False, radius=0.01), "MjcSiteAPI")
    apply(add_shape(stage, "/cart/hook", UsdGeom.Sphere, (0.2, 0, 0.3), collides=False, radius=0.01), "NewtonSiteAPI")
    apply(add_shape(stage, "/link/seen", UsdGeom.Sphere, collides=False, radius=0.05), "MjcImageableAPI")
    for path, kind, target in (("/motor", "MjcActuator", "mjc:target"), ("/servo", "NewtonActuator", "newton:targets")):
        relate(stage.DefinePrim(path, kind), target, ["/turn" if kind == "MjcActuator" else "/rail"])
    apply(stage.GetPrimAtPath("/servo"), "NewtonPDControlAPI", "NewtonMaxEffortClampingAPI")
    author(stage.GetPrimAtPath("/servo"), "newton:kp", 10.0)
    apply(add_joint(stage, "/connect", "ball", ("/base", "/knob")), "MjcEqualityConnectAPI")
    apply(add_joint(stage, "/weld", "fixed", ("/base", "/cart")), "MjcEqualityWeldAPI")
    relate(stage.DefinePrim("/tendon", "MjcTendon"), "mjc:path", ["/turn", "/rail"])
    author(stage.GetPrimAtPath("/tendon"), "mjc:type", "fixed")
    relate(stage.DefinePrim("/cable", "MjcTendon"), "mjc:path", ["/link/site", "/link/ball", "/cart/hook"])
    stage.DefinePrim("/key", "MjcKeyframe")
    return stage
