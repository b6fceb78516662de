"""On a GPU a step is one CUDA graph: it equals the uncaptured step, and the host never waits."""

import pytest
import torch
from tiny_tasks import tiny_env

NUM, LAST = 64, (0, 5, 63)
pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU"),
    pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype"),
]


@pytest.fixture
def env(tmp_path):
    environment = tiny_env(tmp_path, num_envs=NUM, device="cuda", seed=1)
    yield environment
    environment.close()


def actions(env, num):
    generator = torch.Generator("cuda").manual_seed(0)
    return 2 * torch.rand((num, env.num_envs, env.num_actions), generator=generator, device="cuda") - 1


def test_a_captured_step_never_waits(env):
    all_actions = actions(env, 104)
    for action in all_actions[:4]:
        env.step(action)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        results = [env.step(action) for action in all_actions[4:]]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(bool(value.isfinite().all()) for step in results for value in step.obs.values())


@pytest.mark.filterwarnings("ignore:environments had faults")
def test_episodes_end_and_begin_within_a_captured_step(env):
    all_actions = actions(env, 6)
    for action in all_actions[:4]:
        env.step(action)
    env.reset()
    env.steps[list(LAST)] = env.max_steps - 1
    faulty_action = all_actions[4].clone()
    faulty_action[7, 0] = torch.nan
    result = env.step(faulty_action)
    assert result.truncated.nonzero().flatten().tolist() == list(LAST)
    assert result.info.faults.nonzero().flatten().tolist() == [7]
    assert torch.equal(result.info.ended, result.truncated | result.terminated) and bool(result.terminated[7])
    assert torch.equal(env.steps == 0, result.info.ended)
    state, final = result.obs["priv_obj_state"], result.info.final_obs["priv_obj_state"]
    assert torch.equal((state == final).all(dim=1), ~result.info.ended)
    after = env.step(all_actions[5])
    torch.testing.assert_close(env.now.object.pos.float(), after.obs["priv_obj_state"][:, :3])  # not the state after `reset`
    assert not after.info.faults.any() and all(bool(value.isfinite().all()) for value in after.obs.values())


@pytest.mark.parametrize("noise", ["clean", "noisy"])
def test_a_captured_step_resumes_from_a_loaded_state(tmp_path, noise):
    """Counters and noise continue as before, and the graph still writes the module's memory."""
    env = tiny_env(tmp_path, num_envs=NUM, device="cuda", seed=1, more=f"noise: {noise}\ntouch: bool\n")
    all_actions = actions(env, 12)
    for action in all_actions[:6]:
        env.step(action)
    saved = env.state_dict()
    expected = [env.step(action) for action in all_actions[6:]]
    counts = {name: value.clone() for name, value in env.touch.memory.named_buffers() if not value.is_floating_point()}
    env.load_state_dict(saved)
    canary = [torch.zeros(NUM, 4, device="cuda") for _ in range(200)]  # would reuse freed memory
    for action, expected_result in zip(all_actions[6:], expected, strict=True):
        result = env.step(action)
        assert torch.equal(result.info.ended, expected_result.info.ended)
        differ = (result.obs["tactile_sensors"] != expected_result.obs["tactile_sensors"]).float().mean()
        assert differ <= 0.02  # sums on a GPU have no fixed order: a reading at the threshold may flip its bit
        torch.testing.assert_close(result.obs["proprio"], expected_result.obs["proprio"], rtol=1e-3, atol=1e-3)
    after = dict(env.touch.memory.named_buffers())
    assert all(torch.equal(after[name], value) for name, value in counts.items())
    assert not any(value.any() for value in canary)
    env.close()
