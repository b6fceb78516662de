"""Anchors: the material point of an object that each taxel sticks to, and its tangential displacement since.

A taxel i takes an anchor e_i, the object's material point at the taxel, in the object's frame, when the deepest object is
deeper than `enter`; it is released when that object is farther than `exit` above the skin, or its gate closes. One object
at a time holds an anchor: the deepest one at that instant, the first among equals. In the link's frame the displacement is

    s_i = R_oᵀ (e_i − c_o) − x_i,        t_i = Π_ni(s_i)                                      [m]

R_o, c_o how the object sees the link (`geoms.distance.Frame`), x_i the taxel's place. With a friction cap, |t_i| ≤ `slip` h_i:
beyond it the skin slides, t_i is scaled back, and the anchor is dragged along by as much.

Shapes: planes (env, taxel); in `reference`, (taxel,) and (taxel, 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.geometry.reference import TIE
from tgdsl.quantities.contact_depth import Penetration, ReferencePenetration

PLANES = ("anchor_x", "anchor_y", "anchor_z", "object")  # state: e_i [m], and the number of its object from 1, 0 for none


class StickSlip(NamedTuple):
    """Stick and slip of a contact: when it gets an anchor, loses it, and slides; numbers, or scalar tensors."""

    standoff: float | Tensor  # s, height of the undeformed skin above the taxels [m]
    enter: float | Tensor  # depth from which a contact sticks [m]
    exit: float | Tensor  # distance above the skin at which the anchor is released [m]
    slip: float | Tensor | None  # largest tangential displacement per depth [1]; None: it never slides


def advance(
    touch: Penetration, pos: Vec, normal: Vec, stick_slip: StickSlip, state: Mapping[str, Tensor]
) -> tuple[Vec, dict[str, Tensor]]:
    """Return the tangential displacements t [m] and the new anchors."""
    anchor, held_by = (state["anchor_x"], state["anchor_y"], state["anchor_z"]), state["object"]
    zero = torch.zeros_like(touch.depth)
    moved, holds = (zero, zero, zero), []
    for k, (name, distance) in enumerate(touch.distances.items(), start=1):
        frame = touch.frames[name]
        holds.append((held_by == k) & ~(distance.value > stick_slip.standoff + stick_slip.exit))
        here = planes.rotate_back(frame.rotation, planes.sub(anchor, frame.offset))
        moved = planes.where(holds[-1], planes.sub(here, pos), moved)
    stretch = planes.sub(moved, planes.scale(planes.dot(moved, normal), normal))
    tangential, slides = (stretch, None) if stick_slip.slip is None else capped(stretch, stick_slip.slip * touch.depth)
    slid = planes.sub(tangential, stretch)
    is_free = ~torch.stack(holds).any(dim=0)
    taken, holder, deepest = (zero, zero, zero), zero, zero + stick_slip.enter
    for k, ((name, distance), is_held) in enumerate(zip(touch.distances.items(), holds, strict=True), start=1):
        rotation, offset = touch.frames[name]
        dragged = anchor
        if slides is not None:
            dragged = planes.where(slides, planes.add(anchor, planes.rotate(rotation, slid)), anchor)
        depth = stick_slip.standoff - distance.value
        is_taken = is_free & (depth > torch.where(holder > 0, deepest + planes.tie(), deepest))
        taken = planes.where(is_held, dragged, planes.where(is_taken, planes.add(planes.rotate(rotation, pos), offset), taken))
        holder = torch.where(is_held | is_taken, float(k), holder)
        deepest = torch.maximum(deepest, depth)
    return tangential, dict(zip(PLANES, (*taken, holder), strict=True))


def capped(stretch: Vec, limit: Tensor) -> tuple[Vec, Tensor]:
    """Return a vector scaled back to a length, and where it had to be; derivatives are finite everywhere."""
    square = planes.dot(stretch, stretch)
    slides = square > torch.clamp(limit * limit, min=planes.tiny())
    factor = torch.where(slides, limit / torch.sqrt(torch.where(slides, square, 1.0)), 1.0)
    return planes.scale(factor, stretch), slides


def advance_reference(
    touch: ReferencePenetration, pos: np.ndarray, normal: np.ndarray, stick_slip: StickSlip, state: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return t (taxel, 3) [m] and the new anchors of one environment, taxel by taxel."""
    result = np.zeros((len(pos), 3))
    after = {name: np.zeros(len(pos)) for name in PLANES}
    for i, (x, n) in enumerate(zip(pos, normal, strict=True)):
        phi, rotation, offset = touch.distance[i], touch.rotation[i], touch.offset[i]
        k = int(state["object"][i]) - 1
        e = np.array([state[name][i] for name in PLANES[:3]])
        if k >= 0 and not phi[k] > stick_slip.standoff + stick_slip.exit:
            s = rotation[k].T @ (e - offset[k]) - x
            t = result[i] = s - (s @ n) * n
            length = float(np.linalg.norm(t))
            if stick_slip.slip is not None and length > stick_slip.slip * touch.depth[i] and length**2 > planes.tiny():
                result[i] = t * (stick_slip.slip * touch.depth[i] / length)
                e = e + rotation[k] @ (result[i] - t)
        else:
            k = _deepest(stick_slip.standoff - phi, float(stick_slip.enter))
            e = rotation[k] @ x + offset[k] if k >= 0 else np.zeros(3)
        for name, value in zip(PLANES, (*e, k + 1), strict=True):
            after[name][i] = value
    return result, after


def _deepest(depth: np.ndarray, enter: float) -> int:
    """Return the deepest object, the first among equals; −1 if none is deeper than `enter`."""
    best, most = -1, enter
    for k, d in enumerate(depth):
        if d > (most + TIE if best >= 0 else most):
            best = k
        most = max(most, d)
    return best
