"""Build the XHand1's link surfaces: smooth closed lofts of super-elliptic sections, each from a few dimensions.

Every number below was measured on the vendor's surface (see README.md); the shapes are our own. Each link is one closed
surface, covers included, in its body frame.

Run `python robots/xhand1/make_meshes.py` to write `assets/*.stl` again (metres; the same bytes every time).
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # as a script, this sees only its own folder

from robots.loft import Shape, Station, write

ASSETS = Path(__file__).resolve().parent / "assets"

# The fist-sized part from the wrist's flange (z = 0) to the knuckles; the slot of the thumb's base is filled.
PALM = Shape(
    along=2,
    facing=0,
    middle=0.0,
    front_exponent=5.8,
    back_exponent=2.6,
    num_rings=26,
    num_around=36,
    stations=(
        Station(0.0, 0.0, 23.5, 23.0, -24.5),  # the wrist's flange
        Station(12.0, 0.0, 24.5, 22.0, -23.5),
        Station(18.0, -0.5, 29.0, 21.5, -22.5),
        Station(24.0, -1.0, 35.5, 22.2, -22.5),
        Station(32.0, -1.5, 40.5, 22.8, -23.0),
        Station(40.0, -2.0, 43.1, 23.1, -23.0),
        Station(50.0, -2.0, 45.6, 23.1, -22.5),
        Station(60.0, -2.0, 47.1, 23.0, -22.0),
        Station(72.0, -2.0, 47.5, 22.9, -21.2),
        Station(86.0, -2.0, 47.2, 22.6, -19.6),
        Station(91.0, -2.5, 46.0, 21.0, -19.0),
        Station(96.0, -3.0, 44.0, 17.0, -18.2),
        Station(101.0, -3.0, 40.0, 14.5, -16.5),
        Station(104.0, -3.0, 36.0, 10.0, -12.0),
    ),
)

# Joint axis at z = 0, next joint axis at z = 55.8; pad between them, ridged cover on the back.
FINGER_LINK1 = Shape(
    along=2,
    facing=0,
    middle=0.0,
    front_exponent=7.8,
    back_exponent=3.0,
    num_rings=24,
    num_around=32,
    stations=(
        Station(-8.0, 0.0, 7.2, 1.5, -1.5),
        Station(-6.0, 0.0, 7.5, 5.3, -5.3),
        Station(-3.0, 0.0, 7.6, 7.2, -8.0),
        Station(3.0, 0.0, 7.8, 7.8, -11.5),
        Station(9.0, 0.0, 8.0, 7.9, -15.5),
        Station(15.0, 0.0, 8.0, 8.8, -16.7),
        Station(20.0, 0.0, 7.8, 10.4, -16.6),
        Station(25.0, 0.0, 7.7, 10.9, -16.5),
        Station(30.0, 0.0, 7.7, 11.1, -16.4),
        Station(35.0, 0.0, 7.7, 10.9, -16.4),
        Station(40.0, 0.0, 7.7, 10.4, -16.3),
        Station(45.0, 0.0, 7.9, 9.5, -15.8),
        Station(50.0, 0.0, 7.9, 9.4, -12.5),
        Station(56.0, 0.0, 7.0, 9.4, -11.9),
        Station(60.0, 0.2, 6.0, 8.5, -11.0),
        Station(63.0, 0.2, 5.4, 6.2, -9.0),
        Station(66.3, 0.2, 4.8, 1.0, -5.6),
    ),
)

# The sensing fingertip: joint axis at z = 0, pad from z = 14 to the rounded end.
FINGER_LINK2 = Shape(
    along=2,
    facing=0,
    middle=-3.0,
    front_exponent=2.9,
    back_exponent=2.8,
    num_rings=26,
    num_around=32,
    stations=(
        Station(-7.8, -0.1, 7.9, -1.0, -4.5),
        Station(-6.0, -0.1, 8.2, 5.2, -6.5),
        Station(-2.0, -0.1, 8.5, 7.8, -8.2),
        Station(4.0, -0.1, 8.8, 8.4, -9.5),
        Station(10.0, 0.0, 8.8, 9.6, -11.0),
        Station(15.0, 0.0, 9.1, 10.3, -11.1),
        Station(20.0, 0.0, 8.9, 10.5, -10.7),
        Station(26.0, 0.0, 8.6, 10.0, -10.2),
        Station(31.0, 0.0, 8.3, 9.4, -9.8),
        Station(35.0, 0.0, 7.7, 8.5, -9.3),
        Station(38.0, 0.0, 6.7, 7.1, -8.7),
        Station(40.0, 0.0, 5.5, 5.5, -7.7),
        Station(41.0, 0.0, 4.5, 4.1, -6.9),
        Station(41.8, 0.0, 3.3, 2.1, -6.0),
        Station(42.3, 0.0, 1.6, -0.8, -4.8),
    ),
)

# The block that swings the index sideways: joint axis through the origin, next joint axis at z = 17.8.
INDEX_BEND = Shape(
    along=2,
    facing=0,
    middle=0.0,
    front_exponent=6.0,
    back_exponent=6.0,
    num_rings=12,
    num_around=24,
    stations=(
        Station(-3.5, 0.0, 8.0, 9.0, -13.0),
        Station(2.0, 0.0, 8.2, 9.5, -13.0),
        Station(10.0, 0.0, 8.2, 9.5, -12.5),
        Station(18.0, 0.0, 8.2, 9.4, -10.8),
        Station(23.0, 0.0, 8.2, 8.0, -9.0),
        Station(26.0, 0.0, 7.8, 4.7, -7.6),
        Station(27.3, 0.0, 7.2, 1.5, -3.5),
    ),
)

# The fork that carries the thumb: joint axis z through the origin, next joint axis near y = 28.6.
THUMB_BEND = Shape(
    along=1,
    facing=2,
    middle=0.0,
    front_exponent=4.0,
    back_exponent=4.0,
    num_rings=14,
    num_around=24,
    stations=(
        Station(-9.0, 0.0, 3.5, 6.0, -6.5),
        Station(-5.0, 0.0, 7.6, 7.5, -7.9),
        Station(0.0, 0.0, 9.0, 7.6, -7.9),
        Station(15.0, -1.0, 8.6, 7.8, -7.9),
        Station(22.0, -0.5, 9.8, 9.0, -8.4),
        Station(30.0, 0.0, 10.0, 9.2, -8.6),
        Station(35.0, 0.0, 9.6, 7.0, -5.5),
        Station(37.2, 0.0, 8.6, 3.0, -2.0),
    ),
)

# The broad thumb: lug at x = −9 around the joint axis (y = 0), lug at x = 9.5 around the next one (y = 55.3).
THUMB_LINK1 = Shape(
    along=1,
    facing=2,
    middle=0.0,
    front_exponent=10.0,
    back_exponent=2.4,
    num_rings=26,
    num_around=36,
    stations=(
        Station(-10.3, -8.8, 4.6, 2.0, -2.0),
        Station(-8.0, -8.8, 5.0, 6.7, -6.7),
        Station(-4.0, -8.5, 5.4, 9.6, -10.2),
        Station(2.0, -6.0, 9.0, 10.3, -12.0),
        Station(7.0, -1.5, 15.5, 10.4, -14.2),
        Station(11.0, -0.3, 18.0, 10.8, -15.3),
        Station(15.0, -0.2, 18.3, 11.3, -16.2),
        Station(20.0, -0.2, 18.2, 11.7, -17.0),
        Station(30.0, -0.2, 18.2, 12.1, -18.0),
        Station(40.0, -0.2, 18.1, 11.9, -17.9),
        Station(45.0, -0.2, 18.3, 11.4, -17.5),
        Station(49.0, 1.5, 15.5, 10.8, -16.5),
        Station(53.0, 6.5, 8.5, 10.5, -12.5),
        Station(58.0, 9.2, 5.2, 10.1, -10.5),
        Station(63.0, 9.4, 4.8, 7.0, -8.2),
        Station(66.8, 9.4, 4.3, 0.5, -6.0),
    ),
)

# The thumb's sensing tip: joint axis at y = 0, pad from y = 16 to the rounded end.
THUMB_LINK2 = Shape(
    along=1,
    facing=2,
    middle=-3.0,
    front_exponent=2.35,
    back_exponent=2.8,
    num_rings=26,
    num_around=36,
    stations=(
        Station(-7.7, 0.0, 15.5, -1.0, -5.0),
        Station(-5.5, 0.0, 16.2, 5.5, -7.0),
        Station(-1.0, 0.0, 16.8, 8.0, -11.0),
        Station(5.0, 0.0, 16.6, 8.6, -15.1),
        Station(12.0, 0.0, 15.5, 10.2, -15.0),
        Station(17.0, 0.0, 14.9, 11.0, -14.9),
        Station(20.0, 0.0, 14.9, 11.0, -14.8),
        Station(25.0, 0.0, 15.0, 10.7, -14.5),
        Station(30.0, 0.0, 14.8, 10.1, -13.5),
        Station(35.0, 0.0, 14.1, 9.2, -13.2),
        Station(40.0, 0.0, 12.8, 8.0, -12.5),
        Station(44.0, 0.0, 11.1, 6.6, -11.4),
        Station(47.0, 0.0, 9.0, 4.7, -10.2),
        Station(49.0, 0.0, 6.6, 2.4, -9.1),
        Station(50.0, 0.0, 5.0, 0.4, -8.2),
        Station(50.7, 0.0, 3.0, -1.9, -6.5),
    ),
)

SHAPES = {
    "palm": PALM,
    "finger_link1": FINGER_LINK1,
    "finger_link2": FINGER_LINK2,
    "index_bend": INDEX_BEND,
    "thumb_bend": THUMB_BEND,
    "thumb_link1": THUMB_LINK1,
    "thumb_link2": THUMB_LINK2,
}

if __name__ == "__main__":
    write(SHAPES, ASSETS)
