"""What `import tgdsl` offers, and how it looks in a console: the same tuples, dictionaries and arrays to code."""

import dataclasses
import json
import os
import pickle
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.console.tables import MAX_ROWS, TaxelTable, text_table, with_units
from tgdsl.module.outputs import Output

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def touch(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    (folder / "scene.xml").write_text("""
<mujoco><worldbody>
  <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
  <body name="side" pos=".1 0 0"><geom name="side" type="box" size=".03 .03 .01"/></body>
  <body name="cube" pos="0 0 .029"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
</worldbody></mujoco>""")
    grid = {"method": "grid", "rows": 5, "columns": 6, "direction": [0, 0, -1], "radius": 0.004}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {
                "model": str(folder / "scene.xml"),
                "layout": {"resolutions": {"o": {"pad": grid, "side": {**grid, "radius": 0.002}}}},
            },
            "objects": {"cube": {"body": "cube"}},
            "sensors": {
                "depth": {"kind": "contact_depth", "links": "*", "feels": ["cube"]},
                "bit": {"kind": "contact", "links": "*", "feels": ["cube"]},
                "skin": {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"]},
            },
        }
    )


IMPORTS = """
import json, sys
import tgdsl
loaded = {}
import tgdsl.commands.cli
loaded["cli"] = [*sys.modules]
tgdsl.load
loaded["load"] = [*sys.modules]
import tgdsl.rl.env, tgdsl.rl.playing.rollout, tgdsl.module.explain
loaded["env"] = [*sys.modules]
print(json.dumps([loaded, tgdsl.testing.KindConformance.__name__, tgdsl.__version__]))
"""


@pytest.fixture(scope="module")
def imported():
    """What a new process has imported, stage by stage, and names that `import tgdsl` hands out."""
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONWARNINGS": "error"}
    ran = subprocess.run([sys.executable, "-c", IMPORTS], env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def test_dir_has_the_public_names_and_no_others():
    assert dir(tgdsl) == sorted({*tgdsl.__all__, "__version__"})
    for name in dir(tgdsl):
        assert getattr(tgdsl, name) is not None
    errors = {name for name in vars(tgdsl.errors) if name.endswith("Error") and name[0].isupper()}
    inside = {"BakeError", "SampleError", "LowerError"}  # these end as mistakes of a document
    assert errors - inside <= set(dir(tgdsl))


def test_testing_and_version_are_reached_by_importing_tgdsl_alone(imported):
    assert imported[1:] == ["KindConformance", version("tgdsl")]


def test_help_waits_for_nothing_heavy(imported):
    """All commands are known without what any of them needs to run; no robot, document or module is looked at."""
    heavy = {"torch", "mujoco", "numpy", "scipy", "pydantic", "ruamel", "matplotlib", "trimesh", "tgdsl.compiler"}
    assert "tgdsl.commands.cli" in imported[0]["cli"]
    assert not heavy & set(imported[0]["cli"])


def test_loading_waits_for_what_only_compiling_needs(imported):
    """SciPy takes 0.3 s; what bakes tables, analyses modes or reads robots is imported where it is used."""
    heavy = {"scipy", "skfem", "trimesh", "mujoco", "ruamel", "matplotlib", "pymeshlab", "sympy", "torch._dynamo"}
    assert "torch" in imported[0]["load"]
    assert not heavy & set(imported[0]["load"])


def test_environments_leave_triton_alone(imported):
    """Its LLVM and that of MuJoCo's software renderer, which `MUJOCO_GL=osmesa` loads, do not go into one process."""
    assert "tgdsl.rl.env" in imported[0]["env"]
    assert "triton" not in imported[0]["env"]


def test_changelog_citation_and_package_name_one_version():
    (released, date), *_ = re.findall(r"^## (\d\S+) \((.+)\)$", (REPOSITORY / "CHANGELOG.md").read_text(), re.M)
    assert f'\nversion = "{released}"\n' in (REPOSITORY / "pyproject.toml").read_text()
    citation = (REPOSITORY / "CITATION.cff").read_text()
    assert f"\nversion: {released}\n" in citation and f"\ndate-released: {date}\n" in citation


def test_the_version_on_the_command_line(here, tmp_path):
    assert here(tmp_path, "--version") == (0, f"tgdsl {version('tgdsl')}\n", "")


def test_the_package_says_that_it_is_typed():
    assert (REPOSITORY / "tgdsl" / "py.typed").is_file()


def test_shapes_in_annotations_are_text():
    """A number is none to jaxtyping, which then checks nothing of that annotation: `Float[Tensor, " 3"]`."""
    unchecked = re.compile(r"\b(?:Bool|Complex|Float|Inexact|Int|Num|Real|Shaped|UInt)\[[\w.]+, *\d")
    files = [*(REPOSITORY / "tgdsl").rglob("*.py"), *(REPOSITORY / "examples").rglob("*.py")]
    assert [str(file) for file in files if unchecked.search(file.read_text(encoding="utf-8"))] == []


# Tables


def test_a_module_prints_in_a_few_lines(touch):
    lines = repr(touch).splitlines()
    assert lines[0] == "TactileModule(60 taxels on 2 links of scene.xml at resolution o, torch.float32, cpu)"
    assert lines[1].split() == ["reading", "kind", "shape", "channels"]
    assert [line.split("  ")[0] for line in lines[3:]] == ["depth", "bit", "skin"]
    assert str(touch) == repr(touch)


def test_outputs_are_a_tuple_of_outputs(touch):
    assert isinstance(touch.outputs, tuple)
    assert touch.outputs == tuple(touch.outputs)
    assert all(isinstance(output, Output) for output in touch.outputs)
    lines = repr(touch.outputs).splitlines()
    assert len(lines) == 2 + len(touch.outputs)
    assert lines[2].split() == ["depth", "contact_depth", "(env,", "60,", "1)", "depth", "[m]"]


def test_inputs_are_a_dataclass_and_print_what_is_wanted(touch):
    inputs = touch.inputs
    assert dataclasses.replace(inputs) == inputs
    assert pickle.loads(pickle.dumps(inputs)) == inputs
    text = repr(inputs)
    for part in (*inputs.fields, *inputs.bodies, "pad – cube", "side – cube", "cube: cube"):
        assert part in text
    assert max(map(len, text.splitlines())) <= 120
    assert "objects" not in text  # there is nothing of the kind


def test_tables_of_taxels_are_arrays(touch):
    table = touch.taxels["depth"]
    assert isinstance(touch.taxels, dict)
    assert isinstance(table, np.ndarray)
    for column in table.dtype.names:
        assert type(table[column]) is np.ndarray
    torch.testing.assert_close(torch.from_numpy(table["pos"].copy()), torch.tensor(table["pos"].tolist(), dtype=torch.float64))
    own = table[table["link"] == "side"]
    assert isinstance(own, TaxelTable)
    assert len(own) == 30
    assert isinstance(table[0], np.void)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(table))["pos"], table["pos"])


def test_a_table_of_taxels_prints_its_first_rows(touch):
    table = touch.taxels["depth"]
    lines = repr(table).splitlines()
    assert lines[0].split() == list(table.dtype.names)
    assert len(lines) == 2 + MAX_ROWS + 1
    assert lines[-1] == f"… and {60 - MAX_ROWS} more"
    assert len(repr(table[:3]).splitlines()) == 2 + 3
    cells = lines[2].split()
    assert cells[:3] == ["0", "pad", "pad"]
    np.testing.assert_allclose([float(cell) for cell in cells[3:6]], table["pos"][0], atol=5e-5)


def test_sensors_on_the_same_taxels_are_listed_once(touch):
    parts = repr(touch.taxels).split("\n\n")
    assert [part.splitlines()[0] for part in parts] == ["depth, bit", "skin"]
    assert [line.split()[:4] for line in parts[0].splitlines()[3:]] == [["pad", "pad", "30", "4"], ["side", "side", "30", "2"]]
    area = float(parts[0].splitlines()[3].split()[4])
    assert area == pytest.approx(1e6 * 0.06**2, rel=1e-3)  # a box's upper side


def test_columns_are_aligned():
    text = text_table(("a", "bb"), [("x", "long"), ("longer", "y")], more=3)
    assert text == "a       bb\n──────  ────\nx       long\nlonger  y\n… and 3 more"


def test_a_unit_stands_once_after_its_channels():
    assert with_units(("x", "y", "p", "on"), ("N", "N", "Pa", "1")) == "x, y [N], p [Pa], on"
