"""Taxels on colliding surfaces and outside other links: grids and even samples, for links by any name."""

import numpy as np
import pytest
from covered_hands import hand

from tgdsl.compiler.resolve import Resolved, resolve
from tgdsl.errors import SpecError
from tgdsl.layout.layout import COVERED
from tgdsl.placement.reach import unfelt
from tgdsl.placement.sample import poisson
from tgdsl.schema.load import load

ATOL = 1e-8  # [m] vertices are float32
SIDES = pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])
POISSON = {"method": "poisson", "count": 150, "radius": "2 mm"}
"""On the whole link."""


def grid(side: int, **more: object) -> dict:
    """Return a grid that looks across the hull's slanted side into the L's hollow."""
    return {"method": "grid", "rows": 7, "columns": 9, "direction": [-1, -side, 0], "radius": "2 mm", **more}


def placed(folder, side: int, placements: dict, **document: object) -> Resolved:
    (folder / "hand.xml").write_text(hand(side))
    layout = {"resolutions": {"only": placements}}
    return resolve(
        load({"tgdsl": 1, "robot": {"model": str(folder / "hand.xml"), "layout": layout}, **document}, needs_sensors=False)
    )


def above_hull(pos: np.ndarray, side: int) -> np.ndarray:
    """Return the distance of points of the palm's frame from its hull's slanted side, negative below it [m]."""
    return (pos[:, 0] + side * pos[:, 1] - 0.04) / np.sqrt(2)


@SIDES
def test_taxels_on_the_hull_are_not_in_the_hollow(tmp_path, side):
    """The mesh is sampled on the hollow's sides, up to 7 mm under the hull; the hull on its slanted side."""
    for method in (POISSON, grid(side)):
        num_on_hull = {}
        for surface in ("mesh", "collision"):
            layout = placed(tmp_path, side, {"palm": {**method, "surface": surface}}).layout
            x, y, z = layout.pos.T * [[1], [side], [1]]
            num_on_hull[surface] = (np.abs(above_hull(layout.pos, side)) < ATOL).sum()
            in_hollow = (
                (x > 0.01 - ATOL) & (y > 0.01 - ATOL) & (above_hull(layout.pos, side) < -1e-4) & (z > ATOL) & (z < 0.04 - ATOL)
            )
            assert in_hollow.any() == (surface == "mesh")
            if "count" in method:
                assert layout.num_taxels == 150
            np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, atol=1e-12)
        assert num_on_hull["mesh"] == 0 and num_on_hull["collision"] > 10


@pytest.mark.parametrize(("side", "surface"), [(1, "mesh"), (-1, "collision")], ids=["right-mesh", "left-collision"])
def test_covered_parts_get_no_taxels_and_counts_hold(tmp_path, side, surface):
    """The plate is welded to the palm and the finger starts inside it: no taxel lies inside another."""
    names = ("palm", "plate", "finger")
    for method in (POISSON, {**POISSON, "count": 40, "region": {"facing": [1, 0, 0], "within": "100 deg"}}):
        bare = placed(tmp_path, side, {name: {**method, "surface": surface} for name in names})
        assert {bare.layout.links[i].name for i in bare.layout.link_id[bare.reach.cover >= 0]} >= {"finger"}
        exposed = placed(tmp_path, side, {name: {**method, "surface": surface, "exposed": True} for name in names})
        assert np.bincount(exposed.layout.link_id).tolist() == [method["count"]] * 3
        assert (exposed.reach.cover == -1).all()
        if surface == "collision":
            assert unfelt(exposed.colliders, exposed.layout, exposed.reach) == ()
            assert (exposed.reach.depth <= 1e-6).all()


@SIDES
def test_covered_cells_of_a_grid_are_dropped(tmp_path, side):
    """The finger's first 8 mm are inside the palm, and the grid's rectangle spans the exposed rest."""
    method = {
        "method": "grid",
        "rows": 2,
        "columns": 10,
        "direction": [0, -side, 0],
        "columns_along": [1, 0, 0],
        "radius": "1 mm",
    }
    bare = placed(tmp_path, side, {"finger": method}).layout
    exposed = placed(tmp_path, side, {"finger": {**method, "exposed": True}}).layout
    # The finger spans x from 0 to 40 mm; the palm ends at 8 mm in its frame, to within a cell of the raster, 1/256.
    np.testing.assert_allclose(bare.pos[:, 0].reshape(2, 10), 0.002 + 0.004 * np.arange(10)[None].repeat(2, 0), atol=1e-9)
    assert exposed.num_taxels == 20 and exposed.pos[:, 0].min() > 0.008
    np.testing.assert_allclose(np.sort(exposed.pos[:10, 0]), 0.008 + 0.0016 + 0.0032 * np.arange(10), atol=0.04 / 256)
    counted = placed(tmp_path, side, {"finger": {**method, "exposed": True, "count": 7}}).layout
    assert counted.num_taxels == 7 and counted.pos[:, 0].min() > 0.008


@pytest.mark.parametrize("key", ["palm", "shell", "p*m"])
def test_links_by_geom_and_by_mesh(tmp_path, key):
    """The palm's geom has its body's name; the thumb, which collides only by a pair, shares the mesh `shell`."""
    text = (
        hand().replace('<body name="palm">', '<body name="base">').replace('name="palm" type="mesh"', 'name="palm" type="mesh"')
    )
    (tmp_path / "hand.xml").write_text(text)
    layout = {"resolutions": {"only": {key: {**POISSON, "surface": "collision", "exposed": True}}}}
    result = resolve(load({"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}}, needs_sensors=False))
    assert [link.body for link in result.layout.links] == ["base"] + ["thumb"] * (key == "shell")
    assert not result.reach.is_buried.any() and (result.reach.cover == -1).all() and result.reach.is_collided.all()
    assert (
        result.geoms_of(result.layout.links[0].name)[0].surface.faces.shape
        != result.robot.mesh(result.robot.geoms[1]).faces.shape
    )


def test_default_options_give_the_same_taxels_bit_for_bit(tmp_path):
    """Defaults may be spelled out; `exposed` changes nothing if nothing is covered."""
    for method in (POISSON, grid(1)):
        bare = placed(tmp_path, 1, {"thumb": method}).layout
        spelled = placed(tmp_path, 1, {"thumb": {**method, "surface": "mesh", "exposed": False}}).layout
        for name in ("pos", "normal", "tangent", "area", "cell"):
            np.testing.assert_array_equal(getattr(bare, name), getattr(spelled, name))
    exposed = placed(tmp_path, 1, {"thumb": {**POISSON, "exposed": True}}).layout
    np.testing.assert_array_equal(exposed.pos, placed(tmp_path, 1, {"thumb": POISSON}).layout.pos)


def test_an_object_in_the_robots_file_covers_nothing(tmp_path):
    """A sliding drawer is a link, unless it is an object: then parts inside it keep their taxels."""
    text = hand().replace("<freejoint/>", '<joint type="slide" axis="1 0 0"/>').replace('pos="0 0.03 0">', 'pos="0 0.03 0.02">')
    (tmp_path / "hand.xml").write_text(text)
    for objects, is_covered in (({}, True), ({"cube": {"body": "cube"}}, False)):
        layout = {"resolutions": {"only": {"palm": {**POISSON, "exposed": False}}}}
        document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}, "objects": objects}
        result = resolve(load(document, needs_sensors=False))
        cube = int(result.robot.compiled.body("cube").id)
        assert (result.reach.cover == cube).any() == is_covered
        assert (
            any(
                record.reason == COVERED and "cube" in record.why
                for record in unfelt(result.colliders, result.layout, result.reach)
            )
            == is_covered
        )


@pytest.mark.parametrize(
    ("link", "options", "message"),
    [
        (
            "the tip",
            {"surface": "collision"},
            'link "the tip": the simulator does not collide geom "nail"; expected `surface: mesh`',
        ),
        (
            "plug",
            {"exposed": True},
            'link "plug": no part of the link\'s exposed outer surface is in the region; other links cover it: place none here',
        ),
        ("palm", {"surface": "hull"}, "surface: found \"hull\", expected 'mesh' or 'collision'"),
        ("palm", {"exposed": "yes"}, 'exposed: found "yes": input should be a valid boolean'),
    ],
)
def test_impossible_placements_are_refused(tmp_path, monkeypatch, link, options, message):
    monkeypatch.setattr(poisson, "MIN_POOL", 1000)  # a link without exposed surface is sampled ten times as densely
    inner = '<body name="plug" pos=".005 .005 .02"><joint/><geom type="box" size=".003 .003 .003"/></body>'
    (tmp_path / "hand.xml").write_text(hand().replace('<body name="plate"', f'{inner}<body name="plate"'))
    layout = {"resolutions": {"only": {link: {**POISSON, "count": 5, **options}}}}
    document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}}
    with pytest.raises(SpecError) as caught:
        resolve(load(document, needs_sensors=False))
    assert message in str(caught.value)
