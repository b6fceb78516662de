"""Datasets read by lerobot, mcap and zarr hold every number of the episodes."""

import json
import sys

import numpy as np
import pytest
import torch
from hand_logs import random_readings, write_log
from small_tasks import small_task

try:
    import torchvision  # noqa: F401
except RuntimeError:  # built for torch with CUDA; lerobot does not call its operations
    for name in ("nms", "qnms"):
        torch.library.define(f"torchvision::{name}", "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
import zarr
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from mcap.reader import make_reader

from tgdsl.rl.datasets.dataset import Episode, Header, LinkTaxels, frames, write_lerobot, write_mcap, write_zarr


def made_up_episodes():
    rng = np.random.default_rng(0)
    links = {"tip": LinkTaxels("tip", rng.normal(size=(4, 3)), rng.normal(size=(4, 3))), "palm": LinkTaxels("palm")}
    header = Header("made up", "press it", ("a", "b"), links, "N", 0.01, 50.0, True, True)
    episodes = []
    for num in (31, 12, 24):
        touch = {"tip": rng.normal(size=(num, 4, 3)), "palm": rng.normal(size=(num, 1, 3))}
        state, action, policy = rng.normal(size=(3, num, 2))
        outcome = {"reward": rng.normal(size=num), "score": float(num), "is_success": num > 20}
        episodes.append(Episode(np.arange(num) * 0.01, state, action, touch, policy, **outcome))
    return header, episodes


def test_lerobot_reads_every_frame(tmp_path):
    header, episodes = made_up_episodes()
    assert write_lerobot(header, episodes, tmp_path) == (3, 16 + 6 + 12)
    dataset = LeRobotDataset("local/touch", root=tmp_path)
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (3, 34, 50)
    frames_of_episodes = [frames(header, episode) for episode in episodes]
    expected = {
        name: np.concatenate([episode_frames[name] for episode_frames in frames_of_episodes]) for name in frames_of_episodes[0]
    }
    assert expected["observation.tactile_window.tip"].shape == (34, 2, 4, 3)
    for i in range(34):
        item = dataset[i]
        for name, values in expected.items():
            np.testing.assert_array_equal(item[name].numpy(), values[i], err_msg=name)
        assert item["task"] == "press it"
    ends = [dataset.meta.episodes[i]["dataset_to_index"] for i in range(3)]
    assert ends == [16, 22, 34] and [dataset.meta.episodes[i]["success"] for i in range(3)] == [True, False, True]
    for name, values in expected.items():
        stats = dataset.meta.stats[name]
        np.testing.assert_allclose(stats["mean"], values.mean(axis=0, dtype=float, keepdims=values.ndim == 1), atol=1e-6)
        np.testing.assert_allclose(stats["std"], values.astype(float).std(axis=0, keepdims=values.ndim == 1), atol=1e-6)
        np.testing.assert_allclose(stats["max"], values.max(axis=0, keepdims=values.ndim == 1), atol=1e-6)
    with_history = LeRobotDataset("local/touch", root=tmp_path, delta_timestamps={"observation.tactile.tip": [-0.02, 0.0]})
    np.testing.assert_array_equal(with_history[20]["observation.tactile.tip"], expected["observation.tactile.tip"][19:21])
    tactile = json.loads((tmp_path / "meta/tactile.json").read_text())
    assert tactile["unit"] == "N" and tactile["links"]["palm"]["pos"] is None
    np.testing.assert_array_equal(tactile["links"]["tip"]["normal"], header.links["tip"].normal)


def test_zarr_reads_every_frame(tmp_path):
    header, episodes = made_up_episodes()
    assert write_zarr(header, episodes, tmp_path / "store") == (3, 34)
    root = zarr.open_group(str(tmp_path / "store"), mode="r")
    frames_of_episodes = [frames(header, episode) for episode in episodes]
    for name in frames_of_episodes[0]:
        np.testing.assert_array_equal(
            root["data"][name][:], np.concatenate([episode_frames[name] for episode_frames in frames_of_episodes])
        )
    assert root["meta/episode_ends"][:].tolist() == [16, 22, 34] and root["meta/success"][:].tolist() == [1.0, 0.0, 1.0]
    np.testing.assert_array_equal(root["meta/tactile/tip/pos"][:], header.links["tip"].pos)
    assert root.attrs["fps"] == 50.0


def test_mcap_reads_every_frame(tmp_path):
    header, episodes = made_up_episodes()
    assert write_mcap(header, episodes, tmp_path) == (3, 34)
    frames_of_episodes = [frames(header, episode) for episode in episodes]
    starts = (0.0, 16 / 50 + 1.0, 22 / 50 + 2.0)
    with (tmp_path / "episodes.mcap").open("rb") as file:
        reader = make_reader(file)
        for name in frames_of_episodes[0]:
            messages = [m for *_, m in reader.iter_messages(topics=[f"/{name.replace('.', '/')}"])]
            assert len(messages) == 34
            for message in messages:
                content = json.loads(message.data)
                value = frames_of_episodes[content["episode"]][name][message.sequence]
                np.testing.assert_array_equal(np.asarray(content["value"], value.dtype), value)
                assert message.log_time == pytest.approx(1e9 * (starts[content["episode"]] + message.sequence / 50), abs=2)
        (tactile,) = reader.iter_metadata()
    assert json.loads(tactile.metadata["links"])["tip"]["pos"] == header.links["tip"].pos.tolist()


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
def test_a_task_and_a_recording_become_datasets(tmp_path, here):
    task, sensors = small_task(tmp_path), tmp_path / "sensors.yaml"
    force = "  push: {kind: kinematic_taxel, links: tip, feels: [item], normal_stiffness: 500}\n"
    sensors.write_text(sensors.read_text() + force)
    options = ("--set", "touch=force", "--set", "episode=0.3 s", "--actions", "random", "--episodes", "3", "--envs", "2")
    code, out, error = here(tmp_path, "export-dataset", task.name, *options, "--out", "frames")
    assert code == 0, error
    dataset = LeRobotDataset("local/task", root=tmp_path / "frames")
    assert dataset.num_episodes == 3 and out.startswith("frames: 3 episodes, ")
    assert bool(dataset[dataset.num_frames - 1]["next.done"])
    code, _, error = here(tmp_path, "run", "sensors.yaml", "--seconds", "0.2", "--num-envs", "2")
    assert code == 0, error
    code, _, error = here(tmp_path, "export-dataset", "out/readings.npz", "--to", "zarr", "--fps", "20", "--out", "run.zarr")
    assert code == 0, error
    ends, run = (
        zarr.open_group(str(tmp_path / "run.zarr"), mode="r")["meta/episode_ends"][:],
        np.load(tmp_path / "out/readings.npz"),
    )
    assert len(ends) == run["qpos"].shape[1] == 2
    code, _, error = here(tmp_path, "export-dataset", "out/readings.npz", "--to", "zarr", "--out", "run.zarr")
    assert code == 2 and "run.zarr: is there already; remove it, or name another folder with --out" in error


def test_a_failed_export_leaves_no_files(tmp_path, here, monkeypatch):
    write_log(tmp_path / "press.npz", random_readings(np.arange(50) * 0.01))
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "zarr", None)
        code, _, error = here(tmp_path, "export-dataset", "press.npz", "--to", "zarr", "--out", "press.zarr")
    assert code == 2 and 'a Zarr store needs zarr: pip install "tgdsl[data]"' in error
    assert [path.name for path in tmp_path.iterdir()] == ["press.npz"]
    code, out, error = here(tmp_path, "export-dataset", "press.npz", "--to", "zarr", "--out", "press.zarr")
    assert code == 0 and "touch in counts on 5 links" in out, error
