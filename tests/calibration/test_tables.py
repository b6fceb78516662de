"""Recordings in CSV files: columns, units, invalid numbers, and located mistakes."""

import numpy as np
import pytest
from recorded_presses import LAG, document, recording

import tgdsl
from tgdsl.calibration.recordings import load_recording
from tgdsl.calibration.tables import read_tables
from tgdsl.errors import SpecError

TABLES = """\
tgdsl: 1
states:
  file: states.csv
  time: t
  unit: mm
  position: {ball: [x, y, z], pad: [px, py, pz]}
targets:
  touch:
    file: touch.csv
    time: 0
    unit: N
    channels: {force_z: [1, 2, 3]}
    scale: -0.001
    invalid: [-1]
    clock_width: 200 ms
    floor: 0.002
"""


@pytest.fixture
def folder(tmp_path):
    """Write the recording to two files: positions in mm, forces in -mN, and two invalid numbers."""
    arrays = recording(document(tmp_path))
    ball, pad = (1e3 * arrays["body_pos"][:, i] for i in (0, 1))
    rows = [",".join(f"{value:.9g}" for value in line) for line in np.column_stack([arrays["time"], ball, pad])]
    (tmp_path / "states.csv").write_text("t,x,y,z,px,py,pz\n" + "\n".join(rows) + "\n")
    force = -1e3 * arrays["target:touch"][:, :, 2]
    force[3, 1], force[5, 0] = -1, np.nan
    lines = np.column_stack([arrays["clock:touch"], force])
    text = "\n".join(",".join("" if np.isnan(v) else f"{v:.9g}" for v in line) for line in lines)
    (tmp_path / "touch.csv").write_text(text)
    (tmp_path / "press.yaml").write_text(TABLES)
    return tmp_path


def test_a_recording_in_tables_reads_the_same(folder):
    path = folder / "touch.yaml"
    touch = tgdsl.compile(path, dtype="float64")
    outputs = {output.name: output for output in touch.outputs}
    recorded, arrays = load_recording(folder / "press.yaml", touch.inputs, outputs), recording(path)
    assert recorded.fields["body_pos"] == pytest.approx(arrays["body_pos"], abs=1e-10)
    (target,) = recorded.targets
    weight = np.ones((60, 3))
    weight[3, 1] = weight[5, 0] = 0
    assert np.array_equal(target.weight[:, :, 0], weight)
    assert target.value[:, :, 0] == pytest.approx(weight * arrays["target:touch"][:, :, 2], abs=1e-9)
    assert target.clock_width == 0.2 and target.floor == 0.002 and target.channels == (2,)
    fit = tgdsl.calibrate(path, folder / "press.yaml", ["touch.normal_stiffness", "touch.depth_exponent"], starts=2)
    assert fit.parameters["touch.depth_exponent"].value == pytest.approx(1.3, abs=0.03)
    assert fit.nuisances["press.yaml: clock of touch"] == pytest.approx(-LAG, abs=5e-3)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("press.yaml", "time: t", "time: tt", r'states\.csv:1:1: there is no column "tt"; did you mean "t"'),
        ("press.yaml", "time: 0", "time: clock", r'touch\.csv:1:1: there is no column "clock"; number them from 0 to 3'),
        ("press.yaml", "[1, 2, 3]", "[1, 2, 4]", r"touch\.csv:1:1: there is no column 4; there are 4, from 0"),
        (
            "press.yaml",
            "[1, 2, 3]}",
            "[1, 2], force_x: [1]}",
            r"press\.yaml:12:\d+: targets\.touch\.channels: expected as many columns each, found force_z: 2, force_x: 1",
        ),
        (
            "press.yaml",
            "targets:",
            "  orientation: {bal: [x, x, x, x]}\ntargets:",
            r'press\.yaml:7:\d+: states\.orientation\.bal: "bal" has an orientation, but no position',
        ),
        ("press.yaml", "unit: mm", "unit: furlong", r"press\.yaml:5:9: states\.unit"),
        ("press.yaml", "file: touch.csv", "file: tuch.csv", r"tuch\.csv: cannot be read as CSV"),
        ("states.csv", "0,0,0,34", "0,oops,0,34", r'states\.csv:2:2: column x: found "oops", expected a number'),
        ("states.csv", "0,0,0,34", "0,0,0,", r"states\.csv:2:4: column z: this cell is empty"),
        ("states.csv", "0,0,0,34", "0,0,0,34,0", r"states\.csv:2:8: found \d columns, expected 7; write decimals with a point"),
        ("states.csv", "t,x,y,z,", "t,x,x,z,", r'states\.csv:1:1: column "x" stands twice; number them from 0 to 6'),
        ("states.csv", "t,x,y", '"t,x,y', r"states\.csv: cannot be read as CSV: unexpected end of data"),
        ("press.yaml", "time: 0", "time: true", r"press\.yaml:10:11: targets\.touch\.time: found True"),
        ("press.yaml", "[px, py, pz]", "[px, py, -1]", r"press\.yaml:6:45: states\.position\.pad\[2\]: found -1"),
        ("press.yaml", "[px, py, pz]", "[px, py, 1 N]", r'states\.csv:1:1: there is no column "1 N"'),
        (
            "press.yaml",
            "{ball: [x, y, z], pad: [px, py, pz]}",
            "{}",
            r"press\.yaml:6:13: states\.position: found a mapping of 0",
        ),
        ("press.yaml", "[1, 2, 3]", "[]", r"press\.yaml:12:25: targets\.touch\.channels\.force_z: found a list of 0"),
        ("press.yaml", "0.002", "-1", r"press\.yaml:16:12: targets\.touch\.floor: -1 is out of range"),
        (
            "press.yaml",
            "targets:",
            "  orientation: {bal: [x, x, x, x]}\ntargets:",
            r'press\.yaml:7:22: states\.orientation\.bal: "bal" has an',
        ),
    ],
)
def test_mistakes_are_located_by_line_and_column(folder, file, old, new, message):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(SpecError, match=message):
        read_tables(folder / "press.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "there is no line of numbers"),
        ("t,x,y,z,px,py,pz\n", "there is no line of numbers"),
        ("t;x;y;z;px;py;pz\n0;0;0;34;0;0;0\n", 'found one column, "t;x;y;z;px;py;pz"; expected commas between columns'),
        ("0 0 0 34\n", 'found one column, "0 0 0 34"; expected commas between columns'),
    ],
)
def test_a_file_without_a_table_gives_one_message(folder, text, message):
    (folder / "states.csv").write_text(text)
    with pytest.raises(SpecError) as error:
        read_tables(folder / "press.yaml")
    assert str(error.value) == f"{folder / 'states.csv'}:1:1: {message}"


def test_a_position_may_be_fixed(folder):
    text = (folder / "press.yaml").read_text()
    (folder / "press.yaml").write_text(text.replace("[px, py, pz]", "[0 m, -2 mm, px]"))
    assert read_tables(folder / "press.yaml")["body_pos"][:, 1].tolist() == [[0.0, -0.002, 0.0]] * 1200


def test_one_column_is_the_sum_of_all_rows(folder):
    text = TABLES.replace("channels: {force_z: [1, 2, 3]}", "channels: {force_z: 1}\n    rows: sum")
    (folder / "press.yaml").write_text(text)
    touch = tgdsl.compile(folder / "touch.yaml", dtype="float64")
    (target,) = load_recording(folder / "press.yaml", touch.inputs, {output.name: output for output in touch.outputs}).targets
    assert target.is_sum and target.value.shape == (60, 1, 1)
