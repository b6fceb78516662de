"""Scripted controls against values by hand, and recordings against their inputs."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.connect import simulate
from tgdsl.runtime.rollout import (
    Recorder,
    Step,
    missed_loads,
    recorded_controls,
    rollout,
    scripted_controls,
    silent_readings,
    touching_bodies,
)

SCENE = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .029">
      <joint name="lift" type="slide" axis="0 0 1"/><joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="box" size=".02 .02 .02" mass=".25"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift"/><motor joint="slide"/></actuator>
  <keyframe><key name="rest" ctrl="0 1"/><key name="squeeze" ctrl="-5 3"/><key name="up" ctrl="1 1"/></keyframe>
</mujoco>
"""


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(SCENE)
    probes = [{"pos": [x, 0, 0.01], "normal": [0, 0, 1]} for x in (0.0, 0.01, 0.025)]
    return {
        "tgdsl": 1,
        "robot": {
            "model": str(path),
            "layout": {"resolutions": {"o": {"pad": {"method": "points", "points": probes, "radius": 0.004}}}},
        },
        "objects": {"cube": {"body": "cube"}},
        "sensors": {
            "touch": {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"], "outputs": ["force"], "readout": "both"},
            "depth": {"kind": "contact_depth", "links": "pad", "feels": ["cube"]},
        },
    }


MODEL = mujoco.MjModel.from_xml_string(SCENE)


def test_scripted_controls_hold_and_move():
    controls = scripted_controls(MODEL, ("rest", "squeeze"), seconds=0.05, control_step=0.01)
    ramp = [[0, 1], [-1.25, 1.5], [-2.5, 2], [-3.75, 2.5], [-5, 3]]
    np.testing.assert_allclose(controls, [[0, 1]] * 5 + ramp + [[-5, 3]] * 5)


def test_scripted_controls_accept_three_or_one_keyframes():
    controls = scripted_controls(MODEL, ("rest", "squeeze", "up"), 0.02, 0.01)
    rest, squeeze, up = [0, 1], [-5, 3], [1, 1]
    np.testing.assert_array_equal(controls, [rest, rest, rest, squeeze, squeeze, squeeze, squeeze, up, up, up])
    np.testing.assert_array_equal(scripted_controls(MODEL, ("up",), 0.03, 0.01), [[1, 1]] * 3)
    np.testing.assert_array_equal(scripted_controls(MODEL, ("up",), 1e-6, 0.01), [[1, 1]])  # always at least one step


def test_invalid_scripts_are_refused():
    with pytest.raises(SimulationError) as caught:
        scripted_controls(MODEL, ("rest", "sqeeze"), 1.0, 0.01)
    assert str(caught.value) == 'the scene has no keyframe "sqeeze"; did you mean "squeeze"?'
    bare = mujoco.MjModel.from_xml_string("<mujoco/>")
    with pytest.raises(SimulationError, match=r'^the scene has no keyframe "rest"; there are no keyframes$'):
        scripted_controls(bare, ("rest",), 1.0, 0.01)
    for keyframes, seconds in (((), 1.0), (("rest",), 0.0), (("rest",), -1.0), (("rest",), np.nan), (("rest",), np.inf)):
        with pytest.raises(SimulationError, match=r"expected at least one, and more than 0 s$"):
            scripted_controls(MODEL, keyframes, seconds, 0.01)


@pytest.mark.parametrize("shape", [(4, 2), (4, 3, 2)])
def test_recorded_controls_round_trip(tmp_path, shape):
    controls = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    np.savez_compressed(tmp_path / "c.npz", ctrl=controls, other=np.zeros(3))
    loaded = recorded_controls(tmp_path / "c.npz")
    assert loaded.dtype == np.float64
    np.testing.assert_array_equal(loaded, controls)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"control": np.zeros((3, 2))}, "expected an .npz file with an array `ctrl`: "),
        ({"ctrl": np.zeros(3)}, "`ctrl` is float64 of shape (3,), expected floats (step, actuator) or (step, env, actuator)"),
        ({"ctrl": np.zeros((3, 2), int)}, "`ctrl` is int64 of shape (3, 2), expected floats "),
        ({"ctrl": np.zeros((0, 2))}, "`ctrl` is float64 of shape (0, 2), expected floats "),
        ({"ctrl": np.array([["a", "b"]])}, "`ctrl` is <U1 of shape (1, 2), expected floats "),
        ({"ctrl": np.array([[{}]])}, "expected an .npz file with an array `ctrl`: Object arrays cannot be loaded"),
    ],
    ids=["name", "flat", "integers", "no_steps", "text", "objects"],
)
def test_invalid_recorded_controls_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "c.npz", **arrays)
    with pytest.raises(SimulationError) as caught:
        recorded_controls(tmp_path / "c.npz")
    assert str(caught.value).startswith(f"{tmp_path / 'c.npz'}: {message}")


def test_recorded_controls_that_are_not_an_archive_are_refused(tmp_path):
    np.savez(tmp_path / "whole.npz", ctrl=np.zeros((3, 2)))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "whole.npz").read_bytes()[:60])
    (tmp_path / "text.npz").write_text("hello")
    (tmp_path / "empty.npz").write_bytes(b"")
    np.save(tmp_path / "array.npy", np.zeros((3, 2)))
    for name in ("cut.npz", "text.npz", "empty.npz", "array.npy", "none.npz"):
        with pytest.raises(SimulationError, match=rf"{name}: expected an \.npz file with an array `ctrl`: "):
            recorded_controls(tmp_path / name)


def test_rollout_equals_the_loop_of_a_user(document):
    touch = tgdsl.compile(document)
    controls = scripted_controls(MODEL, ("rest", "squeeze"), 0.04, 0.01)
    steps = list(rollout(touch, simulate(touch, 2, substeps=2), controls))
    assert [step.index for step in steps] == list(range(12))
    np.testing.assert_allclose([step.time for step in steps], 0.01 * np.arange(1, 13))
    sim = simulate(touch, 2, substeps=2)
    for step, control in zip(steps, controls, strict=True):
        sim.step(control)
        for name, reading in touch(sim.state()).items():
            assert torch.equal(reading, step.readings[name])
    assert steps[-1].readings["depth"].max() > 0


def test_controls_may_differ_between_environments(document):
    touch = tgdsl.compile(document)
    controls = np.zeros((3, 2, 2))
    controls[:, 1, 0] = 100.0  # lifts the second cube
    *_, last = rollout(touch, simulate(touch, 2, substeps=10), controls)
    depth = last.readings["depth"]
    assert depth[0].max() > 0
    assert not depth[1].any()


@pytest.mark.parametrize("controls", [np.zeros((3, 2)), np.zeros((3, 4, 2))], ids=["for_all", "for_each"])
def test_a_recording_has_its_readings_units_and_layout(document, tmp_path, controls):
    touch = tgdsl.compile(document)
    recorder = Recorder(touch, 3, 4)
    rng = np.random.default_rng(0)
    recorded = {output.name: rng.normal(size=(3, 4, *output.shape)).astype(np.float32) for output in touch.outputs}
    for index in range(3):
        readings = {name: torch.from_numpy(values[index]).double().requires_grad_() for name, values in recorded.items()}
        recorder.add(Step(index, 0.1 * (index + 1), readings, torch.full((4, 7), float(index))))
    recorder.write(tmp_path / "r.npz", controls, Path("scene.yaml"), ["a", "b"])
    with np.load(tmp_path / "r.npz", allow_pickle=False) as archive:
        arrays = dict(archive)
    units = {f"{name}:{part}" for name in recorded for part in ("channels", "units")}
    layout_keys = {f"{name}:{part}" for name in recorded for part in ("link", "body", "pos", "normal", "area")}
    assert (
        arrays.keys()
        == {"time", "ctrl", "actuators", "qpos", "document", "touch", "touch/clean", "depth"} | units | layout_keys
    )
    np.testing.assert_allclose(arrays["time"], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(arrays["ctrl"], controls)
    for name, values in recorded.items():
        assert arrays[name].dtype == np.float32
        np.testing.assert_array_equal(arrays[name], values)
    assert arrays["touch:channels"].tolist() == ["force_x", "force_y", "force_z"]
    assert arrays["touch/clean:units"].tolist() == ["N"] * 3
    assert (arrays["depth:channels"].tolist(), arrays["depth:units"].tolist()) == (["depth"], ["m"])
    for name in recorded:  # the points of the layout, by hand
        assert arrays[f"{name}:link"].tolist() == arrays[f"{name}:body"].tolist() == ["pad"] * 3
        np.testing.assert_allclose(arrays[f"{name}:pos"], [[0, 0, 0.01], [0.01, 0, 0.01], [0.025, 0, 0.01]])
        np.testing.assert_allclose(arrays[f"{name}:normal"], [[0, 0, 1]] * 3)
        np.testing.assert_allclose(arrays[f"{name}:area"], np.pi * 0.004**2)
    assert [path.name for path in tmp_path.iterdir()] == ["r.npz"]


def test_a_recording_of_bodies_names_them(document, tmp_path):
    sensors = {"solver": {"kind": "link_contact", "links": "pad", "feels": ["cube"]}}
    touch = tgdsl.compile({**document, "sensors": sensors})
    recorder = Recorder(touch, 1, 1)
    recorder.add(Step(0, 0.1, {"solver": torch.zeros(1, 1, 4)}, torch.zeros(1, 7)))
    recorder.write(tmp_path / "r.npz", np.zeros((1, 2)), Path("scene.yaml"), ["a", "b"])
    with np.load(tmp_path / "r.npz", allow_pickle=False) as archive:
        assert archive["solver:body"].tolist() == ["pad"]
        assert not {"solver:pos", "solver:link"} & set(archive)


def test_a_failed_recording_leaves_no_file(document, tmp_path, monkeypatch):
    recorder = Recorder(tgdsl.compile(document), 1, 1)

    def fail(*_: object) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match=r"no space"):
        recorder.write(tmp_path / "r.npz", np.zeros((1, 2)), Path("scene.yaml"), ["a", "b"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("clearance", [-1e-3, 1e-3])
def test_an_object_is_touched_when_surfaces_overlap(document, clearance):
    touch = tgdsl.compile(document)
    sim = simulate(touch, 2)
    sim.set_state([0], qpos=np.array([0.001 + clearance, 0.0]))  # at 0, the cube is a millimetre deep
    sim.set_state([1], qpos=np.array([0.001 - clearance, 0.0]))
    assert bool(touching_bodies(touch, sim)) == (clearance < 0)


@pytest.mark.parametrize(("clearance", "is_contact"), [(-1e-3, True), (1e-3, True), (3e-3, False), (6e-3, False)])
def test_within_a_gap_no_object_is_touched(document, tmp_path, clearance, is_contact):
    """Within the margin of 2 mm MuJoCo makes constraints; in the gap of 3 mm beyond, it only detects contacts."""
    (tmp_path / "gap.xml").write_text(SCENE.replace('size=".03 .03 .01"', 'size=".03 .03 .01" margin=".002" gap=".003"'))
    touch = tgdsl.compile({**document, "robot": {**document["robot"], "model": str(tmp_path / "gap.xml")}})
    sim = simulate(touch, 1)
    sim.set_state([0], qpos=np.array([0.001 + clearance, 0.0]))
    data = mujoco.MjData(sim.model)
    data.qpos[:] = 0.001 + clearance, 0.0
    mujoco.mj_forward(sim.model, data)
    assert (data.ncon > 0) == (clearance < 5e-3)
    assert bool(touching_bodies(touch, sim)) == is_contact == (data.nefc > 0)


@pytest.mark.parametrize("faces_up", [True, False])
def test_taxels_on_an_untouched_side_are_silent(document, faces_up):
    """A grid along −z lies on the side that faces the cube, one along +z on the other side."""
    grid = {"method": "grid", "rows": 2, "columns": 2, "direction": [0, 0, -1 if faces_up else 1], "radius": 0.002}
    layout = {"resolutions": {"o": {"pad": grid}}}
    sensors = {"depth": document["sensors"]["depth"]}
    touch = tgdsl.compile({**document, "robot": {**document["robot"], "layout": layout}, "sensors": sensors})
    assert len(touch.taxels["depth"]) == 4
    sim = simulate(touch, 1)
    silent = silent_readings(touch, sim, touch(sim.state()), touching_bodies(touch, sim))
    assert silent == ({} if faces_up else {"depth": ["pad"]})


@pytest.mark.parametrize(("cube", "is_contact"), [(0.03, True), (0.1, False)])
def test_touching_bodies_accepts_flexes(document, tmp_path, cube, is_contact):
    """A cloth penetrates a floor; its contacts have no geom, and the cube has the last geom."""
    cloth = """<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".02 .02 .02" radius=".002" mass=".1" pos=".5 0 0">
      <contact selfcollide="none"/><edge equality="true"/></flexcomp>
    <geom name="floor" type="box" size=".1 .1 .01" pos=".5 0 -.01"/>"""
    text = SCENE.replace("<worldbody>", f"<worldbody>{cloth}").replace('pos="0 0 .029"', f'pos=".5 0 {cube - 0.01}"')
    (tmp_path / "cloth.xml").write_text(text)
    touch = tgdsl.compile({**document, "robot": {**document["robot"], "model": str(tmp_path / "cloth.xml")}})
    sim = simulate(touch, 1)
    assert sim.model.nflex == 1 and sim.model.geom(sim.model.ngeom - 1).bodyid == sim.model.body("cube").id
    assert bool(touching_bodies(touch, sim)) == is_contact


@pytest.mark.parametrize(("x", "is_told"), [(0.0, False), (0.022, True)])
def test_a_load_away_from_all_taxels_is_reported(tmp_path, x, is_told):
    """A cube at rest presses with m g, on the taxels or two centimetres away."""
    scene = SCENE.replace(
        '<joint name="lift" type="slide" axis="0 0 1"/><joint name="slide" type="slide" axis="1 0 0"/>', "<freejoint/>"
    )
    scene = (
        scene.split("<actuator>")[0].replace('pos="0 0 .029"', f'pos="{x} 0 .0149"').replace(".02 .02 .02", ".005 .005 .005")
        + "</mujoco>"
    )
    (tmp_path / "scene.xml").write_text(scene)
    probes = [{"pos": [0.002 * i, 0, 0.01], "normal": [0, 0, 1]} for i in (-1, 0, 1)]
    layout = {"resolutions": {"o": {"pad": {"method": "points", "points": probes, "radius": 0.002}}}}
    sensor = {"kind": "force_taxel", "links": "pad", "feels": ["cube"]}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": layout},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"load": sensor},
        }
    )
    sim = simulate(touch, 1)
    for _ in range(200):
        sim.step()
    messages = missed_loads(touch, touch(sim.state()))
    weight = f"{0.25 * 9.81:.3g}"
    expected = f'"load" misses {weight} of {weight} N, which act where none of its taxels is'
    assert messages == ({"load/missed": expected} if is_told else {})
