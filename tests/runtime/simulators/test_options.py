"""MuJoCo's options by name act like the same options in the scene's XML, on both simulators and in every variant."""

import mujoco
import numpy as np
import pytest
from warp_cases import SCENE, module, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.scene.options import set_options

BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
OPTIONS = {"timestep": 0.004, "cone": "pyramidal", "iterations": 7, "gravity": [0.5, 0, -3], "impratio": 2}
WRITTEN = '<option timestep="0.004" cone="pyramidal" iterations="7" gravity=".5 0 -3" impratio="2" integrator="implicitfast"/>'
VARIANTS = {"variants": [{"type": "box", "size": [0.02] * 3}, {"type": "sphere", "size": [0.02]}]}


@BOTH
@pytest.mark.parametrize("target", [None, VARIANTS], ids=["one", "variants"])
def test_options_act_like_those_in_the_scene(tmp_path, simulator, target):
    sim = simulator(module(tmp_path, target=target), 3, options=OPTIONS, substeps=2, keyframe="home")
    text = SCENE.replace('<option timestep="0.002" cone="elliptic" impratio="10" integrator="implicitfast"/>', WRITTEN)
    assert text != SCENE
    expected = simulator(module(tmp_path, text, target=target), 3, substeps=2, keyframe="home")
    assert sim.control_step == expected.control_step == 0.008
    for _ in range(5):
        sim.step(np.array([0.1, -0.2]))
        expected.step(np.array([0.1, -0.2]))
    np.testing.assert_array_equal(sim.qpos.numpy(), expected.qpos.numpy())
    assert sim.env_model(1).opt.iterations == 7


@BOTH
@pytest.mark.parametrize("target", [None, VARIANTS], ids=["one", "variants"])
def test_stiffness_options_act_like_those_in_the_scene(tmp_path, simulator, target):
    """For all geoms, including variants; stiffer contacts change the motion."""
    options = {"solref": [0.01, 0.8], "solimp": [0.95, 0.99, 0.002, 0.4, 3]}
    text = SCENE.replace("<worldbody>", '<default><geom solref=".01 .8" solimp=".95 .99 .002 .4 3"/></default><worldbody>', 1)
    assert text != SCENE
    sims = [
        simulator(module(tmp_path, scene, target=target), 3, options=with_options, keyframe="home", substeps=2)
        for scene, with_options in ((SCENE, options), (text, None), (SCENE, None))
    ]
    for _ in range(20):
        for sim in sims:
            sim.step(np.array([0.1, -0.2]))
    with_options, in_scene, without = (sim.qpos.numpy() for sim in sims)
    np.testing.assert_array_equal(with_options, in_scene)
    assert not np.array_equal(with_options, without)
    for model in (sims[0].env_model(1), sims[0].env_model(2)):
        assert (model.geom_solref == [0.01, 0.8]).all() and (model.geom_solimp == options["solimp"]).all()


def test_stiffness_options_apply_to_pairs():
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><geom name="a" size="1"/><body><joint/><geom name="b" size="1"/></body></worldbody>'
        '<contact><pair geom1="a" geom2="b"/></contact></mujoco>'
    )
    set_options(spec, {"solref": (-100, -1)})
    model = spec.compile()
    assert (model.pair_solref == [-100, -1]).all() and (model.geom_solref == [-100, -1]).all()


def test_a_time_constant_below_two_timesteps_is_refused_unless_refsafe_is_off():
    """MuJoCo would raise it to two timesteps."""
    spec = mujoco.MjSpec()
    with pytest.raises(SimulationError, match=r"option solref is \[0.009, 1\], expected a time constant of at least 0.01 s"):
        set_options(spec, {"timestep": 0.005, "solref": [0.009, 1]})
    assert spec.option.timestep == 0.002
    set_options(spec, {"timestep": 0.005, "solref": [0.01, 1]})
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_REFSAFE
    set_options(spec, {"solref": [0.001, 1]})


@pytest.mark.parametrize("given", ["elliptic", "Elliptic", int(mujoco.mjtCone.mjCONE_ELLIPTIC)])
def test_a_keyword_may_be_given_as_its_number(given):
    spec = mujoco.MjSpec()
    set_options(spec, {"cone": given})
    assert spec.option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC


def test_an_artefact_keeps_its_own_options(tmp_path):
    touch = module(tmp_path)
    tgdsl.simulate(touch, 1, options={"timestep": 0.01}).close()
    assert tgdsl.simulate(touch, 1).control_step == 0.002


@BOTH
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"timestp": 1}, 'MuJoCo has no option "timestp"; did you mean "timestep"?'),
        ({"cone": "eliptic"}, 'option cone is "eliptic"; did you mean "elliptic"?'),
        ({"solver": 7}, "option solver is 7; known values: cg, newton, pgs"),
        ({"iterations": 2**31}, "option iterations is 2147483648, expected a whole number at least 0 and at most 2147483647"),
        ({"timestep": 0}, "option timestep is 0, expected a number more than 0"),
        ({"timestep": float("nan")}, "option timestep is nan, expected a number more than 0"),
        ({"iterations": 1.5}, "option iterations is 1.5, expected a whole number at least 0"),
        ({"tolerance": -1}, "option tolerance is -1, expected a number at least 0"),
        ({"gravity": 9.81}, "option gravity is 9.81, expected 3 numbers"),
        ({"solref": 0.01}, "option solref is 0.01, expected 2 numbers"),
        ({"solref": [0.01, -1]}, "option solref is [0.01, -1], expected a time constant [s] and a damping ratio, or −k and −b"),
        ({"solimp": [0.9, 0.95, 0.001]}, "option solimp is [0.9, 0.95, 0.001], expected 5 numbers"),
        (
            {"solimp": [0.9, 1, 0.001, 0.5, 2]},
            "option solimp is [0.9, 1, 0.001, 0.5, 2], expected impedances and midpoint from 0.0001 to 0.9999, "
            "a width of at least 0, a power of at least 1",
        ),
    ],
)
def test_invalid_options_are_named(tmp_path, simulator, options, message):
    with pytest.raises(SimulationError) as caught:
        simulator(module(tmp_path), 1, options=options)
    assert str(caught.value) == message


@BOTH
def test_options_are_refused_with_a_users_model(tmp_path, simulator):
    touch = module(tmp_path)
    model = tgdsl.simulate(touch, 1).model
    with pytest.raises(SimulationError, match="`options` are for the artefact's scene"):
        simulator(touch, 1, model=model, options={"timestep": 0.01})


def test_an_unknown_option_is_named(tmp_path):
    touch = module(tmp_path)
    for simulate, name in ((tgdsl.simulate, "simulate"), (BatchSimulation, "BatchSimulation"), (warp, "WarpSimulation")):
        with pytest.raises(SimulationError, match=f'^{name} has no option "subtseps"; did you mean "substeps"\\?$'):
            simulate(touch, 1, subtseps=2)


def test_the_last_matching_pattern_sets_the_largest_torque():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody>"
        + "".join(f"<body name='{n}'><joint name='{n}'/><geom size='.1' mass='1'/></body>" for n in ("left", "right", "lift"))
        + "</worldbody><actuator>"
        + "".join(f"<position joint='{n}' kp='1'/>" for n in ("left", "right", "lift"))
        + "</actuator></mujoco>"
    )
    set_options(spec, {"timestep": 0.004, "max_torque": {"l*": 2.0, "left": 0.5}})
    model = spec.compile()
    assert model.opt.timestep == 0.004
    assert model.actuator_forcelimited.tolist() == [1, 0, 1]
    assert model.actuator_forcerange.tolist() == [[-0.5, 0.5], [0, 0], [-2, 2]]
