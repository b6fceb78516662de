"""Networks: what each group goes through, how it is normalised, and what is exported."""

import pytest
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalDiscountedVariationNormalization, EmpiricalNormalization
from tensordict import TensorDict

from tgdsl.rl.train.model import EncodedModel, Gaussian, Normalisation, RewardNormalisation

GROUPS = {"tactile_sensors": 6, "goal": 3, "proprio": 4}
MOMENTS = 1e-4
"""Relative; an offset of 1e5 spreads is rounded in float32 by up to 0.3 % of one, which is 1e-5 of the variance."""
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


def observations(num=5, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict({name: torch.randn((num, size), generator=generator) for name, size in GROUPS.items()}, [num])


def model_of(**options):
    torch.manual_seed(0)
    encoders = {"tactile_sensors": {"hidden": [7], "size": 2}, "*": {"hidden": [9, 8], "size": 5}}
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian", "init_std": 0.5}
    options = {"hidden_dims": [11], "encoders": encoders, "distribution_cfg": gaussian, **options}
    return EncodedModel(observations(), {"actor": list(GROUPS)}, "actor", 2, **options)


def by_hand(layers, x):
    """Return what a multi-layer perceptron returns: ELU between linear layers."""
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    for i, layer in enumerate(linear):
        x = x @ layer.weight.T + layer.bias
        x = x if i == len(linear) - 1 else torch.where(x > 0, x, x.exp() - 1)
    return x


def test_each_group_has_its_own_network():
    model, obs = model_of(), observations()
    model.obs_normalizer._mean.copy_(torch.arange(13.0))
    model.obs_normalizer._std.fill_(2.0)
    x = (torch.cat([obs[name] for name in GROUPS], dim=1) - torch.arange(13.0)) / (2.0 + 1e-2)
    parts = [by_hand(encoder, part) for encoder, part in zip(model.encoders, x.split([6, 3, 4], dim=1), strict=True)]
    assert [part.shape[1] for part in parts] == [2, 5, 5]
    torch.testing.assert_close(model(obs), by_hand(model.mlp, torch.cat(parts, dim=1)))
    widths = [[layer.out_features for layer in own if isinstance(layer, torch.nn.Linear)] for own in model.encoders]
    assert widths == [[7, 2], [9, 8, 5], [9, 8, 5]]


def test_without_encoders_it_is_rsl_rl_s_own():
    model = model_of(encoders=None)
    torch.manual_seed(0)
    own = MLPModel(observations(), {"actor": list(GROUPS)}, "actor", 2, [11], obs_normalization=True)
    own.mlp.load_state_dict(model.mlp.state_dict())
    torch.testing.assert_close(model(observations()), own(observations()))


def test_what_is_exported_acts_like_it(tmp_path):
    """As TorchScript, in any batch, after it was used: with the mean, and the normalisation of what was seen."""
    model, obs = model_of(eps=1e-5, clip=3.0), observations()
    model.update_normalization(observations(100, seed=1))
    model(obs, stochastic_output=True)  # what is left of it is no part of what is exported
    torch.jit.save(torch.jit.script(model.as_jit()), str(tmp_path / "policy.pt"))
    policy = torch.jit.load(str(tmp_path / "policy.pt"))
    many = observations(33, seed=2)
    torch.testing.assert_close(policy(torch.cat([many[name] for name in GROUPS], dim=1)), model.eval()(many))
    assert isinstance(model.distribution, Gaussian)
    torch.testing.assert_close(model.as_onnx(False)(torch.cat([many[name] for name in GROUPS], dim=1)), model(many))


def test_drawn_numbers_are_those_of_torch():
    model, obs = model_of(), observations()
    torch.manual_seed(4)
    drawn = model(obs, stochastic_output=True)
    torch.manual_seed(4)
    assert torch.equal(drawn, torch.normal(model.output_mean, model.output_std))


@pytest.mark.parametrize("until", [None, 40])
def test_normalisation_is_rsl_rl_s_own_in_place(until):
    """In float64, of metres and of thousands; and, after `until` rows, of no more."""
    own, other = Normalisation([3], 1e-2, until), EmpiricalNormalization([3], 1e-2, until).double()
    places = {name: value.data_ptr() for name, value in own.state_dict().items()}
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        rows = torch.randn((16, 3), generator=generator) * torch.tensor([1e-3, 1.0, 1e3]) + torch.tensor([0.1, 5.0, -1e3])
        own.update(rows)
        other.update(rows.double())
        torch.testing.assert_close(own(rows), other(rows.double()).float(), rtol=1e-5, atol=1e-6)
    for name, value in other.state_dict().items():
        torch.testing.assert_close(own.state_dict()[name], value, rtol=1e-8, atol=1e-12)
    assert {name: value.data_ptr() for name, value in own.state_dict().items()} == places
    own.eval()
    own.update(rows + 1.0)
    torch.testing.assert_close(own.state_dict()["_mean"], other.state_dict()["_mean"])


def test_moments_follow_what_changes_late():
    """Offsets of up to 1e5 spreads, and all moves by a spread after 1e9 rows: by float64 moments of all rows, joined."""
    rows, updates = 1_000, 1_000
    own, generator = Normalisation(9, 1e-5), torch.Generator().manual_seed(0)
    x = 1e-2 * torch.randn((rows, 9), generator=generator) + torch.linspace(0.0, 1e3, 9)
    late = x + 1e-2
    own.update(x)
    own.count.fill_(10**9)  # the same rows again and again change nothing else
    for _ in range(updates):
        own.update(late)
    (mean, var), (late_mean, late_var) = (
        (each.mean(dim=0), each.var(dim=0, correction=0)) for each in (x.double(), late.double())
    )
    share = rows * updates / (10**9 + rows * updates)
    var = torch.lerp(var, late_var, share) + share * (1.0 - share) * (late_mean - mean).square()
    mean = torch.lerp(mean, late_mean, share)
    torch.testing.assert_close(own.mean.double(), mean, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(own.std.double(), var.sqrt(), rtol=MOMENTS, atol=0.0)
    assert own(x).dtype == torch.float32


def test_moments_of_older_checkpoints_are_float32():
    own, old = Normalisation(3), EmpiricalNormalization(3)
    rows = 3.0 * observations(40)["goal"] + 1.0
    old.update(rows)
    own.load_state_dict(old.state_dict())
    for name in ("_mean", "_var", "_std"):
        assert torch.equal(own.state_dict()[name], old.state_dict()[name].double())
    torch.testing.assert_close(own(rows), old(rows))


def test_a_small_eps_does_not_hide_what_is_in_metres_and_a_bound_keeps_what_is_rare():
    rows = 1e-3 * torch.randn((1000, 1), generator=torch.Generator().manual_seed(0))
    rows[0] = 1.0
    seen = {}
    for eps in (1e-2, 1e-5):
        own = Normalisation(1, eps, clip=10.0)
        own.update(rows[1:])
        seen[eps] = own(rows)
    assert seen[1e-2].abs()[1:].max() < 0.4 and seen[1e-5][1:].std() > 0.95
    assert float(seen[1e-5][0]) == 10.0


def test_rewards_are_divided_by_the_deviation_of_their_discounted_sums():
    own, other = RewardNormalisation(8, until=50), EmpiricalDiscountedVariationNormalization([], until=50)
    generator = torch.Generator().manual_seed(0)
    zero = torch.zeros(8)
    torch.testing.assert_close(own(zero), zero)  # of no deviation yet
    other(zero)
    for _ in range(8):
        rewards = 5.0 * torch.rand(8, generator=generator)
        torch.testing.assert_close(own(rewards), other(rewards))
    own.eval(), other.eval()
    torch.testing.assert_close(own(rewards), other(rewards))
