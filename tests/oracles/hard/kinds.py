"""Hard cases of every kind: far positions, motion, sizes, contacts that no solver finds, broken environments."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.hard import case
from oracles.hard.case import Errors
from oracles.hard.scene import pair_of, quiet, worst_of
from tgdsl.module.accuracy.states import moved, only
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.sensors import KINDS

NAMES = tuple(kind.name for kind in KINDS)
NUM_ENVS, NUM_CALLS = 4, 3
FLOAT32, FLOAT64, FAR = 1e-5, 1e-11, 1e-9
"""Largest error over the channel's largest magnitude: 80 float32 roundings; rounding; 1 km away."""
READ_BY = {"contact_audio": ("contact_force",), "actuation_audio": ("joint_vel",)}
"""Fields to break for kinds that read no poses."""
Change = Callable[[SceneState], SceneState]


def _unchanged(state: SceneState) -> SceneState:
    return state


def _far(state: SceneState) -> SceneState:
    return moved(state, np.array([600.0, -800.0, 100.0]), Rotation.from_rotvec([0.3, -1.1, 0.7]))


def _scaled(factor: float, *names: str) -> Change:
    def change(state: SceneState) -> SceneState:
        return dataclasses.replace(state, **{n: factor * v for n in names if (v := getattr(state, n)) is not None})

    return change


def _any_length(state: SceneState) -> SceneState:
    factors = torch.tensor([1e-3, 0.5, 1 + 1e-6, 40.0], dtype=torch.float64)
    return dataclasses.replace(state, body_quat=state.body_quat * factors[: len(state.body_quat), None, None])


def _opposing(state: SceneState) -> SceneState:
    """Press each pair from two sides at one point, so that the forces cancel."""
    if state.contact_force is None or state.contact_force.shape[2] < 2:
        return state
    changed = {}
    for name, sign in (("contact_pos", 1), ("contact_force", -1), ("contact_torque", -1), ("contact_normal", -1)):
        if (value := getattr(state, name)) is not None:
            twin = torch.zeros_like(value)
            twin[:, :, 0], twin[:, :, 1] = value[:, :, 0], sign * value[:, :, 0]
            changed[name] = twin
    if state.contact_netforce is not None:
        changed["contact_netforce"] = torch.zeros_like(state.contact_netforce)
    return dataclasses.replace(state, **changed)


def _on_each_other(state: SceneState) -> SceneState:
    """Put all bodies in one pose: taxels deep inside, on axes and planes of symmetry."""
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(state.body_quat)
    return dataclasses.replace(state, body_pos=torch.zeros_like(state.body_pos), body_quat=one.clone())


FORCES = ("contact_force", "contact_torque", "contact_netforce")
CONTACTS = ("contact_found", *SLOT_FIELDS, "contact_netforce")
CHANGES = (
    ("states as they come", "any", _unchanged),
    ("1 km from the origin, turned", "world coordinates lose their digits", _far, False, FAR),
    ("100 m/s and 1,000 rad/s", "terms in velocities swamp the others", _scaled(1e3, "body_linvel", "body_angvel")),
    ("quaternions of length 1e-3 to 40", "rotations that stretch", _any_length, False, FAR),
    ("forces of 1e-9 N", "division by a load that vanishes", _scaled(1e-9, *FORCES)),
    ("forces of 1e6 N", "overflow, loss of digits", _scaled(1e6, *FORCES)),
    ("identical opposing contacts", "division by a net force of zero", _opposing),
    ("empty contact lists", "division by zero, stale contacts", _scaled(0.0, *CONTACTS)),
    ("all bodies at one place", "ties, normals of length zero, medial axes", _on_each_other),
    ("a hundredth of the size", "lengths near the thresholds", _unchanged, True, FLOAT64, 0.01),
    ("ten times the size", "lengths beyond the thresholds", _unchanged, True, FLOAT64, 10.0,
     tuple(name for name in NAMES if name != "proximity")),
)  # fmt: skip
"""Name, risk, change of the state; whether the reference reads the changed state; float64 error, scale, kinds."""


def _in_all_kinds(name: str, risk: str, reference: str, unit: str, **limits):
    return case.hard("every kind", name, risk, reference, unit, dict(zip(NAMES, NAMES, strict=True)), **limits)


@case.hard("every kind", "{name}", "{risk}", "the kind's float64 definition", "of full scale", each=CHANGES)
def against_reference(
    dtype: torch.dtype, name: str, risk: str, change: Change, is_truth: bool = True, float64: float = FLOAT64,
    scale: float = 1.0, kinds: tuple[str, ...] = NAMES,
):  # fmt: skip
    most, errors = float64 if dtype == torch.float64 else FLOAT32, []
    for kind in kinds:
        pair, worst = pair_of(kind, dtype, scale), 0.0
        for call in range(NUM_CALLS):
            state = pair.module.example_state(NUM_ENVS, seed=call, spread=0.03 * scale)
            changed = change(state)
            worst = max(worst, worst_of(pair, changed, changed if is_truth else state, most))
        errors.append(worst)
    return Errors(errors, most, kinds)


@_in_all_kinds(
    "not-a-number in one environment", "it spreads to others, or is read as no contact", "the same states unbroken",
    "units of the reading",
)  # fmt: skip
def one_broken_environment(dtype: torch.dtype, kind: str):
    whole, broken = pair_of(kind, dtype).module, pair_of(kind, dtype).module
    worst = 0.0
    for call in range(NUM_CALLS):
        state = whole.example_state(3, seed=call)
        parts = {name: getattr(state, name).clone() for name in READ_BY.get(kind, ("body_pos", "body_quat"))}
        for part in parts.values():
            part[1] = torch.nan
        with quiet():
            expected = whole(state)["s"]
            reading = broken(dataclasses.replace(state, **parts))["s"]
        worst = max(worst, float((reading[[0, 2]] - expected[[0, 2]]).abs().max()))
        is_seen = bool(reading[1].isnan().any())
    return worst if is_seen else np.inf


@_in_all_kinds(
    "one environment at a time", "an environment sees others of its batch", "the batch as a whole", "of full scale",
    float64=1e-13, float32=1e-6,
)  # fmt: skip
def split_batches(dtype: torch.dtype, kind: str, num_envs: int = 3):
    whole, singles = pair_of(kind, dtype).module, [pair_of(kind, dtype).module for _ in range(num_envs)]
    worst = 0.0
    for call in range(NUM_CALLS):
        state = whole.example_state(num_envs, seed=call)
        with quiet():
            together = whole(state)["s"].double()
            alone = torch.cat([one(only(state, slice(i, i + 1)))["s"] for i, one in enumerate(singles)]).double()
        worst = max(worst, float((together - alone).abs().max() / together.abs().max().clamp(min=1e-300)))
    return worst


@_in_all_kinds(
    "{num_envs:,} environments", "indices overflow, or an environment reads another's row", "three environments alone",
    "of full scale", float64=None, float32=1e-6,
)  # fmt: skip
def many_environments(dtype: torch.dtype, kind: str, num_envs: int = 4096):
    many, few = pair_of(kind, dtype).module, pair_of(kind, dtype).module
    state = many.example_state(num_envs, seed=0)
    with quiet():
        reading, expected = many(state)["s"][:3].double(), few(only(state, slice(0, 3)))["s"].double()
    return float((reading - expected).abs().max() / expected.abs().max().clamp(min=1e-300))


@_in_all_kinds(
    "reset of one environment", "others are reset too, or the one keeps what it remembers",
    "modules without that reset, and never called", "units of the reading", defects=(16,),
)  # fmt: skip
def reset_of_some(dtype: torch.dtype, kind: str):
    module, unreset, fresh = (pair_of(kind, dtype).module for _ in range(3))
    first, second = (module.example_state(4, seed=seed) for seed in (0, 1))
    with quiet():
        for one in (module, unreset):
            one(first)
        module.reset([2])
        reading, others, start = (one(second)["s"] for one in (module, unreset, fresh))
    return max(float(apart.abs().max()) for apart in (reading[[0, 1, 3]] - others[[0, 1, 3]], reading[2] - start[2]))


@_in_all_kinds("states are left alone", "a reading changes the simulator's own tensors", "copies", "fields", float64=None)
def states_are_left_alone(dtype: torch.dtype, kind: str):
    module = pair_of(kind, dtype).module
    state = module.example_state(3)
    before = {n: v.clone() for n in SHAPES if (v := getattr(state, n)) is not None}
    with quiet():
        module(state)
    return sum(not torch.equal(getattr(state, name), value) for name, value in before.items())
