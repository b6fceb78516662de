"""Training settings of a task's document: the paper's values, groups, and errors at their places."""

import pytest
from small_runs import small_learner
from small_tasks import TASK, small_task

from tgdsl.errors import SimulationError, SpecError
from tgdsl.rl.load import load_task
from tgdsl.rl.train.learner import config, observed

GROUPS = {"proprio": 6, "tactile_sensors": 4, "priv_proprio": 9, "goal": 7, "priv_obj_state": 15, "priv_obj_props": 6}


def load_small(folder, train="", **overrides):
    file = small_task(folder)
    file.write_text(TASK + train)
    return load_task(file, overrides)


def test_defaults_match_the_paper():
    """Table of the appendix, by task: iterations, steps, discount, entropy; and the values that all tasks share.

    They are the defaults of a document; the examples depart from them.
    """
    table = {
        "in_palm_rotate": (6000, 24, 0.998, 2e-3),
        "in_hand_repose": (20000, 24, 0.998, 2e-3),
        "screwdriver": (5000, 12, 0.99, 0.0),
    }
    for name, expected in table.items():
        overrides = {"train": {"learning_rate": 1e-3}}  # leaves the other defaults
        task = load_task(f"examples/tasks/{name}.yaml", overrides)
        train = task.spec.train
        assert (train.iterations, train.steps, train.discount, train.entropy) == expected
        settings = config(task, GROUPS)
        algorithm = settings["algorithm"]
        assert (algorithm["learning_rate"], algorithm["schedule"], algorithm["desired_kl"]) == (1e-3, "adaptive", 0.01)
        assert (algorithm["num_learning_epochs"], algorithm["num_mini_batches"], algorithm["lam"]) == (5, 4, 0.95)
        assert (algorithm["clip_param"], algorithm["value_loss_coef"], algorithm["max_grad_norm"]) == (0.2, 1.0, 1.0)
        assert settings["actor"]["hidden_dims"] == [512, 256, 128] and settings["actor"]["distribution_cfg"]["init_std"] == 1.0
        assert settings["critic"]["encoders"]["*"] == {"hidden": [512, 256, 128], "size": 64}
        assert settings["actor"]["encoders"]["tactile_sensors"] == {"hidden": [64, 64], "size": 32}
        assert (algorithm["rnd_cfg"]["learning_rate"], algorithm["rnd_cfg"]["num_outputs"]) == (1e-3, 8)


@pytest.mark.parametrize("learner", ["train", "distill"])
def test_setting_widths_keeps_the_size_of_the_embedding(tmp_path, learner):
    """That of touch has 32 numbers; other groups have 64."""
    spec = getattr(load_task(small_task(tmp_path), {f"{learner}.networks.touch_encoder.hidden": "[8]"}).spec, learner)
    assert (spec.networks.touch_encoder.hidden, spec.networks.touch_encoder.size) == ((8,), 32)
    assert spec.networks.encoder.size == 64


def test_groups_of_actor_critic_and_rnd(tmp_path):
    teacher = ["priv_proprio", "goal", "priv_obj_state"]
    groups = observed(load_small(tmp_path), GROUPS)
    assert groups == {"actor": teacher, "critic": [*teacher, "priv_obj_props"], "rnd_state": ["priv_obj_state"]}
    touch = load_small(tmp_path, "train: {actor: [proprio, tactile_sensors, goal], rnd: off}\n")
    assert observed(touch, GROUPS) == {"actor": ["proprio", "tactile_sensors", "goal"], "critic": groups["critic"]}
    assert config(touch, GROUPS)["algorithm"]["rnd_cfg"] is None
    other_groups = observed(load_small(tmp_path), {"command": 3, "proprio": 6, "priv_proprio": 9, "priv_ridge": 1})
    assert other_groups == {name: ["command", "priv_proprio", "priv_ridge"] for name in ("actor", "critic", "rnd_state")}


@pytest.mark.parametrize(
    ("train", "message"),
    [
        ("{learning_rat: 1}", 'unknown key "learning_rat"'),
        ("{learning_rate: 0}", "train.learning_rate: 0 is out of range, expected more than 0"),
        ("{discount: 1.5}", "train.discount"),
        ("{networks: {initial_std: 0.5, min_std: 0.6}}", "train.networks: min_std 0.6 is more than initial_std 0.5"),
        ("{rnd: of}", "train.rnd"),
        ("{rnd: {outputs: 0}}", "train.rnd.outputs"),
        ("{actor: [goal, goal]}", "actor names a group twice"),
        ("{networks: {hidden: []}}", "train.networks.hidden"),
    ],
)
def test_errors_are_located(tmp_path, train, message):
    with pytest.raises(SpecError) as raised:
        load_small(tmp_path, f"train: {train}\n")
    assert message in str(raised.value) and "task.yaml:" in str(raised.value)


def test_unknown_groups_are_located(tmp_path):
    wrong = "train: {actor: [gaol, propio], critic: [goals], rnd: {groups: [goa]}}\ndistill: {groups: [propio]}\n"
    with pytest.raises(SpecError) as raised:
        load_small(tmp_path, wrong)
    places = ["train.actor[0]", "train.actor[1]", "train.critic[0]", "train.rnd.groups[0]", "distill.groups[0]"]
    assert [problem.path for problem in raised.value.problems] == places
    with pytest.raises(
        SpecError, match=r'task\.yaml:\d+:\d+: train\.critic\[1\]: there is no group of observations "gaol".*"goal"'
    ):
        load_small(tmp_path, "train: {critic: [proprio, gaol]}\n")
    with pytest.raises(SpecError, match=r'train\.actor\[0\]: there is no group of observations "tactile_sensors"'):
        small_learner(tmp_path, touch="none", train__actor="[tactile_sensors]")
    # Students may observe touch that their teacher lacks.
    assert observed(load_small(tmp_path, "distill: {groups: [proprio, tactile_sensors]}\n"), GROUPS | {"tactile_sensors": 0})
    code = "from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate\nclass Own(InPalmRotate):\n    def observe(self, now):\n"
    (tmp_path / "own.py").write_text(f"{code}        return {{}}\n")  # its groups are known only in environments
    task = load_small(tmp_path, "train: {rnd: {groups: [empty]}, actor: [gaol]}\n", task="own.py:Own")
    with pytest.raises(SpecError, match=r'train\.actor\[0\]: there is no group of observations "gaol"'):
        observed(task, GROUPS | {"empty": 0})
    task = load_small(tmp_path, "train: {rnd: {groups: [empty]}}\n", task="own.py:Own")
    with pytest.raises(SpecError, match=r'train\.rnd\.groups\[0\]: the group of observations "empty" is empty'):
        observed(task, GROUPS | {"empty": 0})
    (tmp_path / "own2.py").write_text(f"{code}        return super().observe(now)\n    own_groups = ('goal', 'command')\n")
    with pytest.raises(SimulationError, match="`own_groups` and `observe` differ in command, priv_obj_props, priv_obj_state"):
        small_learner(tmp_path, task="own2.py:Own")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("action.smoothing", 1.0, "action: smoothing is 1, expected less than 1"),
        ("randomise.drive.delay", [0.9, 2.2], "drive: delay is 0.9 to 2.2 control steps, expected whole numbers"),
        ("randomise.drive.delay", 1e9, r"drive: delay is up to 1e\+09 control steps, expected at most 1000"),
        ("episode", 1e300, "episode: .*1000000"),
    ],
)
def test_impossible_actions_and_drives_are_refused(tmp_path, name, value, message):
    with pytest.raises(SpecError, match=message):
        load_task(small_task(tmp_path), {name: value})
