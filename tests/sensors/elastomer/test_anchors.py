"""Stick and slip: the memory of the taxels' anchors, against geometry and a closed form of Winkler's foundation."""

import numpy as np
import pytest
import torch
from oracles import friction
from scipy.spatial.transform import Rotation

from tgdsl.geometry.planes import rot, vec
from tgdsl.quantities.contact_depth import Distance, Penetration, ReferencePenetration
from tgdsl.quantities.geoms import Frame
from tgdsl.sensors.elastomer.anchors import PLANES, StickSlip, advance, advance_reference

STICK_SLIP = StickSlip(0.0, 1e-5, 1e-4, None)
UP = np.array([0.0, 0.0, 1.0])


class Skin:
    """Taxels on a link; each step runs `advance` and its reference, which must agree."""

    def __init__(self, pos, normal=UP, stick_slip=STICK_SLIP):
        self.pos = np.atleast_2d(np.asarray(pos, dtype=float))
        self.normal = np.broadcast_to(np.asarray(normal, dtype=float), self.pos.shape)
        self.stick_slip = stick_slip
        self.memory = {name: np.zeros(len(self.pos)) for name in PLANES}

    def step(self, *objects):
        """Advance by a step. Objects: (distances [m], translation [m] and rotation vector in the link's frame)."""
        num = len(self.pos)
        phi = np.stack([np.broadcast_to(distance, num) for distance, *_ in objects], axis=1).astype(float)
        turns = [Rotation.from_rotvec(turn).as_matrix() for _, _, turn in objects]
        rotation = np.broadcast_to(np.stack([turn.T for turn in turns]), (num, len(objects), 3, 3))
        offset = np.broadcast_to(
            np.stack([-turn.T @ at for turn, (_, at, _) in zip(turns, objects, strict=True)]), (num, len(objects), 3)
        )
        depth = np.maximum(0.0, (self.stick_slip.standoff - phi).max(axis=1))
        zero = np.zeros((num, 3))
        touch = ReferencePenetration(depth, zero, zero, zero, phi, np.zeros((*phi.shape, 3)), rotation, offset)
        previous = {name: torch.from_numpy(value)[None] for name, value in self.memory.items()}
        expected, self.memory = advance_reference(touch, self.pos, self.normal, self.stick_slip, self.memory)
        penetration = self.felt(self.pos, phi, rotation, offset, depth)
        displacement, after = advance(penetration, self.planes(self.pos), self.planes(self.normal), self.stick_slip, previous)
        np.testing.assert_allclose(torch.stack(displacement, dim=-1)[0], expected, rtol=1e-12, atol=1e-16)
        for name in PLANES:
            np.testing.assert_allclose(after[name][0], self.memory[name], rtol=1e-12, atol=1e-16)
        return expected

    @staticmethod
    def planes(vectors):
        return vec(torch.from_numpy(vectors.T.copy()))

    @staticmethod
    def felt(pos, phi, rotation, offset, depth):
        def plane(values):
            return torch.tensor(np.ascontiguousarray(values))[None]

        zero = torch.zeros(1, len(phi), dtype=torch.float64)
        distances = {str(k): Distance(plane(phi[:, k]), (zero, zero, zero)) for k in range(phi.shape[1])}
        frames = {
            str(k): Frame(
                rot(plane(rotation[:, k].reshape(-1, 9)[:, i]) for i in range(9)), vec(plane(offset[:, k, i]) for i in range(3))
            )
            for k in range(phi.shape[1])
        }
        return Penetration(Skin.planes(pos), plane(depth), None, None, None, distances, frames)


HERE = ([0.0, 0, 0], [0.0, 0, 0])


def test_the_displacement_equals_a_translation_while_pressed():
    """The place of first touch does not matter; the part along the normal is left out."""
    skin = Skin([[1e-3, 2e-3, 0], [0, 0, 0]])
    start = np.array([3e-3, -1e-3, 5e-3])
    turn = [0.3, 0.8, -0.2]
    assert not skin.step((-1e-3, start, turn)).any()
    for shift in ([4e-4, -2e-4, 1e-3], [-6e-4, 1e-4, -3e-4]):
        displacement = skin.step((-1e-3, start + shift, turn))
        np.testing.assert_allclose(displacement, [[shift[0], shift[1], 0]] * 2, atol=1e-16)


def test_a_rotation_while_pressed_displaces_every_taxel():
    """About the normal through the origin: t = (R − 1) x; about a tangent, the tangential part of it."""
    x = np.array([[1e-3, 0.5e-3, 0.0], [-2e-3, 0, 0]])
    for turn in ([0, 0, 0.4], [0.2, 0, 0], [0.1, -0.2, 0.3]):
        skin = Skin(x)
        skin.step((-1e-3, *HERE))
        displacement = skin.step((-1e-3, [0.0, 0, 0], turn))
        moved = x @ Rotation.from_rotvec(turn).as_matrix().T - x
        np.testing.assert_allclose(displacement, moved * [1, 1, 0], atol=1e-16)


def test_each_taxel_has_its_own_tangent_plane():
    normal = np.array([[0, 0, 1.0], [1.0, 0, 0], [0.6, 0, 0.8]])
    skin = Skin(np.zeros((3, 3)), normal)
    skin.step((-1e-3, *HERE))
    displacement = skin.step((-1e-3, [1e-3, 2e-3, 0], [0.0, 0, 0]))
    np.testing.assert_allclose(
        displacement, [[1e-3, 2e-3, 0], [0, 2e-3, 0], [1e-3 * (1 - 0.36), 2e-3, -1e-3 * 0.48]], atol=1e-16
    )


def test_lifting_releases_and_touching_again_restarts():
    """Between −enter and +exit nothing changes; beyond, the displacement is forgotten."""
    skin, shift = Skin([0, 0, 0]), [2e-4, 0.0, 0]
    assert not skin.step((-0.5e-5, *HERE)).any() and skin.memory["object"][0] == 0  # not deep enough
    skin.step((-2e-5, *HERE))
    assert skin.memory["object"][0] == 1
    np.testing.assert_allclose(skin.step((0.9e-4, shift, [0.0, 0, 0]))[0], shift, atol=1e-16)  # still held
    assert not skin.step((1.1e-4, shift, [0.0, 0, 0])).any() and skin.memory["object"][0] == 0
    assert not any(skin.memory[name].any() for name in PLANES)
    skin.step((-2e-5, shift, [0.0, 0, 0]))
    np.testing.assert_allclose(skin.step((-2e-5, [5e-4, 0, 0], [0.0, 0, 0]))[0], [3e-4, 0, 0], atol=1e-16)
    assert not skin.step((np.inf, [5e-4, 0, 0], [0.0, 0, 0])).any() and skin.memory["object"][0] == 0  # the gate closed


def test_a_standoff_raises_both_thresholds():
    skin = Skin([0, 0, 0], stick_slip=StickSlip(2e-3, 1e-5, 1e-4, None))
    skin.step((2e-3 - 0.5e-5, *HERE))
    assert skin.memory["object"][0] == 0
    skin.step((2e-3 - 2e-5, *HERE))
    assert skin.memory["object"][0] == 1
    skin.step((2e-3 + 0.9e-4, *HERE))
    assert skin.memory["object"][0] == 1
    skin.step((2e-3 + 1.1e-4, *HERE))
    assert skin.memory["object"][0] == 0


def test_one_object_holds_at_a_time():
    """The deepest at first touch holds, or the first among equals (to 1e-7 m); another takes over only after its release."""
    skin = Skin([0, 0, 0])
    near, far = (-1e-3, *HERE), (-2e-3, *HERE)
    skin.step(near, far)
    assert skin.memory["object"][0] == 2
    skin.step((-5e-3, *HERE), near)
    assert skin.memory["object"][0] == 2
    displacement = skin.step((-5e-3, [7e-4, 0, 0], [0.0, 0, 0]), (-1e-3, [0, 1e-4, 0], [0.0, 0, 0]))
    np.testing.assert_allclose(displacement[0], [0, 1e-4, 0], atol=1e-16)
    skin.step((-5e-3, [7e-4, 0, 0], [0.0, 0, 0]), (1.0, [0, 1e-4, 0], [0.0, 0, 0]))
    assert skin.memory["object"][0] == 1
    np.testing.assert_allclose(skin.step((-5e-3, [9e-4, 0, 0], [0.0, 0, 0]), (1.0, *HERE))[0], [2e-4, 0, 0], atol=1e-16)
    equal = Skin([0, 0, 0])
    equal.step((-1e-3, *HERE), (-1e-3 - 0.5e-7, *HERE))
    assert equal.memory["object"][0] == 1


@pytest.mark.parametrize("way", [[3e-3, 4e-3, 0], [-1e-3, 0.0, 0]])
def test_the_cap_holds_exactly_and_the_anchor_is_dragged(way):
    """Beyond μ' h the displacement keeps its direction; moving back unloads at once, like a slider."""
    slip, depth, turn = 0.5, 1e-3, [0.2, -0.1, 0.5]
    skin, way = Skin([1e-3, 0, 0], stick_slip=STICK_SLIP._replace(slip=slip)), np.array(way)
    skin.step((-depth, np.zeros(3), turn))
    displacement = skin.step((-depth, way, turn))[0]
    np.testing.assert_allclose(displacement, slip * depth * way / np.linalg.norm(way), rtol=1e-12, atol=1e-18)
    back = -0.1 * displacement
    np.testing.assert_allclose(skin.step((-depth, way + back, turn))[0], 0.9 * displacement, rtol=1e-12, atol=1e-17)
    held = skin.step((-depth / 2, way + back, turn))[0]  # with half the depth half is held
    assert np.linalg.norm(held) == pytest.approx(slip * depth / 2, rel=1e-12)
    assert not skin.step((0.5e-4, way + back, turn)).any()  # out of contact, not yet let go: nothing is held
    assert skin.memory["object"][0] == 1


def test_below_the_cap_nothing_slides():
    skin = Skin([0, 0, 0], stick_slip=STICK_SLIP._replace(slip=0.5))
    skin.step((-1e-3, *HERE))
    anchor = [skin.memory[name].copy() for name in PLANES]
    skin.step((-1e-3, [4.9e-4, 0, 0], [0.0, 0, 0]))
    np.testing.assert_array_equal([skin.memory[name] for name in PLANES], anchor)


def test_a_skin_of_springs_differs_most_from_mindlins_at_seven_sixteenths():
    fine = np.linspace(0, 1, 4001)
    difference = friction.loading(fine) - friction.mindlin(fine)
    assert difference.max() == pytest.approx(27 / 256, abs=1e-6)
    assert fine[difference.argmax()] == pytest.approx(7 / 16, abs=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_at_every_corner(dtype):
    """No contact; just released; no displacement at zero depth; displacement at zero depth; at the cap."""
    num = 5
    depth = torch.tensor([[0.0, 0.0, 0.0, 0.0, 1e-3]], dtype=dtype, requires_grad=True)
    phi = torch.tensor([[1.0, 2e-4, 0.5e-4, 0.5e-4, -1e-3]], dtype=dtype, requires_grad=True)
    along = torch.tensor([[0.0, 0.0, 0.0, 1e-3, 5e-4]], dtype=dtype, requires_grad=True)
    zero, one = torch.zeros(1, num, dtype=dtype), torch.ones(1, num, dtype=dtype)
    frame = Frame((one, zero, zero, zero, one, zero, zero, zero, one), (-along, zero, zero))
    state = dict.fromkeys(PLANES[:3], zero) | {"object": torch.tensor([[0.0, 1, 1, 1, 1]], dtype=dtype)}
    flat = (zero[0], zero[0], zero[0])
    penetration = Penetration(flat, depth, None, None, None, {"o": Distance(phi, (zero, zero, zero))}, {"o": frame})
    slip = torch.tensor(0.5, dtype=dtype, requires_grad=True)
    displacement, after = advance(penetration, flat, (zero[0], zero[0], one[0]), STICK_SLIP._replace(slip=slip), state)
    total = sum(part.sum() for part in (*displacement, *after.values()))
    for gradient in torch.autograd.grad(total, [depth, phi, along, slip], allow_unused=True):
        assert gradient is None or torch.isfinite(gradient).all()


def test_nan_is_returned_and_not_remembered():
    """A broken pose reads NaN at held taxels, takes no anchor, and leaves the old ones."""
    skin = Skin(np.zeros((2, 3)))
    skin.step((np.array([-1e-3, 1.0]), *HERE))
    previous = {name: torch.from_numpy(value.copy())[None] for name, value in skin.memory.items()}
    nan = np.full((2, 1, 3, 3), np.nan)
    penetration = Skin.felt(skin.pos, nan[:, :, 0, 0], nan, nan[:, :, 0], nan[:, 0, 0, 0])
    stick_slip = STICK_SLIP._replace(slip=0.5)
    displacement, after = advance(penetration, Skin.planes(skin.pos), Skin.planes(np.array(skin.normal)), stick_slip, previous)
    assert displacement[0][0, 0].isnan()
    for name in PLANES:
        torch.testing.assert_close(after[name], previous[name], rtol=0, atol=0)
