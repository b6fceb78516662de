"""Tables as users see them, against text by hand."""

import numpy as np
import pytest

from tgdsl.console.tables import TaxelTable, TaxelTables, listing, shapes, text_table, with_units

KIND = np.dtype([("link", "U8"), ("body", "U8"), ("pos", float, 3), ("radius", float), ("area", float)])


def table(*rows: tuple[object, ...]) -> TaxelTable:
    return np.array(list(rows), dtype=KIND).view(TaxelTable)


def test_cells_are_aligned_under_their_header():
    text = text_table(("a", "long"), [("three", "x"), ("b", "y")])
    assert text == "a      long\n─────  ────\nthree  x\nb      y"
    assert text_table(("a",), [("b",)], more=2) == "a\n─\nb\n… and 2 more"


def test_a_listing_aligns_names_and_wraps_text():
    assert listing([("one", "first"), ("three", "")]) == "  one    first\n  three  none"
    assert listing([]) == ""
    first, second = listing([("name", " ".join(["word"] * 30))]).split("\n")
    assert first.startswith("  name  word") and second.startswith(" " * 8 + "word")
    assert len(first) <= 112 < len(first + " word")


@pytest.mark.parametrize(
    ("channels", "units", "text"),
    [
        (("force_x", "force_y", "depth"), ("N", "N", "m"), "force_x, force_y [N], depth [m]"),
        (("bit", "force"), ("1", "N"), "bit, force [N]"),
        (("force", "bit"), ("N", "1"), "force [N], bit"),
    ],
)
def test_a_unit_appears_once_after_its_channels(channels, units, text):
    assert with_units(channels, units) == text


def test_shapes_lists_dtypes_and_shapes():
    assert shapes({"a": np.zeros((2, 3)), "b": 3}) == "a float64 (2, 3), b int"


def test_long_tables_of_taxels_are_cut():
    rows = table(*((f"l{i}", "b", (0, 0, -1e-9), 0.002, 1e-6) for i in range(23)))
    lines = repr(rows).split("\n")
    assert lines[0].split() == ["link", "body", "pos", "radius", "area"]
    assert lines[2].split() == ["0", "l0", "b", "0.0000", "0.0000", "0.0000", "0.002", "1e-06"]
    assert len(lines) == 2 + 20 + 1 and lines[-1] == "… and 3 more"
    assert type(rows["radius"]) is np.ndarray and type(rows[:2]) is TaxelTable


def test_sensors_on_the_same_taxels_share_a_table():
    both = [("tip", "t", (0, 0, 0), 0.001, 2e-6), ("tip", "t", (0, 0, 0), 0.0025, 3e-6), ("pad", "p", (0, 0, 0), 0.0, 1e-6)]
    text = repr(TaxelTables({"one": table(*both), "two": table(*both), "three": table(both[0])}))
    first, second = text.split("\n\n")
    assert first.split("\n")[0] == "one, two" and second.split("\n")[0] == "three"
    assert first.split("\n")[1].split("  ")[0] == "link"
    assert [line.split() for line in first.split("\n")[3:]] == [["tip", "t", "2", "1–2.5", "5"], ["pad", "p", "1", "0", "1"]]
    assert [line.split() for line in second.split("\n")[3:]] == [["tip", "t", "1", "1", "2"]]


def test_names_are_not_broken():
    long = "-".join(["part"] * 40)
    assert listing([("a", f"first {long}")]).split("\n") == ["  a  first", f"     {long}"]
