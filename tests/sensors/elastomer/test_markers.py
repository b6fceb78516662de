"""Markers away from the taxels: the operators are rectangular, taxels press and markers are read."""

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.sensors.elastomer.elastic import Layer
from tgdsl.sensors.elastomer.operators import Elastic

BALL, DEPTH, STIFFNESS, YOUNG, NU = 0.01, 5e-4, 1e8, 1e6, 0.4
SCENE = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01" pos="0 0 -.01"/></body>
  <body name="ball" pos="0 0 .05"><freejoint/><geom type="sphere" size=".01"/></body>
</worldbody></mujoco>
"""
GRID = {"method": "grid", "rows": 6, "columns": 6, "direction": [0, 0, -1], "radius": 1e-3}
GRID["region"] = {"box": {"min": [-3e-3, -3e-3, -1e-3], "max": [3e-3, 3e-3, 1e-3]}}
KERNELS = {
    "gaussian": {"kernel": "gaussian", "friction": 0.7},
    "half_space": {"kernel": "half_space", "youngs_modulus": YOUNG, "normal_stiffness": STIFFNESS, "poissons_ratio": NU},
    "bonded_layer": {
        "kernel": "bonded_layer", "youngs_modulus": YOUNG, "normal_stiffness": STIFFNESS, "poissons_ratio": NU, "thickness": 4e-3,
    },
    "points": {"kernel": "gaussian", "anchors": "points", "points": 200},
}  # fmt: skip


def points(places):
    dots = [{"pos": list(map(float, place)), "normal": [0, 0, 1], "radius": 1e-3} for place in places]
    return {"pad": {"method": "points", "points": dots}}


def compiled(folder, sensor, markers=None, taxels=None):
    (folder / "scene.xml").write_text(SCENE)
    resolutions = {"taxels": taxels or {"pad": GRID}, **({} if markers is None else {"dots": markers})}
    fields = {"kind": "elastomer", "links": "pad", "feels": ["ball"], "gate": "geometric", **sensor}
    fields |= {} if markers is None else {"markers": "dots"}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": resolutions}},
            "resolution": "taxels",
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"skin": fields},
        },
        dtype="float64",
    )


def state(touch, x=0.0):
    pos, quat = torch.zeros(1, 2, 3, dtype=torch.float64), torch.zeros(1, 2, 4, dtype=torch.float64)
    quat[..., 0] = 1
    pos[:, touch.inputs.bodies.index("ball")] = torch.tensor([x, 0.0, BALL - DEPTH], dtype=torch.float64)
    return tgdsl.SceneState(body_pos=pos, body_quat=quat)


def dragged_readings(touch):
    """Return the readings after pressing the ball in and dragging it by 0.1 mm."""
    touch(state(touch))
    return touch(state(touch, 1e-4))["skin"][0].numpy()


@pytest.mark.parametrize("kernel", KERNELS)
def test_markers_at_the_taxels_read_like_the_taxels(tmp_path, kernel):
    """In reverse order; equal sources give equal readings."""
    plain = compiled(tmp_path, KERNELS[kernel])
    places = plain.taxels["skin"]["pos"]
    with_markers = compiled(tmp_path, KERNELS[kernel], points(places[::-1]))
    expected = dragged_readings(plain)
    assert abs(expected).max() > 0
    assert dragged_readings(with_markers)[::-1] == pytest.approx(expected, rel=1e-9, abs=1e-9 * abs(expected).max())


@pytest.mark.parametrize("kernel", ["half_space", "bonded_layer"])
def test_markers_elsewhere_read_the_sum_of_exact_profiles(tmp_path, kernel):
    """Σ_i G(r_ij) [τ_i, p_i] A_i with each profile at its own distance: the layer's table errs by about 1e-6."""
    places = np.array([[0.37e-3, -0.81e-3, 0], [6.2e-3, 1.4e-3, 0], [-11e-3, 9e-3, 0]])
    touch = compiled(tmp_path, KERNELS[kernel], points(places))
    readings, taxels = dragged_readings(touch), touch.plan.layout
    spec_layer = Layer(4e-3 if kernel == "bonded_layer" else np.inf, 0.0, YOUNG / (2 * (1 + NU)), NU)
    depth = np.maximum(0.0, BALL - np.linalg.norm(taxels.pos - np.array([1e-4, 0, BALL - DEPTH]), axis=1))
    ratio = YOUNG / (2 * (1 + NU) * 4e-3 * STIFFNESS) if kernel == "bonded_layer" else 2 * (1 - NU) / (2 - NU)
    stuck = np.linalg.norm(taxels.pos - np.array([0, 0, BALL - DEPTH]), axis=1) < BALL - 1e-5
    traction = np.where((depth > 0) & stuck, STIFFNESS * ratio * 1e-4, 0.0)
    expected = np.zeros((3, 3))
    for j, place in enumerate(places):
        r = (place - taxels.pos)[:, :2]
        length = np.linalg.norm(r, axis=1)
        e, mean = r / length[:, None], float(taxels.area.mean())
        g = Elastic(spec_layer).profiles(length, taxels.area, mean, is_exact=True)
        along = g.spread * STIFFNESS * depth + 2 * g.bend * traction * e[:, 0]
        into = g.normal * STIFFNESS * depth + g.lift * traction * e[:, 0]
        expected[j, :2] = ((along * taxels.area)[:, None] * e).sum(axis=0)
        expected[j, 0] += ((g.along - g.bend) * traction * taxels.area).sum()
        expected[j, 2] = -(into * taxels.area).sum()
    assert readings == pytest.approx(expected, abs=1e-5 * abs(expected).max())


def test_readings_have_the_markers_rows(tmp_path):
    """Rows, places and noise are the markers'; gains apply to the reading."""
    places = points([[1e-3, 0, 0], [2e-3, 5e-3, 0]])
    touch, clean = (
        compiled(tmp_path, {**KERNELS["gaussian"], **noise}, places) for noise in ({"noise": {"gain": [0.5, 0.5]}}, {})
    )
    assert touch.outputs[0].rows == "marker" and touch.outputs[0].shape == (2, 3)
    assert touch.rows["skin"]["pos"][1].tolist() == [2e-3, 5e-3, 0]
    assert dragged_readings(touch) == pytest.approx(0.5 * dragged_readings(clean), rel=1e-12)


@pytest.mark.parametrize(
    ("sensor", "markers", "message"),
    [
        ({"markers": "dts"}, points([[0, 0, 0]]), 'the layout has no resolution "dts"; did you mean "dots"'),
        ({"operator": "fft"}, points([[0, 0, 0]]), "`operator: fft` is of markers that are the taxels"),
        ({"boundary": {}, "thickness": 2e-3}, points([[0, 0, 0]]), "a clamped `boundary` is of markers that are the taxels"),
    ],
)
def test_impossible_markers_are_mistakes(tmp_path, sensor, markers, message):
    (tmp_path / "scene.xml").write_text(SCENE)
    fields = {"kind": "elastomer", "links": "pad", "feels": ["ball"], "markers": "dots", **sensor}
    resolutions = {"taxels": {"pad": GRID}, "dots": markers}
    robot = {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": resolutions}}
    with pytest.raises(SpecError, match=message):
        tgdsl.compile(
            {
                "tgdsl": 1,
                "robot": robot,
                "resolution": "taxels",
                "objects": {"ball": {"body": "ball"}},
                "sensors": {"skin": fields},
            }
        )


def test_markers_only_on_other_links_are_a_mistake(tmp_path):
    with pytest.raises(SpecError, match='the resolution "dots" has no taxels on pad'):
        compiled(tmp_path, KERNELS["gaussian"], {"ball": {"method": "points", "points": points([[0, 0, 0]])["pad"]["points"]}})
