"""Fit the Sharpa Wave's primitive colliders to its meshes: `colliders.yaml` of the right hand.

Run `python robots/sharpa/make_colliders.py` to write it again; it prints how far the primitives are from the surfaces.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # as a script, this sees only its own folder

from robots.colliders import Link, Primitive
from robots.colliders_file import write

FOLDER = Path(__file__).resolve().parent
FRONT = (1.0, 0.0, 0.0)

# The palm's face is a hollow between the fingers' head and the balls of thumb and pinky. Of concave surfaces boxes are sections
# of planes, whose other faces are inside the palm.
PALM = Link(
    primitives=(
        Primitive("box", (1.3, 7.5, 70.5), (18.1, 27.5, 9.6), turn=(0.1, 0.2, 0.9), is_core=True),
        Primitive("box", (-1.1, -14.8, 38), (20.4, 4.7, 26), turn=(-3.3, 0.2, 2.2)),
        Primitive("box", (-2.8, 0, 30), (19.4, 12.2, 17), turn=(20.4, -3, 12.5)),
        Primitive("box", (-1.5, -3.1, 59.5), (20.5, 11.9, 8.6), turn=(29.7, 8.7, 4)),
        Primitive("box", (-3.1, 11.8, 35.5), (17.1, 13.1, 16), turn=(-4, -9.5, 7), is_core=True),
        Primitive("box", (-1.8, 15.2, 58.7), (19.1, 13, 10), turn=(10.6, 19.3, 1)),
        Primitive("box", (-5.1, 27.9, 33.3), (14.4, 6.2, 16), turn=(-13.7, 3.4, 20.9)),
        Primitive("box", (-1.7, 31.5, 54.7), (15.9, 5.1, 10.5), turn=(-0.3, 24.7, -5.3)),
        Primitive("box", (0.5, -1.2, 16.2), (15.7, 27.5, 14), turn=(4.8, -2.8, 3.6)),
        Primitive("capsule", (1, 33, 55.1), (14.3,), (2, 32.8, 68.9)),
        Primitive("capsule", (14.1, -1.7, 45.4), (3,), (13.2, 3.3, 46.5)),
        Primitive("capsule", (9.9, 26.4, 44), (2.5,), (8.9, 30.5, 43.6)),
        Primitive("capsule", (15.2, 29.2, 59), (3,), (15.4, 31.9, 60)),
    ),
    touched=(FRONT,),
    region=((4, -16, 34), (30, 36, 78)),
    count=4000,
    is_hollow=True,
)
PINKY_MC = Link(
    primitives=(
        Primitive("box", (11, 3, -33), (21.3, 7.5, 19), is_core=True),
        Primitive("capsule", (0, 8, -50), (10,), (0, 8, -40)),
        Primitive("capsule", (0, 8, -40), (10,), (0, 8, -16)),
        Primitive("capsule", (14, 8, -48), (11,), (14, 8, -18)),
    ),
    touched=((-1.0, 0.0, 0.0),),
    region=((-15, -4, -52), (5, 11.5, -15)),
    count=3000,
)
MCP = Link(primitives=(Primitive("box", (0, 0, 0), (8.5, 9, 5.6), is_core=True),))
PP = Link(
    primitives=(
        Primitive("capsule", (19, 0, -2), (8.6,), (46, 0, -1), is_core=True),
        Primitive("capsule", (19, 2, 4), (7,), (33, 2, 3.4), is_pair=True),
        Primitive("capsule", (33, 2, 3.4), (6.5,), (44, 2, 1.5), is_pair=True),
        Primitive("capsule", (17, -3, 5), (5,), (17, 3, 5)),
    ),
    touched=((0.0, 0.0, 1.0),),
    region=((13, -10, 2), (41, 10, 20)),
    lateral=1,
)
MP = Link(
    primitives=(
        Primitive("capsule", (9, -1.5, 0), (8,), (28, -1.2, 0), is_core=True),
        Primitive("capsule", (14, 1, 0), (7.8,), (24, 0, 0)),
        Primitive("capsule", (13, 2, -2), (6,), (13, 2, 2)),
    ),
    touched=((0.0, 1.0, 0.0),),
    region=((9, 0, -10), (27, 20, 10)),
    lateral=2,
)
DP = Link(
    primitives=(
        Primitive("sphere", (7, -2, 0), (7.6,), is_core=True),
        Primitive("capsule", (11, -6, -3), (2.5,), (22, -7, -2), is_pair=True),
    ),
    lateral=2,
)
ELASTOMER = Link(
    primitives=(
        Primitive("capsule", (0, -16.5, 2), (7.1,), (0, -19.5, 2.2), is_core=True),
        Primitive("capsule", (-2, -13, 0), (5.5,), (2, -13, 0)),
        Primitive("capsule", (0, -20, 2), (6.4,), (0, -21, 3)),
    ),
    touched=((0.0, 0.0, -1.0), (0.0, -1.0, -1.0), (0.0, -1.0, 0.0)),
    region=((-10, -30, -10), (10, -10.5, 2)),
    lateral=0,
)
THUMB_MC = Link(
    primitives=(
        Primitive("box", (38, -9, 11), (20, 14, 10), turn=(30, 0, 0), is_core=True),
        Primitive("capsule", (24, -1, 6), (7.5,), (44, -0.5, 6)),
        Primitive("capsule", (24, 2, 11.5), (7.5,), (40, 3, 11.5)),
        Primitive("capsule", (24, -2, 14.5), (7.5,), (40, -1.5, 14.5)),
        Primitive("capsule", (24, -7, 17.5), (7.5,), (44, -6.5, 17.5)),
        Primitive("capsule", (44, -0.5, 6), (7.5,), (60, -4, 5)),
        Primitive("capsule", (44, 0, 11.5), (7.5,), (60, -4, 9)),
        Primitive("capsule", (44, -6.5, 17.5), (7.5,), (60, -9, 14)),
        Primitive("capsule", (16, -5, 11), (6,), (16, -8, 16)),
    ),
    touched=((0.0, 0.866, 0.5),),
    region=((18, -1, 6), (56, 20, 26.5)),
    count=3000,
)
THUMB_PP = Link(
    primitives=(
        Primitive("capsule", (18, 0, -3), (9,), (36, 0, -1.5), is_core=True),
        Primitive("capsule", (19, 1.5, 2), (8,), (33, 1.5, 1.5), is_pair=True),
        Primitive("capsule", (17, -2.5, 3), (6.5,), (17, 2.5, 3)),
    ),
    touched=((0.0, 0.0, 1.0),),
    region=((12, -10, 1), (34, 10, 20)),
    lateral=1,
)
THUMB_DP = Link(
    primitives=(
        Primitive("sphere", (8, -2, 0), (8.8,), is_core=True),
        Primitive("capsule", (12, -7, -3.5), (2.8,), (24, -8, -2), is_pair=True),
    ),
    lateral=2,
)
THUMB_ELASTOMER = Link(
    primitives=(
        Primitive("capsule", (0, -18.5, 2), (8.2,), (0, -22, 3.4), is_core=True),
        Primitive("capsule", (-2, -15, 0), (6.4,), (2, -15, 0)),
        Primitive("capsule", (0, -22, 3), (7.2,), (0, -23.5, 5)),
    ),
    touched=((0.0, 0.0, -1.0), (0.0, -1.0, -1.0), (0.0, -1.0, 0.0)),
    region=((-12, -33, -12), (12, -12.5, 3)),
    lateral=0,
)
LINKS = {
    "palm_base": PALM,  # and the palm's other meshes
    "pinky_mc": PINKY_MC,
    "mcp": MCP,
    "pp": PP,
    "mp": MP,
    "dp": DP,
    "elastomer": ELASTOMER,
    "thumb_mc": THUMB_MC,
    "thumb_pp": THUMB_PP,
    "thumb_dp": THUMB_DP,
    "thumb_elastomer": THUMB_ELASTOMER,
}

if __name__ == "__main__":
    write(FOLDER / "sharpa_right.xml", LINKS)
