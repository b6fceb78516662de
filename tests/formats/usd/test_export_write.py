"""Whole exported stages: units, bodies, masses, collision filters, names, and what USD cannot hold."""

import sys

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics, UsdValidation
from scipy.spatial.transform import Rotation
from usd_exports import SINGLE, TOLERANCE, XHAND1, ZOO, exported, mujoco_poses, named, walk, world_of, world_pose

from tgdsl.errors import RobotError
from tgdsl.formats.robot import export_model, load_model


def test_units_and_default_prim(zoo):
    stage, model = zoo
    assert UsdGeom.GetStageMetersPerUnit(stage) == UsdPhysics.GetStageKilogramsPerUnit(stage) == 1
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/zoo_of_shapes"
    assert stage.GetDefaultPrim().GetAttribute("tgdsl:name").Get() == "zoo of shapes"
    assert stage.GetDefaultPrim().HasAPI(UsdPhysics.ArticulationRootAPI)
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/physicsScene"))
    gravity = scene.GetGravityMagnitudeAttr().Get() * np.array(scene.GetGravityDirectionAttr().Get())
    np.testing.assert_allclose(gravity, model.opt.gravity, rtol=SINGLE)


def test_bodies_are_siblings_at_their_world_poses(pair):
    stage, model = pair
    bodies, poses = named(stage, UsdPhysics.RigidBodyAPI), mujoco_poses(model, model.qpos0)
    assert bodies.keys() == poses.keys()
    for name, prim in bodies.items():
        assert prim.GetParent() == stage.GetDefaultPrim()
        np.testing.assert_allclose(world_pose(prim), poses[name], atol=1e-14)
        assert [str(op.GetTypeName()) for op in UsdGeom.Xformable(prim).GetOrderedXformOps()] == ["double3", "quatd"]


def test_masses_and_inertia_tensors(pair):
    stage, model = pair
    for name, prim in named(stage, UsdPhysics.RigidBodyAPI).items():
        mass, body = UsdPhysics.MassAPI(prim), model.body(name)
        assert mass.GetMassAttr().Get() == pytest.approx(body.mass[0], rel=SINGLE)
        np.testing.assert_allclose(mass.GetCenterOfMassAttr().Get(), body.ipos, rtol=SINGLE)
        if not body.inertia.all():
            assert (
                name == "stand"
                and not mass.GetPrincipalAxesAttr().IsAuthored()
                and not mass.GetDiagonalInertiaAttr().IsAuthored()
            )
            continue
        axes = mass.GetPrincipalAxesAttr().Get()
        turn = Rotation.from_quat([axes.real, *axes.imaginary], scalar_first=True).as_matrix()
        expected_turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
        tensor = turn @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ turn.T
        expected = expected_turn @ np.diag(body.inertia) @ expected_turn.T
        np.testing.assert_allclose(tensor, expected, atol=2 * SINGLE * body.inertia.max(), err_msg=name)


FAMILY = """<mujoco><worldbody>
  <geom name='wall' type='box' size='.1 .1 .1'/>
  <body name='palm'><geom size='.1'/>
    <body name='pad'><geom size='.1'/></body>
    <body name='link1'><joint/><geom size='.1'/>
      <body name='plate'><geom size='.1'/><body name='screw'><geom size='.1'/></body></body>
      <body name='link2'><joint/><geom size='.1'/><body name='nail'><geom size='.1'/></body></body>
    </body>
    <body name='link3'><joint/><geom size='.1'/></body>
  </body>
  <body name='cube'><freejoint/><geom size='.1'/></body>
</worldbody><contact><exclude body1='link3' body2='palm'/><exclude body1='nail' body2='cube'/><exclude body1='world' body2='link1'/></contact></mujoco>"""


@pytest.mark.parametrize("option", ["", "<option><flag filterparent='disable'/></option>"], ids=["default", "parents_collide"])
def test_collision_filters_match_mujoco(tmp_path, option):
    stage, _ = exported(tmp_path, FAMILY.replace("<worldbody>", f"{option}<worldbody>"))
    apart = set()
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.FilteredPairsAPI):
            for target in UsdPhysics.FilteredPairsAPI(prim).GetFilteredPairsRel().GetTargets():
                name = (
                    target.name if target.GetParentPath() == stage.GetDefaultPrim().GetPath() else target.GetParentPath().name
                )
                apart.add(frozenset((prim.GetName(), name)))
        if prim.IsA(UsdPhysics.Joint) and not UsdPhysics.Joint(prim).GetCollisionEnabledAttr().Get():
            rels = UsdPhysics.Joint(prim).GetBody0Rel(), UsdPhysics.Joint(prim).GetBody1Rel()
            apart.add(frozenset(target.name for rel in rels for target in rel.GetTargets()))
    model = load_model(tmp_path / "robot.xml")
    bodies = model.bodies[1:]
    pairs = [(a, b) for a in bodies for b in bodies if a < b]
    assert {frozenset(p) for p in pairs if not model.can_collide(*p)} == {p for p in apart if len(p) == 2 and "world" not in p}
    assert {p for p in apart if "world" in p} == {frozenset(("world", "link1"))}


def test_invalid_and_clashing_names_become_identifiers(tmp_path):
    bodies = "<body name='a/b'><geom name='1st'/></body><body name='a_b'><geom name='a/b'/></body><body name='a b'><geom/><geom/></body>"
    bodies = bodies.replace("<geom", "<geom size='.1'") + "<body name='joints'/><body><geom size='.1'/></body>"
    stage, _ = exported(tmp_path, world_of(bodies))
    root = stage.GetDefaultPrim()
    assert root.GetName() == "MuJoCo_Model"
    bodies_by_name = {
        child.GetName(): child.GetAttribute("tgdsl:name").Get()
        for child in root.GetChildren()
        if child.HasAPI(UsdPhysics.RigidBodyAPI)
    }
    assert bodies_by_name == {"a_b": "a/b", "a_b_1": "a_b", "a_b_2": "a b", "joints_1": "joints", "body_5": None}
    geoms = {
        str(p.GetPath().MakeRelativePath(root.GetPath())): p.GetAttribute("tgdsl:name").Get()
        for p in stage.Traverse()
        if p.IsA(UsdGeom.Gprim)
    }
    assert geoms == {
        "a_b/_st": "1st",
        "a_b_1/a_b": "a/b",
        "a_b_2/sphere": None,
        "a_b_2/sphere_1": None,
        "body_5/sphere": None,
    }


@pytest.mark.parametrize("ending", [".usda", ".usdc", ".usd"])
def test_export_is_repeatable(tmp_path, ending):
    (tmp_path / "robot.xml").write_text(ZOO)
    contents = []
    for name in ("one", "two", "one"):
        export_model(tmp_path / "robot.xml", tmp_path / f"{name}{ending}")
        contents.append((tmp_path / f"{name}{ending}").read_bytes())
    assert contents[0] == contents[1] == contents[2]
    assert contents[0].startswith(b"#usda 1.0" if ending == ".usda" else b"PXR-USDC")
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(["robot.xml", f"one{ending}", f"two{ending}"])


def test_exported_stages_pass_usds_validators(pair):
    stage, _ = pair
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert "usdPhysicsValidators:PhysicsJointChecker" in {validator.GetMetadata().name for validator in validators}
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_urdf_can_be_exported(tmp_path):
    inertial = "<inertial><mass value='1'/><inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' iyz='0'/></inertial>"
    link = "<visual><geometry><box size='.1 .2 .3'/></geometry></visual><collision><geometry><sphere radius='.1'/></geometry></collision>"
    (tmp_path / "arm.urdf").write_text(
        f"<robot name='arm'><link name='base'>{inertial}{link}</link><link name='hand'>{inertial}{link}</link>"
        "<joint name='wrist' type='revolute'><parent link='base'/><child link='hand'/><origin xyz='0 0 1' rpy='.1 .2 .3'/>"
        "<axis xyz='0 1 0'/><limit lower='-1' upper='1' effort='3' velocity='1'/></joint></robot>"
    )
    export_model(tmp_path / "arm.urdf", tmp_path / "arm.usda")
    stage, model = Usd.Stage.Open(str(tmp_path / "arm.usda")), load_model(tmp_path / "arm.urdf").compiled
    assert stage.GetDefaultPrim().GetName() == "arm"
    qpos = np.array([0.4])
    np.testing.assert_allclose(walk(stage, model, qpos)["hand"], mujoco_poses(model, qpos)["hand"], atol=TOLERANCE)


HINGES = "<body name='knot'><joint axis='1 0 0'/><joint axis='0 1 0'/><geom size='.1'/></body>"


@pytest.mark.parametrize(
    ("text", "out", "message"),
    [
        (
            world_of(HINGES),
            "r.usda",
            '{file}: body "knot" has 2 joints, and a body in USD has one to its parent; give each joint a separate body',
        ),
        (
            world_of(
                "<geom name='hill' type='hfield' hfield='h'/>", asset="<hfield name='h' nrow='3' ncol='3' size='1 1 .1 .1'/>"
            ),
            "r.usda",
            '{file}: geom "hill" of body world is of type hfield, which USD does not have',
        ),
        (world_of("<geom size='.1'/>"), "r.obj", "{out}: USD files end in .usda, .usdc, .usd"),
        (world_of("<geom size='.1'/>"), "nowhere/r.usda", "{out}: cannot be written: No such file or directory"),
    ],
    ids=["joints", "hfield", "ending", "folder"],
)
def test_models_that_cannot_be_exported_are_refused(tmp_path, text, out, message):
    (tmp_path / "robot.xml").write_text(text)
    with pytest.raises(RobotError) as caught:
        export_model(tmp_path / "robot.xml", tmp_path / out)
    assert str(caught.value) == message.format(file=tmp_path / "robot.xml", out=tmp_path / out)
    assert [file.name for file in tmp_path.iterdir()] == ["robot.xml"]


def test_without_usd_core(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(RobotError, match="pip install usd-core"):
        export_model(XHAND1, tmp_path / "hand.usda")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    exported(tmp_path, world_of("<geom size='.1'/>"))
    old_content = (tmp_path / "robot.usda").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    with pytest.raises(RobotError) as caught:
        export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert str(caught.value) == f"{tmp_path / 'robot.usda'}: cannot be written: No space left on device"
    assert (tmp_path / "robot.usda").read_bytes() == old_content
    assert sorted(file.name for file in tmp_path.iterdir()) == ["robot.usda", "robot.xml"]


TWO = "<body name='a'><joint name='j' {joint}/><geom size='.1'/></body><body name='b' pos='1 0 0'><joint name='k' type='ball'/><geom size='.1'/></body>"


@pytest.mark.parametrize(
    ("bodies", "rest", "messages"),
    [
        (
            "<body name='a'><freejoint name='f'/><geom size='.1'/></body>",
            "<actuator><motor name='m' joint='f'/></actuator>",
            ['actuator "m" is on what USD has no prim for (a free joint): left out'],
        ),
        (
            TWO,
            "<equality><connect body1='a' body2='b' anchor='0 0 0'/><weld body1='a' body2='b'/></equality><sensor><clock/></sensor>"
            "<tendon><fixed><joint joint='j' coef='1'/></fixed></tendon><keyframe><key time='1'/></keyframe>",
            ["USD holds no sensors: 1 left out"],
        ),
        (TWO.replace("{joint}", "stiffness='2 1'"), "", ["USD holds no polynomial springs and dampers: 1 left out"]),
        (
            "<body name='a'><joint/><geom size='.1'/><body name='dummy'/></body>",
            "",
            ["USD takes a mass of 0 for one that is not given: dummy"],
        ),
        (
            "<geom name='egg' type='ellipsoid' size='.1 .2 .3'/>",
            "",
            ["USD's physics has no ellipsoids, and leaves out or rounds: egg"],
        ),
        (
            "<body name='shelf'><geom type='plane' size='1 1 1'/></body>",
            "",
            ["USD's physics has no planes on bodies, and leaves out: unnamed geom 0"],
        ),
    ],
    ids=["free", "kinds", "springs", "massless", "ellipsoid", "plane"],
)
def test_left_out_parts_are_named(tmp_path, bodies, rest, messages):
    (tmp_path / "robot.xml").write_text(world_of(bodies.replace("{joint}", ""), rest))
    with pytest.warns(UserWarning, match="robot.xml: ") as caught:
        export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert [str(warning.message) for warning in caught] == [f"{tmp_path / 'robot.xml'}: {message}" for message in messages]
    assert (tmp_path / "robot.usda").exists()
