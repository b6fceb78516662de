"""All hard cases stand, and each finding has its line."""

import numpy as np
import pytest
from held import assert_stands

from oracles.hard import contacts, every, heat, kinds, probes
from oracles.hard.results import Allowed, HardCase, entry_of
from tgdsl.report.defects import DEFECTS

SLOW = tuple(case for case in kinds.CASES if getattr(case, "keywords", {}).get("scale", 1.0) != 1.0)
"""Bake fields of moments at other sizes."""


@pytest.mark.parametrize("case", [case for case in kinds.CASES if case not in SLOW])
def test_every_kind_stands(case):
    assert_stands(case())


@pytest.mark.parametrize("case", SLOW)
def test_every_kind_stands_at_other_sizes(case):
    assert_stands(case())


@pytest.mark.parametrize("case", [*probes.CASES, *contacts.CASES, *heat.CASES])
def test_hard_cases_stand(case):
    assert_stands(case())


def test_every_finding_has_its_line():
    """Of cases that answer findings for this report."""
    cheap = (
        kinds.reset_of_some, probes.early_contact, contacts.first_reading, contacts.bytes_of_state, contacts.tactile_frames,
        heat.turned_links, heat.energy,
    )  # fmt: skip
    numbers = {number for case in cheap for number in case().defects}
    assert {defect.number for defect in DEFECTS if defect.answered_in == "hard"} <= numbers
    assert [defect.number for defect in DEFECTS] == list(range(1, 26))


def test_a_case_that_does_not_stand_is_told():
    errors = {"float64": Allowed(np.array([0.0, np.nan]), 1.0), "float32": Allowed(np.array([0.5, 0.5]), 1.0)}
    case = HardCase("name", "risk", "reference", "m", ("a", "b"), errors)
    assert not case.holds and not case.is_finite
    entry = entry_of(case)
    assert not entry.holds and entry.record["float64_worst"] == np.inf and entry.record["float32_worst"] == 0.5
    sheet = every.sheet_of({"group": ([case], [("other", "why")])})
    assert sheet.failed == sheet.entries and sheet.sections[0].left_out == (("other", "why"),)
