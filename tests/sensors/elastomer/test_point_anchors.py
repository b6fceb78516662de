"""Anchors of points: the conformance suite, the printed sum by hand, sticking, sliding and release."""

import dataclasses

import numpy as np
import pytest
import torch

from tgdsl.geometry.planes import vec
from tgdsl.quantities.points import LinkPoints, ReferencePoints, point_tiles
from tgdsl.sensors.elastomer import ELASTOMER
from tgdsl.sensors.elastomer.anchors import StickSlip
from tgdsl.sensors.elastomer.point_anchors import PLANES, Markers, advance, drag, reference_drag
from tgdsl.testing import SCENE, KindConformance


class Creeping(KindConformance):
    """Poses move little between states, so that points stay in the skin; one gate in three closes at the end."""

    kind = ELASTOMER
    step = 5e-4

    def states(self, module, num_envs=None):
        first = module.example_state(num_envs or self.num_envs, seed=0)
        assert first.body_pos is not None and first.body_quat is not None
        for step in range(self.num_steps):
            direction = torch.randn(first.body_pos.shape, generator=torch.Generator().manual_seed(step), dtype=torch.float64)
            turned = first.body_quat + 5 * self.step * step * torch.cat([direction, direction[..., :1]], dim=-1)
            is_in_contact = first.contact_found
            if is_in_contact is not None:
                is_in_contact = torch.ones_like(is_in_contact)
                is_in_contact[::3, 0] = float(step < 2)
            pos = first.body_pos + self.step * step * direction
            yield dataclasses.replace(first, body_pos=pos, body_quat=turned, contact_found=is_in_contact)


class TestElastomerOnPoints(Creeping):
    num_envs = 12  # with fewer hardly a point slides
    parameters = {"anchors": "points", "feels": ["item", "tool"], "standoff": 0.003, "points": 80, "friction": 0.3}
    gates = ("geometric",)


class TestElastomerOnPointsAsInThePaper(Creeping):
    test_compiled_equals_eager = None  # part of another compiled graph
    test_gradients_of_parameters_equal_finite_differences = None  # as for points above, and for the paper's model of taxels
    parameters = {"feels": ["item", "tool"], "points": 80, "model": "paper", "shear_strength": 200}


def test_shear_matters_in_the_suites_states(tmp_path):
    """In the suite's states points stay held, some of them slide, and they move markers."""
    suite, free = TestElastomerOnPoints(), TestElastomerOnPointsAsInThePaper()
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    for case, changes in ((suite, {"friction": 0}), (suite, {"friction": 5}), (free, {"shear_falloff": 4000})):
        touch, _ = case.build(case.document(scene), torch.float64)
        changed, _ = case.build(case.document(scene, **changes), torch.float64)
        differences = []
        for inputs in case.states(touch):
            read, reread = touch(inputs)["s"], changed(inputs)["s"]
            differences.append(float((read - reread).abs().max() / read.abs().max()))
        assert differences[0] == 0 and max(differences) > 5e-3


STICK_SLIP = StickSlip(1e-3, 1e-5, 1e-4, None)
TILES = torch.tensor(point_tiles([(0, 2)], 2))
UP = np.array([0.0, 0.0, 1.0])


class Skin:
    """Markers at the origin and next to it, and two points; each step runs torch and the reference, which must agree."""

    POS = np.array([[0.0, 0, 0], [4e-3, 3e-3, 0]])
    NORMAL = np.array([UP, [0.6, 0, 0.8]])

    def __init__(self, stick_slip=STICK_SLIP, gradient=UP):
        self.stick_slip, self.gradient = stick_slip, np.broadcast_to(gradient, (2, 3))
        self.memory = {name: np.zeros(2) for name in PLANES}

    def step(self, pos, distance):
        pos = np.asarray(pos, dtype=float)
        distance = np.broadcast_to(np.asarray(distance, dtype=float), (2,))
        reference_points = ReferencePoints(np.arange(2), pos, distance, self.gradient, 3e-6)
        expected, after = reference_drag([reference_points], self.POS, self.NORMAL, self.stick_slip, 2000.0, 6e-6, self.memory)

        def rows(vectors):
            return vec(torch.from_numpy(np.array(part))[None, None] for part in vectors.T)

        phi, area = torch.tensor(distance)[None, None], torch.tensor([[3e-6]], dtype=torch.float64)
        points = LinkPoints(((0, 2),), TILES, rows(pos), phi, rows(self.gradient), area)
        previous = {name: torch.from_numpy(value)[None] for name, value in self.memory.items()}
        loads, state = advance([points], self.stick_slip, previous)
        marker, normal = (vec(part[0, 0] for part in rows(vectors)) for vectors in (self.POS, self.NORMAL))
        markers = Markers(marker, normal, *torch.tensor([2000.0, 6e-6], dtype=torch.float64))
        np.testing.assert_allclose(torch.stack(drag(loads, markers, 1), dim=-1)[0], expected, rtol=1e-12, atol=1e-22)
        for name in PLANES:
            np.testing.assert_allclose(state[name][0], after[name], rtol=1e-12, atol=1e-18)
        self.memory, self.loads = after, torch.stack(loads[0].strength, dim=-1)[0, 0].numpy()
        return expected


START = np.array([[1e-3, 0, 0.5e-3], [-2e-3, 5e-3, 0.2e-3]])


def test_two_points_by_hand():
    """The printed sum for two points that move differently, with one tilted tangent plane; weights are A_p/A_ref."""
    skin = Skin()
    assert not skin.step(START, [0.5e-3, 0.2e-3]).any()
    shift = np.array([[2e-4, -1e-4, -1e-4], [-1e-4, 3e-4, 5e-5]])
    displacements = skin.step(START + shift, [0.4e-3, 0.25e-3])
    for x, n, u in zip(Skin.POS, Skin.NORMAL, displacements, strict=True):
        flat = np.eye(3) - np.outer(n, n)
        expected = np.zeros(3)
        for z, s, h in zip(START + shift, shift, [0.6e-3, 0.75e-3], strict=True):
            expected += 0.5 * flat @ s * h * np.exp(-2000 * np.sum((flat @ (x - z)) ** 2))
        np.testing.assert_allclose(u, expected, rtol=1e-12)


def test_lifting_releases_and_touching_again_restarts():
    """The standoff raises both thresholds; between them nothing changes, beyond them the displacement is forgotten."""
    skin, shift = Skin(), np.array([2e-4, 0, 0])
    skin.step(START, [1e-3 - 0.5e-5, 1e-3 - 2e-5])
    np.testing.assert_array_equal(skin.memory["held"], [0, 1])
    skin.step(START + shift, [1.0, 1e-3 + 0.9e-4])
    np.testing.assert_array_equal(skin.memory["held"], [0, 1])
    assert not skin.loads.any()  # held, but nothing presses
    skin.step(START + shift, [1.0, 0.5e-3])
    np.testing.assert_allclose(skin.loads[1], 0.5e-3 * shift, rtol=1e-12)
    skin.step(START + shift, [1.0, 1e-3 + 1.1e-4])
    assert not any(skin.memory[name].any() for name in PLANES)
    skin.step(START + shift, 0.5e-3)
    assert not skin.loads.any()
    skin.step(START + 3 * shift, 0.5e-3)
    np.testing.assert_allclose(skin.loads, [0.5e-3 * 2 * shift] * 2, rtol=1e-12)
    skin.step(START, np.inf)  # the gate closed
    assert not skin.memory["held"].any()


@pytest.mark.parametrize("gradient", [UP, np.array([0.0, 0.6, 0.8])])
def test_the_cap_holds_exactly_and_the_anchor_is_dragged(gradient):
    """|Π_m s| ≤ μ' h in the link's tangent plane at the point; moving back unloads at once."""
    skin, h, slip = Skin(STICK_SLIP._replace(slip=0.5), gradient), 0.4e-3, 0.5
    flat = np.eye(3) - np.outer(gradient, gradient)
    way = np.array([3e-3, 4e-3, 1e-3])
    skin.step(START, 1e-3 - h)
    skin.step(START + way, 1e-3 - h)
    t = flat @ way
    held = slip * h * t / np.linalg.norm(t)
    np.testing.assert_allclose(skin.loads @ flat, [h * held] * 2, rtol=1e-10)
    np.testing.assert_allclose(skin.loads @ gradient, h * (way @ gradient), rtol=1e-10)  # the rest stays
    skin.step(START + way - 0.1 * held, 1e-3 - h)
    np.testing.assert_allclose(skin.loads @ flat, [h * 0.9 * held] * 2, rtol=1e-10)
    below = Skin(STICK_SLIP._replace(slip=0.5))
    below.step(START, 1e-3 - h)
    anchors = [below.memory[name].copy() for name in PLANES]
    below.step(START + [0.49 * h, 0, 0], 1e-3 - h)
    np.testing.assert_array_equal([below.memory[name] for name in PLANES], anchors)


def test_nan_is_returned_and_not_remembered():
    skin = Skin(STICK_SLIP._replace(slip=0.5))
    skin.step(START, [0.5e-3, 5.0])
    previous = {name: torch.from_numpy(value)[None] for name, value in skin.memory.items()}
    nan = torch.full((1, 1, 2), torch.nan, dtype=torch.float64)
    broken = LinkPoints(((0, 2),), TILES, (nan, nan, nan), nan, (nan, nan, nan), nan[0, :, :1])
    loads, after = advance([broken], skin.stick_slip, previous)
    assert loads[0].strength[0][0, 0, 0].isnan()
    for name in PLANES:
        torch.testing.assert_close(after[name], previous[name], rtol=0, atol=0)
