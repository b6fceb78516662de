"""Masses and frictions of objects: derived fields match what MuJoCo compiles, and the physics follows."""

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, warp

from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.objects import MASS_FIELDS

OWN = ("mass", "friction")
ODD = {"geoms": [{"type": "sphere", "size": [0.012], "pos": [0, 0, 0.02]}, {"type": "box", "size": [0.01, 0.01, 0.02]}]}
VARIANTS = {"variants": [{"type": "box", "size": [0.02] * 3}, {"type": "sphere", "size": [0.02], "density": 500}]}
SLOPE = """
<mujoco>
  <option timestep="0.002" cone="elliptic" impratio="100" integrator="implicitfast" gravity="{x} 0 {z}"/>
  <worldbody>
    <body name="table"><geom type="box" size="1 1 .01" friction="1"/></body>
    <body name="cube" pos="0 0 .0299">
      <freejoint/><geom name="cube" type="box" size=".02 .02 .02" mass=".25" priority="1" friction="1"/>
    </body>
  </worldbody>
</mujoco>
"""


def simulator(kind, touch, num_envs, **options):
    return BatchSimulation(touch, num_envs, **options) if kind == "batch" else warp(touch, num_envs, per_env=OWN, **options)


BOTH = pytest.mark.parametrize("kind", ["batch", "warp"])


def compiled_with(mass: float) -> mujoco.MjModel:
    """Return the scene compiled with a mass."""
    return mujoco.MjModel.from_xml_string(SCENE.replace('mass=".25"', f'mass="{mass}"'))


@BOTH
def test_fields_derived_from_a_mass_match_mujocos_compiler(tmp_path, kind):
    sim = simulator(kind, module(tmp_path), 3)
    sim.properties.set([0, 2], mass={"cube": np.array([0.1, 9, 0.7])})
    np.testing.assert_allclose(sim.properties.mass("cube"), [0.1, 0.25, 0.7], rtol=1e-6)
    for env, mass in enumerate([0.1, 0.25, 0.7]):
        expected = compiled_with(mass)
        for name in MASS_FIELDS:
            values = sim.parameters[name][env].numpy() if kind == "warp" else getattr(sim.env_model(env), name)
            np.testing.assert_allclose(values, getattr(expected, name), rtol=1e-5, atol=1e-9, err_msg=f"{name} {env}")


@BOTH
def test_environments_move_like_scenes_with_their_mass(tmp_path, kind):
    sim, masses = simulator(kind, module(tmp_path), 3, keyframe="home"), [0.1, 0.25, 0.7]
    sim.properties.set(mass={"cube": torch.tensor(masses)})
    push = torch.zeros_like(sim._arrays["xfrc_applied"])
    push[:, sim.model.body("cube").id, :3] = torch.tensor([0.1, 0.05, 0.02])
    sim._arrays["xfrc_applied"].copy_(push)
    for _ in range(50):
        sim.step(np.zeros(2))
    for env, mass in enumerate(masses):
        model = compiled_with(mass)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.xfrc_applied[:] = push[env].numpy()
        data.ctrl[:] = 0
        for _ in range(50):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(sim.qpos[env], data.qpos, atol=1e-12 if kind == "batch" else 2e-4)


@pytest.mark.parametrize(("kind", "friction"), [("batch", 0.3), ("batch", 0.6), ("warp", 0.6)])
def test_a_cube_slides_beyond_the_angle_of_friction(tmp_path, kind, friction):
    """Slopes of 0.9 and 1.1 times atan μ: the cube stays on the first, and accelerates at g (sin α − μ cos α) on the second.

    MuJoCo's soft contacts let it hop at first, which costs up to 6 % of the speed.
    """
    for share in (0.9, 1.1):
        angle = share * np.arctan(friction)
        touch = module(tmp_path, SLOPE.format(x=9.81 * np.sin(angle), z=-9.81 * np.cos(angle)), links=("table",))
        sim = simulator(kind, touch, 2)
        sim.properties.set(friction={"cube": torch.tensor([friction, 3.0])})
        np.testing.assert_allclose(sim.properties.friction("cube"), [friction, 3.0], rtol=1e-6)
        for _ in range(250):
            sim.step()
        speed = 9.81 * (np.sin(angle) - friction * np.cos(angle)) * 0.5 if share > 1 else 0.0
        assert float(sim.qvel[0, 0]) == pytest.approx(speed, rel=0.08, abs=0.003)
        assert float(sim.qvel[1, 0]) == pytest.approx(0, abs=0.003)


def test_compounds_take_a_mass_and_a_friction(tmp_path):
    sim = BatchSimulation(module(tmp_path, target={"variants": [*VARIANTS["variants"], ODD]}), 6)
    before = sim.properties.mass("cube").clone()
    sim.properties.set([1, 2], mass={"cube": 0.5}, friction={"cube": 0.1})
    np.testing.assert_allclose(sim.properties.mass("cube"), [before[0], 0.5, 0.5, *before[3:]], rtol=1e-12)
    np.testing.assert_allclose(sim.properties.friction("cube"), [1, 0.1, 0.1, 1, 1, 1])
    body = sim.model.body("cube").id
    for env in (1, 2):
        plain, changed = sim.env_model(env + 3), sim.env_model(env)
        np.testing.assert_allclose(
            changed.body_inertia[body] / 0.5, plain.body_inertia[body] / plain.body_mass[body], rtol=1e-12
        )
        np.testing.assert_allclose(
            changed.body_invweight0[body] * 0.5, plain.body_invweight0[body] * plain.body_mass[body], rtol=1e-9
        )
    for _ in range(3):
        sim.step()
    assert torch.isfinite(sim.qpos).all()


@BOTH
def test_variants_take_a_mass_and_get_their_own_back_when_chosen_again(tmp_path, kind):
    sim = simulator(kind, module(tmp_path, target=VARIANTS), 4)
    nominal = [1000 * 0.04**3, 500 * 4 / 3 * np.pi * 0.02**3] * 2
    np.testing.assert_allclose(sim.properties.mass("cube"), nominal, rtol=1e-6)
    sim.properties.set(mass={"cube": 0.3}, friction={"cube": 0.2})
    np.testing.assert_allclose(sim.properties.mass("cube"), [0.3] * 4, rtol=1e-6)
    sim.set_objects(variants={"cube": [1, 0]}, env_ids=[0, 1])
    masses = sim.properties.mass("cube")
    np.testing.assert_allclose(masses, [nominal[1], nominal[0], 0.3, 0.3], rtol=1e-6)
    for _ in range(3):
        sim.step()
    assert torch.isfinite(sim.qpos).all()


@BOTH
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": {"cub": 1.0}}, 'there is no object or body "cub"; did you mean "cube"?'),
        ({"mass": {"cube": 0.0}}, "mass of cube is 0, expected more than 0"),
        ({"mass": {"cube": np.nan}}, "mass of cube is nan, expected more than 0"),
        ({"friction": {"cube": -0.1}}, "friction of cube is -0.1, expected at least 0"),
        ({"friction": {"cube": [1, 2]}}, "friction of cube has shape (2,), expected one number or (3,)"),
        ({"mass": {"cube": 1.0}, "friction": {"cube": -1.0}}, "friction of cube is -1, expected at least 0"),
    ],
)
def test_invalid_properties_are_named_and_change_nothing(tmp_path, kind, given, message):
    sim = simulator(kind, module(tmp_path), 3)
    with pytest.raises(SimulationError) as caught:
        sim.properties.set(**given)
    assert str(caught.value) == message
    np.testing.assert_allclose(sim.properties.mass("cube"), [0.25] * 3, rtol=1e-6)


def test_warp_names_bodies_it_cannot_scale_and_fields_that_environments_share(tmp_path):
    sim = warp(module(tmp_path), 2, per_env=OWN)
    with pytest.raises(SimulationError, match='"pad" is part of a kinematic tree, or its joints have armature'):
        sim.properties.set(mass={"pad": 1.0})
    plain = warp(module(tmp_path), 2)
    with pytest.raises(SimulationError, match=r'environments share each friction; simulate\(..., per_env=\("friction",\)\)'):
        plain.properties.set(friction={"cube": 1.0})


def test_shared_properties_can_be_read(tmp_path):
    plain, per_env = warp(module(tmp_path), 2), warp(module(tmp_path), 2, per_env=OWN)
    for name in ("mass", "friction"):
        shared, values = (getattr(sim.properties, name)("cube") for sim in (plain, per_env))
        assert shared.shape == (2,) and torch.equal(shared, values)


def test_a_link_of_a_chain_takes_a_mass_on_the_cpu(tmp_path):
    sim = BatchSimulation(module(tmp_path), 2)
    mass = float(sim.properties.mass("pad")[0])
    sim.properties.set([1], mass={"pad": 2 * mass})
    model = mujoco.MjModel.from_xml_string(SCENE)
    pad = model.body("pad").id
    model.body_mass[pad], model.body_inertia[pad] = 2 * mass, 2 * model.body_inertia[pad]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for name in (*MASS_FIELDS, "actuator_acc0"):
        np.testing.assert_array_equal(getattr(sim.env_model(1), name), getattr(model, name), err_msg=name)
