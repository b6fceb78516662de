"""Every mistake in a USD stage is reported with its prim."""

import builtins
import math

import pytest
from pxr import Gf, UsdGeom, UsdPhysics
from stages import (
    GENERIC,
    QUAD,
    WEDGE,
    WEDGE_FACES,
    add_body,
    add_joint,
    add_mesh,
    add_shape,
    chain,
    compiled,
    error_of,
    generic,
    new_stage,
    path_of,
)

from tgdsl.errors import RobotError
from tgdsl.formats.usd.reader import usd_to_mjcf


def test_unresolved_references(tmp_path, capfd):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    path_of(stage)
    for text, parts in {
        'def Xform "a" (references = @gone.usda@) {}': ("/a: ", "gone.usda"),
        'def Xform "a" (payload = @gone.usda@) {}': ("/a: ", "gone.usda"),
        'def Xform "a" (references = </gone>) {}': ("/a: ", "/gone"),
        'def Xform "a" {\n  def Xform "c" (references = @robot.usda@</gone>) {}\n}': ("/a/c: ", "/gone"),
    }.items():
        file = tmp_path / "broken.usda"
        file.write_text(f"#usda 1.0\n{text}\n")
        with pytest.raises(RobotError) as caught:
            usd_to_mjcf(file)
        assert str(caught.value).startswith(f"{file}: {parts[0]}")
        assert parts[1] in str(caught.value)
        (tmp_path / "broken.usda").unlink()
    file = tmp_path / "layers.usda"
    file.write_text("#usda 1.0\n(\n  subLayers = [@gone.usda@]\n)\n")
    with pytest.raises(RobotError, match=r"layers\.usda: /: .*gone\.usda"):
        usd_to_mjcf(file)
    assert capfd.readouterr() == ("", "")  # USD prints nothing itself


def test_files_that_are_not_usd(tmp_path):
    (tmp_path / "text.usda").write_text("hello")
    (tmp_path / "broken.usda").write_text('#usda 1.0\ndef Xform "a" {\n')
    (tmp_path / "noise.usdc").write_bytes(bytes(range(200)))
    for name in ("text.usda", "broken.usda", "noise.usdc"):
        with pytest.raises(RobotError, match=rf"{name}: not a USD file: \S"):
            usd_to_mjcf(tmp_path / name)
    with pytest.raises(RobotError, match=r"gone\.usda: there is no such file"):
        usd_to_mjcf(tmp_path / "gone.usda")


def test_a_stage_without_a_robot(tmp_path):
    stage = new_stage(tmp_path)
    add_shape(stage, "/floor")
    assert error_of(stage) == "/: no prim has an enabled PhysicsRigidBodyAPI: there is no robot in it"


@pytest.mark.parametrize("limits", [{}, dict.fromkeys(GENERIC[:4], (1.0, -1.0)), dict.fromkeys(GENERIC[1:3], (1.0, -1.0))])
def test_generic_joints_without_a_mujoco_type_are_refused(tmp_path, limits):
    stage = new_stage(tmp_path)
    generic(stage, limits or {"distance": (0.1, 0.2)})
    free = [dof for dof in GENERIC if dof not in limits]
    assert error_of(stage) == (
        f"/robot/j: a generic joint that leaves {', '.join(free)} free is no single MuJoCo joint (hinge, slide, ball, fixed, free)"
    )


def test_joints_unknown_to_mujoco_are_refused(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2)
    add_joint(stage, "/far", "distance", ("/b0", "/b1"))
    assert error_of(stage) == "/far: PhysicsDistanceJoint is not supported: MuJoCo has no such joint"
    stage.RemovePrim("/far")
    stage.DefinePrim("/gear", "PhysxPhysicsGearJoint")
    hint = "known joints: revolute, prismatic, spherical, fixed, generic"
    assert error_of(stage) == f"/gear: PhysxPhysicsGearJoint is not supported; {hint}"
    stage.RemovePrim("/gear")
    add_joint(stage, "/loop", "slide", ("/b0", "/b1"), (1, 0, 0), excludeFromArticulation=True)
    assert error_of(stage) == "/loop: a prismatic joint closes a loop, for which MuJoCo has no constraint"


def test_invalid_joints_filters_and_gravity_are_refused(tmp_path):
    stage = new_stage(tmp_path)
    chain(stage, 2)
    joint = UsdPhysics.Joint(stage.GetPrimAtPath("/j1"))
    joint.GetBody0Rel().SetTargets(["/gone"])
    assert error_of(stage) == "/j1: physics:body0 names /gone, which does not exist"
    joint.GetBody0Rel().SetTargets(["/b0", "/b1"])
    assert error_of(stage) == "/j1: physics:body0 has 2 targets; expected one at most"
    joint.GetBody0Rel().SetTargets(["/b0"])
    stage.GetPrimAtPath("/b0").SetActive(False)
    assert error_of(stage) == "/j1: physics:body0 names /b0, which does not exist"
    stage.GetPrimAtPath("/b0").SetActive(True)
    joint.GetLocalRot0Attr().Set(Gf.Quatf(0))
    assert error_of(stage) == "/j1: physics:localRot0 is no rotation: (0, 0, 0, 0)"
    joint.GetLocalPos1Attr().Set((math.inf, 0, 0))
    joint.GetLocalRot0Attr().Set(Gf.Quatf(1))
    assert error_of(stage) == "/j1: physics:localPos1 is not finite"
    joint.GetLocalPos1Attr().Set((0, 0, 0))
    joint.GetLocalRot0Attr().Set(Gf.Quatf(1))
    joint.GetPrim().GetAttribute("physics:lowerLimit").Set(10.0)
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(-10.0)
    assert error_of(stage).startswith("/j1: its lower limit 0.17")
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(math.nan)
    assert error_of(stage) == "/j1: physics:upperLimit is not a number"
    joint.GetPrim().GetAttribute("physics:upperLimit").Set(20.0)
    pairs = UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath("/b0")).CreateFilteredPairsRel()
    pairs.SetTargets(["/gone"])
    assert error_of(stage) == "/b0: physics:filteredPairs names /gone, which does not exist"
    pairs.ClearTargets(True)
    UsdPhysics.Scene.Define(stage, "/scene").CreateGravityDirectionAttr((math.inf, 0, 0))
    assert error_of(stage) == "/scene: gravity is not finite"


@pytest.mark.parametrize(
    ("points", "faces", "message"),
    [
        ([], [], "the mesh has no points"),
        (WEDGE, [], "the mesh has no faceVertexCounts"),
        (WEDGE, [(0, 1, 4)], "faceVertexIndices holds 4; the mesh has 4 points"),
        (WEDGE, [(0, 1, -1)], "faceVertexIndices holds -1; the mesh has 4 points"),
        (WEDGE, [(0, 1), (0, 1, 2)], "the mesh has a face with 2 corners; expected 3 or more"),
        ([*WEDGE[:3], (0, 0, math.inf)], WEDGE_FACES, "the mesh has points that are not finite"),
        (QUAD, [(0, 1, 2, 3)], "the mesh is flat: it has no hull to collide; use a plane or a thin box"),
    ],
)
def test_broken_meshes_are_refused(tmp_path, points, faces, message):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    prim = add_mesh(stage, "/b/m", points, faces)
    assert error_of(stage) == f"/b/m: {message}"
    if points == WEDGE and faces:
        UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Set([3, 3])
        assert error_of(stage).startswith("/b/m: ")


def test_flat_meshes_can_be_seen(tmp_path):
    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    add_mesh(stage, "/b/sheet", QUAD, [(0, 1, 2, 3)], collides=False)
    assert compiled(stage).geom("sheet").group == 2


def test_invalid_transforms_are_refused(tmp_path):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b")
    prim.GetAttribute("xformOp:translate").Set(Gf.Vec3d(math.nan, 0, 0))
    assert error_of(stage) == "/b: its transform is not finite"
    prim.GetAttribute("xformOp:translate").Set(Gf.Vec3d(0, 0, 0))
    prim.GetAttribute("xformOp:scale").Set(Gf.Vec3d(1, 0, 1))
    assert error_of(stage) == "/b: its transform is sheared or flat, so that it has no rigid frame"
    prim.GetAttribute("xformOp:scale").Set(Gf.Vec3d(1, 1, 1))
    add_shape(stage, "/b/box", scale=(1, 1, 0))
    assert error_of(stage) == "/b/box: its transform is flat: a scale is zero"


def test_impossible_bodies_are_refused(tmp_path):
    stage = new_stage(tmp_path)
    prim = add_body(stage, "/b", mass=0)
    assert error_of(stage) == "/b: the body can move, but has neither mass nor colliders"
    UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(-1.0)
    assert error_of(stage) == "/b: physics:mass is -1.0; expected 0 or more"
    UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(1.0)
    UsdPhysics.MassAPI.Apply(prim).CreateDiagonalInertiaAttr((1, 1, 1))
    add_shape(stage, "/b/floor", UsdGeom.Plane)
    assert error_of(stage) == "/b/floor: a plane can only belong to the world or to a kinematic body"
    stage.RemovePrim("/b/floor")
    add_shape(stage, "/b/ball", UsdGeom.Sphere, radius=0.0)
    assert error_of(stage) == "/b/ball: radius is 0.0; expected more than 0"


def test_without_usd_core(tmp_path, monkeypatch):
    real = builtins.__import__

    def importing(name, *rest, **keywords):
        if name == "pxr":
            raise ImportError(name)
        return real(name, *rest, **keywords)

    stage = new_stage(tmp_path)
    add_body(stage, "/b")
    path = path_of(stage)
    monkeypatch.setattr(builtins, "__import__", importing)
    with pytest.raises(RobotError, match="pip install usd-core"):
        usd_to_mjcf(path)
