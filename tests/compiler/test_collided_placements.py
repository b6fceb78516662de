"""Taxels on what the simulator collides, and without what other links cover: grids and even samples, links by any name."""

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
    """Return a grid that looks along the hull's slanted side into the L's hollow."""
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
def test_on_the_hull_nothing_is_in_the_hollow(tmp_path, side):
    """Of the mesh the hollow's sides are sampled, down to 7 mm under the hull; of the hull its slanted side is."""
    for how in (POISSON, grid(side)):
        found = {}
        for surface in ("mesh", "collision"):
            layout = placed(tmp_path, side, {"palm": {**how, "surface": surface}}).layout
            x, y, z = layout.pos.T * [[1], [side], [1]]
            found[surface] = (np.abs(above_hull(layout.pos, side)) < ATOL).sum()
            in_hollow = (
                (x > 0.01 - ATOL) & (y > 0.01 - ATOL) & (above_hull(layout.pos, side) < -1e-4) & (z > ATOL) & (z < 0.04 - ATOL)
            )
            assert in_hollow.any() == (surface == "mesh")
            if "count" in how:
                assert layout.num_taxels == 150
            np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, atol=1e-12)
        assert found["mesh"] == 0 and found["collision"] > 10


@pytest.mark.parametrize(("side", "surface"), [(1, "mesh"), (-1, "collision")], ids=["right-mesh", "left-collision"])
def test_what_others_cover_is_left_out_and_counts_hold(tmp_path, side, surface):
    """The plate is welded to the palm, the finger begins in it: no taxel is inside either, nor theirs inside the palm."""
    names = ("palm", "plate", "finger")
    for how in (POISSON, {**POISSON, "count": 40, "region": {"facing": [1, 0, 0], "within": "100 deg"}}):
        bare = placed(tmp_path, side, {name: {**how, "surface": surface} for name in names})
        assert {bare.layout.links[i].name for i in bare.layout.link_id[bare.reach.cover >= 0]} >= {"finger"}
        exposed = placed(tmp_path, side, {name: {**how, "surface": surface, "exposed": True} for name in names})
        assert np.bincount(exposed.layout.link_id).tolist() == [how["count"]] * 3
        assert (exposed.reach.cover == -1).all()
        if surface == "collision":
            assert unfelt(exposed.colliders, exposed.layout, exposed.reach) == ()
            assert (exposed.reach.depth <= 1e-6).all()


@SIDES
def test_cells_of_a_grid_that_are_covered_are_dropped(tmp_path, side):
    """A grid on the finger's upper side: its first 8 mm are inside the palm. Its rectangle is that of what is exposed."""
    how = {"method": "grid", "rows": 2, "columns": 10, "direction": [0, -side, 0], "columns_along": [1, 0, 0], "radius": "1 mm"}
    bare = placed(tmp_path, side, {"finger": how}).layout
    exposed = placed(tmp_path, side, {"finger": {**how, "exposed": True}}).layout
    # The finger spans x from 0 to 40 mm; the palm ends at 8 mm in its frame, to within a cell of the raster, 1/256.
    np.testing.assert_allclose(bare.pos[:, 0].reshape(2, 10), 0.002 + 0.004 * np.arange(10)[None].repeat(2, 0), atol=1e-9)
    assert exposed.num_taxels == 20 and exposed.pos[:, 0].min() > 0.008
    np.testing.assert_allclose(np.sort(exposed.pos[:10, 0]), 0.008 + 0.0016 + 0.0032 * np.arange(10), atol=0.04 / 256)
    kept = placed(tmp_path, side, {"finger": {**how, "exposed": True, "count": 7}}).layout
    assert kept.num_taxels == 7 and kept.pos[:, 0].min() > 0.008


@pytest.mark.parametrize("key", ["palm", "shell", "p*m"])
def test_links_by_geom_and_by_mesh(tmp_path, key):
    """The palm's geom is named as its body; the mesh `shell` is the thumb's too, which collides by a pair alone."""
    text = (
        hand().replace('<body name="palm">', '<body name="base">').replace('name="palm" type="mesh"', 'name="palm" type="mesh"')
    )
    (tmp_path / "hand.xml").write_text(text)
    layout = {"resolutions": {"only": {key: {**POISSON, "surface": "collision", "exposed": True}}}}
    found = resolve(load({"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}}, needs_sensors=False))
    assert [link.body for link in found.layout.links] == ["base"] + ["thumb"] * (key == "shell")
    assert not found.reach.is_buried.any() and (found.reach.cover == -1).all() and found.reach.is_collided.all()
    assert (
        found.geoms_of(found.layout.links[0].name)[0].surface.faces.shape != found.robot.mesh(found.robot.geoms[1]).faces.shape
    )


def test_a_mesh_is_sampled_as_before_bit_for_bit(tmp_path):
    """The defaults, spelled out or not, give the same taxels; so does `exposed` where nothing is covered."""
    for how in (POISSON, grid(1)):
        bare = placed(tmp_path, 1, {"thumb": how}).layout
        spelled = placed(tmp_path, 1, {"thumb": {**how, "surface": "mesh", "exposed": False}}).layout
        for name in ("pos", "normal", "tangent", "area", "cell"):
            np.testing.assert_array_equal(getattr(bare, name), getattr(spelled, name))
    exposed = placed(tmp_path, 1, {"thumb": {**POISSON, "exposed": True}}).layout
    np.testing.assert_array_equal(exposed.pos, placed(tmp_path, 1, {"thumb": POISSON}).layout.pos)


def test_an_object_in_the_robots_file_covers_nothing(tmp_path):
    """A drawer that slides is a link, unless it is an object: then what is in it at rest is not left out."""
    text = hand().replace("<freejoint/>", '<joint type="slide" axis="1 0 0"/>').replace('pos="0 0.03 0">', 'pos="0 0.03 0.02">')
    (tmp_path / "hand.xml").write_text(text)
    for objects, is_covered in (({}, True), ({"cube": {"body": "cube"}}, False)):
        layout = {"resolutions": {"only": {"palm": {**POISSON, "exposed": False}}}}
        document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}, "objects": objects}
        found = resolve(load(document, needs_sensors=False))
        cube = int(found.robot.compiled.body("cube").id)
        assert (found.reach.cover == cube).any() == is_covered
        assert (
            any(own.reason == COVERED and "cube" in own.why for own in unfelt(found.colliders, found.layout, found.reach))
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
def test_what_cannot_be_is_told(tmp_path, monkeypatch, link, options, message):
    monkeypatch.setattr(poisson, "MIN_POOL", 1000)  # a link without exposed surface is sampled ten times as densely
    inner = '<body name="plug" pos=".005 .005 .02"><joint/><geom type="box" size=".003 .003 .003"/></body>'
    (tmp_path / "hand.xml").write_text(hand().replace('<body name="plate"', f'{inner}<body name="plate"'))
    layout = {"resolutions": {"only": {link: {**POISSON, "count": 5, **options}}}}
    document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": layout}}
    with pytest.raises(SpecError) as caught:
        resolve(load(document, needs_sensors=False))
    assert message in str(caught.value)
