"""A dataset as one MCAP file of JSON messages, which Foxglove and others plot: a topic per feature, `/observation/state`."""

# pyright: reportMissingImports=false

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from tgdsl.errors import TgdslError
from tgdsl.rl.datasets.episode import Episode, Header, features, numbered_frames

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
