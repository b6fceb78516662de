"""Objects that taxels can sense: bodies of the scene, and geoms that differ between environments."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, StrictBool, StrictInt, Tag, model_validator

from tgdsl.fields.materials import MaterialField
from tgdsl.fields.models import Number, Position, Positive, PositiveLength, SpecModel, Temperature, Usual
from tgdsl.sensors.base import Alternative

NUM_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
"""How many sizes a primitive has, as MuJoCo defines them: radius; radius and half-length; half-lengths."""


def _oriented(quat: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if not any(quat):
        raise ValueError("[0, 0, 0, 0] is no orientation, expected a quaternion w, x, y, z of non-zero length")
    return quat


Quat = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_oriented)]


class _PlacedGeom(SpecModel):
    pos: Annotated[Position, Usual("length", high=10.0)] = (0.0, 0.0, 0.0)
    """Origin of its frame in the body's frame [m]."""
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    """Orientation of its frame in the body's frame, w, x, y, z."""
    density: Annotated[Positive, Usual("number", low=5.0, high=25000.0)] = 1000.0
    """Density [kg/m³]; ignored if the scene gives the body's inertia."""


class _Primitive(SpecModel):
    type: Literal["sphere", "capsule", "cylinder", "ellipsoid", "box"]
    """Its type, by MuJoCo's name."""
    size: Annotated[tuple[PositiveLength, ...], Field(min_length=1, max_length=3), Usual("length", low=1e-4, high=5.0)]
    """Its size as MuJoCo defines it: radius; radius and half-length; half-lengths along x, y, z [m]."""

    @model_validator(mode="after")
    def _check_size(self) -> _Primitive:
        if len(self.size) != NUM_SIZES[self.type]:
            raise ValueError(f"a {self.type} has {NUM_SIZES[self.type]} sizes, found {len(self.size)}")
        return self


class PrimitiveGeom(_Primitive, _PlacedGeom):
    """A primitive."""


class ColliderSpec(_Primitive):
    """A primitive that a link collides with."""

    pos: Position = (0.0, 0.0, 0.0)
    """Origin of its frame in the body's frame [m]."""
    quat: Quat = (1.0, 0.0, 0.0, 0.0)
    """Orientation of its frame in the body's frame, w, x, y, z."""
    core: StrictBool = False
    """Whether it also collides with links that have primitive colliders; by default it does not."""


class CollidersSpec(SpecModel):
    """The primitive colliders of a robot, in a file next to its model."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    bodies: Annotated[dict[str, Annotated[tuple[ColliderSpec, ...], Field(min_length=1)]], Field(min_length=1)]
    """Colliders by body; they replace the colliding geoms of that body."""


class MeshGeom(_PlacedGeom):
    """A mesh from a file."""

    mesh: str
    """Mesh file (.stl, .obj), relative to this document."""
    scale: Positive = 1.0
    """Factor from the file's unit to metres: 0.001 for millimetres."""


class CompoundGeoms(SpecModel):
    """Several geoms that move as one."""

    geoms: Annotated[tuple[Geom, ...], Field(min_length=1)]
    """The geoms."""


def _geom_tag(value: Any) -> str:
    return "a mesh" if isinstance(value, MeshGeom) or (isinstance(value, dict) and "mesh" in value) else "a primitive"


def _variant_tag(value: Any) -> str:
    is_compound = isinstance(value, CompoundGeoms) or (isinstance(value, dict) and "geoms" in value)
    return "a compound" if is_compound else _geom_tag(value)


Geom = Annotated[
    Annotated[PrimitiveGeom, Tag("a primitive")] | Annotated[MeshGeom, Tag("a mesh")],
    Discriminator(_geom_tag),
]
Variant = Annotated[
    Annotated[PrimitiveGeom, Tag("a primitive")]
    | Annotated[MeshGeom, Tag("a mesh")]
    | Annotated[CompoundGeoms, Tag("a compound")],
    Discriminator(_variant_tag),
]
CompoundGeoms.model_rebuild()


class TemperaturePerEnv(SpecModel):
    """Temperature per environment at the start of an episode: see `SceneState.object_temperature`."""

    per_env: Annotated[Temperature, Usual("temperature", high=250.0)]
    """Initial value in all environments [°C]."""


def _not_bare(value: Any) -> Any:
    if value == "per_env":
        raise ValueError("found `per_env` alone, expected `{per_env: 45 degC}`, the temperature to begin with")
    return value


ObjectTemperature = Annotated[
    Annotated[Temperature, Tag("the same in all")] | Annotated[TemperaturePerEnv, Tag("per environment")],
    Discriminator(lambda value: "per environment" if isinstance(value, (dict, TemperaturePerEnv)) else "the same in all"),
    BeforeValidator(_not_bare),
]
_Materials = Annotated[tuple[MaterialField, ...], Field(min_length=1)]
ObjectMaterials = Annotated[
    _Materials,
    BeforeValidator(
        lambda value: value if isinstance(value, (list, tuple)) else (value,), json_schema_input_type=MaterialField | _Materials
    ),
]
Cells = Annotated[StrictInt, Field(ge=1)]
Bits = Annotated[StrictInt, Field(ge=0, lt=2**31)]


class ObjectSpec(SpecModel):
    """An object that taxels can sense: a body of the scene, with its geoms or other ones, or an added body."""

    body: str | None = None
    """Name of its body in the scene (or in the robot's file, if there is no scene); default: a body with the object's name is
    added to the scene. Child bodies without joints belong to it, unless they are objects themselves; bodies fixed to the world
    do not belong to `world`."""
    geom: Variant | None = None
    """Geom that replaces the geoms of the body and of the bodies that belong to it. Other attributes of the body's first geom,
    such as friction, stay."""
    variants: Annotated[tuple[Variant, ...], Field(min_length=1)] | None = None
    """Alternatives to `geom`, one per environment: see `SceneState.variant`."""
    size: Literal["fixed", "per_env"] = "fixed"
    """`per_env`: its size is part of the state, see `SceneState.object_size`; it and each variant must be one primitive."""
    pos: Annotated[Position | None, Usual("length", high=10.0)] = None
    """Initial position of an added body in the world [m]; default: the origin."""
    quat: Quat | None = None
    """Initial orientation of an added body, w, x, y, z; default: the world's axes."""
    joint: Literal["free", "fixed"] | None = None
    """Joint of an added body: it moves freely (default), or is fixed to the world."""
    contype: Bits | None = None
    """MuJoCo's `contype` of an added body's geoms; default: 1, plus the bits for contact with all colliding geoms of the
    scene."""
    conaffinity: Bits | None = None
    """MuJoCo's `conaffinity` of an added body's geoms; default: as for `contype`."""
    surface: str = "collision"
    """The surface that taxels sense: `collision`, the geoms that collide, meshes as convex hulls, as in MuJoCo; `visual`, the
    other geoms, meshes in their exact shape; or names of geoms or meshes of its body, with shell wildcards. Contacts are those
    of its colliding geoms, or, if it has none, of all colliding geoms of its body."""
    query: Literal["sdf", "raycast"] = "sdf"
    """Distances to its meshes: from a grid that is baked at compile time, or to the nearest triangle at run time (needs
    warp-lang). Primitives are exact in both."""
    tolerance: Annotated[PositiveLength, Usual("length", high=0.005)] = 5e-5
    """Largest distance error of a grid, 99th percentile away from sharp edges [m]."""
    max_bytes: Annotated[StrictInt, Field(ge=1)] = 64 * 2**20
    """Largest size of a grid [bytes]."""

    temperature: Annotated[ObjectTemperature | None, Usual("temperature", high=250.0)] = None
    """Temperature at the start of an episode, `45 degC`; `{per_env: 45 degC}` makes it part of the state, with this initial
    value: see `SceneState.object_temperature`. Default: ambient temperature [°C]."""
    material: ObjectMaterials | None = None
    """Material for heat flow: a name such as `steel`, `{like: steel, emissivity: 0.8}`, or all numbers. A list has one entry
    per environment: see `SceneState.object_material`."""
    cells: tuple[Cells, Cells, Cells] | None = None
    """Numbers of cells of its temperature along x, y, z, over the bounding box of its geoms in its body's frame; default: one
    temperature."""

    @model_validator(mode="after")
    def _check_heat(self) -> ObjectSpec:
        thermal = [key for key in ("temperature", "cells") if getattr(self, key) is not None]
        if thermal and self.material is None:
            raise ValueError(f"`{thermal[0]}` is for heat flow, which needs `material`, such as `steel`")
        if self.material is not None and self.size == "per_env":
            raise ValueError("`material` with `size: per_env` is not supported: heat needs a volume known beforehand")
        return self

    @model_validator(mode="after")
    def _check(self) -> ObjectSpec:
        if self.geom is not None and self.variants is not None:
            raise ValueError("found `geom` and `variants`, expected one of them")
        if self.body is None and not self.compounds:
            raise ValueError("expected `body`, the name of a body in the scene, or `geom` or `variants` for an added body")
        added = [key for key in ("pos", "quat", "joint", "contype", "conaffinity") if getattr(self, key) is not None]
        if self.body is not None and added:
            raise ValueError(f'`{added[0]}` is for an added body; the scene sets it for body "{self.body}"')
        if self.compounds and self.surface not in ("collision", "visual"):
            raise ValueError(f'surface "{self.surface}" names a geom; with `geom` or `variants`: `collision` or `visual`')
        return self

    @property
    def compounds(self) -> tuple[tuple[PrimitiveGeom | MeshGeom, ...], ...]:
        """The geoms of each variant; none if the object has the scene's geoms."""
        variants = self.variants or (() if self.geom is None else (self.geom,))
        return tuple(part.geoms if isinstance(part, CompoundGeoms) else (part,) for part in variants)

    def body_of(self, name: str) -> str:
        """Return the name of its body; `name` is the object's."""
        return name if self.body is None else self.body


def query_alternatives() -> list[Alternative]:
    """Return the distance queries for meshes, from coarse to fine; distances to primitives are exact."""
    grids = [
        Alternative(f"grid, {1e3 * error:g} mm", {"query": "sdf", "tolerance": error}) for error in (1e-3, 2e-4, 5e-5, 1e-5)
    ]
    return [*grids, Alternative("raycast", {"query": "raycast"}, unused=("tolerance", "max_bytes"), is_exact=True)]
