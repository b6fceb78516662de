"""Modes of vibration of a body: what an impulse on it makes ring.

An impulse J [N·s] at the time 0 makes the body sound as

    s(t) = J Σ_i g_i e^(−d_i t) sin(2π f_i t)                                                 [m/s]

with the frequency f_i [Hz], the decay rate d_i of the amplitude [1/s], and the gain g_i [1/kg] of each mode. With mode shapes
φ_i normalised to the mass, ∫ρ φ_i² dV = 1, it is g_i = φ_i(struck) φ_i(heard), both by the component along the surface's
normal, and s the pseudo-velocity ω q of the surface: its displacement q times ω = 2πf, which has the amplitude of its velocity
and no jump at the impulse.

Shapes: `mode` modes of one body, `point` points of it, `node` nodes of a grid, z running fastest, `field` fields of
its modes, one of each, and as many as there are mode shapes where symmetry makes these one mode, see `loudness`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int
from pydantic import Field, StrictInt

from tgdsl.fields.materials import MaterialField
from tgdsl.fields.models import SpecModel


class ShapeModes(SpecModel):
    """Modes by modal analysis of a body's shape."""

    material: MaterialField
    """Its material, by name or by numbers."""
    count: Annotated[StrictInt, Field(ge=1)] = 32
    """Number of modes, from the lowest on, at most."""


@dataclass(frozen=True, eq=False)
class ModeShapes:
    """Mode shapes on a grid through the body, as vectors, over the RMS of their normal component on the surface."""

    axes: Float[np.ndarray, "3 3"]  # the grid's axes, as rows, of the body's frame
    low: Float[np.ndarray, " 3"]  # place of its first node along these axes [m]
    step: Float[np.ndarray, " 3"]  # spacing of its nodes along each [m]
    num: Int[np.ndarray, " 3"]  # number of its nodes along each, two or more
    value: Float[np.ndarray, "node 3 field"]  # fields at the nodes, along the grid's axes [1]
    owner: Int[np.ndarray, " field"]  # the mode of each field, ascending
    error: Float[np.ndarray, " field"]  # root mean square over the surface of what interpolation is off by, of each field [1]

    def share(self, pos: Float[np.ndarray, "point 3"], along: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point mode"]:
        """Return by how much more or less than by its gain each mode is struck at points, along a direction there [1].

        Args:
            pos: The points, in the body's frame [m].
            along: The direction, of unit length, in the body's frame.
        """
        result = interpolated(self.low, self.step, self.num, self.value, pos @ self.axes.T)
        return of_groups(np.einsum("xif,xi->xf", result, along @ self.axes.T), self.owner, int(self.owner.max()) + 1)

    def of(self, kept: Bool[np.ndarray, " mode"]) -> ModeShapes:
        """Return the shapes of some modes."""
        mine = kept[self.owner]
        number = np.cumsum(kept) - 1
        return replace(self, value=self.value[:, :, mine], owner=number[self.owner[mine]], error=self.error[mine])


@dataclass(frozen=True, eq=False)
class Modes:
    """Modes of a body, by ascending frequency."""

    frequency: Float[np.ndarray, " mode"]  # f, of the undamped mode's ringing [Hz]
    decay: Float[np.ndarray, " mode"]  # rate d at which its amplitude decays [1/s]
    gain: Float[np.ndarray, " mode"]  # amplitude of s per impulse, g [1/kg]
    shapes: ModeShapes | None = None  # how strongly each is struck where and along what; None: alike everywhere


INAUDIBLE = 1e-3  # gain below which a group is left out, over the largest gain
MERGE_TOLERANCE = 1e-3  # relative difference of frequencies up to which modes are one: less than the elements resolve


@dataclass(frozen=True, eq=False)
class Loudness:
    """Modes of one frequency taken together."""

    wave_number: Float[np.ndarray, " group"]  # ω L/c, root mean square of each group
    multiplicity: Int[np.ndarray, " group"]  # how many modes it has
    gain: Float[np.ndarray, " group"]  # g, per mass of the body: dimensionless
    mixture: Float[np.ndarray, "mode field"]  # of the mode shapes of unit modal mass, what makes the fields
    owner: Int[np.ndarray, " field"]  # the group of each field, ascending


def of_groups(
    fields: Float[np.ndarray, "*point field"], owner: Int[np.ndarray, " field"], count: int
) -> Float[np.ndarray, "*point group"]:
    """Return the share of each of so many groups: its field, or of several the root of the sum of their squares."""
    by_group = [fields[..., owner == group] for group in range(count)]
    results = [part[..., 0] if part.shape[-1] == 1 else np.sqrt((part**2).sum(axis=-1)) for part in by_group]
    return np.stack(results, axis=-1) if results else fields[..., :0]


def groups(wave_number: Float[np.ndarray, " mode"]) -> list[slice]:
    """Return which modes, by ascending frequency, are one: those up to `MERGE_TOLERANCE` above the first of them."""
    result, start = [], 0
    for mode in range(1, len(wave_number) + 1):
        if mode == len(wave_number) or wave_number[mode] > (1 + MERGE_TOLERANCE) * wave_number[start]:
            result.append(slice(start, mode))
            start = mode
    return result


def loudness(
    wave_number: Float[np.ndarray, " mode"], normal: Float[np.ndarray, "x mode"], area: Float[np.ndarray, " x"], mass: float
) -> Loudness:
    """Return the groups of modes that are heard; the last one, which more modes could belong to, is left out.

    How strongly modes are struck and heard: mode shapes along the surface's normal, and modes of one frequency taken together.

    Modes whose frequencies are nearer than `MERGE_TOLERANCE` are one. A square plate, a can or a ball has pairs and multiplets
    that symmetry makes equal, and any mixture of them is a mode too. Results for a group are the same for all mixtures. With φ
    the column of its mode shapes along the surface's normal and M = (1/A) ∫ φ φᵀ dA their mean products over it, an impulse J
    at the point x makes all of them ring in phase, at amplitudes φ(x) J. The root mean square of the sound over the surface is

        √(φᵀ(x) M φ(x)) J,   and its root mean square over all x   g J,   g = ‖M‖ = √(Σ M_ij²)

    For a single mode these are |φ(x)| a J and a² J, where a² is the mean of φ². Groups that hardly move the surface along its
    normal, such as torsion of a ball, are left out: they are neither struck nor heard.

    How much more a group is struck at x than in the mean, its share, is φ/a of a single mode, with its sign; of several it is
    √Σ f_k², with as many fields f = Λ^(1/2) Vᵀ φ/g, M = V Λ Vᵀ, as it has modes. Fields are sums of mode shapes, and so vectors
    throughout the body.

    Shapes: `x` points of the surface, `mode` modes, `group` groups of modes of one frequency, `field` fields of all groups.

    Args:
        wave_number: Of each mode, ascending.
        normal: Mode shapes of unit modal mass along the normals.
        area: Surface that each point stands for.
        mass: The body's.
    """
    mode_groups = groups(wave_number)[:-1]
    gain, mixtures = np.zeros(len(mode_groups)), []
    for i, group in enumerate(mode_groups):
        shape, mixture = normal[:, group] * np.sqrt(mass), np.zeros((len(wave_number), group.stop - group.start))
        products = (shape * area[:, None]).T @ shape / area.sum()
        gain[i] = np.linalg.norm(products)
        if gain[i] > 0 and mixture.shape[1] == 1:
            mixture[group] = sign_of(shape[:, 0]) / np.sqrt(gain[i])
        elif gain[i] > 0:
            square, vector = np.linalg.eigh(products)
            mixture[group] = vector * np.sqrt(np.maximum(square, 0.0)) / gain[i]
        mixtures.append(np.sqrt(mass) * mixture)
    square = np.array([np.mean(wave_number[group] ** 2) for group in mode_groups])
    multiplicity = np.array([group.stop - group.start for group in mode_groups], np.int64)
    heard = gain > INAUDIBLE * gain.max(initial=0.0)
    mixture = np.concatenate(
        [np.zeros((len(wave_number), 0)), *(part for part, is_heard in zip(mixtures, heard, strict=True) if is_heard)], axis=1
    )
    owner = np.repeat(np.arange(int(heard.sum())), multiplicity[heard])
    return Loudness(np.sqrt(square)[heard], multiplicity[heard], gain[heard], mixture, owner)


def sign_of(shape: Float[np.ndarray, " x"]) -> float:
    """Return the sign that makes a mode shape positive at the first of its points that are about the largest."""
    size = np.abs(shape)
    first = int(np.argmax(size > (1 - 1e-6) * size.max(initial=0.0)))
    return 1.0 if not len(shape) or shape[first] >= 0 else -1.0


def interpolated(
    low: np.ndarray, step: np.ndarray, num: np.ndarray, value: np.ndarray, pos: Float[np.ndarray, "x 3"]
) -> Float[np.ndarray, "x 3 field"]:
    """Return values between the nodes of a grid, trilinear; outside its box the value at the nearest point of the box."""
    at = np.clip((pos - low) / step, 0.0, num - 1)
    first = np.minimum(at.astype(np.int64), num - 2)
    share = at - first
    result = np.zeros((len(pos), *value.shape[1:]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(np.array(corner), share, 1 - share).prod(axis=1)
        node = np.ravel_multi_index(tuple((first + corner).T), tuple(num))
        result += weight[:, None, None] * value[node]
    return result
