"""in_palm_rotate as a task of mjlab: its angle of rotation, and training by mjlab's script."""

import math
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
from ruamel.yaml import YAML

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def env():
    from mjlab.envs import ManagerBasedRlEnv

    from tgdsl.adapters.mjlab_tasks import env_cfg

    cfg = env_cfg()
    cfg.scene.num_envs = 2
    environment = ManagerBasedRlEnv(cfg, device="cpu")
    environment.reset()
    yield environment
    environment.close()


def put(env, angle: float, move: float = 0.0) -> None:
    """Turn the cube of the second environment about the vertical from its start, and move it along x."""
    from tgdsl.adapters.mjlab_tasks import turning

    w, *_, z = turning(env).start[1, 3:].tolist()
    half = 0.5 * angle + math.atan2(z, w)
    pose = turning(env).start.clone()
    pose[1, 3:] = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
    pose[1, 0] += move
    env.sim.data.qpos[:, env.scene["object"].indexing.free_joint_q_adr] = pose


def test_turning_is_the_angle_about_the_vertical(env):
    from tgdsl.adapters.mjlab_tasks import drop, goal, object_distance, spin, success, turning

    env.reset()
    for angle in (0.8, 1.4):
        put(env, angle)
        spin(env)
        torch.testing.assert_close(turning(env).angle, torch.tensor([0.0, angle]), atol=1e-5, rtol=0.0)
        assert float(goal(env)[1, 6]) == pytest.approx(math.pi / 2 - angle, abs=1e-3)
    assert success(env).tolist() == [0.0, 0.0] and float(turning(env).rate[1]) == pytest.approx(0.6 / env.step_dt, abs=1e-3)
    put(env, 1.55, 0.05)
    assert spin(env).tolist()[1] == 4.0
    assert success(env).tolist() == [0.0, 1.0] and turning(env).reached.tolist() == [0.0, 1.0]
    torch.testing.assert_close(object_distance(env), torch.tensor([0.0, 0.03]), atol=1e-6, rtol=0.0)
    assert drop(env).tolist() == [False, False]
    put(env, 1.55, 0.08)
    assert drop(env).tolist() == [False, True]
    env.reset(env_ids=torch.tensor([1]))
    assert turning(env).angle.tolist() == turning(env).reached.tolist() == [0.0, 0.0] and not drop(env).any()


def test_the_sensor_is_that_of_tgdsls_task():
    from tgdsl.adapters.mjlab_tasks import DOCUMENT

    palm = YAML(typ="safe").load(ROOT / "examples" / "tasks" / "palm.yaml")
    assert DOCUMENT["sensors"]["touch"] == palm["sensors"]["touch"]


def test_mjlabs_script_trains_the_task(tmp_path):
    """It finds the task by the entry point in pyproject.toml."""
    value = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]["mjlab.tasks"]["tgdsl"]
    folder = tmp_path / "packages" / "declared-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: declared\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[mjlab.tasks]\ntgdsl = {value}\n")
    path = os.pathsep.join([str(folder.parent), str(ROOT)])
    options = ["--env.scene.num-envs", "2", "--agent.num-steps-per-env", "4", "--agent.max-iterations", "2"]
    command = [sys.executable, "-m", "mjlab.scripts.train", "Tgdsl-In-Palm-Rotate", *options, "--gpu-ids", "None"]
    environment = os.environ | {
        "PYTHONPATH": path,
        "MJLAB_WARP_QUIET": "1",
        "CUDA_VISIBLE_DEVICES": "",
        "WANDB_MODE": "disabled",
    }
    run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=540, check=False)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "[WARN]" not in run.stderr and "Learning iteration 1/2" in run.stdout
    assert list(tmp_path.glob("logs/rsl_rl/tgdsl_in_palm_rotate/*/model_*.pt"))
