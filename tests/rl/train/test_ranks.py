"""Several processes: what torchrun says, and that two learn what one does with both batches."""

import os
import subprocess
import sys

import joint_learning
import pytest
import torch
from small_runs import ARGUMENTS
from small_tasks import small_task

from tgdsl.rl.train.folder import RunFolder, read_checkpoint
from tgdsl.rl.train.model import Gaussian
from tgdsl.rl.train.ranks import RankError, Ranks


def started(num, *arguments):
    """Run something by torchrun; return what the first process prints."""
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(num)]
    done = subprocess.run([sys.executable, *torchrun, *arguments], capture_output=True, text=True, env=environ)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


@pytest.mark.slow
def test_two_processes_learn_what_one_does_with_both_batches(tmp_path, monkeypatch):
    """Networks, normalisers, learning rate and advantages after three iterations, in float64; gradients are clipped."""
    monkeypatch.setattr(Gaussian, "sample", Gaussian.sample)  # which the script replaces
    try:
        joint_learning.main(tmp_path)
    finally:
        torch.set_default_dtype(torch.float32)
    started(2, joint_learning.__file__, str(tmp_path))
    whole, first, second = (torch.load(tmp_path / f"{name}.pt") for name in ("1_0", "2_0", "2_1"))
    for name in ("advantages", "pos"):
        axis = whole[name].dim() - 2 if name == "pos" else 1
        joint = torch.cat([first.pop(name), second.pop(name)], dim=axis)
        torch.testing.assert_close(joint, whole.pop(name), rtol=1e-8, atol=1e-10)
    assert len(set(whole["rates"].tolist())) > 1
    assert whole.keys() == first.keys() == second.keys()
    for name, value in whole.items():
        torch.testing.assert_close(first[name], value, rtol=1e-8, atol=1e-11, msg=lambda text, name=name: f"{name}: {text}")
        assert torch.equal(first[name], second[name]), name


@pytest.mark.slow
def test_the_command_in_two_processes(tmp_path):
    """One folder; both processes' environments count, differ, and go on."""
    document = str(small_task(tmp_path))
    out = ["--device", "cpu", "--envs", "3", "--episodes", "4", "--out", str(tmp_path / "run")]
    said = started(2, "-m", "tgdsl", "train", document, *out, "--iterations", "2", *ARGUMENTS)
    assert said.count("policy: ") == 1 and "48 steps" in said
    state = read_checkpoint(RunFolder(tmp_path / "run").checkpoint)
    assert (state["iteration"], state["samples"], len(state["processes"])) == (2, 48, 2)
    one, two = state["processes"]
    assert not torch.equal(one["cpu"], two["cpu"])
    started(2, "-m", "tgdsl", "train", document, *out, "--iterations", "4", "--resume", str(tmp_path / "run"))
    assert read_checkpoint(RunFolder(tmp_path / "run").checkpoint)["iteration"] == 4
    assert [row["samples"] for row in RunFolder(tmp_path / "run").rows()] == ["24", "48", "72", "96"]


def test_what_torchrun_says():
    assert Ranks.of({}) == Ranks() == Ranks(0, 1, 0) and Ranks().rsl_rl is None and Ranks().is_first
    two = Ranks.of({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"})
    assert (two.device("cuda"), two.device("cpu"), two.is_first) == ("cuda:1", "cpu", False)
    assert two.rsl_rl == {"global_rank": 1, "local_rank": 1, "world_size": 2}
    with pytest.raises(RankError, match='device is "cuda:0", and 2 processes take a GPU each; expected "cuda"'):
        two.device("cuda:0")
    assert Ranks().device("cuda:1") == "cuda:1"
