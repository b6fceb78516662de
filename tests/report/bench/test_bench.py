"""A whole bench of a small scene: independent errors, repeatability and refused requests."""

import csv
import json
import warnings
from html.parser import HTMLParser

import mujoco
import numpy as np
import pytest
import torch
from benched_pads import bench_document

import tgdsl
from tgdsl.errors import StateError, TgdslError
from tgdsl.module.accuracy.states import narrowed, readings_of
from tgdsl.module.state import SceneState
from tgdsl.report.bench.bench import Bench, Options, bench
from tgdsl.report.bench.page import write_bench
from tgdsl.report.bench.physics import coordinates
from tgdsl.report.bench.results import rows_of
from tgdsl.tuning.recording import Recording, load_recording, record, save_recording, varied
from tgdsl.tuning.trials import Cost

FEW = Options(num_envs=(3, 5), repeats=2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("bench")


@pytest.fixture(scope="module")
def work(folder):
    return Bench(bench_document(folder), save_states=folder / "states.npz", state_envs=4, steps=9, options=FEW)


@pytest.fixture(scope="module")
def report(work):
    return bench(work)


@pytest.mark.slow
def test_every_subject_has_three_points_and_one_current(report):
    assert [subject.name for subject in report.subjects] == ["depth", "skin", "physics"]
    for subject in report.subjects:
        assert len(subject.points) >= 3 and sum(point.is_own for point in subject.points) == 1
        assert any(point.is_on_front for point in subject.points)


@pytest.mark.slow
def test_errors_equal_those_of_compiled_modules(report, folder):
    """Float32 and bfloat16 against float64, recomputed from the recorded states."""
    recording = load_recording(folder / "states.npz")
    change = {"observations": "{}"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        touches = [
            tgdsl.compile(folder / "pad.yaml", sensors=["depth"], overrides=change, dtype=d) for d in ("float64", "float32")
        ]
    exact, rough = (torch.stack([t(s)["depth"].double() for s in recording.for_module(t.inputs)])[:, :2] for t in touches)
    readings = torch.stack([touches[0](s)["depth"] for s in recording.for_module(touches[0].inputs)])
    scale = (readings - readings.flatten().median()).abs().max()
    assert scale > 1e-3
    depth = report.subjects[0]
    assert depth.own.chosen.largest.value == pytest.approx(float((rough - exact).abs().max() / scale), rel=1e-9)
    rounded = next(point for point in depth.points if point.precision == "bfloat16 readings")
    assert rounded.chosen.largest.value == pytest.approx(
        float((rough.bfloat16().double() - exact).abs().max() / scale), rel=1e-9
    )
    assert 1e-9 < depth.own.chosen.largest.value < 1e-5 < rounded.chosen.largest.value < 2**-8


@pytest.mark.slow
def test_the_definition_agrees_with_the_reference(report):
    assert float(report.subjects[0].check.split(" by ")[1].split()[0]) < 1e-12


@pytest.mark.slow
def test_a_truncated_operator_is_off_by_about_its_tolerance(report):
    """Relative errors of the matrix bound those of its products, up to the loads' conditioning."""
    errors = {point.label: point.chosen.rms.value for point in report.subjects[1].points if point.precision == "float32"}
    assert errors["svd, 10 %"] < 1.0 and errors["svd, 1 %"] < 0.1
    assert errors["dense"] < 1e-5
    assert report.subjects[1].reference.startswith("dense")


@pytest.mark.slow
def test_every_number_of_environments_is_timed(report):
    assert all(set(point.times) == {3, 5} for subject in report.subjects[:2] for point in subject.points)


@pytest.mark.slow
def test_counted_bytes_match_the_tensors(report):
    """16 taxels of one number: 64 bytes in float32; a sensor without imperfections and shear has no state."""
    single, double, half = report.subjects[0].points
    assert (single.cost.output, double.cost.output, half.cost.output) == (64, 128, 32)
    assert single.cost.state == report.subjects[1].own.cost.state == 0


@pytest.mark.slow
def test_two_runs_agree_on_errors_exactly(work, report):
    repeated = bench(Bench(work.document, states=work.save_states, sensors=("skin",), options=FEW))
    for one, two in zip(report.subjects[1].points, repeated.subjects[0].points, strict=True):
        assert (one.chosen, one.verified, one.cost) == (two.chosen, two.verified, two.cost)
    physics = bench(Bench(work.document, sensors=("physics",), state_envs=4, steps=9, options=FEW)).subjects[0]
    assert [p.chosen for p in physics.points] == [p.chosen for p in report.subjects[2].points]


class Links(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.links, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src", "xlink:href") and value]

    def handle_decl(self, decl):
        self.links += [decl] if "http" in decl else []


@pytest.mark.slow
def test_the_page_opens_offline(report, folder):
    files = {file.suffix: file for file in write_bench(report, folder / "out")}
    text = files[".html"].read_text()
    parser = Links()
    parser.feed(text)
    assert parser.tags.count("svg") == parser.tags.count("table") == 3
    assert not {"script", "link", "img", "iframe"} & set(parser.tags) and "http" not in text and "@import" not in text
    assert all(link.startswith("#") for link in parser.links)
    identifiers = [part.split('"')[0] for part in text.split(' id="')[1:] if part.startswith("m")]
    assert len(identifiers) == len(set(identifiers))
    with files[".csv"].open() as file:
        rows = list(csv.DictReader(file))
    content = json.loads(files[".json"].read_text())
    assert len(rows) == len(content["rows"]) == len(list(rows_of(report)))
    assert float(rows[0]["rms"]) == content["rows"][0]["rms"] == report.subjects[0].points[0].chosen.rms.value


@pytest.mark.slow
def test_saved_states_load_unchanged(folder, work, report, tmp_path):
    touch = tgdsl.compile(work.document, overrides={"observations": "{}"})
    recording = record(touch, 3, steps=6)
    save_recording(recording, tmp_path / "s.npz")
    loaded = load_recording(tmp_path / "s.npz")
    for before_saving, after_loading in zip(recording.for_module(touch.inputs), loaded.for_module(touch.inputs), strict=True):
        for name in touch.inputs.fields:
            assert name == "dt" or torch.equal(getattr(before_saving, name), getattr(after_loading, name))
        assert before_saving.dt == after_loading.dt


def test_states_by_hand_load_unchanged(tmp_path):
    pos = torch.arange(12.0, dtype=torch.float64).reshape(2, 2, 1, 3)
    states = tuple(SceneState(body_pos=pos[i], dt=0.01) for i in range(2))
    save_recording(Recording(states, {"body": ("cube",)}, "by hand"), tmp_path / "s.npz")
    loaded = load_recording(tmp_path / "s.npz")
    assert loaded.source == f"{tmp_path / 's.npz'}: 2 steps in 2 environments" and loaded.names == {"body": ["cube"]}
    for state, expected in zip(loaded.states, pos, strict=True):
        assert torch.equal(state.body_pos, expected) and state.body_quat is None and state.dt == 0.01


@pytest.mark.slow
def test_narrowed_states_read_the_same(work):
    """A module of one sensor reads the same from the states as the module of all sensors."""
    everything = tgdsl.compile(work.document, overrides={"observations": "{}"}, dtype="float64")
    recording = record(everything, 2, steps=6)
    alone = tgdsl.compile(work.document, overrides={"observations": "{}"}, sensors=["depth"], dtype="float64")
    np.testing.assert_array_equal(
        readings_of(alone, recording.for_module(alone.inputs), "depth"), readings_of(everything, recording.states, "depth")
    )


def test_varied_controls_differ_between_environments_within_their_range():
    controls, ranges = np.linspace([0.0, 0.0], [1.0, 5.0], 7), np.array([[0.0, 1.0], [0.0, 0.0]])
    samples = varied(controls, ranges, 6, seed=0)
    np.testing.assert_array_equal(samples[:, 0], controls)
    assert samples[..., 0].min() >= 0 and samples[..., 0].max() <= 1
    assert len(np.unique(samples[-1], axis=0)) == 6
    np.testing.assert_array_equal(samples, varied(controls, ranges, 6, seed=0))


def test_varied_controls_sway_at_least_twice_in_a_run():
    """Periods of 0.05 to 0.4 runs have 5 to 40 turning points; the peaks are 6 % of the control's range apart."""
    samples = varied(np.ones((2000, 1)), np.array([[0.0, 5.0]]), 40, seed=0)[:, 1:, 0]
    turns = (np.diff(np.sign(np.diff(samples, axis=0)), axis=0) != 0).sum(axis=0)
    assert 5 <= turns.min() < 8 and 20 < turns.max() <= 40
    np.testing.assert_allclose(np.ptp(samples, axis=0), 0.06 * 5.0, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"sensors": ("dept",)}, 'there is no sensor "dept"; did you mean "depth"?'),
        ({"options": Options(num_envs=(0,))}, "environments that are timed: found 0, expected numbers of at least 1"),
        ({"options": Options(num_envs=())}, "environments that are timed: found none, expected numbers of at least 1"),
        ({"options": Options(repeats=0)}, "timed calls: found 0, expected at least 1"),
        ({"state_envs": 1}, "1 environments of 90 steps: expected at least 2, and at least one step"),
    ],
)
def test_unmeasurable_requests_are_refused(work, wrong, message):
    with pytest.raises(TgdslError) as caught:
        bench(Bench(work.document, **wrong))
    assert str(caught.value) == message


@pytest.mark.slow
def test_states_of_another_document_are_refused(work, report, tmp_path):
    arrays = dict(np.load(work.save_states))
    arrays["names:body"] = np.array(["pad", "ball"])
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(StateError, match="these states lack the body cube: they are of another document"):
        bench(Bench(work.document, states=tmp_path / "other.npz", sensors=("depth",), options=FEW))


@pytest.mark.parametrize("content", [b"", b"no zip", {"ctrl": 3}, {"body_pos": (2, 2, 1, 3)}, {"names:body": 1}])
def test_files_without_states_are_refused(tmp_path, content):
    path = tmp_path / "s.npz"
    if isinstance(content, dict):
        np.savez(path, **{name: np.zeros(shape) for name, shape in content.items()})
    else:
        path.write_bytes(content)
    with pytest.raises(StateError, match=r"s\.npz: expected "):
        load_recording(path)


@pytest.mark.slow
def test_a_missing_field_is_named(work, report):
    touch = tgdsl.compile(work.document, overrides={"observations": "{}"})
    recording = load_recording(work.save_states)
    recording.states[0].contact_found = None
    with pytest.raises(StateError, match="these states have no contact_found"):
        narrowed(recording.states[0], recording.names, touch.inputs)


BLOCKS = (
    "  sound: {kind: contact_audio, links: pad, feels: [cube], samples: 8, substeps: 5, modes: [{frequency: 500, decay: 10}]}"
)


def physics_of(folder, more=""):
    path = bench_document(folder)
    path.write_text(path.read_text().replace("observations:", f"{more}\nobservations:"))
    return bench(Bench(path, sensors=("physics",), state_envs=4, steps=9, options=FEW)).subjects[0]


@pytest.fixture(scope="module")
def physics(tmp_path_factory):
    return physics_of(tmp_path_factory.mktemp("physics"))


def test_sensors_that_read_blocks_do_not_change_the_physics(physics, tmp_path):
    """Even though the bench tries other time steps than theirs."""
    assert [point.chosen for point in physics_of(tmp_path, BLOCKS).points] == [point.chosen for point in physics.points]


def test_physics_is_compared_with_a_finer_run(physics):
    """A quarter of the time step: half the time step is nearer to it. The state is two angles or positions and two speeds."""
    errors = {point.label: point.chosen.rms.value for point in physics.points}
    assert 0 < errors["time step 1 ms"] < physics.own.chosen.rms.value < errors["time step 10 ms"]
    assert physics.own.label.startswith("as written") and sum(point.is_own for point in physics.points) == 1
    assert physics.own.cost == Cost(None, 0, 4 * 8, 4 * 8)


def test_orientations_are_left_out_of_the_physics():
    joints = ("<freejoint/>", '<joint type="ball"/>', '<joint type="hinge"/>', '<joint type="slide"/>')
    bodies = "".join(f'<body>{joint}<geom size=".1"/></body>' for joint in joints)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    assert coordinates(model) == ([0, 1, 2, 11, 12], ["position"] * 3 + ["angle", "position"])
