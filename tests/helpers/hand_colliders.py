"""The fit of primitive colliders, `robots/colliders.py`, and what writes them, `robots/colliders_file.py`, as modules."""

import importlib
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]

sys.path.append(str(ROOT))  # as the hands' scripts have it
fit = importlib.import_module("robots.colliders")
written = importlib.import_module("robots.colliders_file")
