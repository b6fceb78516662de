"""Attributes of MJCF elements: MuJoCo's arrays with their values, and the USD attributes; one table reads and writes them.

Several schemas define the same value: our `tgdsl:`, MuJoCo's `mjc:`, Newton's `newton:`, PhysX's `physx…:` and UsdPhysics, in
this order. The first authored one counts; a contradicting one is dropped with a warning. A value that the schema leaves to its
engine (`-inf`, `-1`) counts as unauthored.

Names and units follow the schemas of MjcPhysics, as in mujoco-usd-converter 0.8, and newton-usd-schemas 0.6. `newton:` uses
the stage's units and degrees. `mjc:` holds MJCF's values, in SI; `ref` and `springref` of a hinge are in the unit of
`mjc:compiler:angle`. Where MjcPhysics deprecates an attribute, its Newton successor is read too.

`tgdsl:<MJCF's name>` holds MuJoCo's values without a USD schema, in SI and radians whatever the stage's units; MuJoCo's
defaults are not written. A value that USD stores in float32 has a copy in double, `tgdsl:<USD's own name>`, in USD's unit. The
copy counts only while it rounds to USD's value, so that edits of USD's value win.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from tgdsl.formats.usd.stage import NAMESPACE, Prim, Stage, usd_modules

FREE, BALL, SLIDE, HINGE = (int(getattr(mujoco.mjtJoint, f"mjJNT_{kind}")) for kind in ("FREE", "BALL", "SLIDE", "HINGE"))
DECIMALS = 14  # decimals of positions and rotations: those beyond are rounding, which differs from machine to machine
AGREEMENT = 1e-5  # relative difference up to which two sources say the same: some attributes are float32
TOKENS = {"euler": "Euler", "rk4": "RK4", "pgs": "PGS", "cg": "CG", "newton": "Newton"}  # MJCF's spelling of MjcPhysics' tokens


def _keywords(enum: Any) -> tuple[str, ...]:
    return tuple(name.rpartition("_")[2].lower() for name, _ in sorted(enum.__members__.items(), key=lambda item: int(item[1])))


KEYWORDS = {
    "type": ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box"),
    "inertia": ("convex", "exact", "legacy", "shell"),
    "integrator": ("Euler", "RK4", "implicit", "implicitfast", "discrete"),
    "cone": ("pyramidal", "elliptic"),
    "jacobian": ("dense", "sparse", "auto"),
    "solver": ("PGS", "CG", "Newton"),
    "dyntype": _keywords(mujoco.mjtDyn),
    "gaintype": _keywords(mujoco.mjtGain),
    "biastype": _keywords(mujoco.mjtBias),
    **dict.fromkeys(("actlimited", "ctrllimited", "forcelimited", "limited", "actuatorfrclimited"), ("false", "true")),
}
"""MJCF's keywords, in the order of MuJoCo's enumerations."""
FLAGS = {"disable": (mujoco.mjtDisableBit, "mjDSBL_"), "enable": (mujoco.mjtEnableBit, "mjENBL_")}
"""MuJoCo's flags that are written if set, as lists of MJCF's names, and their bits."""
KNOWN_FLAGS = ("gravity", "filterparent")  # flags that USD has attributes for


@dataclass(frozen=True)
class Source:
    """A USD attribute that holds the value of an MJCF attribute."""

    name: str  # the attribute's name; with `is_range`, the part before `:min` and `:max`
    unit: str = "1"  # its unit, a key of `units`
    neutral: float | None = None  # a value that counts as unauthored
    is_range: bool = False  # whether two attributes hold the ends of a range
    is_rate: bool = False  # whether it is an integer number of steps per second, to be inverted

    def value(self, stage: Stage, prim: Prim, is_angular: bool) -> Any:
        """Return the value in MJCF's unit, or None if none is authored."""
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


@dataclass(frozen=True)
class Row:
    """Where the value of an MJCF attribute is."""

    array: str = ""  # of `MjModel`, `MjOption` or `MjsMesh`; empty if it is not written by the table
    sources: tuple[Source, ...] = ()  # USD attributes, most specific first; `tgdsl:<MJCF's name>` always comes before them


Table = Mapping[str, Row]  # rows by the names of an MJCF element's attributes


def mjc(
    name: str, *more: Source, array: str = "", unit: str = "1", neutral: float | None = None, is_range: bool = False
) -> Row:
    return Row(array, (Source(f"mjc:{name}", unit, neutral, is_range), *more))


def flag_names(key: str) -> dict[str, int]:
    bits, prefix = FLAGS[key]
    return {name.removeprefix(prefix).lower(): int(bit) for name, bit in bits.__members__.items() if name.startswith(prefix)}


OPTION: Table = {
    "timestep": mjc("option:timestep", Source("newton:timeStepsPerSecond", is_rate=True), array="timestep"),
    **{
        name: mjc(f"option:{name}", array=name)
        for name in (
            *("integrator", "cone", "impratio", "jacobian", "solver", "tolerance", "density", "viscosity"),
            *("ls_iterations", "ls_tolerance", "noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance"),
            *("sdf_iterations", "sdf_initpoints", "wind", "magnetic", "o_margin", "o_solref", "o_solimp", "o_friction"),
        )
    },
    "iterations": mjc("option:iterations", Source("newton:maxSolverIterations", neutral=-1.0), array="iterations"),
    "actuatorgroupdisable": mjc("option:actuatorgroupdisable"),
}
COMPILER: Table = {
    **{name.lower(): mjc(f"compiler:{name}") for name in ("alignFree", "balanceInertia", "boundInertia", "boundMass")},
    **{name.lower(): mjc(f"compiler:{name}") for name in ("fitAABB", "fuseStatic")},
    "settotalmass": mjc("compiler:setTotalMass", neutral=-1.0),
}
FLAG: Table = {
    **{name: mjc(f"flag:{name}") for name in sorted(name for key in FLAGS for name in flag_names(key))},
    "gravity": mjc("flag:gravity", Source("newton:gravityEnabled")),
}
SELF_COLLISION: Table = {
    "self": Row("", (Source("newton:selfCollisionEnabled"), Source("physxArticulation:enabledSelfCollisions")))
}
JOINT: Table = {
    "margin": mjc("margin", array="jnt_margin"),
    "stiffness": mjc("stiffness", array="jnt_stiffness"),
    "actuatorgravcomp": mjc("actuatorgravcomp", array="jnt_actgravcomp"),
    "solreflimit": mjc("solreflimit", array="jnt_solref"),
    "solimplimit": mjc("solimplimit", array="jnt_solimp"),
    "solreffriction": mjc("solreffriction", array="dof_solref"),
    "solimpfriction": mjc("solimpfriction", array="dof_solimp"),
    "damping": mjc("damping", Source("newton:damping", "damping")),
    "armature": mjc("armature", Source("newton:armature", "inertia"), Source("physxJoint:armature", "inertia")),
    "frictionloss": mjc("frictionloss", Source("newton:friction", "effort"), Source("physxJoint:jointFriction", "effort")),
    "springref": mjc("springref", unit="mjcf angle"),
    "springdamper": mjc("springdamper"),
    "ref": mjc("ref", unit="mjcf angle"),
    "actuatorfrclimited": mjc("actuatorfrclimited"),
    "actuatorfrcrange": mjc("actuatorfrcrange", is_range=True),
    "group": mjc("group"),
    "range": Row(),
}
BODY: Table = {"gravcomp": mjc("body:gravcomp")}
GROUP: Table = {"group": mjc("group")}
GEOM: Table = {
    **{name: mjc(name, array=f"geom_{name}") for name in ("condim", "priority", "solmix", "solref", "solimp")},
    **{name: Row(f"geom_{name}") for name in ("friction", "contype", "conaffinity")},
    "margin": mjc("margin", Source("newton:contactMargin", "length"), array="geom_margin"),
    "gap": mjc("gap", Source("newton:contactGap", "length", neutral=-math.inf), array="geom_gap"),
    **GROUP,
}
SITE: Table = {**{name: Row(f"site_{name}") for name in ("type", "size", "rgba")}, "group": mjc("group", array="site_group")}
FRICTION: Table = {
    "torsional": mjc("torsionalfriction", Source("newton:torsionalFriction", "length")),
    "rolling": mjc("rollingfriction", Source("newton:rollingFriction", "length")),
}
"""Of a material; `friction` of its geoms."""
MESH: Table = {
    "inertia": mjc("inertia", array="inertia"),
    "maxhullvert": mjc("maxhullvert", Source("newton:maxHullVertices", neutral=-1.0), array="maxhullvert", neutral=-1.0),
}
EQUALITY: Table = {"solref": mjc("solref", array="eq_solref"), "solimp": mjc("solimp", array="eq_solimp")}
WELD: Table = {**EQUALITY, "torquescale": mjc("torqueScale")}
MIMIC: Table = {
    "0": mjc("coef0", Source("newton:mimicCoef0", "position")),
    "1": mjc("coef1", Source("newton:mimicCoef1")),
    **{str(power): mjc(f"coef{power}") for power in (2, 3, 4)},
}
"""Coefficients of the polynomial of the leader's position. MJCF counts all in radians, whatever its compiler's angle."""
LIMITS = ("act", "ctrl", "force")
ACTUATOR: Table = {
    **{
        name.lower(): mjc(name, array=f"actuator_{name.lower()}")
        for name in ("actEarly", "biasPrm", "biasType", "dynPrm", "dynType", "gainPrm", "gainType", "gear", "group")
    },
    **{name.lower(): mjc(name) for name in ("actDim", "crankLength", "inheritRange")},
    **{f"{name}limited": mjc(f"{name}Limited", array=f"actuator_{name}limited") for name in LIMITS},
    **{f"{name}range": mjc(f"{name}Range", array=f"actuator_{name}range", is_range=True) for name in (*LIMITS, "length")},
    **{name: Row(f"actuator_{name}") for name in ("delay", "armature", "damping")},
    "nsample": Row(),
}
"""Rows without a source have no attribute in MjcPhysics."""
SERVO: Table = {
    "kp": Row("", (Source("newton:kp", "inertia"),)),
    "kd": Row("", (Source("newton:kd", "inertia"),)),
    "constant": Row("", (Source("newton:constEffort", "effort"),)),
    "most": Row("", (Source("newton:maxEffort", "effort", neutral=math.inf),)),
}
"""NewtonActuator: gains per radian, in the stage's kg·m² or kg, over s² or s, like an inertia."""
TENDON: Table = {
    **{
        name: mjc(name, array=f"tendon_{name}")
        for name in ("armature", "damping", "frictionloss", "stiffness", "margin", "group", "limited")
    },
    "springlength": mjc("springlength", array="tendon_lengthspring"),
    **{f"sol{part}limit": mjc(f"sol{part}limit", array=f"tendon_sol{part}_lim") for part in ("ref", "imp")},
    **{f"sol{part}friction": mjc(f"sol{part}friction", array=f"tendon_sol{part}_fri") for part in ("ref", "imp")},
    "range": mjc("range", array="tendon_range", is_range=True),
    "actuatorfrclimited": mjc("actuatorfrclimited", array="tendon_actfrclimited"),
    "actuatorfrcrange": mjc("actuatorfrcrange", array="tendon_actfrcrange", is_range=True),
}
DRAWN: Table = {"rgba": mjc("rgba"), "width": mjc("width", array="tendon_width")}  # of a spatial tendon
KEY: Table = {
    "time": Row("key_time"),
    **{name: mjc(name, array=f"key_{name}") for name in ("qpos", "qvel", "act", "ctrl", "mpos", "mquat")},
}


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
        "mjcf angle": math.radians(1) if is_angular and stage.compiler("angle") != "radian" else 1.0,
    }


def read_custom(stage: Stage, prim: Prim, key: str) -> Any:
    return stage.authored(prim, f"{NAMESPACE}{key}")


def read_attributes(stage: Stage, prim: Prim, table: Table, is_angular: bool = False) -> dict[str, str]:
    """Return what a prim says of an MJCF element, as its attributes, and take note of contradictions."""
    result = {}
    for attribute, row in table.items():
        custom = read_custom(stage, prim, attribute)
        values = [] if custom is None else [(f"{NAMESPACE}{attribute}", custom)]
        for source in row.sources:
            value = source.value(stage, prim, is_angular)
            if value is not None and values and not _agree(values[0][1], value, source.is_rate):
                stage.drop(f"{source.name} was dropped, which contradicts {values[0][0]}", prim)
            if value is not None:
                values.append((source.name, value))
        if values:
            name, value = values[0]
            is_token = isinstance(value, str) and name.startswith("mjc:option:")
            result[attribute] = text_of(TOKENS.get(value, value) if is_token else value)
    return result


def _agree(first: Any, other: Any, is_rate: bool) -> bool:
    if isinstance(first, str) or isinstance(other, str):
        return str(first).lower() == str(other).lower()
    if is_rate:
        return round(1.0 / first) == round(1.0 / other)
    one, two = np.ravel(np.asarray(first, dtype=float)), np.ravel(np.asarray(other, dtype=float))
    return one.shape == two.shape and bool(np.allclose(one, two, rtol=AGREEMENT, atol=1e-12))


def with_limits(stage: Stage, attributes: dict[str, str], pairs: Iterable[str]) -> dict[str, str]:
    """Return attributes with `…limited` resolved as `mjc:compiler:autoLimits` says."""
    for name in pairs:
        if attributes.get(f"{name}limited", "auto") != "auto":
            continue
        attributes.pop(f"{name}limited", None)
        if f"{name}range" in attributes and stage.compiler("autoLimits") is False:
            attributes[f"{name}limited"] = "false"
    return attributes


def text_of(value: Any) -> str:
    """Return a value as MJCF writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (str, int, float)):
        return str(value)
    return " ".join(str(number) if isinstance(number, int) else repr(float(number) + 0.0) for number in value)


def author(prim: Any, name: str, value: Any, kind: str = "") -> None:
    """Set an attribute of a prim; an empty string is not written."""
    if isinstance(value, str) and not value:
        return
    if not kind:
        kinds = {str: "Token" if name.startswith("mjc:") else "String", bool: "Bool", int: "Int", float: "Double"}
        if isinstance(value, list):
            kind = {str: "StringArray", int: "IntArray"}.get(type(value[0]) if value else float, "DoubleArray")
        else:
            kind = "Double2" if isinstance(value, tuple) else kinds[type(value)]
    u = usd_modules()
    is_custom = not name.startswith(("mjc:", "newton:"))
    prim.CreateAttribute(name, getattr(u.Sdf.ValueTypeNames, kind), custom=is_custom).Set(
        u.Vt.IntArray(value) if kind == "IntArray" else value
    )


def set_custom(prim: Any, key: str, value: str | bool | int | float | tuple[float, float] | list[float] | list[str]) -> None:
    author(prim, f"{NAMESPACE}{key}", value)


def set_customs(prim: Any, table: Table, element: Any, default: Any, index: int | None = None) -> None:
    """Set custom attributes for fields, or rows `index` of arrays, that differ from an element with defaults."""
    for attribute, row in table.items():
        if not row.array:
            continue
        one, other = (np.asarray(getattr(each, row.array)) for each in (element, default))
        number, usual = (one, other) if index is None else (one[index], other[0])
        if not np.array_equal(number, usual):
            set_custom(prim, attribute, KEYWORDS[attribute][int(number)] if attribute in KEYWORDS else number.tolist())


def set_sources(prim: Any, table: Table, model: mujoco.MjModel, index: int) -> None:
    """Set the MuJoCo attributes of an element by its index, and as custom ones what they do not include and is not zero."""
    for attribute, row in table.items():
        if not row.array:
            continue
        array = np.asarray(getattr(model, row.array)[index])
        value = array.ravel().tolist() if array.ndim else array.item()
        if attribute in KEYWORDS:
            value = KEYWORDS[attribute][int(array)]
        if not row.sources:
            if np.any(array):
                set_custom(prim, attribute, value)
        elif row.sources[0].is_range:
            limited = attribute.replace("range", "limited")
            is_limited = getattr(model, table[limited].array)[index] if limited in table else array.any()
            for end, number in zip(("min", "max"), array.tolist() if is_limited else (), strict=False):
                author(prim, f"{row.sources[0].name}:{end}", number)
        elif array.size:
            author(prim, row.sources[0].name, value)


def set_number(attribute: Any, value: float | np.ndarray) -> None:
    """Set an attribute to 15 digits; where it is float32, also its double-precision copy `tgdsl:<its name>`."""
    u, digits = usd_modules(), [float(f"{number:.15g}") + 0.0 for number in np.ravel(value).tolist()]
    kind = attribute.GetTypeName().type.typeName
    if kind == "GfQuatf":
        exact, wide = u.Gf.Quatd(*digits), "Quatd"
        attribute.Set(u.Gf.Quatf(exact))
    elif kind == "GfVec3f":
        exact, wide = u.Gf.Vec3d(*digits), "Double3"
        attribute.Set(u.Gf.Vec3f(exact))
    else:
        exact, wide = digits[0], "Double"
        attribute.Set(exact)
    if type(exact)(attribute.Get()) != exact:
        author(attribute.GetPrim(), f"{NAMESPACE}{attribute.GetName()}", exact, wide)


@cache
def default_model() -> mujoco.MjModel:
    inside = '<body><joint/><geom type="sphere" size="1"/><site/></body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{inside}</worldbody></mujoco>")


@dataclass(eq=False)
class StageWriter:
    """A stage that a compiled model is being written to."""

    file: Path  # the robot file, for messages
    spec: mujoco.MjSpec  # MuJoCo's editable model
    model: mujoco.MjModel  # MuJoCo's compiled model
    stage: Any  # the `Usd.Stage`
    root: str = ""  # path of the default prim
    scope: str = ""  # path of the scope that holds joints and what acts on them
    materials: str = ""  # path of the scope that holds physics materials
    bodies: dict[int, str] = field(default_factory=dict)  # path of each body's prim, by MuJoCo's index
    sites: dict[int, str] = field(default_factory=dict)  # path of each site's prim, by MuJoCo's index
    geoms: dict[int, str] = field(default_factory=dict)  # path of each geom's prim, by MuJoCo's index
    joints: dict[int, Any] = field(default_factory=dict)  # schema of each joint that can move, by MuJoCo's index
    tendons: dict[int, str] = field(default_factory=dict)  # path of each tendon's prim, by MuJoCo's index
    frictions: dict[float, Any] = field(default_factory=dict)  # the physics material of each sliding friction that is in use
    unsupported: list[str] = field(default_factory=list)  # one message for each thing that USD does not hold
    _taken: set[str] = field(default_factory=set)

    def path(self, parent: str, name: str) -> str:
        """Return a path below a prim that is valid, like the name, and not yet taken; and take it."""
        plain = f"{parent}/{usd_modules().Tf.MakeValidIdentifier(name)}"
        result, number = plain, 0
        while result in self._taken:
            number += 1
            result = f"{plain}_{number}"
        self._taken.add(result)
        return result

    def define(self, kind: str, prim_name: str, name: str) -> Any:
        prim = self.stage.DefinePrim(self.path(self.scope, prim_name), kind)
        set_custom(prim, "name", name)
        return prim

    def body_name(self, body: int) -> str:
        return self.model.body(body).name or f"body_{body}"


def rounded(values: Float[np.ndarray, " number"]) -> Float[np.ndarray, " number"]:
    """Return a position [m] or rotation rounded to `DECIMALS`."""
    return np.round(values, DECIMALS) + 0.0


def file_vertices(model: mujoco.MjModel, mesh: int) -> Float[np.ndarray, "vertex 3"]:
    """Return a mesh's vertices in the frame of its file [m], in float32 and in MuJoCo's order."""
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    moved = model.mesh_vert[first : first + count].astype(np.float64)
    result = Rotation.from_quat(model.mesh_quat[mesh], scalar_first=True).apply(moved) + model.mesh_pos[mesh]
    bit = np.finfo(np.float32).eps * max(np.abs(result).max(), np.abs(moved).max())
    for decimals in range(8):
        if np.abs(np.round(result, decimals) - result).max() <= bit:
            result = np.round(result, decimals)
            break
    return np.ascontiguousarray(result + 0.0, dtype=np.float32)
