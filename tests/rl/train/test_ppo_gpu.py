"""On a GPU: captured PPO equals eager PPO, and the host never waits."""

import pytest
import torch
from drifting_envs import Drifting
from tiny_tasks import tiny_env, write_task

from tgdsl.rl.load import load_task
from tgdsl.rl.train.learner import Learner
from tgdsl.rl.train.model import EncodedModel
from tgdsl.rl.train.ppo import CapturedPPO

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU"),
    pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype"),
]
NUM_ENVS, STEPS = 256, 8
RND = {
    "weight": 1.0,
    "num_outputs": 4,
    "predictor_hidden_dims": [16],
    "target_hidden_dims": [16],
    "state_normalization": True,
    "reward_normalization": True,
}


def algorithm_of(env):
    """Make an algorithm on the GPU."""
    encoders = {"*": {"hidden": [32], "size": 8}}
    model = {"class_name": "tgdsl.rl.train.model:EncodedModel", "hidden_dims": [32], "encoders": encoders}
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian", "init_std": 0.8}
    config = {
        "num_steps_per_env": STEPS,
        "multi_gpu": None,
        "obs_groups": {"actor": ["here", "there"], "critic": ["here", "there", "still"], "rnd_state": ["here"]},
        "actor": model | {"distribution_cfg": gaussian},
        "critic": model,
        "algorithm": {"class_name": "tgdsl.rl.train.ppo:CapturedPPO", "rnd_cfg": dict(RND), "precision": "float32"},
    }
    torch.manual_seed(0)
    return CapturedPPO.construct_algorithm(env.get_observations().to("cuda"), env, config, "cuda")


def parts_of(algorithm):
    return [value for name, value in vars(algorithm).items() if name in ("_chosen", "_judged", "_returned", "_learned")]


def roll(algorithm, env):
    algorithm.train_mode()
    obs = env.get_observations().to("cuda")
    for _ in range(STEPS):
        obs, reward, dones, extras = env.step(algorithm.act(obs).cpu())
        obs = obs.to("cuda")
        extras = {name: value.cuda() for name, value in extras.items()}
        algorithm.process_env_step(obs, reward.cuda(), dones.cuda(), extras)
    return obs


def test_captured_equals_eager():
    """Three updates from the same rollouts."""
    env = Drifting(NUM_ENVS, dtype=torch.float32)
    captured, eager = algorithm_of(env), algorithm_of(env)
    for part in parts_of(eager):
        part._is_captured = False
    for seed in range(3):
        last = roll(captured, env)
        for name in ("actions", "rewards", "dones", "values", "actions_log_prob"):
            getattr(eager.storage, name).copy_(getattr(captured.storage, name))
        eager.storage.observations.copy_(captured.storage.observations)
        eager.storage.distribution_params = tuple(value.clone() for value in captured.storage.distribution_params)
        for algorithm in (captured, eager):
            torch.manual_seed(seed)
            algorithm.compute_returns(last)
            algorithm.update()
        torch.testing.assert_close(captured.storage.returns, eager.storage.returns, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(captured.losses, eager.losses, rtol=1e-3, atol=1e-5)
        assert captured.learning_rate == pytest.approx(eager.learning_rate, rel=1e-6)
        for one, other in zip(captured.actor.parameters(), eager.actor.parameters(), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-3, atol=2e-4)
    assert captured._learned._graph is not None and eager._learned._graph is None
    assert isinstance(captured.actor, EncodedModel)


def test_actions_are_gaussian_and_differ_between_calls():
    env = Drifting(NUM_ENVS, dtype=torch.float32)
    algorithm = algorithm_of(env)
    obs = env.get_observations().to("cuda")
    samples = torch.stack([algorithm.act(obs).clone() for _ in range(200)])
    params = algorithm.transition.distribution_params
    noise = (samples - params[0]) / params[1]
    assert abs(float(noise.mean())) < 0.02 and abs(float(noise.std()) - 1.0) < 0.02
    assert not (samples[5:] == samples[4:-1]).any()


def test_the_host_never_waits(tmp_path):
    document = write_task(tmp_path)
    env = tiny_env(tmp_path, num_envs=NUM_ENVS, device="cuda")
    learner = Learner(env, load_task(document), seed=0)
    for _ in range(3):
        learner.iterate()
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(2):
            learner.roll()
            learner.learn()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    iteration = learner.iterate()
    assert all(torch.isfinite(torch.tensor(list(iteration.metrics.values()))))
    env.close()
