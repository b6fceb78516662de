"""CapturedPPO equals rsl_rl's PPO in float64, for all options."""

import contextlib
import copy
import io
import sys

import pytest
import torch
from drifting_envs import Drifting
from rsl_rl.algorithms import PPO

from tgdsl.errors import TgdslError
from tgdsl.rl.train.ppo import CapturedPPO

NUM_ENVS, STEPS = 16, 6
RND = {
    "weight": 3.0,
    "num_outputs": 4,
    "predictor_hidden_dims": [8],
    "target_hidden_dims": [8],
    "state_normalization": True,
    "reward_normalization": True,
}


@pytest.fixture(autouse=True)
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def settings(is_ours, rnd=None, std_range=None, **algorithm):
    network = {"hidden_dims": [16, 8], "activation": "elu", "obs_normalization": True}
    ours = {"class_name": "tgdsl.rl.train.model:EncodedModel", "eps": 1e-2}
    theirs = {"class_name": "MLPModel"}
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian" if is_ours else "GaussianDistribution", "init_std": 0.8}
    gaussian |= {"std_range": std_range} if std_range else {}
    return {
        "num_steps_per_env": STEPS,
        "multi_gpu": None,
        "obs_groups": {"actor": ["here", "there"], "critic": ["here", "there", "still"], "rnd_state": ["here"]},
        "actor": network | (ours if is_ours else theirs) | {"distribution_cfg": gaussian},
        "critic": network | (ours if is_ours else theirs),
        "algorithm": {
            "class_name": "tgdsl.rl.train.ppo:CapturedPPO" if is_ours else "PPO",
            "num_learning_epochs": 3,
            "num_mini_batches": 4,
            "rnd_cfg": copy.deepcopy(rnd),
            **algorithm,
        },
    }


def algorithm_of(is_ours, env, **options):
    """Make an algorithm whose networks are the same for both kinds."""
    config = settings(is_ours, **options)
    kind = CapturedPPO if is_ours else PPO
    torch.manual_seed(0)
    with contextlib.redirect_stdout(io.StringIO()):
        return kind.construct_algorithm(env.get_observations(), env, config, "cpu")


def iterate(algorithm, env, seed, steps=STEPS):
    """Run one iteration; the seed determines both the rollout and the update."""
    algorithm.train_mode()
    obs = env.get_observations()
    torch.manual_seed(2 * seed)
    with torch.inference_mode():
        for _ in range(steps):
            obs, reward, dones, extras = env.step(algorithm.act(obs))
            algorithm.process_env_step(obs, reward, dones, extras)
        algorithm.compute_returns(obs)
    torch.manual_seed(2 * seed + 1)
    return {name: float(value) for name, value in algorithm.update().items()}


def tensors_of(algorithm):
    """Return all learned tensors by name."""
    models = {"actor": algorithm.actor, "critic": algorithm.critic}
    if algorithm.rnd:
        models |= {"predictor": algorithm.rnd.predictor, "state": algorithm.rnd.state_normalizer}
        models |= {"reward": algorithm.rnd.reward_normalizer.emp_norm}
    return {f"{part}/{name}": value for part, model in models.items() for name, value in model.state_dict().items()}


@pytest.mark.parametrize(
    ("options", "rates"),
    [
        pytest.param({"learning_rate": 1e-3, "rnd": RND}, None, id="rnd"),
        pytest.param({"learning_rate": 9e-3, "desired_kl": 0.5}, "rises", id="rate rises to its bound"),
        pytest.param({"learning_rate": 4e-3, "desired_kl": 1e-4}, "falls", id="rate falls"),
        pytest.param({"schedule": "fixed", "use_clipped_value_loss": False, "optimizer": "adamw"}, "stays", id="fixed"),
    ],
)
def test_captured_ppo_equals_rsl_rls(options, rates):
    """Three iterations from the same weights, with the same random numbers and mini-batches."""
    ours, theirs = (algorithm_of(is_ours, Drifting(NUM_ENVS), **options) for is_ours in (True, False))
    envs = [Drifting(NUM_ENVS), Drifting(NUM_ENVS)]
    first_rate = theirs.learning_rate
    seen_rates = [first_rate]
    for seed in range(3):
        losses, expected = iterate(ours, envs[0], seed), iterate(theirs, envs[1], seed)
        assert losses == pytest.approx(expected, rel=1e-9, abs=1e-12)
        assert ours.learning_rate == pytest.approx(theirs.learning_rate, rel=1e-14)
        seen_rates.append(theirs.learning_rate)
        torch.testing.assert_close(ours.storage.returns, theirs.storage.returns, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(ours.storage.advantages, theirs.storage.advantages, rtol=1e-9, atol=1e-11)
    our_tensors, their_tensors = tensors_of(ours), tensors_of(theirs)
    assert our_tensors.keys() == their_tensors.keys()
    for name, value in their_tensors.items():
        torch.testing.assert_close(
            our_tensors[name], value, rtol=1e-8, atol=1e-11, msg=lambda text, name=name: f"{name}: {text}"
        )
    is_as_expected = {
        "rises": max(seen_rates) == 1e-2,
        "falls": min(seen_rates) < first_rate / 2,
        "stays": set(seen_rates) == {first_rate},
        None: True,
    }
    assert is_as_expected[rates], seen_rates


def test_exploration_stays_in_bounds_and_can_leave_the_bound():
    """The policy is rewarded for less exploration; at the bound, distant actions still raise it."""
    env = Drifting(NUM_ENVS)
    free, bound = (algorithm_of(True, env, std_range=r, entropy_coef=-0.1) for r in ((1e-6, 1e6), (0.75, 1e6)))
    for algorithm in (free, bound):
        for seed in range(6):
            iterate(algorithm, env, seed)
    assert free.actor.distribution.std_param.max() < 0.75
    distribution = bound.actor.distribution
    assert (distribution.std_param == 0.75).all() and (bound.actor.output_std == 0.75).all()
    distribution.update(torch.zeros(1, env.num_actions))
    distribution.log_prob(torch.full((1, env.num_actions), 3.0)).sum().backward()
    assert (distribution.std_param.grad > 0).all()


def test_unsupported_options_are_refused_by_name():
    with pytest.raises(TgdslError, match="CapturedPPO does without use_mixed_precision: take rsl_rl's own PPO"):
        algorithm_of(True, Drifting(NUM_ENVS), use_mixed_precision=True)
    with pytest.raises(TgdslError, match="does without optimizer sgd"):
        algorithm_of(True, Drifting(NUM_ENVS), optimizer="sgd")


@pytest.mark.parametrize(("num_envs", "parts", "least"), [(1, 32, 32), (1, 1, 2)])
def test_a_rollout_with_fewer_rows_than_mini_batches_is_refused(monkeypatch, num_envs, parts, least):
    monkeypatch.setattr(sys.modules[__name__], "STEPS", 1)
    with pytest.raises(TgdslError, match=f"are 1 rows of a rollout, expected at least {least}: train.mini_batches is {parts}"):
        algorithm_of(True, Drifting(num_envs), num_mini_batches=parts)


def test_a_saved_algorithm_resumes_exactly(tmp_path):
    """On environments in the same state, the next iteration is equal after loading."""
    env = Drifting(NUM_ENVS)
    first = algorithm_of(True, env, rnd=RND)
    iterate(first, env, 0)
    torch.save(first.save(), tmp_path / "saved.pt")
    other = algorithm_of(True, env, rnd=RND, learning_rate=5e-3)
    with torch.no_grad():
        for parameter in other.actor.parameters():
            parameter += 1.0
    other.load(torch.load(tmp_path / "saved.pt", weights_only=True), None, True)
    other.rnd.reward_normalizer.total.copy_(first.rnd.reward_normalizer.total)
    env_copy = copy.deepcopy(env)
    assert iterate(first, env, 1) == iterate(other, env_copy, 1)
    assert first.learning_rate == other.learning_rate
    for name, value in tensors_of(first).items():
        assert torch.equal(tensors_of(other)[name], value), name
