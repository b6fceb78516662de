"""Every attribute of the schemas of MjcPhysics and Newton reaches the compiled model or is named in a warning.

The tables are the schemas' lists of attributes (MjcPhysics in mujoco-usd-converter 0.8, newton-usd-schemas 0.6). Expected
values follow MJCF's documentation of the attribute with the same name, and the schemas' units.
"""

import math
from collections import Counter, defaultdict
from contextlib import contextmanager

import mujoco
import numpy as np
import pytest
from schema_stages import PRIMS, author, schema_stage
from stages import compiled, warned

from tgdsl.scene.compare import differing_fields

DEGREE = math.radians(1)
REF, IMP = [0.03, 0.8], [0.7, 0.9, 0.002, 0.4, 3.0]
SEVEN = [0.0, 0.0, 7.0]
OPTIONS = {
    "actuatorgroupdisable": ((1, 3), "disableactuator", 0b1010),
    "ccd_iterations": (17, "ccd_iterations", 17),
    "ccd_tolerance": (1e-5, "ccd_tolerance", 1e-5),
    "cone": ("elliptic", "cone", 1),
    "density": (1.5, "density", 1.5),
    "impratio": (3.0, "impratio", 3.0),
    "integrator": ("implicitfast", "integrator", 3),
    "iterations": (33, "iterations", 33),
    "jacobian": ("sparse", "jacobian", 1),
    "ls_iterations": (11, "ls_iterations", 11),
    "ls_tolerance": (0.05, "ls_tolerance", 0.05),
    "magnetic": ((0.0, 1.0, 2.0), "magnetic", [0, 1, 2]),
    "noslip_iterations": (4, "noslip_iterations", 4),
    "noslip_tolerance": (1e-5, "noslip_tolerance", 1e-5),
    "o_friction": ([0.9, 0.8, 0.01, 0.001, 0.002], "o_friction", [0.9, 0.8, 0.01, 0.001, 0.002]),
    "o_margin": (0.004, "o_margin", 0.004),
    "o_solimp": (IMP, "o_solimp", IMP),
    "o_solref": (REF, "o_solref", REF),
    "sdf_initpoints": (30, "sdf_initpoints", 30),
    "sdf_iterations": (7, "sdf_iterations", 7),
    "solver": ("cg", "solver", 1),
    "timestep": (0.004, "timestep", 0.004),
    "tolerance": (1e-6, "tolerance", 1e-6),
    "viscosity": (0.1, "viscosity", 0.1),
    "wind": ((1.0, 2.0, 3.0), "wind", [1, 2, 3]),
}
DISABLED = ("actuation", "autoreset", "clampctrl", "constraint", "contact", "damper", "equality", "eulerdamp", "filterparent")
DISABLED += ("frictionloss", "gravity", "island", "limit", "midphase", "multiccd", "nativeccd", "refsafe", "sensor", "spring")
DISABLED += ("warmstart",)
ENABLED = ("energy", "fwdinv", "invdiscrete", "override")


def of(array, kind, name):
    """Return a reader of an array at a named element; for a joint, at its first degree of freedom."""

    def read(model):
        index = getattr(model, kind)(name).id
        return getattr(model, array)[model.jnt_dofadr[index] if array.startswith("dof_") else index]

    return read


def turn(array):
    return of(array, "joint", "turn")


def rail(array):
    return of(array, "joint", "rail")


def ball(array):
    return of(array, "geom", "ball")


def motor(array):
    return of(f"actuator_{array}", "actuator", "motor")


def tendon(array):
    return of(f"tendon_{array}", "tendon", "tendon")


def ten(*first):
    return [*first, *[0.0] * (10 - len(first))]


SEEN = [
    *(("scene", f"mjc:option:{n}", value, lambda m, f=f: getattr(m.opt, f), want) for n, (value, f, want) in OPTIONS.items()),
    *(
        (
            "scene",
            f"mjc:flag:{n}",
            False,
            lambda m, n=n: m.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{n.upper()}") != 0,
            True,
        )
        for n in DISABLED
    ),
    *(
        (
            "scene",
            f"mjc:flag:{n}",
            True,
            lambda m, n=n: m.opt.enableflags & getattr(mujoco.mjtEnableBit, f"mjENBL_{n.upper()}") != 0,
            True,
        )
        for n in ENABLED
    ),
    ("scene", "mjc:compiler:setTotalMass", 9.0, lambda m: m.body_mass.sum(), 9.0),
    ("scene", "mjc:compiler:boundMass", 2.0, lambda m: m.body_mass[1:], [2.0] * 4),
    ("scene", "mjc:compiler:boundInertia", 0.035, lambda m: np.sort(m.body_inertia[1]), [0.035, 0.035, 0.04]),
    ("scene", "newton:timeStepsPerSecond", 250, lambda m: m.opt.timestep, 0.004),
    ("scene", "newton:maxSolverIterations", 12, lambda m: m.opt.iterations, 12),
    ("scene", "newton:gravityEnabled", False, lambda m: m.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY != 0, True),
    ("root", "newton:selfCollisionEnabled", False, lambda m: m.nexclude, 4),
    ("turn", "mjc:armature", 0.2, turn("dof_armature"), 0.2),
    ("turn", "mjc:damping", 0.3, turn("dof_damping"), 0.3),
    ("turn", "mjc:frictionloss", 0.4, turn("dof_frictionloss"), 0.4),
    ("turn", "mjc:margin", 0.05, turn("jnt_margin"), 0.05),
    ("turn", "mjc:ref", 20.0, lambda m: m.qpos0[0], 20 * DEGREE),
    ("rail", "mjc:ref", 0.2, lambda m: m.qpos0[1], 0.2),
    ("turn", "mjc:springref", 30.0, lambda m: m.qpos_spring[0], 30 * DEGREE),
    ("turn", "mjc:stiffness", 2.5, turn("jnt_stiffness"), 2.5),
    ("turn", "mjc:springdamper", [0.1, 1.0], lambda m: turn("jnt_stiffness")(m) > 0 and turn("dof_damping")(m) > 0, True),
    ("turn", "mjc:group", 3, turn("jnt_group"), 3),
    ("turn", "mjc:solreflimit", REF, turn("jnt_solref"), REF),
    ("turn", "mjc:solimplimit", IMP, turn("jnt_solimp"), IMP),
    ("turn", "mjc:solreffriction", REF, turn("dof_solref"), REF),
    ("turn", "mjc:solimpfriction", IMP, turn("dof_solimp"), IMP),
    ("turn", "mjc:actuatorgravcomp", True, turn("jnt_actgravcomp"), 1),
    ("turn", "mjc:actuatorfrcrange:max", 4.0, turn("jnt_actfrcrange"), [0, 4]),
    ("turn", "mjc:actuatorfrcrange:min", -4.0, turn("jnt_actfrcrange"), [-4, 0]),
    ("turn", "newton:armature", 0.2, turn("dof_armature"), 0.2),
    ("turn", "newton:damping", 0.3, turn("dof_damping"), 0.3 / DEGREE),
    ("rail", "newton:damping", 0.3, rail("dof_damping"), 0.3),
    ("socket", "newton:damping", 0.3, of("dof_damping", "joint", "socket"), 0.3 / DEGREE),
    ("turn", "newton:friction", 0.4, turn("dof_frictionloss"), 0.4),
    ("link", "mjc:body:gravcomp", 0.5, of("body_gravcomp", "body", "link"), 0.5),
    ("ball", "mjc:condim", 4, ball("geom_condim"), 4),
    ("ball", "mjc:gap", 0.02, ball("geom_gap"), 0.02),
    ("ball", "mjc:margin", 0.03, ball("geom_margin"), 0.03),
    ("ball", "mjc:group", 4, ball("geom_group"), 4),
    ("ball", "mjc:priority", 2, ball("geom_priority"), 2),
    ("ball", "mjc:solmix", 0.3, ball("geom_solmix"), 0.3),
    ("ball", "mjc:solref", REF, ball("geom_solref"), REF),
    ("ball", "mjc:solimp", IMP, ball("geom_solimp"), IMP),
    ("ball", "newton:contactMargin", 0.03, ball("geom_margin"), 0.03),
    ("ball", "newton:contactGap", 0.02, ball("geom_gap"), 0.02),
    ("seen", "mjc:group", 1, of("geom_group", "geom", "seen"), 1),
    ("site", "mjc:group", 4, of("site_group", "site", "site"), 4),
    ("rubber", "mjc:torsionalfriction", 0.02, ball("geom_friction"), [0.5, 0.02, 0.0001]),
    ("rubber", "mjc:rollingfriction", 0.003, ball("geom_friction"), [0.5, 0.005, 0.003]),
    ("rubber", "newton:torsionalFriction", 0.02, ball("geom_friction"), [0.5, 0.02, 0.0001]),
    ("rubber", "newton:rollingFriction", 0.003, ball("geom_friction"), [0.5, 0.005, 0.003]),
    ("connect", "mjc:solref", REF, of("eq_solref", "equality", "connect"), REF),
    ("connect", "mjc:solimp", IMP, of("eq_solimp", "equality", "connect"), IMP),
    ("connect", "physics:jointEnabled", False, of("eq_active0", "equality", "connect"), 0),
    ("weld", "mjc:solref", REF, of("eq_solref", "equality", "weld"), REF),
    ("weld", "mjc:solimp", IMP, of("eq_solimp", "equality", "weld"), IMP),
    ("weld", "mjc:torqueScale", 3.0, lambda m: m.equality("weld").data[10], 3.0),
    ("motor", "mjc:actEarly", True, motor("actearly"), 1),
    ("motor", "mjc:biasPrm", [1.0, -2.0, -3.0], motor("biasprm"), ten(1, -2, -3)),
    ("motor", "mjc:biasType", "affine", motor("biastype"), 1),
    ("motor", "mjc:ctrlRange:max", 2.0, motor("ctrlrange"), [0, 2]),
    ("motor", "mjc:ctrlRange:min", -2.0, motor("ctrlrange"), [-2, 0]),
    ("motor", "mjc:dynPrm", [0.3], motor("dynprm"), ten(0.3)),
    ("motor", "mjc:dynType", "filter", motor("dyntype"), 2),
    ("motor", "mjc:forceRange:max", 2.0, motor("forcerange"), [0, 2]),
    ("motor", "mjc:forceRange:min", -2.0, motor("forcerange"), [-2, 0]),
    ("motor", "mjc:gainPrm", [5.0, 1.0], motor("gainprm"), ten(5, 1)),
    ("motor", "mjc:gainType", "affine", motor("gaintype"), 1),
    ("motor", "mjc:gear", [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], motor("gear"), [2, 0, 0, 0, 0, 0]),
    ("motor", "mjc:group", 3, motor("group"), 3),
    ("motor", "mjc:lengthRange:max", 2.0, motor("lengthrange"), [0, 2]),
    ("motor", "mjc:lengthRange:min", -2.0, motor("lengthrange"), [-2, 0]),
    ("motor", "mjc:jointInParent", True, motor("trntype"), 1),
    ("servo", "newton:kd", 2.0, of("actuator_biasprm", "actuator", "servo"), ten(0, -10, -2)),
    ("servo", "newton:constEffort", 2.0, of("actuator_biasprm", "actuator", "servo"), ten(2, -10)),
    ("servo", "newton:maxEffort", 2.0, of("actuator_forcerange", "actuator", "servo"), [-2, 2]),
    ("tendon", "mjc:armature", 0.2, tendon("armature"), 0.2),
    ("tendon", "mjc:damping", 0.2, tendon("damping"), 0.2),
    ("tendon", "mjc:frictionloss", 0.2, tendon("frictionloss"), 0.2),
    ("tendon", "mjc:stiffness", 0.2, tendon("stiffness"), 0.2),
    ("tendon", "mjc:springlength", [0.1, 0.3], tendon("lengthspring"), [0.1, 0.3]),
    ("tendon", "mjc:group", 2, tendon("group"), 2),
    ("tendon", "mjc:margin", 0.01, tendon("margin"), 0.01),
    ("tendon", "mjc:range:max", 2.0, tendon("range"), [0, 2]),
    ("tendon", "mjc:range:min", -2.0, tendon("range"), [-2, 0]),
    ("tendon", "mjc:actuatorfrcrange:max", 2.0, tendon("actfrcrange"), [0, 2]),
    ("tendon", "mjc:actuatorfrcrange:min", -2.0, tendon("actfrcrange"), [-2, 0]),
    ("tendon", "mjc:solreflimit", REF, tendon("solref_lim"), REF),
    ("tendon", "mjc:solimplimit", IMP, tendon("solimp_lim"), IMP),
    ("tendon", "mjc:solreffriction", REF, tendon("solref_fri"), REF),
    ("tendon", "mjc:solimpfriction", IMP, tendon("solimp_fri"), IMP),
    ("tendon", "mjc:path:coef", [2.0, -3.0], lambda m: m.wrap_prm[:2], [2, -3]),
    ("tendon", "mjc:path:indices", (1, 0), lambda m: m.wrap_objid[:2], [1, 0]),
    ("cable", "mjc:width", 0.01, of("tendon_width", "tendon", "cable"), 0.01),
    ("key", "mjc:qpos", [0.1, 0.2, 1.0, 0.0, 0.0, 0.0], lambda m: m.key("key").qpos, [0.1, 0.2, 1, 0, 0, 0]),
    ("key", "mjc:qvel", [0.1, 0.2, 0.3, 0.4, 0.5], lambda m: m.key("key").qvel, [0.1, 0.2, 0.3, 0.4, 0.5]),
    ("key", "mjc:ctrl", [0.1, 0.2], lambda m: m.key("key").ctrl, [0.1, 0.2]),
]
LIMITED = [("turn", "actuatorfrc", "jnt_actfrclimited"), ("motor", "ctrl", "actuator_ctrllimited")]
LIMITED += [("motor", "force", "actuator_forcelimited"), ("tendon", "", "tendon_limited")]
LIMITED += [("tendon", "actuatorfrc", "tendon_actfrclimited")]
WARNED = {
    "scene": {
        "mjc:compiler:inertiaFromGeom": "true",
        "mjc:compiler:inertiaGroupRange:min": 2,
        "newton:xpbd:softBodyRelaxation": 0.5,
        "newton:kamino:padmm:primalTolerance": 1e-5,
        "newton:vbd:rigid:contactHistory": True,
        "newton:mpm:tolerance": 1e-3,
    },
    "turn": {"newton:velocityLimit": 3.0, "newton:limitStiffness": 100.0, "newton:limitDamping": 1.0},
    "ball": {
        "newton:sdfMaxResolution": 32,
        "newton:sdfTargetVoxelSize": 0.01,
        "newton:sdfNarrowBandInner": -0.2,
        "newton:sdfNarrowBandOuter": 0.2,
        "newton:sdfTextureFormat": "uint8",
        "newton:sdfPadding": 0.1,
        "newton:hydroelasticEnabled": True,
        "newton:hydroelasticStiffness": 1e9,
        "mjc:unheard": 1.0,
    },
    "rubber": {
        "newton:contactStiffness": 2500.0,
        "newton:contactDamping": 100.0,
        "newton:contactFrictionGain": 10.0,
        "newton:contactAdhesion": 0.1,
        "newton:mpm:youngsModulus": 1e5,
        "newton:curvesBendDamping": 1.0,
    },
    "servo": {
        "newton:delaySteps": 2,
        "newton:ki": 1.0,
        "newton:integralMax": 1.0,
        "newton:modelPath": "net.pt",
        "newton:maxMotorEffort": 1.0,
        "newton:saturationEffort": 1.0,
        "newton:velocityLimit": 1.0,
        "newton:lookupPositions": [0.0, 1.0],
        "newton:lookupEfforts": [1.0, 2.0],
    },
}
SILENT = {
    "scene": {
        "mjc:compiler:alignFree": False,
        "mjc:compiler:angle": "degree",
        "mjc:compiler:autoLimits": True,
        "mjc:compiler:balanceInertia": True,
        "mjc:compiler:fitAABB": True,
        "mjc:compiler:fuseStatic": False,
        "mjc:compiler:inertiaFromGeom": "auto",
        "mjc:compiler:inertiaGroupRange:max": 5,
        "mjc:compiler:saveInertial": True,
        "mjc:compiler:useThread": False,
        "newton:maxSolverIterations": -1,
    },
    "root": {"newton:jointsAddMobility": True},
    "turn": {"newton:velocityLimit": math.inf, "newton:limitStiffness": -math.inf},
    "ball": {"newton:contactGap": -math.inf},
    "mesh": {"newton:maxHullVertices": -1},
    "rubber": {"newton:contactStiffness": -math.inf, "newton:contactAdhesion": -math.inf},
    "motor": {"mjc:crankLength": 0.0, "mjc:actDim": -1, "mjc:inheritRange": 0.0},
    "tendon": {"mjc:group": 0},
    "cable": {"mjc:path:segments": (0, 0, 0), "mjc:path:divisors": [1.0], "mjc:type": "spatial"},
}


def flat(table):
    return [(where, name, value) for where, rows in table.items() for name, value in rows.items()]


@pytest.fixture(scope="module")
def stage(tmp_path_factory):
    """Return the stage without any of the attributes."""
    return schema_stage(tmp_path_factory.mktemp("stage"))


@pytest.fixture(scope="module")
def plain(stage):
    """Return the model of the stage."""
    return compiled(stage)


@contextmanager
def authored(stage, rows):
    """Set attributes of the stage temporarily, from rows of prim, name and value."""
    prims = [(stage.GetPrimAtPath(PRIMS[where]), name, value) for where, name, value in rows]
    for prim, name, value in prims:
        author(prim, name, value)
    try:
        yield
    finally:
        for prim, name, _ in prims:
            prim.RemoveProperty(name)


def in_rounds(rows):
    """Split rows into rounds of one attribute per prim, except all options in the first and all flags in the second."""
    rounds, following = defaultdict(list), Counter(scene=2)
    for row in rows:
        where, name = row[:2]
        group = name.split(":")[1]
        if group in ("option", "flag"):
            rounds[("option", "flag").index(group)].append(row)
        else:
            rounds[following[where]].append(row)
            following[where] += 1
    return rounds.values()


def test_each_attribute_of_the_schemas_sets_its_field(stage, plain, subtests):
    """Warnings are errors, so no attribute causes one."""
    with authored(stage, [("key", "mjc:ctrl", [0.0, 0.0])]):
        with_key = compiled(stage)
    for rows in in_rounds(SEEN):
        with authored(stage, [row[:3] for row in rows]):
            model = compiled(stage)
        for where, name, _, field, expected in rows:
            with subtests.test(where=where, name=name):
                assert not np.array_equal(field(with_key if where == "key" else plain), expected)  # not the default
                np.testing.assert_allclose(field(model), expected, rtol=1e-6)


@pytest.mark.parametrize("is_auto", [True, False], ids=["auto", "explicit"])
def test_limits_follow_the_compilers_autolimits(tmp_path, is_auto):
    """As in MJCF: with `auto`, `autoLimits` decides whether a range suffices; `true` and `false` are explicit."""
    expected = {("auto", True): 1, ("auto", False): 0, ("true", False): 1, ("false", True): 0}
    for (token, is_autolimited), limited in expected.items():
        stage = schema_stage(tmp_path, f"{token}_{is_autolimited}.usda")
        author(stage.GetPrimAtPath("/scene"), "mjc:compiler:autoLimits", is_autolimited)
        for where, name, _ in LIMITED:
            prim = stage.GetPrimAtPath(PRIMS[where])
            flag, span = [f"{name}Limited", f"{name}Range"] if where == "motor" else [f"{name}limited", f"{name}range"]
            author(prim, f"mjc:{span}:min", -1.0)
            author(prim, f"mjc:{span}:max", 1.0)
            if not is_auto or token != "auto":
                author(prim, f"mjc:{flag}", token)
        model = compiled(stage)
        assert {array: getattr(model, array)[0] for *_, array in LIMITED} == {array: limited for *_, array in LIMITED}


def test_a_warning_names_each_attribute_that_is_not_read(stage):
    """Attributes of one group may share a warning; no warning is about anything else."""
    rows = flat(WARNED)
    with authored(stage, rows):
        _, messages = warned(stage)

    def is_about(message, where, name):
        return (name in message or name.rpartition(":")[0] in message) and message.endswith(PRIMS[where])

    assert [row for row in rows if not any(is_about(message, *row[:2]) for message in messages)] == []
    assert [message for message in messages if not any(is_about(message, *row[:2]) for row in rows)] == []


def test_default_values_change_nothing(stage, plain):
    with authored(stage, flat(SILENT)):
        assert differing_fields(plain, compiled(stage)) == []


def test_newtons_values_have_the_stages_units(tmp_path):
    """A stage in centimetres: lengths shrink by 100, torques by 10⁴; damping is per degree."""
    stage = schema_stage(tmp_path, metres=0.01)
    for where, name, value in (
        ("turn", "newton:damping", 3.0),
        ("rail", "newton:damping", 3.0),
        ("turn", "newton:armature", 2.0),
        ("rail", "newton:armature", 2.0),
        ("turn", "newton:friction", 5.0),
        ("rail", "newton:friction", 5.0),
        ("ball", "newton:contactMargin", 0.5),
        ("rubber", "newton:torsionalFriction", 0.5),
        ("servo", "newton:maxEffort", 7.0),
    ):
        author(stage.GetPrimAtPath(PRIMS[where]), name, value)
    model = compiled(stage)
    np.testing.assert_allclose(model.dof_damping[:2], [3e-4 / DEGREE, 3.0])
    np.testing.assert_allclose(model.dof_armature[:2], [2e-4, 2.0])
    np.testing.assert_allclose(model.dof_frictionloss[:2], [5e-4, 0.05])
    np.testing.assert_allclose(ball("geom_margin")(model), 0.005)
    np.testing.assert_allclose(ball("geom_friction")(model)[1], 0.005)
    np.testing.assert_allclose(model.actuator("servo").gainprm[0], 10.0)
    np.testing.assert_allclose(model.actuator("servo").forcerange, [-0.07, 0.07])


def test_angles_have_the_compilers_unit(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/scene"), "mjc:compiler:angle", "radian")
    for name in ("mjc:ref", "mjc:springref"):
        author(stage.GetPrimAtPath("/turn"), name, 0.25)
    model = compiled(stage)
    assert (model.qpos0[0], model.qpos_spring[0]) == (0.25, 0.25)


def test_newtons_default_time_step_applies_to_its_scenes(tmp_path):
    """Writers omit defaults: 1000 steps per second with NewtonSceneAPI, otherwise MuJoCo's 0.002 s."""
    for is_named, expected in ((False, 0.002), (True, 0.001)):
        stage = schema_stage(tmp_path, f"{is_named}.usda")
        if is_named:
            stage.GetPrimAtPath("/scene").AddAppliedSchema("NewtonSceneAPI")
        assert compiled(stage).opt.timestep == expected
