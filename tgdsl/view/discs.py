"""Taxels of a layout as discs: where they lie in the world, how large they are drawn, and the link groups that colour them.

Shapes: `taxel` taxels of one layout, `corner` corners of a disc.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from tgdsl.layout.layout import Layout
from tgdsl.view.taxels import Taxels

Array = np.ndarray
_RADIUS = (0.0006, 0.0022)  # least and largest radius of a disc [m]


def radii(layout: Layout, pos: Float[Array, "taxel 3"]) -> Float[Array, " taxel"]:
    """Return the radius of each disc [m]: the same on a link, and small enough to leave room between neighbours."""
    radius = np.full(len(pos), _RADIUS[1])
    for link in range(len(layout.links)):
        own = np.flatnonzero(layout.link_id == link)
        if len(own) > 1:
            apart = KDTree(pos[own]).query(pos[own], k=2)[0][:, 1]
            radius[own] = np.clip(0.44 * np.median(apart), *_RADIUS)
    return radius


def discs(taxels: Taxels, radius: Float[Array, " taxel"]) -> Float[Array, "taxel corner 3"]:
    """Return discs about the taxels, in their tangent planes."""
    least = np.eye(3)[np.abs(taxels.normal).argmin(axis=1)]
    first = np.cross(taxels.normal, least)
    first *= (radius / np.linalg.norm(first, axis=1))[:, None]
    second = np.cross(taxels.normal, first)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)[:, None]
    return taxels.pos[:, None] + np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]


def group_of(layout: Layout) -> list[str]:
    """Return the group that each link is coloured by: the one of fewest links that it is in; empty if it is in none."""

    def smallest(link: str) -> str:
        own = [group for group, members in layout.groups.items() if link in members]
        return min(own, key=lambda group: (len(layout.groups[group]), group), default="")

    return [smallest(link.name) for link in layout.links]


def legend(layout: Layout) -> dict[str, int]:
    """Return the label of each group that colours any link, in the links' order, and how many taxels have its colour.

    A group some of whose links have the colour of a smaller one is called `other`.
    """
    chosen = group_of(layout)
    active = np.bincount(layout.link_id[layout.radius > 0], minlength=len(layout.links))
    counts: dict[str, int] = {}
    for group in dict.fromkeys(chosen):
        is_whole = chosen.count(group) == len(layout.groups.get(group, ()))
        nobody = "no group" if layout.groups else "taxels"
        label = nobody if not group else group if is_whole else f"other {group}"
        counts[label] = int(sum(active[i] for i, own in enumerate(chosen) if own == group))
    return counts
