"""Authored values that are not read are named, unless they do not matter to physics."""

from schema_stages import author, relate, schema_stage
from stages import compiled, error_of, path_of, warned


def test_unknown_schemas_and_types_are_named(tmp_path):
    stage = schema_stage(tmp_path)
    stage.GetPrimAtPath("/turn").AddAppliedSchema("NewtonKaminoSceneAPI")
    stage.DefinePrim("/deformable", "NewtonSponge")
    _, messages = warned(stage)
    assert messages == [
        "the API schema NewtonKaminoSceneAPI was dropped: /turn",
        "prims of type NewtonSponge were dropped: /deformable",
    ]


def test_looks_and_bookkeeping_are_ignored(tmp_path):
    stage = schema_stage(tmp_path)
    prim = stage.GetPrimAtPath("/link/ball")
    for name, value in (
        ("primvars:warmth", 1.0),
        ("inputs:roughness", 0.1),
        ("ui:order", 3),
        ("physics:startsAsleep", True),
    ):
        author(prim, name, value)
    relate(prim, "material:binding", ["/rubber"])
    relate(prim, "physics:simulationOwner", ["/scene"])
    compiled(stage)


def test_one_warning_for_each_attribute(tmp_path):
    stage = schema_stage(tmp_path)
    for path in ("/turn", "/rail", "/socket"):
        author(stage.GetPrimAtPath(path), "physxJoint:maxJointVelocity", 5.0)
    _, messages = warned(stage)
    assert messages == ["physxJoint:maxJointVelocity was dropped, which means nothing here: /turn, /rail, /socket"]


def test_wrong_values_are_errors(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/cart/wedge"), "mjc:inertia", "hollow")
    assert error_of(stage) == "/cart/wedge: mjc:inertia is 'hollow'; expected one of legacy, convex, exact, shell"
    assert path_of(stage).exists()
