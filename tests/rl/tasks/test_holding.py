"""Pay for progress while an object is held, and while it coasts."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from task_references import pay as paid
from tiny_tasks import tiny_env

from tgdsl.rl import terms
from tgdsl.rl.tasks.parts import Holding, HoldSpec, are_fingers

HAND = """<mujoco><worldbody>
  <body name="arm"><joint name="lift" type="slide" axis="0 0 1"/><geom size=".01" mass="1"/>
    <body name="palm"><geom size=".01" mass="1"/>
      <body name="near"><joint name="bend" axis="0 1 0"/><geom size=".01" mass="1"/>
        <body name="far"><geom size=".01" mass="1"/></body></body>
      <body name="jaw"><joint name="close" type="slide" axis="1 0 0"/><geom size=".01" mass="1"/></body>
    </body></body>
  <body name="ball"><freejoint/><geom size=".01" mass="1"/></body>
</worldbody></mujoco>"""
LINKS = ("palm", "near", "far", "jaw")
FORCES = [
    ((0.0, 0.0, 0.0, 0.0), False),
    ((9.0, 0.0, 0.0, 0.0), False),  # only the palm
    ((0.0, 9.0, 0.0, 0.0), False),  # only one finger
    ((0.05, 0.05, 0.0, 0.0), True),  # the palm and a finger, just above the load
    ((0.04, 0.05, 0.0, 0.0), False),
    ((0.0, 0.0, 1.0, 1.0), True),  # two fingers
]


def test_links_that_move_relative_to_the_palm_are_fingers():
    """The palm and links fixed to it are not, though a slide moves the hand; without a palm, a hinged link counts."""
    model = mujoco.MjModel.from_xml_string(HAND)
    assert are_fingers(model, LINKS).tolist() == [False, True, True, True]
    assert are_fingers(model, ("near",)).tolist() == [True]
    assert are_fingers(model, ()).tolist() == []


def instant(forces):
    """Return an instant with forces along a slanted axis, whose sizes are given per link."""
    force = torch.tensor(forces, dtype=torch.float64)[:, :, None] * torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    return SimpleNamespace(link_force=force, joint_pos=torch.zeros(len(forces), 1, dtype=torch.float64))


def test_two_fingers_or_a_finger_and_the_palm_hold():
    setup = SimpleNamespace(model=mujoco.MjModel.from_xml_string(HAND), links=LINKS, device="cpu")
    spec = HoldSpec(coasting_pay=0.3, load=0.0499)
    now = instant([forces for forces, _ in FORCES])
    expected = [1.0 if is_held else 0.3 for _, is_held in FORCES]
    holding = Holding(spec, setup)
    assert holding.is_held(now).tolist() == [is_held for _, is_held in FORCES]
    assert holding.pay(now).tolist() == pytest.approx(expected, abs=1e-15)
    fingers = np.array([False, True, True, True])
    assert [paid(spec, force.numpy(), fingers) for force in now.link_force] == expected
    assert Holding(HoldSpec(links=1), setup).is_held(now).tolist() == [False, False, True, True, True, True]


def test_torques_and_speeds_cost():
    """|τ/τ_max| of 1/2, 1 and none: 1.25. Speeds of 0.4 m/s (0.2 free) and 3 rad/s (2 free): 1 + 0.5; slower is free."""
    now = SimpleNamespace(
        torque=torch.tensor([[0.5, -0.4, 3.0]]),
        object=SimpleNamespace(
            linvel=torch.tensor([[0.0, 0.4, 0.0], [0.1, 0, 0]]), angvel=torch.tensor([[0, 0, 3.0], [1, 0, 0]])
        ),
    )
    setup = SimpleNamespace(max_torque=torch.tensor([1.0, 0.4, torch.inf]))
    assert terms.Effort(weight=1).rate(now, setup).tolist() == pytest.approx([1.25])
    assert terms.ObjectSpeed(weight=1, free_speed=0.2, free_spin=2.0).rate(now, setup).tolist() == pytest.approx([1.5, 0.0])


def test_a_coasting_object_earns_a_share(tmp_path):
    """The test turns a ball that nothing touches: turning forward pays the share c, turning back costs in full."""
    sums = {}
    for pay in (1.0, 0.25):
        (tmp_path / str(pay)).mkdir()
        more = f"hold: {{coasting_pay: {pay}}}\nrewards: {{near: 0, work: 0}}\nepisode: 10 s\n"
        env = tiny_env(tmp_path / str(pay), 2, gravity="0 0 0", more=more)
        env.reset()
        earned = []
        for i in range(1, 30):
            half = torch.tensor([0.03 * i, -0.03 * i], dtype=torch.float64)
            env.sim.qpos[:, 5] = 0.2  # above the plates
            env.task.start_pos[:, 2] = 0.2
            env.sim.qpos[:, 6:10] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
            env.sim.qvel[:] = 0
            earned.append(env.step(torch.zeros(2, 2)).info.terms)
        sums[pay] = {name: sum(term[name] for term in earned) for name in ("success", "spin")}
        env.close()
    assert sums[1.0]["success"][0] == pytest.approx(150 * 0.025)
    assert sums[0.25]["success"].tolist() == pytest.approx([0.25 * 150 * 0.025, 0.0], rel=1e-6)
    assert sums[0.25]["spin"].tolist() == pytest.approx([0.25 * sums[1.0]["spin"][0].item(), sums[1.0]["spin"][1].item()])
