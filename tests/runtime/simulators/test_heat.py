"""Temperatures and materials of objects as fields of a state, on both simulators."""

import numpy as np
import pytest
import torch
from thermometers import THERMOMETER
from torch._dynamo.utils import counters
from warp_cases import SCENE, warp

import tgdsl
from tgdsl.errors import ArtifactError, SimulationError, SpecError, StateError
from tgdsl.fields.materials import MATERIALS
from tgdsl.module.module import TactileModule
from tgdsl.plan.plan import FORMAT
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.sensors import KINDS
from tgdsl.testing import FLOAT64_TOLERANCE, ReferenceModule, assert_agrees

BALLS = "".join(f'<body name="{name}" pos="{x} 0 .5"><freejoint/><geom size=".02"/></body>' for x, name in enumerate("abcd", 1))
OBJECTS = {
    "free": {"body": "a", "material": ["steel", "wood", "glass"], "temperature": {"per_env": "45 degC"}},
    "kind": {"body": "b", "material": ["copper", {"like": "wood", "conductivity": "0.2 W/(m*K)"}], "temperature": 60},
    "warm": {"body": "c", "material": "abs", "temperature": {"per_env": "300 K"}},
    "cold": {"body": "d"},
}
OF_STEEL, OF_WOOD, OF_GLASS = (MATERIALS[name].conductivity for name in ("steel", "wood", "glass"))


def document(folder, objects=OBJECTS, kind="thermometer", feels=("free", "kind", "warm")):
    (folder / "scene.xml").write_text(
        SCENE.replace('<body name="arm"', BALLS + '<body name="arm"')
        .replace('qpos="0 0 .0299 1 0 0 0', 'qpos="0 0 .0299 1 0 0 0 ' + "1 0 .5 1 0 0 0 " * 4)
        .replace('qvel="', 'qvel="0 0 0 0 0 0 ' + "0 0 0 0 0 0 " * 3)
    )
    sensors = {name: {"kind": kind, "links": "pad", "feels": [name]} for name in feels}
    touch = {"kind": "link_contact", "links": "table", "feels": ["cold"]}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml")},
        "objects": objects,
        "sensors": {**sensors, "touch": touch},
    }


def compiled(folder, **options):
    return tgdsl.compile(document(folder, **options), kinds=[THERMOMETER], dtype=torch.float64)


def simulator(kind, touch, num_envs, **options):
    return BatchSimulation(touch, num_envs, **options) if kind == "batch" else warp(touch, num_envs, **options)


BOTH = pytest.mark.parametrize("kind", ["batch", "warp"])


def test_inputs_list_heated_objects(tmp_path):
    touch = compiled(tmp_path)
    assert touch.inputs.fields[-2:] == ("object_temperature", "object_material")
    assert touch.inputs.heated == ("free", "kind", "warm")
    assert touch.inputs.num_materials == (3, 2, 1)
    assert touch.inputs.start_temperatures == (45.0, None, pytest.approx(26.85))
    assert touch.inputs.objects == ()
    assert "  heated  free, kind, warm" in touch.explain()


@pytest.mark.parametrize(
    ("feels", "fields"), [(["kind"], {"object_material"}), (["warm"], {"object_temperature"}), ([], set())], ids=str
)
def test_a_module_wants_only_the_fields_that_its_sensors_read(tmp_path, feels, fields):
    """An object that only other sensors feel, or that is equal in all environments, needs no field."""
    inputs = compiled(tmp_path, feels=feels).inputs
    assert {name for name in inputs.fields if name.startswith("object_")} == fields
    assert inputs.heated == (tuple(feels) if fields else ())
    equal_objects = {"only": {"body": "a", "material": "steel", "temperature": 40}, "cold": {"body": "d"}}
    assert compiled(tmp_path, objects=equal_objects, feels=["only"]).inputs.heated == ()


def test_readings_agree_with_the_reference(tmp_path):
    doc = document(tmp_path)
    touch = tgdsl.compile(doc, kinds=[THERMOMETER], dtype=torch.float64)
    state = touch.example_state(6)
    assert state.object_material is not None and state.object_temperature is not None
    assert state.object_material.tolist() == [[env % 3, env % 2, 0] for env in range(6)]
    assert 15 <= state.object_temperature.min() < state.object_temperature.max() <= 45
    readings = touch(state)
    for name in ("free", "kind", "warm"):
        spec = THERMOMETER.spec.model_validate(doc["sensors"][name])
        single = tgdsl.compile({**doc, "sensors": {name: doc["sensors"][name]}}, kinds=[THERMOMETER], dtype=torch.float64)
        single_state = single.example_state(6)
        assert_agrees(
            single(single_state)[name], ReferenceModule(single.plan, THERMOMETER, spec), single_state, FLOAT64_TOLERANCE
        )
    assert readings["kind"][:, 0].tolist() == [[60.0, 401.0], [60.0, 0.2]] * 3


def test_an_artefact_keeps_heated_objects(tmp_path):
    touch = compiled(tmp_path)
    tgdsl.save(touch, tmp_path / "a.safetensors")
    loaded = tgdsl.load(tmp_path / "a.safetensors", kinds=[THERMOMETER], dtype=torch.float64)
    assert loaded.inputs == touch.inputs
    state = touch.example_state(6)
    torch.testing.assert_close(loaded(state)["free"], touch(state)["free"], rtol=0, atol=0)
    loaded.reset()
    torch.testing.assert_close(tgdsl.simulate(loaded, 3).read()["warm"][:, 0, 0], torch.full((3,), 26.85, dtype=torch.float64))
    with pytest.raises(ArtifactError, match="plan format"):
        type(touch.plan).from_json(touch.plan.to_json().replace(f'"format":{FORMAT}', '"format":12'), touch.plan.arrays)


def test_dtypes_shapes_and_ranges_of_a_state_are_checked(tmp_path):
    touch = compiled(tmp_path)
    state = touch.example_state(4)
    moved = state.to(torch.float32)
    assert moved.object_material.dtype == torch.int64 and moved.object_temperature.dtype == torch.float32
    assert touch(moved)["free"].shape == (4, 1, 2)
    state.object_material[2, 1] = 2
    with pytest.raises(StateError, match=r"SceneState\.object_material of object kind is 2, expected 0 to 1"):
        touch(state)
    state.object_material = state.object_material.double()
    with pytest.raises(
        StateError, match=r"SceneState\.object_material is torch\.float64, expected torch\.int64 or torch\.int32"
    ):
        touch(state)
    state.object_material = torch.zeros(4, 2, dtype=torch.int64)
    with pytest.raises(StateError, match=r"SceneState\.object_material has shape \(4, 2\), expected \(env, 3\)"):
        touch(state)
    state.object_temperature = None
    with pytest.raises(StateError, match="SceneState lacks object_temperature, which this module reads"):
        touch(state)


@BOTH
def test_environments_start_with_the_documents_values(tmp_path, kind):
    sim = simulator(kind, compiled(tmp_path), 4)
    state = sim.state()
    np.testing.assert_allclose(state.object_temperature, [[45, 0, 26.85]] * 4, rtol=1e-7)
    assert state.object_material.tolist() == [[0, 0, 0], [1, 1, 0], [2, 0, 0], [0, 1, 0]]
    readings = sim.read()["free"][:, 0]
    np.testing.assert_allclose(readings, [[45, OF_STEEL], [45, OF_WOOD], [45, OF_GLASS], [45, OF_STEEL]], rtol=1e-7)


@BOTH
def test_set_values_survive_steps_and_resets(tmp_path, kind):
    sim = simulator(kind, compiled(tmp_path), 3, keyframe="home")
    first, live = sim.state(), (sim.heat.temperature, sim.heat.material)
    sim.set_objects(env_ids=[2, 0], temperatures={"free": [50, 10], "warm": -5.5}, materials={"free": [1, 2], "kind": 1})
    expected = [[10, 0, -5.5], [45, 0, 26.85], [50, 0, -5.5]], [[2, 1, 0], [1, 1, 0], [1, 1, 0]]
    assert first.object_material.tolist() == [[0, 0, 0], [1, 1, 0], [2, 0, 0]], "a state is a copy"
    for act in (
        lambda: None,
        sim.step,
        sim.reset,
        lambda: sim.reset([1]),
        sim.step,
        lambda: sim.set_state(qpos=sim.qpos.clone()),
    ):
        act()
        state = sim.state()
        np.testing.assert_allclose(state.object_temperature, expected[0], rtol=1e-6)
        assert state.object_material.tolist() == expected[1]
    assert sim.heat.temperature is live[0] and sim.heat.material is live[1], "written in place"


@BOTH
def test_values_written_into_live_tensors_are_in_the_next_state(tmp_path, kind):
    sim = simulator(kind, compiled(tmp_path), 3)
    column = sim.heat.names.index("warm")
    sim.heat.temperature[:, column] = torch.tensor([20.0, 30.0, 40.0])
    sim.heat.material[1, sim.heat.names.index("kind")] = 0
    assert sim.state().object_temperature[:, column].tolist() == [20, 30, 40]
    assert sim.read()["kind"][:, 0, 1].tolist() == [401.0] * 3


@BOTH
def test_set_objects_restarts_its_environments(tmp_path, kind):
    sim = simulator(kind, compiled(tmp_path), 3, keyframe="home")
    start = sim.qpos.clone()
    for _ in range(5):
        sim.step()
    moved = sim.qpos.clone()
    assert not torch.equal(start, moved)
    sim.set_objects(env_ids=[1], materials={"free": 0})
    assert torch.equal(sim.qpos[1], start[1]) and torch.equal(sim.qpos[[0, 2]], moved[[0, 2]])


def test_both_simulators_agree(tmp_path):
    sims = [simulator(kind, compiled(tmp_path), 5) for kind in ("batch", "warp")]
    rng = np.random.default_rng(3)
    for _ in range(3):
        ids = rng.permutation(5)[:3]
        chosen = {"temperatures": {"free": rng.uniform(-20, 90, 3)}, "materials": {"free": rng.integers(3, size=3)}}
        states = []
        for sim in sims:
            sim.set_objects(env_ids=ids, **chosen)
            sim.step()
            states.append(sim.state())
        torch.testing.assert_close(states[0].object_temperature, states[1].object_temperature.double(), rtol=1e-6, atol=0)
        assert torch.equal(states[0].object_material, states[1].object_material)


@BOTH
def test_state_dict_restores_temperatures_and_materials(tmp_path, kind):
    touch = compiled(tmp_path)
    sim = simulator(kind, touch, 3)
    sim.set_objects(temperatures={"free": [1, 2, 3]}, materials={"free": [2, 1, 0]})
    saved = sim.state_dict()
    assert {name for name in saved if name.startswith("heat/")} == {"heat/temperature", "heat/material"}
    sim.set_objects(temperatures={"free": 70}, materials={"free": 1})
    live = sim.heat.temperature
    sim.load_state_dict(saved)
    assert sim.heat.temperature is live
    assert sim.state().object_temperature[:, 0].tolist() == [1, 2, 3] and sim.state().object_material[:, 0].tolist() == [
        2,
        1,
        0,
    ]
    with pytest.raises(SimulationError, match="heat/temperature missing or of another shape"):
        sim.load_state_dict({name: value for name, value in saved.items() if name != "heat/temperature"})
    sim.close()
    without = simulator(kind, compiled(tmp_path, feels=[]), 3)
    assert not [name for name in without.state_dict() if name.startswith("heat")]


@BOTH
def test_invalid_values_change_nothing(tmp_path, kind):
    sim = simulator(kind, compiled(tmp_path), 3)
    before = sim.state_dict()
    for bad, message in (
        ({"temperatures": {"fre": 3}}, 'no object "fre" holds heat; did you mean "free"?'),
        (
            {"temperatures": {"kind": 3}},
            "the temperature of object kind is fixed; the document frees it with `temperature: {per_env",
        ),
        (
            {"temperatures": {"free": -300}},
            "temperatures of object free: expected 3 numbers of at least -273.15 °C, found -300",
        ),
        ({"temperatures": {"free": [1, float("nan"), 2]}}, "temperatures of object free: expected 3 numbers"),
        ({"temperatures": {"free": [1, 2]}}, "temperatures of object free: expected 3 numbers"),
        ({"materials": {"free": 3}}, "materials of object free: expected 3 integers from 0 to 2, found 3"),
        ({"materials": {"warm": 1}}, "materials of object warm: expected 3 integers from 0 to 0, found 1"),
        ({"materials": {"free": 0.5}}, "materials of object free: expected 3 integers from 0 to 2, found 0.5"),
        ({"temperatures": {"free": 3}, "materials": {"free": -1}}, "materials of object free: expected 3 integers"),
        ({"temperatures": {"free": 3}, "env_ids": [7]}, "env_ids: found 7, expected indices from 0 to 2, or a mask of 3"),
        ({"temperatures": {"free": 3}, "variants": {"free": 0}}, "no object of this module differs between environments"),
        ({}, "no object of this module differs between environments"),
    ):
        with pytest.raises(SimulationError) as caught:
            sim.set_objects(**bad)
        assert message in str(caught.value)
    for name, value in sim.state_dict().items():
        assert torch.equal(value, before[name]), name
    sim.close()
    without = simulator(kind, compiled(tmp_path, feels=[]), 3)
    with pytest.raises(SimulationError, match="no temperature or material differs between environments"):
        without.set_objects(temperatures={"free": 3})


def test_variants_and_heat_are_set_in_one_call_or_not_at_all(tmp_path):
    """An invalid value of one leaves both unchanged."""
    shapes = [{"type": "sphere", "size": [0.02]}, {"type": "box", "size": [0.02, 0.02, 0.02]}]
    objects = {**OBJECTS, "free": {**OBJECTS["free"], "variants": shapes}}
    sim = BatchSimulation(compiled(tmp_path, objects=objects), 4)
    sim.set_objects(variants={"free": [1, 1, 0, 0]}, temperatures={"free": [1, 2, 3, 4]})
    state = sim.state()
    assert state.variant[:, 0].tolist() == [1, 1, 0, 0] and state.object_temperature[:, 0].tolist() == [1, 2, 3, 4]
    for bad in ({"variants": {"free": 2}, "temperatures": {"free": 9}}, {"variants": {"free": 0}, "materials": {"free": 9}}):
        with pytest.raises(SimulationError):
            sim.set_objects(**bad)
    state = sim.state()
    assert state.variant[:, 0].tolist() == [1, 1, 0, 0] and state.object_temperature[:, 0].tolist() == [1, 2, 3, 4]


@pytest.mark.slow
def test_one_compiled_graph_serves_all_materials(tmp_path):
    touch = compiled(tmp_path)
    fused = TactileModule(touch.plan, (*KINDS, THERMOMETER), dtype=torch.float64).compile(backend="eager")
    torch.compiler.reset()
    counters.clear()
    for num_envs in (16, 48):
        state = touch.example_state(num_envs)
        assert state.object_material is not None
        state.object_material = state.object_material.flip(0)
        readings, expected = fused(state), touch(state)
        for name, value in expected.items():
            torch.testing.assert_close(readings[name], value, rtol=0, atol=0)
    assert counters["stats"]["unique_graphs"] == 1 and not counters["graph_break"]


def test_a_quantity_can_require_a_material(tmp_path):
    with pytest.raises(SpecError, match=r"objects\.cold: expected `material`, what it is made of"):
        compiled(tmp_path, feels=["cold"])
