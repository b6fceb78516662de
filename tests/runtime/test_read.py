"""States of scenes that users step, against tgdsl's simulations and MuJoCo's functions."""

import dataclasses
import re

import mujoco
import mujoco_warp
import numpy as np
import pytest
import torch
import warp as wp
from warp_cases import SCENE, module, wanting_contacts

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.quantities.pairs import Pair
from tgdsl.runtime.batch.simulation import BatchSimulation

JOINTS = ("joint_pos", "joint_vel", "joint_effort", "last_action")


def module_wanting_all(folder) -> tuple[TactileModule, mujoco.MjModel]:
    """Return a module that wants contacts and joints, and a model with its contact sensors."""
    touch, model = wanting_contacts(folder)
    inputs = dataclasses.replace(
        touch.inputs, fields=(*touch.inputs.fields, *JOINTS), joints=("two", "one"), actuators=("two", "one")
    )
    return TactileModule(dataclasses.replace(touch.plan, inputs=inputs)), model


def moved_data(model, seed) -> mujoco.MjData:
    """Return data a few steps after the keyframe, with random controls, evaluated at its joints."""
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = np.random.default_rng(seed).normal(size=model.nu)
    mujoco.mj_step(model, data, nstep=5 + seed)
    mujoco.mj_forward(model, data)
    return data


def host_forces(warp_model, warp_data):
    """Return each contact's environment and the force on its second geom's body, in the world frame [N]."""
    count = int(warp_data.nacon.numpy()[0])
    ids, forces = wp.array(np.arange(count), dtype=int), wp.zeros(count, dtype=wp.spatial_vector)
    mujoco_warp.contact_force(warp_model, warp_data, ids, True, forces)
    return list(zip(warp_data.contact.worldid.numpy()[:count], forces.numpy()[:, :3], strict=True))


def spec_with_robots(folder, touch, count=1) -> mujoco.MjSpec:
    """Return a scene with copies of the module's scene under the prefixes "a/", "b/" and so on."""
    spec = mujoco.MjSpec()
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for i in range(count):
        child = mujoco.MjSpec.from_file(str(folder / "scene.xml"))
        tgdsl.instrument(child, touch.inputs)
        spec.attach(child, prefix=f"{'abc'[i]}/", frame=spec.worldbody.add_frame(pos=[i, 0, 0]))
    return spec


def assert_same(state, expected, tolerance):
    for field in dataclasses.fields(expected):
        value = getattr(expected, field.name)
        if isinstance(value, torch.Tensor):
            scale = max(float(value.abs().max()), 1e-3)
            error = float((getattr(state, field.name) - value).abs().max())
            assert error <= tolerance * scale, f"{field.name} is off by {error / scale}"


def test_read_mujoco_agrees_with_the_batch(tmp_path):
    touch, model = module_wanting_all(tmp_path)
    envs = [moved_data(model, seed) for seed in range(3)]
    sim = BatchSimulation(touch, 3, model=model)
    for name in ("qpos", "qvel", "ctrl", "qacc_warmstart"):
        sim.arrays[name].copy_(torch.from_numpy(np.stack([getattr(env, name) for env in envs])))
    sim.forward()
    state = tgdsl.read_mujoco(touch, model, envs)
    assert set(touch.inputs.fields) == {f.name for f in dataclasses.fields(state) if getattr(state, f.name) is not None} - {
        "time",
        "substeps",
    }
    assert_same(state, dataclasses.replace(sim.state(), time=state.time, dt=None), 1e-9)
    assert (state.contact_found > 0).any()
    assert state.time.tolist() == [env.time for env in envs]
    assert_same(tgdsl.read_mujoco(touch, model, envs[1]), dataclasses.replace(state, **_only(state, 1)), 0.0)


def _only(state, env) -> dict:
    values = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    return {name: v[env : env + 1] for name, v in values.items() if isinstance(v, torch.Tensor)}


def test_velocities_and_joints_match_mujocos_functions(tmp_path):
    touch, model = module_wanting_all(tmp_path)
    data = moved_data(model, 1)
    state = tgdsl.read_mujoco(touch, model, data)
    for i, name in enumerate(touch.inputs.bodies):
        twist = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, model.body(name).id, twist, 0)
        np.testing.assert_allclose(state.body_angvel[0, i], twist[:3], atol=1e-9)
        np.testing.assert_allclose(state.body_linvel[0, i], twist[3:], atol=1e-9)
    assert [float(v) for v in state.joint_pos[0]] == [data.joint("two").qpos[0], data.joint("one").qpos[0]]
    assert [float(v) for v in state.last_action[0]] == [data.ctrl[1], data.ctrl[0]]


def test_read_warp_agrees_with_read_mujoco(tmp_path):
    touch, model = module_wanting_all(tmp_path)
    data = moved_data(model, 2)
    warp_model = mujoco_warp.put_model(model)
    warp_data = mujoco_warp.put_data(model, data, nworld=2)
    mujoco_warp.forward(warp_model, warp_data)
    net = torch.zeros(2, 3)
    for i, (world, force) in enumerate(host_forces(warp_model, warp_data)):
        names = [model.body(model.geom_bodyid[geom]).name for geom in warp_data.contact.geom.numpy()[i]]
        assert set(names) == {"table", "cube"}
        net[world] += torch.tensor(force if names[1] == "table" else -force)
    expected = tgdsl.read_mujoco(touch, model, [data, data])
    state = tgdsl.read_warp(touch, model, warp_model, warp_data)
    kinematic = ("body_pos", "body_quat", "body_linvel", "body_angvel", "contact_found", *JOINTS)
    assert_same(state, tgdsl.SceneState(**{name: getattr(expected, name) for name in kinematic}), 1e-6)
    table = touch.inputs.pairs.index(Pair("table", "cube"))
    assert float(net.norm()) > 1.0
    for force in (state.contact_netforce[:, table], state.contact_force[:, table].sum(dim=1)):
        assert torch.allclose(force, net, rtol=0, atol=1e-6 * float(net.abs().max()))
    assert float((net - expected.contact_netforce[:, table]).abs().max()) < 1e-2 * float(net.abs().max())  # another solver
    before = state.body_pos.clone()
    mujoco_warp.step(warp_model, warp_data)
    mujoco_warp.forward(warp_model, warp_data)
    assert not torch.equal(tgdsl.read_warp(touch, model, warp_model, warp_data).body_pos, before)
    assert torch.equal(state.body_pos, before)  # a state is a copy


def test_names_match_below_a_prefix(tmp_path):
    touch, model = module_wanting_all(tmp_path)
    named = touch.inputs.renamed(prefix="a/")
    nested = tgdsl.instrument(spec_with_robots(tmp_path, touch), named).compile()
    data, nested_data = moved_data(model, 0), mujoco.MjData(nested)
    for name in ("qpos", "qvel", "ctrl"):
        getattr(nested_data, name)[:] = getattr(data, name)
    mujoco.mj_forward(nested, nested_data)
    expected = tgdsl.read_mujoco(touch, model, data)
    by_suffix = tgdsl.read_mujoco(touch, nested, nested_data)
    assert_same(by_suffix, dataclasses.replace(expected, time=by_suffix.time), 1e-9)
    by_name = tgdsl.read_mujoco(touch, nested, nested_data, inputs=named)
    assert_same(by_name, by_suffix, 0.0)


def test_ambiguous_names_are_refused_with_the_candidates(tmp_path):
    touch = module(tmp_path)
    named = [touch.inputs.renamed(prefix=prefix) for prefix in ("a/", "b/")]
    spec = spec_with_robots(tmp_path, touch, 2)
    for inputs in named:
        tgdsl.instrument(spec, inputs)
    two = spec.compile()
    data = mujoco.MjData(two)
    mujoco.mj_forward(two, data)
    name = touch.inputs.bodies[0]
    with pytest.raises(SimulationError, match=re.escape(f'"{name}" may be any of the bodies a/{name}, b/{name}; say which')):
        tgdsl.read_mujoco(touch, two, data)
    states = [tgdsl.read_mujoco(touch, two, data, inputs=inputs) for inputs in named]
    shift = states[1].body_pos - states[0].body_pos
    assert torch.allclose(shift, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))


def test_unevaluated_data_is_refused(tmp_path):
    touch, model = module_wanting_all(tmp_path)
    data = mujoco.MjData(model)
    with pytest.raises(SimulationError, match=r"call mujoco\.mj_forward\(model, data\) first"):
        tgdsl.read_mujoco(touch, model, [moved_data(model, 1), data])
    mujoco.mj_forward(model, data)
    assert tgdsl.read_mujoco(touch, model, data).body_quat.norm(dim=-1).allclose(torch.ones(1, dtype=torch.float64))


def test_a_missing_body_is_named_with_a_suggestion(tmp_path):
    touch = module(tmp_path)
    other = mujoco.MjModel.from_xml_string(SCENE.replace('"pad"', '"pad_"'))
    with pytest.raises(SimulationError, match=re.escape('the scene has no body "pad"; did you mean "pad_"?')):
        tgdsl.read_mujoco(touch, other, mujoco.MjData(other))
    warp_model, warp_data = mujoco_warp.put_model(other), mujoco_warp.make_data(other)
    with pytest.raises(SimulationError, match=re.escape('the scene has no body "pad"; did you mean "pad_"?')):
        tgdsl.read_warp(touch, other, warp_model, warp_data)
