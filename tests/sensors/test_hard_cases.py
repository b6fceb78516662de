"""Scenes that break touch sensors: resting contact on a corner, ties, deep overlap, fast spin, careless quaternions."""

import numpy as np
import pytest
import torch
from oracles.hard.probes import HARD, NUM_STEPS, jittered, repeated
from oracles.setups.scenes import module, state

import tgdsl


def two_cubes(tmp_path, dtype=torch.float64, bodies=("left", "right")):
    """Return a probe half way between two cubes that move in opposite directions, and the scene's rest state."""
    cube = '<freejoint/><geom type="box" size=".01 .01 .01"/>'
    (tmp_path / "scene.xml").write_text(
        '<mujoco><worldbody><body name="pad"><freejoint/><geom size=".05"/></body>'
        + "".join(f'<body name="{body}">{cube}</body>' for body in bodies)
        + "</worldbody></mujoco>"
    )
    points = [{"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.004}]
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(tmp_path / "scene.xml"),
                "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}},
            },
            "objects": {body: {"body": body} for body in bodies},
            "sensors": {
                "s": {
                    "kind": "kinematic_taxel",
                    "links": "pad",
                    "feels": list(bodies),
                    "gate": "geometric",
                    "outputs": ["force"],
                }
            },
        },
        dtype=dtype,
    )
    scene = repeated(state(touch), 1)
    for body, side in (("left", -1.0), ("right", 1.0)):
        i = touch.inputs.bodies.index(body)
        scene.body_pos[0, i, 0] = side * 0.012
        scene.body_linvel[0, i, 1] = side
    return touch, scene


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_first_of_two_equally_deep_objects_always_wins(tmp_path, dtype):
    for bodies in (("left", "right"), ("right", "left")):
        touch, scene = two_cubes(tmp_path, dtype, bodies)
        force = touch(jittered(scene, NUM_STEPS))["s"][:, 0].double()
        side = -1.0 if bodies[0] == "left" else 1.0
        expected = [-side * 500 * 0.002**1.2, 2 * side, 0]  # pushed away from the winner, dragged along with it
        np.testing.assert_allclose(force.numpy(), np.tile(expected, (NUM_STEPS, 1)), atol=1e-4)


def test_the_deeper_object_wins_whatever_the_order(tmp_path):
    touch, scene = two_cubes(tmp_path)
    scene.body_pos[0, touch.inputs.bodies.index("right"), 0] -= 1e-5
    assert touch(scene)["s"][0, 0, 1].item() == pytest.approx(2.0)


def test_quaternions_need_not_have_unit_length(tmp_path):
    touch = module(tmp_path, [(0.01, 0.004, 0.002)], '<geom type="box" size=".02 .01 .015"/>', kind="kinematic_taxel")
    unit = state(touch, quat=[0.5, 0.5, -0.5, 0.5], angvel=[1, 2, 3])
    expected = touch(unit)["s"]
    for factor in (1e-3, 0.5, 1 + 1e-6, 40.0):
        scene = state(touch, quat=[factor * part for part in (0.5, 0.5, -0.5, 0.5)], angvel=[1, 2, 3])
        torch.testing.assert_close(touch(scene)["s"], expected, rtol=1e-12, atol=1e-14)


def test_fingers_feel_each_other(tmp_path):
    """An object may be a link of the robot; no link feels itself."""
    (tmp_path / "scene.xml").write_text(
        '<mujoco><worldbody><body name="thumb"><freejoint/><geom size=".01"/></body>'
        '<body name="index"><freejoint/><geom type="box" size=".01 .01 .01"/></body></worldbody></mujoco>'
    )
    point = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"thumb": point, "index": point}}}},
            "objects": {"thumb": {"body": "thumb"}, "index": {"body": "index"}},
            "sensors": {"s": {"kind": "contact_depth", "links": "*", "feels": ["thumb", "index"]}},
        },
        dtype=torch.float64,
    )
    assert {(pair.link, pair.object) for pair in touch.inputs.pairs} == {("thumb", "index"), ("index", "thumb")}
    scene = touch.example_state(1)
    rows = {body: i for i, body in enumerate(touch.inputs.bodies)}
    scene.body_pos[:], scene.body_quat[:] = 0.0, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
    scene.body_pos[0, rows["index"], 2] = 0.019
    scene.contact_found[:] = True
    depth = dict(zip(touch.taxels["s"]["link"], touch(scene)["s"][0, :, 0].tolist(), strict=True))
    # The thumb's probe is 1 mm inside the index's box; the index's probe 19 mm above the thumb's ball.
    assert depth == {"thumb": pytest.approx(0.005), "index": 0.0}


@pytest.mark.parametrize("geom", HARD)
def test_depth_follows_sizes(tmp_path, geom):
    """Derivatives by an object's sizes match its readings, where the nearest point is unique."""
    rng = np.random.default_rng(4)
    touch = module(tmp_path, rng.normal(scale=0.012, size=(20, 3)) + 0.003, geom, kind="contact_depth")
    size = touch.constants["quantities/contact_depth/geoms/0/size"].clone()
    scene = state(touch)

    def depth(values: torch.Tensor) -> torch.Tensor:
        touch.constants._buffers["quantities/contact_depth/geoms/0/size"] = values
        return touch(scene)["s"]

    assert torch.autograd.gradcheck(depth, size.requires_grad_(), eps=1e-7, atol=1e-5)
