"""Collision filters apply to the prims that they name, not to bodies nested below."""

import pytest
from pxr import UsdGeom, UsdPhysics
from schema_stages import apply, author
from stages import add_body, add_joint, add_shape, compiled, error_of, meetings, new_stage, warned


def nested(folder, count=6):
    """Return a stage with nested bodies `/b0/b1/b2`… in one place, and their paths."""
    stage, paths = new_stage(folder), [""]
    for i in range(count):
        paths.append(f"{paths[-1]}/b{i}")
        add_body(stage, paths[-1])
        add_shape(stage, f"{paths[-1]}/box{i}", UsdGeom.Cube, size=0.1)
    return stage, paths[1:]


def everyone(count):
    return {(f"b{i}", f"b{j}") for i in range(count) for j in range(i + 1, count)}


def keep_apart(stage, source, *targets):
    UsdPhysics.FilteredPairsAPI.Apply(stage.GetPrimAtPath(source)).CreateFilteredPairsRel().SetTargets(list(targets))


def test_a_bodys_filter_excludes_bodies_nested_below(tmp_path):
    stage, paths = nested(tmp_path)
    keep_apart(stage, paths[0], paths[2], paths[4])
    model = compiled(stage)
    assert meetings(model) == everyone(6) - {("b0", "b2"), ("b0", "b4")}
    assert model.nexclude == 2


def test_a_body_owns_colliders_below_scopes(tmp_path):
    stage, paths = nested(tmp_path, 2)
    add_body(stage, "/c")
    add_shape(stage, "/c/geometry/left/box", UsdGeom.Cube, size=0.1)
    add_shape(stage, "/c/geometry/right", UsdGeom.Cube, size=0.1)
    keep_apart(stage, "/c", paths[1])
    assert meetings(compiled(stage)) == {("b0", "b1"), ("b0", "c")}


def test_a_filter_may_name_colliders(tmp_path):
    stage, paths = nested(tmp_path, 3)
    keep_apart(stage, f"{paths[0]}/box0", f"{paths[1]}/box1")
    assert meetings(compiled(stage)) == everyone(3) - {("b0", "b1")}


def test_an_articulations_filter_covers_all_its_bodies(tmp_path):
    """The root is no body: it represents the bodies below it and those connected to them."""
    stage = new_stage(tmp_path)
    root = UsdGeom.Xform.Define(stage, "/robot").GetPrim()
    UsdPhysics.ArticulationRootAPI.Apply(root)
    for path in ("/robot/b0", "/robot/b1", "/b2", "/b3"):
        add_body(stage, path)
        add_shape(stage, f"{path}/box_of_{path[-2:]}", UsdGeom.Cube, size=0.1)
    add_joint(stage, "/j", "hinge", ("/robot/b1", "/b2"), collisionEnabled=True)
    keep_apart(stage, "/robot", "/b3")
    assert meetings(compiled(stage)) == {("b0", "b1"), ("b0", "b2"), ("b1", "b2")}


def test_the_filter_of_a_root_that_is_a_body_covers_that_body(tmp_path):
    stage, paths = nested(tmp_path, 3)
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath(paths[0]))
    keep_apart(stage, paths[0], paths[2])
    assert meetings(compiled(stage)) == {("b0", "b1"), ("b1", "b2")}


@pytest.mark.parametrize("side", ["source", "target"])
def test_filters_of_other_prims_are_dropped_with_a_warning(tmp_path, side):
    stage, paths = nested(tmp_path, 3)
    UsdGeom.Scope.Define(stage, f"{paths[1]}/visuals")
    ends = (f"{paths[1]}/visuals", paths[0])
    keep_apart(stage, *(ends if side == "source" else ends[::-1]))
    model, messages = warned(stage)
    source = ends[0] if side == "source" else ends[1]
    assert messages == [f"collision filters were dropped of no body, collider or articulation, but {ends[0]}: {source}"]
    assert meetings(model) == everyone(3)


def test_a_filter_of_a_missing_prim_is_refused(tmp_path):
    stage, paths = nested(tmp_path, 1)
    keep_apart(stage, paths[0], "/gone")
    assert error_of(stage) == "/b0: physics:filteredPairs names /gone, which does not exist"


@pytest.mark.parametrize("name", ["newton:selfCollisionEnabled", "physxArticulation:enabledSelfCollisions"])
def test_articulations_without_self_collision(tmp_path, name):
    stage = new_stage(tmp_path)
    for path in ("/b0", "/b1", "/b2", "/c"):
        add_body(stage, path)
        add_shape(stage, f"{path}/box_of_{path[1:]}", UsdGeom.Cube, size=0.1)
    for one, two in (("b0", "b1"), ("b1", "b2")):
        add_joint(stage, f"/{one}{two}", "hinge", (f"/{one}", f"/{two}"))
    UsdPhysics.ArticulationRootAPI.Apply(stage.GetPrimAtPath("/b0"))
    assert meetings(compiled(stage)) == {("b0", "b2"), ("b0", "c"), ("b1", "c"), ("b2", "c")}
    author(stage.GetPrimAtPath("/b0"), name, False)
    assert meetings(compiled(stage)) == {("b0", "c"), ("b1", "c"), ("b2", "c")}


def palm(folder, is_mujocos, **values):
    """Return a palm fixed to the world, its thumb, a shell welded to the thumb, and a tip on the shell."""
    stage = new_stage(folder)
    if is_mujocos:
        apply(UsdPhysics.Scene.Define(stage, "/scene").GetPrim(), "MjcSceneAPI")
    for path in ("/palm", "/thumb", "/shell", "/tip"):
        add_body(stage, path)
        add_shape(stage, f"{path}/box_of_{path[1:]}", UsdGeom.Cube, size=0.1)
    add_joint(stage, "/fixed", "fixed", (None, "/palm"))
    add_joint(stage, "/j0", "hinge", ("/palm", "/thumb"))
    add_joint(stage, "/weld", "fixed", ("/thumb", "/shell"))
    add_joint(stage, "/j1", "hinge", ("/shell", "/tip"), **values)
    return stage


def test_mujocos_scene_filters_parents_like_mujoco(tmp_path):
    """UsdPhysics filters jointed bodies. MuJoCo merges welded bodies, and lets everything touch fixed ones."""
    assert meetings(compiled(palm(tmp_path, False))) >= {("palm", "shell"), ("palm", "tip")}
    stage = palm(tmp_path, True)
    assert meetings(compiled(stage)) == {("palm", "thumb"), ("palm", "shell"), ("palm", "tip")}
    author(stage.GetPrimAtPath("/scene"), "mjc:flag:filterparent", False)
    assert meetings(compiled(stage)) == {
        ("palm", "thumb"),
        ("palm", "shell"),
        ("palm", "tip"),
        ("shell", "tip"),
        ("thumb", "tip"),
    }


def test_a_joints_collision_flag_overrides_mujocos_scene(tmp_path):
    """If one joint's bodies collide, MuJoCo's filter is off; other filtered pairs are listed."""
    stage = palm(tmp_path, True, collisionEnabled=True)
    assert ("shell", "tip") in meetings(compiled(stage))
    add_body(stage, "/nail")
    add_shape(stage, "/nail/box_of_nail", UsdGeom.Cube, size=0.1)
    add_joint(stage, "/j2", "hinge", ("/tip", "/nail"))
    assert ("nail", "tip") not in meetings(compiled(stage))
