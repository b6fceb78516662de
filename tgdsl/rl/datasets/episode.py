"""Episodes with touch, and the frames that a dataset has of them.

A source samples joints and touch at its own rate; a dataset has frames at a fixed one. A frame holds the newest sample at its
time. Where there are several samples in a frame's time, it also holds a window of the newest ones.

Shapes: `step` samples, `frame` frames, `window` samples of a window, `joint` joints, `taxel` taxels of a link, `channel`
components.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
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
    """What all episodes of a dataset have in common."""

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
