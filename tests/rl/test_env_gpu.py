"""On a GPU a step is one CUDA graph: it does what the same step does without one, and the host never waits."""

import pytest
import torch
from tiny_tasks import tiny_env

NUM, LAST = 64, (0, 5, 63)
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")]


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
    assert not after.info.faults.any() and all(bool(value.isfinite().all()) for value in after.obs.values())
