"""The definition of a microphone in float64, for one environment: places in the world, sample by sample."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tgdsl.layout.layout import Layout
from tgdsl.quantities.kinematics import Places
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceContext, ReferenceState
from tgdsl.sensors.microphone.interpolation import LEAST_DELAY, TAPS, coefficients
from tgdsl.sensors.microphone.spec import MicrophoneSpec
from tgdsl.sensors.upstream import PLACE, SAMPLES, Upstream


def reference(
    spec: MicrophoneSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return p (sample, 1, 1) [Pa], and what is remembered."""
    found = gathered[Upstream]
    made = np.concatenate([own[SAMPLES] for own in found.values()], axis=1)
    place = np.concatenate([own[PLACE] for own in found.values()], axis=1)
    listener = np.array(spec.pos) if spec.body is None else gathered[Places][0]
    num, num_rows = made.shape
    num_nodes, room = state["path"].shape[1], state["history"].shape[1]
    level = np.concatenate([np.full(own[SAMPLES].shape[1], spec.levels.get(name, 1.0)) for name, own in found.items()])
    if context.is_first:
        track, history = np.repeat(place[None], num_nodes + 1, axis=0), np.zeros((room, num_rows))
    else:
        track, history = np.concatenate([place[None], state["track"][:-1]]), state["emitted"]
    sound = np.concatenate([history, made])
    far = spec.reach / spec.speed
    pressure, ages = np.zeros((num, 1, 1)), np.zeros(num_rows)
    for row in range(num_rows):
        ages[row] = age_of_sound(listener, track[:, :, row], context.dt, spec.speed)
        before = ages[row] if context.is_first else state["ages"][row]
        is_heard = [age <= far and age < num_nodes * context.dt for age in (before, ages[row])]
        distances = [max(spec.speed * age, spec.nearest) for age in (before, ages[row])]
        gains = [level[row] / r**spec.falloff if heard else 0.0 for r, heard in zip(distances, is_heard, strict=True)]
        for k in range(1, num + 1):
            share = k / num
            delay = (before + share * (ages[row] - before)) * num / context.dt
            delay = float(min(max(delay, LEAST_DELAY), room - TAPS // 2))
            value = interpolated(sound[:, row], room + k - 1 - delay)
            pressure[k - 1] += (gains[0] + share * (gains[1] - gains[0])) * value
    after = {"path": state["path"], "history": state["history"]}
    return pressure, after | {"track": track, "emitted": sound[num:], "ages": ages}


def age_of_sound(listener: Float[np.ndarray, " 3"], track: Float[np.ndarray, "node 3"], dt: float, speed: float) -> float:
    """Return how long ago a source emitted what is heard now [s], its places at the last steps being given, now first."""
    from scipy.optimize import brentq

    def early(age: float) -> float:
        where = [np.interp(age, dt * np.arange(len(track)), track[:, i]) for i in range(3)]
        return age - float(np.linalg.norm(listener - where)) / speed

    for node in range(1, len(track)):
        if early(node * dt) > 0:
            first, last = (node - 1) * dt, node * dt
            tolerance = {"xtol": 1e-18, "rtol": 4 * np.finfo(float).eps}
            return first if early(first) == 0 else float(brentq(early, first, last, **tolerance))  # type: ignore[arg-type]
    return (len(track) - 1) * dt


def interpolated(samples: Float[np.ndarray, " sample"], place: float) -> float:
    """Return the value between samples, at a number of them from the first."""
    first = int(np.floor(place))
    taps = coefficients().T @ (place - first - 0.5) ** np.arange(len(coefficients()))
    return float(taps @ samples[first - TAPS // 2 + 1 : first + TAPS // 2 + 1])
