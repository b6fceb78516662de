"""A proposed layout as YAML with comments on its guesses and on the values to edit."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import TgdslError, listed
from tgdsl.fields import units
from tgdsl.files.write import atomic_write, check_writable, with_folder
from tgdsl.formats.model import Model
from tgdsl.placement.propose.propose import FACTORS, Draft, LinkProposal, Proposal, escaped

WIDTH = 120  # lists of names are broken at this column
_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*\Z")
_BRACKETED, _CHARACTER = re.compile(r"\[(.)\]"), r"\1"
_KEYWORDS = {"null", "true", "false", "yes", "no", "on", "off", "y", "n"}
_HEADER = """\
# A layout for {robot}, proposed by `tgdsl layout new`{looked}.
# Density: {density:g} taxels per cm² at `med`, a quarter of that at `low`, four times as much at `high`; at least 1 a link.
# `radius` is the reach of a taxel: neighbours overlap a little. To edit: remove links that need no taxels, move links
# between groups, and give a region (facing, box, sphere, geoms) or `method: grid` where taxels should not be all around.
# A document uses this file by `robot: {{model: ..., layout: THIS FILE}}`, and picks a resolution by `resolution: med`.
"""
_ABOUT = {
    "tips": "guessed: the last links of all chains, and what a single jaw closes on",
    "palm": "guessed: the largest link from which the chains part, and parts of it",
    "fingers": "all links that move against the palm",
    "hand": "the fingers, the palm and links fixed to it",
}
_OPTIONS = {
    "surface": "on the collision geometry: the surface is deeper inside it than taxels reach",
    "exposed": "without the parts that are inside other collision geoms in the initial state",
}
_NOT_COLLIDED = "none of these links collides in the simulator, so their taxels need `gate: geometric`"
_MISREAD = (
    "no hinge of this robot turns by more than 6.28 degrees: its limits look like radians, and its file lacks "
    '`<compiler angle="radian"/>`; inner sides are guessed in radians, but the simulator uses the limits as they stand'
)
_UNSEEN, _CHANGED = ": not checked yet", " and changed by hand; comments mark the guesses"
_NO_PALM = "  # no palm: the chains part from nothing that has a surface, or there is only one chain\n"

USUAL_DENSITY = (100.0, math.inf)  # below one per dm² another unit was most likely meant [1/m²]


def new_draft(
    robot: Model,
    density: str,
    with_groups: bool,
    out: Path,
    is_forced: bool,
    include: Sequence[str] = (),
    progress: Progress = silent,
) -> Draft:
    """Propose a layout for a robot that `write_layout` can write.

    Raises:
        TgdslError: If the density is none, the file is there already or cannot be written, the robot has no link that can carry
            taxels, or a name to include matches none.
    """
    try:
        per_area = units.parse(density, "density")
    except ValueError as error:
        raise TgdslError(f"--density: {error}") from error
    if per_area <= 0:
        raise TgdslError(f"--density: {density} is out of range, expected more than 0")
    if (problem := units.doubt(per_area, "density", *USUAL_DENSITY)) is not None:
        warnings.warn(f"--density {density}: {'; '.join(problem)}", stacklevel=2)
    check_new(out, is_forced)
    return Draft(robot, per_area, with_groups, include, progress)


def check_new(out: Path, is_forced: bool) -> None:
    """Raise `TgdslError` if a layout cannot be written, or may not replace a file."""
    if out.is_file() and not is_forced:
        raise TgdslError(f"{out}: this file is there already; give --force to replace it, or --out for another")
    check_writable(out)


def write_layout(draft: Draft, out: Path) -> list[str]:
    """Write a layout; return what to tell the user."""
    proposal = draft.proposal
    atomic_write(with_folder(out), layout_text(proposal, draft.robot.file.name).encode())
    totals = {r: sum(link.counts[r] for link in proposal.links) for r in FACTORS}
    return [
        f"{len(proposal.links)} links: " + ", ".join(f"{total} taxels at {r}" for r, total in totals.items()),
        *(f"group {name}: {_BRACKETED.sub(_CHARACTER, listed(members))}" for name, members in proposal.groups.items()),
        *(f"left out: {line}" for line in _by_reason(proposal.left_out)),
        *(f"weak guess of the inner side: {line}" for line in _doubts(proposal, has_side=True)),
        *(f"all around: {line}" for line in _doubts(proposal, has_side=False)),
        *(f"{option}: {listed([link.name for link in links])}: {_OPTIONS[key]}" for key, option, links in _options(proposal)),
        *([] if proposal.is_collided else [f"not collided: {_NOT_COLLIDED}"]),
        *([f"limits: {_MISREAD}"] if proposal.is_misread else []),
        f"{out}: comments mark every guess; check them",
    ]


def layout_text(proposal: Proposal, robot: str) -> str:
    """Return the file's text; the same proposal gives the same text."""
    is_changed = proposal.chosen_groups or not all(link.is_guess for link in proposal.links)
    looked = _CHANGED if is_changed else _UNSEEN
    parts = [_HEADER.format(robot=quoted(robot), looked=looked, density=proposal.density * 1e-4)]
    parts += [f"# Left out: {line}\n" for line in _by_reason(proposal.left_out)]
    parts += [] if proposal.is_collided else [f"# Note: {_NOT_COLLIDED}.\n"]
    parts += [f"# Note: {_MISREAD}.\n"] if proposal.is_misread else []
    if proposal.groups and proposal.shared:
        names = ", ".join(map(quoted, proposal.shared))
        parts.append(f"# Note: geoms or meshes of other links are also called {names}; a selection by that name takes both.\n")
    parts += ["tgdsl: 1\n", _groups_text(proposal), "resolutions:\n"]
    for resolution in FACTORS:
        total = sum(link.counts[resolution] for link in proposal.links)
        parts.append(f"  {resolution}:  # {total} taxels\n")
        parts += [_link_text(proposal, link, resolution) for link in proposal.links]
    return "".join(parts)


def _options(proposal: Proposal) -> list[tuple[str, str, list[LinkProposal]]]:
    results = [(key, [link for link in proposal.links if key in link.options]) for key in _OPTIONS]
    return [(key, f"{key}: {_flow(links[0].options[key])}", links) for key, links in results if links]


def _doubts(proposal: Proposal, has_side: bool) -> list[str]:
    return _by_reason(
        [(link.name, link.doubt) for link in proposal.links if link.doubt and (link.facing is not None) == has_side]
    )


def _by_reason(named: Sequence[tuple[str, str]]) -> list[str]:
    reasons = dict.fromkeys(why for _, why in named)
    names = {reason: [quoted(name) for name, why in named if why == reason] for reason in reasons}
    return [f"{', '.join(names[reason])}: {one_line(reason)}" for reason in reasons]


def _groups_text(proposal: Proposal) -> str:
    if not proposal.groups:
        return ""
    lines = ["groups:\n"]
    for name, members in proposal.groups.items():
        about = "" if name in proposal.chosen_groups else f"  # {_ABOUT[name]}\n"
        lines.append(about + _broken(f"  {name}: [", [quoted(member) for member in members]))
        if name == "tips" and not {"palm"} & (proposal.groups.keys() | proposal.chosen_groups):
            lines.append(_NO_PALM)
    if any(member.startswith("[") for members in proposal.groups.values() for member in members):
        lines.append("  # A name such as [p]alm means the link palm, where another group has the same name.\n")
    return "".join(lines)


def _link_text(proposal: Proposal, link: LinkProposal, resolution: str) -> str:
    entry: dict[str, Any] = proposal.placement(link, resolution)
    text = f"    {quoted(escaped(link.name))}: {_flow(entry)}\n"
    if resolution != "med":
        return text
    about = f"{1e4 * link.area:.3g} cm²"
    if link.density != proposal.density:
        about += f", {1e-4 * link.density:g} taxels per cm²"
    if link.is_guess and link.facing is not None:
        about += ", inner side guessed from how the joints close" + (f"; weak: {link.doubt}" if link.doubt else "")
    elif link.is_guess:
        about += f", {link.doubt}: all around"
    notes = [f"    # {about}\n"]
    if link.geoms:
        notes.append(f"    # for taxels on one geom, write its name instead: {listed([quoted(name) for name in link.geoms])}\n")
    notes += [f"    # {_OPTIONS[option]}\n" for option in link.options]
    return "".join(notes) + text


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list):
        return "[" + ", ".join(_flow(item) for item in value) + "]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def quoted(name: str) -> str:
    """Return a name as YAML reads it back: plain if it is a simple word, else in double quotes, on one line."""
    if _PLAIN.match(name) and name.lower() not in _KEYWORDS:
        return name
    text = json.dumps(name, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in text)


def one_line(text: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _broken(start: str, items: Sequence[str]) -> str:
    """Return a flow sequence that is broken before `WIDTH`."""
    lines, line = [], start
    for i, item in enumerate(items):
        piece = item + ("," if i + 1 < len(items) else "]")
        if len(line) + len(piece) > WIDTH and line.strip() and not line.endswith("["):
            lines.append(line.rstrip())
            line = "    "
        line += piece + " "
    return "\n".join([*lines, line.rstrip()]) + "\n"
