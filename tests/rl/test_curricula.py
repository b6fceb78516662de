"""Curricula: weights and parameters of terms that follow the progress of learning, also in compiled steps."""

from pathlib import Path

import numpy as np
import pytest
import torch
from pincer_tasks import write_pincer
from tiny_tasks import tiny_env, write_task

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task, number_owners

EXAMPLES = Path(__file__).parents[2] / "examples" / "tasks"
TASKS = ("in_palm_rotate", "in_hand_repose", "screwdriver", "grip_force", "hot_ball")
QUIET = {"touch": "none"}

EFFORT = "terms: {more: {term: linear, of: rewards.effort, first: 10, last: 30, start: 0, end: -0.5}}\n"
NEAR = """terms:
  close: {term: near, weight: 2, width: 5 cm}
  closer: {term: linear, of: terms.close.width, first: 0, last: 4, start: 0.05, end: 0.01}
"""
OWN = """from tgdsl.fields.models import Number
from tgdsl.rl.terms import CurriculumTerm

class Halves(CurriculumTerm):
    begin: Number

    def value(self, iteration, score):
        return self.begin * 0.5**iteration
"""


def effort(env):
    """Return Σ (τ/τ_max)² of each environment, in float64."""
    return ((env.now.torque.numpy() / env.task.setup.actuators.limit) ** 2).sum(axis=1)


def test_a_weight_is_linear_in_iterations(tmp_path):
    env = tiny_env(tmp_path, more=EFFORT)
    for iteration, weight in ((0, 0.0), (10, 0.0), (15, -0.125), (20, -0.25), (30, -0.5), (99, -0.5)):
        env.curricula.advance(iteration, None)
        result = env.step(torch.full((4, 2), 0.7))
        expected = weight * env.control_step * effort(env)
        assert effort(env).min() > 1e-6
        np.testing.assert_allclose(result.info.terms["effort"], expected, rtol=1e-6, atol=0)


def test_a_weight_follows_a_score_that_should_fall(tmp_path):
    by_score = "by: score, first: 0.5, last: 0.1, start: 1, end: 3"
    env = tiny_env(tmp_path, more=EFFORT.replace("first: 10, last: 30, start: 0, end: -0.5", by_score))
    for score, weight in ((None, 1.0), (0.5, 1.0), (0.2, 1 + 2 * 0.3 / 0.4), (0.1, 3.0), (0.0, 3.0)):
        env.curricula.advance(7, score)
        assert env.curricula.values["rewards.effort"].item() == pytest.approx(weight)


def test_a_parameter_of_a_term_can_follow_a_curriculum(tmp_path):
    env = tiny_env(tmp_path, more=NEAR)
    for iteration, width in ((0, 0.05), (2, 0.03), (4, 0.01)):
        env.curricula.advance(iteration, None)
        result = env.step(torch.full((4, 2), 0.3))
        rate = np.exp(-np.maximum(env.now.distance.numpy(), 0.0) / width).mean(axis=1)
        np.testing.assert_allclose(result.info.terms["close"], 2 * env.control_step * rate, rtol=1e-6)


def document(folder, name):
    """Return the document of a task: of a small hand where there is one, else the example's."""
    if name == "screwdriver":
        return write_pincer(folder)
    return EXAMPLES / f"{name}.yaml" if name in ("grip_force", "hot_ball") else write_task(folder, name)


@pytest.mark.parametrize("name", TASKS)
def test_a_curriculums_number_acts_as_if_set_in_the_document(tmp_path, name):
    """All numbers at nine tenths, at once: rewards, observations and terminations are equal to the bit."""
    file = document(tmp_path, name)
    loaded = load_task(file, QUIET)
    numbers = {
        path: 0.9 * dict(owner)[path.rpartition(".")[2]] for path, owner in number_owners(loaded.task, loaded.spec, {}).items()
    }
    terms = {
        f"c{i}": {"term": "linear", "of": path, "first": 0, "last": 1, "start": value, "end": value}
        for i, (path, value) in enumerate(numbers.items())
    }
    env, other = (TouchEnv(file, 4, threads=1, overrides=QUIET | more) for more in (numbers, {"terms": terms}))
    assert len(other.curricula.values) == len(numbers) >= 13
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        action = 2 * torch.rand((4, env.num_actions), generator=generator) - 1
        one, two = env.step(action), other.step(action)
        assert torch.equal(one.reward, two.reward) and torch.equal(one.terminated, two.terminated)
        for actual, expected in ((one.obs, two.obs), (one.info.terms, two.info.terms)):
            assert all(torch.equal(value, expected[key]) for key, value in actual.items())


def test_one_document_can_have_stages_of_a_number(tmp_path):
    """The pay for progress while the object coasts falls from 1 to 0, without separate runs with `--set`."""
    more = "terms: {stage: {term: linear, of: hold.coasting_pay, first: 10, last: 20, start: 1, end: 0}}\n"
    env, pays = tiny_env(tmp_path, more=more), []
    for iteration in (0, 15, 20):
        env.curricula.advance(iteration, None)
        env.reset(0)
        env.step(torch.zeros(4, 2))
        assert not env.task.holding.is_held(env.now).any()
        pays.append(env.task.memory["pay"].tolist())
    assert pays == [[1.0] * 4, [0.5] * 4, [0.0] * 4]


def test_a_compiled_step_reads_the_number_of_each_iteration(tmp_path):
    """Without a graph break and without recompiling."""
    env = tiny_env(tmp_path, more=EFFORT)
    env.step(torch.full((4, 2), 0.7))
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph

    compiled = torch.compile(env.task.reward, fullgraph=True, backend=backend)
    for iteration, weight in ((0, 0.0), (15, -0.125), (30, -0.5)):
        env.curricula.advance(iteration, None)
        terms = compiled(env.now, torch.zeros(4, dtype=torch.bool))
        np.testing.assert_allclose(terms["effort"], weight * effort(env), rtol=1e-9)
    assert len(graphs) == 1


def test_a_user_defined_curriculum_saves_its_state(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    more = 'terms: {fade: {term: "own.py:Halves", of: rewards.near, begin: 4}}\n'
    env, resumed = tiny_env(tmp_path, more=more), tiny_env(tmp_path, more=more)
    env.curricula.advance(3, None)
    resumed.load_state_dict(env.state_dict())
    assert resumed.curricula.values["rewards.near"].item() == 0.5
    one, two = env.step(torch.zeros(4, 2)), resumed.step(torch.zeros(4, 2))
    assert torch.equal(one.info.terms["near"], two.info.terms["near"])


@pytest.mark.parametrize(
    ("change", "path", "says"),
    [
        (
            ("rewards.effort", "rewards.efort"),
            "terms.more.of",
            'there is no number "rewards.efort" that can change; did you mean',
        ),
        (("rewards.effort", "terms.more.end"), "terms.more.of", 'there is no number "terms.more.end" that can change'),
        (("rewards.effort", "episode"), "terms.more.of", 'there is no number "episode" that can change'),
        (("rewards.effort", "max_force"), "terms.more", "max_force would be -0.5: -0.5 is out of range, expected more than 0"),
        (("rewards.effort", "hold.coasting_pay"), "terms.more", "hold.coasting_pay would be -0.5: "),
        (("last: 30", "last: 10"), "terms.more", "first and last are both 10"),
        (("last: 30", "last: 5"), "terms.more", "last, iteration 5, is before first, 10"),
    ],
)
def test_errors_in_a_curriculum_are_reported_at_their_place(tmp_path, change, path, says):
    with pytest.raises(SpecError) as caught:
        load_task(write_task(tmp_path, more=EFFORT.replace(*change)))
    problem = caught.value.problems[0]
    assert problem.path == path and says in f"{problem.what}; {problem.hint}"
