"""Small USD stages for tests, and what they should come to, in NumPy."""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.usd.reader import usd_to_mjcf

ONE = (1.0, 0.0, 0.0, 0.0)
JOINTS = {
    "hinge": UsdPhysics.RevoluteJoint,
    "slide": UsdPhysics.PrismaticJoint,
    "ball": UsdPhysics.SphericalJoint,
    "fixed": UsdPhysics.FixedJoint,
    "distance": UsdPhysics.DistanceJoint,
    "generic": UsdPhysics.Joint,
}


def new_stage(folder: Path, name: str = "robot.usda", metres: float = 1.0, up: str = "Z") -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(folder / name))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    return stage


def stage_with_base(folder: Path, name: str = "robot.usda") -> Usd.Stage:
    """Return a stage with a body `/base` that is fixed to the world."""
    stage = new_stage(folder, name)
    add_body(stage, "/base")
    add_joint(stage, "/fixed", "fixed", (None, "/base"))
    return stage


def placed(prim: Usd.Prim, pos: Sequence[float] = (0, 0, 0), quat: Sequence[float] = ONE, scale: Sequence[float] = (1, 1, 1)):
    """Give a prim a transform: translate, orient (w, x, y, z), scale."""
    xform = UsdGeom.Xformable(prim)
    xform.AddTranslateOp().Set(Gf.Vec3d(*map(float, pos)))
    xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*map(float, quat)).GetNormalized())
    xform.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*map(float, scale)))
    return prim


def add_body(
    stage: Usd.Stage, path: str, pos=(0, 0, 0), quat=ONE, scale=(1, 1, 1), mass: float = 1.0, kind=UsdGeom.Xform
) -> Usd.Prim:
    """Add a rigid body with an authored mass (unless that is 0) and the inertia diag(0.02, 0.03, 0.04)."""
    prim = placed(kind.Define(stage, path).GetPrim(), pos, quat, scale)
    UsdPhysics.RigidBodyAPI.Apply(prim)
    if mass:
        api = UsdPhysics.MassAPI.Apply(prim)
        api.CreateMassAttr(mass)
        api.CreateDiagonalInertiaAttr((0.02, 0.03, 0.04))
        api.CreateCenterOfMassAttr((0, 0, 0))
    return prim


def move(prim: Usd.Prim, pose: np.ndarray) -> None:
    """Move a prim that `placed` has placed."""
    prim.GetAttribute("xformOp:translate").Set(Gf.Vec3d(*pose[:3, 3].tolist()))
    quat = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True).tolist()
    prim.GetAttribute("xformOp:orient").Set(Gf.Quatd(*quat))


def call(prim: Usd.Prim, name: str) -> None:
    """Author the name that a prim shall have in MJCF."""
    prim.CreateAttribute("tgdsl:name", Sdf.ValueTypeNames.String, custom=True).Set(name)


def add_shape(
    stage: Usd.Stage, path: str, kind=UsdGeom.Cube, pos=(0, 0, 0), quat=ONE, scale=(1, 1, 1), collides: bool = True, **values
):
    """Add a geometry prim; `values` are its attributes."""
    prim = placed(kind.Define(stage, path).GetPrim(), pos, quat, scale)
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    if collides:
        UsdPhysics.CollisionAPI.Apply(prim)
    return prim


def add_mesh(stage: Usd.Stage, path: str, points, faces, approximation: str = "convexHull", **keywords) -> Usd.Prim:
    prim = add_shape(stage, path, UsdGeom.Mesh, **keywords)
    mesh = UsdGeom.Mesh(prim)
    mesh.CreatePointsAttr([tuple(map(float, point)) for point in points])
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
    mesh.CreateFaceVertexIndicesAttr([int(i) for face in faces for i in face])
    if prim.HasAPI(UsdPhysics.CollisionAPI):
        UsdPhysics.MeshCollisionAPI.Apply(prim).CreateApproximationAttr(approximation)
    return prim


def add_joint(
    stage: Usd.Stage, path: str, kind: str, bodies, pos0=(0, 0, 0), rot0=ONE, pos1=(0, 0, 0), rot1=ONE, **values
) -> Usd.Prim:
    """Add a joint; of `bodies`, None is the world; `values` are attributes under `physics:`."""
    joint = JOINTS[kind].Define(stage, path)
    for relationship, body in zip((joint.CreateBody0Rel(), joint.CreateBody1Rel()), bodies, strict=True):
        if body:
            relationship.SetTargets([body])
    joint.CreateLocalPos0Attr(tuple(map(float, pos0)))
    joint.CreateLocalPos1Attr(tuple(map(float, pos1)))
    joint.CreateLocalRot0Attr(Gf.Quatf(*map(float, rot0)).GetNormalized())
    joint.CreateLocalRot1Attr(Gf.Quatf(*map(float, rot1)).GetNormalized())
    for name, value in values.items():
        joint.GetPrim().GetAttribute(f"physics:{name}").Set(value)
    return joint.GetPrim()


def add_material(stage: Usd.Stage, path: str, prim: Usd.Prim, purpose: str = "physics", **values: float) -> Usd.Prim:
    material = UsdShade.Material.Define(stage, path)
    UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    for name, value in values.items():
        material.GetPrim().GetAttribute(f"physics:{name}").Set(value)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose=purpose)
    return material.GetPrim()


def path_of(stage: Usd.Stage) -> Path:
    """Save a stage and return its file."""
    stage.Save()
    return Path(stage.GetRootLayer().realPath)


def compiled(stage: Usd.Stage) -> mujoco.MjModel:
    """Save a stage, and return what MuJoCo makes of its MJCF."""
    return mujoco.MjModel.from_xml_string(usd_to_mjcf(path_of(stage)))


def matrix(pos=(0, 0, 0), quat=ONE) -> np.ndarray:
    """Return a homogeneous transform; its numbers are rounded as USD's float32 attributes are."""
    result = np.eye(4)
    result[:3, 3] = np.float32(pos)
    result[:3, :3] = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    return result


def turn(axis: str, angle: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(angle * np.eye(3)["XYZ".index(axis)]).as_matrix()
    return result


def shift(axis: str, distance: float) -> np.ndarray:
    result = np.eye(4)
    result[:3, 3] = distance * np.eye(3)["XYZ".index(axis)]
    return result


def world_pose(model: mujoco.MjModel, body: str, qpos: Sequence[float] | None = None, key: str | None = None) -> np.ndarray:
    """Return MuJoCo's world pose of a body."""
    data = mujoco.MjData(model)
    if key:
        mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
    if qpos is not None:
        data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = data.body(body).xmat.reshape(3, 3), data.body(body).xpos
    return result


def inertia(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Return a body's inertia about its centre of mass, in its frame."""
    turned = Rotation.from_quat(model.body(body).iquat, scalar_first=True).as_matrix()
    return turned @ np.diag(model.body(body).inertia) @ turned.T


def meetings(model: mujoco.MjModel) -> set[tuple[str, ...]]:
    """Return the pairs of bodies that MuJoCo finds in contact."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {tuple(sorted(model.body(model.geom_bodyid[g]).name for g in contact.geom)) for contact in data.contact}


TOLERANCE = 1e-6
"""USD keeps joint frames and sizes in float32, MuJoCo mesh vertices too; all here is about 1 m or 1 kg."""
ODD = (0.8, 0.3, -0.4, 0.2)
OTHER = (0.5, -0.6, 0.1, 0.7)
ONE_TURN = (1.0, 0.0, 0.0, 0.0)
WEDGE = [(0, 0, 0), (3, 0, 0), (0, 2, 0), (0, 0, 1)]
WEDGE_FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
QUAD = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
FRAMES = ((0.4, -0.3, 0.2), ODD, (-0.1, 0.25, 0.35), OTHER)
"""Where the joint of `arm` is in body 0 and in body 1: position and quaternion."""
FRAME0, FRAME1 = matrix(*FRAMES[:2]), matrix(*FRAMES[2:])


def close(found, expected, tolerance: float = TOLERANCE) -> None:
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance)


def error_of(stage: Usd.Stage) -> str:
    path = path_of(stage)
    with pytest.raises(RobotError) as caught:
        usd_to_mjcf(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def warned(stage: Usd.Stage) -> tuple[mujoco.MjModel, list[str]]:
    """Return the model, and its warnings without the file's name."""
    with pytest.warns(UserWarning, match=r"\.usda: ") as caught:
        model = compiled(stage)
    return model, [str(w.message).removeprefix(f"{path_of(stage)}: ") for w in caught]


def arm(stage: Usd.Stage, kind: str, axis: str, is_swapped: bool = False, **values) -> None:
    """Add a base that is fixed to the world and a link on it; frame 0 is the base's, or the link's if swapped."""
    add_body(stage, "/robot/base", (0.1, 0.2, 0.3), OTHER)
    add_body(stage, "/robot/link")
    UsdPhysics.ArticulationRootAPI.Apply(
        add_joint(stage, "/robot/root", "fixed", (None, "/robot/base"), (0.1, 0.2, 0.3), OTHER)
    )
    bodies = ("/robot/link", "/robot/base") if is_swapped else ("/robot/base", "/robot/link")
    add_joint(stage, "/robot/j", kind, bodies, *FRAMES, **({"axis": axis} if axis else {}), **values)
    place_at_zero(stage, is_swapped)


def place_at_zero(stage: Usd.Stage, is_swapped: bool) -> None:
    """Move the link to where the joint is at zero, so that nothing is off."""
    base = matrix((0.1, 0.2, 0.3), OTHER)
    pose = base @ (FRAME1 @ np.linalg.inv(FRAME0) if is_swapped else FRAME0 @ np.linalg.inv(FRAME1))
    move(stage.GetPrimAtPath("/robot/link"), pose)


GENERIC = ("transX", "transY", "transZ", "rotX", "rotY", "rotZ")


def generic(stage: Usd.Stage, limits: dict[str, tuple[float, float]]) -> None:
    arm(stage, "generic", "")
    for dof, (low, high) in limits.items():
        limit = UsdPhysics.LimitAPI.Apply(stage.GetPrimAtPath("/robot/j"), dof)
        limit.CreateLowAttr(low)
        limit.CreateHighAttr(high)


def parents(model: mujoco.MjModel) -> dict[str, str]:
    return {model.body(i).name: model.body(model.body_parentid[i]).name for i in range(1, model.nbody)}


def chain(stage: Usd.Stage, count: int, kind: str = "hinge", **values) -> None:
    """Add bodies a row along x, 1 m apart, each joined to the one before by its own origin."""
    for i in range(count):
        add_body(stage, f"/b{i}", (i, 0, 0))
        if i:
            add_joint(stage, f"/j{i}", kind, (f"/b{i - 1}", f"/b{i}"), (1, 0, 0), **values)
