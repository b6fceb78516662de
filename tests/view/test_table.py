"""The tables' numbers against sums by hand."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.runtime.xhand1.driver import Reading
from tgdsl.runtime.xhand1.log.log import Fault
from tgdsl.runtime.xhand1.wire.protocol import STATE_SIZE, decode_state
from tgdsl.view.hand_table import HandView
from tgdsl.view.table import table

SCENE = """
<mujoco>
  <worldbody>
    <body name="palm"><geom type="box" size=".03 .03 .01"/></body>
    <body name="tip" pos="0 0 1"><geom size=".01"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.xml"
    path.write_text(SCENE)

    def points(num: int) -> dict:
        return {"method": "points", "points": [{"pos": [i, 0, 0], "normal": [0, 0, 1]} for i in range(num)], "radius": 0.01}

    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(path), "layout": {"resolutions": {"only": {"palm": points(3), "tip": points(2)}}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {
                "touch": {"kind": "kinematic_taxel", "links": "*", "feels": ["cube"], "outputs": ["force", "torque"]},
                "depth": {"kind": "contact_depth", "links": "palm", "feels": ["cube"], "readout": "both"},
                "bit": {"kind": "contact", "links": "tip", "feels": ["cube"]},
                "twist": {"kind": "kinematic_taxel", "links": "tip", "feels": ["cube"], "outputs": ["torque"]},
                "net": {"kind": "link_contact", "links": "palm", "feels": ["cube"]},
            },
        }
    )


def readings() -> dict[str, torch.Tensor]:
    force = torch.tensor([[3.0, 0, 1], [0, 4, 2], [0, 0, 9], [-6, 0, 0], [0, 8, 0]])
    reading = torch.cat([force, torch.full((5, 3), 100.0)], dim=1)
    depth = torch.tensor([[1e-3], [2.5e-3], [0.0]])
    bit, torque = torch.tensor([[1.0], [0.0]]), torch.tensor([[-0.3, 0, 0.4], [0.1, 0, 0]])
    first = {"touch": reading, "depth": depth, "depth/clean": 2 * depth, "bit": bit, "twist": torque}
    first["net"] = torch.tensor([[1.0, 0, 3, 4]])
    return {name: torch.stack([0 * value, value]).requires_grad_() for name, value in first.items()}


def test_numbers_match_sums_by_hand(touch):
    # palm: |(3, 4, 12)| = 13; largest depth 2.5 mm. tip: |(-6, 8, 0)| = 10; one of two taxels; largest |torque| 0.5. net: |(0, 3, 4)| = 5, beside the contact bit
    assert table(touch, readings(), env=1) == [
        "link  touch [N]  depth [m]  depth/clean [m]  bit [taxels]  twist [N·m]  net [N]",
        "────  ─────────  ─────────  ───────────────  ────────────  ───────────  ───────",
        "palm     13.000   2.50e-03         5.00e-03             –            –    5.000",
        "tip      10.000          –                –           1/2     5.00e-01        –",
    ]


def test_the_first_environment_is_the_default(touch):
    assert table(touch, readings()) == table(touch, readings(), env=0)
    assert table(touch, readings())[2].split() == ["palm", "0.000", "0", "0", "–", "–", "0.000"]


def test_rounding_is_printed_as_zero(touch):
    """Up to 1 µm and 1 µN·m, float32's rounding of centimetres and newtons."""
    small = {"depth": torch.full((1, 3, 1), 0.9e-6), "depth/clean": torch.full((1, 3, 1), 1.1e-6)}
    rest = {name: value[:1] for name, value in readings().items() if name not in small}
    assert table(touch, rest | small)[2].split() == ["palm", "0.000", "0", "1.10e-06", "–", "–", "0.000"]


# A hand ------------------------------------------------------------------------------------------------------------------------


def hand_lines(capsys, *events: Reading | Fault, now: float | None = None) -> list[str]:
    """Return what a view prints at the end."""
    view = HandView(None, "a hand")
    for event in events:
        view.show(event, now)
    view.end()
    return capsys.readouterr().out.splitlines()


def reading_at(now: float, **state: np.ndarray) -> Reading:
    return Reading(7, now - 0.008, now, replace(decode_state(bytes(STATE_SIZE)), **state))


def test_a_hands_table_has_the_age_and_the_rate_of_its_readings(capsys):
    readings = [reading_at(now) for now in (0.0, 1.9, 2.0, 2.1, 2.2)]  # the last second has four of them, 0.1 s apart
    title, first, trouble, *_ = hand_lines(capsys, *readings, now=2.45)
    assert (title, first, trouble) == ("a hand", "reading 7   age 258 ms   10/s   0 failures", "")
    fault = Fault(2.3, "HandTimeoutError", "no reply")
    assert hand_lines(capsys, *readings, fault, now=2.45)[1:3] == [
        "reading 7   age 258 ms   10/s   1 failures",
        "NO NEW READING: HandTimeoutError: no reply",
    ]
    assert hand_lines(capsys, fault) == ["a hand", "not one reading came"]


def test_a_readings_age_counts_until_now(capsys):
    (age,) = re.findall(r"age (\d+) ms", hand_lines(capsys, reading_at(time.monotonic() - 3.0))[1])
    assert 3008 <= int(age) < 8000


def test_a_hands_table_has_forces_with_bars_and_joints_with_errors(capsys):
    force, error = np.zeros((5, 3), np.int16), np.zeros((12, 3), np.uint16)
    taxels = np.zeros((5, 120, 3), np.int16)
    force[1], force[3], error[2, 1], taxels[3, 7] = (3, 4, 12), (0, 0, 300), 0x21, (0, -130, 0)
    parts = {"joint_temperature": np.full(12, 0x0123), "current": np.arange(12), "taxel_force": taxels}
    position = np.linspace(0, 1.1, 12).astype(np.float32)
    parts |= {"total_force": force, "joint_error": error, "position": position, "total_temperature": np.arange(31, 36)}
    lines = hand_lines(capsys, reading_at(0.0, **parts), now=0.0)
    rows = [line.split() for line in lines]
    index = rows[5]
    assert index[:6] == ["index", "3.00", "4.00", "12.00", "13.00", "32"]
    eighths = 8 * index[6].count("█") + " ▏▎▍▌▋▊▉".find(index[6][-1])
    assert eighths == round(8 * 32 * 13 / 255)
    assert lines[7].endswith(32 * "█" + " SATURATED, 1 taxels saturated")  # 300 is beyond a full bar
    assert not any("saturated" in line.lower() for line in lines[4:7])
    joints = rows[-12:]
    np.testing.assert_allclose([float(row[-4]) for row in joints if row[-1] == "–"], np.delete(position, 2), atol=5e-4)
    assert [row[-3:-1] for row in joints if row[-1] == "–"] == [[str(i), "35"] for i in range(12) if i != 2]  # 0x23 °C
    assert joints[2][-3:] == ["0x0000", "0x0021", "0x0000"]
