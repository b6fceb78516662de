"""Fits to recordings made with known parameters: values, clocks, intervals, warnings, and the fitted document."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from recorded_presses import LAG, TRUE, document, motion, readings, recording

import tgdsl
from tgdsl.calibration import fit as fitting
from tgdsl.calibration import picture as picturing
from tgdsl.calibration import problem as problems
from tgdsl.calibration.model import InfeasibleError, Model, Parameter
from tgdsl.calibration.recordings import velocities
from tgdsl.console.progress import silent
from tgdsl.errors import TgdslError
from tgdsl.view.style import new_figure

FIT = ["touch.normal_stiffness", "touch.depth_exponent"]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return document(tmp_path_factory.mktemp("fitted"))


@pytest.fixture(scope="module")
def fitted(path):
    return tgdsl.calibrate(path, recording(path), FIT, hold_out="time", starts=4)


def test_parameters_and_clock_are_found(fitted):
    stiffness, exponent = (fitted.parameters[name] for name in FIT)
    assert stiffness.low < 900 < stiffness.high and exponent.low < 1.3 < exponent.high
    assert exponent.high - exponent.low < 0.06
    for parameter, bounds in ((stiffness.parameter, (0, 5000)), (exponent.parameter, (0.1, 10))):  # a decade around 500 and 1
        assert (parameter.low, parameter.high) == pytest.approx(bounds)
    assert fitted.nuisances["<arrays>: clock of touch"] == pytest.approx(-LAG, abs=2e-3)
    (error,) = fitted.errors
    assert error.error == pytest.approx(error.floor, rel=0.1) and error.held_out < 1.1 * error.error
    assert any("correlation 0.99" in text for text in fitted.warnings)


def test_a_load_cell_under_all_taxels_is_enough(path):
    """The sum of all rows gives the same parameters."""
    arrays = recording(path)
    arrays["target:touch"] = arrays["target:touch"].sum(axis=1, keepdims=True)
    fit = tgdsl.calibrate(path, arrays | {"rows:touch": np.array("sum")}, FIT, hold_out="time", starts=1)
    stiffness, exponent = (fit.parameters[name] for name in FIT)
    assert stiffness.low < 900 < stiffness.high and exponent.low < 1.3 < exponent.high
    assert fit.errors[0].error == pytest.approx(3**0.5 * fit.errors[0].floor, rel=0.2)  # noise of three rows
    with pytest.raises(TgdslError, match=r"hold_out: taxel: each target has one row; expected time or recording"):
        tgdsl.calibrate(path, arrays | {"rows:touch": np.array("sum")}, FIT, hold_out="taxel")


def test_a_linear_parameter_is_solved_for(fitted):
    """Force is linear in stiffness, not in the exponent; a plain search finds the same minimum."""
    problem, solution = fitted.problem, fitted.solution
    assert problem.linear == (0,)
    plain = problem.minimise(solution.x, are_fixed=True)
    assert solution.cost < plain.cost * (1 + 1e-6)
    assert plain.cost == pytest.approx(solution.cost, rel=1e-3)
    assert plain.x == pytest.approx(solution.x, abs=5e-3)


def test_the_jacobian_of_the_projected_residual_matches_differences(fitted):
    problem, x = fitted.problem, fitted.solution.x
    jacobian = problem.jacobian(x, problem.weights(), (1, 2), are_fixed=False)
    for j, column in zip((1, 2), jacobian.T, strict=True):
        step = 1e-3 * np.eye(3)[j]
        slope = (
            problem.solve(x + step, problem.weights()).residual - problem.solve(x - step, problem.weights()).residual
        ) / 2e-3
        assert column == pytest.approx(slope, abs=2e-2 * abs(slope).max())


def test_the_fitted_document_predicts_new_recordings(path, fitted):
    out = fitted.document(path.parent / "fitted.yaml")
    text = out.read_text()
    assert f"normal_stiffness: {fitted.parameters[FIT[0]].value:.6g}  # fitted, 95 %: " in text
    refit = tgdsl.calibrate(out, recording(path, seed=1))
    assert refit.errors[0].error == pytest.approx(refit.errors[0].floor, rel=0.1)
    assert not refit.parameters
    with pytest.raises(TgdslError, match="relative to its folder"):
        fitted.document(path.parent / "elsewhere" / "fitted.yaml")


def test_a_fit_can_be_printed_and_plotted(fitted, tmp_path, monkeypatch):
    text = str(fitted)
    assert "touch.depth_exponent" in text and "held out" in text and "warning: touch.normal_stiffness" in text
    assert fitted.plot(tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    drawn = []
    monkeypatch.setattr(picturing, "save_figure", lambda figure, path: drawn.append(figure) or path)
    fitted.plot(tmp_path / "fit.png")
    left, right = (panel.get_title(loc="left") for panel in drawn[0].axes)
    assert left.startswith(f"<arrays>: touch, relative RMSE {fitted.errors[0].error:.3f}") and right.startswith("residual")


def test_scales_need_channels_along_axes():
    output = SimpleNamespace(name="touch", channels=("force_x", "depth"))
    model = SimpleNamespace(module=SimpleNamespace(outputs=[output]))
    target = SimpleNamespace(reading="touch", channels=(0, 1), value=np.zeros((1, 2, 2)), weight=np.ones((1, 2, 2)))
    with pytest.raises(TgdslError, match="reading: scale: force_x, depth are not along x, y, z; expected offset or affine"):
        problems._part(0, target, "scale", np.eye(3)[:2], model)


def test_a_plot_over_time_has_the_largest_rows():
    measured = np.array([0.1, 5.0, -7.0, 1.0]).reshape(1, 4, 1)
    part = SimpleNamespace(target=SimpleNamespace(value=measured, time=np.zeros(1)), weight=np.ones_like(measured))
    left, right = new_figure(6, 3).subplots(1, 2)
    picturing._lines((left, right), part, measured + 0.5, None, "N")
    assert [line.get_ydata().tolist() for line in left.lines] == [[-7], [-6.5], [5], [5.5], [1], [1.5]]
    assert [line.get_ydata().tolist() for line in right.lines[:3]] == [[0.5]] * 3


def test_changed_parameters_read_like_a_compiled_document(path):
    """Setting and restoring a parameter gives the compiled document's readings to the bit."""
    model = Model(path, FIT)
    first_module = model.module
    model.set((900.0, 1.3))
    assert model.module is first_module
    states = motion(40)
    fields = {name: states[name] for name in ("body_pos", "body_quat")}
    fields |= velocities(states["time"], fields)
    result = model._read("touch", fields, states["time"])
    assert np.array_equal(result, readings(path, states))
    model.set([parameter.start for parameter in model.parameters])
    assert np.array_equal(model._read("touch", fields, states["time"]), readings(path, states, {}))


def test_parameters_that_change_requests_are_recompiled(path):
    """An elastomer's `standoff` changes its requests of the scene."""
    skin = {
        "sensors": {"touch": {"kind": "elastomer", "links": "pad", "feels": ["ball"], "standoff": 0.001, "shear_strength": 0}}
    }
    model = Model(path, ["touch.standoff"], {"sensors.touch": skin["sensors"]["touch"]})
    first_module = model.module
    model.set((0.002,))
    assert model.module is not first_module
    states = motion(20)
    result = model._read("touch", states, states["time"])
    touch = tgdsl.compile(path, overrides={"sensors.touch": {**skin["sensors"]["touch"], "standoff": 0.002}}, dtype="float64")
    state = tgdsl.SceneState(**{name: torch.from_numpy(states[name]) for name in ("body_pos", "body_quat")})
    assert np.array_equal(result, touch(state)["touch"].numpy())


def test_values_that_exclude_each_other_are_infeasible(path):
    layer = {
        "kernel": "bonded_layer",
        "youngs_modulus": 1e5,
        "normal_stiffness": 1e8,
        "thickness": 0.003,
        "marker_depth": 0.001,
    }
    sensor = {"kind": "elastomer", "links": "pad", "feels": ["ball"], **layer}
    model = Model(path, ["touch.thickness", "touch.marker_depth"], {"sensors.touch": sensor})
    with pytest.raises(InfeasibleError, match="below the layer"):
        model.set((0.002, 0.0025))


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        ("tuch.normal_stiffness", 'did you mean "touch"'),
        ("touch.stiffness", 'there is no field "stiffness"'),
        ("touch.feels", "no number that can be fitted"),
        ("touch.friction_cone", "the document gives no value"),
        ("touch.normal_stiffness=1", "expected a range such as touch.normal_stiffness=500:1000"),
        ("touch.normal_stiffness = 600:900", "the document's value 500 is out of the range 600 to 900"),
    ],
)
def test_parameters_that_cannot_be_fitted_are_refused(path, fit, message):
    with pytest.raises(TgdslError, match=message):
        Model(path, [fit])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"hold_out": "block"}, 'hold_out: found "block"; did you mean "blocks"?'),
        ({"reading": "ofset"}, 'reading: found "ofset"; did you mean "offset"?'),
        ({"reading": {"touch": "ofset"}}, 'reading: found "ofset"; did you mean "offset"?'),
        ({"intervals": "profil"}, 'intervals: found "profil"; did you mean "profile"?'),
        ({"hold_out": "recording"}, "hold_out: recording: there is one recording, expected several; or blocks, taxel or time"),
    ],
)
def test_unknown_options_are_refused(path, options, message):
    with pytest.raises(TgdslError, match=re.escape(message)):
        tgdsl.calibrate(path, recording(path), ["touch.normal_stiffness"], starts=1, **options)


def test_the_document_itself_is_not_overwritten(path):
    fit = tgdsl.calibrate(path, recording(path), ["touch.normal_stiffness"], starts=1)
    before = path.read_bytes()
    with pytest.raises(TgdslError, match="this is the document that the fit began with"):
        fit.document(path)
    assert path.read_bytes() == before


def test_a_sensor_that_nothing_touches_is_named(path):
    """Poses in millimetres put the ball far from the pad."""
    arrays = recording(path)
    far = arrays | {"body_pos": 1e3 * arrays["body_pos"]}
    fit = tgdsl.calibrate(path, far, ["touch.normal_stiffness"], starts=1, intervals="none")
    assert any("the sensors read 0 in all samples" in text for text in fit.warnings), fit.warnings


def test_a_fit_needs_a_recording(path):
    with pytest.raises(TgdslError, match="there is no recording, expected at least one"):
        tgdsl.calibrate(path, [], ["touch.normal_stiffness"])


def test_unidentified_parameters_are_named(path):
    """A resting ball shows no damping; a range that excludes the truth gives its end."""
    arrays = recording(path, lag=0.0)
    still = arrays | {name: np.repeat(arrays[name][600:601], 1200, axis=0) for name in ("body_pos", "body_quat")}
    still["target:touch"] = np.repeat(arrays["target:touch"][30:31], 60, axis=0)
    still.pop("clock_width:touch")
    fit = tgdsl.calibrate(path, still, ["touch.normal_damping=0:500"], starts=1)
    assert not fit.parameters["touch.normal_damping"].is_identified
    assert "touch.normal_damping: no reading depends on it; leave it out" in fit.warnings
    short = tgdsl.calibrate(path, arrays, ["touch.normal_stiffness", "touch.depth_exponent=0.8:1.1"], starts=1)
    assert any(text.startswith("touch.depth_exponent: at the end of its range, 1.1") for text in short.warnings)


def test_an_interval_ends_with_its_range():
    """1.96 standard deviations of 0.3 about 0.95 reach from 0.362 of the range to its end: 0.638, below the limit of 0.9."""
    problem = SimpleNamespace(model=SimpleNamespace(parameters=[Parameter("touch.k", 15.0, 10.0, 20.0, "", False)]))
    solution, uncertainty = SimpleNamespace(x=np.array([0.95])), SimpleNamespace(sigma=np.array([0.3]))
    (found,) = fitting._parameters(problem, solution, uncertainty, "none", 0, silent)
    assert (found.value, found.low, found.high) == pytest.approx((19.5, 13.62, 20.0)) and found.is_identified


def test_a_pose_offset_is_found_within_its_prior(path):
    """The ball was 0.3 mm lower than recorded."""
    arrays = recording(path, lag=0.0)
    arrays["body_pos"] = arrays["body_pos"] + np.array([[0, 0, 3e-4], [0, 0, 0]])
    arrays["width:body_pos"] = np.array([[0, 0, 5e-4], [0, 0, 0]])
    fit = tgdsl.calibrate(path, arrays, FIT, starts=1)
    assert fit.nuisances["<arrays>: body_pos ball.z"] == pytest.approx(-3e-4, abs=3e-5)
    assert fit.parameters["touch.depth_exponent"].low < 1.3 < fit.parameters["touch.depth_exponent"].high


def test_each_recording_has_its_own_gain_and_offset(path):
    first, second = recording(path, seed=1), recording(path, seed=2)
    second["target:touch"] = 0.8 * second["target:touch"] + np.array([0.0, 0.1, -0.2])
    fit = tgdsl.calibrate(path, [first, second], FIT[1:], reading="offset", gain=True, starts=1, intervals="none")
    one, two = (value for name, value in fit.nuisances.items() if name.endswith("gain"))
    assert two / one == pytest.approx(0.8, rel=0.02)
    assert [e.error < 1.1 * e.floor for e in fit.errors] == [True, True]


def test_robust_fits_ignore_lost_rows(path):
    arrays = recording(path)
    arrays["target:touch"][40:46, 1] += 0.5
    robust, plain = (tgdsl.calibrate(path, arrays, FIT, robust=robust, starts=1, intervals="none") for robust in (True, False))
    off = {name: abs(fit.parameters[FIT[1]].value - 1.3) for name, fit in (("robust", robust), ("plain", plain))}
    assert off["robust"] < 0.02 and off["robust"] < 0.3 * off["plain"]


@pytest.mark.parametrize("by", ["taxel", "blocks", "recording"])
def test_each_way_to_hold_out_works(path, by):
    fit = tgdsl.calibrate(
        path, [recording(path, seed=1), recording(path, seed=2)], FIT, hold_out=by, folds=3, starts=1, intervals="none"
    )
    assert all(0.9 * e.error < e.held_out < 1.15 * e.error for e in fit.errors)


def test_a_wrong_model_stays_above_the_noise_floor(path):
    """The truth has damping, the fit does not: its error is above the floor until damping is fitted."""
    arrays = recording(path)
    true = TRUE | {"sensors.touch.normal_damping": 3e4}
    states = motion(1200)
    values = readings(path, states, true).reshape(1200, -1)
    clock = arrays["clock:touch"] - LAG
    arrays["target:touch"] = np.stack([np.interp(clock, states["time"], c) for c in values.T], axis=1).reshape(60, 3, 3)
    fit = tgdsl.calibrate(path, arrays, FIT, starts=1, intervals="none")
    assert fit.errors[0].error > 2 * fit.errors[0].floor
    better = tgdsl.calibrate(path, arrays, [*FIT, "touch.normal_damping=0:1e5"], starts=1, intervals="none")
    assert better.errors[0].error < 0.2 * fit.errors[0].error
