"""The Layout: the taxels of a spec on one robot at one resolution. NumPy, float64, one row per taxel.

Shapes: `taxel` rows, sorted by link; every position and direction is in the frame of the taxel's body.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Link:
    """A part of the robot that carries taxels."""

    name: str  # name that the layout gave it: a body's, a geom's or a mesh's
    body: str  # the body whose frame the taxels are in


@dataclass(frozen=True, eq=False)
class Layout:
    """Taxels of all links."""

    links: tuple[Link, ...]  # the links, in the robot's body order
    groups: Mapping[str, tuple[str, ...]]  # names of the links in each link group
    link_id: Int[np.ndarray, " taxel"]  # index into `links` of each taxel; ascending
    pos: Float[np.ndarray, "taxel 3"]  # position in the body frame [m]
    normal: Float[np.ndarray, "taxel 3"]  # outward unit normal in the body frame
    tangent: Float[np.ndarray, "taxel 3"]  # unit tangent in the body frame, perpendicular to the normal
    radius: Float[np.ndarray, " taxel"]  # sensing radius [m]; 0 marks an inactive filler
    area: Float[np.ndarray, " taxel"]  # surface that the taxel stands for [m²]
    cell: Int[np.ndarray, "taxel 2"]  # row and column in the link's grid; −1 where it has none

    @staticmethod
    def of_links(links: tuple[Link, ...], groups: Mapping[str, tuple[str, ...]]) -> Layout:
        """Return the layout of links that carry no taxels, for sensors that have a place on each link."""
        none, link_groups = np.zeros((0, 3)), _groups_of(links, groups)
        no_cells = np.zeros((0, 2), dtype=np.int64)
        return Layout(links, link_groups, np.zeros(0, dtype=np.int64), none, none, none, none[:, 0], none[:, 0], no_cells)

    @property
    def bodies(self) -> tuple[str, ...]:
        """The links' bodies, each once, in order."""
        return tuple(dict.fromkeys(link.body for link in self.links))

    @property
    def body_id(self) -> Int[np.ndarray, " taxel"]:
        """Index into `bodies` of each taxel; ascending."""
        return self.link_body_id[self.link_id]

    @property
    def link_body_id(self) -> Int[np.ndarray, " link"]:
        """Index into `bodies` of each link."""
        return np.array([self.bodies.index(link.body) for link in self.links], dtype=np.int64)

    @property
    def num_taxels(self) -> int:
        """Number of taxels on all links."""
        return len(self.link_id)

    def taxels_of(self, names: tuple[str, ...]) -> Int[np.ndarray, " chosen"]:
        """Return the taxel indices of some links, ascending."""
        is_requested = np.array([link.name in set(names) for link in self.links], dtype=bool)
        return np.flatnonzero(is_requested[self.link_id]).astype(np.int64)

    def take(self, taxels: Int[np.ndarray, " chosen"]) -> Layout:
        """Return the layout of some taxels, with only the links that carry them."""
        used = np.unique(self.link_id[taxels])
        renumbered = np.full(len(self.links), -1, dtype=np.int64)
        renumbered[used] = np.arange(len(used))
        links = tuple(self.links[i] for i in used)
        columns = {name: getattr(self, name)[taxels] for name in ("pos", "normal", "tangent", "radius", "area", "cell")}
        return Layout(links, _groups_of(links, self.groups), renumbered[self.link_id[taxels]], **columns)


def _groups_of(links: Sequence[Link], groups: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    names = {link.name for link in links}
    remaining = {group: tuple(name for name in members if name in names) for group, members in groups.items()}
    return {group: members for group, members in remaining.items() if members}


REASONS = NOT_COLLIDED, BURIED, COVERED = "not collided", "buried", "covered at rest"
"""Why a taxel cannot sense; of several reasons the first counts."""


@dataclass(frozen=True, eq=False)
class Unfelt:
    """Taxels of a link that cannot sense, all for one reason."""

    link: str  # the link
    reason: str  # one of the reasons above
    why: str  # the reason in words
    taxels: Int[np.ndarray, " unfelt"]  # the taxels, by their indices in the layout, ascending
    of: int  # number of taxels of the link

    def __str__(self) -> str:
        return f"{self.link}: {len(self.taxels)} of {self.of} taxels {self.why}"


def by_reason(records: Sequence[Unfelt]) -> str:
    """Return the number of taxels that cannot sense for each reason: "buried 12, covered at rest 3"."""
    counts = {reason: sum(len(record.taxels) for record in records if record.reason == reason) for reason in REASONS}
    return ", ".join(f"{reason} {count}" for reason, count in counts.items() if count)


def unfelt_ids(records: Sequence[Unfelt]) -> Int[np.ndarray, " unfelt"]:
    """Return the indices of the taxels that cannot sense, ascending."""
    return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(record.taxels for record in records)]))
