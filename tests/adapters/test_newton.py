"""Touch in the installed Newton: readings match plain MuJoCo in the same pose, forces are Newton's."""

import json
import re
from pathlib import Path

import newton
import numpy as np
import pytest
import torch
import warp as wp
from newton.sensors import SensorContact
from newton_host import SOLVERS, WORLDS, Host
from scene_of_adapters import DEPTH, LOAD, SCENE, document

from tgdsl.adapters.newton import SensorTactile
from tgdsl.errors import SimulationError, StateError
from tgdsl.geometry.rotations import rotated
from tgdsl.quantities.pairs import Pair


@pytest.mark.parametrize("solver", SOLVERS)
def test_readings_match_plain_mujoco(tmp_path, solver):
    host = Host(solver)
    sensor = SensorTactile(host.model, document(tmp_path))
    host.push()
    host.step(6)
    skin, expected = host.read(sensor)["skin"], sensor.touch(host.plain(sensor.touch))["skin"]
    assert (expected[:, :4, :3].abs() > 1e-3).any()
    assert len(skin) == 1 or (skin[0] != skin[1]).any()
    for part in (slice(0, 3), slice(3, 6)):  # forces and torques, each relative to its full scale
        scale = float(expected[..., part].abs().max())
        assert float((skin[..., part] - expected[..., part]).abs().max()) <= 1e-6 * scale


@pytest.mark.parametrize("solver", SOLVERS)
def test_loads_and_contact_positions_match_newton(tmp_path, solver):
    host = Host(solver)
    spread = {"kind": "force_taxel", "links": ["palm"], "feels": ["cube"], "slots": 8}
    sensor = SensorTactile(host.model, document(tmp_path, load=LOAD, spread=spread))
    assert sensor.solver_observable_kinds == {"contact_f"}
    newton_sensor = SensorContact(
        host.model, sensing_bodies="*palm", counterpart_bodies="*cube", request_contact_attributes=False
    )
    states, read = [], sensor.touch.forward
    sensor.touch.forward = lambda state, **kwargs: states.append(state) or read(state, **kwargs)
    host.push()
    host.step(20)
    readings = host.read(sensor)
    newton_sensor.update(host.state, host.contacts, observables=host.observables)
    column = [
        list(row).index(i)
        for row, i in zip(newton_sensor.counterpart_indices, np.flatnonzero(_is(host.model, "cube")), strict=True)
    ]
    force, position = (
        values.numpy()[np.arange(len(column)), column] for values in (newton_sensor.force_matrix, newton_sensor.position_matrix)
    )
    scale = float(abs(force).max())
    assert scale > 0.5
    state, pair = states[-1], sensor.touch.inputs.pairs.index(Pair("palm", "cube"))
    np.testing.assert_allclose(state.contact_netforce[:, pair], force, atol=1e-6 * scale)
    palm = wp.to_torch(host.state.body_q)[_is(host.model, "palm")]
    in_world = rotated(palm[:, [6, 3, 4, 5]], readings["load"][:, 0])
    np.testing.assert_allclose(in_world, force, atol=1e-6 * scale)
    weight = state.contact_force[:, pair].norm(dim=-1, keepdim=True)
    mean = (weight * state.contact_pos[:, pair]).sum(dim=1) / weight.sum(dim=1)
    np.testing.assert_allclose(mean, position, atol=1e-6)
    normal = state.contact_normal[:, pair][weight[..., 0] > 0]
    assert (normal[:, 2] < -0.9).all()  # out of the cube
    assert (state.contact_found[:, pair] == (weight[..., 0] > 0).sum(dim=1)).all()


def _is(model, name) -> np.ndarray:
    return np.array([label.endswith(f"/{name}") for label in model.body_label])


def test_resetting_one_world_keeps_the_others(tmp_path):
    delayed = DEPTH | {"noise": {"read_delay": 0.004}}
    host, doc = Host(), document(tmp_path, stacked=DEPTH | {"history": 3}, delayed=delayed, load=LOAD)
    sensor, fresh = (SensorTactile(host.model, doc) for _ in range(2))
    host.push()
    for _ in range(4):
        host.step()
        previous = {name: value.clone() for name, value in host.read(sensor, dt=0.002).items()}
    assert (previous["load"][:, 0, 2] < 0).all()
    host.read(fresh, dt=0.002)
    sensor.reset([1])
    host.state.body_q.assign(host.model.body_q)
    current = host.read(sensor, dt=0.002, worlds=[1])
    fresh.reset()
    start = host.read(fresh, dt=0.002, worlds=range(WORLDS))
    for name in ("stacked", "delayed", "skin"):
        assert torch.equal(current[name][0], previous[name][0])
        assert torch.equal(current[name][1], start[name][1])
        assert not torch.equal(current[name][1], previous[name][1])
    assert torch.equal(current["load"][0], previous["load"][0])
    assert not current["load"][1].any()  # the last contacts belong to the previous episode
    host.step()
    assert host.read(sensor, dt=0.002)["load"][1].any()


def test_joints_are_read_by_name(tmp_path):
    doc = document(tmp_path)
    doc["observations"]["hand"] = [{"type": "joint_pos", "joints": ["bend"]}, {"type": "joint_vel", "joints": ["bend"]}]
    host = Host()
    sensor = SensorTactile(host.model, doc)
    host.push()
    host.step(3)
    states, read = [], sensor.touch.forward
    sensor.touch.forward = lambda state, **kwargs: states.append(state) or read(state, **kwargs)
    host.read(sensor)
    hinges = np.flatnonzero([label.endswith("/bend") for label in host.model.joint_label])
    at = host.model.joint_q_start.numpy()[hinges], host.model.joint_qd_start.numpy()[hinges]
    assert states[-1].joint_pos[:, 0].tolist() == host.state.joint_q.numpy()[at[0]].tolist()
    assert states[-1].joint_vel[:, 0].tolist() == host.state.joint_qd.numpy()[at[1]].tolist()


def test_unknown_names_and_missing_inputs_are_refused(tmp_path):
    host, doc = Host(), document(tmp_path)
    for settings, message in (
        ({"names": {"pad": "hand/pda"}}, 'the scene has no body "hand/pda"; known bodies: hand/worldbody/'),
        ({"names": {"pad": "hand/worldbody/palm/pda"}}, 'did you mean "hand/worldbody/palm/pad"?'),
    ):
        with pytest.raises(SimulationError, match=re.escape(message)):
            SensorTactile(host.model, doc, **settings)
    with pytest.raises(SimulationError, match=r"the sensors read contacts: hand contacts and observables"):
        SensorTactile(host.model, document(tmp_path, load=LOAD)).update(host.state, host.contacts)
    delayed = DEPTH | {"noise": {"read_delay": 0.004}}
    with pytest.raises(StateError, match=r"SceneState lacks dt"):
        host.read(SensorTactile(host.model, document(tmp_path, delayed=delayed)))


def test_worlds_that_differ_are_refused(tmp_path):
    builder = newton.ModelBuilder()
    for scene in (SCENE, SCENE.replace('"pad"', '"thumb"')):
        world = newton.ModelBuilder()
        world.add_mjcf(scene)
        builder.add_world(world)
    with pytest.raises(SimulationError, match=r"worlds 0 and 1 differ in their body labels: pad, thumb"):
        SensorTactile(builder.finalize(device="cpu"), document(tmp_path))


def test_a_model_without_worlds_counts_as_one(tmp_path):
    builder = newton.ModelBuilder()
    builder.add_mjcf(SCENE)
    model = builder.finalize(device="cpu")
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    pipeline = newton.CollisionPipeline(model)
    contacts = pipeline.contacts()
    pipeline.collide(state, contacts)
    skin = SensorTactile(model, document(tmp_path)).update(state, contacts)["skin"]  # without a solver
    host = Host("xpbd")
    host.pipeline.collide(host.state, host.contacts)
    assert skin.any() and torch.equal(skin, host.read(SensorTactile(host.model, document(tmp_path)))["skin"][:1])


def test_the_documented_code_reads_touch(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "newton.md").read_text(encoding="utf-8")
    lines = re.search(r"^```python\n(import newton.*?)^```$", page, flags=re.M | re.S)[1]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hand.yaml").write_text(json.dumps(document(tmp_path, load=LOAD)), encoding="utf-8")
    names = {"model": Host().model}
    exec(lines, names)
    assert names["readings"]["skin"].shape == (WORLDS, 8, 6)
    assert names["sensor"].touch.observe(names["readings"])["policy"].shape == (WORLDS, 24)
