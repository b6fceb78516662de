"""Random contacts of links with objects: of some pairs none, of others one to all slots, in one plane as a solver has them."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from tgdsl.quantities.patch import Contacts, Sides

NUM_ENVS = 37


class Case(NamedTuple):
    """What there is: slots, bodies, objects, and whether some of these never meet."""

    slots: int = 4
    bodies: int = 3
    objects: int = 2
    are_all: bool = True


CASES = {
    "four slots": Case(),
    "one object": Case(objects=1, bodies=5),
    "some never meet": Case(are_all=False),
    "three slots": Case(slots=3),
    "one slot": Case(slots=1),
    "two slots": Case(slots=2),
    "eight slots": Case(slots=8),
}


def arguments(name: str, dtype: torch.dtype, num_envs: int = NUM_ENVS) -> tuple:
    """Return the arguments of `patch`."""
    case, rng = CASES[name], np.random.default_rng(5)
    num = case.bodies * case.objects
    pairs = rng.permutation(num + 1)[:num].reshape(case.bodies, case.objects)  # one pair is of another sensor
    if not case.are_all:
        pairs.flat[::3] = num + 1
    shape = (num_envs, num + 1, case.slots)
    centre, axis = rng.normal(size=(*shape[:2], 1, 3)), rng.normal(size=(*shape[:2], 1, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    apart = 0.01 * rng.normal(size=(*shape, 3))
    pos = centre + apart - np.sum(apart * axis, axis=-1, keepdims=True) * axis
    is_used = np.arange(case.slots) < rng.integers(0, case.slots + 1, shape[:2])[..., None]
    normal = axis + 0.1 * rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    if case.slots > 1:
        normal[0, :, 1] = -normal[0, :, 0]  # a pinch, whose normals cancel
        is_used[0], is_used[0, :, 2:] = True, False
        pos[1, :, 1], is_used[1] = pos[1, :, 0], True  # one point twice
    force = rng.uniform(0.5, 2.0, (*shape, 1)) * normal + 0.2 * rng.normal(size=(*shape, 3))
    if case.slots > 1:
        force[0, :, 1] = -force[0, :, 0]
    force[2] *= -1.0  # they pull, and do not count
    force[3] = 0.0  # the solver tells the whole force alone
    torque = 0.01 * rng.normal(size=(*shape, 3))
    whole = (force * is_used[..., None]).sum(axis=2) + 0.1 * rng.normal(size=(*shape[:2], 3)) * is_used.any(axis=2)[..., None]
    whole[0] = (force * is_used[..., None]).sum(axis=2)[0]
    pos[4, :, 0] += np.where(is_used[4, :, :1], 0.0, np.nan)  # unused slots hold arbitrary numbers
    quat = rng.normal(size=(num_envs, case.bodies + 1, 4))
    bodies = rng.permutation(case.bodies + 1)[: case.bodies]

    def tensor(value: np.ndarray) -> Tensor:
        return torch.as_tensor(value.astype(np.float32)).to(dtype)

    fields = [tensor(np.where(is_used[..., None], part, 0.0)) for part in (force, torque, normal)]
    places = [tensor(part) for part in (pos, whole, rng.normal(size=(num_envs, case.bodies + 1, 3)), quat)]
    sides = Sides(torch.from_numpy(bodies), torch.from_numpy(pairs), case.are_all)
    return Contacts(*fields, *places), sides, dtype
