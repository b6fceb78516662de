"""Random states are valid: a solver could have returned them, for any seed."""

import pytest
import torch

import tgdsl

SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01"/></body>
  <body name="tip" pos=".1 0 0"><geom type="sphere" size=".01"/></body>
  <body name="item" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""
FRICTION = 0.5
SLOTS = 5


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example")
    (folder / "scene.xml").write_text(SCENE)
    point = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.003}]}
    return tgdsl.compile({
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"pad": point, "tip": point}}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {"touch": {"kind": "force_taxel", "links": "*", "feels": ["item"], "slots": SLOTS}},
    })  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1])
def test_contacts_could_come_from_a_solver(touch, seed):
    """Unit normals, forces in their friction cone, and the net force as their sum; unused slots are zero."""
    state = touch.example_state(50, seed=seed)
    normal, force = state.contact_normal, state.contact_force
    is_used = torch.arange(SLOTS) % 3 != 2
    assert normal.shape == force.shape == (50, 2, SLOTS, 3)
    torch.testing.assert_close(normal.norm(dim=-1), is_used.double().expand(50, 2, SLOTS), rtol=0, atol=1e-12)
    along = (force * normal).sum(dim=-1)
    assert (along[..., is_used] > 0).all()
    assert ((force - along[..., None] * normal).norm(dim=-1) <= FRICTION * along + 1e-12).all()
    torch.testing.assert_close(state.contact_netforce, force.sum(dim=2), rtol=0, atol=1e-12)
    for value in (force, state.contact_pos, state.contact_torque):
        assert not value[:, :, ~is_used].any()
    torch.testing.assert_close(torch.cross(state.contact_torque, normal, dim=-1), torch.zeros_like(force), rtol=0, atol=1e-15)


def test_bodies_and_contacts_have_the_requested_spread(touch):
    """Standard deviations of 3,000 numbers, to 5 %."""
    state = touch.example_state(500, spread=0.2)
    torch.testing.assert_close(state.body_quat.norm(dim=-1), torch.ones(500, len(touch.inputs.bodies)).double())
    links = state.body_pos[:, [touch.inputs.bodies.index(pair.link) for pair in touch.inputs.pairs], None]
    for offsets in (state.body_pos, (state.contact_pos - links)[:, :, :2]):
        assert float(offsets.std()) == pytest.approx(0.2, rel=0.05)
