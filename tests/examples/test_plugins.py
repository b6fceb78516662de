"""The example package: a kind with custom rows, memory and no objects, and a quantity, both outside tgdsl."""

import dataclasses
import json
import sys
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import ArtifactError, BakeError, LowerError, SimulationError, SpecError, StateError, TgdslError
from tgdsl.files.plugins import installed
from tgdsl.testing import KindConformance

PLUGINS = Path(__file__).parents[2] / "examples" / "plugins"
sys.path.append(str(PLUGINS))  # as in its package

from accelerometer import ACCELEROMETER  # noqa: E402
from dipoles import HALL, MAGNETIC_FIELD, MU  # noqa: E402

SCENE = """<mujoco><option timestep=".002" gravity="0 0 -9.81"/><worldbody>
  <body name="pad" pos="0 0 1" quat=".6 0 .8 0"><geom type="box" size=".03 .03 .01"/></body>
  <body name="item" pos="0 0 3"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""
GRAVITY = 9.81


class TestAccelerometer(KindConformance):
    kind = ACCELEROMETER
    parameters = {"cutoff": 20.0, "gravity": [0, 0, 0]}  # with gravity, readings of a rotated scene differ
    gates = ()


class TestAccelerometerBlock(KindConformance):
    kind = ACCELEROMETER
    parameters = {"cutoff": 20.0, "gravity": [0, 0, 0], "substeps": 3}
    gates = ()


class TestHall(KindConformance):
    kind = HALL
    parameters = {"moment": [0.1, -0.2, 0.4], "range": 0.2}
    gates = ()


@pytest.fixture
def build(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def compiled(kinds=(ACCELEROMETER, HALL), **sensors):
        points = [{"pos": [0.01, 0.002, 0.01], "normal": [0, 0, 1], "radius": 0.004}]
        layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}
        document = {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": layout},
            "objects": {"item": {"body": "item"}},
            "sensors": sensors,
        }
        return tgdsl.compile(document, kinds=list(kinds), dtype="float64")

    return compiled


def test_at_rest_an_accelerometer_reads_minus_gravity_in_the_link(build):
    touch = build(imu={"kind": "accelerometer", "links": "pad"})
    sim = tgdsl.simulate(touch, num_envs=2)
    sim.step()
    expected = Rotation.from_quat([0.6, 0, 0.8, 0], scalar_first=True).inv().apply([0, 0, GRAVITY])
    np.testing.assert_allclose(touch(sim.state())["imu"], np.broadcast_to(expected, (2, 1, 3)), rtol=1e-12, atol=1e-12)


def test_in_free_fall_an_accelerometer_reads_zero(build):
    touch = build(imu={"kind": "accelerometer", "links": "item", "cutoff": 1e4})
    sim = tgdsl.simulate(touch, num_envs=1)
    for _ in range(5):
        sim.step()
        read = touch(sim.state())["imu"]
    np.testing.assert_allclose(read, np.zeros((1, 1, 3)), atol=1e-9)


def test_the_low_pass_answers_a_step_exponentially(build):
    """Constant acceleration from the second call: y = a (1 − e^(−2π f_c t)), minus gravity, at every step."""
    touch = build(imu={"kind": "accelerometer", "links": "pad", "cutoff": 5.0})
    state = touch.example_state(1)
    state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
    for k in range(8):
        state.dt, state.body_linvel = 0.01, torch.full_like(state.body_linvel, 0.02 * k)
        read = touch(state)["imu"][0, 0].numpy()
        expected = 2.0 * (1 - np.exp(-2 * np.pi * 5.0 * 0.01 * k))
        np.testing.assert_allclose(read, [expected, expected, GRAVITY + expected], rtol=1e-12, atol=1e-12)


def test_a_block_holds_the_readings_of_each_physics_step(build):
    spec = {"kind": "accelerometer", "links": ["item", "pad"], "cutoff": 40.0}
    block, single = build(imu={**spec, "substeps": 4}), build(imu=spec)
    sims = tgdsl.simulate(block, num_envs=2, substeps=4), tgdsl.simulate(single, num_envs=2, substeps=4)
    start = block(sims[0].state())["imu"]
    torch.testing.assert_close(start, single(sims[1].state())["imu"][:, None].expand(-1, 4, -1, -1), rtol=0, atol=0)
    for _ in range(3):
        sims[0].step()
        singles = [single(state)["imu"] for state in sims[1].substates()]
        torch.testing.assert_close(block(sims[0].state())["imu"], torch.stack(singles, dim=1), rtol=0, atol=1e-12)
    assert block.outputs[0].shape == (4, 2, 3) and block.outputs[0].rows == "imu"
    assert block.rows["imu"]["link"].tolist() == ["pad", "item"]  # in the robot's order


def test_a_reset_clears_blocks(build):
    touch = build(imu={"kind": "accelerometer", "links": "item", "substeps": 3})
    sim = tgdsl.simulate(touch, num_envs=3, substeps=3)
    for _ in range(4):
        sim.step()
        previous = touch(sim.state())["imu"]
    sim.reset([1])
    state = sim.state()
    current = touch(state, env_ids=[1])["imu"]
    torch.testing.assert_close(current[[0, 2]], previous[[0, 2]], rtol=0, atol=0)
    assert all(torch.equal(part.body_linvel[1], state.body_linvel[1]) for part in state.substeps)
    np.testing.assert_allclose(current[1], np.broadcast_to([0, 0, GRAVITY], (3, 1, 3)), atol=1e-12)


def test_a_block_needs_the_states_of_all_its_physics_steps(build):
    touch = build(imu={"kind": "accelerometer", "links": "item", "substeps": 3})
    state = touch.example_state(2)
    with pytest.raises(StateError, match="substeps holds 1 states, expected 2"):
        touch(dataclasses.replace(state, substeps=state.substeps[:1]))
    sim = tgdsl.simulate(touch, num_envs=1)
    with pytest.raises(SimulationError, match="advanced at 3 physics steps per call, and this simulation makes 1"):
        sim.step()


def test_a_block_has_no_history(build):
    with pytest.raises(SpecError, match="block of samples"):
        build(imu={"kind": "accelerometer", "links": "item", "substeps": 3, "history": 2})


def test_blocks_have_one_length_and_no_clean_reading(build):
    block = {"kind": "accelerometer", "links": "item", "substeps": 3}
    with pytest.raises(SpecError, match=r'sensors\.b: it is advanced at 2 physics steps of a call, "a" at 3'):
        build(a=block, b={**block, "substeps": 2})
    with pytest.raises(SpecError, match=r"sensors\.a\.readout: this sensor reads a block of samples, which has no noise"):
        build(a={**block, "readout": "both"})


def test_substates_give_the_earlier_states_of_a_step(build):
    sims = [tgdsl.simulate(build(a={"kind": "accelerometer", "links": "item", "substeps": 3}), 2, substeps=3) for _ in range(2)]
    for sim in sims:
        sim.step()
    sims[0].step()
    states = list(sims[1].substates())
    after_substates, expected = (sim.state() for sim in sims[::-1])
    for actual, reference in zip((*after_substates.substeps, after_substates), (*expected.substeps, expected), strict=True):
        assert torch.equal(actual.body_pos, reference.body_pos)
    assert all(
        torch.equal(actual.body_pos, reference.body_pos)
        for actual, reference in zip(after_substates.substeps, states, strict=False)
    )


@pytest.mark.filterwarnings("ignore")
def test_a_fault_does_not_shorten_the_step_of_other_environments(build):
    positions = []
    for substeps in (0, 3):
        sim = tgdsl.simulate(build(a={"kind": "accelerometer", "links": "item", "substeps": substeps}), 3, substeps=3)
        sim.step()
        sim.qvel[1] = 1e30
        with pytest.raises(SimulationError, match="environments 1 diverged"):
            sim.step()
        positions.append(sim.qpos[[0, 2]].clone())
    assert torch.equal(*positions)


def test_invalid_substeps_are_refused(build):
    touch = build(a={"kind": "accelerometer", "links": "item", "substeps": 3})
    state = touch.example_state(1)
    for wrong in (None, (1, 2)):
        state.substeps = wrong
        with pytest.raises(StateError, match=r"SceneState\.substeps: expected a tuple of tgdsl\.SceneState"):
            touch(state)


def magnets(**change):
    methods = {name: staticmethod(value) if isinstance(value, FunctionType) else value for name, value in change.items()}
    return dataclasses.replace(HALL, quantities=(type("Wrong", (type(MAGNETIC_FIELD),), methods)(),))


def refusing(error):
    def plan(planning, uses):
        raise error

    return plan


WRONG_QUANTITIES = {
    "sensors.hall: cannot bake": magnets(plan=refusing(BakeError("cannot bake"))),
    "sensors.hall.moment: too weak; wind more": magnets(plan=refusing(LowerError("too weak", "moment", "wind more"))),
    'quantity "magnetic_field": `plan` returns NoneType, expected its part, FieldPart': magnets(
        plan=lambda planning, uses: None
    ),
    'quantity "magnetic_field" reads the field humidity; known fields: body_angvel': magnets(fields=lambda _: {"humidity"}),
    '`gather` of the quantity "magnetic_field" returns 0 values': magnets(gather=lambda part, scene: ()),
    '`gather` of the quantity "magnetic_field": expected a tuple': magnets(gather=lambda part, scene: None),
    'quantity "magnetic_field": its `part` is no frozen dataclass': magnets(part=dict),
    'quantity "a.b": its name has "/" or "."': magnets(name="a.b"),
}


@pytest.mark.parametrize("message", WRONG_QUANTITIES)
def test_mistakes_in_a_quantity_are_named(build, message):
    def read():
        touch = build(kinds=[WRONG_QUANTITIES[message]], hall={"kind": "hall", "links": "pad", "feels": ["item"]})
        return touch(touch.example_state(2))

    with pytest.raises(TgdslError) as error:
        read()
    assert message in str(error.value)


def test_a_peek_and_a_loaded_state_read_the_same(build, tmp_path):
    touch = build(imu={"kind": "accelerometer", "links": "item", "cutoff": 30.0})
    first, second = (touch.example_state(2, seed=seed) for seed in (0, 1))
    touch(first)
    peeked = touch.peek(second)["imu"]
    tgdsl.save(touch, tmp_path / "a.safetensors")
    loaded = tgdsl.load(tmp_path / "a.safetensors", kinds=[ACCELEROMETER], dtype="float64")
    loaded.load_state_dict(touch.state_dict())
    for reading in (touch(second)["imu"], loaded(second)["imu"]):
        torch.testing.assert_close(reading, peeked, rtol=0, atol=0)


def test_a_dipoles_field_matches_the_closed_form(build):
    """B = μ₀/4π 2m/r³ along the axis, −μ₀/4π m/r³ across it, and 0 beyond the range."""
    touch = build(hall={"kind": "hall", "links": "pad", "feels": ["item"], "moment": [0, 0, 0.3], "range": 1.0})
    state = touch.example_state(3)
    state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
    taxel, item = torch.tensor([0.01, 0.002, 0.01], dtype=torch.float64), touch.inputs.bodies.index("item")
    state.body_pos[:] = 0.0
    state.body_pos[:, item] = taxel - torch.tensor([[0, 0, 0.05], [0.05, 0, 0], [0, 0, 1.1]], dtype=torch.float64)
    expected = MU * 0.3 / 0.05**3 * np.array([[0, 0, 2], [0, 0, -1], [0, 0, 0]])
    np.testing.assert_allclose(touch(state)["hall"][:, 0], expected, rtol=1e-12, atol=1e-18)


def test_an_artefact_without_its_quantity_is_refused(build, tmp_path):
    tgdsl.save(build(hall={"kind": "hall", "links": "pad", "feels": ["item"]}), tmp_path / "a.safetensors")
    with pytest.raises(ArtifactError, match='asks for the quantity "magnetic_field", which is not known'):
        tgdsl.load(tmp_path / "a.safetensors")


def test_installed_plugins_appear_in_documents_commands_and_the_schema(tmp_path, monkeypatch, here):
    info = tmp_path / "tgdsl_plugins_example-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tgdsl-plugins-example\nVersion: 0.1.0\n")
    points = (PLUGINS / "pyproject.toml").read_text().split("[project.entry-points.")[1:]
    text = "\n".join(part.split("\n\n")[0].replace('"', "") for part in points).replace("tgdsl.kinds]", "[tgdsl.kinds]")
    (info / "entry_points.txt").write_text(text.replace("tgdsl.quantities]", "[tgdsl.quantities]") + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    installed.cache_clear()
    try:
        code, out, errors = here(tmp_path, "compile", str(PLUGINS / "plugins.yaml"), "-o", "a.safetensors")
        assert (code, errors) == (0, "") and "imu (accelerometer, 5)" in out
        code, out, errors = here(tmp_path, "explain", "a.safetensors")
        assert code == 0 and "poses and velocities of its links" in out
        assert here(tmp_path, "schema")[0] == 0
        definitions = json.loads((tmp_path / "tgdsl.schema.json").read_text())["$defs"]
        assert {"AccelerometerSpec", "HallSpec"} <= definitions.keys()
    finally:
        installed.cache_clear()


@pytest.mark.slow
def test_both_simulators_read_the_same(build):
    from tgdsl.runtime.warp import WarpSimulation

    sensors = {
        "imu": {"kind": "accelerometer", "links": "item", "substeps": 3},
        "hall": {"kind": "hall", "links": "pad", "feels": ["item"], "range": 5.0},
    }
    batch, warp = build(**sensors), build(**sensors)
    sims = tgdsl.simulate(batch, num_envs=2, substeps=3), WarpSimulation(warp, 2, substeps=3, device="cpu")
    for _ in range(3):
        for sim in sims:
            sim.step()
        actual, expected = warp(sims[1].state()), batch(sims[0].state())
        for name in expected:
            scale = float(expected[name].abs().max())
            torch.testing.assert_close(actual[name], expected[name], rtol=0, atol=2e-3 * scale)
