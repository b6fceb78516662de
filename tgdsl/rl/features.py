"""Descriptions of the groups of observations that tasks share, which `groups` computes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from tgdsl.console.tables import TaxelTable

GoalPart = Literal["orientation", "difference", "angle"]  # parts of an observed goal, an orientation
AXES = ("x", "y", "z")
COLUMNS = ("xx", "xy", "xz", "yx", "yy", "yz")
"""Components of the first two columns of a rotation's matrix, that is of the turned x axis and y axis."""


@dataclass(frozen=True)
class Features:
    """Adjacent features of one kind."""

    name: str  # name of the quantity; of a vector, its components in order: `force_x, force_y, force_z`
    size: int  # how many there are
    unit: str = "1"  # unit of the quantity, before it is scaled; "1" if it has none
    frame: str = ""  # axes of a vector's components: `world`, or `link`, the frame of the link; empty without a direction
    link: str = ""  # the body; empty if there is none
    scale: float = 1.0  # factor from the quantity to the features
    rows: range = range(0)  # rows of `env.touch.rows[sensor]`, one feature each: taxels or probes; else empty
    sensor: str = ""  # the reading; empty if there is none
    note: str = ""  # where the reading is cut off


def vector(name: str, unit: str, link: str = "", frame: str = "world") -> Features:
    """Return the components of a vector."""
    return Features(", ".join(f"{name}_{axis}" for axis in AXES), 3, unit, frame, link)


def orientation(name: str, link: str = "") -> Features:
    """Return the six numbers of an orientation: the turned x axis, then the turned y axis, in world axes."""
    return Features(", ".join(f"{name}_{part}" for part in COLUMNS), 6, "1", "world", link)


def object_state(body: str) -> list[Features]:
    """Describe `groups.object_state`."""
    return [
        vector("position", "m", body),
        orientation("orientation", body),
        vector("velocity", "m/s", body),
        vector("angular_velocity", "rad/s", body),
    ]


def distances(sensor: str, table: TaxelTable) -> list[Features]:
    """Describe `Now.distance`, less than 0 inside the object; sensor and table are those of `Setup.rows`."""
    links = table["link"].tolist()
    return [
        Features("distance", len(rows), "m", "", link, 1.0, rows, sensor) for link, rows in runs_of(links, range(len(links)))
    ]


def object_props(body: str, probes: tuple[str, TaxelTable] | None = None) -> list[Features]:
    """Describe `groups.object_props`; without `probes`, a row of `Setup.rows`, friction and mass alone."""
    props = [Features("friction", 1, "1", "", body), Features("mass", 1, "kg", "", body)]
    return props + (distances(*probes) if probes else [])


def link_forces(links: Sequence[str]) -> list[Features]:
    """Describe `Now.link_force`, the object's force on each link."""
    return [vector("force", "N", link, "link") for link in links]


def goal(parts: Sequence[GoalPart], body: str) -> list[Features]:
    """Describe `groups.goal`."""
    known = {
        "orientation": orientation("goal", body),
        "difference": orientation("goal_from_object", body),
        "angle": Features("angle_to_goal", 1, "rad", "", body),
    }
    return [known[part] for part in parts]


def runs_of(links: Sequence[str], rows: Sequence[int]) -> list[tuple[str, range]]:
    """Return rows that follow one another and are of one link."""
    runs: list[tuple[str, range]] = []
    for row in rows:
        if runs and runs[-1][0] == links[row] and runs[-1][1].stop == row:
            runs[-1] = (links[row], range(runs[-1][1].start, row + 1))
        else:
            runs.append((links[row], range(row, row + 1)))
    return runs
