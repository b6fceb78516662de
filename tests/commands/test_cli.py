"""The command line as users run it: output, files and exit codes."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from unscripted_hands import URDF

import tgdsl
from tgdsl.commands.arguments import parsed_overrides
from tgdsl.schema.document import json_schema

REPOSITORY = Path(__file__).parents[2]
SCENE = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .029">
      <joint name="lift" type="slide" axis="0 0 1"/><geom type="box" size=".02 .02 .02" mass=".25"/>
    </body>
  </worldbody>
  <actuator><motor joint="lift"/></actuator>
  <keyframe><key name="rest" ctrl="0"/><key name="squeeze" ctrl="-5"/></keyframe>
</mujoco>
"""
DOCUMENT = """tgdsl: 1
robot:
  model: scene.xml
  layout:
    resolutions:
      low: {pad: {method: grid, rows: 2, columns: 3, direction: [0, 0, -1], radius: 4 mm}}
      high: {pad: {method: grid, rows: 4, columns: 4, direction: [0, 0, -1], radius: 4 mm}}
objects: {cube: {body: cube}}
resolution: low
sensors:
  touch: {kind: kinematic_taxel, links: pad, feels: [cube], outputs: [force], normal_stiffness: 500}
  bit: {kind: contact, links: pad, feels: [cube]}
observations:
  policy: [{type: force, of: touch}, {type: agg_bool, of: bit}]
"""


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """Return a folder with a document and its compiled artefact."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "pad.yaml").write_text(DOCUMENT)
    tgdsl.save(tgdsl.compile(folder / "pad.yaml"), folder / "pad.safetensors")
    return folder


WITHOUT_PROGRESS = """
from tgdsl.commands.cli import main
from tgdsl.console import progress
progress.LINE_PERIOD = 1e6  # no lines of progress on a busy machine
main()
"""


@pytest.fixture
def fails(here):
    """Return a function that runs a wrong command and returns its message."""

    def run(folder: Path, *arguments: str) -> str:
        code, _, message = here(folder, *arguments)
        assert code == 2, message
        return message

    return run


# compile


def test_compile_prints_a_summary(base, tmp_path, here):
    for name in ("scene.xml", "pad.yaml"):
        shutil.copy(base / name, tmp_path)
    code, printed, error = here(tmp_path, "compile", "pad.yaml")
    assert (code, error) == (0, "")
    lines = printed.splitlines()
    assert lines[:2] == ["6 taxels on 1 links at resolution low", "sensors: touch (kinematic_taxel, 6), bit (contact, 6)"]
    assert lines[2].startswith(f"pad.safetensors: {(tmp_path / 'pad.safetensors').stat().st_size} bytes in ")
    assert [output.name for output in tgdsl.load(tmp_path / "pad.safetensors").outputs] == ["touch", "bit"]


def test_compile_with_overrides_into_a_new_folder(base, tmp_path, here):
    out = tmp_path / "new" / "folder" / "pad.safetensors"
    arguments = ("--set", "resolution=high", "--set", "sensors.touch.normal_stiffness=400", "-o", str(out))
    code, output, error = here(base, "compile", "pad.yaml", *arguments)
    assert code == 0, error
    assert output.startswith("16 taxels on 1 links at resolution high\n")
    plan = tgdsl.load(out).plan
    assert 400.0 in [
        float(value) for name, value in plan.arrays.items() if name.startswith("sensors/touch/") and value.size == 1
    ]


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        (
            "resolution=mid",
            '--set resolution=mid: resolution: unknown resolution "mid"; known resolutions: high, low\n1 mistake\n',
        ),
        ("resolution", 'tgdsl: --set resolution: expected KEY=VALUE, such as "resolution=high"\n'),
        ("sensors.bit.threshold=3 kg", '"kg" is not a unit of length, expected one of m, cm, mm, um, µm\n1 mistake\n'),
        ("sensors.bit.treshold=3 mm", 'unknown key "treshold"; did you mean "threshold"?\n1 mistake\n'),
        ("tgdsl.x=3", "--set tgdsl.x=3: tgdsl.x: does not lead to a key of a mapping\n1 mistake\n"),
    ],
)
def test_wrong_overrides_are_refused(base, fails, argument, message):
    assert fails(base, "compile", "pad.yaml", "--set", argument).endswith(message)


def test_resolution_is_an_override_not_an_option(base, fails):
    message = "tgdsl: --resolution{}: there is no such option; write --set resolution=high\n"
    assert fails(base, "compile", "pad.yaml", "--resolution", "high") == message.format("")
    assert fails(base, "compile", "pad.yaml", "--resolution=3") == message.format("=3")


def test_unreadable_documents_are_reported(base, tmp_path, fails):
    assert fails(base, "compile", "none.yaml") == "none.yaml: cannot read this file: No such file or directory\n1 mistake\n"
    (tmp_path / "scene.xml").write_text("<mujoco><worldbody><geo/></worldbody></mujoco>")
    (tmp_path / "pad.yaml").write_text(DOCUMENT)
    message = fails(tmp_path, "compile", "pad.yaml")
    assert message.startswith("tgdsl: scene.xml: XML Error: ")
    assert "geo" in message
    assert not list(tmp_path.glob("*.safetensors"))


def test_unwritable_files_are_reported(base, tmp_path, fails):
    (tmp_path / "file").write_text("")
    assert fails(base, "compile", "pad.yaml", "-o", str(tmp_path / "file" / "x.safetensors")).startswith("tgdsl: ")
    assert (
        fails(base, "schema", "-o", str(tmp_path / "none" / "s.json"))
        == f"tgdsl: {tmp_path}/none/s.json: No such file or directory\n"
    )


def test_unknown_commands_list_the_known_ones(base, fails):
    for arguments in (("compil",), ()):
        assert "compile, explain, schema, run" in fails(base, *arguments)


# explain


def test_explain_of_document_and_artefact(base, here):
    explained = tgdsl.load(base / "pad.safetensors").explain() + "\n"
    assert here(base, "explain", "pad.safetensors") == (0, explained, "")
    assert here(base, "explain", "pad.yaml") == (0, explained, "")
    output = here(base, "explain", "pad.yaml", "--set", "resolution=high")[1]
    assert "asks for depth of 16 probes (query 0)" in output and " in cube (box), " in output


def test_an_artefact_cannot_be_overridden(base, fails):
    message = "tgdsl: an artefact cannot be overridden; compile the document with --set instead\n"
    assert fails(base, "explain", "pad.safetensors", "--set", "resolution=high") == message


def test_a_damaged_artefact_is_reported(base, tmp_path, fails):
    (tmp_path / "x.safetensors").write_bytes((base / "pad.safetensors").read_bytes()[:-5])
    assert fails(tmp_path, "explain", "x.safetensors").startswith("tgdsl: x.safetensors: cannot read this artefact: ")


# schema


def test_schema_in_the_repository_is_current():
    committed = (REPOSITORY / "tgdsl.schema.json").read_text(encoding="utf-8")
    assert json.loads(committed) == json_schema(), "run `tgdsl schema`"
    assert committed == json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def test_schema_command(tmp_path, here):
    assert here(tmp_path, "schema") == (0, "tgdsl.schema.json\n", "")
    assert json.loads((tmp_path / "tgdsl.schema.json").read_text(encoding="utf-8")) == json_schema()


# run


@pytest.mark.slow
def test_run_prints_and_writes_readings(base, tmp_path):
    """A new process shows every warning."""
    environment = {**os.environ, "PYTHONWARNINGS": "default", "PYTHONPATH": str(REPOSITORY), "NO_COLOR": "1", "COLUMNS": "200"}
    command = [sys.executable, "-c", WITHOUT_PROGRESS, "run", "pad.yaml", "--seconds", "0.1", "--out", str(tmp_path / "out")]
    process = subprocess.run(command, cwd=base, env=environment, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stderr) == (0, "")
    lines = process.stdout.splitlines()
    assert lines[0] == "t = 0.30 s"
    assert lines[1].split() == ["link", "touch", "[N]", "bit", "[taxels]"]
    assert lines[3].split()[0] == "pad"
    assert lines[3].split()[2] == "6/6"
    out = tmp_path / "out"
    assert lines[4:] == [f"readings: {out}/readings.npz", f"picture:  {out}/picture.png", f"overview: {out}/overview.png"]
    with np.load(out / "readings.npz") as archive:
        np.testing.assert_allclose(archive["time"], 0.01 * np.arange(1, 31))
        np.testing.assert_allclose(archive["ctrl"][:, 0], [0] * 10 + list(np.linspace(0, -5, 10)) + [-5] * 10)
        assert archive["touch"].shape == (30, 1, 6, 3)
        assert archive["bit"].all()
        force = np.linalg.norm(archive["touch"][-1, 0].sum(axis=0))
    assert float(lines[3].split()[1]) == pytest.approx(force, abs=6e-4)
    for name in ("picture.png", "overview.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


@pytest.mark.usefixtures("no_pictures")
def test_run_recorded_controls(base, tmp_path, here):
    controls = np.zeros((4, 3, 1))
    controls[:, 2] = 50.0
    np.savez(tmp_path / "c.npz", ctrl=controls)
    arguments = ("--controls", str(tmp_path / "c.npz"), "--num-envs", "3", "--substeps", "10", "--out", str(tmp_path))
    code, _, error = here(base, "run", "pad.yaml", *arguments)
    assert code == 0, error
    with np.load(tmp_path / "readings.npz") as archive:
        assert archive["bit"].shape == (4, 3, 6, 1)
        assert archive["bit"][-1, 0].all()
        assert not archive["bit"][-1, 2].any()
        np.testing.assert_allclose(archive["time"], [0.02, 0.04, 0.06, 0.08])


def test_wrong_runs_are_refused(base, tmp_path, fails):
    np.savez(tmp_path / "two.npz", ctrl=np.zeros((3, 2)))
    cases = {
        ("--keyframes", "rest", "sqeeze"): 'tgdsl: the scene has no keyframe "sqeeze"; did you mean "squeeze"?\n',
        ("--keyframes",): "tgdsl: 0 keyframes held for 1 s: expected at least one, and more than 0 s\n",
        ("--num-envs", "0"): "tgdsl: num_envs is 0, expected a whole number of at least 1\n",
        ("--controls", "none.npz"): "tgdsl: none.npz: expected an .npz file with an array `ctrl`: ",
        ("--controls", str(tmp_path / "two.npz")): "tgdsl: control has shape (2,), expected (1, 1) or (1,)\n",
    }
    for arguments, message in cases.items():
        assert fails(base, "run", "pad.safetensors", *arguments, "--out", str(tmp_path / "out")).startswith(message)
    assert not (tmp_path / "out" / "readings.npz").exists()


@pytest.mark.usefixtures("no_pictures")
def test_run_closes_a_hand_without_keyframes(here, tmp_path):
    """Three commands lead from a robot file to touch; the artefact does not need the file."""
    (tmp_path / "my hand.urdf").write_text(URDF)
    (tmp_path / "hand.yaml").write_text(
        "tgdsl: 1\nrobot: {model: my hand.urdf, layout: layout.yaml}\nresolution: low\n"
        "objects: {ball: {geom: {type: sphere, size: [12 mm]}}}\n"
        "sensors: {touch: {kind: link_contact, links: hand, feels: [ball]}}\n"
    )
    assert here(tmp_path, "layout", "new", "my hand.urdf")[0] == 0
    assert here(tmp_path, "compile", "hand.yaml")[0] == 0
    (tmp_path / "my hand.urdf").unlink()
    code, out, output = here(tmp_path, "run", "hand.safetensors", "--seconds", "0.8", "--num-envs", "2", "--out", "closed")
    assert code == 0, output
    assert out.startswith(
        "no keyframes rest and squeeze: the hand closes on `ball`, put between the fingers, without gravity; 3 of 3 joints\n"
    )
    with np.load(tmp_path / "closed" / "readings.npz") as archive:
        forces = np.linalg.norm(archive["touch"][..., 1:], axis=-1)
        assert archive["ctrl"].shape == (len(forces), 3) and np.isfinite(forces).all()
        assert not forces[0].any() and ((forces[-1] > 0).sum(axis=-1) >= 2).all()
    code, _, output = here(tmp_path, "run", "hand.safetensors", "--controls", "closed/readings.npz", "--out", "again")
    assert code == 2 and "closed/readings.npz: its controls are of servos that `tgdsl run` added to close the hand" in output


@pytest.mark.usefixtures("no_pictures")
def test_run_holds_a_scene_without_keyframes(here, tmp_path):
    start, end = SCENE.index("<keyframe>"), SCENE.index("</mujoco>")
    (tmp_path / "scene.xml").write_text(SCENE[:start] + SCENE[end:])
    (tmp_path / "pad.yaml").write_text(DOCUMENT)
    code, out, _ = here(tmp_path, "run", "pad.yaml", "--seconds", "0.1", "--out", "held")
    reason = "no keyframes rest and squeeze, and the hand does not close (it has no hinge and no slide)"
    assert code == 0 and f"{reason}: its initial state is held for 0.1 s\n" in out
    with np.load(tmp_path / "held" / "readings.npz") as archive:
        assert archive["touch"].shape[0] == 10


@pytest.mark.parametrize(
    ("arguments", "format_"),
    [((), "pt2"), (("-o", "hand.onnx"), "onnx"), (("--to", "aoti"), "aoti"), (("-o", "hand.aoti.pt2"), "aoti")],
)
def test_the_suffix_sets_the_format_of_an_export(base, here, monkeypatch, arguments, format_):
    class Exported(Exception):
        pass

    def export(self, path, to, **_):
        raise Exported(to)

    monkeypatch.setattr(tgdsl.TactileModule, "export", export)
    with pytest.raises(Exported, match=f"^{format_}$"):
        here(base, "export", "pad.yaml", *arguments)


def test_a_repeated_override_has_its_last_place():
    """Else a mapping that is given in between would replace it."""
    pairs = ("skin.shear=1", "skin={shear: 2}", "skin.shear=3")
    assert list(parsed_overrides(pairs).items()) == [("skin", "{shear: 2}"), ("skin.shear", "3")]
