"""On a GPU a step is one CUDA graph: it does what the same step does without one, and the host never waits."""

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
    made = tiny_env(tmp_path, num_envs=NUM, device="cuda", seed=1)
    yield made
    made.close()


def actions(env, num):
    generator = torch.Generator("cuda").manual_seed(0)
    return 2 * torch.rand((num, env.num_envs, env.num_actions), generator=generator, device="cuda") - 1


def test_a_captured_step_waits_for_nothing(env):
    chosen = actions(env, 104)
    for action in chosen[:4]:
        env.step(action)
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        made = [env.step(action) for action in chosen[4:]]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(bool(value.isfinite().all()) for step in made for value in step.obs.values())


@pytest.mark.filterwarnings("ignore:environments had faults")
def test_episodes_end_and_begin_within_a_captured_step(env):
    chosen = actions(env, 6)
    for action in chosen[:4]:
        env.step(action)
    env.reset()
    env.steps[list(LAST)] = env.max_steps - 1
    bad = chosen[4].clone()
    bad[7, 0] = torch.nan
    made = env.step(bad)
    assert made.truncated.nonzero().flatten().tolist() == list(LAST)
    assert made.info.faults.nonzero().flatten().tolist() == [7]
    assert torch.equal(made.info.ended, made.truncated | made.terminated) and bool(made.terminated[7])
    assert torch.equal(env.steps == 0, made.info.ended)
    state, final = made.obs["priv_obj_state"], made.info.final_obs["priv_obj_state"]
    assert torch.equal((state == final).all(dim=1), ~made.info.ended)
    after = env.step(chosen[5])
    torch.testing.assert_close(env.now.object.pos.float(), after.obs["priv_obj_state"][:, :3])  # not that of `reset`
    assert not after.info.faults.any() and all(bool(value.isfinite().all()) for value in after.obs.values())


@pytest.mark.parametrize("noise", ["clean", "noisy"])
def test_a_captured_step_goes_on_from_a_state_that_is_loaded(tmp_path, noise):
    """Counts are those after as many steps, noise is drawn as it was, and memory that the graph writes is still the module's."""
    env = tiny_env(tmp_path, num_envs=NUM, device="cuda", seed=1, more=f"noise: {noise}\ntouch: bool\n")
    chosen = actions(env, 12)
    for action in chosen[:6]:
        env.step(action)
    saved = env.state_dict()
    expected = [env.step(action) for action in chosen[6:]]
    counts = {name: value.clone() for name, value in env.touch.memory.named_buffers() if not value.is_floating_point()}
    env.load_state_dict(saved)
    canary = [torch.zeros(NUM, 4, device="cuda") for _ in range(200)]  # where freed memory would be handed out again
    for action, before in zip(chosen[6:], expected, strict=True):
        made = env.step(action)
        assert torch.equal(made.info.ended, before.info.ended)
        differ = (made.obs["tactile_sensors"] != before.obs["tactile_sensors"]).float().mean()
        assert differ <= 0.02  # physics on a GPU adds up in any order: a bit at its threshold may fall on the other side
        torch.testing.assert_close(made.obs["proprio"], before.obs["proprio"], rtol=1e-3, atol=1e-3)
    after = dict(env.touch.memory.named_buffers())
    assert all(torch.equal(after[name], value) for name, value in counts.items())
    assert not any(value.any() for value in canary)
    env.close()
