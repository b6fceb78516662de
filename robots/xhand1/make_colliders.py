"""Fit the XHand1's primitive colliders to its meshes: `colliders.yaml` of the right hand.

Run `python robots/xhand1/make_colliders.py` to write it again; it prints how far the primitives are from the surfaces.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # as a script, this sees only its own folder

from robots.colliders import Link, Primitive
from robots.colliders_file import write

FOLDER = Path(__file__).resolve().parent
FRONT, END = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)

PALM = Link(
    primitives=(
        Primitive("box", (2, -2, 58), (20.6, 36, 29), is_core=True),
        Primitive("box", (0, -2, 20), (22, 24, 20)),
        Primitive("capsule", (12.8, 36, 58), (9.5,), (12.8, 36, 86), is_pair=True),
        Primitive("capsule", (12.8, 36, 56), (9.5,), (12.8, 32, 40), is_pair=True),
        Primitive("capsule", (12.8, 31, 39), (9.5,), (12.8, 24, 24), is_pair=True),
        Primitive("capsule", (13, -32, 84), (9,), (13, 28, 84)),
        Primitive("capsule", (9, -32, 95), (8,), (9, 28, 95)),
    ),
    touched=(FRONT,),
    region=((0, -50, 28), (30, 46, 94)),
    lateral=1,
    middle=-2.0,
)
FINGER_LINK1 = Link(
    primitives=(
        Primitive("capsule", (-6, 0, 8), (8.5,), (-7, 0, 52), is_core=True),
        Primitive("box", (3, 0, 36), (7.2, 7.2, 16)),
        Primitive("box", (1, 0, 8), (6.5, 7.2, 12)),
        Primitive("capsule", (3, -3, 57), (6,), (3, 3, 57)),
    ),
    touched=(FRONT,),
    region=((0, -10, 0), (20, 10, 60)),
    lateral=1,
)
FINGER_LINK2 = Link(
    primitives=(
        Primitive("capsule", (-0.5, 0, 2), (8.8,), (0.5, 0, 33), is_core=True),
        Primitive("capsule", (0, 0, 12), (9,), (1.2, 0, 24)),
        Primitive("sphere", (-1, 0, 35), (7.2,)),
    ),
    touched=(FRONT, (1.0, 0.0, 1.0), END),
    region=((-3, -10, 8), (20, 10, 50)),
    lateral=1,
)
INDEX_BEND = Link(
    primitives=(
        Primitive("box", (-1.8, 0, 10), (11, 8, 14), is_core=True),
        Primitive("capsule", (0, -2, 18), (8,), (0, 2, 18)),
    ),
    touched=(FRONT,),
    region=((0, -10, -3), (20, 10, 24)),
    lateral=1,
)
THUMB_FRONT, THUMB_END = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
THUMB_BEND = Link(
    primitives=(
        Primitive("box", (-0.4, 14, -1), (8, 19, 6), is_core=True),
        Primitive("capsule", (2.8, 0, 1.8), (6,), (3.4, 27, 2.4), is_pair=True),
    ),
    touched=(THUMB_FRONT,),
    region=((-20, -2, 0), (20, 30, 20)),
    lateral=0,
    middle=-0.4,
)
THUMB_LINK1 = Link(
    primitives=(
        Primitive("box", (0, 28, 3), (17.0, 18.5, 8.5), is_core=True),
        Primitive("box", (-7, 2, 0), (7, 8, 9.5)),
        Primitive("box", (9, 54, 0), (5, 8, 10)),
        Primitive("capsule", (-12.5, 16, 6), (5,), (-12.5, 42, 6)),
        Primitive("capsule", (12.5, 16, 6), (5,), (12.5, 42, 6)),
        Primitive("capsule", (-6, 18, -5), (11,), (-6, 38, -6)),
        Primitive("capsule", (6, 18, -5), (11,), (6, 38, -6)),
    ),
    touched=(THUMB_FRONT,),
    region=((-20, 13, 0), (20, 45, 20)),
)
THUMB_LINK2 = Link(
    primitives=(
        Primitive("capsule", (4, 12, -2), (11,), (4, 32, -2), is_pair=True),
        Primitive("capsule", (2, 20, -1), (11,), (2, 38, -3), is_pair=True),
        Primitive("capsule", (-5, 3, -3), (10,), (5, 3, -3), is_core=True),
    ),
    touched=(THUMB_FRONT, (0.0, 1.0, 1.0), THUMB_END),
    region=((-20, 8, -3), (20, 60, 20)),
    lateral=0,
)
LINKS = {
    "palm": PALM,
    "thumb_bend": THUMB_BEND,
    "thumb_link1": THUMB_LINK1,
    "thumb_link2": THUMB_LINK2,
    "index_bend": INDEX_BEND,
    "finger_link1": FINGER_LINK1,
    "finger_link2": FINGER_LINK2,
}

if __name__ == "__main__":
    write(FOLDER / "xhand1_right.xml", LINKS)
