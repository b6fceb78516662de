"""The published documents: teachers and students can learn each on a CPU."""

import csv
import json
from pathlib import Path

import pytest

from tgdsl.commands.distill import Distill
from tgdsl.commands.train import Train
from tgdsl.schema.yaml import parse

FOLDER = Path(__file__).parents[2] / "examples" / "tasks" / "published"
pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]
FEW = {"in_palm_rotate": (), "in_hand_repose": (), "screwdriver": ("grasps.num=8",)}


def test_each_document_is_tested():
    assert {file.stem for file in FOLDER.glob("*.yaml")} == FEW.keys()


def test_sensors_of_tasks_have_the_papers_radius_and_no_hysteresis():
    documents = {file.name: parse(file.read_text(), file.name).value for file in FOLDER.parent.glob("*.yaml")}
    sensors = [sensor for document in documents.values() for sensor in document.get("sensors", {}).values()]
    near = [sensor["radius"] for sensor in sensors if sensor["kind"] == "proximity"]
    contacts = [sensor for sensor in sensors if sensor["kind"] == "contact"]
    assert len(near) >= 6 and set(near) == {"10 mm"}
    assert contacts and not any("release_threshold" in sensor for sensor in contacts)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEW)
def test_a_teacher_and_its_students_learn_a_few_iterations(name, tmp_path):
    document, out = FOLDER / f"{name}.yaml", tmp_path / "teacher"
    overrides = (*FEW[name], "train.steps=4", "distill.steps=4")
    Train(document, device="cpu", envs=2, iterations=1, episodes=0, out=out, set=overrides).run()
    card = json.loads((out / "policy.json").read_text())
    goal = {"in_palm_rotate": 1, "in_hand_repose": 13}
    assert card["groups"].get("goal") == goal.get(name) and card["groups"]["priv_touch"] == 15
    students = tmp_path / "students"
    options = {"device": "cpu", "types": "none,agg_bool,force", "seeds": 1, "envs": 48, "iterations": 2, "episodes": 0}
    Distill(document, teacher=out / "policy.pt", out=students, set=overrides, **options).run()
    with (students / "med" / "curve.csv").open(newline="") as opened:
        rows = list(csv.DictReader(opened))
    losses = [float(value) for name, value in rows[-1].items() if name.startswith("Loss/") and name.endswith("s0")]
    assert len(rows) == 2 and len(losses) == 3 and min(losses) > 0
    spec = json.loads((students / "med" / "run.json").read_text())["starts"][-1]["spec"]
    assert spec["distill"]["normalise"] and (spec["randomise"]["push"]["x"] == [0, 0]) == (name == "screwdriver")
