"""MJCF's attributes and the USD attributes that hold their values, most specific first; units and contradictions.

Several schemas say the same: our own `tgdsl:`, MuJoCo's `mjc:`, Newton's `newton:`, PhysX's `physx…:` and UsdPhysics, in this
order. The first that is authored is taken; one that says something else is dropped with a warning. A value that the schema
calls its engine's choice (`-inf`, `-1`) says nothing.

Names and units are those of the schemas MjcPhysics, as in mujoco-usd-converter 0.8, and of newton-usd-schemas 0.6: `newton:`
counts in the stage's units and in degrees; `mjc:` holds MJCF's own values, in SI, of which `ref` and `springref` of a hinge are
in the unit that `mjc:compiler:angle` names. Where MjcPhysics calls an attribute deprecated, its Newton successor is read too.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tgdsl.formats.usd.custom_attributes import GEOM, JOINT, MESH, OPTION, read_custom, text_of
from tgdsl.formats.usd.stage import Prim, Stage

AGREEMENT = 1e-5
"""Relative difference up to which two sources say the same: some attributes are float32."""
TOKENS = {"euler": "Euler", "rk4": "RK4", "pgs": "PGS", "cg": "CG", "newton": "Newton"}
"""MjcPhysics' tokens that MJCF spells otherwise."""


@dataclass(frozen=True)
class Source:
    """A USD attribute that holds the value of an MJCF attribute.

    Attributes:
        name: The attribute's name; with `is_range`, what precedes `:min` and `:max`.
        unit: Its unit, a key of `units`.
        neutral: A value that says nothing.
        is_range: Whether two attributes hold the ends of a range.
        is_rate: Whether it is a whole number of steps per second, whose inverse is meant.
    """

    name: str
    unit: str = "1"
    neutral: float | None = None
    is_range: bool = False
    is_rate: bool = False

    def value(self, stage: Stage, prim: Prim, is_angular: bool) -> Any:
        """Return the value in MJCF's unit, or None if nothing is said."""
        if self.is_range:
            ends = [stage.authored(prim, f"{self.name}:{end}") for end in ("min", "max")]
            return None if ends == [None, None] else [float(end or 0.0) for end in ends]
        value = stage.authored(prim, self.name)
        if value is None or (self.neutral is not None and value == self.neutral):
            return None
        if self.is_rate:
            return None if value <= 0 else 1.0 / value
        if isinstance(value, bool | str):
            return value
        factor = units(stage, is_angular)[self.unit]
        if factor == 1.0:
            return value
        return value * factor if isinstance(value, int | float) else [float(number) * factor for number in value]


SourceTable = Mapping[str, tuple[Source, ...]]
"""Attributes of an MJCF element, and where their values may be, most specific first; `tgdsl:<attribute>` always comes first."""


def mjc(name: str, *more: Source, unit: str = "1", neutral: float | None = None, is_range: bool = False) -> tuple[Source, ...]:
    """Return a MuJoCo attribute as a source, with those that come after it."""
    return (Source(f"mjc:{name}", unit, neutral, is_range), *more)


OPTIONS: SourceTable = {
    **{name: mjc(f"option:{name}") for name in OPTION},
    "timestep": mjc("option:timestep", Source("newton:timeStepsPerSecond", is_rate=True)),
    "iterations": mjc("option:iterations", Source("newton:maxSolverIterations", neutral=-1.0)),
    "actuatorgroupdisable": mjc("option:actuatorgroupdisable"),
}
COMPILER: SourceTable = {
    name.lower(): mjc(f"compiler:{name}", neutral=neutral)
    for name, neutral in {
        "alignFree": None,
        "balanceInertia": None,
        "boundInertia": None,
        "boundMass": None,
        "fitAABB": None,
        "fuseStatic": None,
        "setTotalMass": -1.0,
    }.items()
}
JOINTS: SourceTable = {
    **{name: mjc(name) for name in JOINT},
    "damping": mjc("damping", Source("newton:damping", "damping")),
    "armature": mjc("armature", Source("newton:armature", "inertia"), Source("physxJoint:armature", "inertia")),
    "frictionloss": mjc("frictionloss", Source("newton:friction", "effort"), Source("physxJoint:jointFriction", "effort")),
    "springref": mjc("springref", unit="mjcf angle"),
    "springdamper": mjc("springdamper"),
    "ref": mjc("ref", unit="mjcf angle"),
    "actuatorfrclimited": mjc("actuatorfrclimited"),
    "actuatorfrcrange": mjc("actuatorfrcrange", is_range=True),
    "group": mjc("group"),
    "range": (),
}
BODY: SourceTable = {"gravcomp": mjc("body:gravcomp")}
COLLIDER: SourceTable = {
    **{name: mjc(name) for name in GEOM if name not in ("friction", "contype", "conaffinity")},
    **dict.fromkeys(("friction", "contype", "conaffinity"), ()),
    "margin": mjc("margin", Source("newton:contactMargin", "length")),
    "gap": mjc("gap", Source("newton:contactGap", "length", neutral=-math.inf)),
    "group": mjc("group"),
}
GROUP: SourceTable = {"group": mjc("group")}
FRICTION: SourceTable = {
    "torsional": mjc("torsionalfriction", Source("newton:torsionalFriction", "length")),
    "rolling": mjc("rollingfriction", Source("newton:rollingFriction", "length")),
}
"""Of a material; `friction` of its geoms."""
ASSET: SourceTable = {
    **dict.fromkeys(MESH, ()),
    "inertia": mjc("inertia"),
    "maxhullvert": mjc("maxhullvert", Source("newton:maxHullVertices", neutral=-1.0), neutral=-1.0),
}
EQUALITY: SourceTable = {"solref": mjc("solref"), "solimp": mjc("solimp")}
WELD: SourceTable = {**EQUALITY, "torquescale": mjc("torqueScale")}


def units(stage: Stage, is_angular: bool) -> dict[str, float]:
    """Return units of USD attributes in SI and radians, for what turns or what slides."""
    metre, kilogram = stage.metres_per_unit, stage.kilograms_per_unit
    inertia = kilogram * (metre**2 if is_angular else 1.0)
    angle = math.radians(1) if is_angular else metre
    return {
        "1": 1.0,
        "length": metre,
        "inertia": inertia,
        "effort": kilogram * metre * (metre if is_angular else 1.0),
        "damping": inertia / (math.radians(1) if is_angular else 1.0),
        "position": angle,
        "mjcf angle": math.radians(1) if is_angular and stage.is_mjcf_in_degrees else 1.0,
    }


def read_attributes(stage: Stage, prim: Prim, table: SourceTable, is_angular: bool = False) -> dict[str, str]:
    """Return what a prim says of an MJCF element, as its attributes, and take note of contradictions.

    Args:
        stage: The stage.
        prim: The prim.
        table: Which attributes, and where their values are.
        is_angular: Whether the element turns, which decides on units.
    """
    result = {}
    for attribute, sources in table.items():
        own = read_custom(stage, prim, attribute)
        values = [] if own is None else [(f"tgdsl:{attribute}", own, Source(""))]
        values += [(s.name, value, s) for s in sources if (value := s.value(stage, prim, is_angular)) is not None]
        for name, value, source in values[1:]:
            if not _agree(values[0][1], value, source):
                stage.drop(f"{name} was dropped, which contradicts {values[0][0]}", prim)
        if values:
            result[attribute] = text_of(TOKENS.get(values[0][1], values[0][1]) if _is_token(values[0]) else values[0][1])
    return result


def with_limits(stage: Stage, attributes: dict[str, str], pairs: Iterable[str]) -> dict[str, str]:
    """Return attributes with `…limited` resolved as `mjc:compiler:autoLimits` says.

    Args:
        stage: The stage.
        attributes: Of an MJCF element.
        pairs: What precedes `limited` and `range`.
    """
    for name in pairs:
        if attributes.get(f"{name}limited", "auto") != "auto":
            continue
        attributes.pop(f"{name}limited", None)
        if f"{name}range" in attributes and not stage.is_mjcf_autolimited:
            attributes[f"{name}limited"] = "false"
    return attributes


def _is_token(found: tuple[str, Any, Source]) -> bool:
    return isinstance(found[1], str) and found[0].startswith("mjc:option:")


def _agree(first: Any, other: Any, source: Source) -> bool:
    if isinstance(first, str) or isinstance(other, str):
        return str(first).lower() == str(other).lower()
    if source.is_rate:
        return round(1.0 / first) == round(1.0 / other)
    one, two = np.ravel(np.asarray(first, dtype=float)), np.ravel(np.asarray(other, dtype=float))
    return one.shape == two.shape and bool(np.allclose(one, two, rtol=AGREEMENT, atol=1e-12))
