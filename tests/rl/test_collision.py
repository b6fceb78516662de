"""`physics: {collision: primitive}` and the solver's options of a task's document reach the simulation."""

from pathlib import Path

import mujoco
import pytest
import torch

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task

TASKS = Path(__file__).parents[2] / "examples" / "tasks"
TASK = TASKS / "in_palm_rotate.yaml"
GIVEN = {"physics.collision": "primitive", "physics.ls_tolerance": 0.05, "physics.iterations": 20, "physics.tolerance": 1e-6}


@pytest.mark.slow
@pytest.mark.parametrize(("task", "palm"), [(TASK.name, "right_hand_link"), ("in_hand_repose_sharpa.yaml", "right_hand_C_MC")])
def test_colliders_and_options_reach_the_simulation(task, palm):
    env = TouchEnv(TASKS / task, 2, overrides=GIVEN | {"touch": "none"}, threads=1)
    model = env.sim.model
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert is_mesh.any() and not model.geom_contype[is_mesh].any() and not model.geom_conaffinity[is_mesh].any()
    assert (model.opt.ls_tolerance, model.opt.iterations, model.opt.tolerance) == (0.05, 20, 1e-6)
    for _ in range(20):
        result = env.step(torch.zeros(2, env.num_actions))
    assert not result.info.faults.any()
    contacts = env.sim.env_model(0).geom(f"tgdsl/{palm}/collider/0").contype[0]
    assert contacts  # the core of the palm
    env.close()


def test_an_unknown_collision_word_is_reported_at_its_place():
    with pytest.raises(SpecError, match=r"physics\.collision"):
        load_task(TASK, {"physics.collision": "capsule"})
