"""Recordings: mistakes are named by key; units, names and clocks are applied."""

import numpy as np
import pytest
from recorded_presses import document, motion, recording
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.calibration.recordings import _Reader, load_recording, velocities
from tgdsl.errors import SpecError, TgdslError
from tgdsl.plan.inputs import Inputs


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    path = document(folder)
    return path, tgdsl.compile(path, dtype="float64"), recording(path)


def read(touch, arrays):
    return load_recording(arrays, touch.inputs, {output.name: output for output in touch.outputs})


def with_value(array, place, value):
    result = array.copy()
    result[place] = value
    return result


BAD = {
    "no clock": (lambda a: a.pop("clock:touch"), "clock:touch: this clock of the target is missing"),
    "no time": (lambda a: a.pop("time"), "time: this clock of the states is missing"),
    "no unit": (lambda a: a.pop("unit:touch"), "unit:touch: the unit of the target is missing"),
    "another unit": (lambda a: a.update({"unit:touch": np.array("mm")}), '"mm" is no unit of this reading, which is in N'),
    "NaN in the target": (
        lambda a: a.update({"target:touch": with_value(a["target:touch"], (3, 1, 2), np.nan)}),
        r"target:touch: \[3, 1, 2\] is nan, 1 such numbers in all; leave the sample out, or set weight:touch to 0 there",
    ),
    "NaN in a pose": (
        lambda a: a.update({"body_pos": with_value(a["body_pos"], (7, 1, 0), np.nan)}),
        r"body_pos: \[7, 1, 0\] is nan",
    ),
    "unsorted": (
        lambda a: a.update({"clock:touch": a["clock:touch"][::-1]}),
        r"clock:touch: \[1\] is 2\.\d+ s after 2\.72 s; expected ascending times",
    ),
    "another name": (lambda a: a.update({"bodies": np.array(["bal", "pad"])}), 'bodies: "ball" is missing; did you mean "bal"'),
    "unknown key": (lambda a: a.update({"targt:touch": np.zeros(3)}), 'targt:touch: unknown key; did you mean "target:touch"'),
    "quaternions of no length": (
        lambda a: a.update({"body_quat": with_value(a["body_quat"], (7, 1), 0.0)}),
        r"body_quat: \[7, 1\] is \[0\. 0\. 0\. 0\.\]; expected a quaternion of length 1, w first",
    ),
    "another shape": (
        lambda a: a.update({"target:touch": a["target:touch"][:, :2]}),
        r"target:touch: found shape \(60, 2, 3\), expected \(60, 3, 3\): samples, taxels, channels",
    ),
    "one row of several": (
        lambda a: a.update({"target:touch": a["target:touch"][:, :1]}),
        r"found shape \(60, 1, 3\), .*; if they are sums of all rows, set rows:touch to \"sum\"",
    ),
    "several rows of a sum": (lambda a: a.update({"rows:touch": np.array("sum")}), r"found shape \(60, 3, 3\), expected \(60, 1, 3\)"),
    "neither each nor sum": (lambda a: a.update({"rows:touch": np.array("all")}), 'rows:touch: found "all"; expected "each" or "sum"'),
    "a name twice": (
        lambda a: a.update({"bodies": np.array(["ball", "pad", "ball"])}),
        'bodies: "ball" stands there 2 times; expected each name once',
    ),
    "zeros alone": (lambda a: a.update({"target:touch": 0 * a["target:touch"]}), "target:touch: all its numbers are 0"),
    "no field": (lambda a: a.pop("body_quat"), "body_quat: this field is missing"),
    "no target": (lambda a: a.pop("target:touch"), "there is no target; expected target:<reading>, of touch"),
    "other times": (lambda a: a.update({"clock:touch": a["clock:touch"] + 100}), "found times from 100.52 to 102.72 s"),
    "a negative width": (lambda a: a.update({"width:body_pos": -np.ones((2, 3))}), "expected standard deviations of at least 0"),
    "a wrong channel": (lambda a: a.update({"channels:touch": np.array(["force_q"])}), '"force_q" is no channel; did you mean'),
}  # fmt: skip


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_mistakes_are_named_by_key(pressed, change, message):
    _, touch, arrays = pressed
    arrays = dict(arrays)
    change(arrays)
    with pytest.raises(SpecError, match=message):
        read(touch, arrays)


@pytest.mark.parametrize(("key", "place"), [("time", 3), ("body_quat", (7, 1, 0))])
def test_an_infinite_number_gives_one_message(pressed, key, place):
    """It is not also out of order, or of another length than 1."""
    _, touch, arrays = pressed
    with pytest.raises(SpecError) as raised:
        read(touch, arrays | {key: with_value(arrays[key], place, np.inf)})
    assert [problem.path for problem in raised.value.problems] == [key]


def test_joints_are_read_in_the_order_of_the_module():
    inputs = Inputs(("joint_pos",), (), (), {}, 0, joints=("bend", "turn"))
    arrays = {"joint_pos": np.array([[1.0, 2.0], [3.0, 4.0]]), "joints": np.array(["turn", "bend"])}
    reader = _Reader("press.npz", arrays, inputs, {})
    np.testing.assert_array_equal(reader._field("joint_pos", 2), [[2, 1], [4, 3]])
    assert not reader.problems


def test_all_mistakes_are_reported_at_once(pressed, tmp_path):
    _, touch, arrays = pressed
    left = {key: value for key, value in arrays.items() if key not in ("clock:touch", "unit:touch")}
    np.savez(tmp_path / "bad.npz", **left)
    with pytest.raises(SpecError) as raised:
        read(touch, tmp_path / "bad.npz")
    assert len(raised.value.problems) == 2
    assert str(raised.value).startswith(f"{tmp_path / 'bad.npz'}: clock:touch: ")


def test_an_unknown_reading_gives_one_message(pressed):
    _, touch, arrays = pressed
    with pytest.raises(SpecError) as error:
        read(touch, {key.replace(":touch", ":toch"): value for key, value in arrays.items()})
    assert str(error.value) == '<arrays>: target:toch: unknown key; did you mean "target:touch"?'


def test_other_files_are_refused(pressed, tmp_path):
    _, touch, _ = pressed
    (tmp_path / "text.npz").write_text("no archive")
    (tmp_path / "empty.npz").touch()
    (tmp_path / "press.csv").write_text("0,1")
    for name, message in (
        ("text.npz", "no .npz file"),
        ("empty.npz", "no .npz file"),
        ("none.npz", "there is no such file"),
        ("press.csv", "a CSV file needs a YAML document"),
    ):
        with pytest.raises(SpecError, match=message):
            read(touch, tmp_path / name)


def test_fewer_numbers_than_unknowns_are_refused(pressed):
    path, _, arrays = pressed
    few = arrays | {"target:touch": arrays["target:touch"][:1], "clock:touch": arrays["clock:touch"][:1]}
    few["weight:touch"] = with_value(np.zeros((1, 3, 3)), (0, 0, 2), 1.0)
    with pytest.raises(TgdslError, match=r"1 numbers in all, expected more than the 2 unknowns: touch\.normal_stiffness"):
        tgdsl.calibrate(path, few, ["touch.normal_stiffness"])


def test_units_weights_and_order_of_names_are_applied(pressed):
    _, touch, arrays = pressed
    other = arrays | {"unit:touch": np.array("mN"), "target:touch": 1e3 * arrays["target:touch"], "floor:touch": np.array(2.0)}
    other |= {"bodies": np.array(["pad", "ball"]), "body_pos": arrays["body_pos"][:, ::-1]}
    other["target:touch"] = with_value(other["target:touch"], (0, 0, 0), np.nan)
    other["weight:touch"] = with_value(np.ones((60, 3, 3)), (0, 0, 0), 0.0)
    converted, plain = read(touch, other), read(touch, arrays)
    assert converted.targets[0].value[1:] == pytest.approx(plain.targets[0].value[1:], rel=1e-12)
    assert converted.targets[0].value[0, 0, 0] == 0 and converted.targets[0].floor == pytest.approx(2e-3)
    assert np.array_equal(converted.fields["body_pos"], plain.fields["body_pos"])


def test_states_are_interpolated_and_velocities_derived(pressed):
    """A body turns at a constant rate: nlerp between steps, and ω from quaternions of either sign."""
    time, rate = np.linspace(0, 1, 401), np.array([0.4, -1.1, 0.7])
    quat = Rotation.from_rotvec(time[:, None] * rate).as_quat()[:, [3, 0, 1, 2]]
    quat[::2] *= -1
    pos = np.stack([np.sin(time), time**2, time], axis=1)
    derived = velocities(time, {"body_pos": pos[:, None], "body_quat": quat[:, None]})
    assert derived["body_angvel"][5:-5, 0] == pytest.approx(np.tile(rate, (391, 1)), abs=1e-5)
    assert derived["body_linvel"][5:-5, 0, 0] == pytest.approx(np.cos(time[5:-5]), abs=1e-5)

    _, touch, arrays = pressed
    states = motion(401)
    states["body_quat"][:, 0] = quat
    states_read = read(touch, arrays | states)
    at = states_read.state_at(np.array([1.00001, 2.3]), states_read.fields)["body_quat"][:, 0]
    exact = Rotation.from_rotvec(np.array([[1.00001], [2.3]]) / 3.0 * rate).as_quat()[:, [3, 0, 1, 2]]
    assert abs((at * exact).sum(axis=1)) == pytest.approx(1.0, abs=1e-9)
