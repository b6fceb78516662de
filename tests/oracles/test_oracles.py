"""Every comparison and hard case holds; each kind and each finding has one."""

import numpy as np
import pytest

from oracles import report
from oracles.comparison import CASES, Comparison, Values, oracle
from oracles.defects import DEFECTS
from oracles.hard.case import HARD, Allowed, HardCase
from tgdsl.errors import TgdslError
from tgdsl.sensors import KINDS


def assert_holds(comparison: Comparison) -> None:
    """Assert that each value is within the comparison's tolerance of its exact value."""
    assert len(comparison.at) == comparison.exact.shape[-1]
    assert not comparison.series or len(comparison.series) == len(comparison.exact)
    np.testing.assert_allclose(
        comparison.ours, comparison.exact, rtol=comparison.rtol, atol=comparison.atol, err_msg=comparison.name
    )
    assert comparison.holds, comparison.name


def assert_stands(case: HardCase) -> None:
    """Assert that each error of a hard case is within its limit, in each precision."""
    for precision, allowed in case.errors.items():
        assert len(allowed.errors) == len(case.parts)
        for part, error in zip(case.parts, allowed.errors, strict=True):
            assert error <= allowed.most, f"{case.name}, {part}, {precision}: {error:.2g} {case.unit}"
    assert case.holds and case.is_finite


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.mark.slow
@pytest.mark.oracle
@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in CASES])
def test_it_holds(case, cache, monkeypatch):
    """A fresh cache forces the modal analysis."""
    if case.section == "sound: modes of bodies":
        monkeypatch.setenv("TGDSL_CACHE", str(cache))
    assert_holds(case.compute())


@pytest.mark.slow
@pytest.mark.oracle
@pytest.mark.parametrize("case", [pytest.param(case, id=case.name) for case in HARD])
def test_hard_cases_stand(case):
    assert_stands(case.compute())


def test_each_kind_and_each_finding_has_a_row():
    functions = {case.compute.func for case in CASES if case.is_reported}
    assert {kind for function in functions for kind in function.kinds} == {"noise", "geometry", *(kind.name for kind in KINDS)}
    for name, cases in (("oracles", CASES), ("hard", HARD)):
        answered = {number for case in cases if case.is_reported for number in case.compute.func.defects}
        assert {defect.number for defect in DEFECTS if defect.answered_in == name} <= answered
    assert [defect.number for defect in DEFECTS] == list(range(1, 26))


@pytest.fixture
def decorated():
    """Undo registrations of a test."""
    before = list(CASES)
    yield lambda **fields: oracle("section", ("kind",), "{x:mm} of {words}", "e", "s", "depth [m]", "at x [m]", **fields)
    CASES[:] = before


def test_a_comparison_that_does_not_hold_says_so(decorated):
    @decorated(rtol=0.05)
    def wrong(x=2e-3):
        return Values([1.0, 0.0], [1.1, 0.0], at=[1, 2], words={"words": "text"})

    comparison = wrong()
    assert (comparison.name, comparison.quantity, comparison.unit) == ("2 mm of text", "depth", "m")
    assert not comparison.holds
    assert comparison.error == pytest.approx(0.1)
    assert comparison.used == pytest.approx(2.0)
    entry = report.entry_of(comparison)
    assert not entry.holds and entry.record["of_allowed"] == pytest.approx(2.0)
    with pytest.raises(AssertionError, match="2 mm of text"):
        assert_holds(comparison)


def test_not_a_number_never_holds(decorated):
    broken = decorated(atol=np.inf)(lambda x=1.0: Values(1.0, np.nan, at=[1], words={"words": ""}))()
    assert not broken.holds and broken.error == np.inf


def test_what_cannot_be_computed_is_listed_with_its_reason(decorated):
    @decorated(each=[1.0], also=[2.0])
    def lacking(x):
        raise TgdslError("pip install something")

    progress = []
    results = report.run(CASES[-2:], lambda *step: progress.append(step))
    assert results == {"section": ([], [("test_oracles.lacking(1.0)", "pip install something")])}
    assert progress == [("section", 0, 1), ("", 1, 1)]


def test_a_hard_case_that_does_not_stand_says_so():
    errors = {"float64": Allowed(np.array([0.0, np.nan]), 1.0), "float32": Allowed(np.array([0.5, 0.5]), 1.0)}
    case = HardCase("name", "risk", "reference", "m", ("a", "b"), errors)
    assert not case.holds and not case.is_finite
    sheet = report.sheet_of("hard", {"group": ([case], [("other", "why")])})
    (entry,) = sheet.entries
    assert not entry.holds and entry.record["float64_worst"] == np.inf and entry.record["float32_worst"] == 0.5
    assert sheet.failed == sheet.entries and sheet.sections[0].left_out == (("other", "why"),)
    with pytest.raises(AssertionError, match="name, b, float64: nan m"):
        assert_stands(case)
