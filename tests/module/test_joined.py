"""Sensors of one kind on different taxels are computed as one and read the same as alone."""

import pytest
import torch

import tgdsl
from tgdsl.module.state import SceneState

SCENE = """
<mujoco>
  <worldbody>
    <body name="a" pos="-.03 0 .01"><geom type="box" size=".02 .02 .01"/></body>
    <body name="b" pos=".03 0 .01" quat=".97 0 0 .26"><geom type="box" size=".02 .02 .01"/></body>
    <body name="bar" pos="0 0 .03"><freejoint/><geom type="box" size=".06 .015 .01"/></body>
    <body name="ball" pos=".03 .005 .058"><freejoint/><geom type="sphere" size=".018"/></body>
  </worldbody>
</mujoco>
"""
POSES = {
    "a": (-0.03, 0, 0.01, 1, 0, 0, 0),
    "b": (0.03, 0, 0.01, 0.97, 0, 0, 0.26),
    "bar": (0, 0, 0.03, 1, 0, 0, 0),
    "ball": (0.03, 0.005, 0.038, 1, 0, 0, 0),
}
"""Position [m] and orientation of each body; ball and bar overlap, so either may be deeper."""
SOFT = {"kind": "kinematic_taxel", "normal_stiffness": 300, "gate": "geometric"}
STIFF = {**SOFT, "normal_stiffness": 800, "depth_exponent": 1.5, "shear_damping": 5.0}
DEPTH = {"kind": "contact_depth", "gate": "geometric"}
NOISE = {"gain": [0.8, 1.2], "white_noise": 0.01, "read_delay": 0.02}


def grid(num, radius):
    step = 0.03 / (num - 1)
    points = [
        {"pos": [-0.015 + step * i, -0.015 + step * j, 0.01], "normal": [0, 0, 1]} for i in range(num) for j in range(num)
    ]
    return {"method": "points", "radius": radius, "points": points}


@pytest.fixture
def document(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def written(**sensors):
        return {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"r": {"a": grid(4, 0.004), "b": grid(5, 0.003)}}},
            },
            "objects": {"bar": {"body": "bar"}, "ball": {"body": "ball"}},
            "sensors": {name: {"feels": ["bar", "ball"], **sensor} for name, sensor in sensors.items()},
        }

    return written


def state(touch, step):
    """Return a state with random poses in which both pads feel the bar."""
    generator = torch.Generator().manual_seed(step)

    def random(scale, width):
        return {name: scale * torch.randn(6, width, generator=generator, dtype=torch.float64) for name in POSES}

    shift, rotation, linvel, angvel = random(3e-4, 3), random(5e-3, 4), random(0.1, 3), random(1.0, 3)
    pos = {name: torch.tensor(pose[:3], dtype=torch.float64) + shift[name] for name, pose in POSES.items()}
    quat = {name: torch.tensor(pose[3:], dtype=torch.float64) + rotation[name] for name, pose in POSES.items()}
    names = touch.inputs.bodies
    fields = (torch.stack([part[name] for name in names], dim=1) for part in (pos, quat, linvel, angvel))
    return SceneState(*fields, dt=0.01)


def joined(touch):
    return {sensor.name: sensor.joined for sensor in touch.plan.sensors}


def num_queries(touch):
    """Return how often distances are measured."""
    return len(touch.plan.quantities["contact_depth"].queries)


LEFT, RIGHT = {"links": "a", **SOFT}, {"links": "b", **STIFF}


@pytest.mark.parametrize("noise", [{}, {"noise": NOISE}], ids=["clean", "noisy"])
def test_joined_sensors_read_the_same_as_alone(document, noise):
    sensors = {"left": {**LEFT, **noise}, "right": RIGHT}
    both = tgdsl.compile(document(**sensors), dtype=torch.float64)
    assert joined(both) == {"left": ("left", "right"), "right": ("left", "right")}
    assert num_queries(both) == 1
    assert "computed as one with right" in both.explain() and "computed as one with left" in both.explain()
    alone = {name: tgdsl.compile(document(**{name: sensor}), dtype=torch.float64) for name, sensor in sensors.items()}
    assert [joined(touch) for touch in alone.values()] == [{"left": ()}, {"right": ()}]
    for step in range(4):
        readings = both(state(both, step))
        for name, touch in alone.items():
            expected = touch(state(touch, step))[name]
            assert (expected[..., 2].abs() > 0).any(dim=1).all()
            torch.testing.assert_close(readings[name], expected, rtol=1e-12, atol=1e-12)
            assert both.plan.layout_of(both.plan.sensor_of(name)).bodies == touch.plan.layout_of(touch.plan.sensors[0]).bodies


def test_joined_sensors_keep_their_parameters(document):
    touch = tgdsl.compile(document(left=LEFT, right=RIGHT), dtype=torch.float64)
    before = touch(state(touch, 0))
    stiffness = touch.constants["sensors/right/normal_stiffness"].requires_grad_()
    readings = touch(state(touch, 0))
    (slope,) = torch.autograd.grad(readings["right"].sum(), stiffness)
    with torch.no_grad():
        stiffness += 2.0
        after = touch(state(touch, 0))
    torch.testing.assert_close(after["right"].sum() - before["right"].sum(), 2.0 * slope, rtol=1e-9, atol=0)
    assert torch.equal(after["left"], before["left"])


@pytest.mark.parametrize(
    ("sensors", "expected"),
    [
        ({"left": LEFT, "right": {**RIGHT, "feels": ["ball"]}}, 2),
        ({"left": LEFT, "right": {**RIGHT, "outputs": ["force"]}}, 2),
        ({"left": LEFT, "right": {"links": "b", **DEPTH}}, 2),
        ({"left": LEFT, "right": {**RIGHT, "noise": {"radius_noise": 1e-4}}}, 2),
        ({"left": LEFT, "right": RIGHT, "again": {"links": "b", **SOFT}}, 2),  # on the same taxels as another sensor
        ({"left": LEFT, "right": RIGHT, "depth": {"links": "b", **DEPTH}}, 2),  # its depth would be measured twice
    ],
    ids=["objects", "channels", "kinds", "radius noise", "twice", "shared"],
)
def test_sensors_with_other_differences_stay_separate(document, sensors, expected):
    touch = tgdsl.compile(document(**sensors))
    assert not any(joined(touch).values())
    assert num_queries(touch) == expected


def test_all_sensors_on_the_same_taxels_are_joined_the_same_way(document):
    depths = {"depth_a": {"links": "a", **DEPTH}, "depth_b": {"links": "b", **DEPTH}}
    touch = tgdsl.compile(document(left=LEFT, right=RIGHT, **depths), dtype=torch.float64)
    assert set(joined(touch).values()) == {("left", "right"), ("depth_a", "depth_b")}
    assert num_queries(touch) == 1
    readings = touch(state(touch, 0))
    assert readings["depth_a"].shape == (6, 16, 1) and readings["depth_b"].shape == (6, 25, 1)
    assert torch.equal(readings["depth_b"][..., 0] > 0, readings["right"][..., 2].abs() > 0)
