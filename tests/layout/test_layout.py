"""Layouts: rows and links that are chosen from one, by hand."""

import numpy as np

from tgdsl.layout.layout import Layout, Link

LINKS = (Link("palm", "base"), Link("pad", "base"), Link("tip", "finger"))
LAYOUT = Layout(
    links=LINKS,
    groups={"hand": ("palm", "pad", "tip"), "ends": ("tip",)},
    link_id=np.array([0, 1, 1, 2]),
    pos=np.arange(12.0).reshape(4, 3),
    normal=np.tile([0.0, 0, 1], (4, 1)),
    tangent=np.tile([1.0, 0, 0], (4, 1)),
    radius=np.array([0.1, 0.2, 0.3, 0.4]),
    area=np.array([1.0, 2.0, 3.0, 4.0]),
    cell=np.array([[0, 0], [0, 1], [1, 0], [-1, -1]]),
)


def test_links_without_taxels_have_empty_columns():
    found = Layout.of_links(LINKS[1:], {"hand": ("palm", "pad"), "palm": ("palm",)})
    assert found.num_taxels == 0 and found.groups == {"hand": ("pad",)} and found.bodies == ("base", "finger")
    shapes = {name: getattr(found, name).shape for name in ("pos", "normal", "tangent", "radius", "area", "cell")}
    assert shapes == {"pos": (0, 3), "normal": (0, 3), "tangent": (0, 3), "radius": (0,), "area": (0,), "cell": (0, 2)}
    assert found.link_id.dtype == found.cell.dtype == np.int64


def test_bodies_count_once():
    assert LAYOUT.bodies == ("base", "finger")
    assert LAYOUT.link_body_id.tolist() == [0, 0, 1] and LAYOUT.body_id.tolist() == [0, 0, 0, 1]


def test_rows_of_links_and_rows_that_are_taken():
    assert LAYOUT.taxels_of(("tip", "palm")).tolist() == [0, 3]
    found = LAYOUT.take(np.array([1, 3]))
    assert found.links == LINKS[1:] and found.link_id.tolist() == [0, 1]
    assert found.groups == {"hand": ("pad", "tip"), "ends": ("tip",)}
    assert (found.pos.tolist(), found.radius.tolist(), found.area.tolist()) == ([[3, 4, 5], [9, 10, 11]], [0.2, 0.4], [2, 4])
    assert found.cell.tolist() == [[0, 1], [-1, -1]]
    assert LAYOUT.take(np.array([0])).groups == {"hand": ("palm",)}
