"""MuJoCo's `<option>` by name: settings of the physics that are changed without an edit of XML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from tgdsl.errors import SimulationError, did_you_mean

Options = Mapping[str, float | int | str | Sequence[float]]
"""Values of fields of MuJoCo's `mjOption` by name; of those with keywords, the keyword that MJCF has."""
KEYWORDS: Mapping[str, Any] = {
    "cone": mujoco.mjtCone,
    "integrator": mujoco.mjtIntegrator,
    "jacobian": mujoco.mjtJacobian,
    "solver": mujoco.mjtSolver,
}
"""Fields whose values have names, and the enumeration of these."""
_POSITIVE = ("timestep", "impratio")
_MOST = 2**31 - 1  # MuJoCo's integers have 32 bits


def option_names() -> tuple[str, ...]:
    """Return the names of MuJoCo's options, sorted."""
    return tuple(sorted(name for name in dir(mujoco.MjOption) if not name.startswith("_") and name not in _METHODS))


_METHODS = {name for name in dir(mujoco.MjOption) if callable(getattr(mujoco.MjOption, name, None))}


def set_options(option: Any, options: Options) -> None:
    """Set options of a model or a spec, all or none.

    Args:
        option: `MjModel.opt` or `MjSpec.option`.
        options: Values by name, such as `{"timestep": 0.005, "cone": "pyramidal", "iterations": 10}`, in MuJoCo's units.

    Raises:
        SimulationError: If there is no such option or keyword, or a value does not fit.
    """
    values = {name: _value(option, name, given) for name, given in options.items()}
    for name, value in values.items():
        setattr(option, name, value)


def _value(option: Any, name: str, given: Any) -> Any:
    """Return the value of an option as MuJoCo has it."""
    if name not in option_names():
        raise SimulationError(f'MuJoCo has no option "{name}"; {did_you_mean(name, option_names(), "options")}')
    if name in KEYWORDS:
        return _keyword(name, given)
    now = getattr(option, name)
    try:
        value = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError):
        value = np.array(np.nan)
    is_whole = isinstance(now, int)
    bound = "more than 0" if name in _POSITIVE else "at least 0" if is_whole or name.endswith("tolerance") else ""
    expected = " ".join(filter(None, ["a whole number" if is_whole else "a number", bound]))
    if np.shape(now):
        expected = f"{np.size(now)} numbers"
    is_fit = value.shape == np.shape(now) and bool(np.isfinite(value).all()) and (not is_whole or value == np.round(value))
    if is_fit and is_whole and value > _MOST:
        is_fit, expected = False, f"{expected} and at most {_MOST}"
    if not is_fit or (bound == "more than 0" and value <= 0) or (bound == "at least 0" and value < 0):
        raise SimulationError(f"option {name} is {given!r}, expected {expected}")
    return value if value.shape else int(value) if is_whole else float(value)


def _keyword(name: str, given: Any) -> int:
    """Return the number of a keyword, which may be given as that number."""
    known = {member.name.partition("_")[2].lower(): int(member) for member in KEYWORDS[name].__members__.values()}
    if isinstance(given, str) and given.lower() in known:
        return known[given.lower()]
    if not isinstance(given, str) and np.ndim(given) == 0 and given in known.values():
        return int(given)
    shown = f'"{given}"' if isinstance(given, str) else repr(given)
    raise SimulationError(f"option {name} is {shown}; {did_you_mean(str(given).lower(), known, 'values')}")
