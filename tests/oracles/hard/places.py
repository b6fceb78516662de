"""Places on and in primitives where the nearest point is not unique."""

import numpy as np

R = 0.01
"""Radius of the probes [m]."""
HALF = 0.02
DIAGONAL = np.sqrt(0.5)

Place = tuple[tuple[float, float, float], float]
HARD: dict[str, list[Place]] = {
    '<geom type="box" size=".02 .02 .02"/>': [
        ((HALF, 0, 0), R),  # on a face
        ((HALF, HALF, 0), R),  # on an edge
        ((HALF, HALF, HALF), R),  # on a corner
        ((0, 0, 0), R + HALF),  # at the centre
        ((HALF + 0.006, HALF + 0.008, 0), 0.0),  # one radius off an edge: just out of reach
        ((HALF + 0.003, HALF + 0.004, 0), 0.005),
    ],
    '<geom type="sphere" size=".02"/>': [((HALF, 0, 0), R), ((0, 0, 0), R + HALF), ((0, 0, HALF + 0.004), 0.006)],
    '<geom type="capsule" size=".01 .02"/>': [
        ((0, 0, 0), R + 0.01),  # at the centre
        ((0, 0, 0.02), R + 0.01),  # on the axis, at the end of the segment
        ((0, 0, 0.03), R),  # on the pole
        ((0.01, 0, 0.013), R),  # on the wall
    ],
    '<geom type="cylinder" size=".02 .03"/>': [
        ((0, 0, 0), R + HALF),
        ((HALF, 0, 0), R),  # on the wall
        ((0, 0, 0.03), R),  # on a cap
        ((HALF * DIAGONAL, HALF * DIAGONAL, 0.03), R),  # on the rim
        ((HALF + 0.003, 0, 0.034), 0.005),
    ],
    '<geom type="ellipsoid" size=".02 .01 .03"/>': [
        ((0, 0, 0), R + 0.01),
        ((HALF, 0, 0), R),
        ((0, 0.01, 0), R),
        ((0, 0, 0.035), 0.005),
    ],
    '<geom type="plane" size="1 1 .1"/>': [((0.3, 0.2, 0), R), ((0, 0, 0.004), 0.006), ((0, 0, -0.03), 0.04)],
}
"""By a geom's MJCF: places [m], and how deep a probe there is in the geom [m]."""
