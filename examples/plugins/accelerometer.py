"""Accelerometer: the specific force at the origin of each link's frame, as an inertial sensor in the link reads it.

    f = Rᵀ (a − g),   a = (v_t − v_(t−1))/Δt                                                  [m/s²]
    y_t = y_(t−1) + (1 − e^(−2π f_c Δt)) (f − y_(t−1))                                        [m/s²]

with R the rotation of the link's frame, v the velocity of its origin in the world [m/s], g gravity [m/s²], f_c the cutoff of a
first-order low-pass [Hz]. At rest it reads −g in the link's frame. At the first call after a reset a = 0 and y = f.

A kind from outside the package: its rows are links rather than taxels, it remembers, and it feels no objects. With `substeps`
it reads a block: one sample for each physics step of a call.

Source: Titterton and Weston, *Strapdown Inertial Navigation Technology*, specific force. Departures: none.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field, StrictInt

from tgdsl.fields.models import Frequency
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities import Gathered, LinkMotion, References
from tgdsl.sensors import Kind
from tgdsl.sensors.base import (
    Axis,
    Channel,
    Constants,
    Context,
    LinkSpec,
    Lowered,
    Memory,
    ReferenceContext,
    ReferenceState,
    State,
    SurfaceOf,
    scalar,
)

VELOCITY, FILTERED = ("velocity_x", "velocity_y", "velocity_z"), ("filtered_x", "filtered_y", "filtered_z")


class AccelerometerSpec(LinkSpec):
    """Specific force of each link."""

    kind: Literal["accelerometer"]
    """Specific force at the origin of each link's frame, in that frame [m/s²]."""
    cutoff: Frequency = 100.0
    """Cutoff of the low-pass, f_c [Hz]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Gravity in the world, g [m/s²]."""
    substeps: Annotated[StrictInt, Field(ge=0)] = 0
    """Physics steps of a call, one sample each; 0: one reading per call [1]."""


def reference(
    spec: AccelerometerSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return y (imu, 3) [m/s²], and the memory."""
    bodies, rows, after = gathered[LinkMotion], [], np.zeros((6, len(layout.links)))
    for i, link in enumerate(layout.links):
        body = bodies[layout.bodies.index(link.body)]
        last, filtered = (np.array([state[name][i] for name in names]) for names in (VELOCITY, FILTERED))
        acceleration = np.zeros(3) if context.is_first else (body.linvel - last) / context.dt
        force = body.rotation.T @ (acceleration - np.array(spec.gravity))
        share = 1.0 if context.is_first else 1.0 - np.exp(-2 * np.pi * spec.cutoff * context.dt)
        rows.append(filtered + share * (force - filtered))
        after[:, i] = [*body.linvel, *rows[-1]]
    return np.array(rows), dict(zip((*VELOCITY, *FILTERED), after, strict=True))


def lower(spec: AccelerometerSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """A row for each link; the cutoff becomes the rate of the filter."""
    return Lowered(
        channels=tuple(Channel(f"acceleration_{axis}", "m/s²") for axis in "xyz"),
        constants={
            "gravity": np.array(spec.gravity),
            "rate": scalar(2 * np.pi * spec.cutoff),
            "body": layout.link_body_id,
        },
        state={name: Memory() for name in (*VELOCITY, *FILTERED)},
        requests=(LinkMotion(),),
        rows=Axis("imu", len(layout.links), {"link": [link.name for link in layout.links]}, np.arange(len(layout.links))),
        substeps=spec.substeps,
    )


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, torch.Tensor], State]:
    """Return the planes of y [m/s²], (env, imu)."""
    motion, body = gathered[LinkMotion], constants["body"]
    rotation = planes.rot(part[:, body] for part in motion.rotation)
    velocity = planes.vec(part[:, body] for part in motion.linvel)
    last, filtered = (planes.vec(state[name] for name in names) for names in (VELOCITY, FILTERED))
    still = planes.vec(torch.zeros_like(part) for part in velocity)
    moved = planes.scale(1 / context.dt, planes.sub(velocity, last))
    acceleration = planes.where(context.is_first, still, moved)
    force = planes.rotate_back(rotation, planes.sub(acceleration, planes.split(constants["gravity"])))
    share = torch.where(context.is_first, 1.0, 1 - torch.exp(-constants["rate"] * context.dt))
    read = planes.add(filtered, planes.scale(share, planes.sub(force, filtered)))
    after = dict(zip((*VELOCITY, *FILTERED), (*velocity, *read), strict=True))
    return {f"acceleration_{axis}": plane for axis, plane in zip("xyz", read, strict=True)}, after


ACCELEROMETER = Kind(AccelerometerSpec, lower, forward, reference, knobs=frozenset(), is_timed=True)
