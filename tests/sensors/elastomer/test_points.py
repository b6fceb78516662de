"""Shear from points on the objects: the printed sum by hand and over known points, holding on and letting go, what is refused."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scenes import module, state
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.compiler.pipeline import compile_plan
from tgdsl.errors import SpecError
from tgdsl.geometry.planes import vec
from tgdsl.module.module import TactileModule
from tgdsl.quantities.points.points import MetPoints, point_tiles
from tgdsl.quantities.reference import ReferencePoints
from tgdsl.schema.load import load
from tgdsl.sensors.elastomer import ELASTOMER, ElastomerSpec
from tgdsl.sensors.elastomer.anchors import Law
from tgdsl.sensors.elastomer.point_anchors import PLANES, Markers, advance, drag, reference_drag
from tgdsl.surfaces.quadrature import Pieces
from tgdsl.testing import SCENE, KindConformance, ReferenceModule, assert_agrees


class Creeping(KindConformance):
    """Poses that move little from one state to the next, so that points stay in the skin; one gate in three closes at last."""

    kind = ELASTOMER
    num_envs = 6
    step = 5e-4

    def states(self, module, num_envs=None):
        first = module.example_state(num_envs or self.num_envs, seed=0)
        assert first.body_pos is not None and first.body_quat is not None
        for step in range(self.num_steps):
            way = torch.randn(first.body_pos.shape, generator=torch.Generator().manual_seed(step), dtype=torch.float64)
            turned = first.body_quat + 5 * self.step * step * torch.cat([way, way[..., :1]], dim=-1)
            found = first.contact_found
            if found is not None:
                found = torch.ones_like(found)
                found[::3, 0] = float(step < 2)
            pos = first.body_pos + self.step * step * way
            yield dataclasses.replace(first, body_pos=pos, body_quat=turned, contact_found=found)


class TestElastomerOnPoints(Creeping):
    parameters = {"anchors": "points", "feels": ["item", "tool"], "standoff": 0.003, "points": 80, "friction": 0.3}
    gates = ("geometric",)


class TestElastomerOnPointsAsInThePaper(Creeping):
    test_compiled_equals_eager = None  # its graph is part of one that is compiled beside it
    parameters = {"feels": ["item", "tool"], "points": 80, "model": "paper", "shear_strength": 200}


def test_shear_is_in_what_the_suite_compares(tmp_path):
    """In the suite's states points are held from one to the next, some of them slide, and they move markers."""
    suite, free = TestElastomerOnPoints(), TestElastomerOnPointsAsInThePaper()
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    for one, other in ((suite, {"friction": 0}), (suite, {"friction": 5}), (free, {"shear_falloff": 4000})):
        touch, _ = one.build(one.document(scene), torch.float64)
        changed, _ = one.build(one.document(scene, **other), torch.float64)
        differences = []
        for found in one.states(touch):
            read, reread = touch(found)["s"], changed(found)["s"]
            differences.append(float((read - reread).abs().max() / read.abs().max()))
        assert differences[0] == 0 and max(differences) > 5e-3


LAW = Law(1e-3, 1e-5, 1e-4, None)
TILES = torch.tensor(point_tiles([(0, 2)], 2))
UP = np.array([0.0, 0.0, 1.0])


class Skin:
    """Markers at the origin and beside it, two points, and the same steps for torch and the reference, which must agree."""

    POS = np.array([[0.0, 0, 0], [4e-3, 3e-3, 0]])
    NORMAL = np.array([UP, [0.6, 0, 0.8]])

    def __init__(self, law=LAW, gradient=UP):
        self.law, self.gradient = law, np.broadcast_to(gradient, (2, 3))
        self.memory = {name: np.zeros(2) for name in PLANES}

    def step(self, pos, distance):
        pos = np.asarray(pos, dtype=float)
        distance = np.broadcast_to(np.asarray(distance, dtype=float), (2,))
        by_hand = ReferencePoints(np.arange(2), pos, distance, self.gradient, 3e-6)
        expected, after = reference_drag([by_hand], self.POS, self.NORMAL, self.law, 2000.0, 6e-6, self.memory)

        def rows(vectors):
            return vec(torch.from_numpy(np.array(part))[None, None] for part in vectors.T)

        phi, area = torch.tensor(distance)[None, None], torch.tensor([[3e-6]], dtype=torch.float64)
        met = MetPoints(((0, 2),), TILES, rows(pos), phi, rows(self.gradient), area)
        before = {name: torch.from_numpy(value)[None] for name, value in self.memory.items()}
        pulls, found = advance([met], self.law, before)
        marker, normal = (vec(part[0, 0] for part in rows(vectors)) for vectors in (self.POS, self.NORMAL))
        markers = Markers(marker, normal, *torch.tensor([2000.0, 6e-6], dtype=torch.float64))
        np.testing.assert_allclose(torch.stack(drag(pulls, markers, 1), dim=-1)[0], expected, rtol=1e-12, atol=1e-22)
        for name in PLANES:
            np.testing.assert_allclose(found[name][0], after[name], rtol=1e-12, atol=1e-18)
        self.memory, self.pulls = after, torch.stack(pulls[0].strength, dim=-1)[0, 0].numpy()
        return expected


START = np.array([[1e-3, 0, 0.5e-3], [-2e-3, 5e-3, 0.2e-3]])


def test_two_points_by_hand():
    """The printed sum for two points that move by different ways, one marker's tangent plane tilted; weights are A_p/A_ref."""
    skin = Skin()
    assert not skin.step(START, [0.5e-3, 0.2e-3]).any()
    way = np.array([[2e-4, -1e-4, -1e-4], [-1e-4, 3e-4, 5e-5]])
    found = skin.step(START + way, [0.4e-3, 0.25e-3])
    for x, n, u in zip(Skin.POS, Skin.NORMAL, found, strict=True):
        flat = np.eye(3) - np.outer(n, n)
        expected = np.zeros(3)
        for z, s, h in zip(START + way, way, [0.6e-3, 0.75e-3], strict=True):
            expected += 0.5 * flat @ s * h * np.exp(-2000 * np.sum((flat @ (x - z)) ** 2))
        np.testing.assert_allclose(u, expected, rtol=1e-12)


def test_lifting_lets_go_and_touching_again_takes_hold_anew():
    """The standoff raises both thresholds; between them nothing changes, beyond them the way so far is forgotten."""
    skin, way = Skin(), np.array([2e-4, 0, 0])
    skin.step(START, [1e-3 - 0.5e-5, 1e-3 - 2e-5])
    np.testing.assert_array_equal(skin.memory["held"], [0, 1])
    skin.step(START + way, [1.0, 1e-3 + 0.9e-4])
    np.testing.assert_array_equal(skin.memory["held"], [0, 1])
    assert not skin.pulls.any()  # held, but nothing presses
    skin.step(START + way, [1.0, 0.5e-3])
    np.testing.assert_allclose(skin.pulls[1], 0.5e-3 * way, rtol=1e-12)
    skin.step(START + way, [1.0, 1e-3 + 1.1e-4])
    assert not any(skin.memory[name].any() for name in PLANES)
    skin.step(START + way, 0.5e-3)
    assert not skin.pulls.any()
    skin.step(START + 3 * way, 0.5e-3)
    np.testing.assert_allclose(skin.pulls, [0.5e-3 * 2 * way] * 2, rtol=1e-12)
    skin.step(START, np.inf)  # the gate closed
    assert not skin.memory["held"].any()


@pytest.mark.parametrize("gradient", [UP, np.array([0.0, 0.6, 0.8])])
def test_the_cap_holds_exactly_and_the_anchor_is_dragged(gradient):
    """|Π_m s| ≤ μ' h in the tangent plane of the link at the point; moving back at once unloads from there."""
    skin, h, slip = Skin(LAW._replace(slip=0.5), gradient), 0.4e-3, 0.5
    flat = np.eye(3) - np.outer(gradient, gradient)
    way = np.array([3e-3, 4e-3, 1e-3])
    skin.step(START, 1e-3 - h)
    skin.step(START + way, 1e-3 - h)
    t = flat @ way
    held = slip * h * t / np.linalg.norm(t)
    np.testing.assert_allclose(skin.pulls @ flat, [h * held] * 2, rtol=1e-10)
    np.testing.assert_allclose(skin.pulls @ gradient, h * (way @ gradient), rtol=1e-10)  # the rest stays
    skin.step(START + way - 0.1 * held, 1e-3 - h)
    np.testing.assert_allclose(skin.pulls @ flat, [h * 0.9 * held] * 2, rtol=1e-10)
    below = Skin(LAW._replace(slip=0.5))
    below.step(START, 1e-3 - h)
    anchors = [below.memory[name].copy() for name in PLANES]
    below.step(START + [0.49 * h, 0, 0], 1e-3 - h)
    np.testing.assert_array_equal([below.memory[name] for name in PLANES], anchors)


def test_not_a_number_comes_out_and_is_not_remembered():
    skin = Skin(LAW._replace(slip=0.5))
    skin.step(START, [0.5e-3, 5.0])
    before = {name: torch.from_numpy(value)[None] for name, value in skin.memory.items()}
    nan = torch.full((1, 1, 2), torch.nan, dtype=torch.float64)
    broken = MetPoints(((0, 2),), TILES, (nan, nan, nan), nan, (nan, nan, nan), nan[0, :, :1])
    pulls, after = advance([broken], skin.law, before)
    assert pulls[0].strength[0][0, 0, 0].isnan()
    for name in PLANES:
        torch.testing.assert_close(after[name], before[name], rtol=0, atol=0)


HALF, D, NUM = 0.02, 5e-4, 400
MARKERS = [(0.0, 0.0, 0.0), (0.012, -0.005, 0.0), (-0.018, 0.019, 0.0), (0.03, 0.0, 0.0)]
QUIET = {"kind": "elastomer", "dilation_strength": 0}
PAD = '<geom type="box" size=".03 .1 .1" pos="0 0 -.03" euler="0 90 0"/>'
"""A slab whose upper side is z = 0, off its body's frame and turned."""


def cube_on(folder, markers=MARKERS, pad=PAD, item=f'<geom type="box" size="{HALF} {HALF} {HALF}"/>', area=None, **sensor):
    """A cube of 4 cm and a pad with markers; the sensor moves them by shear alone."""
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


def sampled(touch, num=NUM):
    return touch.plan.arrays[f"objects/item/points/{num}/points"][:, 0].T.copy()


def closed_form(before, after, weight, markers=MARKERS, falloff=2000.0):
    """100 Σ_p w Π(z_p − e_p) h_p exp(−λ |Π(x_j − z_p)|²) over points that were and are below z = 0, all of them shallow."""
    h = np.where((before[:, 2] < -1e-5) & (after[:, 2] < 0), -after[:, 2], 0.0)
    apart = np.array(markers)[:, None, :2] - after[None, :, :2]
    fall = np.exp(-falloff * (apart**2).sum(axis=2))
    return 100 * weight * np.einsum("jp,p,pk->jk", fall, h, (after - before)[:, :2])


@pytest.mark.parametrize("model", ["tgdsl", "paper"])
def test_a_dragged_cube_is_the_sum_over_its_points(tmp_path, model):
    """Dragged by (a, b) and pressed a little deeper, any side down: every point of the cube is known."""
    touch = cube_on(tmp_path, **({"model": "paper", "anchors": None} if model == "paper" else {}))
    weight = 1.0 if model == "paper" else 6 * (2 * HALF) ** 2 / NUM / 6e-6
    for turn in ([0, 0, 0], [0, np.pi / 2, 0], [0.01, -0.008, 0.3]):
        quat = Rotation.from_rotvec(turn)
        first, second = np.array([0, 0, HALF - D]), np.array([4e-4, -2.5e-4, HALF - 1.2 * D])
        touch.reset()
        still = touch(state(touch, pos=first.tolist(), quat=quat.as_quat(scalar_first=True)))["s"][0]
        found = touch(state(touch, pos=second.tolist(), quat=quat.as_quat(scalar_first=True)))["s"][0].numpy()
        before, after = (quat.apply(sampled(touch)) + at for at in (first, second))
        assert not still.any() and ((before[:, 2] < 0).sum() > 10)
        expected = closed_form(before, after, weight)
        np.testing.assert_allclose(found[:, :2], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
        assert not found[:, 2].any()


def test_a_cube_turned_about_the_normal_twists_the_markers(tmp_path):
    """Each point by (R − 1) of its place; about the middle the field goes round, and it is nothing in the middle."""
    markers = [(0.0, 0, 0), *((0.012 * np.cos(a), 0.012 * np.sin(a), 0) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False))]
    num, psi = 20000, 0.05
    touch = cube_on(tmp_path, markers, points=num, shear_falloff=20000)
    turn = Rotation.from_rotvec([0, 0, psi])
    touch(state(touch, pos=[0, 0, HALF - D]))
    found = touch(state(touch, pos=[0, 0, HALF - D], quat=turn.as_quat(scalar_first=True)))["s"][0].numpy()
    before = sampled(touch, num) + [0, 0, HALF - D]
    expected = closed_form(before, turn.apply(before), 6 * (2 * HALF) ** 2 / num / 6e-6, markers, 20000.0)
    np.testing.assert_allclose(found[:, :2], expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    outward = np.array(markers)[1:, :2] / 0.012
    around = outward @ [[0, 1], [-1, 0]]
    twist = (found[1:, :2] * around).sum(axis=1)
    # ∫ (R − 1) z exp(−λ |x − z|²) dA = π/λ (R − 1) x, far from the edge
    np.testing.assert_allclose(twist, 100 / 6e-6 * D * np.pi / 20000 * 0.012 * np.sin(psi), rtol=0.12)
    assert np.abs((found[1:, :2] * outward).sum(axis=1)).max() < 0.12 * twist.mean()
    assert np.linalg.norm(found[0]) < 0.05 * twist.mean()


def test_many_points_and_many_taxels_agree(tmp_path):
    """Under a flat face the anchors of taxels and of points are two quadratures of one integral."""
    line = np.linspace(-0.029, 0.029, 30)
    grid = [(x, y, 0.0) for x in line for y in line]
    shallow, num = 2e-4, 20000
    readings = []
    choices: list[dict[str, Any]] = [{"points": num}, {"anchors": "taxels"}]
    for fields in choices:
        touch = cube_on(tmp_path, grid, area=4e-6, **fields)
        touch(state(touch, pos=[0, 0, HALF - shallow]))
        readings.append(touch(state(touch, pos=[3e-4, -2e-4, HALF - shallow]))["s"][0].numpy())
    points, taxels = readings
    error = np.abs(points - taxels).max() / np.abs(taxels).max()
    assert error < 0.05
    assert np.sqrt(((points - taxels) ** 2).mean() / (taxels**2).mean()) < 0.03


@pytest.mark.parametrize("friction", [None, 0.3])
def test_gradients_by_pose_with_anchors_held(tmp_path, friction):
    """Of the second call, while points stick, or some of them slide: against central differences."""
    touch = cube_on(tmp_path, item='<geom type="sphere" size=".02"/>', friction=friction, dilation_strength=100, points=2000)
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
        given = state(touch, pos=[0, 0, 0.07 + height - down])
        assert given.body_pos is not None
        given.body_pos.requires_grad_()
        (gradient,) = torch.autograd.grad(touch(given)["s"].sum(), [given.body_pos])
        assert torch.isfinite(gradient).all()


def test_points_that_are_near_follow_each_other(tmp_path):
    """Each face of a cube is one run of the list, and most steps are no longer than a few spacings."""
    pos = sampled(cube_on(tmp_path))
    axis = np.abs(pos).argmax(axis=1)
    is_new = np.diff(2 * axis + (pos[np.arange(NUM), axis] > 0)) != 0
    assert is_new.sum() == 5
    steps = np.linalg.norm(np.diff(pos, axis=0), axis=1)
    assert np.quantile(steps, 0.8) < 2 * np.sqrt(6 * (2 * HALF) ** 2 / NUM)


def test_the_order_changes_no_point():
    corners = np.random.default_rng(0).normal(size=(20, 3, 3))
    pieces = Pieces(corners, corners.mean(axis=1), corners[:, 0], np.ones(20))
    plain, ordered = (sorted(draw(50, seed=3).pos.tolist()) for draw in (pieces.random, pieces.random_by_side))
    assert plain == ordered


VARIANTS = [
    {"type": "box", "size": [HALF, 0.015, 0.01]},
    {"geoms": [{"type": "sphere", "size": [0.02]}, {"type": "capsule", "size": [0.01, 0.02], "pos": [0.01, 0, 0.01]}]},
]
COMPOUND = PAD + '<geom type="capsule" size=".008 .02" pos=".01 .02 .004" euler="30 70 10"/>'


def test_variants_on_a_compound_link_equal_the_reference(tmp_path):
    """Each environment has the points of its own variant; the link is the union of two turned geoms."""
    sensor = {"standoff": 0.004, "friction": 0.5, "dilation_strength": 100, "points": 60}
    touch = cube_on(tmp_path, pad=COMPOUND, target={"body": "item", "variants": VARIANTS}, **sensor)
    plan = touch.plan
    assert plan.objects[0].num_variants == 2
    fields = {"kind": "elastomer", "links": "pad", "feels": ("item",), "anchors": "points", "gate": "geometric", **sensor}
    reference = ReferenceModule(plan, ELASTOMER, ELASTOMER.spec(**fields))
    for seed in range(3):
        given = touch.example_state(6, seed=seed, spread=0.01)
        assert given.body_pos is not None and given.variant is not None
        given.body_pos[:, touch.inputs.bodies.index("item"), 2] += 0.01
        given.variant[:] = torch.arange(6)[:, None] % 2
        assert_agrees(touch(given)["s"], reference, given, 1e-12)
    area = plan.arrays["objects/item/points/60/area"] * 60
    assert area[0] == pytest.approx(8 * (HALF * 0.015 + HALF * 0.01 + 0.015 * 0.01), rel=1e-9)
    assert (touch.memory.get_buffer("s:held").sum(dim=1) > 0).all()


def test_a_link_that_is_a_mesh_feels_like_the_primitive(tmp_path):
    """A finely meshed box for the pad, by its baked grid."""
    trimesh.creation.box((0.06, 0.2, 0.2)).export(tmp_path / "slab.stl")
    plain = cube_on(tmp_path)
    (tmp_path / "scene.xml").write_text("")
    asset = (
        '</body><body name="unused"/></worldbody><asset><mesh name="slab" file="slab.stl"/></asset><worldbody><body name="p">'
    )
    readings = []
    for touch in (plain, cube_on(tmp_path, pad='<geom type="mesh" mesh="slab" pos="0 0 -.03" euler="0 90 0"/>' + asset)):
        touch(state(touch, pos=[0, 0, HALF - D]))
        readings.append(touch(state(touch, pos=[3e-4, -2e-4, HALF - D]))["s"][0].numpy())
    assert np.abs(readings[1] - readings[0]).max() < 0.02 * np.abs(readings[0]).max()


PAIRS = """
<mujoco><worldbody>
  <body name="a" pos="0 0 .1"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="b"><freejoint/><geom type="box" size=".02 .02 .01"/></body>
  <body name="item"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  <body name="floor"><geom type="plane" size="1 1 .1"/></body>
</worldbody><contact><exclude body1="b" body2="item"/></contact></mujoco>
"""


def on_two_links(folder, **sensor):
    (folder / "scene.xml").write_text(PAIRS)
    taxel = {"method": "points", "radius": 0.004, "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}]}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"a": taxel, "b": taxel}}}},
        "objects": {"item": {"body": "item"}, "floor": {"body": "floor"}},
        "sensors": {"s": {"kind": "elastomer", "links": "*", "feels": ["item"], "anchors": "points", "points": 50, **sensor}},
    }


def test_state_is_for_pairs_that_can_meet(tmp_path):
    """Link b and the item never collide: under the gate it has no points; explain says what is remembered."""
    touch = tgdsl.compile(on_two_links(tmp_path))
    assert {name: memory.shape for name, memory in touch.plan.sensors[0].state.items()} == dict.fromkeys(PLANES, (50,))
    text = touch.explain()
    assert "remembers anchor_x, anchor_y, anchor_z, held (800 bytes per environment)" in text
    assert "50 points of item against a" in text
    both = compile_plan(on_two_links(tmp_path, gate="geometric"))
    assert both.sensors[0].state["held"].shape == (100,)
    unsheared = on_two_links(tmp_path, gate="geometric", shear_strength=0)
    del unsheared["sensors"]["s"]["anchors"], unsheared["sensors"]["s"]["points"]
    still = compile_plan(unsheared)
    assert not still.sensors[0].state and still.skin is None


def test_the_gate_is_that_of_the_pair(tmp_path):
    """Points sink in only while the simulator has the pair in contact, and let go when it has not."""
    touch = tgdsl.compile(on_two_links(tmp_path, dilation_strength=0), dtype=torch.float64)
    assert [(pair.link, pair.object) for pair in touch.inputs.pairs] == [("a", "item")]
    given = state(touch, pos=[0, 0, 0.0295])
    for found, shift, reads in ((0, 0.0, False), (1, 1e-4, False), (1, 3e-4, True), (0, 4e-4, False), (1, 5e-4, False)):
        given = state(touch, pos=[shift, 0, 0.0295])
        given.contact_found = torch.full((1, 1), float(found))
        readings = touch(given)["s"][0]
        assert bool(readings[0].any()) == reads and not readings[1].any()
        assert bool(touch.memory.get_buffer("s:held").any()) == bool(found)


REFUSED = [
    ({"feels": ["item", "floor"]}, {}, 'sensors.s.feels[1]: body "floor" has a plane', "anchors: taxels"),
    ({}, {"size": "per_env"}, 'sensors.s.feels[0]: the size of body "item" is given per environment', "anchors: taxels"),
    (
        {"kernel": "half_space", "youngs_modulus": 1e5, "normal_stiffness": 1e8, "points": None},
        {},
        "`anchors: points`",
        "taxels",
    ),
    ({"anchors": "taxels"}, {}, "`points` is not used by `anchors: taxels`", ""),
    ({"shear_strength": 0, "points": None}, {}, "`anchors` is not used without shear", ""),
    ({"shear_strength": 0, "anchors": None}, {}, "`points` is not used without shear", ""),
    ({"points": 0}, {}, "sensors.s.points: found 0: input should be greater than or equal to 1", ""),
]


@pytest.mark.parametrize(("fields", "target", "message", "hint"), REFUSED)
def test_what_cannot_be_is_refused_where_it_stands(tmp_path, fields, target, message, hint):
    document = on_two_links(tmp_path)
    document["objects"]["item"] |= target
    sensor = {**document["sensors"]["s"], **fields}
    document["sensors"]["s"] = {name: value for name, value in sensor.items() if value is not None}
    with pytest.raises(SpecError) as caught:
        compile_plan(document)
    assert message in str(caught.value) and hint in str(caught.value)


@pytest.mark.parametrize("readout", ["measured", "clean", "both"])
def test_a_mistake_is_named_once_however_a_sensor_is_read(tmp_path, readout):
    """A sensor that is read both ways with noise of its radii is computed twice, and has one place in the document."""
    document = on_two_links(tmp_path, readout=readout, noise={"radius_noise": 0.1}, feels=["item", "floor"])
    with pytest.raises(SpecError) as caught:
        compile_plan(document)
    assert [problem.path for problem in caught.value.problems] == ["sensors.s.feels[1]"]


def test_the_papers_model_anchors_points(tmp_path):
    document = on_two_links(tmp_path, model="paper")
    del document["sensors"]["s"]["anchors"]
    spec = load(document).spec.sensors["s"]
    assert isinstance(spec, ElastomerSpec) and spec.anchored == "points"
    assert TactileModule(compile_plan(document)).plan.sensors[0].state["held"].shape == (50,)
