"""Sheets as text and files: contents and repeatability."""

import csv
import json
from dataclasses import replace

import numpy as np

from oracles import report
from oracles.comparison import CASES
from oracles.defects import DEFECTS
from oracles.hard.case import Allowed, HardCase
from oracles.sheet import Entry, findings, sheet_page, sheet_text, write_sheet


def sheet():
    case_of = {case.name: case for case in CASES}  # their order is that in which files were imported
    names = ("half_space.loaded_disc()", "filters.maxwell_step()", "filters.crosstalk_edges()")
    return report.sheet_of("oracles", report.run([case_of[name] for name in names]))


def test_files_have_every_number_and_a_plot_of_each(tmp_path):
    written = write_sheet(sheet(), tmp_path)
    assert [file.name for file in written] == ["oracles.csv", "oracles.json", "oracles.html"]
    rows = list(csv.DictReader(written[0].read_text().splitlines()))
    assert [row["section"] for row in rows] == ["contact mechanics: half-space", "filters", "filters"]
    assert float(rows[2]["paper_error"]) > 0.6 and rows[2]["holds"] == "True"
    entries = json.loads(written[1].read_text())["entries"]
    np.testing.assert_allclose(entries[2]["exact"], [1, 1, 1])
    assert entries[2]["defects"] == [10]
    text = written[2].read_text()
    assert text.count("<svg") == 3
    assert "http://" not in text.replace("http://www.w3.org", "") and "src=" not in text
    for defect in DEFECTS:
        assert f"{defect.number}. {defect.about}".replace("'", "&#x27;") in text
    again = tmp_path / "again"
    again.mkdir()
    assert [file.read_bytes() for file in write_sheet(sheet(), again)] == [file.read_bytes() for file in written]


def test_the_text_says_what_does_not_hold():
    assert sheet_text(sheet()).endswith("3 of 3 hold")
    case = HardCase("name", "risk", "reference", "m", ("a",), {"float64": Allowed(np.array([2.0]), 1.0)}, (5,))
    failed = report.sheet_of("hard", {"group": ([case], [("other", "no extra")])})
    text = sheet_text(failed)
    assert text.endswith("1 of 1 do not hold (✗)")
    assert "✗" in text and "not to be had: other: no extra" in text
    assert 'class="failed"' in sheet_page(failed)
    assert replace(failed, sections=()).failed == ()


def test_the_first_entry_answers_a_finding():
    entries = [
        Entry(title, (), {}, (), lambda _: None, True, numbers, title * 2) for title, numbers in (("a", (3,)), ("b", (3, 4)))
    ]
    answered = {defect.number: (title, figure) for defect, title, figure in findings(entries)}
    assert list(answered) == [defect.number for defect in DEFECTS]
    assert answered[3] == ("a", "aa") and answered[4] == ("b", "bb") and answered[1] == ("", "")
