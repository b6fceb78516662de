"""How two documents of a task differ."""

from __future__ import annotations

import json
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
    return [] if before == now else [f"{path}: {json.dumps(before)}, now {json.dumps(now)}"]


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
    own, other = ({name: value for name, value in spec.items() if name not in leave_out} for spec in (before, now))
    return differences(own, other)
