"""Mimic joints, stacked joints, ranges of ball joints, and masses by MuJoCo's rules."""

import mujoco
import numpy as np
import pytest
from pxr import UsdGeom, UsdPhysics
from schema_stages import apply, author, relate, schema_stage
from stages import (
    WEDGE,
    WEDGE_FACES,
    add_body,
    add_joint,
    add_mesh,
    add_shape,
    close,
    compiled,
    error_of,
    inertia,
    new_stage,
    stage_with_base,
    warned,
    world_pose,
)


def lead_and_follow(folder, kind="hinge"):
    """Return a stage with two joints of a kind on a fixed base."""
    stage = stage_with_base(folder)
    for end in ("lead", "follow"):
        add_body(stage, f"/{end}er")
        add_joint(stage, f"/{end}", kind, ("/base", f"/{end}er"))
    return stage


@pytest.mark.parametrize(("kind", "offset"), [("hinge", np.radians(10.0)), ("slide", 10.0)])
def test_a_follower_is_a_polynomial_of_its_leader(tmp_path, kind, offset):
    """Follower = coef0 + coef1 leader, with coef0 in degrees for hinges; higher coefficients are MuJoCo's."""
    stage = lead_and_follow(tmp_path, kind)
    follower = stage.GetPrimAtPath("/follow")
    apply(follower, "NewtonMimicAPI", "MjcEqualityJointAPI")
    relate(follower, "newton:mimicJoint", ["/lead"])
    for name, value in (("newton:mimicCoef0", 10.0), ("newton:mimicCoef1", -2.0), ("mjc:coef2", 0.3), ("mjc:coef3", 0.4)):
        author(follower, name, value)
    author(follower, "mjc:coef4", 0.5)
    author(follower, "mjc:solref", [0.03, 0.8])
    author(follower, "mjc:solimp", [0.7, 0.9, 0.002, 0.4, 3.0])
    model = compiled(stage)
    assert model.eq_type.tolist() == [mujoco.mjtEq.mjEQ_JOINT]
    assert (model.eq_obj1id[0], model.eq_obj2id[0]) == (model.joint("follow").id, model.joint("lead").id)
    np.testing.assert_allclose(model.eq_data[0, :5], [offset, -2, 0.3, 0.4, 0.5])
    np.testing.assert_allclose(model.eq_solref[0], [0.03, 0.8])
    np.testing.assert_allclose(model.eq_solimp[0], [0.7, 0.9, 0.002, 0.4, 3])
    author(follower, "newton:mimicEnabled", False)
    assert compiled(stage).eq_active0.tolist() == [0]


def test_followers_accept_mujocos_old_names(tmp_path):
    stage = lead_and_follow(tmp_path)
    follower = stage.GetPrimAtPath("/follow")
    apply(follower, "MjcEqualityJointAPI")
    relate(follower, "mjc:target", ["/lead"])
    author(follower, "mjc:coef0", 0.2)
    author(follower, "mjc:coef1", 3.0)
    np.testing.assert_allclose(compiled(stage).eq_data[0, :5], [0.2, 3, 0, 0, 0])


def test_a_leader_outside_the_tree_is_named(tmp_path):
    stage = lead_and_follow(tmp_path)
    apply(stage.GetPrimAtPath("/follow"), "NewtonMimicAPI")
    relate(stage.GetPrimAtPath("/follow"), "newton:mimicJoint", ["/fixed"])
    model, messages = warned(stage)
    assert messages == ["couplings were dropped whose leader or follower is no revolute or prismatic joint: /follow"]
    assert model.neq == 0


@pytest.mark.parametrize("by", ["joint", "articulation"])
def test_joints_between_the_same_bodies_stack(tmp_path, by):
    """Two slides and a hinge in stage order: the pose is their product."""
    stage = stage_with_base(tmp_path)
    add_body(stage, "/puck")
    for name, kind, axis in (("x", "slide", "X"), ("turn", "hinge", "Z"), ("y", "slide", "Y")):
        joint = add_joint(stage, f"/{name}", kind, ("/base", "/puck"), axis=axis)
        if by == "joint":
            apply(joint, "MjcJointAPI")
    if by == "articulation":
        apply(stage.GetPrimAtPath("/base"), "NewtonArticulationRootAPI")
        author(stage.GetPrimAtPath("/base"), "newton:jointsAddMobility", True)
    model = compiled(stage)
    assert [model.joint(i).name for i in range(model.njnt)] == ["x", "turn", "y"]
    assert model.neq == 0
    x, turn, y = 0.3, 0.7, -0.2
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    pose[:2, 3] = np.array([x, 0]) + pose[:2, :2] @ [0, y]
    close(world_pose(model, "puck", [x, turn, y]), pose)


def slid(x, y):
    pose = np.eye(4)
    pose[:2, 3] = x, y
    return pose


def turned(angle):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    return pose


@pytest.mark.parametrize("swapped", [("turn",), ("x",), ("x", "turn"), ("y",), ("x", "turn", "y")])
def test_stacked_joints_may_name_the_two_bodies_in_any_order(tmp_path, swapped):
    """A joint moves body 1 against body 0; the order starts at body 0 of the first joint, whichever is the parent."""
    stage = stage_with_base(tmp_path)
    add_body(stage, "/puck")
    for name, kind, axis in (("x", "slide", "X"), ("turn", "hinge", "Z"), ("y", "slide", "Y")):
        bodies = ("/puck", "/base") if name in swapped else ("/base", "/puck")
        apply(add_joint(stage, f"/{name}", kind, bodies, axis=axis), "MjcJointAPI")
    model = compiled(stage)
    assert model.neq == 0 and model.njnt == 3
    values = {"x": 0.3, "turn": 0.7, "y": -0.2}
    moves = {"x": slid(0.3, 0.0), "turn": turned(0.7), "y": slid(0.0, -0.2)}
    is_back = "x" in swapped  # then the product is the base's pose relative to the puck
    chain = [np.linalg.inv(move) if (name in swapped) != is_back else move for name, move in moves.items()]
    pose = chain[0] @ chain[1] @ chain[2]
    measured = world_pose(model, "puck", [values[model.joint(i).name] for i in range(3)])
    close(measured, np.linalg.inv(pose) if is_back else pose)


@pytest.mark.parametrize("name", ["newton:mimicJoint", "mjc:target"])
def test_a_joint_with_two_leaders_is_refused(tmp_path, name):
    stage = lead_and_follow(tmp_path)
    follower = stage.GetPrimAtPath("/follow")
    apply(follower, "NewtonMimicAPI", "MjcEqualityJointAPI")
    relate(follower, name, ["/lead", "/follow"])
    message = f"/follow: {name} has 2 targets, /lead, /follow; expected one, which it follows"
    assert error_of(stage).endswith(message)


@pytest.mark.parametrize("path", ["/connect", "/weld"])
def test_disabled_constraints_start_inactive(tmp_path, path):
    stage = schema_stage(tmp_path)
    joints = [prim for prim in stage.Traverse() if prim.GetName() == path[1:]]
    joints[0].GetAttribute("physics:jointEnabled").Set(False)
    model = compiled(stage)
    kind = mujoco.mjtEq.mjEQ_WELD if path == "/weld" else mujoco.mjtEq.mjEQ_CONNECT
    assert [bool(active) for active in model.eq_active0] == [
        int(constraint_kind) != int(kind) for constraint_kind in model.eq_type
    ]


def test_the_range_of_a_ball_joint_is_its_cone(tmp_path):
    stage = stage_with_base(tmp_path)
    add_body(stage, "/knob")
    joint = add_joint(stage, "/socket", "ball", ("/base", "/knob"), coneAngle0Limit=40.0, coneAngle1Limit=40.0)
    apply(joint, "MjcJointAPI")
    np.testing.assert_allclose(compiled(stage).joint("socket").range, [0, np.radians(40)])


def test_a_full_inertia_overrules_the_principal_one(tmp_path):
    stage = new_stage(tmp_path)
    body = add_body(stage, "/body")
    apply(body, "NewtonMassAPI")
    author(body, "newton:inertia", [0.03, 0.04, 0.05, 0.001, -0.002, 0.003])
    expected = [[0.03, 0.001, -0.002], [0.001, 0.04, 0.003], [-0.002, 0.003, 0.05]]
    close(inertia(compiled(stage), "body"), np.array(expected))


@pytest.mark.parametrize("schema", [{"newton:massModel": "shell"}, {"mjc:shellinertia": True}], ids=["newton", "mjc"])
@pytest.mark.parametrize("thickness", [None, 0.01])
def test_shells_weigh_by_area_or_thickness(tmp_path, schema, thickness):
    """A spherical shell: 4πr² times its density (per area, or times its thickness), with 2/3 m r²."""
    stage = new_stage(tmp_path)
    add_body(stage, "/body", mass=0)
    ball = add_shape(stage, "/body/ball", UsdGeom.Sphere, radius=0.1)
    UsdPhysics.MassAPI.Apply(ball).CreateDensityAttr(50.0)
    for name, value in schema.items():
        author(ball, name, value)
    if thickness:
        author(ball, "newton:shellThickness", thickness)
    model = compiled(stage)
    mass = 4 * np.pi * 0.01 * 50 * (thickness or 1.0)
    np.testing.assert_allclose(model.body("body").mass, mass, rtol=1e-5)
    np.testing.assert_allclose(model.body("body").inertia, 2 / 3 * mass * 0.01, rtol=1e-5)


@pytest.mark.parametrize("model", ["legacy", "convex", "exact", "shell"])
def test_meshes_weigh_by_mujocos_inertia_option(tmp_path, model):
    """A tetrahedron with edges 3, 2 and 1 m: its volume is 1 m³, and the area of its faces 3 + 1 + 1.5 + 3.5 m²."""
    stage = new_stage(tmp_path)
    add_body(stage, "/body", mass=0)
    mesh = add_mesh(stage, "/body/wedge", np.array(WEDGE), WEDGE_FACES)
    UsdPhysics.MassAPI.Apply(mesh).CreateDensityAttr(2.0)
    apply(mesh, "MjcMeshCollisionAPI")
    author(mesh, "mjc:inertia", model)
    np.testing.assert_allclose(compiled(stage).body("body").mass, 2 * (9 if model == "shell" else 1), rtol=1e-5)


@pytest.mark.parametrize("name", ["mjc:maxhullvert", "newton:maxHullVertices"])
def test_hulls_have_the_given_number_of_corners(tmp_path, name):
    generator = np.random.default_rng(0)
    points = generator.normal(size=(60, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = [tuple(map(int, face)) for face in mujoco_hull(points)]
    stage = new_stage(tmp_path)
    add_body(stage, "/body")
    mesh = add_mesh(stage, "/body/stone", points, faces)
    author(mesh, name, 12)
    model = compiled(stage)
    assert model.mesh_graph[model.mesh_graphadr[0]] == 12


def mujoco_hull(points):
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    outward = np.cross(
        points[hull.simplices[:, 1]] - points[hull.simplices[:, 0]], points[hull.simplices[:, 2]] - points[hull.simplices[:, 0]]
    )
    is_wrong = np.einsum("ij,ij->i", outward, hull.equations[:, :3]) < 0
    return np.where(is_wrong[:, None], hull.simplices[:, ::-1], hull.simplices)


def test_sites_have_the_shape_of_their_gprims(tmp_path):
    stage = schema_stage(tmp_path)
    stage.GetPrimAtPath("/link/site").GetAttribute("radius").Set(0.04)
    model = compiled(stage)
    assert model.site("site").type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
    assert model.site("site").size[0] == 0.04
    assert "site" not in [model.geom(i).name for i in range(model.ngeom)]


def test_equality_constraints_hold_at_the_joint_frames(tmp_path):
    """Joints with MjcEqualityConnectAPI and WeldAPI join bodies of the tree without being part of it."""
    model = compiled(schema_stage(tmp_path))
    assert sorted(model.eq_type.tolist()) == [mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD]
    assert [model.joint(i).name for i in range(model.njnt)] == ["turn", "rail", "socket"]
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.efc_pos[: data.ne], 0, atol=1e-9)
