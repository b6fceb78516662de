"""A run that starts from a policy: `tgdsl train --init`."""

import re
from itertools import pairwise

import pytest
import torch
from small_runs import small_learner

from tgdsl.rl.playing.policy import PolicyError, card_texts, policy_for, read_policy, write_policy
from tgdsl.rl.students.student import Architecture, Encoder, Student, acting, deployed
from tgdsl.rl.train import learner as learners
from tgdsl.rl.train.folder import run_origin
from tgdsl.rl.train.model import Exported

pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]


def written(learner, loaded, folder):
    """Write a learner's policy and read it."""
    card = learner.card(run_origin(loaded, learner.env, 0, {}, 1), 0.0, "a command")
    learner.write_policy(card, folder / "policy.pt")
    return read_policy(folder / "policy.pt")


def actions(learner) -> torch.Tensor:
    """Return a learner's actions without exploration, of its environments' present observations."""
    obs = learner.env.observe()
    x = torch.cat([obs[name] for name in learner.groups["actor"]], dim=1).float()
    with torch.no_grad():
        return Exported(learner.algorithm.actor)(x)


def parameters(network) -> torch.Tensor:
    return torch.cat([part.detach().flatten().clone() for part in network.parameters()])


def test_a_run_starts_with_the_policys_actions_and_deviations(tmp_path):
    teacher, loaded = small_learner(tmp_path)
    for _ in range(2):
        teacher.iterate()
    saved, (learner, _) = written(teacher, loaded, tmp_path), small_learner(tmp_path, seed=1)
    before = parameters(learner.algorithm.critic)
    learner.start_from(saved)
    torch.testing.assert_close(actions(learner), policy_for(learner.env, saved)(learner.env.observe()))
    assert learner.std == pytest.approx(teacher.std)
    assert torch.equal(parameters(learner.algorithm.critic), before)
    for name in ("_mean", "_var", "count"):
        own, theirs = (getattr(each.algorithm.actor.obs_normalizer, name) for each in (learner, teacher))
        assert torch.equal(own, theirs), name


def test_the_critic_learns_first(tmp_path, monkeypatch):
    """A resumed run counts on."""
    monkeypatch.setattr(learners, "CRITIC_FIRST", 2)
    teacher, loaded = small_learner(tmp_path)
    saved, (learner, _) = written(teacher, loaded, tmp_path), small_learner(tmp_path, seed=1)
    learner.start_from(saved)
    begun, critics = parameters(learner.algorithm.actor), [parameters(learner.algorithm.critic)]
    learner.iterate()
    critics.append(parameters(learner.algorithm.critic))
    state, iteration = learner.state_dict(), learner.iteration
    learner, _ = small_learner(tmp_path, seed=1)
    learner.load_state_dict(state)
    learner.iteration = iteration
    learner.iterate()
    critics.append(parameters(learner.algorithm.critic))
    assert torch.equal(parameters(learner.algorithm.actor), begun)
    assert all(not torch.equal(one, other) for one, other in pairwise(critics))
    learner.iterate()
    assert not torch.equal(parameters(learner.algorithm.actor), begun)


def student_file(learner, loaded, folder):
    """Write a student that acts at random and read it."""
    sizes = {name: learner.env.groups[name] for name in learner.groups["actor"]}
    encoders = tuple((size, Encoder("mlp", (8,), 4)) for size in sizes.values())
    torch.manual_seed(0)
    student = Student(Architecture(encoders, (8,), learner.env.num_actions))
    student.mean.normal_()
    student.var.uniform_(0.01, 2.0)
    card = learner.card(run_origin(loaded, learner.env, 0, {}, 1), 0.0, "a command") | {"std": None, "samples": 1000}
    write_policy(deployed(acting(student)), card_texts(learner.env.touch, card), folder / "student.pt")
    return read_policy(folder / "student.pt")


def test_a_run_starts_from_a_student(tmp_path):
    learner, loaded = small_learner(tmp_path, train__networks__eps=1e-5, train__networks__clip=10.0)
    saved = student_file(learner, loaded, tmp_path)
    learner.start_from(saved)
    torch.testing.assert_close(actions(learner), policy_for(learner.env, saved)(learner.env.observe()))
    assert int(learner.algorithm.actor.obs_normalizer.count) == 1000


def test_policies_that_do_not_fit_are_refused(tmp_path):
    teacher, loaded = small_learner(tmp_path)
    saved = written(teacher, loaded, tmp_path)
    for overrides, message in (
        ({"train__networks__hidden": "[9]"}, "its network is not that of train.networks: size mismatch for mlp.0.weight"),
        ({"train__networks__hidden": "[8, 8]"}, "its network is not that of train.networks: Missing key(s)"),
        ({"train__actor": "[goal]"}, "not goal; try --set train.actor="),
    ):
        learner, _ = small_learner(tmp_path, **overrides)
        with pytest.raises(PolicyError, match=re.escape(message)):
            learner.start_from(saved)
    learner, loaded = small_learner(tmp_path, train__networks__clip=0.1)
    with pytest.raises(PolicyError, match=r"acts otherwise, by up to .*; a student normalises by train\.networks\.eps=1e-5"):
        learner.start_from(student_file(learner, loaded, tmp_path))
