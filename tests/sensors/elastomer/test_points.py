"""Shear from points on objects: the sum over known points, gradients, variants and links of any shape."""

from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from oracles.setups.scenes import module, state
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.sensors.elastomer import ELASTOMER
from tgdsl.surfaces.quadrature import Pieces
from tgdsl.testing import ReferenceModule, assert_agrees

HALF, D, NUM = 0.02, 5e-4, 400
MARKERS = [(0.0, 0.0, 0.0), (0.012, -0.005, 0.0), (-0.018, 0.019, 0.0), (0.03, 0.0, 0.0)]
QUIET = {"kind": "elastomer", "dilation_strength": 0}
PAD = '<geom type="box" size=".03 .1 .1" pos="0 0 -.03" euler="0 90 0"/>'
"""A slab with its upper side at z = 0, turned and off its body's frame."""


def compile_cube(folder, markers=MARKERS, pad=PAD, item=f'<geom type="box" size="{HALF} {HALF} {HALF}"/>', area=None, **sensor):
    """Compile a cube of 4 cm and a pad with markers that only shear moves."""
    (folder / "scene.xml").write_text(
        f'<mujoco><worldbody><body name="pad"><freejoint/>{pad}</body><body name="item"><freejoint/>{item}</body>'
        "</worldbody></mujoco>"
    )
    sensor = {"anchors": "points", "points": NUM, "gate": "geometric", **QUIET, **sensor}
    if sensor["anchors"] == "taxels":
        del sensor["points"]
    target = sensor.pop("target", {"body": "item"})
    points = [
        {"pos": [float(v) for v in at], "normal": [0, 0, 1], "radius": 0.004, **({"area": area} if area else {})}
        for at in markers
    ]
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": layout},
        "objects": {"item": target},
        "sensors": {"s": {"links": "pad", "feels": ["item"], **sensor}},
    }
    return tgdsl.compile(document, dtype=torch.float64)


def sampled_points(touch, num=NUM):
    (cloud,) = touch.plan.quantities["points"].clouds
    assert cloud.points.shape == (3, 1, num)
    return cloud.points[:, 0].T.copy()


def closed_form(start, end, weight, markers=MARKERS, falloff=2000.0):
    """Return 100 Σ_p w Π(z_p − e_p) h_p exp(−λ |Π(x_j − z_p)|²) over shallow points that start and end below z = 0."""
    h = np.where((start[:, 2] < -1e-5) & (end[:, 2] < 0), -end[:, 2], 0.0)
    offset = np.array(markers)[:, None, :2] - end[None, :, :2]
    fall = np.exp(-falloff * (offset**2).sum(axis=2))
    return 100 * weight * np.einsum("jp,p,pk->jk", fall, h, (end - start)[:, :2])


@pytest.mark.parametrize("model", ["tgdsl", "paper"])
def test_a_dragged_cube_reads_the_sum_over_its_points(tmp_path, model):
    """Dragged by (a, b) and pressed a little deeper, in several orientations: every point of the cube is known."""
    touch = compile_cube(tmp_path, **({"model": "paper", "anchors": None} if model == "paper" else {}))
    weight = 1.0 if model == "paper" else 6 * (2 * HALF) ** 2 / NUM / 6e-6
    for turn in ([0, 0, 0], [0, np.pi / 2, 0], [0.01, -0.008, 0.3]):
        quat = Rotation.from_rotvec(turn)
        first, second = np.array([0, 0, HALF - D]), np.array([4e-4, -2.5e-4, HALF - 1.2 * D])
        touch.reset()
        still = touch(state(touch, pos=first.tolist(), quat=quat.as_quat(scalar_first=True)))["s"][0]
        readings = touch(state(touch, pos=second.tolist(), quat=quat.as_quat(scalar_first=True)))["s"][0].numpy()
        start, end = (quat.apply(sampled_points(touch)) + at for at in (first, second))
        assert not still.any() and ((start[:, 2] < 0).sum() > 10)
        expected = closed_form(start, end, weight)
        np.testing.assert_allclose(readings[:, :2], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
        assert not readings[:, 2].any()


def test_a_cube_turned_about_the_normal_twists_the_markers(tmp_path):
    """Each point moves by (R − 1) of its place: the field circles the middle and vanishes there."""
    markers = [(0.0, 0, 0), *((0.012 * np.cos(a), 0.012 * np.sin(a), 0) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False))]
    num, psi = 20000, 0.05
    touch = compile_cube(tmp_path, markers, points=num, shear_falloff=20000)
    turn = Rotation.from_rotvec([0, 0, psi])
    touch(state(touch, pos=[0, 0, HALF - D]))
    readings = touch(state(touch, pos=[0, 0, HALF - D], quat=turn.as_quat(scalar_first=True)))["s"][0].numpy()
    start = sampled_points(touch, num) + [0, 0, HALF - D]
    expected = closed_form(start, turn.apply(start), 6 * (2 * HALF) ** 2 / num / 6e-6, markers, 20000.0)
    np.testing.assert_allclose(readings[:, :2], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    outward = np.array(markers)[1:, :2] / 0.012
    around = outward @ [[0, 1], [-1, 0]]
    twist = (readings[1:, :2] * around).sum(axis=1)
    # ∫ (R − 1) z exp(−λ |x − z|²) dA = π/λ (R − 1) x, far from the edge
    np.testing.assert_allclose(twist, 100 / 6e-6 * D * np.pi / 20000 * 0.012 * np.sin(psi), rtol=0.12)
    assert np.abs((readings[1:, :2] * outward).sum(axis=1)).max() < 0.12 * twist.mean()
    assert np.linalg.norm(readings[0]) < 0.05 * twist.mean()


def test_many_points_and_many_taxels_agree(tmp_path):
    """Under a flat face anchors of taxels and of points are two quadratures of one integral."""
    line = np.linspace(-0.029, 0.029, 30)
    grid = [(x, y, 0.0) for x in line for y in line]
    shallow, num = 2e-4, 20000
    readings = []
    choices: list[dict[str, Any]] = [{"points": num}, {"anchors": "taxels"}]
    for fields in choices:
        touch = compile_cube(tmp_path, grid, area=4e-6, **fields)
        touch(state(touch, pos=[0, 0, HALF - shallow]))
        readings.append(touch(state(touch, pos=[3e-4, -2e-4, HALF - shallow]))["s"][0].numpy())
    points, taxels = readings
    error = np.abs(points - taxels).max() / np.abs(taxels).max()
    assert error < 0.05
    assert np.sqrt(((points - taxels) ** 2).mean() / (taxels**2).mean()) < 0.03


@pytest.mark.parametrize("friction", [None, 0.3])
def test_gradients_by_pose_with_held_anchors(tmp_path, friction):
    """Gradients of the second call, while points stick or some slide, against central differences."""
    touch = compile_cube(
        tmp_path, item='<geom type="sphere" size=".02"/>', friction=friction, dilation_strength=100, points=2000
    )
    first, second = state(touch, pos=[0, 0, 0.0185]), state(touch, pos=[3e-4, 1e-4, 0.0183], quat=[1, 0.02, 0.01, 0.03])
    touch(first)
    memory = {name: value.clone() for name, value in touch.memory.named_buffers()}
    assert memory["s:held"].sum() > 10
    assert second.body_pos is not None and second.body_quat is not None
    leaves = [second.body_pos.clone().requires_grad_(), second.body_quat.clone().requires_grad_()]
    scale = float(touch(second)["s"].abs().max())

    def read(pos, quat):
        return touch.core({"body_pos": pos, "body_quat": quat}, memory)[0]["s"] / scale

    assert torch.autograd.gradcheck(read, leaves, eps=1e-8, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("height", [0.0, 1e-9, 5.0])
def test_gradients_are_finite_at_first_touch_and_far_away(tmp_path, height):
    touch = module(
        tmp_path, MARKERS, '<geom type="sphere" size=".02"/>', kind="elastomer", anchors="points", points=50, friction=0.5,
        dtype=torch.float32,
    )  # fmt: skip
    for down in (0.0, 1e-7):
        inputs = state(touch, pos=[0, 0, 0.07 + height - down])
        assert inputs.body_pos is not None
        inputs.body_pos.requires_grad_()
        (gradient,) = torch.autograd.grad(touch(inputs)["s"].sum(), [inputs.body_pos])
        assert torch.isfinite(gradient).all()


def test_near_points_are_neighbours_in_the_list(tmp_path):
    """Each face of a cube is one run of the list; most steps are at most a few spacings long."""
    pos = sampled_points(compile_cube(tmp_path))
    axis = np.abs(pos).argmax(axis=1)
    is_new = np.diff(2 * axis + (pos[np.arange(NUM), axis] > 0)) != 0
    assert is_new.sum() == 5
    steps = np.linalg.norm(np.diff(pos, axis=0), axis=1)
    assert np.quantile(steps, 0.8) < 2 * np.sqrt(6 * (2 * HALF) ** 2 / NUM)


def test_ordering_keeps_all_points():
    corners = np.random.default_rng(0).normal(size=(20, 3, 3))
    pieces = Pieces(corners, corners.mean(axis=1), corners[:, 0], np.ones(20))
    plain, ordered = (sorted(draw(50, seed=3).tolist()) for draw in (pieces.random, pieces.random_by_side))
    assert plain == ordered


VARIANTS = [
    {"type": "box", "size": [HALF, 0.015, 0.01]},
    {"geoms": [{"type": "sphere", "size": [0.02]}, {"type": "capsule", "size": [0.01, 0.02], "pos": [0.01, 0, 0.01]}]},
]
COMPOUND = PAD + '<geom type="capsule" size=".008 .02" pos=".01 .02 .004" euler="30 70 10"/>'


def test_variants_on_a_compound_link_equal_the_reference(tmp_path):
    """Each environment has the points of its variant; the link is the union of two turned geoms."""
    sensor = {"standoff": 0.004, "friction": 0.5, "dilation_strength": 100, "points": 60}
    touch = compile_cube(tmp_path, pad=COMPOUND, target={"body": "item", "variants": VARIANTS}, **sensor)
    plan = touch.plan
    assert plan.objects[0].num_variants == 2
    fields = {"kind": "elastomer", "links": "pad", "feels": ("item",), "anchors": "points", "gate": "geometric", **sensor}
    reference = ReferenceModule(plan, ELASTOMER, ELASTOMER.spec(**fields))
    for seed in range(3):
        inputs = touch.example_state(6, seed=seed, spread=0.01)
        assert inputs.body_pos is not None and inputs.variant is not None
        inputs.body_pos[:, touch.inputs.bodies.index("item"), 2] += 0.01
        inputs.variant[:] = torch.arange(6)[:, None] % 2
        assert_agrees(touch(inputs)["s"], reference, inputs, 1e-12)
    area = plan.quantities["points"].clouds[0].area * 60
    assert area[0] == pytest.approx(8 * (HALF * 0.015 + HALF * 0.01 + 0.015 * 0.01), rel=1e-9)
    assert (touch.memory.get_buffer("s:held").sum(dim=1) > 0).all()


def test_a_mesh_link_feels_like_the_primitive(tmp_path):
    """The pad is a finely meshed box, by its baked grid."""
    trimesh.creation.box((0.02, 0.06, 0.06)).export(tmp_path / "slab.stl")
    plain = compile_cube(tmp_path, pad='<geom type="box" size=".01 .03 .03" pos="0 0 -.01" euler="0 90 0"/>')
    (tmp_path / "scene.xml").write_text("")
    asset = (
        '</body><body name="unused"/></worldbody><asset><mesh name="slab" file="slab.stl"/></asset><worldbody><body name="p">'
    )
    readings = []
    for touch in (plain, compile_cube(tmp_path, pad='<geom type="mesh" mesh="slab" pos="0 0 -.01" euler="0 90 0"/>' + asset)):
        touch(state(touch, pos=[0, 0, HALF - D]))
        readings.append(touch(state(touch, pos=[3e-4, -2e-4, HALF - D]))["s"][0].numpy())
    assert np.abs(readings[1] - readings[0]).max() < 0.02 * np.abs(readings[0]).max()
