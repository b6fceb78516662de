"""Datasets of episodes with touch: their frames, and files for LeRobot 3.0, MCAP and Zarr.

A source samples joints and touch at its own rate; a dataset has frames at a fixed one. A frame holds the newest sample at its
time. Where there are several samples in a frame's time, it also holds a window of the newest ones.

LeRobot's own writer pins torch below 2.11; the format is as lerobot 0.4.4 reads it. An MCAP file has JSON messages, a topic per
feature. A Zarr store has `data/<feature>` (frame, …), `meta/episode_ends`, and `meta/tactile/<link>` with the taxels. Each
writer takes an empty folder and returns the numbers of episodes and frames.

Shapes: `step` samples, `frame` frames, `window` samples of a window, `joint` joints, `taxel` taxels of a link, `channel`
components.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from tgdsl.errors import TgdslError

FORCE = ("force_x", "force_y", "force_z")  # the components of touch, in the frame of the taxels' body
TOUCH = "observation.tactile"
EPS = 1e-6  # share of a frame by which a sample may be late


@dataclass(frozen=True, eq=False)
class LinkTaxels:
    """The taxels of a link. A hand that reports only the sum of a fingertip's forces has one, at an unknown place."""

    body: str  # the link's body
    pos: Float[np.ndarray, "taxel 3"] | None = None  # positions in the body's frame [m]
    normal: Float[np.ndarray, "taxel 3"] | None = None  # outward normals in the body's frame

    @property
    def num_taxels(self) -> int:
        """Number of taxels."""
        return 1 if self.pos is None else len(self.pos)


@dataclass(frozen=True, eq=False)
class Header:
    """Properties that all episodes of a dataset share."""

    name: str  # the document, task or log
    task: str  # the task in words
    joints: tuple[str, ...]  # names of the joints
    links: Mapping[str, LinkTaxels]  # taxels by link
    unit: str  # unit of touch
    control_step: float  # time between samples, of a log its median [s]
    fps: float  # frames per second
    has_outcome: bool = False  # whether there are rewards and success
    has_policy: bool = False  # whether a policy acts

    @property
    def window(self) -> int:
        """Samples of touch per frame."""
        return max(1, round(1.0 / (self.fps * self.control_step)))

    def describe(self) -> dict[str, Any]:
        """Return unit, channels and window of touch, and the taxels of each link, as values for JSON."""
        links = {
            name: {
                "body": link.body,
                "pos": None if link.pos is None else link.pos.tolist(),
                "normal": None if link.normal is None else link.normal.tolist(),
            }
            for name, link in self.links.items()
        }
        touch = {"source": self.name, "unit": self.unit, "channels": list(FORCE), "frame": "body"}
        return touch | {"window": self.window, "sample_step": self.control_step, "links": links}


@dataclass(frozen=True, eq=False)
class Episode:
    """The samples of one episode."""

    time: Float[np.ndarray, " step"]  # time of each sample [s]
    state: Float[np.ndarray, "step joint"]  # joint positions [rad]
    action: Float[np.ndarray, "step joint"]  # set-points of the joints [rad]
    # touch by link, in the header's unit and the frame of the taxels' body
    touch: Mapping[str, Float[np.ndarray, "step taxel channel"]]
    policy_action: Float[np.ndarray, "step joint"] | None = None  # the policy's actions, from −1 to 1
    reward: Float[np.ndarray, " step"] | None = None  # reward of the step that follows each sample
    score: float | None = None  # score of the episode
    is_success: bool | None = None  # whether it succeeded


@dataclass(frozen=True)
class Feature:
    """A column of a dataset."""

    dtype: str  # its dtype
    shape: tuple[int, ...]  # shape of a frame's value
    names: tuple[str, ...] | None = None  # names of its numbers, or of its axes if it has several


def features(header: Header) -> dict[str, Feature]:
    """Return the columns of a dataset's frames."""
    joints, window = header.joints, header.window
    num_taxels = {name: link.num_taxels for name, link in header.links.items()}
    vector = Feature("float32", (len(joints),), joints)
    result = {"observation.state": vector, "action": vector}
    flat = tuple(f"{link}/{i}/{name}" for link, num in num_taxels.items() for i in range(num) for name in FORCE)
    result[TOUCH] = Feature("float32", (len(flat),), flat)
    for link, num in num_taxels.items():
        result[f"{TOUCH}.{link}"] = Feature("float32", (num, len(FORCE)), ("taxel", "channel"))
        if window > 1:
            shape = (window, num, len(FORCE))
            result[f"{TOUCH}_window.{link}"] = Feature("float32", shape, ("sample", "taxel", "channel"))
    if window > 1:
        result[f"{TOUCH}_window_time"] = Feature("float32", (window,))
    result |= {"policy_action": vector} if header.has_policy else {}
    if header.has_outcome:
        result |= {"next.reward": Feature("float32", (1,)), "next.success": Feature("bool", (1,))}
    return result | {"next.done": Feature("bool", (1,))}


def frames(header: Header, episode: Episode) -> dict[str, np.ndarray]:
    """Return an episode's frames by the names of `features`, (frame, …); a feature of shape (1,) has (frame,).

    A frame's reward is the sum over its time.
    """
    time = episode.time - episode.time[0]
    ticks = np.arange(int(np.floor(time[-1] * header.fps + EPS)) + 1)
    newest: Int[np.ndarray, " frame"] = np.searchsorted(time, (ticks + EPS) / header.fps, side="right") - 1
    back = np.arange(header.window)[::-1]
    past = np.maximum(newest[:, None] - back, 0)
    result = {"observation.state": episode.state[newest], "action": episode.action[newest]}
    result[TOUCH] = np.concatenate([touch[newest].reshape(len(newest), -1) for touch in episode.touch.values()], axis=1)
    for link, touch in episode.touch.items():
        result[f"{TOUCH}.{link}"] = touch[newest]
        if header.window > 1:
            result[f"{TOUCH}_window.{link}"] = touch[past]
    if header.window > 1:
        result[f"{TOUCH}_window_time"] = time[past] - (ticks / header.fps)[:, None]
    is_last = ticks == ticks[-1]
    if episode.policy_action is not None:
        result["policy_action"] = episode.policy_action[newest]
    if episode.reward is not None:
        result["next.reward"] = np.add.reduceat(episode.reward, newest)
        result["next.success"] = is_last & bool(episode.is_success)
    result["next.done"] = is_last
    result = {name: value if value.dtype == bool else value.astype(np.float32) for name, value in result.items()}
    return {name: value.ravel() if value.shape[1:] == (1,) else value for name, value in result.items()}


def numbered_frames(header: Header, episodes: Iterable[Episode]) -> Iterator[tuple[int, Episode, dict[str, np.ndarray]]]:
    """Yield each episode's number, from 0, itself and its frames."""
    number = -1
    for number, episode in enumerate(episodes):
        yield number, episode, frames(header, episode)
    if number < 0:
        raise TgdslError(f"{header.name}: there is no episode to write")


FILE_MB = 100
PATHS = {name: name + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet" for name in ("data", "meta/episodes")}
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
INDICES = {name: Feature("int64", (1,)) for name in ("frame_index", "episode_index", "index", "task_index")}


def write_lerobot(header: Header, episodes: Iterable[Episode], folder: Path) -> tuple[int, int]:
    """Write a dataset into an empty folder; return the numbers of episodes and frames."""
    try:
        import pandas
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        raise TgdslError(f'a dataset of LeRobot needs pyarrow and pandas: pip install "tgdsl[data]" ({error})') from error
    columns = features(header) | {"timestamp": Feature("float32", (1,)), **INDICES}
    rows: list[dict[str, Any]] = []
    stats: list[dict[str, dict[str, np.ndarray]]] = []
    writer, file, size, total = None, 0, 0, 0
    for number, episode, values in numbered_frames(header, episodes):
        num = len(values["action"])
        indices = np.arange(num)
        values |= {"timestamp": (indices / header.fps).astype(np.float32), "frame_index": indices, "index": total + indices}
        values |= {"episode_index": np.full(num, number), "task_index": np.zeros(num, int)}
        table = pa.table({name: _array(pa, values[name]) for name in columns})
        if writer is None or size > FILE_MB * 2**20:
            file, size = file + (writer is not None), 0
            if writer is not None:
                writer.close()
            path = folder / PATHS["data"].format(chunk_index=file // 1000, file_index=file % 1000)
            path.parent.mkdir(parents=True, exist_ok=True)
            writer = pq.ParquetWriter(path, table.schema)
        writer.write_table(table)
        size += sum(value.nbytes for value in values.values())
        stats.append({name: _statistics(values[name]) for name in columns})
        place = {"data/chunk_index": file // 1000, "data/file_index": file % 1000}
        row = {"episode_index": number, "tasks": [header.task], "length": num, **place}
        row |= {"dataset_from_index": total, "dataset_to_index": total + num}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        row |= {} if episode.score is None else {"score": episode.score, "success": episode.is_success}
        rows.append(row | {f"stats/{name}/{key}": s.tolist() for name, parts in stats[-1].items() for key, s in parts.items()})
        total += num
    assert writer is not None
    writer.close()
    path = folder / PATHS["meta/episodes"].format(chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), path)
    pandas.DataFrame({"task_index": [0]}, index=pandas.Index([header.task])).to_parquet(folder / "meta/tasks.parquet")
    described = {name: {"dtype": f.dtype, "shape": list(f.shape), "names": f.names} for name, f in columns.items()}
    info = {
        "codebase_version": "v3.0",
        "robot_type": None,
        "total_episodes": len(rows),
        "total_frames": total,
        "total_tasks": 1,
    }
    info |= {"chunks_size": 1000, "data_files_size_in_mb": FILE_MB, "video_files_size_in_mb": 200}
    info |= {"fps": int(header.fps) if header.fps.is_integer() else header.fps, "splits": {"train": f"0:{len(rows)}"}}
    info |= {"data_path": PATHS["data"], "video_path": None, "features": described}
    joined = {
        name: {key: s.tolist() for key, s in _joined([episode_stats[name] for episode_stats in stats]).items()}
        for name in columns
    }
    for name, value in {"info": info, "stats": joined, "tactile": header.describe()}.items():
        (folder / "meta" / f"{name}.json").write_text(json.dumps(value, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return len(rows), total


def _array(pa: Any, values: np.ndarray) -> Any:
    result = pa.array(values.ravel())
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(result, values.shape[1])
    for size in values.shape[:0:-1]:
        result = pa.ListArray.from_arrays(np.arange(0, len(result) + 1, size, dtype=np.int32), result)
    return result


def _statistics(values: np.ndarray) -> dict[str, np.ndarray]:
    keep, values = values.ndim == 1, values.astype(np.float64)
    result = {name: getattr(values, name)(axis=0, keepdims=keep) for name in ("min", "max", "mean", "std")}
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0, keepdims=keep)
    return result | {"count": np.array([len(values)])} | dict(zip(QUANTILES, quantiles, strict=True))


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Return the statistics of all episodes; of quantiles, as LeRobot does, the means."""
    count = np.array([part["count"][0] for part in parts], dtype=np.float64)
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0] if name != "count"}
    result = {name: np.tensordot(count / count.sum(), stacked[name], 1) for name in ("mean", *QUANTILES)}
    variance = np.tensordot(count / count.sum(), stacked["std"] ** 2 + (stacked["mean"] - result["mean"]) ** 2, 1)
    ends = {"min": stacked["min"].min(axis=0), "max": stacked["max"].max(axis=0)}
    return result | ends | {"std": np.sqrt(variance), "count": np.array([int(count.sum())])}


FILE = "episodes.mcap"
SECOND = 1_000_000_000


def write_mcap(header: Header, episodes: Iterable[Episode], folder: Path) -> tuple[int, int]:
    """Write `episodes.mcap` into a folder; return the numbers of episodes and frames.

    A message is `{"episode": …, "value": …}`; the next episode begins a second after the last frame of the one before. The
    names of a topic's numbers stand in its channel's metadata, and what touch is in the file's metadata `tactile`.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise TgdslError(f'an MCAP file needs mcap: pip install "tgdsl[data]" ({error})') from error
    schema = {"type": "object", "properties": {"episode": {"type": "integer"}, "value": {}}}
    channels: dict[str, int] = {}
    number, total, start = 0, 0, 0
    with (folder / FILE).open("wb") as file:
        writer = Writer(file)
        writer.start()
        kind = writer.register_schema("tgdsl.Feature", "jsonschema", json.dumps(schema).encode())
        for name, feature in features(header).items():
            metadata = {"names": json.dumps(feature.names), "shape": json.dumps(feature.shape)}
            channels[name] = writer.register_channel(f"/{name.replace('.', '/')}", "json", kind, metadata)
        for number, _, values in numbered_frames(header, episodes):
            for frame in range(len(values["action"])):
                time = start + round(frame * SECOND / header.fps)
                for name, channel in channels.items():
                    message = json.dumps({"episode": number, "value": values[name][frame].tolist()}).encode()
                    writer.add_message(channel, time, message, time, frame)
            total += len(values["action"])
            start += round(len(values["action"]) * SECOND / header.fps) + SECOND
        writer.add_metadata("tactile", {name: json.dumps(value) for name, value in header.describe().items()})
        writer.finish()
    return number + 1, total


CHUNK_BYTES = 2**20


def write_zarr(header: Header, episodes: Iterable[Episode], folder: Path) -> tuple[int, int]:
    """Write a dataset into an empty folder; return the numbers of episodes and frames."""
    try:
        import zarr
    except ImportError as error:
        raise TgdslError(f'a Zarr store needs zarr: pip install "tgdsl[data]" ({error})') from error
    root = zarr.open_group(str(folder), mode="w", zarr_format=2)
    data, meta = root.create_group("data"), root.create_group("meta")
    arrays, ends = {}, list[int]()
    outcome: dict[str, list[float]] = {"score": [], "success": []}
    for name, feature in features(header).items():
        shape = () if feature.shape == (1,) else feature.shape
        rows = max(1, CHUNK_BYTES // (4 * int(np.prod(shape))))
        arrays[name] = data.create_array(name, shape=(0, *shape), chunks=(rows, *shape), dtype=feature.dtype)
        arrays[name].attrs["names"] = feature.names
    for _, episode, values in numbered_frames(header, episodes):
        for name, array in arrays.items():
            array.append(values[name])
        ends.append(len(values["action"]) + (ends[-1] if ends else 0))
        for name, value in (("score", episode.score), ("success", episode.is_success)):
            outcome[name] += [] if value is None else [float(value)]
    numbers = {"episode_ends": np.array(ends), **{name: np.array(value) for name, value in outcome.items() if value}}
    for name, value in numbers.items():
        meta.create_array(name, data=value)
    tactile = meta.create_group("tactile")
    tactile.attrs.update({"unit": header.unit, "channels": list(FORCE), "sample_step": header.control_step})
    for name, link in header.links.items():
        group = tactile.create_group(name)
        group.attrs["body"] = link.body
        for column, value in (("pos", link.pos), ("normal", link.normal)):
            if value is not None:
                group.create_array(column, data=value)
    root.attrs.update({"fps": header.fps, "task": header.task, "source": header.name, "window": header.window})
    return len(ends), ends[-1]
