"""A probe-bearing pad and one object of a given shape, for closed-form cases."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState


def module(
    folder: Path,
    probes: Sequence[Sequence[float]],
    geom: str,
    *,
    radius: float = 0.01,
    dtype: torch.dtype = torch.float64,
    gate: str | None = "geometric",
    **sensor: Any,
) -> TactileModule:
    """Return a module with one sensor, `s`, whose probes [m] are on the body `pad`; the object's geom is MJCF text."""
    path = folder / "scene.xml"
    joint = "" if "plane" in geom else "<freejoint/>"  # MuJoCo allows planes in static bodies only
    path.write_text(
        f'<mujoco><worldbody><body name="pad"><freejoint/><geom type="sphere" size=".05"/></body>'
        f'<body name="item">{joint}{geom}</body></worldbody></mujoco>'
    )
    points = [{"pos": [float(value) for value in probe], "normal": [0, 0, 1], "radius": radius} for probe in probes]
    document = {
        "tgdsl": 1,
        "robot": {"model": str(path), "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": points}}}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": {"links": "pad", "feels": ["item"], **({"gate": gate} if gate else {}), **sensor}},
    }
    return tgdsl.compile(document, dtype=dtype)


def state(touch: TactileModule, **item: Sequence[float]) -> SceneState:
    """Return a state with everything at rest at the origin, but for what is said of the item: pos, quat, linvel, angvel."""
    rest = {"pos": [0, 0, 0], "quat": [1, 0, 0, 0], "linvel": [0, 0, 0], "angvel": [0, 0, 0]}
    values = {}
    for name, default in rest.items():
        rows = [item.get(name, default) if body == "item" else default for body in touch.inputs.bodies]
        values[f"body_{name}"] = torch.tensor(np.array([rows], dtype=float))
    if touch.inputs.pairs:
        values["contact_found"] = torch.ones(1, len(touch.inputs.pairs))
    return SceneState(**values)
