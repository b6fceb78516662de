"""The layout of taxels: link groups and, per resolution and link, how its surface is sampled."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictBool, StrictInt, Tag, model_validator

from tgdsl.fields.models import (
    TEXT_OR_OTHER,
    Area,
    Direction,
    Position,
    PositiveLength,
    Radius,
    Selector,
    SpecModel,
    Text,
    Usual,
)
from tgdsl.fields.regions import Region

MAX_COUNT = 1_000_000
Count = Annotated[StrictInt, Field(ge=1, le=MAX_COUNT)]
Cell = Annotated[StrictInt, Field(ge=0, lt=MAX_COUNT)]


class _Sampled(SpecModel):
    radius: Annotated[Radius, Usual("length", low=1e-5, high=0.1)]
    """Sensing radius of each probe [m]; 0 makes it an inactive filler."""
    region: Region = ()
    """Part of the surface to sample: a region, or a list of regions that means their intersection; default: all of it."""
    surface: Literal["mesh", "collision"] = "mesh"
    """`mesh`: meshes as they are; `collision`: their convex hulls, which the simulator collides, and which keep objects out of
    the hollows of a concave mesh."""
    exposed: StrictBool = False
    """Whether to leave out surface inside other colliding geoms of the robot in the model's initial state, such as the part of
    a link that the next one covers."""


class Grid(_Sampled):
    """Rows × columns projected along a direction onto the surface; cells that miss it are dropped."""

    method: Literal["grid"]
    """Regular cells projected along a direction."""
    rows: Count
    """Cells across `columns_along`."""
    columns: Count
    """Cells along `columns_along`."""
    direction: Direction
    """Direction of projection in the link frame, into the surface: `[-1, 0, 0]` samples the side that faces +x."""
    columns_along: Direction | None = None
    """Axis of the columns in the link frame; default: the first of the link's z, y, x axes that is not near parallel
    (|cos| < 0.7) to `direction`."""
    rows_reversed: bool = False
    """Whether row 0 is at the far end of the rows' axis: on a mirrored hand taxel i is then the mirror image of taxel i."""
    count: Count | None = None
    """Number of cells to use, of the cells that hit the surface the nearest to the grid's centre; default: all that hit."""

    @model_validator(mode="after")
    def _enough_cells(self) -> Grid:
        if self.rows * self.columns > MAX_COUNT:
            raise ValueError(f"{self.rows} × {self.columns} cells are too many, expected at most {MAX_COUNT} in all")
        if self.count is not None and self.count > self.rows * self.columns:
            raise ValueError(f"count {self.count} is more than the {self.rows} × {self.columns} cells of the grid")
        return self


class Poisson(_Sampled):
    """Blue-noise samples of the surface: an exact count, or as many as fit at a spacing."""

    method: Literal["poisson"]
    """Irregular, evenly spread samples."""
    count: Count | None = None
    """Exact number of samples."""
    spacing: Annotated[PositiveLength | None, Usual("length", high=0.1)] = None
    """Least distance between samples [m], instead of `count`."""
    seed: Annotated[StrictInt, Field(ge=0)] = 0
    """Seed of the sampling."""
    sampler: Literal["lattice", "pymeshlab"] = "lattice"
    """Draws the candidates: `lattice`: on lines fixed in space, so that a mesh that was saved again gives the same taxels;
    `pymeshlab`: its stratified sampling of the faces, which follows their order."""

    @model_validator(mode="after")
    def _one_of(self) -> Poisson:
        if (self.count is None) == (self.spacing is None):
            raise ValueError("expected exactly one of `count` and `spacing`")
        return self


class Point(SpecModel):
    """One probe, given by hand."""

    pos: Annotated[Position, Usual("length", high=5.0)]
    """Position in the link frame [m]."""
    normal: Direction
    """Outward normal in the link frame; it is normalised."""
    radius: Annotated[Radius | None, Usual("length", low=1e-5, high=0.1)] = None
    """Sensing radius [m]; default: the `radius` of the list."""
    area: Annotated[Area | None, Usual("area", high=0.01)] = None
    """Surface that the probe stands for [m²]; default: the disc of its radius."""
    tangent: Direction | None = None
    """Direction of shear x in the link frame, across the normal; default: the first of the z, y, x axes that is not near it."""
    row: Cell | None = None
    """Row in the grid of the link's taxels, for images; default: it is on no grid."""
    column: Cell | None = None
    """Column in that grid."""

    @model_validator(mode="after")
    def _whole_cell(self) -> Point:
        if (self.row is None) != (self.column is None):
            raise ValueError("expected both `row` and `column`, or neither")
        return self


class Points(SpecModel):
    """Probes given one by one, or in a CSV file with the header `x,y,z,nx,ny,nz`.

    Further columns as needed: `radius`, `area`, the tangent `tx,ty,tz`, the cell `row,column`, and `link` in a file of several.
    """

    method: Literal["points"]
    """Explicit probes."""
    points: Annotated[Text | Annotated[tuple[Point, ...], Field(min_length=1), Tag("other")], TEXT_OR_OTHER]
    """The probes, or the name of a CSV file next to the layout (SI units), from which each link takes its rows."""
    radius: Annotated[Radius | None, Usual("length", low=1e-5, high=0.1)] = None
    """Sensing radius of the points that name none [m]."""

    @model_validator(mode="after")
    def _has_radii(self) -> Points:
        if self.radius is None and not isinstance(self.points, str):
            bare = [i for i, point in enumerate(self.points) if point.radius is None]
            if bare:
                raise ValueError(f"points[{bare[0]}] has no radius, and the list gives none for all")
        return self


Placement = Annotated[Grid | Poisson | Points, Field(discriminator="method")]


class LayoutSpec(SpecModel):
    """Link groups, and at each resolution how each link is sampled."""

    tgdsl: Literal[1] = 1
    """Version of the grammar."""
    groups: dict[str, Selector] = {}
    """Named sets of links: wildcards over link names, or other groups."""
    resolutions: Annotated[dict[str, dict[str, Placement]], Field(min_length=1)]
    """Per resolution, per link (a body, geom or mesh name, or a shell wildcard): how its surface is sampled."""
