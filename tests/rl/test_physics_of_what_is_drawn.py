"""The simulation obeys what an environment draws: pushes, masses, frictions and drives, by closed forms."""

from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_tasks import tiny_env

from tgdsl.geometry.rotations import rotated
from tgdsl.rl.env import TouchEnv

DOCUMENT = Path(__file__).parents[2] / "examples" / "tasks" / "in_palm_rotate.yaml"


def test_a_push_accelerates_a_free_ball_by_force_over_mass(tmp_path):
    """Δv = F Δt/m, with the drawn mass, at the drawn control steps."""
    push = "randomise: {mass: [0, 200 g], push: {x: 0.1 N, interval: [0.1 s, 0.2 s], duration: 50 ms}}\n"
    env = tiny_env(tmp_path, 16, task="tiny_tasks:Coasting", gravity="0 0 0", more=push + "drop_distance: 10\nepisode: 0.6 s\n")
    env.reset(3)
    mass = env.now.mass.clone()
    assert mass.min() < 0.16 and mass.max() > 0.24
    push_steps, ball = torch.zeros(16), env.sim.model.body(env.task.setup.object).id
    for _ in range(20):
        env.step(torch.zeros(16, 2))
        push_steps += env.sim.arrays["xfrc_applied"][:, ball, 0].float() / 0.1
        speed = env.sim.qvel[:, 3]
        torch.testing.assert_close(speed, (0.1 * 0.025 / mass) * push_steps.double(), rtol=1e-9, atol=1e-15)
    assert (push_steps >= 2).all() and (push_steps % 2 == 0).any()


def test_targets_arrive_with_the_drawn_delay(tmp_path):
    env = tiny_env(tmp_path, 32, gravity="0 0 0", more="randomise: {drive: {delay: [0, 3]}}\naction: {scale: 0.2}\n")
    env.reset(5)
    delay = env.actuation.drawn["delay"]
    assert set(delay.flatten().tolist()) == {0.0, 1.0, 2.0, 3.0}
    start = env.actuation.target.clone()
    for i in range(5):
        env.step(torch.ones(32, 2))
        expected = start + 0.2 * (i + 1 - delay).clamp(min=0.0)
        torch.testing.assert_close(env.sim.ctrl[:, :2], expected.clamp(max=0.8), rtol=0, atol=1e-12)


def test_a_stalled_joint_has_the_drawn_strength_and_bias(tmp_path):
    """Far from its target a drive exerts its largest torque; near it, stiffness times the biased error."""
    more = "randomise: {drive: {strength: [0.5, 1], bias: [-0.05, 0.05]}}\naction: {mode: absolute}\n"
    env = tiny_env(tmp_path, 16, gravity="0 0 0", more=more)
    env.reset(2)
    drawn = {name: value.clone() for name, value in env.actuation.drawn.items()}
    env.sim.qpos[:, :2] = -0.8
    env.sim.qvel[:] = 0
    env.actuation.place(torch.ones(16, dtype=torch.bool))
    env.actuation.command(torch.ones(16, 2))
    env.actuation.drive()
    torch.testing.assert_close(env.actuation.torque, 0.3 * drawn["strength"])
    env.actuation.command(torch.full((16, 2), -1.0 + 0.1 / 0.8))
    env.actuation.drive()
    torch.testing.assert_close(env.actuation.torque, 0.1 + drawn["bias"])
    assert drawn["strength"].std() > 0.05 and drawn["bias"].std() > 0.01


@pytest.mark.slow
def test_force_taxels_weigh_the_drawn_mass():
    """At rest, the forces on all taxels together carry the object."""
    overrides = {"touch": "force_taxel", "resolution": "low", "randomise.mass": "[0, 100 g]", "randomise.xy": 0.0}
    overrides |= {"randomise.drive": {}, "randomise.push": {}, "episode": "10 s"}
    env = TouchEnv(DOCUMENT, 8, threads=1, overrides=overrides)
    env.reset(1)
    for _ in range(80):
        env.step(torch.zeros(env.num_envs, env.num_actions))
    force = env.now.readings["load"].double()
    body = [env.sim.model.body(name).id for name in env.touch.taxels["load"]["body"].tolist()]
    quat = torch.from_numpy(np.asarray(env.sim.batch.xquat)[:, body])
    total = rotated(quat, force).sum(dim=1).numpy()
    weight = 9.81 * env.now.mass.numpy()
    assert weight.std() > 0.1
    np.testing.assert_allclose(-total[:, 2], weight, rtol=0.02)
    np.testing.assert_allclose(total[:, :2], 0.0, atol=0.02 * weight.max())
