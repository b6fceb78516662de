"""Compare the XHand1's surfaces with the vendor's: distance and angle from our taxels to the same link's mesh there.

Run `python robots/xhand1/measure.py REFERENCE_DIR`; the folder holds the vendor's URDF and meshes (see README.md).
Exits with 1 if the mean distance is 1 mm or more, the mean angle 20° or more, or the two give different taxel counts.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # as a script, this sees only its own folder

from robots.measure import compare

if __name__ == "__main__":
    compare(Path(__file__).resolve().parent, "xhand1_right.xml")
