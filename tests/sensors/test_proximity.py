from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from oracles import proximity
from oracles.proximity import AREA, COARSE, R, read
from oracles.proximity import DENSITY as RHO
from oracles.setups.scenes import BOX, folder, module, state

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.module.state import SceneState
from tgdsl.quantities import moment_fields
from tgdsl.sensors.proximity import PROXIMITY
from tgdsl.testing import KindConformance


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    """Fields with errors measured at few points, shared by all tests of this file."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "coarse"))
    monkeypatch.setattr(moment_fields, "CHOICE_POINTS", 200)
    monkeypatch.setattr(moment_fields, "REPORT_POINTS", 200)


class TestProximity(KindConformance):
    kind = PROXIMITY
    parameters = {"tolerance": 0.1}
    test_compiled_equals_eager = None  # `test_compiled.py` compiles all kinds, this one too, as one graph
    gates = ()


class TestProximityWithSmoothGradients(KindConformance):
    kind = PROXIMITY
    parameters = {"tolerance": 0.1, "gradient_tolerance": 0.3, "radius": 0.01}
    gates = ()


class TestProximityOverPointsAsInThePaper(KindConformance):
    kind = PROXIMITY
    parameters = {"backend": "points", "points": 300, "max_bytes": 2**22, "model": "paper", "torque_about": "link"}
    gates = ()


class TestProximityOfOneRadius(KindConformance):
    kind = PROXIMITY
    parameters = {"tolerance": 0.1, "radius": 0.01}
    test_compiled_equals_eager = None  # the same graph as `TestProximity`
    gates = ()


class TestProximityAsInThePaper(KindConformance):
    kind = PROXIMITY
    parameters = {"tolerance": 0.1, "model": "paper", "outputs": ["force"], "reference_area": 0.01}
    test_compiled_equals_eager = None  # part of another compiled graph
    gates = ()


SIDES = (proximity.plane_in_front, *(partial(proximity.plane_at_the_side, about) for about in ("taxel", "link")))


@pytest.mark.parametrize("compare", SIDES)
def test_forces_of_a_plane_match_hand_calculations(compare):
    """A plane in front pushes the sensor back, one at the side twists it; the paper's model pulls."""
    comparison = compare()
    assert comparison.paper_error > comparison.magnitude


def test_the_papers_model_pulls():
    ours, paper = (read(sensor={"model": m}, pos=[0, 0, -0.003]) for m in ("tgdsl", "paper"))
    np.testing.assert_allclose(paper, -ours, atol=1e-15)
    assert paper[2] > 0


def test_slip_drags_the_sensor_along_with_the_object():
    """A sliding cube: f_t = k_s ρ S0 v_t; velocity along the normal has no effect."""
    s0 = -read(BOX, pos=[0, 0, -0.026])[2] / (300 * RHO)
    assert s0 == pytest.approx(proximity.over_a_plane(0.006), rel=0.1)


def rotating_state(touch, spin, drift, **item):
    """Return a state in which link and object turn as one rigid body."""
    scene = state(touch, **item)
    assert scene.body_pos is not None and scene.body_angvel is not None and scene.body_linvel is not None
    for i in range(2):
        scene.body_angvel[0, i] = torch.tensor(spin)
        scene.body_linvel[0, i] = torch.tensor(drift + np.cross(spin, scene.body_pos[0, i].numpy()))
    return scene


def test_joint_rotation_is_slip_only_in_the_papers_model(tmp_path):
    """The paper's slip is then ω × S1 with the absolute ω, in the link's frame."""
    spin, at = np.array([1.0, -2.0, 0.5]), {"pos": [0, 0, -0.026]}
    for model, slips in (("tgdsl", 0.0), ("paper", 1.0)):
        touch = module(
            tmp_path, [(0.004, 0, 0)], BOX, gate=None, kind="proximity", model=model, tolerance=COARSE, reference_area=AREA
        )
        still = touch(state(touch, **at))["s"][0, 0].numpy()
        moving = touch(rotating_state(touch, spin, np.array([0.3, 0.1, -0.2]), **at))["s"][0, 0].numpy()
        # The torque at rest gives S1 except along the normal; the cube's middle is below the probe.
        sign = 1.0 if model == "paper" else -1.0
        s1 = np.array([-still[4], still[3], 0]) * sign / (300 * RHO)
        depth = ((moving - still)[0] / (10 * RHO) + spin[2] * s1[1]) / spin[1] if slips else 0.0
        slip = slips * np.cross(spin, [s1[0], s1[1], depth])
        np.testing.assert_allclose((moving - still)[:2], 10 * RHO * slip[:2], rtol=1e-9, atol=1e-13)
        assert (abs((moving - still)[:2]) > 1e-6).all() == bool(slips)
        assert not slips or depth < 0


def test_the_whole_area_is_the_default_reference():
    readings = read(BOX, sensor={"reference_area": None}, pos=[0, 0, -0.026])
    np.testing.assert_allclose(readings, read(BOX, pos=[0, 0, -0.026]), rtol=1e-6, atol=1e-15)


def test_points_and_field_agree_to_sampling_noise(tmp_path):
    """Of 100,000 points some 3,200 are within reach: they err by √(1.5 / 3200) = 2.2 %; the field errs by less."""
    line = np.linspace(-0.02, 0.02, 6)
    probes = [(x, y, 0) for x in line for y in line]
    readings = []
    for sensor in ({"tolerance": 0.02}, {"backend": "points", "points": 100_000, "max_bytes": 2**29}):
        touch = module(tmp_path, probes, BOX, gate=None, kind="proximity", reference_area=AREA, **sensor)
        readings.append(touch(state(touch, pos=[0.003, 0, -0.025]))["s"][0].numpy())
    assert np.sqrt(np.mean((readings[0] - readings[1]) ** 2, axis=0)[2]) < 0.025 * np.abs(readings[1][:, 2]).max()


def test_the_mean_does_not_depend_on_the_number_of_taxels(tmp_path):
    """Twice as many taxels on the same patch: the mean force changes by less than 2 %."""
    means = []
    for num in (10, 20):
        line = ((np.arange(num) + 0.5) / num - 0.5) * 0.04
        probes = [(x, y, 0) for x in line for y in line]
        touch = module(tmp_path, probes, BOX, gate=None, kind="proximity", reference_area=AREA, tolerance=COARSE)
        means.append(touch(state(touch, pos=[0.003, 0, -0.024]))["s"][0, :, 2].mean().item())
    assert means[1] == pytest.approx(means[0], rel=0.02)


def test_stiffness_is_a_constant_that_gradients_reach(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], BOX, gate=None, kind="proximity", reference_area=AREA, tolerance=COARSE)
    at = state(touch, pos=[0.002, 0, -0.024])
    stiffness = touch.constants["sensors/s/stiffness"].requires_grad_()
    force = touch(at)["s"][0, 0, 2]
    (slope,) = torch.autograd.grad(force, stiffness)
    assert slope.item() * stiffness.item() == pytest.approx(force.item(), rel=1e-12)  # the force at rest is linear in it


def test_each_radius_has_its_own_field(tmp_path):
    """Two radii in one layout read what each reads alone."""
    touch, alone = [], []
    for radii in ((0.01, 0.006), (0.01,), (0.006,)):
        (tmp_path / "scene.xml").write_text(SCENE)
        points = [{"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": r} for r in radii]
        compiled = tgdsl.compile(document(tmp_path, points), dtype=torch.float64)
        readings = compiled(state(compiled, pos=[0.004, 0, -0.023]))["s"][0]
        (alone if len(radii) == 1 else touch).append(readings)
    torch.testing.assert_close(touch[0], torch.cat(alone))
    assert (touch[0][:, 2] < 0).all()


def test_a_sensors_radius_overrides_the_layouts():
    """Over a plane each sensor matches the closed form for its radius; a taxel that the layout disables reads zero."""
    plane = {"kind": "proximity", "links": "pad", "feels": ["floor"], "reference_area": AREA}
    with folder() as path:
        spec = document(path, [{**POINT, "radius": 0.004}, {**POINT, "radius": 0.0}])
        spec["sensors"] = {
            "s": plane,
            "wide": {**plane, "radius": "10 mm"},
            "points": {**plane, "radius": 0.007, "backend": "points"},
        }
        touch = tgdsl.compile(spec, dtype=torch.float64)
    above = state(touch)
    above.body_pos[0, touch.inputs.bodies.index("pad"), 2] = 0.003
    readings = touch(above)
    for name, radius in (("s", 0.004), ("wide", 0.01), ("points", 0.007)):
        s0 = 2 * np.pi * (radius**3 / 6 - radius * 0.003**2 / 2 + 0.003**3 / 3)
        assert readings[name][0, 0, 2].item() == pytest.approx(-300 * RHO * s0, rel=1e-12)
        assert (readings[name][0, 1] == 0).all()


SCENE = (
    '<mujoco><worldbody><body name="pad"><freejoint/><geom size=".05"/></body>'
    f'<body name="item"><freejoint/>{BOX}</body><body name="floor"><geom type="plane" size="1 1 .1"/></body></worldbody></mujoco>'
)


def document(folder, probes, feels=("item",), target=None, **sensor):
    coarse = {} if sensor.get("backend") == "points" else {"tolerance": COARSE}
    (folder / "scene.xml").write_text(SCENE)
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": probes}}}}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": layout},
        "objects": {"item": {"body": "item", **(target or {})}, "floor": {"body": "floor"}},
        "sensors": {"s": {"kind": "proximity", "links": "pad", "feels": list(feels), **coarse, **sensor}},
    }


POINT = {"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": R}


@pytest.mark.parametrize("backend", ["field", "points"])
def test_variants_equal_single_objects(tmp_path, backend):
    variants = [{"type": "box", "size": [0.02] * 3}, {"type": "sphere", "size": [0.02]}]
    options = {"backend": backend} | ({"points": 500} if backend == "points" else {})
    points = [POINT, {**POINT, "radius": 0.8 * R}]
    touch = tgdsl.compile(document(tmp_path, points, target={"variants": variants}, **options), dtype=torch.float64)
    at = touch.example_state(4, spread=0.004)
    assert at.body_pos is not None and at.variant is not None
    at.body_pos[:, touch.inputs.bodies.index("item"), 2] -= 0.024
    together = touch(at)["s"]
    for env in range(4):
        target = {"geom": variants[int(at.variant[env, 0])]}
        alone = tgdsl.compile(document(tmp_path, points, target=target, **options), dtype=torch.float64)
        values = {name: getattr(at, name)[env : env + 1] for name in alone.inputs.fields}
        torch.testing.assert_close(alone(SceneState(**values))["s"][0], together[env], rtol=1e-12, atol=1e-15)
    assert (together[:, 0, :3].abs().sum(dim=1) > 0).sum() >= 3


def test_a_body_feels_like_the_sum_of_its_geoms(tmp_path):
    """A box and two planes, at rest; planes hide nothing of each other or of the box."""
    plane = '<geom type="plane" size="1 1 .1"/>'
    geoms = ['<geom type="box" size=".02 .02 .002"/>', plane, plane.replace("/>", ' pos="0 0 -.002" euler="10 0 0"/>')]
    readings = []
    for chosen in (geoms, *([geom] for geom in geoms)):
        spec = document(tmp_path, [POINT], feels=["floor"], reference_area=AREA)
        (tmp_path / "scene.xml").write_text(SCENE.replace(plane, "".join(chosen)))
        touch = tgdsl.compile(spec, dtype=torch.float64)
        above = state(touch)
        above.body_pos[0, touch.inputs.bodies.index("pad"), 2] = 0.004
        readings.append(touch(above)["s"][0, 0])
    whole, *parts = readings
    torch.testing.assert_close(whole, torch.stack(parts).sum(dim=0), rtol=1e-9, atol=1e-15)
    assert all(part[2] < 0 for part in parts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": {"size": "per_env"}}, 'sensors.s.feels[0]: the size of body "item" is given per environment'),
        ({"feels": ["floor"]}, "sensors.s: floor: planes alone have no area to share the density among; give `reference_area`"),
        ({"max_bytes": 1000}, 'sensors.s: body "item": a field of moments of a tolerance of 0.04 at a radius of 10 mm needs'),
        ({"tolerance": 0}, "sensors.s.tolerance: 0 is out of range, expected more than 0"),
    ],
)
def test_mistakes(tmp_path, changes, message):
    with pytest.raises(SpecError) as error:
        tgdsl.compile(document(tmp_path, [POINT], **changes))
    assert message in str(error.value)
    assert len(error.value.problems) == 1, str(error.value)


def test_only_moments_are_computed(tmp_path):
    """No distances are baked or measured; `explain` states the cost of the field."""
    touch = tgdsl.compile(document(tmp_path, [POINT], outputs=["torque"]))
    assert touch.inputs.fields == ("body_pos", "body_quat") and "contact_depth" not in touch.plan.quantities
    text = touch.explain()
    assert "fields of moments" in text and "item, radius 10 mm: " in text
    force = tgdsl.compile(document(tmp_path, [POINT], feels=["item", "floor"]))
    assert force.inputs.fields == ("body_pos", "body_quat", "body_linvel", "body_angvel")


SOLIDS = {
    "sphere": ('<geom type="sphere" size=".025"/>', 4 * np.pi * 0.025**2),
    "capsule": ('<geom type="capsule" size=".01 .02"/>', 4 * np.pi * 0.01**2 + 2 * np.pi * 0.01 * 0.04),
    "cylinder": ('<geom type="cylinder" size=".01 .02"/>', 2 * np.pi * 0.01**2 + 2 * np.pi * 0.01 * 0.04),
}


@pytest.mark.parametrize("shape", SOLIDS)
def test_density_is_divided_among_the_points(tmp_path, shape):
    """A ball around the whole object weighs every point: ρ S0 = density times the mean of R − |p − q|, whatever the area."""
    geom, area = SOLIDS[shape]
    sensor = {"backend": "points", "points": 300, "outputs": ["force"], "reference_area": None, "normal_stiffness": 1.0}
    touch = module(tmp_path, [(0, 0, 0)], geom, radius=0.06, gate=None, kind="proximity", **sensor)
    (table,) = touch.plan.quantities["moments"].tables
    assert float(table.area[0]) == pytest.approx(area, rel=1e-12)
    points = table.surface.points.T[:300]
    place = np.array([0.001, -0.002, 0.003])
    mean = np.mean(0.06 - np.linalg.norm(points + place, axis=1))
    force = touch(state(touch, pos=place.tolist()))["s"][0, 0, 2]
    assert float(force) == pytest.approx(-100 * mean, rel=1e-12)


def test_explain_counts_the_bytes_of_all_channels(tmp_path):
    """With radius noise a field holds derivatives too: 8 numbers of 4 bytes at each node."""
    cases: list[tuple[dict[str, Any], int]] = [({}, 4), ({"noise": {"radius_noise": 1e-3}}, 8)]
    for noise, channels in cases:
        touch = module(tmp_path, [(0, 0, 0)], BOX, gate=None, kind="proximity", tolerance=0.1, **noise)
        x, y, z = touch.plan.quantities["moments"].tables[0].surface.num[0]
        assert f"{x} × {y} × {z} nodes every" in touch.explain()
        assert f" mm, {4 * channels * x * y * z} bytes\n" in touch.explain()
