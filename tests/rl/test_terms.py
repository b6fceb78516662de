"""Terms that a document adds to its task: rewards, terminations, observations, including user-defined ones."""

from pkgutil import resolve_name

import mujoco
import numpy as np
import pytest
import torch
from pydantic import ValidationError
from tiny_tasks import tiny_env, write_task

from tgdsl.errors import SimulationError, SpecError
from tgdsl.rl.load import load_task
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.task import Task
from tgdsl.rl.tasks import TASKS
from tgdsl.rl.tasks.grip_force import GripForce
from tgdsl.rl.tasks.hot_ball import HotBall
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate
from tgdsl.rl.terms import ContactForce, HandTask, Near

OWN = '''
import torch
from tgdsl.fields.models import PositiveLength
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.task import Start, Task
from tgdsl.rl.terms import ObservationTerm, RewardTerm, TerminationTerm

class Height(RewardTerm):
    """Height of the object over `floor` [m]."""
    floor: PositiveLength = 0.01

    def rate(self, now, setup):
        return now.object.pos[:, 2] - self.floor

class Turned(TerminationTerm):
    """A joint is beyond `most`."""
    most: float

    def is_over(self, now, setup):
        return (now.joint_pos > self.most).any(dim=1)

class Squares(ObservationTerm):
    def observe(self, now, setup):
        return now.joint_pos.square()

class Idle(Task):
    Spec = TaskSpec
    score_unit = "none"

    def reset(self, chosen, episode):
        return Start({"qpos": self.setup.qpos.expand(self.setup.num_envs, -1)})

    def advance(self, now):
        pass

    def is_over(self, now):
        return torch.zeros_like(now.friction, dtype=torch.bool)

    def reward(self, now, is_over):
        return {"nothing": torch.zeros_like(now.friction)}

    def observe(self, now):
        return {}

    def score(self):
        return torch.zeros(self.setup.num_envs)

class Wrong(RewardTerm):
    def rate(self, now, setup):
        return now.joint_pos
'''


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    return tmp_path


def test_terms_add_to_reward_termination_and_observations(folder):
    more = """terms:
  height: {term: "own.py:Height", weight: -2, floor: 2 cm}
  hurry: {term: object_speed, weight: -0.5, free_speed: 1 mm/s, free_spin: 0.01}
  turned: {term: "own.py:Turned", most: 0.3}
  squares: {term: "own.py:Squares"}
"""
    env, plain = tiny_env(folder, more=more), tiny_env(folder)
    rng = torch.Generator().manual_seed(1)
    ended = torch.zeros(4, dtype=torch.bool)
    for _ in range(20):
        action = 2 * torch.rand((4, 2), generator=rng) - 1
        action[0] = 1.0  # the first environment's joints go up until the episode ends
        result, other = env.step(action), plain.step(action)
        if (ended | result.info.ended).any():
            ended |= result.terminated
            break
        pos, speed, spin = (env.now.object.pos, env.now.object.linvel.norm(dim=1), env.now.object.angvel.norm(dim=1))
        expected = {
            "height": -2 * (pos[:, 2] - 0.02),
            "hurry": -0.5 * ((speed / 1e-3 - 1).clamp(min=0) + (spin / 0.01 - 1).clamp(min=0)),
        }
        for name, rate in expected.items():
            np.testing.assert_allclose(result.info.terms[name], env.control_step * rate, rtol=1e-5, atol=1e-9)
        extra = sum(result.info.terms[name] for name in expected)
        np.testing.assert_allclose(result.reward - other.reward, extra, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(result.obs["squares"], env.now.joint_pos.square(), rtol=1e-6)
    assert ended[0]


def test_a_saved_environment_resumes_with_its_terms(folder):
    more = 'terms: {height: {term: "own.py:Height", weight: 1}, squares: {term: "own.py:Squares"}}\n'
    env, resumed = tiny_env(folder, more=more), tiny_env(folder, more=more)
    action = torch.full((4, 2), 0.3)
    env.step(action)
    resumed.load_state_dict(env.state_dict())
    one, two = env.step(action), resumed.step(action)
    assert torch.equal(one.reward, two.reward) and torch.equal(
        one.info.episode_terms["height"], two.info.episode_terms["height"]
    )


def test_terms_read_the_last_actions(folder):
    """The latest first, zero before an episode's first step, and saved with the environment."""
    env, resumed = tiny_env(folder), tiny_env(folder)
    actions = 2 * torch.rand((7, 4, 2), generator=torch.Generator().manual_seed(0)) - 1
    exact = actions.double()
    for i in range(5):
        env.step(actions[i])
    expected = exact[[3, 2, 1]].transpose(0, 1)
    torch.testing.assert_close(env.now.past_actions, expected)
    resumed.load_state_dict(env.state_dict())
    resumed.step(actions[5])
    torch.testing.assert_close(resumed.now.past_actions, exact[[4, 3, 2]].transpose(0, 1))
    env.reset()
    env.step(actions[5])
    env.step(actions[6])
    torch.testing.assert_close(env.now.past_actions, torch.stack([exact[5], *torch.zeros(2, 4, 2).double()], dim=1))


def test_observations_compile_to_one_graph(folder):
    """Steps on a GPU are compiled: each graph break would launch its own kernels."""
    env = tiny_env(folder, more="terms: {object: {term: object_state}}\ngoal: [orientation, difference, angle]\n")
    observations = torch.compile(env._observe, fullgraph=True, backend="eager")(env.now)
    torch.testing.assert_close(observations, env._observe(env.now), rtol=0, atol=0)


def test_terms_add_the_sensors_that_they_need(folder):
    env = tiny_env(folder, task="own.py:Idle", more="terms: {near: {weight: 1}}\n")
    assert env.now.distance.shape[1] > 0


@pytest.mark.parametrize(
    ("terms", "line", "path", "says"),
    [
        ("{efort: {weight: 1}}", 8, "terms.efort.term", 'there is no term "efort"; did you mean "effort"?'),
        ("{a: {term: efort, weight: 1}}", 8, "terms.a.term", 'did you mean "effort"?'),
        ("{a: {term: contact_force}}", 8, "terms.a", 'missing key "weight"'),
        ("{a: {term: contact_force, weight: 1, max_forse: 2 N}}", 8, "terms.a.max_forse", 'did you mean "max_force"?'),
        ("{a: {term: contact_force, weight: 1, max_force: 2 mm}}", 8, "terms.a.max_force", "unit of force"),
        ("{near: {weight: 1}}", 8, "terms.near", "set `rewards.near`"),
        ("{a: {term: 'own.py:Hight', weight: 1}}", 8, "terms.a.term", 'did you mean "Height"?'),
        ("{a: {term: 'nowhere.py:A', weight: 1}}", 8, "terms.a.term", "there is no such file"),
        ("{a: {term: 'pathlib:Path'}}", 8, "terms.a.term", "no subclass of tgdsl.rl.terms.Term"),
        ("{proprio: {term: object_state}}", 8, "terms.proprio", "give the term another name"),
        ("{a: 3}", 8, "terms.a", "expected a mapping"),
    ],
)
def test_errors_in_a_term_are_reported_at_their_place(folder, terms, line, path, says):
    with pytest.raises(SpecError) as caught:
        load_task(write_task(folder, more=f"terms: {terms}\n"))
    (problem,) = caught.value.problems
    assert (problem.line, problem.path) == (line, path)
    assert says in f"{problem.what}; {problem.hint}"


def test_values_are_set_by_dotted_path(folder):
    task = write_task(folder, more="terms: {effort_: {term: speed_limit, max_speed: 1 m/s}}\n")
    assert load_task(task, {"terms.effort_.max_speed": "3 cm/s"}).terms["effort_"].max_speed == pytest.approx(0.03)


def test_a_term_of_the_wrong_shape_is_named(folder):
    with pytest.raises(
        SimulationError, match=r'the term "odd" is of shape \(4, 2\) and torch.float64, expected a tensor \(4,\)'
    ):
        tiny_env(folder, more='terms: {odd: {term: "own.py:Wrong", weight: 1}}\n').step(torch.zeros(4, 2))


def test_a_term_cannot_replace_one_of_the_task(folder):
    with pytest.raises(SimulationError, match='has a term "nothing" already'):
        tiny_env(folder, task="own.py:Idle", more="terms: {nothing: {term: work, weight: 1}}\n").step(torch.zeros(4, 2))
    with pytest.raises(SimulationError, match='group "goal"'):
        tiny_env(folder, more="terms: {goal: {term: object_state}}\n")


def test_a_document_can_remove_a_term_of_the_task(folder):
    """Its name becomes free, and the other terms stay the same."""
    env, plain = tiny_env(folder, overrides={"rewards.near": "null"}), tiny_env(folder)
    result, other = env.step(torch.full((4, 2), 0.3)), plain.step(torch.full((4, 2), 0.3))
    assert result.info.terms.keys() == other.info.terms.keys() - {"near"}
    assert torch.allclose(result.reward, other.reward - other.info.terms["near"], rtol=1e-6, atol=1e-7)
    env = tiny_env(folder, more="rewards: {near: null}\nterms: {near: {weight: 2, width: 1 cm}}\n")
    result = env.step(torch.full((4, 2), 0.3))
    rate = np.exp(-np.maximum(env.now.distance.numpy(), 0.0) / 0.01).mean(axis=1)
    np.testing.assert_allclose(result.info.terms["near"], 2 * env.control_step * rate, rtol=1e-6)


def test_a_user_defined_task_lists_its_terms(folder):
    """Its weights are keys of the document, after those of its base task."""
    (folder / "lift.py").write_text(
        "from tgdsl.rl.task import reward_term\n"
        "from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\n\n"
        "class Lift(InPalmRotate):\n"
        "    @reward_term(3.0, '1/(m s)')\n"
        "    def height(self, now):\n"
        '        """Height of the object."""\n'
        "        return now.object.pos[:, 2]\n"
    )
    env = tiny_env(folder, task="lift.py:Lift", overrides={"rewards.height": -2})
    assert list(env.task.terms)[-1] == "height" and len(env.task.terms) == len(InPalmRotate.terms) + 1
    assert env.task.Rewards.model_fields["height"].description == "Height of the object [1/(m s)]."
    result = env.step(torch.zeros(4, 2))
    expected = -2 * env.control_step * env.now.object.pos[:, 2].numpy()
    np.testing.assert_allclose(result.info.terms["height"], expected, rtol=1e-6)


def test_only_the_nearest_probes_count(folder):
    env = tiny_env(folder, more="rewards: {near: null}\nterms: {near: {weight: 2, width: 1 cm, nearest: 3}}\n")
    result = env.step(torch.full((4, 2), 0.3))
    nearest = np.sort(np.maximum(env.now.distance.numpy(), 0.0), axis=1)[:, :3]
    expected = 2 * env.control_step * np.exp(-nearest / 0.01).mean(axis=1)
    np.testing.assert_allclose(result.info.terms["near"], expected, rtol=1e-6)


def test_the_net_force_sums_mujocos_contacts(folder):
    """Both plates and the floor press. With one physics step, forces are those at the start of the control step."""
    more = "randomise: {xy: [20 mm, 20 mm]}\nphysics: {substeps: 1}\naction: {mode: absolute}\n"
    more += "terms: {free: {term: net_force, weight: 1, free: 1 mN, most: 1000 N}, bounded: {term: net_force, weight: 1, free: 1 N, most: 2 N}}\n"
    env, names = tiny_env(folder, 1, more=more), ("qpos", "qvel", "qacc_warmstart", "ctrl")
    model, sizes = env.sim.env_model(0), []
    for _ in range(120):
        state = {name: env.sim.arrays[name][0].clone().numpy() for name in names}
        result = env.step(torch.tensor([[0.0, -1.0]]))
        state["ctrl"] = env.sim.arrays["ctrl"][0].numpy()
        data = mujoco.MjData(model)
        for name, value in state.items():
            getattr(data, name)[:] = value
        mujoco.mj_forward(model, data)
        net, force, hand = np.zeros(3), np.zeros(6), [model.body(name).id for name in ("left", "right")]
        for i in range(data.ncon):
            mujoco.mj_contactForce(model, data, i, force)
            bodies = model.geom_bodyid[data.contact[i].geom]
            if set(bodies) & set(hand) and model.body("ball").id in bodies:
                net += (1 if bodies[0] in hand else -1) * data.contact[i].frame.reshape(3, 3).T @ force[:3]
        size = np.linalg.norm(net)
        rates = [float(result.info.terms[name]) / env.control_step for name in ("free", "bounded")]
        np.testing.assert_allclose(rates, [max(0, size - 1e-3), min(2, max(0, size - 1))], atol=1e-5)
        sizes.append(size)
    assert max(sizes) > 3 and any(1 < size < 3 for size in sizes)


def test_an_episode_ends_at_a_score(folder):
    env = tiny_env(folder, 3, gravity="0 0 0", more="episode: 20 s\nterms: {enough: {term: score_limit, most: 2}}\n")
    ends = []
    for _ in range(60):
        env.sim.qvel[:, 8] = torch.tensor([0.0, 6.0, 3.0])  # spun by hand
        result = env.step(torch.zeros(3, 2))
        ends += [(result.terminated.tolist(), result.info.score.tolist())] if result.terminated.any() else []
    assert next(end for end, _ in ends) == [False, True, False] and ends[0][1][1] == 2
    assert not any(end[0] for end, _ in ends) and any(end[2] for end, _ in ends)


def test_a_document_chooses_the_links_of_a_group_of_forces(folder):
    env = tiny_env(folder, more='terms: {tip: {term: link_force, links: ["ri*"]}}\n')
    obs = env.step(torch.ones(4, 2)).obs["tip"]
    assert torch.equal(obs, env.now.link_force[:, 1].float())
    with pytest.raises(SimulationError, match='no link matches "tip"; known links: left, right'):
        tiny_env(folder, more="terms: {tip: {term: link_force, links: [tip]}}\n")
    with pytest.raises(SpecError, match=r"terms\.tip\.links: found a list of 0, expected at least 1 entry"):
        tiny_env(folder, more="terms: {tip: {term: link_force, links: []}}\n")


def test_parameters_of_shared_terms_are_keys_of_the_document():
    """They have the term's unit and default, unless the spec defines the key."""

    class OwnSpec(TaskSpec):
        max_force: float = 3.0

    class Reach(Task):
        Spec = OwnSpec
        near = Near.of_task(1.0, width="reach")
        contact_force = ContactForce.of_task(-1.0, max_force="max_force")

    common = {"tgdsl": 1, "task": "reach", "document": "palm.yaml", "object": "item", "joints": ["*"]}
    spec = Reach.Spec.model_validate(common)
    assert (spec.reach, spec.max_force) == (0.02, 3.0)
    assert Near.for_spec(Reach.Spec.model_validate(common | {"reach": "5 mm"}), {"width": "reach"}).width == 0.005
    with pytest.raises(ValidationError, match="reach"):
        Reach.Spec.model_validate(common | {"reach": "-5 mm"})


def test_shared_terms_appear_once_in_each_task():
    """Terms of `HandTask` are in each task's reward and document, after the task's own terms unless it redefines them."""
    for task in map(resolve_name, TASKS.values()):
        assert HandTask.terms.keys() <= task.terms.keys() == task.Spec.model_fields["rewards"].annotation.model_fields.keys()
    assert list(HotBall.terms) == ["approach", "contact", "progress", "latched", "lost", *HandTask.terms]
    assert GripForce.terms["action_rate"].weight == -0.01 != HotBall.terms["action_rate"].weight
