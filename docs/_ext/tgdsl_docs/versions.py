"""Write `versions.js`, which the pages' version switcher reads, and an `index.html` that opens the newest version.

The argument is the folder that has a folder of pages per version: build/docs.
"""

import json
import sys
from pathlib import Path

from packaging.version import Version


def main() -> None:
    """List the versions, newest first."""
    folder = Path(sys.argv[1])
    names = sorted((inventory.parent.name for inventory in folder.glob("*/objects.inv")), key=Version, reverse=True)
    (folder / "versions.js").write_text(f"const VERSIONS = {json.dumps(names)};\n", encoding="utf-8")
    page = f'<!doctype html><meta http-equiv="refresh" content="0; url={names[0]}/index.html">\n'
    (folder / "index.html").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
