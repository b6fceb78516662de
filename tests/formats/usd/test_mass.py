"""Masses of USD stages against closed forms and usd-core; materials, filters and gravity."""

import math

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics
from scipy.spatial.transform import Rotation
from stages import (
    ODD,
    ONE_TURN,
    QUAD,
    add_body,
    add_joint,
    add_material,
    add_mesh,
    add_shape,
    chain,
    close,
    compiled,
    inertia,
    matrix,
    meetings,
    new_stage,
    warned,
)


@pytest.mark.parametrize(
    ("body", "collider", "material", "expected"),
    [
        ({}, {}, 0, 16000),
        ({"Mass": 5}, {}, 0, 5),
        ({"Density": 2}, {}, 0, 32),
        ({}, {"Mass": 7}, 0, 8007),
        ({}, {"Density": 3}, 0, 8024),
        ({}, {}, 4, 64),
        ({"Density": 2}, {"Density": 3}, 4, 40),
        ({"Mass": 5}, {"Mass": 7}, 0, 5),
        ({"Mass": 5, "CenterOfMass": (0, 1, 0)}, {}, 0, 5),
        ({"Mass": 5, "DiagonalInertia": (1, 2, 2.5)}, {}, 0, 5),
        ({"Density": 2, "DiagonalInertia": (1, 2, 2.5), "CenterOfMass": (0, 1, 0)}, {}, 0, 32),
        ({}, {"Mass": 7, "CenterOfMass": (0, 1, 0)}, 0, 8007),
        ({}, {"Mass": 7, "DiagonalInertia": (1, 2, 2.5)}, 0, 8007),
    ],
)
def test_masses_match_usd_core(tmp_path, body, collider, material, expected):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b", (1, 2, 3), ODD, mass=0)
    boxes = {"/b/one": (1.0, 0.0, 0.0), "/b/two": (-2.0, 0.0, 0.5)}
    for path, pos in boxes.items():
        add_shape(stage, path, pos=pos)
    for target, values in ((prim, body), (stage.GetPrimAtPath("/b/one"), collider)):
        api = UsdPhysics.MassAPI.Apply(target)
        for name, value in values.items():
            getattr(api, f"Create{name}Attr")(value)
        if "DiagonalInertia" in values:
            api.CreatePrincipalAxesAttr(Gf.Quatf(*map(float, ONE_TURN)))
    if material:
        add_material(stage, "/m", prim, density=float(material))

    def box(at: Usd.Prim):
        information = UsdPhysics.RigidBodyAPI.MassInformation()
        information.volume, information.inertia = 8.0, Gf.Matrix3f(16 / 3)
        information.localPos, information.localRot = Gf.Vec3f(*boxes[str(at.GetPath())]), Gf.Quatf(1)
        return information

    mass, moments, centre, axes = UsdPhysics.RigidBodyAPI(prim).ComputeMassProperties(box)
    rotation = Rotation.from_quat([axes.GetReal(), *axes.GetImaginary()], scalar_first=True).as_matrix()
    model = compiled(stage)
    close(model.body("b").mass, expected)
    close(mass, expected)
    close(model.body("b").ipos, centre)
    np.testing.assert_allclose(inertia(model, "b"), rotation @ np.diag(moments) @ rotation.T, atol=1e-5 * max(moments))


def test_authored_inertia(tmp_path):
    stage = new_stage(tmp_path)
    api = UsdPhysics.MassAPI(add_body(stage, "/b", scale=(2, 3, 4)))
    api.CreateCenterOfMassAttr((0.1, 0.2, 0.3))
    api.CreatePrincipalAxesAttr(Gf.Quatf(*ODD).GetNormalized())
    model = compiled(stage)
    axes = matrix((0, 0, 0), ODD)[:3, :3]
    close(model.body("b").ipos, [0.2, 0.6, 1.2])  # in the scaled space of the prim
    close(inertia(model, "b"), axes @ np.diag([0.02, 0.03, 0.04]) @ axes.T)


def test_impossible_and_missing_inertias_are_repaired(tmp_path):
    stage = new_stage(tmp_path)
    UsdPhysics.MassAPI(add_body(stage, "/long")).CreateDiagonalInertiaAttr((0.01, 0.01, 0.1))
    UsdPhysics.MassAPI(add_body(stage, "/disc")).CreateDiagonalInertiaAttr(
        (0.7, 0.1, 0.8)
    )  # in float32 the first two add up to less
    for name in ("seen", "bare"):
        UsdPhysics.MassAPI(add_body(stage, f"/{name}", mass=2.0)).CreateDiagonalInertiaAttr((0, 0, 0))
    add_shape(stage, "/seen/box", collides=False)
    model, messages = warned(stage)
    assert messages == [
        "inertias that no body can have were mended: /long",
        "bodies have a mass but neither inertia nor colliders; their visuals count as solid: /seen",
        "bodies have a mass but neither inertia nor geometry; they count as a ball of 0.1 m radius: /bare",
    ]
    close(model.body("long").inertia, 0.04)
    close(model.body("disc").inertia, [0.1, 0.7, 0.8])
    close(model.body("seen").inertia, 2 * 4 / 6)
    close(model.body("bare").inertia, 0.4 * 2 * 0.01)


def test_friction_of_materials(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    values = {
        "both": {"dynamicFriction": 0.3, "staticFriction": 0.6},
        "static": {"staticFriction": 0.7},
        "zero": {"dynamicFriction": 0.0},
        "neither": {"density": 100.0},
    }
    for name, material in values.items():
        add_material(stage, f"/m_{name}", add_shape(stage, f"/b/{name}"), **material)
    add_material(stage, "/all", add_shape(stage, "/b/any"), "", dynamicFriction=0.2)
    add_shape(stage, "/b/none")
    model = compiled(stage)
    frictions = {name: float(model.geom(name).friction[0]) for name in (*values, "any", "none")}
    expected = {"both": 0.3, "static": 0.7, "zero": 0.0, "neither": 1.0, "any": 0.2, "none": 1.0}
    close([frictions[name] for name in expected], list(expected.values()))


def crowd(stage: Usd.Stage, *names: str) -> None:
    """Add overlapping boxes, all of which collide."""
    for i, name in enumerate(names):
        add_body(stage, f"/{name}", (0.01 * i, 0, 0))
        add_shape(stage, f"/{name}/{name}_box")


def test_jointed_bodies_collide_if_the_joint_says_so(tmp_path):
    for collides in (False, True):
        stage = new_stage(tmp_path, f"{collides}.usda")
        crowd(stage, "a", "b", "c")
        add_joint(stage, "/ab", "hinge", ("/a", "/b"), (0.01, 0, 0), collisionEnabled=collides)
        add_joint(stage, "/bc", "hinge", ("/b", "/c"), (0.01, 0, 0))
        assert meetings(compiled(stage)) == {("a", "c")} | ({("a", "b")} if collides else set())


def test_filtered_pairs(tmp_path):
    stage = new_stage(tmp_path)
    crowd(stage, "a", "b", "c", "d")
    add_shape(stage, "/d/second")
    for prim, target in (("/a", "/b"), ("/a/a_box", "/c/c_box"), ("/b", "/d/second")):
        api = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(prim))
        api.CreateFilteredPairsRel().SetTargets([target])
    model, messages = warned(stage)
    assert meetings(model) == {("a", "d"), ("b", "c"), ("b", "d"), ("c", "d")}
    assert messages == ["collision filters were dropped that hold for some colliders of a body only: /b"]


@pytest.mark.parametrize("is_inverted", [False, True])
def test_collision_groups(tmp_path, is_inverted):
    stage = new_stage(tmp_path)
    crowd(stage, "a", "b", "c", "d")
    for name, members, filtered in (("one", "ab", "two"), ("two", "c", "")):
        group = UsdPhysics.CollisionGroup.Define(stage, f"/{name}")
        Usd.CollectionAPI(group.GetPrim(), "colliders").CreateIncludesRel().SetTargets([f"/{m}" for m in members])
        if filtered:
            group.CreateFilteredGroupsRel().SetTargets([f"/{filtered}"])
            group.CreateInvertFilteredGroupsAttr(is_inverted)
    free = {("a", "d"), ("b", "d"), ("c", "d")}
    expected = {("a", "c"), ("b", "c")} if is_inverted else {("a", "b")}
    assert meetings(compiled(stage)) == free | expected


@pytest.mark.parametrize("up", "YZ")
@pytest.mark.parametrize(
    ("direction", "magnitude", "expected"),
    [
        ((0, 0, 0), -math.inf, (0, 0, -9.81)),
        ((0, 0, 0), 300.0, (0, 0, -3.0)),
        ((2, 0, 0), 300.0, (3.0, 0, 0)),
        ((0, 0, 0), 0.0, (0, 0, 0)),
    ],
)
def test_gravity(tmp_path, direction, magnitude, expected, up):
    stage = new_stage(tmp_path, metres=0.01, up=up)
    add_body(stage, "/b")
    scene = UsdPhysics.Scene.Define(stage, "/scene")
    scene.CreateGravityDirectionAttr(direction)
    scene.CreateGravityMagnitudeAttr(magnitude)
    close(compiled(stage).opt.gravity, expected)


def test_dropped_properties_are_named_once(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 3, breakForce=10.0)
    drive = UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j1"), "angular")
    drive.CreateTypeAttr("acceleration")
    drive.CreateStiffnessAttr(1.0)
    UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/j2"), "transX").CreateDampingAttr(1.0)
    stage.GetPrimAtPath("/j2").AddAppliedSchema("PhysxMimicJointAPI:rotX")
    add_body(stage, "/c", (0, 1, 0))
    add_joint(stage, "/cone", "ball", ("/b0", "/c"), (0, 1, 0), coneAngle0Limit=30.0)
    UsdPhysics.RigidBodyAPI(stage.GetPrimAtPath("/c")).CreateVelocityAttr((1, 0, 0))
    UsdPhysics.CollisionAPI.Apply(UsdGeom.Xform.Define(stage, "/c/group").GetPrim())
    UsdGeom.Points.Define(stage, "/c/points")
    UsdGeom.PointInstancer.Define(stage, "/c/swarm")
    add_shape(stage, "/c/swarm/one")
    add_mesh(stage, "/c/triangle", QUAD[:3], [(0, 1, 2)], collides=False)
    add_material(stage, "/m", add_shape(stage, "/c/box"), restitution=0.5)
    add_joint(stage, "/itself", "hinge", ("/c", "/c/box"))
    for name in ("one", "two"):
        UsdPhysics.Scene.Define(stage, f"/{name}")
    _, messages = warned(stage)
    assert sorted(messages) == sorted(
        [
            "joints do not break: their breakForce and breakTorque were dropped: /j1, /j2",
            "drives were dropped whose gains are per mass (type acceleration), which MuJoCo does not have: /j1",
            "drives were dropped that are not along the one degree of freedom of a revolute or prismatic joint: /j2",
            "cone limits of spherical joints were dropped: MuJoCo limits a ball joint's whole angle: /cone",
            "couplings between joints (mimic) were dropped: /j2",
            "initial velocities were dropped: /c",
            "colliders were dropped that are no geometry that MuJoCo has: /c/group",
            "visuals were dropped that are no geometry that MuJoCo has: /c/points, /c/swarm",
            "visual meshes with less than four points were dropped: /c/triangle",
            "restitution of materials was dropped: MuJoCo has none: /m",
            "joints were dropped that join a body to itself, or the world to the world: /itself",
            "physics scenes after the first one were dropped: /two",
        ]
    )
