"""Calibration files: counts converted by hand, and errors with their line and column."""

from pathlib import Path

import numpy as np
import pytest

from tgdsl.errors import SpecError
from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.driver import Tare

GOOD = """\
tgdsl: 1
hand: right hand, no. 7
units: N
fingers:
  thumb: {scale: [0.1, 0.2, 0.05], signs: [-1, -1, 1], tare: [3, -2, 10], bias: [0, 0, 0.5]}
  index: {scale: [0.1, 0.1, 0.1], rotation: [[0, 0, 1], [0, 1, 0], [1, 0, 0]]}
  middle: {scale: [0.1, 0.1, 0.1]}
  ring: {scale: [0.1, 0.1, 0.1]}
  pinky: {scale: [1e-1, 0.1, 0.1], tare: [0.5, 0, 0]}
"""


def read(tmp_path: Path, text: str) -> Calibration:
    path = tmp_path / "hand.yaml"
    path.write_text(text, encoding="utf-8")
    return load_calibration(path)


def problems_of(tmp_path: Path, text: str) -> list[str]:
    with pytest.raises(SpecError) as caught:
        read(tmp_path, text)
    return [str(problem).removeprefix(f"{tmp_path}/") for problem in caught.value.problems]


def test_counts_become_forces(tmp_path):
    calibration = read(tmp_path, GOOD)
    counts = np.array([[13, 8, 110], [1, 2, 3], [127, -128, 255], [0, 0, 0], [1, 0, 0]], dtype=np.int16)
    expected = [
        [-0.1 * 10, -0.2 * 10, 0.05 * 100 + 0.5],
        [0.3, 0.2, 0.1],
        [12.7, -12.8, 25.5],
        [0, 0, 0],
        [0.05, 0, 0],
    ]
    assert calibration.units == "N"
    assert calibration.apply(counts) == pytest.approx(np.array(expected), abs=1e-12)
    many = np.broadcast_to(counts, (4, 2, 5, 3))
    assert calibration.apply(many) == pytest.approx(np.broadcast_to(expected, (4, 2, 5, 3)), abs=1e-12)


def test_counts_of_inverts_apply(tmp_path):
    calibration = read(tmp_path, GOOD)
    counts = np.random.default_rng(0).uniform(-100, 100, (7, 5, 3))
    assert calibration.counts_of(calibration.apply(counts)) == pytest.approx(counts, abs=1e-9)


def test_without_a_file_counts_stay_counts():
    counts = np.arange(15, dtype=np.int16).reshape(5, 3)
    assert (Calibration.none().apply(counts) == counts).all()
    assert Calibration.none().units == "counts"


def test_a_tare_reads_zero():
    mean = np.arange(15, dtype=np.float64).reshape(5, 3)
    tared = Calibration.none().with_tare(Tare(mean, np.zeros((5, 3)), 20))
    assert (tared.apply(mean) == 0).all()


def test_a_file_round_trips(tmp_path):
    calibration = read(tmp_path, GOOD)
    reloaded = read(tmp_path, calibration.text())
    for name in ("scale", "rotation", "bias", "tare"):
        assert (getattr(reloaded, name) == getattr(calibration, name)).all()
    assert (reloaded.units, reloaded.hand) == ("N", "right hand, no. 7")


@pytest.mark.parametrize(
    ("old", "new", "messages"),
    [
        ("units: N", "units: lb", ["hand.yaml:3:8: units: found \"lb\", expected 'counts' or 'N'"]),
        ("tgdsl: 1\n", "", ['hand.yaml:1:1: missing key "tgdsl"']),
        ("signs: [-1, -1, 1]", "signs: [-1, -1, 2]", ["hand.yaml:5:52: fingers.thumb.signs[2]: found 2, expected -1 or 1"]),
        (
            "signs: [-1, -1, 1]",
            "sings: [-1, -1, 1]",
            ['hand.yaml:5:36: fingers.thumb.sings: unknown key "sings"; did you mean "signs"?'],
        ),
        (
            "[[0, 0, 1], [0, 1, 0], [1, 0, 0]]",
            "[[0, 0, 1], [0, 1, 0], [1, 1, 0]]",
            ["hand.yaml:6:10: fingers.index: rotation is off by 1, expected rows of length 1 at right angles"],
        ),
        (
            "tare: [3, -2, 10]",
            "rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
            ["hand.yaml:5:10: fingers.thumb: found `signs` and `rotation`, expected one of them"],
        ),
        ("  pinky: {scale: [1e-1, 0.1, 0.1], tare: [0.5, 0, 0]}\n", "", ['hand.yaml:4:1: fingers: missing key "pinky"']),
        (
            "scale: [1e-1, 0.1, 0.1], ",
            "",
            ["hand.yaml:1:1: the unit is N, but pinky without `scale`; expected N per count"],
        ),
        (
            "scale: [1e-1, 0.1, 0.1]",
            "scale: [0, 0.1, x]",
            [
                "hand.yaml:9:19: fingers.pinky.scale[0]: 0 is out of range, expected more than 0",
                'hand.yaml:9:27: fingers.pinky.scale[2]: "x" is not a quantity, expected a number',
            ],
        ),
        ("units: N\n", "units: N\nunits: N\n", ["hand.yaml:4:1: units: this key stands twice, first in line 3"]),
    ],
)
def test_mistakes_have_their_line_and_column(tmp_path, old, new, messages):
    assert old in GOOD
    assert problems_of(tmp_path, GOOD.replace(old, new)) == messages


def test_the_contact_threshold_is_optional_and_positive(tmp_path):
    assert read(tmp_path, GOOD).contact_threshold is None
    calibration = read(tmp_path, GOOD.replace("units: N\n", "units: N\ncontact_threshold: 0.35\n"))
    assert calibration.contact_threshold == 0.35
    assert read(tmp_path, calibration.text()).contact_threshold == 0.35
    assert problems_of(tmp_path, GOOD.replace("units: N\n", "units: N\ncontact_threshold: 0\n")) == [
        "hand.yaml:4:20: contact_threshold: 0 is out of range, expected more than 0"
    ]


def test_unreadable_files_are_refused(tmp_path):
    assert problems_of(tmp_path, "") == ["hand.yaml:1:1: the document is empty"]
    assert problems_of(tmp_path, "- 1\n") == ["hand.yaml:1:1: found a list of 1, expected a mapping"]
    with pytest.raises(SpecError, match="cannot read this file: No such file"):
        load_calibration(tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_bytes(b"\xff")
    with pytest.raises(SpecError, match="not UTF-8 text: byte 0"):
        load_calibration(tmp_path / "bad.yaml")
