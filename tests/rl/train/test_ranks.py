"""Training in several processes: torchrun's variables, and equality with one process on both batches."""

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


def run_torchrun(num, *arguments):
    """Run a command by torchrun; return the output of the first process."""
    environ = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(num)]
    process = subprocess.run([sys.executable, *torchrun, *arguments], capture_output=True, text=True, env=environ)
    assert process.returncode == 0, process.stderr[-4000:]
    return process.stdout


@pytest.mark.slow
def test_two_processes_equal_one_with_both_batches(tmp_path, monkeypatch):
    """Networks, normalisers, learning rate and advantages after three iterations in float64, with clipped gradients."""
    monkeypatch.setattr(Gaussian, "sample", Gaussian.sample)  # the script replaces it
    try:
        joint_learning.main(tmp_path)
    finally:
        torch.set_default_dtype(torch.float32)
    run_torchrun(2, joint_learning.__file__, str(tmp_path))
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
    """They share one folder; the environments of both count, differ, and resume."""
    document = str(small_task(tmp_path))
    out = ["--device", "cpu", "--envs", "3", "--episodes", "4", "--out", str(tmp_path / "run")]
    output = run_torchrun(2, "-m", "tgdsl", "train", document, *out, "--iterations", "2", *ARGUMENTS)
    assert output.count("policy: ") == 1 and "48 steps" in output
    state = read_checkpoint(RunFolder(tmp_path / "run").checkpoint)
    assert (state["iteration"], state["samples"], len(state["processes"])) == (2, 48, 2)
    one, two = state["processes"]
    assert not torch.equal(one["cpu"], two["cpu"])
    run_torchrun(2, "-m", "tgdsl", "train", document, *out, "--iterations", "4", "--resume", str(tmp_path / "run"))
    assert read_checkpoint(RunFolder(tmp_path / "run").checkpoint)["iteration"] == 4
    assert [row["samples"] for row in RunFolder(tmp_path / "run").rows()] == ["24", "48", "72", "96"]


def test_ranks_follow_torchruns_variables():
    assert Ranks.of({}) == Ranks() == Ranks(0, 1, 0) and Ranks().rsl_rl is None and Ranks().is_first
    two = Ranks.of({"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"})
    assert (two.device("cuda"), two.device("cpu"), two.is_first) == ("cuda:1", "cpu", False)
    assert two.rsl_rl == {"global_rank": 1, "local_rank": 1, "world_size": 2}
    with pytest.raises(RankError, match='device is "cuda:0", and 2 processes take a GPU each; expected "cuda"'):
        two.device("cuda:0")
    assert Ranks().device("cuda:1") == "cuda:1"
