"""grip_force with the user's command, and as one environment of several."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tgdsl.errors import LowerError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.tasks.grip_force import GripForce

DOCUMENT = Path(__file__).parents[3] / "examples" / "tasks" / "grip_force.yaml"
PLAIN = {"touch": "none", "randomise.drive": {}, "randomise.push": {}}
"""Ideal drives and no pushes."""


@pytest.mark.slow
def test_the_users_force_is_commanded_throughout():
    """It does not depend on the object's weight; forces outside the document's range are refused."""
    loaded = load_task(DOCUMENT, PLAIN)
    env = TouchEnv(replace(loaded, spec=GripForce.asked_for(loaded.spec, (3.5,))), 8, threads=1)
    for _ in range(2):
        assert (env.task.asked() == 3.5).all() and (env.task.asked() == env.task.command[:, None]).all()
        env.reset()
    env.close()
    with pytest.raises(LowerError, match="a force of 9 N; expected 1 to 8 N"):
        GripForce.asked_for(loaded.spec, (9.0,))


@pytest.mark.slow
def test_an_environments_number_determines_its_object():
    """The fourth of eight environments equals the same one alone: object, command and start."""
    together = TouchEnv(DOCUMENT, 8, threads=1, overrides=PLAIN)
    alone = TouchEnv(DOCUMENT, 1, threads=1, overrides=PLAIN, first_env=3)
    assert alone.task.setup.variant.tolist() == [3]
    assert torch.equal(alone.task.command[0], together.task.command[3])
    assert torch.equal(alone.sim.qpos[0], together.sim.qpos[3])
    model, same, other = (env.sim.env_model(i) for env, i in ((alone, 0), (together, 3), (together, 0)))
    for name in ("geom_size", "geom_type", "geom_contype"):
        np.testing.assert_array_equal(getattr(model, name), getattr(same, name))
    assert (model.geom_size != other.geom_size).any() or (model.geom_contype != other.geom_contype).any()
    alone.close()
    together.close()
