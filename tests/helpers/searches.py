"""Probes among objects at random: what tests of the search for the deepest geom are given."""

from functools import partial

import torch

from tgdsl.geometry import planes
from tgdsl.geometry.planes import rot, vec
from tgdsl.quantities.contact_depth import Probes, Target
from tgdsl.quantities.geoms import Geoms
from tgdsl.quantities.pairs import Motion, PairedObject, Pairs

SHAPES = ("plane", "sphere", "capsule", "cylinder", "box")


CASES = {
    # environments, taxels, links, shapes of each object, what differs between environments, is it gated, does reach vary
    "boxes": (3, 50, 1, ["box"] * 4, "nothing", False, False),
    "every shape": (5, 33, 3, [*SHAPES], "nothing", False, False),
    "several geoms": (4, 37, 2, [["box", "sphere", "cylinder"], ["capsule"] * 3, ["box"], ["plane", "box", "box"]], "nothing", True, False),
    "variants": (9, 13, 2, [["box", "box"], ["cylinder", "sphere", "capsule"], ["box"]], "variant", True, True),
    "sized": (6, 21, 1, ["box", ["sphere", "cylinder"]], "size", False, False),
    "one environment": (1, 70, 2, [["box", "capsule"], "sphere"], "variant", True, True),
    "one taxel": (37, 1, 1, ["box", "box"], "nothing", False, True),
    "no environment": (0, 5, 2, [["box", "sphere"]], "variant", True, False),
    "far apart": (23, 40, 2, [["box", "box"], ["sphere", "box"], *["cylinder"] * 4], "nothing", False, False),
}  # fmt: skip


def paired(name, first_pair, num_pairs):
    """Return an object that has so many pairs; what it is in the state does not matter to a search."""
    return PairedObject(name, name, first_pair, num_pairs, 1, False, -1)


def made(case, dtype):
    """Return pairs, probes, the felt targets' indices, the targets and the reach of a case, random but for its shapes."""
    num_envs, num_taxels, num_links, shapes, differs, is_gated, is_noisy = CASES[case]
    rng = torch.Generator().manual_seed(len(case))
    draw = partial(torch.randn, generator=rng, dtype=torch.float64)
    any_of = partial(torch.randint, generator=rng)

    def turns(*shape):
        return planes.rotation(draw(*shape, 4))

    spread = 0.04 if case == "far apart" else 0.02
    targets, first_pair = [], 1  # of a pair before and two after them nobody asks
    for i, own in enumerate(shapes):
        own = [own] if isinstance(own, str) else own
        shape = (num_envs if differs == "variant" and i % 2 == 0 else 1, len(own))
        is_centred = tuple((len(own) == 1 and i % 3 != 1) or g == 1 for g in range(len(own)))
        held = torch.tensor(is_centred)[:, None]
        pos = torch.where(held, 0.0, 0.02 * draw(*shape, 3))
        rotation = torch.where(held, torch.eye(3, dtype=torch.float64).flatten(), torch.stack(turns(*shape), dim=-1))
        size = 0.005 + 0.01 * torch.rand((num_envs if differs == "size" else shape[0], len(own), 3), generator=rng)
        absent = any_of(3, shape) == 0 if shape[0] != 1 else None
        geoms = [part.to(dtype) for part in (size, pos, rotation)]
        alike = (None,) * len(own)
        held = Geoms(tuple(own), is_centred, *geoms, absent, None, alike)
        targets.append(Target(paired(f"{i}", first_pair, num_links), held))
        first_pair += num_links
    num_pairs = first_pair + 2
    rotation = turns(num_envs, num_pairs)
    parts = [*rotation, *(spread * draw(3, num_envs, num_pairs)), *draw(9, num_envs, num_pairs)]
    stacked = torch.stack(list(parts), dim=1).to(dtype)
    stacked[:, :, 0], stacked[:, :, -2:] = torch.nan, torch.nan
    parts = stacked.unbind(1)
    motion = Motion(vec(parts[12:15]), vec(parts[15:18]), vec(parts[18:21]))
    gate = torch.where(any_of(3, (num_envs, num_pairs)) == 0, -torch.inf, 0.0).to(dtype) if is_gated else None
    probes = Probes(vec((0.01 * draw(3, num_taxels)).to(dtype)), any_of(num_links, (len(targets), num_taxels)))
    which = list(range(len(targets)))
    which = which[1:] if len(which) > 3 else which
    radius = 0.004 + 0.001 * draw(*((num_envs,) if is_noisy else ()), num_taxels)
    is_active = any_of(8, (len(which), *([1] if is_noisy else []), num_taxels)) > 0
    reach = torch.where(is_active, radius.abs(), -torch.inf).to(dtype)
    return Pairs(rot(parts[:9]), vec(parts[9:12]), motion, gate), probes, which, targets, reach
