"""Shapes of USD stages: units, axes, scale, instances and meshes."""

import math
import xml.etree.ElementTree as ET
from itertools import product

import mujoco
import numpy as np
import pytest
import trimesh
from pxr import UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation
from stages import (
    ODD,
    OTHER,
    TOLERANCE,
    WEDGE,
    WEDGE_FACES,
    add_body,
    add_joint,
    add_mesh,
    add_shape,
    call,
    close,
    compiled,
    error_of,
    inertia,
    matrix,
    move,
    new_stage,
    parents,
    path_of,
    placed,
    warned,
    world_pose,
)

from tgdsl.formats.robot import load_model
from tgdsl.formats.usd.reader import usd_to_mjcf

ELL = [(x, y, z) for z in (0, 1) for x, y in ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2))]
ELL_FACES = [(5, 4, 3, 2, 1, 0), (6, 7, 8, 9, 10, 11), *((i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6) for i in range(6))]
"""An L-shaped prism."""


def test_centimetres_and_y_up_convert_to_metres_and_z_up(tmp_path):
    """The same robot with either up-axis, in metres and in centimetres."""
    models = []
    upright = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # Z-up from Y-up
    for metres, up in ((1.0, "Z"), (0.01, "Y")):
        stage = new_stage(tmp_path, f"robot{up}.usda", metres, up)
        unit, is_y = 1 / metres, up == "Y"
        top = Rotation.from_matrix(upright.T if is_y else np.eye(3)).as_quat(scalar_first=True)
        placed(UsdGeom.Xform.Define(stage, "/top").GetPrim(), quat=top)
        scene = UsdPhysics.Scene.Define(stage, "/scene")
        scene.CreateGravityMagnitudeAttr(9.5 * unit)
        add_body(stage, "/top/base", unit * np.array([0.1, 0.2, 0.3]), ODD, mass=0)
        add_body(stage, "/top/link", mass=0)
        link = matrix((0.1, 0.2, 0.3), ODD) @ matrix((0.1, 0, 0.2), OTHER)
        link[:3, 3] *= unit
        move(stage.GetPrimAtPath("/top/link"), link)
        add_shape(stage, "/top/base/box", pos=(0, 0, 0.1 * unit), quat=OTHER, scale=(0.1 * unit, 0.2 * unit, 0.3 * unit))
        add_shape(stage, "/top/link/pill", UsdGeom.Capsule, radius=0.05 * unit, height=0.2 * unit, axis="X")
        add_mesh(stage, "/top/link/wedge", np.array(WEDGE) * 0.1 * unit, WEDGE_FACES, pos=(0.1 * unit, 0, 0))
        UsdPhysics.MassAPI.Apply(stage.GetPrimAtPath("/top/link/wedge")).CreateDensityAttr(500 * metres**3)
        add_joint(
            stage, "/top/j", "slide", ("/top/base", "/top/link"), (0.1 * unit, 0, 0.2 * unit), OTHER,
            lowerLimit=-0.1 * unit, upperLimit=0.2 * unit,
        )  # fmt: skip
        models.append(compiled(stage))
    one, two = models
    for name in ("body_mass", "body_inertia", "body_ipos", "geom_size", "jnt_range", "geom_pos"):
        close(getattr(two, name), getattr(one, name))
    close(two.opt.gravity, one.opt.gravity)
    for body in ("base", "link"):
        close(world_pose(two, body), world_pose(one, body))
    close(one.opt.gravity, [0, 0, -9.5])


SHAPES = [
    (UsdGeom.Cube, {"size": 0.4}, (1, 2, 3), "box", (0.2, 0.4, 0.6), 0.4**3 * 6),
    (UsdGeom.Cube, {"size": 0.4}, (-1, 2, 3), "box", (0.2, 0.4, 0.6), 0.4**3 * 6),
    (UsdGeom.Sphere, {"radius": 0.3}, (2, 2, 2), "sphere", (0.6,), 4 / 3 * np.pi * 0.6**3),
    (UsdGeom.Sphere, {"radius": 0.3}, (1, 2, 3), "ellipsoid", (0.3, 0.6, 0.9), 4 / 3 * np.pi * 0.3**3 * 6),
    (UsdGeom.Capsule, {"radius": 0.2, "height": 0.6}, (2, 2, 2), "capsule", (0.4, 0.6), np.pi * 0.16 * 1.2 + 4 / 3 * np.pi * 0.4**3),
    (UsdGeom.Cylinder, {"radius": 0.2, "height": 0.6}, (3, 3, 2), "cylinder", (0.6, 0.6), np.pi * 0.36 * 1.2),
    (UsdGeom.Cylinder, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, np.pi * 0.04 * 2 * 0.6),
    (UsdGeom.Capsule, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, 2 * (np.pi * 0.04 * 0.6 + 4 / 3 * np.pi * 0.008)),
    (UsdGeom.Cone, {"radius": 0.2, "height": 0.6}, (1, 2, 1), "mesh", None, 2 * np.pi * 0.04 * 0.6 / 3),
    (UsdGeom.Capsule_1, {"radiusTop": 0.2, "radiusBottom": 0.2, "height": 0.0}, (1, 1, 1), "sphere", (0.2,), 4 / 3 * np.pi * 0.008),
    (UsdGeom.Capsule_1, {"radiusTop": 0.2, "radiusBottom": 0.01, "height": 0.1}, (1, 1, 1), "ball", None, 4 / 3 * np.pi * 0.008),
    (UsdGeom.Cylinder_1, {"radiusTop": 0.2, "radiusBottom": 0.2, "height": 0.6}, (1, 1, 1), "cylinder", (0.2, 0.3), np.pi * 0.04 * 0.6),
    (UsdGeom.Cylinder_1, {"radiusTop": 0.1, "radiusBottom": 0.2, "height": 0.6}, (1, 1, 1), "mesh", None, np.pi * 0.2 * (0.01 + 0.02 + 0.04)),
]  # fmt: skip


@pytest.mark.parametrize("axis", "XYZ")
@pytest.mark.parametrize(("kind", "values", "scale", "shape", "size", "volume"), SHAPES)
def test_shapes(tmp_path, kind, values, scale, shape, size, volume, axis):
    """Type, size, pose, volume and inertia of every shape, rotated and scaled, against MuJoCo's inertia."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    scale = np.array(scale, dtype=float)
    if "height" in values:
        values = {**values, "axis": axis}
        scale = np.roll(scale, "XYZ".index(axis) + 1)  # the last scale is along the axis
    elif axis != "Z":
        return
    add_shape(stage, "/b/shape", kind, (0.1, 0.2, 0.3), ODD, scale.tolist(), **values)
    text = usd_to_mjcf(path_of(stage))
    model = mujoco.MjModel.from_xml_string(text)
    tensor = inertia(model, "b")
    close(model.body("b").mass, 1000 * volume, 5e-3 if shape in ("mesh", "ball") else TOLERANCE)
    geom = load_model(path_of(stage)).geoms[0]
    assert geom.shape == ("mesh" if shape == "ball" else shape)
    root = ET.fromstring(text)
    root.find("worldbody/body").remove(root.find("worldbody/body/inertial"))
    for mesh in root.iter("mesh"):
        mesh.set("inertia", "exact")
    bare = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    np.testing.assert_allclose(tensor, inertia(bare, "b"), rtol=1e-5, atol=1e-5 * np.abs(tensor).max())
    close(model.body("b").ipos, bare.body("b").ipos, 1e-5)
    if size:
        close(geom.size[: len(size)], size)
    if size or shape == "ball":
        return
    surface = load_model(path_of(stage)).surface((geom,))
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight
    np.testing.assert_allclose(mesh.volume, volume, rtol=5e-3)  # and faces point outwards
    local = (mesh.vertices - [0.1, 0.2, 0.3]) @ matrix((0, 0, 0), ODD)[:3, :3] / scale
    height = values["height"] + (2 * values["radius"] if kind is UsdGeom.Capsule else 0)
    along = "XYZ".index(axis)
    close([local[:, along].min(), local[:, along].max()], [-height / 2, height / 2])
    around = np.linalg.norm(np.delete(local, along, axis=1), axis=1)
    close(around.max(), 0.2, 1e-3)
    if kind is UsdGeom.Cone:  # the tip is up the axis
        assert around[local[:, along] > 0].max() < 1e-6


def test_shear(tmp_path):
    """A rotated shape under a scaled parent: a sphere becomes an ellipsoid, a cube a mesh; a body is refused."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b", mass=0)
    placed(UsdGeom.Xform.Define(stage, "/b/stretched").GetPrim(), scale=(1, 2, 3))
    add_shape(stage, "/b/stretched/ball", UsdGeom.Sphere, quat=ODD, scale=(1, 1, 2))
    add_shape(stage, "/b/stretched/cube", quat=ODD, scale=(1, 1, 2))
    model = compiled(stage)
    close(model.body("b").mass, 1000 * 12 * (4 / 3 * np.pi + 8))
    linear = np.diag([1, 2, 3]) @ matrix((0, 0, 0), ODD)[:3, :3] @ np.diag([1, 1, 2])
    ball = model.geom("ball")
    turned = Rotation.from_quat(ball.quat, scalar_first=True).as_matrix()
    close(turned @ np.diag(ball.size**2) @ turned.T, linear @ linear.T)  # the same quadric
    corners = (
        load_model(path_of(stage)).surface(tuple(g for g in load_model(path_of(stage)).geoms if g.name == "cube")).vertices
    )
    expected = np.array(list(product((-1, 1), repeat=3))) @ linear.T
    assert np.linalg.norm(corners[:, None] - expected, axis=2).min(axis=0).max() < 1e-5
    add_body(stage, "/b/stretched/turned", quat=ODD)
    assert error_of(stage) == "/b/stretched/turned: its transform is sheared or flat, so that it has no rigid frame"


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 0.5, 3), (-1, 2, 1)])
@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_meshes_keep_their_pose_and_orientation(tmp_path, scale, orientation):
    stage = new_stage(tmp_path, metres=0.01)
    add_body(stage, "/b", mass=0)
    faces = [face[::-1] for face in WEDGE_FACES] if orientation == "leftHanded" else WEDGE_FACES
    prim = add_mesh(stage, "/b/wedge", WEDGE, faces, pos=(5, 6, 7), quat=ODD, scale=scale)
    UsdGeom.Mesh(prim).CreateOrientationAttr(orientation)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    volume = 1e-6 * abs(np.prod(scale))
    np.testing.assert_allclose(trimesh.Trimesh(surface.vertices, surface.faces).volume, volume, rtol=1e-5)
    expected = 0.01 * ((np.array(WEDGE) * scale) @ matrix((0, 0, 0), ODD)[:3, :3].T + [5, 6, 7])
    assert np.linalg.norm(surface.vertices[:, None] - expected, axis=2).min(axis=0).max() < TOLERANCE
    np.testing.assert_allclose(model.compiled.body("b").mass, 1000 * volume, rtol=1e-6)


def test_concave_polygons_are_triangulated(tmp_path):
    """Volume and area of an L-shaped prism are right only if no triangle lies outside the polygon."""
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/ell", ELL, ELL_FACES, collides=False, quat=ODD)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    mesh = trimesh.Trimesh(surface.vertices, surface.faces)
    assert mesh.is_volume
    np.testing.assert_allclose([mesh.volume, mesh.area], [3, 2 * 3 + 8], rtol=1e-6)
    geom = model.compiled.geom("ell")
    assert (geom.contype, geom.conaffinity, geom.group) == (0, 0, 2)
    close(model.compiled.body("b").mass, 1.0)


@pytest.mark.parametrize("first", range(16))
def test_polygons_with_many_reflex_corners_are_triangulated(tmp_path, first):
    """A comb with four teeth, from any first corner and either side."""
    teeth = [corner for x in (6, 4, 2, 0) for corner in ((x + 1, 3), (x, 3), (x, 1), (x - 1, 1))][:-2]
    comb = [(0, 0), (7, 0), *teeth]
    ring = np.roll(np.array([(x, y, 0.5 * x) for x, y in comb], dtype=float), first, axis=0)
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/comb", [*ring, (0, 0, 9)], [tuple(range(len(ring)))[:: 1 if first % 2 else -1]], collides=False)
    model = load_model(path_of(stage))
    surface = model.surface(model.touchable("b"))
    following = np.roll(ring, -1, axis=0)
    area = np.cross(ring, following).sum(axis=0) / 2
    assert len(surface.faces) == len(ring) - 2
    np.testing.assert_allclose(trimesh.Trimesh(surface.vertices, surface.faces).area, np.linalg.norm(area), rtol=1e-5)


def test_approximations(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    kinds = ("none", "convexHull", "boundingCube", "boundingSphere", "convexDecomposition", "meshSimplification", "sdf")
    for i, kind in enumerate(kinds):
        add_mesh(stage, f"/b/{kind}", ELL, ELL_FACES, kind, pos=(0, 0, 10 * i), scale=(1, 1, 2))
    add_mesh(stage, "/b/wedge", WEDGE, WEDGE_FACES, "none")  # convex: the hull is exact
    model, messages = warned(stage)
    hulls = ("none", "convexDecomposition", "meshSimplification", "sdf")
    assert messages == [f'meshes with approximation "{kind}" collide as their convex hulls: /b/{kind}' for kind in hulls]
    box, ball = model.geom("boundingCube"), model.geom("boundingSphere")
    assert (box.type, ball.type) == (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE)
    close(box.size, [1, 1, 1])
    close(box.pos, [1, 1, 21])
    close(ball.pos, [1, 1, 31])
    close(ball.size[0], math.sqrt(3))
    assert (box.group, model.geom("boundingCube_visual").group) == (3, 2)
    assert model.geom("boundingCube_visual").contype == 0
    assert model.nmesh == 2  # equal meshes are kept once


def test_instances_have_all_their_geoms(tmp_path):
    part = new_stage(tmp_path, "part.usda")
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/part").GetPrim())
    add_shape(part, "/part/box", pos=(0, 0, 1))
    add_mesh(part, "/part/look", WEDGE, WEDGE_FACES, collides=False)
    path_of(part)
    stage = new_stage(tmp_path)
    for name in ("left", "right"):
        add_body(stage, f"/{name}", mass=0)
        held = UsdGeom.Xform.Define(stage, f"/{name}/shapes").GetPrim()
        held.GetReferences().AddReference("./part.usda")
        held.SetInstanceable(True)
        assert held.IsInstance()
    model = load_model(path_of(stage))
    assert [(geom.body, geom.name) for geom in model.geoms] == [
        ("left", "left_shapes_box"),
        ("left", "left_shapes_look"),
        ("right", "right_shapes_box"),
        ("right", "right_shapes_look"),
    ]
    assert model.compiled.nmesh == 1
    for body in ("left", "right"):
        close(model.compiled.body(body).mass, 8000.0)
        close(model.compiled.body(body).ipos, [0, 0, 1])


def test_a_whole_robot_can_be_an_instance(tmp_path):
    """Joints inside an instance name the prototype's bodies, but connect the instance's."""
    part = new_stage(tmp_path, "part.usda")
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/part").GetPrim())
    for i in range(2):
        add_body(part, f"/part/b{i}", (i, 0, 0))
    add_joint(part, "/part/j", "hinge", ("/part/b0", "/part/b1"), (1, 0, 0))
    path_of(part)
    stage = new_stage(tmp_path)
    for name in ("left", "right"):
        held = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
        held.GetReferences().AddReference("./part.usda")
        held.SetInstanceable(True)
    model = compiled(stage)
    assert parents(model) == {"left_b0": "world", "left_b1": "left_b0", "right_b0": "world", "right_b1": "right_b0"}


def test_names(tmp_path):
    stage = new_stage(tmp_path)
    for finger in ("thumb", "index"):
        UsdGeom.Xform.Define(stage, f"/hand/{finger}")
        add_body(stage, f"/hand/{finger}/tip")
        add_shape(stage, f"/hand/{finger}/tip/pad")
    add_body(stage, "/hand/world")
    named = add_body(stage, "/hand/palm")
    call(named, "right/palm")
    call(add_shape(stage, "/hand/palm/skin"), "pad")
    double = add_body(stage, "/hand/back")
    call(double, "right/palm")
    add_body(stage, "/hand/index/tip/nested", (1, 0, 0))  # a nested body moves separately
    add_shape(stage, "/hand/index/tip/nested/nail")
    model, messages = warned(stage)
    assert messages == ["duplicate names in tgdsl:name were dropped: /hand/back"]
    names = {model.body(i).name for i in range(model.nbody)}
    assert names == {"world", "thumb_tip", "index_tip", "hand_world", "right/palm", "back", "nested"}
    geoms = {model.geom(i).name: model.body(model.geom_bodyid[i]).name for i in range(model.ngeom)}
    assert geoms == {
        "thumb_tip_pad": "thumb_tip",
        "index_tip_pad": "index_tip",
        "pad": "right/palm",
        "nail": "nested",
    }
    assert parents(model)["nested"] == "world"


def test_purpose_and_visibility_set_groups_of_geoms(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    for name, purpose, collides in product("v", ("default", "render", "guide", "proxy"), (True, False)):
        prim = add_shape(stage, f"/b/{name}_{purpose}_{collides}", collides=collides)
        UsdGeom.Imageable(prim).CreatePurposeAttr(purpose)
    UsdGeom.Imageable(add_shape(stage, "/b/unseen")).MakeInvisible()
    off = add_shape(stage, "/b/off")
    off.GetAttribute("physics:collisionEnabled").Set(False)
    UsdGeom.Gprim(off).CreateDisplayColorAttr([(0.1, 0.2, 0.3)])
    add_shape(stage, "/floor", UsdGeom.Plane, axis="Y", pos=(0, 0, -1))
    model = compiled(stage)
    groups = {model.geom(i).name: (int(model.geom_group[i]), bool(model.geom_contype[i])) for i in range(model.ngeom)}
    assert groups == {
        "v_default_True": (0, True),
        "v_default_False": (2, False),
        "v_render_True": (0, True),
        "v_render_False": (2, False),
        "v_guide_True": (3, True),
        "v_proxy_True": (3, True),
        "unseen": (3, True),
        "off": (2, False),
        "floor": (0, True),
    }
    close(model.geom("off").rgba, [0.1, 0.2, 0.3, 1])
    normal = Rotation.from_quat(model.geom("floor").quat, scalar_first=True).as_matrix()[:, 2]
    close(normal, [0, 1, 0])
    close(model.body("b").mass, 1.0)
