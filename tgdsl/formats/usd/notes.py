"""What MuJoCo has and USD has no word for: attributes `tgdsl:<MJCF's name>`, that the exporter writes and the importer reads.

Their values are MJCF's: SI units and radians, whatever the units of the stage. What MuJoCo has by default is not noted.

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

Notes = dict[str, str]
"""Attributes of an MJCF element, and the arrays of `MjModel` (or fields of `MjOption`, `MjsMesh`) that hold their values."""
GEOM: Notes = {
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
JOINT: Notes = {
    "margin": "jnt_margin",
    "solreflimit": "jnt_solref",
    "solimplimit": "jnt_solimp",
    "solreffriction": "dof_solref",
    "solimpfriction": "dof_solimp",
}
SITE: Notes = {"type": "site_type", "size": "site_size", "group": "site_group", "rgba": "site_rgba"}
MESH: Notes = {"maxhullvert": "maxhullvert", "inertia": "inertia"}
OPTION: Notes = {
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
WORDS = {
    "type": ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box"),
    "inertia": ("convex", "exact", "legacy", "shell"),
    "integrator": ("Euler", "RK4", "implicit", "implicitfast", "discrete"),
    "cone": ("pyramidal", "elliptic"),
    "jacobian": ("dense", "sparse", "auto"),
    "solver": ("PGS", "CG", "Newton"),
}
"""MJCF's words where it has no numbers, in the order of MuJoCo's."""
FLAGS = {"disable": (mujoco.mjtDisableBit, "mjDSBL_"), "enable": (mujoco.mjtEnableBit, "mjENBL_")}
"""MuJoCo's flags that are noted if set, as lists of MJCF's names, and the bits that they are."""
KNOWN_FLAGS = ("gravity", "filterparent")
"""Flags that USD has words for."""


@cache
def plain() -> mujoco.MjModel:
    """Return a model in which all that is noted is as MuJoCo has it by default."""
    inside = '<body><joint/><geom type="sphere" size="1"/><site/></body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")


def notable(table: Notes, own: Any, usual: Any) -> dict[str, Any]:
    """Return the values of a table that are not as usual, by MJCF's names, as `note` wants them.

    Args:
        table: What could be noted.
        own: By the array's name, an element's value: any callable.
        usual: The same of an element that MuJoCo's defaults hold for.
    """
    found = {}
    for attribute, array in table.items():
        value = np.asarray(own(array))
        if not np.array_equal(value, usual(array)):
            found[attribute] = WORDS[attribute][int(value)] if attribute in WORDS else value.tolist()
    return found


def flags(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Return the flags of a model that are to be noted, by `disable` and `enable`."""
    found = {}
    for key, (bits, prefix) in FLAGS.items():
        names = {
            name.removeprefix(prefix).lower(): int(bit) for name, bit in bits.__members__.items() if name.startswith(prefix)
        }
        value = int(getattr(model.opt, f"{key}flags"))
        found[key] = [name for name, bit in names.items() if value & bit and name not in KNOWN_FLAGS]
    return {key: names for key, names in found.items() if names}


def read_note(stage: Stage, prim: Prim, key: str) -> Any:
    """Return the value of a note, or None."""
    return stage.authored(prim, f"{NAMESPACE}{key}")


def read_notes(stage: Stage, prim: Prim, attributes: Iterable[str]) -> dict[str, str]:
    """Return what is noted of a prim, as attributes of an MJCF element."""
    found = {attribute: read_note(stage, prim, attribute) for attribute in attributes}
    return {attribute: _text(value) for attribute, value in found.items() if value is not None}


def read_flags(stage: Stage, scene: Prim) -> dict[str, str]:
    """Return the flags that are noted of a physics scene, as attributes of an MJCF element."""
    return {str(name): key for key in FLAGS for name in read_note(stage, scene, key) or ()}


def _text(value: Any) -> str:
    return str(value) if isinstance(value, (str, int, float)) else " ".join(repr(float(number)) for number in value)
