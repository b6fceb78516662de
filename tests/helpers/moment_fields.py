"""Probes in random fields of moments: what tests of the moments are given."""

import torch
from searches import paired

from tgdsl.geometry import planes
from tgdsl.geometry.planes import rot, split, vec
from tgdsl.quantities.moment_sums import MomentField, MomentSource
from tgdsl.quantities.pairs import Pairs

NUM = ((7, 6, 8), (5, 8, 6))


CELL = (0.01, 0.008)


CASES = {
    # environments, taxels, pairs, what a point's field depends on, whether radii vary
    "one field": (3, 100, 1, "nothing", False),
    "one environment": (1, 37, 2, "nothing", False),
    "one taxel of one environment": (1, 1, 1, "nothing", False),
    "no environment": (0, 5, 1, "nothing", False),
    "several links": (29, 13, 4, "nothing", False),
    "radius noise": (5, 41, 2, "nothing", True),
    "by variant": (6, 33, 2, "env", False),
    "by radius": (6, 33, 2, "taxel", True),
    "by both": (6, 33, 2, "both", True),
}


def made(case, dtype, spread=0.03):
    """Return pairs, the probes' places and the source of a case, random but for its shapes: places around and beyond the lattice."""
    num_envs, num_taxels, num_pairs, depends_on, is_noisy = CASES[case]
    rng = torch.Generator().manual_seed(len(case))

    def draw(*shape):
        return torch.randn(shape, generator=rng, dtype=torch.float64)

    quat = draw(num_envs, num_pairs + 1, 4)
    turns = [part[:, 1:] for part in planes.rotation(quat / quat.norm(dim=-1, keepdim=True))]
    pairs = Pairs(
        rot(part.to(dtype) for part in turns),
        split((0.3 * spread * draw(num_envs, num_pairs + 1, 3)[:, 1:]).to(dtype)),
        None,
        None,
    )
    pos = vec((spread * draw(3, num_taxels)).to(dtype))
    pair = torch.randint(num_pairs - (num_pairs > 1), (num_taxels,), generator=rng)  # the last of several has no taxel
    radius = torch.where(torch.arange(num_taxels) % 7 == 3, 0.0, 0.01).to(dtype)
    shift = (0.001 * draw(num_envs, num_taxels)).to(dtype) if is_noisy else None
    field = fields(depends_on, num_envs, num_taxels, 8 if is_noisy else 4, draw, rng, dtype)
    radius = radius if shift is None else torch.where(radius > 0, radius + shift, radius)
    source = MomentSource(paired("can", 1, num_pairs), pair, radius, shift, field, (), torch.ones(1, 1, dtype=dtype))
    padded = Pairs(
        *(tuple(torch.nn.functional.pad(part, (1, 2), value=torch.nan) for part in own) for own in pairs[:2]), None, None
    )
    return padded, pos, source


def fields(depends_on, num_envs, num_taxels, num_channels, draw, rng, dtype) -> MomentField:
    """Return fields that are random inside and zero on the rim."""
    values = []
    for num in NUM:
        inner = draw(*(n - 2 for n in num), num_channels)
        values.append(torch.nn.functional.pad(inner, (0, 0, 1, 1, 1, 1, 1, 1)).reshape(-1, num_channels))
    origin = torch.tensor([[-0.03, -0.02, -0.04], [-0.02, -0.03, -0.025]], dtype=dtype)
    cell = torch.tensor(CELL, dtype=dtype)
    table = torch.cat(values).to(dtype)
    if depends_on == "nothing":
        return MomentField(table[: len(values[0])], 0, NUM[0], split(origin[0]), cell[0])
    shape = {"env": (num_envs, 1), "taxel": (num_taxels,), "both": (num_envs, num_taxels)}[depends_on]
    which = torch.randint(2, shape, generator=rng)
    counts = torch.tensor(NUM)[which]
    return MomentField(table, torch.tensor([0, len(values[0])])[which], split(counts), split(origin[which]), cell[which])
