"""Fits of counts to forces for hands with known parameters, and the command's files."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_logs import random_readings, write_log

import tgdsl
from tgdsl.calibration.hand.fit import FingerFit, FitError, fit_finger, time_offset
from tgdsl.calibration.hand.loads import (
    Load,
    Samples,
    TipRecord,
    known_tip_forces,
    load_loads,
    samples_under_forces,
    samples_under_loads,
    simulated_tip_forces,
)
from tgdsl.calibration.hand.report import calibrated, drawing, picture, report
from tgdsl.errors import SpecError, TgdslError
from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.log.log import open_log
from tgdsl.runtime.xhand1.wire.protocol import FORCE_MAX, FORCE_MIN

AXES = np.eye(3)
PRESSES = np.concatenate([np.zeros((1, 3)), 2 * AXES, -2 * AXES, [[1.0, 1.0, 3.0], [0.5, -1.0, 4.0]]])
SCALE, TARE = np.array([0.05, 0.08, 0.1]), np.array([7.0, -12.0, 21.0])


def rotation(seed: int, is_mirrored: bool = False) -> np.ndarray:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return turn * (-1 if (np.linalg.det(turn) < 0) != is_mirrored else 1)


def counts_of(force: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return (force @ turn) / SCALE + TARE


@pytest.mark.parametrize("is_mirrored", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_fits_recover_the_true_parameters(seed, is_mirrored):
    turn = rotation(seed, is_mirrored)
    fit = fit_finger(counts_of(PRESSES, turn), PRESSES)
    assert fit.scale == pytest.approx(SCALE, rel=1e-6)
    assert fit.rotation == pytest.approx(turn, abs=1e-6)
    assert fit.tare == pytest.approx(TARE, abs=1e-5)
    assert fit.max_error.max() < 1e-6
    assert fit.r_squared == pytest.approx(np.ones(3))
    assert np.linalg.det(fit.rotation) == pytest.approx(-1 if is_mirrored else 1)


def test_a_known_tare_needs_no_unloaded_frame():
    turn, presses = rotation(3), np.repeat(2 * AXES, 2, axis=0)
    fit = fit_finger(counts_of(presses, turn), presses, tare=TARE)
    assert fit.scale == pytest.approx(SCALE, rel=1e-6)
    assert fit.tare == pytest.approx(TARE)


def test_signs_are_straight_lines_per_axis():
    turn = np.diag([-1.0, 1.0, -1.0])
    fit = fit_finger(counts_of(PRESSES, turn), PRESSES, axes="signs")
    assert (fit.rotation == turn).all()
    assert fit.scale == pytest.approx(SCALE)
    noisy = counts_of(PRESSES, turn) + np.random.default_rng(0).normal(size=PRESSES.shape)
    fit = fit_finger(noisy, PRESSES, axes="signs")
    for axis in range(3):  # force over counts, as by np.polyfit
        slope, height = np.polyfit(noisy[:, axis], PRESSES[:, axis], 1)
        assert fit.scale[axis] == pytest.approx(abs(slope))
        assert fit.tare[axis] == pytest.approx(-height / slope)


def test_rounding_errors_stay_below_a_count():
    """Errors are at most half a count per axis; the scale over many presses is far more accurate."""
    rng, turn = np.random.default_rng(2), rotation(8)
    force = rng.uniform([-2, -2, 0], [2, 2, 5], (400, 3))
    fit = fit_finger(np.round(counts_of(force, turn)), force)
    assert fit.max_error.max() < 0.75 * np.linalg.norm(SCALE)
    assert fit.rms.max() < SCALE.max() / math.sqrt(12) * 1.1
    assert fit.scale == pytest.approx(SCALE, rel=3e-3)
    assert fit.rotation == pytest.approx(turn, abs=3e-3)


def test_noise_is_averaged_and_reported():
    rng, turn, sigma = np.random.default_rng(4), rotation(9, True), 3.0
    force = np.repeat(PRESSES, 500, axis=0)
    noise = rng.normal(scale=sigma, size=force.shape)
    fit = fit_finger(counts_of(force, turn) + noise, force)
    expected = np.sqrt(((turn * SCALE) ** 2).sum(axis=1)) * sigma
    assert fit.rms == pytest.approx(expected, rel=0.05)
    assert fit.scale == pytest.approx(SCALE, rel=0.05)
    assert fit.rotation == pytest.approx(turn, abs=0.03)
    assert fit.r_squared == pytest.approx(1 - (expected / force.std(axis=0)) ** 2, abs=0.02)


def test_the_fit_is_a_local_minimum():
    """Rotating it or changing a scale increases the errors."""
    rng, turn = np.random.default_rng(6), rotation(1)
    force = rng.uniform(-3, 3, (60, 3))
    counts = counts_of(force, turn) + rng.normal(scale=5, size=force.shape)
    fit = fit_finger(counts, force, tare=TARE)

    def cost(scale: np.ndarray, matrix: np.ndarray) -> float:
        return float((((counts - TARE) * scale @ matrix.T - force) ** 2).sum())

    best = cost(fit.scale, fit.rotation)
    for axis in range(3):
        for step in (-1e-3, 1e-3):
            cos, sin = math.cos(step), math.sin(step)
            small = np.roll([[1, 0, 0], [0, cos, -sin], [0, sin, cos]], (axis, axis), (0, 1))
            assert cost(fit.scale, small @ fit.rotation) > best
            assert cost(fit.scale * (1 + step * AXES[axis]), fit.rotation) > best


@pytest.mark.parametrize(
    ("presses", "says"),
    [
        (PRESSES[:, :] * [1, 1, 0], "no load along z of the link; expected loads along x, y and z, and no load as one of them"),
        (PRESSES * [0, 0, 1], "no load along x or y of the link"),
        (np.ones((9, 3)), "no load along x or y or z of the link"),
        (PRESSES @ [[1, 1, 0], [1, 1, 0], [0, 0, 1]], r"no load in the direction \(-?0\.71, -?0\.71, -?0\.00\) of the link: all loads lie in a plane"),
        (PRESSES[:3], "3 frames, expected at least 4"),
    ],
)  # fmt: skip
def test_insufficient_loads_are_refused(presses, says):
    with pytest.raises(FitError, match=says):
        fit_finger(counts_of(presses, rotation(0)), presses)


def test_a_sensor_that_is_blind_to_an_axis_is_refused():
    counts = counts_of(PRESSES, np.eye(3))
    counts[:, 1] = 5
    with pytest.raises(FitError, match="the fingertip's counts along its y say nothing of the loads"):
        fit_finger(counts, PRESSES)


# time


def swings(time: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """Return an irregular force along three axes over time."""
    t = time - shift
    press = np.maximum(np.sin(2.1 * t) + 0.5 * np.sin(5.3 * t + 1), 0)
    return np.column_stack([0.5 * press * np.sin(1.7 * t), 0.3 * press * np.cos(2.9 * t), 3 * press])


@pytest.mark.parametrize("offset", [-1.3, -0.0173, 0.0, 0.4321, 1.9])
def test_a_time_offset_is_found(offset):
    turn, rng = rotation(5, True), np.random.default_rng(0)
    time, known_time = np.cumsum(rng.uniform(0.008, 0.013, 1200)), np.arange(0, 12, 0.01)
    counts = np.round(counts_of(swings(time, offset), turn) + rng.normal(size=(1200, 3)))
    estimated = time_offset(time, counts, known_time, swings(known_time), 2.0)
    assert estimated == pytest.approx(offset, abs=1e-3)


def test_constant_or_disjoint_series_are_refused():
    time = np.arange(0, 5, 0.01)
    with pytest.raises(FitError, match="the counts are always the same"):
        time_offset(time, np.ones((500, 3)), time, swings(time), 1.0)
    with pytest.raises(FitError, match="the known forces are always the same"):
        time_offset(time, swings(time), time, np.ones((500, 3)), 1.0)
    with pytest.raises(FitError, match="no time in common"):
        time_offset(time, swings(time), time + 100, swings(time), 1.0)


# logs


def pressed_log(path, force, times, turn=None, taxels=None):
    """Write a log of an index finger under forces over time; the rest is unloaded at its tare."""
    turn = np.eye(3) if turn is None else turn
    readings = []
    for i, (reading, now) in enumerate(zip(random_readings(100 + times), times, strict=True)):
        total = np.tile(TARE, (5, 1))
        total[1] = counts_of(force(now), turn)
        total = np.clip(np.round(total), FORCE_MIN, FORCE_MAX).astype(np.int16)
        taxel = np.zeros((5, 120, 3), dtype=np.int16)
        for number in (taxels or {}).get(i, ()):
            taxel[1, number, 2] = 255
        readings.append(replace(reading, state=replace(reading.state, total_force=total, taxel_force=taxel)))
    return open_log(write_log(path, readings))


def staircase(now: float) -> np.ndarray:
    """Return the press at a time: one per second."""
    return PRESSES[min(int(now), len(PRESSES) - 1)]


LOADS = tuple(Load(finger="index", start=i + 0.1, end=i + 0.9, force=tuple(press)) for i, press in enumerate(PRESSES.tolist()))


def test_saturated_samples_are_left_out(tmp_path):
    times = np.arange(0, len(PRESSES), 0.05)
    log = pressed_log(tmp_path / "a.npz", staircase, times, rotation(2), {25: (3, 99), 26: (3,), 0: (7,)})
    samples = samples_under_loads(TipRecord.of(log), "index", LOADS)
    during = [i for i, now in enumerate(times - 0.008) if 0.1 <= now % 1 <= 0.9]
    assert (samples.num_left_out, samples.saturated_taxels) == (2, (3, 99))
    assert len(samples.counts) == len(during) - 2
    expected = np.array([staircase(times[i]) for i in during if i not in (25, 26)])
    assert (samples.force == expected).all()
    fit = fit_finger(samples.counts, samples.force)
    assert fit.scale == pytest.approx(SCALE, rel=0.02)
    assert report({"index": fit}, {"index": samples})[-1] == "  left out at the end of the range: 2 readings; taxels 3, 99"
    without_taxels = samples_under_loads(TipRecord.of(log, (3, 99)), "index", LOADS)
    assert (without_taxels.num_left_out, len(without_taxels.counts)) == (0, len(during))
    with pytest.raises(FitError, match="taxels 120: expected numbers from 0 to 119"):
        TipRecord.of(log, (120,))


def test_a_press_beyond_the_range_is_left_out(tmp_path):
    def force(now: float) -> np.ndarray:
        return staircase(now) * (20 if now >= 8 else 1)

    log = pressed_log(tmp_path / "a.npz", force, np.arange(0, len(PRESSES), 0.02))
    samples = samples_under_loads(TipRecord.of(log), "index", LOADS)
    assert samples.num_left_out == 40
    assert samples.saturated_taxels == ()
    fit = fit_finger(samples.counts, samples.force, axes="signs")
    assert fit.scale == pytest.approx(SCALE, rel=0.02)
    with pytest.raises(FitError, match=r"index: in all 40 readings its sum is at the end of the range; expected smaller loads"):
        samples_under_loads(TipRecord.of(log), "index", LOADS[8:])


def test_loads_outside_the_log_are_refused(tmp_path):
    record = TipRecord.of(pressed_log(tmp_path / "a.npz", staircase, np.arange(0, 2, 0.05)))
    late = Load(finger="index", start=7, end=8, force=(0, 0, 1))
    with pytest.raises(FitError, match=r"index: from 7 s to 8 s the log holds no reading; it goes from 0 s to 1\.942 s"):
        samples_under_loads(record, "index", (late,))
    one, other = (Load(finger="index", start=0, end=1 + i, force=(0, 0, 1)) for i in (0, 0.5))
    with pytest.raises(FitError, match=r"index: from 0 s to 1\.5 s there are two loads at once"):
        samples_under_loads(record, "index", (one, other))
    with pytest.raises(FitError, match="index: there is no reading while its force is known"):
        samples_under_forces(record, "index", np.array([50.0, 60.0]), np.zeros((2, 3)))


def test_files_of_loads_are_read_and_checked(tmp_path):
    file = tmp_path / "loads.yaml"
    file.write_text("tgdsl: 1\nloads:\n  - {finger: index, start: 500 ms, end: 2, force: [0, 0, -500 mN]}\n")
    assert load_loads(file) == (Load(finger="index", start=0.5, end=2.0, force=(0.0, 0.0, -0.5)),)
    file.write_text(
        "tgdsl: 1\nloads:\n  - {finger: indx, start: 2, end: 1, force: [0, 0]}\n  - {finger: ring, start: 2, end: 1, force: [0, 0, 1]}\n"
    )
    with pytest.raises(SpecError) as caught:
        load_loads(file)
    lines = str(caught.value).replace(f"{tmp_path}/", "").splitlines()
    assert (
        lines[0] == "loads.yaml:3:14: loads[0].finger: found \"indx\", expected 'thumb', 'index', 'middle', 'ring' or 'pinky'"
    )
    assert "loads[0].force" in lines[1] and "value 3 is missing" in lines[1]
    assert lines[2].endswith("loads[1]: from 2 s to 1 s, expected an end after the start")
    with pytest.raises(SpecError, match="cannot read this file: No such file or directory"):
        load_loads(tmp_path / "none.yaml")


# known forces over time


def test_forces_are_read_from_a_file(tmp_path):
    time, force = np.arange(3.0), np.arange(45.0).reshape(3, 5, 3)
    np.savez(tmp_path / "a.npz", time=time, tip_force=force)
    read_time, read_force = known_tip_forces(tmp_path / "a.npz")
    assert (read_time == time).all()
    assert (read_force["ring"] == force[:, 3]).all()
    np.savez(tmp_path / "b.npz", time=time, touch=force)
    with pytest.raises(TgdslError, match=r"b\.npz: there is no array tip_force; it holds time, touch"):
        known_tip_forces(tmp_path / "b.npz")
    np.savez(tmp_path / "b.npz", time=time, tip_force=force[:, :4])
    with pytest.raises(TgdslError, match=r"tip_force has shape \(3, 4, 3\), expected \(3, 5, 3\)"):
        known_tip_forces(tmp_path / "b.npz")
    with pytest.raises(TgdslError, match=r"expected an \.npz file with arrays time and tip_force"):
        known_tip_forces(tmp_path / "none.npz")


SCENE = """
<mujoco>
  <worldbody>
    <body name="left_hand_mid_link2"><geom type="box" size=".03 .03 .01"/></body>
    <body name="left_hand_index_rota_link2" pos="0 0 1"><geom size=".01"/></body>
    <body name="palm" pos="0 0 2"><geom size=".01"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  </worldbody>
</mujoco>
"""


def points(num: int) -> dict:
    return {"method": "points", "points": [{"pos": [i, 0, 0], "normal": [0, 0.6, 0.8]} for i in range(num)], "radius": 0.01}


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(SCENE)
    links = {"left_hand_mid_link2": points(3), "left_hand_index_rota_link2": points(2), "palm": points(1)}
    sensors = {
        "force": {"kind": "kinematic_taxel", "outputs": ["force"]},
        "depth": {"kind": "contact_depth"},
        "solver": {"kind": "link_contact"},
        "bit": {"kind": "contact"},
        "palm": {"kind": "contact_depth", "links": "palm"},
    }
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(path), "layout": {"resolutions": {"only": links}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {name: {"links": "*", "feels": ["cube"]} | sensor for name, sensor in sensors.items()},
        }
    )


def test_forces_are_read_from_a_simulation(touch, tmp_path):
    rng, time = np.random.default_rng(0), np.arange(4.0)
    shapes = {output.name: output.shape for output in touch.outputs}
    arrays = {name: rng.normal(size=(4, 2, *shape)).astype(np.float32) for name, shape in shapes.items()}
    np.savez(tmp_path / "r.npz", time=time, **arrays)
    bodies = touch.taxels["force"]["body"].tolist()
    assert sorted(bodies) == sorted(["left_hand_mid_link2"] * 3 + ["left_hand_index_rota_link2"] * 2 + ["palm"])
    masks = {
        "middle": [b == "left_hand_mid_link2" for b in bodies],
        "index": [b == "left_hand_index_rota_link2" for b in bodies],
    }
    for env in (0, 1):
        read_time, read_force = simulated_tip_forces(tmp_path / "r.npz", touch, "force", env=env)
        assert (read_time == time).all()
        assert sorted(read_force) == ["index", "middle"]
        for finger, mask in masks.items():
            assert read_force[finger] == pytest.approx(arrays["force"][:, env, mask].astype(np.float64).sum(axis=1))
    _, read_force = simulated_tip_forces(tmp_path / "r.npz", touch, "depth", depth_scale=100.0)
    depth = arrays["depth"][:, 0, masks["index"], 0].astype(np.float64).sum(axis=1)
    assert read_force["index"] == pytest.approx(100 * depth[:, None] * [0, 0.6, 0.8])
    _, read_force = simulated_tip_forces(tmp_path / "r.npz", touch, "solver")
    solver = next(output for output in touch.outputs if output.name == "solver")
    force_x = solver.channels.index("force_x") if "force_x" in solver.channels else None
    assert force_x is not None
    row = solver.bodies.index("left_hand_mid_link2")
    assert read_force["middle"] == pytest.approx(arrays["solver"][:, 0, row, force_x : force_x + 3].astype(np.float64))
    for name, says in [
        ("none", 'the document has no reading "none"; it has force, depth, solver, bit, palm'),
        ("bit", "bit has channels contact, expected forces or depths"),
        ("palm", "palm is on palm: none of them is a fingertip of an XHand1"),
    ]:
        with pytest.raises(TgdslError, match=says):
            simulated_tip_forces(tmp_path / "r.npz", touch, name)
    with pytest.raises(TgdslError, match="force has shape"):
        simulated_tip_forces(tmp_path / "r.npz", touch, "force", env=2)


# calibrations and reports


def a_fit(seed: int = 0):
    return fit_finger(counts_of(PRESSES, rotation(seed)), PRESSES)


def test_a_calibration_reproduces_the_forces(tmp_path):
    fit = a_fit()
    tare = np.arange(15.0).reshape(5, 3)
    base = replace(Calibration.none(), tare=tare, hand="mine")
    result = calibrated(base, {"index": fit}, "index")
    file = tmp_path / "hand.yaml"
    file.write_text(result.text())
    loaded = load_calibration(file)
    assert (loaded.units, loaded.hand) == ("N", "mine")
    counts = np.repeat(counts_of(PRESSES, rotation(0))[:, None], 5, axis=1)
    assert loaded.apply(counts)[:, 1] == pytest.approx(PRESSES, abs=1e-6)
    assert (loaded.tare[[0, 2, 3, 4]] == tare[[0, 2, 3, 4]]).all()
    assert loaded.scale == pytest.approx(np.tile(SCALE, (5, 1)))


def test_fingers_without_loads_are_not_guessed():
    with pytest.raises(FitError, match=r"thumb, middle, ring, pinky: no load was on them.*or say --others index"):
        calibrated(Calibration.none(), {"index": a_fit()})
    with pytest.raises(FitError, match="the other fingers cannot be like ring, which was not fitted; fitted: index"):
        calibrated(Calibration.none(), {"index": a_fit()}, "ring")
    newton = replace(Calibration.none(), units="N", scale=np.full((5, 3), 0.3))
    result = calibrated(newton, {"index": a_fit()})
    assert (result.scale[[0, 2, 3, 4]] == 0.3).all()
    assert result.scale[1] == pytest.approx(SCALE)


def test_the_report_and_the_picture():
    fit = a_fit()
    lines = report({"index": fit}, {"index": Samples(PRESSES, PRESSES, 0, ())})
    assert lines[0].startswith("index: 9 readings; scale 0.05000 0.08000 0.10000 N per count, rotation [")
    assert lines[0].endswith("tare 7.00 -12.00 21.00 counts")
    assert lines[3] == "  z: loads -2.00 to 4.00 N; RMS 0.0000 N, at most 0.0000 N, R² 1.00000"
    assert len(lines) == 4
    figure = drawing({"index": fit, "ring": a_fit(1)}, "a.npz")
    assert [axes.get_title(loc="left") for axes in figure.axes[:2]] == ["index", "ring"]
    offsets = np.concatenate([points.get_offsets() for points in figure.axes[0].collections])
    assert np.asarray(offsets) == pytest.approx(np.repeat(PRESSES.T.reshape(-1, 1), 2, axis=1), abs=1e-6)


def test_errors_are_reported_per_axis():
    """By hand: forces of variance 1, 4 and 0 N² with errors of 0, ±1 and −3 or 1 N."""
    force = np.array([[1.0, 2.0, 5.0], [-1.0, -2.0, 5.0]])
    error = np.array([[0.0, 1.0, -3.0], [0.0, -1.0, 1.0]])
    fit = FingerFit(np.ones(3), np.eye(3), np.zeros(3), force, error)
    assert fit.max_error.tolist() == [0.0, 1.0, 3.0]
    assert fit.rms == pytest.approx([0.0, 1.0, math.sqrt(5)])
    np.testing.assert_allclose(fit.r_squared, [1.0, 0.75, np.nan])


def test_four_loads_are_enough_and_three_are_not():
    force = np.concatenate([np.zeros((1, 3)), 2 * AXES])
    fit = fit_finger(counts_of(force, np.eye(3)), force, axes="signs")
    assert fit.scale == pytest.approx(SCALE) and fit.tare == pytest.approx(TARE)
    with pytest.raises(FitError, match=r"^3 frames, expected at least 4$"):
        fit_finger(counts_of(force, np.eye(3))[:3], force[:3])


def test_counts_that_do_not_follow_their_axis_are_refused():
    """Counts along x follow the product of x and y over all eight sign patterns, uncorrelated with any axis."""
    presses = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    counts = presses * [0, 1, 1] + presses[:, :1] * presses[:, 1:2] * [1, 0, 0]
    with pytest.raises(FitError, match="the fingertip's counts along its x do not follow the loads"):
        fit_finger(counts, presses, axes="signs", tare=np.zeros(3))


@pytest.mark.parametrize(("units", "expected"), [("N", 0.5), ("counts", None)])
def test_a_contact_threshold_is_kept_if_its_unit_stays(units, expected):
    base = replace(Calibration.none(), units=units, contact_threshold=0.5)
    result = calibrated(base, {"index": a_fit()}, "index")
    assert (result.units, result.contact_threshold) == ("N", expected)


def test_a_picture_shows_the_errors_of_each_finger_below(tmp_path):
    fit = fit_finger(counts_of(PRESSES, np.eye(3)) + np.random.default_rng(0).normal(size=PRESSES.shape), PRESSES)
    _, below = drawing({"index": fit}, "a.npz").axes
    offsets = np.concatenate([np.asarray(points.get_offsets()) for points in below.collections])
    np.testing.assert_allclose(offsets, np.stack([fit.force.T.ravel(), fit.error.T.ravel()], axis=1), atol=1e-12)
    assert [line.get_ydata() for line in below.lines] == [[0, 0]]
    assert picture({"index": fit}, tmp_path / "fit.png", "a.npz").read_bytes().startswith(b"\x89PNG")
