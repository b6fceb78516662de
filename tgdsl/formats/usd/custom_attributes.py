"""Custom attributes `tgdsl:<MJCF's name>`: what MuJoCo has and USD has no schema for, written on export and read on import.

Their values are MJCF's: SI units and radians, whatever the units of the stage. MuJoCo's defaults are not written.

A value that USD keeps in float32 has a twin in double, `tgdsl:<USD's own name>`, in USD's unit. It counts as long as USD's
value is what it rounds to: who edits the stage edits USD's.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import mujoco
import numpy as np

from tgdsl.formats.usd.stage import NAMESPACE, Prim, Stage

AttributeTable = dict[str, str]
"""Attributes of an MJCF element, and the arrays of `MjModel` (or fields of `MjOption`, `MjsMesh`) that hold their values."""
GEOM: AttributeTable = {
    "condim": "geom_condim",
    "priority": "geom_priority",
    "friction": "geom_friction",
    "solmix": "geom_solmix",
    "solref": "geom_solref",
    "solimp": "geom_solimp",
    "margin": "geom_margin",
    "gap": "geom_gap",
    "contype": "geom_contype",
    "conaffinity": "geom_conaffinity",
}
JOINT: AttributeTable = {
    "margin": "jnt_margin",
    "stiffness": "jnt_stiffness",
    "actuatorgravcomp": "jnt_actgravcomp",
    "solreflimit": "jnt_solref",
    "solimplimit": "jnt_solimp",
    "solreffriction": "dof_solref",
    "solimpfriction": "dof_solimp",
}
SITE: AttributeTable = {"type": "site_type", "size": "site_size", "group": "site_group", "rgba": "site_rgba"}
MESH: AttributeTable = {"maxhullvert": "maxhullvert", "inertia": "inertia"}
OPTION: AttributeTable = {
    name: name
    for name in (
        *(
            "timestep",
            "integrator",
            "cone",
            "impratio",
            "jacobian",
            "solver",
            "iterations",
            "tolerance",
            "density",
            "viscosity",
        ),
        *("ls_iterations", "ls_tolerance", "noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance"),
        *("sdf_iterations", "sdf_initpoints", "wind", "magnetic", "o_margin", "o_solref", "o_solimp", "o_friction"),
    )
}
KEYWORDS = {
    "type": ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box"),
    "inertia": ("convex", "exact", "legacy", "shell"),
    "integrator": ("Euler", "RK4", "implicit", "implicitfast", "discrete"),
    "cone": ("pyramidal", "elliptic"),
    "jacobian": ("dense", "sparse", "auto"),
    "solver": ("PGS", "CG", "Newton"),
}
"""MJCF's keywords, in the order of MuJoCo's enumerations."""
FLAGS = {"disable": (mujoco.mjtDisableBit, "mjDSBL_"), "enable": (mujoco.mjtEnableBit, "mjENBL_")}
"""MuJoCo's flags that are written if set, as lists of MJCF's names, and their bits."""
KNOWN_FLAGS = ("gravity", "filterparent")
"""Flags that USD has attributes for."""


@cache
def default_model() -> mujoco.MjModel:
    """Return a model with MuJoCo's default value of every attribute in the tables."""
    inside = '<body><joint/><geom type="sphere" size="1"/><site/></body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")


def non_default(table: AttributeTable, own: Any, usual: Any) -> dict[str, Any]:
    """Return the values of a table that are not MuJoCo's defaults, by MJCF's names, as `set_custom` takes them.

    Args:
        table: The attributes.
        own: By the array's name, an element's value: any callable.
        usual: The same of an element with MuJoCo's defaults.
    """
    result = {}
    for attribute, array in table.items():
        value = np.asarray(own(array))
        if not np.array_equal(value, usual(array)):
            result[attribute] = KEYWORDS[attribute][int(value)] if attribute in KEYWORDS else value.tolist()
    return result


def flag_names(key: str) -> dict[str, int]:
    """Return MJCF's names of the flags of `disable` or `enable`, and their bits."""
    bits, prefix = FLAGS[key]
    return {name.removeprefix(prefix).lower(): int(bit) for name, bit in bits.__members__.items() if name.startswith(prefix)}


def non_default_flags(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Return the flags of a model that are set and that USD has no attribute for, by `disable` and `enable`."""
    result = {}
    for key in FLAGS:
        value = int(getattr(model.opt, f"{key}flags"))
        result[key] = [name for name, bit in flag_names(key).items() if value & bit and name not in KNOWN_FLAGS]
    return {key: names for key, names in result.items() if names}


def read_custom(stage: Stage, prim: Prim, key: str) -> Any:
    """Return the value of a custom attribute, or None."""
    return stage.authored(prim, f"{NAMESPACE}{key}")


def read_mjcf_attributes(stage: Stage, prim: Prim, attributes: Iterable[str]) -> dict[str, str]:
    """Return a prim's custom attributes as attributes of an MJCF element."""
    result = {attribute: read_custom(stage, prim, attribute) for attribute in attributes}
    return {attribute: text_of(value) for attribute, value in result.items() if value is not None}


def read_option_flags(stage: Stage, scene: Prim) -> dict[str, str]:
    """Return a physics scene's solver flags as attributes of an MJCF element."""
    return {str(name): key for key in FLAGS for name in read_custom(stage, scene, key) or ()}


def text_of(value: Any) -> str:
    """Return a value as MJCF writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (str, int, float)):
        return str(value)
    return " ".join(str(number) if isinstance(number, int) else repr(float(number)) for number in value)
