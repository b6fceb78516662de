"""What taxels can feel: bodies of the scene, and geoms that differ between environments."""

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
    """Its density [kg/m³]; counts unless the body's inertia is given in the scene."""


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
    """Whether links that have primitive colliders meet it too; the others meet what is no such link alone."""


class CollidersSpec(SpecModel):
    """The primitive colliders of a robot, in a file of their own beside its model."""

    tgdsl: Literal[1]
    """Version of the grammar."""
    bodies: Annotated[dict[str, Annotated[tuple[ColliderSpec, ...], Field(min_length=1)]], Field(min_length=1)]
    """Colliders by the name of the body whose colliding geoms they stand in for."""


class MeshGeom(_PlacedGeom):
    """A mesh of a file."""

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
    """A temperature at which each environment begins its episodes: see `SceneState.object_temperature`."""

    per_env: Annotated[Temperature, Usual("temperature", high=250.0)]
    """The temperature that all environments have to begin with [°C]."""


def _is_per_env(value: Any) -> str:
    return "per environment" if isinstance(value, (dict, TemperaturePerEnv)) else "the same in all"


def _not_bare(value: Any) -> Any:
    if value == "per_env":
        raise ValueError("found `per_env` alone, expected `{per_env: 45 degC}`, the temperature to begin with")
    return value


def _as_tuple(value: Any) -> Any:
    return value if isinstance(value, (list, tuple)) else (value,)


ObjectTemperature = Annotated[
    Annotated[Temperature, Tag("the same in all")] | Annotated[TemperaturePerEnv, Tag("per environment")],
    Discriminator(_is_per_env),
    BeforeValidator(_not_bare),
]
_Materials = Annotated[tuple[MaterialField, ...], Field(min_length=1)]
ObjectMaterials = Annotated[_Materials, BeforeValidator(_as_tuple, json_schema_input_type=MaterialField | _Materials)]
Cells = Annotated[StrictInt, Field(ge=1)]
Bits = Annotated[StrictInt, Field(ge=0, lt=2**31)]


class ObjectSpec(SpecModel):
    """Something that taxels can feel: a body of the scene as it is, with other geoms, or a body of its own."""

    body: str | None = None
    """Name of its body in the scene (or in the robot's file, if there is no scene); default: a body of its own, of the object's
    name, is added to the scene. Bodies below it that have no joint are part of it, unless they are objects themselves; what is
    fixed to the world is no part of `world`."""
    geom: Variant | None = None
    """Geom that the body has instead of its own, and of those of bodies that are part of it. What else the scene says of the
    body's first geom, such as friction, stays."""
    variants: Annotated[tuple[Variant, ...], Field(min_length=1)] | None = None
    """The same, of which each environment takes one: see `SceneState.variant`."""
    size: Literal["fixed", "per_env"] = "fixed"
    """`per_env` if its size is part of the state: see `SceneState.object_size`. It (and each variant) is then one primitive."""
    pos: Annotated[Position | None, Usual("length", high=10.0)] = None
    """Where a body of its own starts, in the world [m]; default: the origin."""
    quat: Quat | None = None
    """How it is turned there, w, x, y, z; default: not at all."""
    joint: Literal["free", "fixed"] | None = None
    """Whether a body of its own moves freely (the default) or is fixed to the world."""
    contype: Bits | None = None
    """MuJoCo's bits of the geoms of a body of its own; default: 1, and what makes it collide with all geoms of the scene that
    collide."""
    conaffinity: Bits | None = None
    """The same."""
    surface: str = "collision"
    """What is felt of it: `collision`, the geoms that collide, meshes by their convex hulls as MuJoCo collides them; `visual`,
    the geoms that do not, meshes as they are; or the name of a geom or mesh of its body, with shell wildcards, as it is. The
    solver's contacts with it are those on its geoms that collide, and on all that do of its body where it has none itself."""
    query: Literal["sdf", "raycast"] = "sdf"
    """How distances to its meshes are found: on a grid baked at compile time, or to the nearest triangle at run time (needs
    warp-lang). Primitives are exact either way."""
    tolerance: Annotated[PositiveLength, Usual("length", high=0.005)] = 5e-5
    """Distance error that a grid may have, 99th percentile away from sharp edges [m]."""
    max_bytes: Annotated[StrictInt, Field(ge=1)] = 64 * 2**20
    """Largest size of a grid [bytes]."""

    temperature: Annotated[ObjectTemperature | None, Usual("temperature", high=250.0)] = None
    """Its temperature when an episode begins, `45 degC`; `{per_env: 45 degC}` if that is part of the state, beginning with it:
    see `SceneState.object_temperature`. Default: that of the surroundings [°C]."""
    material: ObjectMaterials | None = None
    """What it is made of, for the flow of heat: a name such as `steel`, `{like: steel, emissivity: 0.8}`, or all numbers. Of a
    list each environment takes one: see `SceneState.object_material`."""
    cells: tuple[Cells, Cells, Cells] | None = None
    """Numbers of cells along x, y, z in which its temperature is resolved, a grid over the box of its geoms in its body's
    frame; default: it has one temperature."""

    @model_validator(mode="after")
    def _check_heat(self) -> ObjectSpec:
        given = [key for key in ("temperature", "cells") if getattr(self, key) is not None]
        if given and self.material is None:
            raise ValueError(f"`{given[0]}` is for the flow of heat, which needs `material`, such as `steel`")
        if self.material is not None and self.size == "per_env":
            raise ValueError("`material` with `size: per_env` is not supported: heat needs a volume known beforehand")
        return self

    @model_validator(mode="after")
    def _check(self) -> ObjectSpec:
        if self.geom is not None and self.variants is not None:
            raise ValueError("found `geom` and `variants`, expected one of them")
        if self.body is None and not self.compounds:
            raise ValueError("expected `body`, the name of a body in the scene, or `geom` or `variants` for a body of its own")
        own = [key for key in ("pos", "quat", "joint", "contype", "conaffinity") if getattr(self, key) is not None]
        if self.body is not None and own:
            raise ValueError(f'`{own[0]}` is for a body of its own; of body "{self.body}" the scene says it')
        if self.compounds and self.surface not in ("collision", "visual"):
            raise ValueError(f'surface "{self.surface}" names a geom; with geoms of its own it is `collision` or `visual`')
        return self

    @property
    def compounds(self) -> tuple[tuple[PrimitiveGeom | MeshGeom, ...], ...]:
        """The geoms of each variant; none if it is the scene's own."""
        variants = self.variants or (() if self.geom is None else (self.geom,))
        return tuple(part.geoms if isinstance(part, CompoundGeoms) else (part,) for part in variants)

    def body_of(self, name: str) -> str:
        """Return its body, its own name being this."""
        return name if self.body is None else self.body


def query_alternatives() -> list[Alternative]:
    """Return how distances to meshes may be found, from coarse to fine; to primitives they are exact."""
    grids = [
        Alternative(f"grid, {1e3 * error:g} mm", {"query": "sdf", "tolerance": error}) for error in (1e-3, 2e-4, 5e-5, 1e-5)
    ]
    return [*grids, Alternative("raycast", {"query": "raycast"}, unused=("tolerance", "max_bytes"), is_exact=True)]
