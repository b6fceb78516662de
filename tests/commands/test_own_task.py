"""A custom task with files in separate folders, learned from any folder."""

import json

import pytest
import small_tasks
from small_runs import ARGUMENTS

pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]
ON = ("--device", "cpu", "--envs", "4", "--iterations")
FEW = tuple(
    word
    for size in ("steps=4", "networks.encoder.hidden=[8]", "networks.touch_encoder.hidden=[8]", "networks.hidden=[8]")
    for word in ("--set", f"distill.{size}")
)
CODE = """from factors import twice
from tgdsl.rl.tasks.in_palm_rotate import InPalmRotate


class Own(InPalmRotate):
    def reward(self, now, is_over):
        return {name: twice(value) for name, value in super().reward(now, is_over).items()}
"""


@pytest.fixture
def base(tmp_path):
    """Return a folder with files in `code`, `robots`, `sensors` and `tasks/mine`, and two working folders."""
    for name in ("code", "robots", "sensors", "tasks/mine", "here", "there/below"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "code" / "own.py").write_text(CODE)
    (tmp_path / "code" / "factors.py").write_text("def twice(value):\n    return 2.0 * value\n")
    (tmp_path / "robots" / "scene.xml").write_text(small_tasks.SCENE)
    (tmp_path / "sensors" / "all.yaml").write_text(small_tasks.SENSORS.replace("scene.xml", "../robots/scene.xml"))
    task = small_tasks.TASK.replace("in_palm_rotate", "../../code/own.py:Own").replace("sensors.yaml", "../../sensors/all.yaml")
    (tmp_path / "tasks" / "mine" / "task.yaml").write_text(task)
    (tmp_path / "tasks" / "moved.yaml").write_text(task.replace("../../", "../"))
    return tmp_path


FIXED = """import torch
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.task import Start, Task


class Own(Task[TaskSpec]):
    Spec, score_unit = TaskSpec, "1"

    def reset(self, chosen, episode):
        return Start({"qpos": self.setup.start})

    def advance(self, now):
        pass

    def is_over(self, now):
        return torch.zeros(self.setup.num_envs, dtype=torch.bool)

    def reward(self, now, is_over):
        return {"none": self.score()}

    def observe(self, now):
        return {}

    def score(self):
        return torch.zeros(self.setup.num_envs)
"""


def test_no_gait_is_printed_for_an_immovable_object(base, here):
    scene = base / "robots" / "scene.xml"
    fixed = scene.read_text().replace('<freejoint name="item"/>', "").replace(' 0 0 .0205 1 0 0 0"', '"')
    scene.write_text(fixed)
    (base / "code" / "own.py").write_text(FIXED)
    task = base / "tasks" / "mine" / "task.yaml"
    task.write_text(task.read_text().partition("randomise")[0])
    code, out, error = here(base / "tasks" / "mine", "evaluate", "task.yaml", "--episodes", "1")
    assert code == 0, error
    assert out.startswith("score 0.000") and len(out.splitlines()) == 1


def test_a_custom_task_is_learned_and_resumed_from_any_folder(base, here):
    """Its document may also move, as long as it names the same files."""
    task, moved, run = "../tasks/mine/task.yaml", "../../tasks/moved.yaml", "../../here/out/task"
    for folder, *words in (
        ("here", "train", task, *ON, "1", "--episodes", "4", *ARGUMENTS),
        ("there/below", "train", "../" + task, "--resume", run, *ON, "2", "--episodes", "0"),
        ("there/below", "train", moved, "--resume", run, *ON, "3", "--episodes", "0"),
        ("there/below", "evaluate", moved, "--policy", f"{run}/policy.pt", "--episodes", "4", "--envs", "4"),
        ("here", "distill", task, "--teacher", "out/task/policy.pt", "--types", "bool", "--seeds", "1", *ON, "1", *FEW),
        ("there/below", "distill", moved, "--resume", f"{run}_students", *ON, "2"),
        ("there/below", "distill", moved, "--resume", f"{run}_students", *ON, "3", "--teacher", f"{run}/policy.pt"),
        ("here", "distill", task, "--resume", "out/task_students", *ON, "3", "--teacher", "./out/../out/task/policy.pt"),
    ):
        code, _, error = here(base / folder, *words, *(("--episodes", "0") if words[0] == "distill" else ()))
        assert code == 0, (words, error)
    run_folder = base / "here" / "out" / "task"
    assert (run_folder / "own.py").read_text() == CODE and (run_folder / "all.yaml").is_file()
    starts = json.loads((base / "here" / "out" / "task_students" / "default" / "run.json").read_text())["starts"]
    assert [start["teacher"] for start in starts] == ["out/task/policy.pt", *[f"{run}/policy.pt"] * 2, "out/task/policy.pt"]
    assert len({start["teacher_sha256"] for start in starts}) == 1
