"""Networks: encoders of groups, normalisation, and export."""

import pytest
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalDiscountedVariationNormalization, EmpiricalNormalization
from tensordict import TensorDict

from tgdsl.rl.train.model import EncodedModel, Gaussian, Normalisation, RewardNormalisation

GROUPS = {"tactile_sensors": 6, "goal": 3, "proprio": 4}
MOMENTS = 1e-4
"""Relative: float32 rounds an offset of 1e5 spreads by up to 0.3 % of a spread, 1e-5 of the variance."""
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


def mlp_output(layers, x):
    """Return the output of a multi-layer perceptron: ELU between linear layers."""
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
    parts = [mlp_output(network, part) for network, part in zip(model.encoders, x.split([6, 3, 4], dim=1), strict=True)]
    assert [part.shape[1] for part in parts] == [2, 5, 5]
    torch.testing.assert_close(model(obs), mlp_output(model.mlp, torch.cat(parts, dim=1)))
    widths = [[layer.out_features for layer in encoder if isinstance(layer, torch.nn.Linear)] for encoder in model.encoders]
    assert widths == [[7, 2], [9, 8, 5], [9, 8, 5]]


def test_without_encoders_the_model_equals_rsl_rls():
    model = model_of(encoders=None)
    torch.manual_seed(0)
    reference = MLPModel(observations(), {"actor": list(GROUPS)}, "actor", 2, [11], obs_normalization=True)
    reference.mlp.load_state_dict(model.mlp.state_dict())
    torch.testing.assert_close(model(observations()), reference(observations()))


def test_an_exported_model_acts_like_the_original(tmp_path):
    """As TorchScript, for any batch, after use: with the mean action and the current normalisation."""
    model, obs = model_of(eps=1e-5, clip=3.0), observations()
    model.update_normalization(observations(100, seed=1))
    model(obs, stochastic_output=True)  # the state it leaves must not be exported
    torch.jit.save(torch.jit.script(model.as_jit()), str(tmp_path / "policy.pt"))
    policy = torch.jit.load(str(tmp_path / "policy.pt"))
    batch = observations(33, seed=2)
    torch.testing.assert_close(policy(torch.cat([batch[name] for name in GROUPS], dim=1)), model.eval()(batch))
    assert isinstance(model.distribution, Gaussian)
    torch.testing.assert_close(model.as_onnx(False)(torch.cat([batch[name] for name in GROUPS], dim=1)), model(batch))


def test_sampling_equals_torch_normal():
    model, obs = model_of(), observations()
    torch.manual_seed(4)
    sample = model(obs, stochastic_output=True)
    torch.manual_seed(4)
    assert torch.equal(sample, torch.normal(model.output_mean, model.output_std))


@pytest.mark.parametrize("until", [None, 40])
def test_normalisation_equals_rsl_rls_and_updates_in_place(until):
    """In float64, with features of 1e-3 to 1e3; it stops after `until` rows."""
    normalisation, other = Normalisation([3], 1e-2, until), EmpiricalNormalization([3], 1e-2, until).double()
    addresses = {name: value.data_ptr() for name, value in normalisation.state_dict().items()}
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        rows = torch.randn((16, 3), generator=generator) * torch.tensor([1e-3, 1.0, 1e3]) + torch.tensor([0.1, 5.0, -1e3])
        normalisation.update(rows)
        other.update(rows.double())
        torch.testing.assert_close(normalisation(rows), other(rows.double()).float(), rtol=1e-5, atol=1e-6)
    for name, value in other.state_dict().items():
        torch.testing.assert_close(normalisation.state_dict()[name], value, rtol=1e-8, atol=1e-12)
    assert {name: value.data_ptr() for name, value in normalisation.state_dict().items()} == addresses
    normalisation.eval()
    normalisation.update(rows + 1.0)
    torch.testing.assert_close(normalisation.state_dict()["_mean"], other.state_dict()["_mean"])


def test_moments_follow_late_changes():
    """Offsets reach 1e5 spreads, and all shift by one spread after 1e9 rows; the reference is in float64."""
    rows, updates = 1_000, 1_000
    normalisation, generator = Normalisation(9, 1e-5), torch.Generator().manual_seed(0)
    x = 1e-2 * torch.randn((rows, 9), generator=generator) + torch.linspace(0.0, 1e3, 9)
    late = x + 1e-2
    normalisation.update(x)
    normalisation.count.fill_(10**9)  # repeating the same rows would change only the count
    for _ in range(updates):
        normalisation.update(late)
    (mean, var), (late_mean, late_var) = (
        (each.mean(dim=0), each.var(dim=0, correction=0)) for each in (x.double(), late.double())
    )
    share = rows * updates / (10**9 + rows * updates)
    var = torch.lerp(var, late_var, share) + share * (1.0 - share) * (late_mean - mean).square()
    mean = torch.lerp(mean, late_mean, share)
    torch.testing.assert_close(normalisation.mean.double(), mean, rtol=0.0, atol=1e-9)
    torch.testing.assert_close(normalisation.std.double(), var.sqrt(), rtol=MOMENTS, atol=0.0)
    assert normalisation(x).dtype == torch.float32


def test_float32_moments_of_older_checkpoints_load():
    normalisation, old = Normalisation(3), EmpiricalNormalization(3)
    rows = 3.0 * observations(40)["goal"] + 1.0
    old.update(rows)
    normalisation.load_state_dict(old.state_dict())
    for name in ("_mean", "_var", "_std"):
        assert torch.equal(normalisation.state_dict()[name], old.state_dict()[name].double())
    torch.testing.assert_close(normalisation(rows), old(rows))


def test_a_small_eps_keeps_small_features_and_clip_bounds_outliers():
    rows = 1e-3 * torch.randn((1000, 1), generator=torch.Generator().manual_seed(0))
    rows[0] = 1.0
    normalised = {}
    for eps in (1e-2, 1e-5):
        normalisation = Normalisation(1, eps, clip=10.0)
        normalisation.update(rows[1:])
        normalised[eps] = normalisation(rows)
    assert normalised[1e-2].abs()[1:].max() < 0.4 and normalised[1e-5][1:].std() > 0.95
    assert float(normalised[1e-5][0]) == 10.0


def test_rewards_are_divided_by_the_deviation_of_their_discounted_sums():
    normalisation, other = RewardNormalisation(8, until=50), EmpiricalDiscountedVariationNormalization([], until=50)
    generator = torch.Generator().manual_seed(0)
    zero = torch.zeros(8)
    torch.testing.assert_close(normalisation(zero), zero)  # no deviation yet
    other(zero)
    for _ in range(8):
        rewards = 5.0 * torch.rand(8, generator=generator)
        torch.testing.assert_close(normalisation(rewards), other(rewards))
    normalisation.eval(), other.eval()
    torch.testing.assert_close(normalisation(rewards), other(rewards))
