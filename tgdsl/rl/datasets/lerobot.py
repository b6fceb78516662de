"""A dataset in the format of LeRobot, version 3.0, written with pyarrow and pandas.

LeRobot's own writer pins torch below 2.11; the format is as lerobot 0.4.4 reads it.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tgdsl.errors import TgdslError
from tgdsl.rl.datasets.episode import Episode, Feature, Header, features, numbered_frames

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
    """Return an episode's statistics over its frames, as LeRobot has them."""
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
