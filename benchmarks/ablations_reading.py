"""How well the force on the object of grip_force can be read from each type of touch, whatever a policy makes of it.

A teacher acts; at each control step all types are felt in one simulation. From the numbers x of one instant a ridge regression
estimates the sum F of the normal forces of the object's contacts, MuJoCo's own contact forces at that instant (`priv_force`),

    F̂ = mean F + (x − mean x)/σ · w,   w = argmin Σ (F̂ − F)² + λ n |w|²          sums and means over the n instants of the fit
    R² = 1 − Σ (F̂ − F)²/Σ (F − mean F)²                                          over the episodes of the test
    relative error = √ mean ((F̂ − F)/F)²                                         the same

σ is the standard deviation of a channel, over all its taxels: with one of its own a taxel that is hardly ever touched would get
a weight that a touch in the test blows up. λ is the one of `RIDGES` with the least error in four-fold cross-validation over the
episodes of the fit, folds of whole episodes. Only instants count at which the object is pressed with half of the least
command or more, and which are `SETTLING` or more after the start. Episodes of test and fit are in other environments; both have
all variants of the object equally often. Intervals of 95 % are percentiles over test episodes drawn with replacement.

A linear map is what a first layer of a network can do: types whose force follows from their numbers otherwise, such as by a
product, may hold more than is read here.

Shapes: `row` instants, `feature` numbers of a type.
"""

from __future__ import annotations

import csv
import io
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int

from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write, with_folder
from tgdsl.observations.observations import PerLink
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensors import PolicyTouch, num_variants, types_of
from tgdsl.rl.students.keys import NONE, Teacher

FORCE = "priv_force"
"""The group whose first number is the force [N]."""
BLIND = "proprio"
"""What a policy that feels nothing knows of its joints."""
RIDGES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
FOLDS, DRAWS = 4, 1000
"""Folds of cross-validation; draws of episodes."""
SETTLING, EVERY = 0.5, 2
"""Time after the start that does not count [s]; of so many instants one is kept."""
Array = np.ndarray


class Reading(NamedTuple):
    """How well the force is read from one type; intervals are of 95 %.

    Attributes:
        type: The type.
        numbers: How many numbers it has.
        r2: R² [1].
        r2_low: Lower bound of its interval.
        r2_high: Upper bound.
        rms: RMS error [N].
        relative: RMS of the error relative to the force [1].
        relative_low: Lower bound of its interval.
        relative_high: Upper bound.
        ridge: λ.
        train_episodes: Episodes of the fit.
        test_episodes: Episodes of the test.
        instants: Instants of the test.
    """

    type: str
    numbers: int
    r2: float
    r2_low: float
    r2_high: float
    rms: float
    relative: float
    relative_low: float
    relative_high: float
    ridge: float
    train_episodes: int
    test_episodes: int
    instants: int


class Recorded(NamedTuple):
    """What was felt while a teacher acted.

    Attributes:
        x: Numbers of each type.
        channels: How many channels these are, as many numbers each, one channel after the other.
        force: F [N].
        episode: Whose instant it is.
        env: In which environment.
    """

    x: Mapping[str, Float[Array, "row feature"]]
    channels: Mapping[str, int]
    force: Float[Array, " row"]
    episode: Int[Array, " row"]
    env: Int[Array, " row"]


def record(
    loaded: LoadedTask, teacher: Path, envs: int, episodes: int, placement: str, types: Sequence[str] = (), seed: int = 0
) -> Recorded:
    """Let a teacher act on the CPU, and return what was felt.

    Args:
        loaded: The task.
        teacher: Its policy.
        envs: Environments.
        episodes: Whole episodes' worth of control steps in each.
        placement: Links that feel.
        types: What is felt; default: all types that the sensors' document has sensors for, but temperatures.
        seed: What is random follows from.

    Raises:
        TgdslError: If the task tells no force, or environments do not divide by the variants of the object.
    """
    types = types or [name for name in types_of(loaded) if name not in (NONE, "temperature")]
    variants = num_variants(loaded)
    if envs < 2 * variants or envs % variants:
        raise TgdslError(f"{envs} environments, expected a multiple of {variants}, the variants of the object, and two of them")
    touch = {type_: PolicyTouch(type_, placement, "clean").group for type_ in types} | {NONE: BLIND}
    own = Teacher(teacher, loaded)
    env = TouchEnv(loaded, envs, seed=seed, touches=[PolicyTouch(type_, placement, "clean") for type_ in types])
    try:
        if FORCE not in env.groups:
            raise TgdslError(
                f'the task "{loaded.spec.task}" has no group "{FORCE}", expected one that tells the force on its object'
            )
        channels = {type_: _channels(env, touch[type_]) for type_ in types} | {NONE: env.groups[BLIND] // env.num_actions}
        actor, obs, kept = own.bound(env), env.reset(seed), []
        least = 0.5 * loaded.spec.force[0]  # pyright: ignore[reportAttributeAccessIssue]
        number, first = torch.zeros(envs, dtype=torch.int64), round(SETTLING / env.control_step)
        for t in range(episodes * env.max_steps):
            force = obs[FORCE][:, 0]
            chosen = (force >= least) & (env.steps >= first)
            if t % EVERY == 0 and bool(chosen.any()):
                rows = torch.arange(envs)[chosen]
                kept.append(({name: obs[group][chosen] for name, group in touch.items()}, force[chosen], number[chosen], rows))
            step = env.step(actor(obs))
            obs = step.obs
            actor.begin(step.info.ended)
            number += step.info.ended
    finally:
        env.close()
    if not kept:
        raise TgdslError(f"the object was never pressed with {least:g} N")
    x = {name: torch.cat([each[0][name] for each in kept]).double().numpy() for name in touch}
    force, number, rows = (torch.cat([each[i] for each in kept]).numpy() for i in (1, 2, 3))
    return Recorded(x, channels, force.astype(np.float64), number * envs + rows, rows)


def readings(recorded: Recorded, variants: int) -> list[Reading]:
    """Return how well the force is read from each type, the best first.

    One block in three, of as many environments as there are variants, is for the test.
    """
    is_test = recorded.env // variants % 3 == 1
    found = [_reading(name, recorded, is_test) for name in recorded.x]
    return sorted(found, key=lambda own: -own.r2)


def write_readings(found: list[Reading], file: Path, arguments: list[str]) -> None:
    """Write them as CSV, under a line with the command.

    Raises:
        FileError: If that cannot be written.
    """
    text = io.StringIO()
    text.write(f"# {shlex.join(['python', 'benchmarks/ablations.py', *arguments])}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Reading._fields)
    writer.writerows([f"{value:.5g}" if isinstance(value, float) else value for value in own] for own in found)
    atomic_write(with_folder(file), text.getvalue().encode())


def fitted(
    x: Float[Array, "row feature"], y: Float[Array, " row"], ridge: float, channels: int = 1
) -> tuple[Array, Array, float]:
    """Return weights of x, what is taken from x before, and what is added: `ŷ = (x − mean) @ w + mean y`."""
    mean = x.mean(axis=0)
    std = np.sqrt(x.var(axis=0).reshape(channels, -1).mean(axis=1))
    scale = np.repeat(np.where(std > 0.0, std, np.inf), x.shape[1] // channels)
    z = (x - mean) / scale
    weights = np.linalg.solve(z.T @ z + ridge * len(x) * np.eye(x.shape[1]), z.T @ (y - y.mean()))
    return weights / scale, mean, float(y.mean())


def read(x: Float[Array, "row feature"], fit: tuple[Array, Array, float]) -> Float[Array, " row"]:
    """Return what a fit reads."""
    weights, mean, level = fit
    return (x - mean) @ weights + level


def _reading(name: str, recorded: Recorded, is_test: Array) -> Reading:
    x, channels, force, episode = recorded.x[name], recorded.channels[name], recorded.force, recorded.episode
    ridge = min(RIDGES, key=lambda own: _folded(x[~is_test], force[~is_test], episode[~is_test], own, channels))
    error = read(x[is_test], fitted(x[~is_test], force[~is_test], ridge, channels)) - force[is_test]
    own, numbers = force[is_test], np.unique(episode[is_test], return_inverse=True)
    ones = np.ones_like(own)
    sums = np.stack([np.bincount(numbers[1], value) for value in (ones, own, own**2, error**2, (error / own) ** 2)])
    drawn = np.random.default_rng(0).integers(len(numbers[0]), size=(DRAWS, len(numbers[0])))
    r2, _, relative = _told(sums.sum(axis=1))
    r2s, _, relatives = _told(sums[:, drawn].sum(axis=2))
    (r2_low, r2_high), (low, high) = (np.percentile(values, [2.5, 97.5]).tolist() for values in (r2s, relatives))
    rms = float(np.sqrt(np.mean(error**2)))
    train = len(np.unique(episode[~is_test]))
    told = (float(r2), r2_low, r2_high, rms, float(relative), low, high, ridge)
    return Reading(name, x.shape[1], *told, train, len(numbers[0]), len(own))


def _told(sums: Array) -> tuple[Array, Array, Array]:
    """Return R², RMS error and relative error by sums over instants: 1, F, F², error², (error/F)²."""
    count, total, squares, errors, relative = sums
    return 1.0 - errors / (squares - total**2 / count), np.sqrt(errors / count), np.sqrt(relative / count)


def _channels(env: TouchEnv, group: str) -> int:
    """Return how many numbers a type has of each taxel, or of each link."""
    source = env.touch_sources[group]
    return env.groups[group] // (len(source.layout.links) if isinstance(source.spec, PerLink) else source.layout.num_taxels)


def _folded(x: Array, y: Array, episode: Array, ridge: float, channels: int) -> float:
    """Return the mean squared error of cross-validation."""
    fold = np.unique(episode, return_inverse=True)[1] % FOLDS
    errors = [
        np.sum((read(x[fold == own], fitted(x[fold != own], y[fold != own], ridge, channels)) - y[fold == own]) ** 2)
        for own in range(FOLDS)
        if (fold == own).any() and (fold != own).any()
    ]
    return float(sum(errors)) / len(y)
