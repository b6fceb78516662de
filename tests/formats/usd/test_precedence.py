"""If several schemas give a value, the most specific one counts and contradictions are named."""

import math

import numpy as np
import pytest
from schema_stages import PRIMS, author, schema_stage
from stages import compiled, warned

DEGREE = math.radians(1)
REF = [0.03, 0.8]


def turn(array):
    return lambda model: getattr(model, array)[0]


def rail(array):
    return lambda model: getattr(model, array)[1]


def ball(array):
    return lambda model: getattr(model, array)[model.geom("ball").id]


@pytest.mark.parametrize(
    ("where", "names", "field", "expected"),
    [
        ("turn", {"tgdsl:margin": 0.1, "mjc:margin": 0.2}, turn("jnt_margin"), 0.1),
        ("turn", {"mjc:armature": 0.1, "newton:armature": 0.2, "physxJoint:armature": 0.3}, turn("dof_armature"), 0.1),
        ("turn", {"newton:armature": 0.2, "physxJoint:armature": 0.3}, turn("dof_armature"), 0.2),
        ("rail", {"newton:friction": 0.2, "physxJoint:jointFriction": 0.3}, rail("dof_frictionloss"), 0.2),
        ("ball", {"mjc:gap": 0.1, "newton:contactGap": 0.2}, ball("geom_gap"), 0.1),
        ("scene", {"mjc:option:timestep": 0.005, "newton:timeStepsPerSecond": 500}, lambda m: m.opt.timestep, 0.005),
        ("scene", {"mjc:option:iterations": 5, "newton:maxSolverIterations": 7}, lambda m: m.opt.iterations, 5),
    ],
)
def test_the_most_specific_counts_and_contradictions_are_named(tmp_path, where, names, field, expected):
    stage = schema_stage(tmp_path)
    for name, value in names.items():
        author(stage.GetPrimAtPath(PRIMS[where]), name, value)
    model, messages = warned(stage)
    assert field(model) == pytest.approx(expected)
    first, *others = names
    assert messages == [f"{name} was dropped, which contradicts {first}: {PRIMS[where]}" for name in others]


def test_sources_that_agree_are_silent(tmp_path):
    stage = schema_stage(tmp_path)
    for where, name, value in (
        ("scene", "mjc:option:timestep", 0.003),
        ("scene", "newton:timeStepsPerSecond", 333),
        ("turn", "mjc:damping", 0.3),
        ("turn", "newton:damping", float(np.float32(0.3 * DEGREE))),
    ):
        author(stage.GetPrimAtPath(PRIMS[where]), name, value)
    model = compiled(stage)
    assert (model.opt.timestep, turn("dof_damping")(model)) == (0.003, 0.3)


def test_a_colliders_solref_overrides_its_materials_stiffness(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/rubber"), "newton:contactStiffness", 2500.0)
    author(stage.GetPrimAtPath("/link/ball"), "mjc:solref", REF)
    np.testing.assert_allclose(ball("geom_solref")(compiled(stage)), REF)
