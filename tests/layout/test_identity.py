"""Tables of taxels that are the same, and how others differ: rows changed by hand."""

import dataclasses
import itertools
import re

import numpy as np
import pytest

from tgdsl.errors import TaxelError
from tgdsl.layout.identity import check_same_rows, columns_of, is_same_id, taxels_id
from tgdsl.layout.layout import Layout, Link

LAYOUT = Layout(
    links=(Link("palm", "base"), Link("tip", "finger")),
    groups={"all": ("palm", "tip")},
    link_id=np.array([0, 0, 0, 1]),
    pos=np.array([[0.001, 0.002, 0.003], [0.004, 0, 0], [0, 0.005, 0], [0.001, 0.002, 0.003]]),
    normal=np.tile([0.0, 0, 1], (4, 1)),
    tangent=np.tile([1.0, 0, 0], (4, 1)),
    radius=np.full(4, 0.002),
    area=np.full(4, 1e-5),
    cell=np.array([[0, 0], [0, 1], [1, 0], [-1, -1]]),
)


POSITION, DIRECTION, AREA = 1e-6, 1e-4, 0.05
"""What files in float32 differ by, at most [m, rad], and what counting a few hundred sampled points does, relative."""


def changed(**arrays: object) -> Layout:
    return dataclasses.replace(LAYOUT, **arrays)


def moved(name: str, row: int, by: object) -> Layout:
    array = getattr(LAYOUT, name).copy()
    array[row] += by
    return changed(**{name: array})


def message(here: Layout, there: Layout = LAYOUT) -> str:
    with pytest.raises(TaxelError) as caught:
        check_same_rows(columns_of(here), columns_of(there), "x")
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "by", "column"),
    [
        ("pos", POSITION, "pos"),
        ("normal", DIRECTION, "normal [0, 0, 1"),
        ("tangent", DIRECTION, "tangent [1, 0, 0"),
        ("radius", POSITION, "radius 0.002"),
        ("area", AREA * 1e-5, "area 1e-05"),
    ],
)
def test_what_is_within_the_tolerance_is_the_same_and_what_is_beyond_is_not(name, by, column):
    step = np.array([0, by, 0]) if getattr(LAYOUT, name).ndim == 2 else by
    check_same_rows(columns_of(moved(name, 2, 0.99 * step)), columns_of(LAYOUT), "x")
    text = message(moved(name, 2, 1.2 * step))
    assert text.startswith("x: 1 of 4 rows are other taxels than expected")
    assert 'the first is row 2: link "palm" at [0, 5' in text
    if name != "pos":
        assert column in text


def test_the_message_counts_rows_and_shows_the_first_that_differs():
    order = [0, 2, 1, 3]
    assert message(changed(**{name: getattr(LAYOUT, name)[order] for name in ("pos", "cell")})) == (
        "x: 2 of 4 rows are other taxels than expected, the same ones in another order; "
        'the first is row 1: link "palm" at [0, 5, 0] mm here, link "palm" at [4, 0, 0] mm expected'
    )
    assert message(LAYOUT.take(np.array([0, 1, 3]))) == (
        "x: 3 taxels here, 4 expected; "
        'the first is row 2: link "tip" at [1, 2, 3] mm here, link "palm" at [0, 5, 0] mm expected'
    )
    assert message(LAYOUT.take(np.array([0, 1]))) == "x: 2 taxels here, 4 expected"
    assert message(changed(cell=np.array([[0, 0], [0, 1], [1, 3], [-1, -1]]))) == (
        "x: 1 of 4 rows are other taxels than expected, the same ones in another order; "
        'the first is row 2: link "palm" at [0, 5, 0] mm, column 3 here, link "palm" at [0, 5, 0] mm, column 0 expected'
    )
    other = changed(links=(Link("palm", "base"), Link("tip", "thumb")))
    assert message(other).endswith('[1, 2, 3] mm, body thumb here, link "tip" at [1, 2, 3] mm, body finger expected')


def test_columns_that_one_table_lacks_are_not_compared():
    short = {name: column for name, column in columns_of(moved("tangent", 0, [0, 1, 0])).items() if name != "tangent"}
    check_same_rows(short, columns_of(LAYOUT), "x")
    check_same_rows(columns_of(LAYOUT), short, "x")
    wide = columns_of(moved("radius", 0, 0.001))
    for here, there in ((wide, short), (short, wide)):
        with pytest.raises(TaxelError, match=r"radius 0\.00[23] here, link .* radius 0\.00[23] expected$"):
            check_same_rows(here, there, "x")


def test_an_id_is_of_each_name_and_place_but_of_no_group():
    assert re.fullmatch("[0-9a-f]{32}", taxels_id(LAYOUT))
    assert taxels_id(LAYOUT) == 2 * "0c03947df9e11363", "files of policies hold ids, and must keep matching"
    assert taxels_id(changed(groups={})) == taxels_id(changed()) == taxels_id(LAYOUT)
    others = [moved(name, 1, by) for name, by in (("pos", 1e-3), ("normal", 0.1), ("tangent", 0.1), ("radius", 1e-3))]
    others += [moved("cell", 1, 1), changed(link_id=np.array([0, 0, 1, 1]))]
    others += [changed(links=(Link("palm", "base"), Link(*names))) for names in (("tip", "thumb"), ("top", "finger"))]
    others += [changed(links=(Link("palm base", "4 tip"), Link("", "finger")))]
    order = [0, 2, 1, 3]
    others += [changed(pos=LAYOUT.pos[order])]
    for one, other in itertools.combinations([LAYOUT, *others], 2):
        assert not is_same_id(taxels_id(one), taxels_id(other))


def test_ids_overlook_rounding_wherever_numbers_are():
    """Two tables in ten thousand have a number within 1e-8 m of a line of each grid, of 600 in 1 mm: (600 · 2e-8 / 1e-3)²."""
    draw, num = np.random.default_rng(0), 200
    for _ in range(100):
        normal = draw.normal(size=(num, 3))
        arrays = {
            "link_id": np.zeros(num, np.int64),
            "pos": draw.uniform(-0.1, 0.1, (num, 3)),
            "normal": normal / np.linalg.norm(normal, axis=1, keepdims=True),
            "tangent": np.tile([1.0, 0, 0], (num, 1)),
            "radius": np.full(num, 0.004),
            "area": draw.uniform(1e-5, 2e-5, num),
            "cell": np.full((num, 2), -1),
        }
        one = changed(**arrays)
        noise = {name: arrays[name] + draw.uniform(-1e-8, 1e-8, arrays[name].shape) for name in ("pos", "normal", "tangent")}
        assert is_same_id(taxels_id(one), taxels_id(changed(**arrays | noise | {"area": 1.04 * arrays["area"]})))
    for number in np.arange(-60, 61) / 4 * 1e-3:  # as people draw them
        one, other = (moved("pos", 0, [number + by, 0, 0]) for by in (-1e-6, 1e-6))
        assert taxels_id(one) == taxels_id(other)


def test_areas_are_compared_with_the_larger_one():
    """5 % of the larger: 1 and 0.951 are the same whichever is where, 1 and 0.949 are not; nothing is the same as nothing."""
    for share, is_same in ((0.951, True), (0.949, False)):
        other = changed(area=LAYOUT.area * share)
        for here, there in ((LAYOUT, other), (other, LAYOUT)):
            if is_same:
                check_same_rows(columns_of(here), columns_of(there), "x")
            else:
                assert message(here, there).startswith("x: 4 of 4 rows are other taxels")
    check_same_rows(columns_of(changed(area=np.zeros(4))), columns_of(changed(area=np.zeros(4))), "x")


def test_the_same_taxels_in_another_order_are_known_by_place_whatever_the_sign_of_zero():
    order, signs = [0, 2, 1, 3], np.where(LAYOUT.pos == 0, -1.0, 1.0)
    other = changed(**{name: getattr(LAYOUT, name)[order] for name in ("normal", "cell")}, pos=(LAYOUT.pos * signs)[order])
    assert ", the same ones in another order; the first is row 1" in message(other)
    assert ", the same ones in another order" in message(dataclasses.replace(other, pos=other.pos + 2e-5))  # 20 µm from there
