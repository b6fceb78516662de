"""`tgdsl grasps`: output, files and errors."""

import numpy as np
import pytest
from pincer_tasks import write_pincer

from tgdsl.files import cache
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.grasps import sampling as loading


@pytest.fixture
def document(tmp_path, monkeypatch):
    """Return a task with a fresh cache."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))
    return write_pincer(tmp_path / "task")


def test_the_task_uses_the_sampled_grasps(here, document, monkeypatch):
    code, out, err = here(document.parent, "grasps", "task.yaml")
    assert (code, err) == (0, "")
    assert out == f"6 grasps of 2 variants of rod: {cache.folder()}\n"
    monkeypatch.setattr(loading, "sample", lambda *_: pytest.fail("sampled again"))
    assert here(document.parent, "grasps", "task.yaml") == (0, out, "")
    assert len(TouchEnv(document, 2, threads=1).task.grasps.qpos) == 6


def test_num_seed_and_a_file_can_be_given(here, document):
    code, out, _ = here(document.parent, "grasps", "task.yaml", "--num", "4", "--seed", "3", "--out", "kept/my grasps.npz")
    assert code == 0 and out.splitlines()[0].startswith("4 grasps of 2 variants of rod") and len(out.splitlines()) == 2
    assert out.splitlines()[1] == "file: kept/my grasps.npz"
    env = TouchEnv(document, 2, threads=1, overrides={"grasps.file": "kept/my grasps.npz"})
    assert len(env.task.grasps.qpos) == 4
    with np.load(document.parent / "kept" / "my grasps.npz") as grasps:
        assert grasps["variant"].tolist() == [0, 0, 1, 1]
    # A document that names a file is still sampled.
    code, out, _ = here(document.parent, "grasps", "task.yaml", "--num", "2", "--set", "grasps.file=nowhere.npz")
    assert code == 0 and out.splitlines()[0].startswith("2 grasps")
    assert "--set, has the same" in out.splitlines()[1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("task.yaml", "--num", "0"), "grasps.num: found 0"),
        (("task.yaml", "--seed", "-1"), "grasps.seed"),
        (("task.yaml", "--set", "grasps.closed=shut"), 'no keyframe "shut"'),
        (("nowhere.yaml",), "nowhere.yaml: cannot read this file"),
        (("task.yaml", "--out", "."), ".: this is a folder"),
        (("sensors.yaml",), "this is a document of sensors"),
    ],
)
def test_mistakes_are_reported_without_a_traceback(here, document, arguments, says):
    code, out, err = here(document.parent, "grasps", *arguments)
    assert code == 2 and out == "" and says in err and "Traceback" not in err


def test_a_task_without_grasps_is_refused(here, document):
    document.write_text(
        document.read_text().replace("task: screwdriver", "task: in_palm_rotate").replace("grasps:", "# grasps:")
    )
    code, _, err = here(document.parent, "grasps", "task.yaml")
    assert code == 2 and "tgdsl: task.yaml: episodes of the task in_palm_rotate do not begin with grasps" in err
