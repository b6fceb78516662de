"""How two documents of a task differ."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

from pydantic import ValidationError

from tgdsl.rl.spec import TaskSpec


def differences(before: Any, now: Any, path: str = "") -> list[str]:
    """Return how two plain values differ, a line each: `rewards.spin: 2.0, now 3.0`."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = dict.fromkeys((*before, *now))
        return [line for name in names for line in differences(before.get(name), now.get(name), f"{path}.{name}".lstrip("."))]
    return [] if is_close(before, now) else [f"{path}: {json.dumps(before)}, now {json.dumps(now)}"]


def is_close(one: Any, other: Any) -> bool:
    """Return whether plain values are equal, numbers but for rounding: 0.7 cm are not quite 7 mm."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(is_close(value, other[name]) for name, value in one.items())
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(is_close, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9)
    return one == other


def spec_differences(
    before: Mapping[str, Any], now: Mapping[str, Any], model: type[TaskSpec], leave_out: tuple[str, ...] = ()
) -> list[str]:
    """Return how two documents differ.

    Args:
        before: The earlier one; what its version of tgdsl did not know has its default.
        now: The later one, of today's fields.
        model: Model of the task's document.
        leave_out: Names at the top that may differ.
    """
    with suppress(ValidationError):  # of a version with other names: what it had is told as it was
        before = model.model_validate(before).model_dump(mode="json")
    left, other = ({name: value for name, value in spec.items() if name not in leave_out} for spec in (before, now))
    return differences(left, other)
