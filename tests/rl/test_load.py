"""Loading task documents: errors are reported at their place, with a hint."""

import json
import sys
from functools import cache
from pathlib import Path
from typing import Literal

import jsonschema
import pytest
import torch
from ruamel.yaml import YAML
from tiny_tasks import tiny_env, write_task

from tgdsl.errors import SimulationError, SpecError, TgdslError
from tgdsl.observations.observations import TYPES, PerLink
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task, task_schema
from tgdsl.rl.playing.evaluation import evaluate
from tgdsl.rl.playing.policy import provenance
from tgdsl.rl.playing.rollout import ZeroActor
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate
from tgdsl.rl.terms import TERMS, RewardTerm

REPOSITORY = Path(__file__).parents[2]
DOCUMENTS = sorted(
    path
    for path in (REPOSITORY / "examples" / "tasks").glob("*.yaml")
    if "\ntask:" in (text := path.read_text(encoding="utf-8")) and "\nmatrix:" not in text  # a sweep
)


def problems(load):
    """Return the problems reported by a call that must fail."""
    with pytest.raises(SpecError) as caught:
        load()
    return caught.value.problems


@pytest.mark.parametrize(
    ("more", "line", "path", "says"),
    [
        ("rewards: {spinn: 2}\n", 8, "rewards.spinn", "spin"),
        ("randomise: {friction: [1.5, 0.5]}\n", 8, "randomise.friction", "not ordered"),
        ("randomise: {friction: [-1, 2]}\n", 8, "randomise.friction", "expected more than 0"),
        ("randomise: {drive: {backlash: [-0.1, 0.2]}}\n", 8, "randomise.drive.backlash", "at least 0"),
        ("randomise:\n  push:\n    x: 3 mm\n", 10, "randomise.push.x", "unit of force"),
        ("touch: forse\n", 8, "touch", "force"),
        ("episode: -1 s\n", 7, "episode", "more than 0"),
        ("physics: {cone: round}\n", 8, "physics.cone", "elliptic"),
        ("physics: {solref: [9 ms, 1]}\n", 8, "physics", "expected at least two timesteps, 0.01 s"),
        ("physics: {substeps: 0}\n", 8, "physics.substeps", "1"),
        ("action: {scale: 3 mm}\n", 8, "action.scale", "unit of angle"),
        ("action: {mode: absolute, scale: 0.2}\n", 8, "action", "absolute actions have none"),
        ("action: {mode: ofset}\n", 8, "action.mode", "offset"),
        ("color: red\n", 8, "color", "unknown key"),
    ],
)
def test_errors_are_reported_at_their_place(tmp_path, more, line, path, says):
    task = write_task(tmp_path, more=more)
    (problem,) = problems(lambda: load_task(task))
    assert (problem.file, problem.line, problem.path) == (str(task), line, path)
    assert says in f"{problem.what} {problem.hint}"


def test_all_errors_are_reported_at_once(tmp_path):
    task = write_task(tmp_path, more="rewards: {spinn: 2}\nepisode: x\n")
    assert {problem.path for problem in problems(lambda: load_task(task))} == {"rewards.spinn", "episode"}


@pytest.mark.parametrize(
    ("old", "new", "line", "path", "says"),
    [
        ("joints: [left, right]", "joints: [left, wright]", 5, "joints[1]", 'no actuated joint is called "wright"'),
        ("joints: [left, right]", 'joints: ["thumb*"]', 5, "joints[0]", 'no actuated joint matches "thumb*"'),
        ("object: ball", "object: cube", 4, "object", 'has no object "cube", only ball'),
        ("keyframe: home", "keyframe: hom", 6, "keyframe", 'the scene has no keyframe "hom"'),
        ("object: ball", "object: ball\nsensors: {nearr: {radius: 4 mm}}", 5, "sensors.nearr", 'has no sensor "nearr"'),
        ("sensors.yaml", "sensor.yaml", 3, "document", 'there is no file "sensor.yaml"'),
        ("in_palm_rotate", "in_palm_rotat", 2, "task", 'there is no task "in_palm_rotat"'),
        ("in_palm_rotate", "nowhere.py:Task", 2, "task", "nowhere.py: FileNotFoundError: there is no such file"),
        ("in_palm_rotate", "pathlib:Path", 2, "task", "no subclass of tgdsl.rl.task.Task"),
        ("in_palm_rotate", "pathlib:Paths", 2, "task", 'pathlib has no class "Paths"'),
    ],
)
def test_mismatches_with_the_scene_are_reported_at_their_place(tmp_path, old, new, line, path, says):
    task = write_task(tmp_path)
    task.write_text(task.read_text().replace(old, new))
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert (problem.file, problem.line, problem.path) == (str(task), line, path)
    assert says in problem.what


def test_a_task_overrides_its_sensors_document(tmp_path):
    """The result compiles as if the sensors' document had said so, and the policy's card has the radius."""
    task = write_task(tmp_path, more="touch: proximity\n")
    sensors = tmp_path / "sensors.yaml"
    text = sensors.read_text()
    arrays = []
    for radius, overrides in (("10 mm", {"sensors.near.radius": "4 mm"}), ("4 mm", {}), ("10 mm", {})):
        sensors.write_text(text.replace("kind: proximity,", f"kind: proximity, radius: {radius},"))
        env = TouchEnv(task, 2, overrides=overrides)
        arrays.append({name: array.tobytes() for name, array in env.touch.plan.arrays.items()})
        if overrides:
            assert provenance(env.loaded, env.sim.model)["sensors"]["sensors"]["near"]["radius"] == 0.004
    assert arrays[0] == arrays[1] != arrays[2]


def test_a_missing_sensor_is_named(tmp_path):
    task = write_task(tmp_path, more="touch: proximity\n")
    sensors = tmp_path / "sensors.yaml"
    text = sensors.read_text()
    sensors.write_text("\n".join(line for line in text.splitlines() if "kind: proximity" not in line))
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert problem.path == "touch" and problem.line == 8
    assert problem.what == '"sensors.yaml" has no sensor of kind "proximity", expected one'
    assert problem.hint.startswith("its sensors allow `touch` none, ") and "proximity" not in problem.hint
    sensors.write_text(text + "  nearer: {kind: proximity, links: hand, feels: [ball]}\n")
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert problem.what == '"sensors.yaml" has the sensors near, nearer of kind "proximity", expected one'
    sensors.write_text("\n".join(line for line in text.splitlines() if "link_contact" not in line))
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert problem.path == "task" and '"link_contact"' in problem.what
    sensors.write_text("\n".join(line for line in text.splitlines() if "link_contact" not in line and "proximity" not in line))
    assert [problem.path for problem in problems(lambda: TouchEnv(task, 2))] == ["task", "touch"]  # all at once


def test_an_unknown_group_of_links_is_named(tmp_path):
    task = write_task(tmp_path, more="placement: finger\n")
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert (problem.path, problem.file) == ("placement", str(task)) and problem.line > 0 and '"finger"' in problem.what


def test_a_document_without_a_task_gets_a_list_of_tasks(tmp_path):
    (tmp_path / "task.yaml").write_text("tgdsl: 1\n")
    (problem,) = problems(lambda: load_task(tmp_path / "task.yaml"))
    assert "in_palm_rotate" in problem.what


def test_values_are_set_by_dotted_path(tmp_path):
    task = write_task(tmp_path)
    spec = load_task(task, {"rewards.spin": 3, "randomise.friction": "[0.5, 2]", "episode": "2 s"}).spec
    assert (spec.rewards.spin, spec.randomise.friction, spec.episode) == (3.0, (0.5, 2.0), 2.0)
    (problem,) = problems(lambda: load_task(task, {"rewards.spinn": 3}))
    assert problem.file == "--set rewards.spinn=3"
    (problem,) = problems(lambda: load_task(task, {"terms.a.weight": 1}))
    assert (problem.file, problem.path) == ("--set terms.a.weight=1", "terms.a.term")


def test_a_user_defined_task_is_loaded_from_next_to_its_document(tmp_path):
    task = write_task(tmp_path, task="own.py:Own", more="extra: 4\n")
    (tmp_path / "own.py").write_text(
        "from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate, InPalmRotateSpec\n"
        "class OwnSpec(InPalmRotateSpec):\n"
        "    extra: int = 1\n"
        "    '''Something.'''\n"
        "class Own(InPalmRotate):\n"
        "    Spec = OwnSpec\n"
    )
    env = TouchEnv(task, 2, threads=1)
    assert isinstance(env.task, InPalmRotate) and env.spec.extra == 4
    (tmp_path / "near_it.py").write_text("from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\n")
    (tmp_path / "other.py").write_text("import near_it\nclass Other(near_it.InPalmRotate):\n    pass\n")
    paths = list(sys.path)
    other = write_task(tmp_path, task="other.py:Other")
    assert load_task(other).task.__name__ == "Other" and sys.path == paths
    del sys.modules["near_it"]
    task = write_task(tmp_path, task="own.py:Own", more="extra: 4\n")
    task.write_text(task.read_text().replace("extra: 4", "extra: x"))
    (problem,) = problems(lambda: load_task(task))
    assert problem.path == "extra" and problem.line == 8


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("import nowhere", "ModuleNotFoundError: No module named 'nowhere'"),
        ("x = = 1", "SyntaxError: invalid syntax"),
        ("y = x", "NameError: name 'x' is not defined"),
        ("class Spec(InPalmRotate.Spec):\n    extra = 1", "PydanticUserError: A non-annotated attribute was detected"),
    ],
)
def test_errors_in_a_user_defined_tasks_file_are_reported_with_their_line(tmp_path, line, says):
    (tmp_path / "code").mkdir()
    code = tmp_path / "code" / "own.py"
    code.write_text(f"from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\n{line}\n")
    task = write_task(tmp_path, task="code/own.py:Own")
    (problem,) = problems(lambda: load_task(task))
    assert (problem.file, problem.line, problem.path) == (str(task), 2, "task")
    assert problem.what.startswith(f'cannot import "code/own.py:Own": {code}:2: {says}')
    code.write_text("from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Owl(InPalmRotate):\n    pass\n")
    (problem,) = problems(lambda: load_task(task))
    assert (problem.what, problem.hint) == ('code/own.py has no class "Own"', 'did you mean "Owl"?')


def test_all_missing_members_of_a_user_defined_task_are_named(tmp_path):
    (tmp_path / "own.py").write_text(
        "from tgdsl.rl.task import Task\nfrom tgdsl.rl.spec import TaskSpec\nclass Own(Task[TaskSpec]):\n    pass\n"
    )
    (problem,) = problems(lambda: load_task(write_task(tmp_path, task="own.py:Own")))
    assert problem.what == '"own.py:Own" lacks advance, is_over, reset, score, Spec, score_unit'


def test_senses_of_a_user_defined_task_must_be_a_tuple_of_kinds(tmp_path):
    code = "from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Own(InPalmRotate):\n    senses = {}\n"
    (tmp_path / "own.py").write_text(code.format('"link_contact"'))
    (tmp_path / "other.py").write_text(code.format('("link_contac",)'))
    (problem,) = problems(lambda: load_task(write_task(tmp_path, task="own.py:Own")))
    assert (problem.path, problem.what) == (
        "task",
        '"own.py:Own": senses is "link_contact", expected a tuple, ("link_contact",)',
    )
    (problem,) = problems(lambda: TouchEnv(write_task(tmp_path, task="other.py:Own"), 2))
    assert (problem.path, problem.hint) == ("task", 'did you mean "link_contact"?')


@pytest.mark.parametrize(
    ("method", "says"),
    [
        ("def reward(self, now, is_over):\n        return {}", "Own: `reward` has no terms, expected one at least"),
        (
            "def reward(self, now, is_over):\n        return {'a': is_over[:, None] * 1.0}",
            r'Own: the term "a" of `reward` is of shape \(2, 1\) and torch\.float\d+, expected a tensor \(2,\)',
        ),
        (
            "def reward(self, now, is_over):\n        return {'a': 1.0}",
            r'the term "a" of `reward` is a float, expected a tensor',
        ),
        (
            "def is_over(self, now):\n        return now.friction",
            r"`is_over` is .*float64, expected a tensor \(2,\) of torch\.bool",
        ),
        ("def score(self):\n        return None", r"Own: `score` is a NoneType, expected a tensor \(2,\)"),
        ("def reset(self, chosen, episode):\n        return {}", "Own: `reset` is a dict, expected a Start"),
        (
            "def observe(self, now):\n        self.parts = {}\n        return super().observe(now)",
            "Own: it has no `observe`, and sets no `self.parts`",
        ),
        (
            "def observe(self, now):\n        return {'goal': now.friction}",
            r'Own: the group "goal" of `observe` is of shape \(2,\) and torch\.float64, expected a tensor \(2, …\)',
        ),
        (
            "def observe(self, now):\n        return {'proprio': now.joint_pos}",
            'Own: `observe` has a group "proprio", as all tasks do; call it otherwise',
        ),
    ],
)
def test_wrong_return_values_of_a_user_defined_task_are_named(tmp_path, method, says):
    (tmp_path / "own.py").write_text(
        f"from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Own(InPalmRotate):\n    {method}\n"
    )
    task = write_task(tmp_path, task="own.py:Own")
    with pytest.raises(SimulationError, match=says):
        TouchEnv(task, 2, threads=1).step(torch.zeros(2, 2))


def test_a_mapping_is_accepted_as_a_document(tmp_path, monkeypatch):
    task = write_task(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert TouchEnv(YAML(typ="safe").load(task), 2, threads=1).num_actions == 2


def test_joints_without_position_servos_are_refused(tmp_path):
    task = write_task(tmp_path)
    robot = tmp_path / "tiny.xml"
    robot.write_text(
        robot.read_text().replace('<position name="left" joint="left" kp="1" kv="0.05"', '<motor name="left" joint="left"')
    )
    (problem,) = problems(lambda: TouchEnv(task, 2))
    assert problem.path == "joints" and "is no position servo" in problem.what


def test_an_object_without_a_free_joint_cannot_be_placed(tmp_path):
    task = write_task(tmp_path)
    scene = tmp_path / "scene.xml"
    text = scene.read_text().replace('<freejoint name="ball"/>', '<joint name="ball" type="hinge"/>')
    scene.write_text(text.replace("  0 0 0.03 1 0 0 0", " 0"))
    with pytest.raises(SimulationError, match='the object\'s body "ball" has no free joint'):
        TouchEnv(task, 2)


def test_an_unknown_simulator_is_refused(tmp_path):
    with pytest.raises(SimulationError, match='simulator is "wrap"; did you mean "warp"'):
        tiny_env(tmp_path, simulator="wrap")


@cache
def validator():
    """Return a validator of the code's schema."""
    return jsonschema.Draft202012Validator(task_schema())


def test_the_schema_in_the_repository_is_up_to_date():
    text = (REPOSITORY / "tgdsl.task.schema.json").read_text(encoding="utf-8")
    assert text == json.dumps(task_schema(), indent=2, ensure_ascii=False) + "\n", "run `tgdsl schema --tasks`"
    jsonschema.Draft202012Validator.check_schema(task_schema())


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_documents_in_the_repository_are_valid(path):
    assert load_task(path).spec.tgdsl == 1
    validator().validate(YAML(typ="safe").load(path))


@pytest.mark.parametrize("more", ["rewards: {spinn: 2}", "touch: forse", "action: {scale: 3 mm}", "color: red", "task: rotate"])
def test_the_schema_rejects_mistakes(tmp_path, more):
    document = YAML(typ="safe").load(write_task(tmp_path)) | YAML(typ="safe").load(more)
    with pytest.raises(jsonschema.ValidationError):
        validator().validate(document)


def test_a_task_without_sensors_can_be_evaluated(tmp_path):
    """A task needs sensors only if it declares them; a policy may feel nothing. Joints and an object remain."""
    task = write_task(tmp_path)
    (tmp_path / "blind.py").write_text(
        "from tgdsl.rl.task import Task\nfrom tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\n\n\n"
        "class Blind(InPalmRotate):\n"
        "    senses = Task.senses  # of a task that does not name any\n\n"
        "    def reward(self, now, is_over):\n"
        "        return {'spin': self.rate}\n"
    )
    task.write_text(task.read_text().replace("in_palm_rotate", "blind.py:Blind"))
    sensors = tmp_path / "sensors.yaml"
    sensors.write_text("\n".join(line for line in sensors.read_text().splitlines() if "link_contact" not in line))
    env = TouchEnv(task, 2, overrides={"touch": "none"})
    assert env.reset()["proprio"].shape[0] == 2 and "tactile_sensors" not in env.groups
    evaluation = evaluate(env, ZeroActor(env), 2)
    assert evaluation.gait.coasting is None and evaluation.gait.link_forces == {} and evaluation.gait.max_speed > 0


class DeepestObservation(PerLink):
    type: Literal["deepest"]
    needs = ("depth",)
    task_kind = "contact_depth"

    @property
    def features(self):
        return (("largest depth", "m", "", 1.0),)

    @staticmethod
    def observe(reading, channels, constants):
        return (reading[:, :, channels[0], None] * constants["operator"]).amax(dim=1)


def test_a_registered_observation_is_a_value_of_touch(tmp_path, monkeypatch):
    with pytest.raises(SpecError, match='touch: unknown type "deepest"; did you mean "depth"'):
        load_task(write_task(tmp_path, more="touch: deepest\n"))
    monkeypatch.setattr(TYPES, "registered", (DeepestObservation,))
    env = tiny_env(tmp_path, 2, more="touch: deepest\n")
    names = [feature.name for _, feature in env.describe()["tactile_sensors"]]
    assert names == ["largest depth"] * env.groups["tactile_sensors"]
    assert "deepest" in task_schema()["$defs"]["TaskSpec"]["properties"]["touch"]["enum"]


class SpinRate(RewardTerm):
    """Spin of the object."""

    def rate(self, now, setup):
        return now.object.angvel.norm(dim=1)


def test_a_document_can_use_terms_of_packages(tmp_path, monkeypatch):
    task = write_task(tmp_path, more="terms: {whirl: {term: spin_rate, weight: 2}}\n")
    (problem,) = problems(lambda: load_task(task))
    assert problem.path == "terms.whirl.term" and 'there is no term "spin_rate"' in problem.what
    monkeypatch.setattr(TERMS, "registered", (SpinRate,))
    assert load_task(task).terms == {"whirl": SpinRate(term="spin_rate", weight=2.0)}
    with pytest.raises(TgdslError, match="RewardTerm lacks rate"):
        TERMS.register(RewardTerm)
