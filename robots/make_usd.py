"""Write the USD twin of each robot beside its MJCF file: `robots/xhand1/xhand1_right.xml` gives `xhand1_right.usda`.

Run `python robots/make_usd.py` to write all of them again (the same bytes every time).
"""

from __future__ import annotations

from pathlib import Path

from tgdsl.formats.robot import export_model

ROBOTS = Path(__file__).parent


def main() -> None:
    """Write the twins."""
    for file in sorted(ROBOTS.glob("*/*.xml")):
        export_model(file, file.with_suffix(".usda"))


if __name__ == "__main__":
    main()
