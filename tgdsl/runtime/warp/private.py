"""Private parts of MuJoCo Warp that contacts are read with: all there are in this project, each with its reason.

Tried with MuJoCo Warp 3.17.0. Another version may lack them; then an error names both.
"""

from __future__ import annotations

from functools import reduce
from importlib.metadata import version
from typing import Any

from tgdsl.errors import SimulationError

TRIED = ("3.17.0",)
"""Versions of MuJoCo Warp that have these parts as they are used here."""


def contact_force_function(mjw: Any) -> Any:
    """Return the Warp function of a contact's force and torque in its frame, for use inside a kernel.

    The public `mujoco_warp.contact_force` is a kernel's launch over a list of contacts: a kernel can call a function, but no
    kernel, and to launch both would need the list, and memory for its answers, on the device.

    Raises:
        SimulationError: If this version has none.
    """
    return _part(mjw, "support.contact_force_fn")


def constraint_contact_bit(mjw: Any) -> int:
    """Return the bit of `Contact.type` of contacts that carry force, rather than those that only sensors look for.

    `Contact.type` is public, the enumeration of its values is not.

    Raises:
        SimulationError: If this version has none.
    """
    return int(_part(mjw, "types.ContactType.CONSTRAINT"))


def _part(mjw: Any, path: str) -> Any:
    try:
        return reduce(getattr, path.split("."), mjw._src)
    except AttributeError as error:
        tried = ", ".join(TRIED)
        what = f"MuJoCo Warp {version('mujoco-warp')} has no `{path}`, which contacts are read with"
        raise SimulationError(f"{what}; tried was {tried}") from error
