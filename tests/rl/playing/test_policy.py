"""A learned policy in a TorchScript file: it acts like the exported network; mismatched sizes are refused by name."""

import pytest
import torch
from rsl_rl.models import MLPModel, RNNModel
from tensordict import TensorDict

from tgdsl.rl.playing.policy import Policy, PolicyError, actor_groups, is_close, read_policy

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
GROUPS = {"proprio": 6, "goal": 7}


def export(model, file):
    """Write a model as rsl_rl's `export_policy_to_jit` does; return the file."""
    torch.jit.script(model.as_jit().cpu()).save(str(file))
    return file


def network(kind=MLPModel, num_actions=2, num_envs=3, **more):
    torch.manual_seed(0)
    obs = TensorDict({name: torch.randn(num_envs, size) for name, size in GROUPS.items()}, batch_size=[num_envs])
    model = kind(obs, {"actor": list(GROUPS)}, "actor", num_actions, hidden_dims=[8], **more)
    return model.eval(), obs


def test_a_policy_acts_like_the_exported_network(tmp_path):
    """With normalised observations; an exported policy returns the mean of its distribution."""
    model, obs = network(obs_normalization=True, distribution_cfg={"class_name": "GaussianDistribution"})
    model.obs_normalizer._mean.fill_(0.3)
    policy = Policy(read_policy(export(model, tmp_path / "policy.pt")), GROUPS, 3, 2)
    action = policy({**obs, "priv_obj_state": torch.zeros(3, 15)})
    torch.testing.assert_close(action, model(obs).detach())
    assert not action.requires_grad


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_a_policy_does_not_depend_on_torchs_default_dtype(tmp_path, dtype):
    model, obs = network()
    saved = read_policy(export(model, tmp_path / "policy.pt"))
    torch.set_default_dtype(dtype)
    try:
        action = Policy(saved, GROUPS, 3, 2)(dict(obs))
    finally:
        torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(action, model(obs).detach())


def test_plain_values_are_compared_up_to_rounding():
    """All parts must be present; numbers may differ by rounding."""
    one = {"a": [1.0, {"b": 0.7 * 0.01}], "c": "x"}
    assert is_close(one, {"c": "x", "a": (1.0, {"b": 7 * 0.001})})
    for other in (
        {"a": [1.0, {"b": 0.007}], "c": "y"},
        {"a": [1.0, {"b": 0.0071}], "c": "x"},
        {"a": [1.0], "c": "x"},
        {"c": "x"},
    ):
        assert not is_close(one, other) and not is_close(other, one)


def test_half_precision_weights_are_loaded_as_float32(tmp_path):
    """Weights are rounded; the normalisation is not."""
    model, obs = network(obs_normalization=True)
    model.obs_normalizer._mean.fill_(0.3)
    module = torch.jit.load(export(model, tmp_path / "policy.pt"))
    for weight in module.parameters():
        weight.data = weight.data.half()
    torch.jit.save(module, tmp_path / "policy.pt")
    for weight in model.parameters():
        weight.data = weight.data.half().float()
    saved = read_policy(tmp_path / "policy.pt")
    assert {weight.dtype for weight in saved.module("cpu").parameters()} == {torch.float32}
    torch.testing.assert_close(Policy(saved, GROUPS, 3, 2)(dict(obs)), model(obs).detach())


def test_a_recurrent_policy_forgets_at_the_end_of_an_episode(tmp_path):
    model, obs = network(RNNModel, num_envs=1, rnn_type="gru", rnn_hidden_dim=4, rnn_num_layers=1)
    policy = Policy(read_policy(export(model, tmp_path / "policy.pt")), GROUPS, 1, 2)
    obs = dict(obs)
    first, second = policy(obs), policy(obs)
    assert not torch.equal(first, second)
    policy.begin(torch.tensor([False]))
    assert not torch.equal(policy(obs), first)
    policy.begin(torch.tensor([True]))
    assert torch.equal(policy(obs), first)
    with pytest.raises(
        PolicyError, match=r"does not take proprio \(6\) \+ goal \(7\) = 13 numbers of 3 environments: .*hidden"
    ):
        Policy(read_policy(tmp_path / "policy.pt"), GROUPS, 3, 2)


def test_groups_default_to_those_of_a_hand():
    groups = {"priv_proprio": 9, "goal": 7, "proprio": 6}
    assert actor_groups(groups) == ("proprio", "goal")
    assert actor_groups(groups, ("goal", "priv_proprio")) == ("goal", "priv_proprio")
    with pytest.raises(PolicyError, match='there is no group of observations "gaol"; did you mean "goal"'):
        actor_groups(groups, ("gaol",))


def test_mismatched_policies_are_refused(tmp_path):
    model, _ = network()
    file = export(model, tmp_path / "policy.pt")
    cases = {
        (("proprio", "goal"), 3): "this policy returns actions (3, 2), expected (3, 3): joints are others",
        (("goal",), 2): "this policy takes 13 numbers, not goal (7) = 7; name its groups, in its order",
    }
    for (names, num_actions), message in cases.items():
        with pytest.raises(PolicyError) as raised:
            Policy(read_policy(file), {name: GROUPS[name] for name in names}, 3, num_actions)
        assert str(raised.value) == f"{file}: {message}"


def test_modules_that_are_no_policies_are_refused(tmp_path):
    class Two(torch.nn.Module):
        def forward(self, first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
            return first + second

    class Pair(torch.nn.Module):
        def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return obs, obs

    messages = {Two: r"does not take .* = 13 numbers of 3 environments: ", Pair: r"returns a tuple, expected \(3, 2\)"}
    for kind, message in messages.items():
        torch.jit.script(kind()).save(str(tmp_path / "module.pt"))
        with pytest.raises(PolicyError, match=message):
            Policy(read_policy(tmp_path / "module.pt"), GROUPS, 3, 2)


def test_unreadable_files_are_reported(tmp_path):
    with pytest.raises(PolicyError) as raised:
        Policy(read_policy(tmp_path / "none.pt"), GROUPS, 3, 2)
    assert str(raised.value) == f"{tmp_path}/none.pt: cannot read this file: No such file or directory"
    torch.save({"actor_state_dict": {}}, tmp_path / "model_0.pt")  # the runner's checkpoint, not a policy
    for name in ("text.pt", "policy.onnx"):
        (tmp_path / name).write_text("no module")
    contents = {
        "model_0.pt": "a checkpoint, from which learning goes on; the policy of a run is its policy.pt",
        "text.pt": r"no TorchScript file, as rsl_rl's `export_policy_to_jit` writes it$",
        "policy.onnx": "the ONNX form of a policy, expected the policy.pt beside it",
    }
    for name, content in contents.items():
        with pytest.raises(PolicyError, match=rf"{name}: this is {content}"):
            read_policy(tmp_path / name)
    with pytest.raises(PolicyError, match=rf"{tmp_path}/policy\.pt: cannot read this file: No such file"):
        read_policy(tmp_path)


def test_a_runs_folder_has_its_policy(tmp_path):
    torch.jit.script(torch.nn.Linear(13, 2)).save(str(tmp_path / "policy.pt"))
    assert read_policy(tmp_path).content == (tmp_path / "policy.pt").read_bytes()
