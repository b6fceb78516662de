"""Points given by hand are taken unchanged; mistakes in files of points are located."""

import numpy as np
import pytest
from oracles.setups.solids import ball, surface_of
from surfaces import HERE, error_of, placement

from tgdsl.errors import SampleError
from tgdsl.placement.sample.sample import sample


def test_points_are_taken_unchanged():
    points = [
        {"pos": [9, 8, 7], "normal": [0, 0, 5], "area": "2 mm2"},
        {"pos": [1, 2, 3], "normal": [1e-200, 0, 0], "radius": 0.01},
        {"pos": [0, 0, 0], "normal": [0, 1, 0], "radius": 0},
    ]
    samples = sample(surface_of(ball(0.01)), placement("points", points=points), HERE)
    np.testing.assert_array_equal(samples.pos, [[9, 8, 7], [1, 2, 3], [0, 0, 0]])
    np.testing.assert_array_equal(samples.normal, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(samples.tangent, [[0, 1, 0], [0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(samples.radius, [0.002, 0.01, 0])
    np.testing.assert_allclose(samples.area, [2e-6, np.pi * 1e-4, 0], rtol=1e-12)
    np.testing.assert_array_equal(samples.cell, np.full((3, 2), -1))


def test_cells_are_counted_from_0():
    point = {"pos": [0, 0, 0], "normal": [0, 0, 1], "row": 0, "column": 0}
    samples = sample(surface_of(ball(0.01)), placement("points", points=[point, {**point, "column": 3}]), HERE)
    np.testing.assert_array_equal(samples.cell, [[0, 0], [0, 3]])
    with pytest.raises(ValueError, match="greater than or equal to 0"):
        placement("points", points=[{**point, "row": -1}])


def test_points_from_a_file(tmp_path):
    text = "x, y, z, nx, ny, nz, radius, area\n1,2,3,0,0,2,,\n\n4,5,6,0,-3,4,0.01,1e-6\n"
    (tmp_path / "pads.csv").write_text("\ufeff" + text, encoding="utf-8")
    samples = sample(surface_of(ball(1)), placement("points", points="pads.csv"), tmp_path)
    np.testing.assert_array_equal(samples.pos, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(samples.normal, [[0, 0, 1], [0, -0.6, 0.8]], rtol=1e-15)
    np.testing.assert_array_equal(samples.radius, [0.002, 0.01])
    np.testing.assert_allclose(samples.area, [np.pi * 0.002**2, 1e-6], rtol=1e-15)


HEADER = "x,y,z,nx,ny,nz"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z,nx,ny\n", "p.csv:1: no column nz; expected the header x,y,z,nx,ny,nz"),
        ("", "p.csv:1: no column x, y, z, nx, ny, nz; expected the header x,y,z,nx,ny,nz"),
        (f"{HEADER},radus\n", 'p.csv:1: unknown column "radus"; did you mean "radius"?'),
        (f"{HEADER}\n", "p.csv has no points"),
        (f"{HEADER},radius\n0,0,0,0,0,1,1\n0,0,b,0,0,1,1\n", 'p.csv:3: z is "b", expected a number'),
        (f"{HEADER},radius\n0,0,inf,0,0,1,1\n", 'p.csv:2: z is "inf", expected a number'),
        (f"{HEADER},radius\n0,,0,0,0,1,1\n", "p.csv:2: y is empty, expected a number"),
        (f"{HEADER}\n0,0,0,0,0,1,1\n", "p.csv:2: more values than the header has columns"),
        (f"{HEADER},radius\n0,0,0,0,0,1,-1\n", "p.csv:2: radius -1 is out of range, expected at least 0"),
        (f"{HEADER},area\n0,0,0,0,0,1,0\n", "p.csv:2: area 0 is out of range, expected more than 0"),
        (
            f"{HEADER},radius\n0,0,0,0,0,0,1\n",
            "p.csv:2: normal [0, 0, 0] has no direction; expected a vector of non-zero length",
        ),
        (
            f"{HEADER}\n0,0,0,0,0,1\n",
            "p.csv:2: the point has no radius; add a column `radius`, or give one `radius` for the whole file",
        ),
    ],
)
def test_invalid_files_of_points_are_refused(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    where = placement("points", points="p.csv", radius=None)
    assert str(error_of(surface_of(ball(1)), where, tmp_path)) == message


def test_a_missing_file_of_points_is_refused(tmp_path):
    error = error_of(surface_of(ball(1)), placement("points", points="no.csv"), tmp_path)
    assert (error.what, error.hint) == ("cannot read the points of no.csv: No such file or directory", "")


def test_a_file_of_several_links_with_tangents_and_cells(tmp_path):
    lines = [f"link,{HEADER},tx,ty,tz,row,column", "a,1,2,3,0,0,2,1,0,1,0,2", "b,0,0,0,0,0,1,,,,,", "a,4,5,6,0,0,1,,,,,"]
    (tmp_path / "p.csv").write_text("\n".join(lines))
    where = placement("points", points="p.csv")
    samples = sample(surface_of(ball(1)), where, tmp_path, "a")
    np.testing.assert_array_equal(samples.pos, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(samples.tangent, [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(samples.cell, [[0, 2], [-1, -1]])
    with pytest.raises(SampleError, match=r'^p\.csv has no points of the link "c"; known links: a, b$'):
        sample(surface_of(ball(1)), where, tmp_path, "c")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HEADER},tx,ty,tz\n0,0,0,0,0,1,0,0,3\n", "p.csv:2: the tangent is along the normal; expected a direction across it"),
        (f"{HEADER},tx,ty,tz\n0,0,0,0,0,1,1,,\n", "p.csv:2: tx without the others of tx, ty, tz; give all or none"),
        (f"{HEADER},row\n0,0,0,0,0,1,1\n", "p.csv:2: row without the others of row, column; give all or none"),
        (f"{HEADER},row,column\n0,0,0,0,0,1,1,.5\n", 'p.csv:2: column is ".5", expected a whole number from 0 to 999999'),
        (
            f"{HEADER},row,column\n0,0,0,0,0,1,1,2\n0,0,0,0,0,1,1,2\n",
            "p.csv:3: row 1, column 2 is used by p.csv:2 too; one point for each cell",
        ),
        (f"{HEADER},x\n0,0,0,0,0,1,1\n", 'p.csv:1: column "x" is there twice'),
    ],
)
def test_invalid_tangents_and_cells_are_refused(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    assert str(error_of(surface_of(ball(1)), placement("points", points="p.csv"), tmp_path)) == message
