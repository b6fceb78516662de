"""Requirements of policies: syntax, evaluation and errors."""

from types import SimpleNamespace

import pytest

from tgdsl.errors import TgdslError
from tgdsl.rl.playing.evaluation import parse_requirements


def evaluation(**gait):
    return SimpleNamespace(
        score=8.0, held=0.96, gait=SimpleNamespace(**{"coasting": 0.1, "penetration": 0.002, "force": None} | gait)
    )


def test_units_and_signs_are_parsed():
    parts = parse_requirements("coasting<10 %, penetration <= 2 mm,held>=95%, spin<7 rad/s, force>1")
    assert [(part.name, part.sign) for part in parts] == [
        ("coasting", "<"), ("penetration", "<="), ("held", ">="), ("spin", "<"), ("force", ">"),
    ]  # fmt: skip
    assert [part.bound for part in parts] == pytest.approx([0.1, 0.002, 0.95, 7.0, 1.0])


@pytest.mark.parametrize(
    ("text", "is_met"),
    [
        ("coasting<0.1", False), ("coasting<=0.1", True), ("penetration<2.1 mm", True), ("penetration<2 mm", False),
        ("score>=8", True), ("score>8", False), ("held>95 %", True), ("force<10 N", False),
    ],
)  # fmt: skip
def test_a_bound_is_met_or_not(text, is_met):
    (requirement,) = parse_requirements(text)
    assert (requirement.failure(evaluation()) is None) == is_met


def test_a_failure_shows_the_measured_value():
    penetration, force = parse_requirements("penetration<1 mm, force<10 N")
    assert penetration.failure(evaluation()) == "not met: penetration<1 mm: found 0.002 m"
    assert force.failure(evaluation()).startswith("not met: force<10 N: it was not measured")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "expected NAME<VALUE"),
        ("coasting", "expected NAME<VALUE"),
        ("coasting=0.1", "expected NAME<VALUE"),
        ("0.1<coasting<0.2", "expected NAME<VALUE"),
        ("coasting<0.1,", "expected NAME<VALUE"),
        ("coastng<0.1", 'nothing is called "coastng"; did you mean "coasting"'),
        ("penetration<2 N", '"N" is not a unit of length'),
        ("penetration<2 %", "is not a quantity"),
        ("coasting<2 mm", "has a unit"),
        ("spin<1 m/s", '"m/s" is not a unit of angular speed'),
        ("score<nan", "is not a quantity"),
    ],
)  # fmt: skip
def test_invalid_requirements_are_refused(text, why):
    with pytest.raises(TgdslError) as error:
        parse_requirements(text)
    assert "--require" in str(error.value) and why in str(error.value)
