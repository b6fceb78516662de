"""Exported geoms have MuJoCo's poses and sizes."""

import mujoco
import numpy as np
import pytest
import trimesh
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade
from usd_exports import SINGLE, TOLERANCE, exported, matrix, named, world_of, world_pose


def extreme_points(prim: Usd.Prim) -> np.ndarray:
    """Return corners or poles of a shape in its frame, from its USD attributes."""
    value = lambda key: prim.GetAttribute(key).Get()  # noqa: E731
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T.astype(float)
    poles = np.vstack([np.eye(3), -np.eye(3)])
    kind = prim.GetTypeName()
    if kind == "Cube":
        return value("size") / 2 * corners
    if kind == "Sphere":
        return value("radius") * poles
    if kind == "Plane":
        return corners * [value("width") / 2, value("length") / 2, 0]
    assert value("axis") == "Z"
    if kind == "Cylinder":
        return np.vstack([poles[[0, 1, 3, 4]] * value("radius") + [0, 0, side * value("height") / 2] for side in (-1, 1)])
    assert kind == "Capsule"
    return poles * value("radius") + [0, 0, 1] * poles * value("height") / 2


def mujoco_extremes(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return the same points of MuJoCo's geom in the world at `qpos0`."""
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    geom, size = model.geom(name), model.geom(name).size
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T.astype(float)
    poles = np.vstack([np.eye(3), -np.eye(3)])
    points = {
        mujoco.mjtGeom.mjGEOM_BOX: corners * size,
        mujoco.mjtGeom.mjGEOM_SPHERE: poles * size[0],
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: poles * size,
        mujoco.mjtGeom.mjGEOM_PLANE: corners * [size[0], size[1], 0],
        mujoco.mjtGeom.mjGEOM_CAPSULE: poles * [size[0], size[0], size[0] + size[1]],
        mujoco.mjtGeom.mjGEOM_CYLINDER: corners[:, [2, 2, 2]] * 0
        + np.vstack([poles[[0, 1, 3, 4]] * size[0] + [0, 0, side * size[1]] for side in (-1, 1)]),
    }[mujoco.mjtGeom(int(geom.type[0]))]
    return points @ state.geom_xmat[geom.id].reshape(3, 3).T + state.geom_xpos[geom.id]


@pytest.mark.parametrize("name", ["floor", "block", "ball", "tube", "seen", "egg", "rod", "die"])
def test_exported_shapes_match_mujoco(zoo, name):
    stage, model = zoo
    prim = named(stage, UsdGeom.Gprim)[name]
    pose = world_pose(prim)
    points = extreme_points(prim) @ pose[:3, :3].T + pose[:3, 3]
    np.testing.assert_allclose(points, mujoco_extremes(model, name), atol=1e-14)
    low, high = (np.array(corner) for corner in UsdGeom.Boundable(prim).GetExtentAttr().Get())
    np.testing.assert_allclose(low, extreme_points(prim).min(axis=0), rtol=SINGLE)
    np.testing.assert_allclose(high, extreme_points(prim).max(axis=0), rtol=SINGLE)


def test_an_infinite_plane_has_no_width(zoo):
    plane = UsdGeom.Plane(named(zoo[0])["endless"])
    assert not plane.GetWidthAttr().IsAuthored()
    assert not plane.GetLengthAttr().IsAuthored()


def test_meshes_are_exported_in_their_original_pose(tmp_path):
    points = np.array([[3.0, 1, 2], [7, 1, 2], [3, 4, 2.5], [3.5, 1, 9], [6, 3, 5]]) * 1e-3
    solid = trimesh.convex.convex_hull(points)  # far from its origin, so that MuJoCo moves it
    solid.export(tmp_path / "wedge.stl")
    geom = "<body name='a' pos='.1 0 0' quat='.5 .5 -.5 .5'><geom name='g' type='mesh' mesh='wedge' pos='0 .2 0' quat='0 1 0 1'/></body>"
    stage, _ = exported(
        tmp_path, world_of(geom, asset="<mesh file='wedge.stl'/>").replace("wedge.stl", str(tmp_path / "wedge.stl"))
    )
    mesh = UsdGeom.Mesh(named(stage)["g"])
    placed = matrix(np.array([0.1, 0, 0]), np.array([0.5, 0.5, -0.5, 0.5])) @ matrix(
        np.array([0, 0.2, 0]), np.array([0, 1.0, 0, 1])
    )
    expected = solid.vertices @ placed[:3, :3].T + placed[:3, 3]
    pose = world_pose(mesh.GetPrim())
    result = np.array(mesh.GetPointsAttr().Get()) @ pose[:3, :3].T + pose[:3, 3]
    gaps = np.linalg.norm(result[:, None] - expected[None], axis=2)
    assert max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < TOLERANCE
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert trimesh.Trimesh(result, faces).volume == pytest.approx(solid.volume, rel=1e-4)  # and faces point outwards
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none"
    assert UsdPhysics.MeshCollisionAPI(mesh.GetPrim()).GetApproximationAttr().Get() == "convexHull"


def test_colliders_masks_and_friction(zoo):
    stage, model = zoo
    for name, prim in named(stage, UsdGeom.Gprim).items():
        geom = model.geom(name)
        masks = [int(prim.GetAttribute(f"tgdsl:{key}").Get() or 0) for key in ("contype", "conaffinity")]
        if prim.GetAttribute("tgdsl:contype"):
            assert masks == [geom.contype[0], geom.conaffinity[0]] != [1, 1]
        else:
            assert (geom.contype[0], geom.conaffinity[0]) == (1, 1)
        assert prim.HasAPI(UsdPhysics.CollisionAPI) == (name not in ("seen", "egg"))
        if name not in ("seen", "egg"):
            material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")
            surface = UsdPhysics.MaterialAPI(material.GetPrim())
            for friction in (surface.GetStaticFrictionAttr(), surface.GetDynamicFrictionAttr()):
                assert friction.Get() == pytest.approx(geom.friction[0], rel=SINGLE)
            assert not surface.GetDensityAttr().IsAuthored()
    materials = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]
    assert len(materials) == 2  # 0.3 and MuJoCo's 1


def test_the_world_is_no_rigid_body(zoo):
    world = zoo[0].GetPrimAtPath("/zoo_of_shapes/world")
    assert not world.HasAPI(UsdPhysics.RigidBodyAPI)
    assert [child.GetName() for child in world.GetChildren()] == ["floor", "endless", "camp"]


def test_colours(zoo):
    prims = named(zoo[0], UsdGeom.Gprim)
    colours = {
        name: (g.GetDisplayColorAttr().Get()[0], g.GetDisplayOpacityAttr().Get())
        for name, g in ((n, UsdGeom.Gprim(p)) for n, p in prims.items())
    }
    np.testing.assert_allclose(colours["block"][0], [0.9, 0.1, 0.2], rtol=SINGLE)
    assert list(colours["block"][1]) == [0.5]
    assert colours["ball"] == (Gf.Vec3f(0, 1, 0), None)
    assert colours["egg"] == (Gf.Vec3f(0.5), None)


def test_sites(zoo):
    stage, model = zoo
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    sites = {name: prim for name, prim in named(stage).items() if prim.GetAttribute("tgdsl:site").Get()}
    assert sites.keys() == {"camp", "mark"}
    for name, prim in sites.items():
        pose = world_pose(prim)
        np.testing.assert_allclose(pose[:3, 3], state.site(name).xpos, atol=1e-14)
        np.testing.assert_allclose(pose[:3, :3].ravel(), state.site(name).xmat, atol=1e-14)
