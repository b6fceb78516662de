"""By how much more or less than by its gain each mode is struck, from where a contact is and which way it presses.

    s_i = Σ_k w_k φ_i(node k) · n,   or √(Σ_f (…)²) over the fields f of modes that symmetry makes one

with the eight nodes around the centre of a pair's contacts on the grid of the body's mode shapes, trilinear weights w, and the
mean normal n of the contacts, weighted by their forces, into the body. Both are in the body's frame; mode shapes φ are over the
root mean square of what is normal to the surface, so that s² is 1 in the mean over it. Beyond the grid's box φ is that of its
nearest point.

Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `row` those of them that ring, `node`
nodes of all grids, `mode` modes of the row with most, `field` fields of the row with most.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.modal.modes import ModeShapes
from tgdsl.sensors.base import Constants


def tables(shapes: Sequence[ModeShapes], num_modes: int) -> dict[str, np.ndarray]:
    """Return the grids of all rows as constants; grids that are equal are one.

    Args:
        shapes: Mode shapes of each row.
        num_modes: Modes of the row with most.
    """
    most = max(own.value.shape[2] for own in shapes)
    kept: dict[bytes, int] = {}
    blocks: list[np.ndarray] = []
    first, owner = np.zeros(len(shapes), np.int64), np.zeros((len(shapes), most, num_modes))
    for row, own in enumerate(shapes):
        value = np.zeros((len(own.value), 3, most), np.float32)
        value[:, :, : own.value.shape[2]] = own.value
        key = value.tobytes()
        if key not in kept:
            kept[key] = sum(map(len, blocks))
            blocks.append(value.reshape(len(value), -1))
        first[row] = kept[key]
        owner[row, np.arange(len(own.owner)), own.owner] = 1.0
    result = {
        "shape_value": np.concatenate(blocks),
        "shape_first": first,
        "shape_num": np.stack([own.num for own in shapes]),
        "shape_axes": np.stack([own.axes for own in shapes]),
        "shape_low": np.stack([own.low for own in shapes]),
        "shape_rate": np.stack([1.0 / own.step for own in shapes]),
    }
    # Without any that are one, field i is mode i.
    return result if (owner.sum(axis=1) <= 1).all() else result | {"shape_owner": owner}


def shares(center: Vec, along: Vec, constants: Constants) -> Float[Tensor, "env body object mode"]:
    """Return the share of each mode of what rings; 0 where nothing touches, as `along` is 0 there.

    Args:
        center: Centre of the contacts, (env, body, object), in the frame of what rings [m].
        along: Their mean normal.
        constants: The sensor's.
    """
    dim = 0 if "is_of_object" in constants else 1
    first, num, axes, low, rate = (
        constants[f"shape_{name}"].unsqueeze(dim) for name in ("first", "num", "axes", "low", "rate")
    )
    rotation = planes.rot(axes[..., i, j] for i in range(3) for j in range(3))
    pos, turned = planes.rotate(rotation, center), planes.rotate(rotation, along)
    node, weights, last = first, [], num - 1
    for i, part in enumerate(pos):
        at = torch.minimum(((part - low[..., i]) * rate[..., i]).clamp(min=0.0), last[..., i].to(part.dtype))
        cell = torch.minimum(at.to(torch.int64).clamp(min=0), last[..., i] - 1)  # not-a-number is some cell
        weights.append((1.0 - (at - cell), at - cell))
        stride = num[..., 2] * num[..., 1] if i == 0 else num[..., 2] if i == 1 else 1
        node = node + cell * stride
    found = None
    for x, y, z in product(range(2), repeat=3):
        corner = constants["shape_value"][node + (x * num[..., 1] + y) * num[..., 2] + z]
        part = (weights[0][x] * weights[1][y] * weights[2][z])[..., None] * corner
        found = part if found is None else found + part
    assert found is not None
    fields = sum(n[..., None] * own for n, own in zip(turned, found.chunk(3, dim=-1), strict=True))
    assert isinstance(fields, Tensor)
    return _of_modes(fields, constants["shape_owner"].unsqueeze(dim)) if "shape_owner" in constants else fields


def _of_modes(fields: Tensor, owner: Tensor) -> Tensor:
    own = fields[..., None] * owner
    return torch.where(owner.sum(dim=-2) > 1, planes.safe_sqrt((own * own).sum(dim=-2)), own.sum(dim=-2))
