"""A dataset as a Zarr store: `data/<feature>` (frame, …), `meta/episode_ends`, and `meta/tactile/<link>` with the taxels."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from tgdsl.errors import TgdslError
from tgdsl.rl.datasets.episode import FORCE, Episode, Header, features, numbered_frames

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
