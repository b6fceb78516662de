"""What is hard for any kind: places far away, motion, sizes, contacts as no solver finds them, broken environments."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from oracles.hard.results import Allowed, Case, HardCase
from oracles.hard.scene import DTYPES, pair_of, quiet, worst_of
from tgdsl.module.accuracy.changed import moved, only
from tgdsl.module.state import SHAPES, SceneState
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.sensors import KINDS

NAMES = tuple(kind.name for kind in KINDS)
NUM_ENVS, NUM_CALLS = 4, 4
FLOAT32, FLOAT64, FAR = 1e-5, 1e-11, 1e-9
"""Largest error over the largest magnitude of the channel: 80 roundings of float32; rounding; 1 km away."""
READ_BY = {"contact_audio": ("contact_force",), "actuation_audio": ("joint_vel",)}
"""What is broken of a state for kinds that poses mean nothing to."""
DEFINITION = "the kind's float64 definition"
Change = Callable[[SceneState], SceneState]


def against_reference(
    name: str, risk: str, change: Change, is_truth: bool, float64: float = FLOAT64, scale: float = 1.0,
    kinds: tuple[str, ...] = NAMES,
) -> HardCase:  # fmt: skip
    """Return how far each kind is from its definition in states that are changed.

    Args:
        name: What is hard.
        risk: What could go wrong.
        change: Makes the state that the module is given.
        is_truth: Whether the reference is given the same; else the state as it was, of which the reading is the same.
        float64: What float64 may be off.
        scale: What all lengths of the scene are times.
        kinds: Names of the kinds.
    """
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        most, found = float64 if precision == "float64" else FLOAT32, []
        for kind in kinds:
            pair, worst = pair_of(kind, dtype, scale), 0.0
            for call in range(NUM_CALLS):
                state = pair.module.example_state(NUM_ENVS, seed=call, spread=0.03 * scale)
                given = change(state)
                worst = max(worst, worst_of(pair, given, given if is_truth else state, most))
            found.append(worst)
        errors[precision] = Allowed(np.array(found), most)
    return HardCase(name, risk, DEFINITION, "of full scale", kinds, errors)


def _as_it_is(state: SceneState) -> SceneState:
    return state


def _far(state: SceneState) -> SceneState:
    return moved(state, np.array([600.0, -800.0, 100.0]), Rotation.from_rotvec([0.3, -1.1, 0.7]))


def _fast(state: SceneState) -> SceneState:
    changed = {name: 1e3 * value for name in ("body_linvel", "body_angvel") if (value := getattr(state, name)) is not None}
    return dataclasses.replace(state, **changed)


def _any_length(state: SceneState) -> SceneState:
    assert state.body_quat is not None
    factors = torch.tensor([1e-3, 0.5, 1 + 1e-6, 40.0], dtype=torch.float64)
    return dataclasses.replace(state, body_quat=state.body_quat * factors[: len(state.body_quat), None, None])


def _scaled_forces(factor: float) -> Change:
    def change(state: SceneState) -> SceneState:
        names = ("contact_force", "contact_torque", "contact_netforce")
        return dataclasses.replace(state, **{n: factor * v for n in names if (v := getattr(state, n)) is not None})

    return change


def _opposing(state: SceneState) -> SceneState:
    """Each pair is pressed from two sides at one place: the forces cancel."""
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


def _no_contacts(state: SceneState) -> SceneState:
    names = ("contact_found", *SLOT_FIELDS, "contact_netforce")
    return dataclasses.replace(state, **{n: torch.zeros_like(v) for n in names if (v := getattr(state, n)) is not None})


def _on_each_other(state: SceneState) -> SceneState:
    """All bodies at one place and of one attitude: taxels deep inside, on the axes and planes of symmetry of what is there."""
    assert state.body_pos is not None and state.body_quat is not None
    one = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(state.body_quat)
    return dataclasses.replace(state, body_pos=torch.zeros_like(state.body_pos), body_quat=one.clone())


def one_broken_environment() -> HardCase:
    """Return how far the other environments are off, and whether the broken one says so, with not-a-number in what it reads."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for kind in NAMES:
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
            found.append(worst if is_seen else np.inf)
        errors[precision] = Allowed(np.array(found), 0.0)
    return HardCase(
        "not-a-number in one environment",
        "it spreads to others, or is read as no contact",
        "the same states unbroken",
        "units of the reading",
        NAMES,
        errors,
    )


def split_batches(num_envs: int = 3) -> HardCase:
    """Return how far a batch is from its environments one by one, over full scale."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for kind in NAMES:
            whole, singles = pair_of(kind, dtype).module, [pair_of(kind, dtype).module for _ in range(num_envs)]
            worst = 0.0
            for call in range(NUM_CALLS):
                state = whole.example_state(num_envs, seed=call)
                with quiet():
                    together = whole(state)["s"].double()
                    alone = torch.cat([one(only(state, slice(i, i + 1)))["s"] for i, one in enumerate(singles)]).double()
                worst = max(worst, float((together - alone).abs().max() / together.abs().max().clamp(min=1e-300)))
            found.append(worst)
        errors[precision] = Allowed(np.array(found), 1e-13 if precision == "float64" else 1e-6)
    return HardCase(
        "one environment at a time",
        "an environment sees others of its batch",
        "the batch as a whole",
        "of full scale",
        NAMES,
        errors,
    )


def many_environments(num_envs: int = 4096) -> HardCase:
    """Return how far the first environments of a large batch are from the same alone, over full scale."""
    found = []
    for kind in NAMES:
        many, few = pair_of(kind, torch.float32).module, pair_of(kind, torch.float32).module
        state = many.example_state(num_envs, seed=0)
        with quiet():
            reading, expected = many(state)["s"][:3].double(), few(only(state, slice(0, 3)))["s"].double()
        found.append(float((reading - expected).abs().max() / expected.abs().max().clamp(min=1e-300)))
    return HardCase(
        f"{num_envs:,} environments",
        "indices overflow, or an environment reads another's row",
        "three environments alone",
        "of full scale",
        NAMES,
        {"float32": Allowed(np.array(found), 1e-6)},
    )


def reset_of_some() -> HardCase:
    """Return how far readings are off after a reset of one of four environments: of the others, and of it from a new start."""
    errors: dict[str, Allowed] = {}
    for precision, dtype in DTYPES.items():
        found = []
        for kind in NAMES:
            module, kept, fresh = (pair_of(kind, dtype).module for _ in range(3))
            first, second = (module.example_state(4, seed=seed) for seed in (0, 1))
            with quiet():
                for one in (module, kept):
                    one(first)
                module.reset([2])
                reading, others, anew = (one(second)["s"] for one in (module, kept, fresh))
            apart = max(float((reading[[0, 1, 3]] - others[[0, 1, 3]]).abs().max()), float((reading[2] - anew[2]).abs().max()))
            found.append(apart)
        errors[precision] = Allowed(np.array(found), 0.0)
    return HardCase(
        "reset of one environment",
        "others are reset too, or the one keeps what it remembers",
        "modules without that reset, and never called",
        "units of the reading",
        NAMES,
        errors,
        defects=(16,),
    )


def states_are_left_alone() -> HardCase:
    """Return how many fields of a state a module changes: none."""
    found = []
    for kind in NAMES:
        module = pair_of(kind, torch.float32).module
        state = module.example_state(3)
        before = {n: v.clone() for n in SHAPES if (v := getattr(state, n)) is not None}
        with quiet():
            module(state)
        found.append(sum(not torch.equal(getattr(state, name), value) for name, value in before.items()))
    return HardCase(
        "states are left alone",
        "a reading changes the simulator's own tensors",
        "copies",
        "fields",
        NAMES,
        {"float32": Allowed(np.array(found, dtype=np.float64), 0.0)},
    )


CASES: tuple[Case, ...] = (
    partial(against_reference, "states as they come", "any", _as_it_is, True),
    partial(against_reference, "1 km from the origin, turned", "world coordinates lose their digits", _far, False, float64=FAR),
    partial(against_reference, "100 m/s and 1,000 rad/s", "terms in velocities swamp the others", _fast, True),
    partial(against_reference, "quaternions of length 1e-3 to 40", "rotations that stretch", _any_length, False, float64=FAR),
    partial(against_reference, "forces of 1e-9 N", "division by a load that vanishes", _scaled_forces(1e-9), True),
    partial(against_reference, "forces of 1e6 N", "overflow, loss of digits", _scaled_forces(1e6), True),
    partial(against_reference, "identical opposing contacts", "division by a net force of zero", _opposing, True),
    partial(against_reference, "empty contact lists", "division by zero, stale contacts", _no_contacts, True),
    partial(against_reference, "all bodies at one place", "ties, normals of length zero, medial axes", _on_each_other, True),
    partial(against_reference, "a hundredth of the size", "lengths near the thresholds", _as_it_is, True, scale=0.01),
    partial(
        against_reference,
        "ten times the size",
        "lengths beyond the thresholds",
        _as_it_is,
        True,
        scale=10.0,
        kinds=tuple(name for name in NAMES if name != "proximity"),
    ),
    one_broken_environment,
    split_batches,
    many_environments,
    reset_of_some,
    states_are_left_alone,
)
