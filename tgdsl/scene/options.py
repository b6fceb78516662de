"""MuJoCo's `<option>` by name, and how stiff contacts are: settings of the physics that are changed without an edit of XML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Any

import mujoco
import numpy as np

from tgdsl.errors import SimulationError, did_you_mean

Options = Mapping[str, float | int | str | Sequence[float | int] | Mapping[str, float]]
"""Values of fields of MuJoCo's `mjOption` by name; of those with keywords, the keyword that MJCF has. Also `solref` and
`solimp`, which all geoms and pairs then have, and `max_torque`, by names or shell wildcards of joints the largest torque of
their actuators [N·m; slides: N]."""
KEYWORDS: Mapping[str, Any] = {
    "cone": mujoco.mjtCone,
    "integrator": mujoco.mjtIntegrator,
    "jacobian": mujoco.mjtJacobian,
    "solver": mujoco.mjtSolver,
}
"""Fields whose values have names, and the enumeration of these."""
CONTACTS: Mapping[str, int] = {"solref": mujoco.mjNREF, "solimp": mujoco.mjNIMP}
"""What all geoms and pairs may be given, and how many numbers these are."""
_POSITIVE = ("timestep", "impratio")
_MOST = 2**31 - 1  # MuJoCo's integers have 32 bits


_METHODS = {name for name in dir(mujoco.MjOption) if name.startswith("_") or callable(getattr(mujoco.MjOption, name, None))}
OPTION_NAMES = tuple(sorted(set(dir(mujoco.MjOption)) - _METHODS))


def set_options(spec: mujoco.MjSpec, options: Options) -> None:
    """Set options of a scene, all or none.

    Args:
        spec: The scene.
        options: Values by name, such as `{"timestep": 0.005, "cone": "pyramidal", "solref": [0.01, 1]}`, in MuJoCo's units.

    Raises:
        SimulationError: If there is no such option or keyword, or a value does not fit, as MuJoCo would silently take another.
    """
    option, torques = spec.option, dict[str, Any](options).get("max_torque", {})
    options = {name: value for name, value in options.items() if name != "max_torque"}
    values = {name: _value(option, name, value) for name, value in options.items() if name not in CONTACTS}
    steps = float(values.get("timestep", option.timestep)), int(values.get("disableflags", option.disableflags))
    contacts = {name: _contact(name, value, *steps) for name, value in options.items() if name in CONTACTS}
    for name, value in values.items():
        setattr(option, name, value)
    for name, value in contacts.items():
        for element in (*spec.geoms, *spec.pairs):
            setattr(element, name, value)
    for actuator in spec.actuators:
        for pattern, torque in torques.items():
            if actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT and fnmatchcase(actuator.target, pattern):
                actuator.forcelimited, actuator.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-torque, torque]


def _contact(name: str, given: Any, timestep: float, disabled: int) -> list[float]:
    """Return what all contacts are given, as MuJoCo has it."""
    try:
        value = [float(number) for number in given]
    except (TypeError, ValueError):
        value = []
    is_fit, expected = len(value) == CONTACTS[name] and bool(np.isfinite(value).all()), f"{CONTACTS[name]} numbers"
    if is_fit and name == "solref":
        is_fit, expected = min(value) > 0 or max(value) <= 0, "a time constant [s] and a damping ratio, or −k and −b"
        is_safe = not disabled & mujoco.mjtDisableBit.mjDSBL_REFSAFE
        if is_fit and is_safe and 0 < value[0] < 2 * timestep:
            is_fit, expected = False, f"a time constant of at least {2 * timestep:g} s, twice the timestep"
    elif is_fit:
        low, high, width, middle, power = value
        bounds = (mujoco.mjMINIMP, mujoco.mjMAXIMP)
        is_fit = all(bounds[0] <= number <= bounds[1] for number in (low, high, middle)) and width >= 0 and power >= 1
        expected = f"impedances and midpoint from {bounds[0]:g} to {bounds[1]:g}, a width of at least 0, a power of at least 1"
    if not is_fit:
        raise SimulationError(f"option {name} is {given!r}, expected {expected}")
    return value


def _value(option: Any, name: str, given: Any) -> Any:
    """Return the value of an option as MuJoCo has it."""
    names = (*OPTION_NAMES, *CONTACTS)
    if name not in names:
        raise SimulationError(f'MuJoCo has no option "{name}"; {did_you_mean(name, names, "options")}')
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
    numbers = {member.name.partition("_")[2].lower(): int(member) for member in KEYWORDS[name].__members__.values()}
    if isinstance(given, str) and given.lower() in numbers:
        return numbers[given.lower()]
    if not isinstance(given, str) and np.ndim(given) == 0 and given in numbers.values():
        return int(given)
    text = f'"{given}"' if isinstance(given, str) else repr(given)
    raise SimulationError(f"option {name} is {text}; {did_you_mean(str(given).lower(), numbers, 'values')}")
