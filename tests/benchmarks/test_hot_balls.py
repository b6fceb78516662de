"""`benchmarks/hot_balls.py`: documents of each setting, and the table of evaluations."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import hot_balls

from tgdsl.fields.materials import MATERIALS
from tgdsl.rl.load import load_task
from tgdsl.schema.load import load


def test_documents_differ_in_the_material_of_fingers(tmp_path):
    """The documents work in any folder, because they name the scene by its path."""
    files = hot_balls.documents(tmp_path / "documents")
    assert [file.stem for file in files] == [setting.name for setting in hot_balls.SETTINGS]
    plain = load(hot_balls.TASKS / "bin.yaml").spec.sensors
    for file, setting in zip(files, hot_balls.SETTINGS, strict=True):
        task = load_task(file)
        assert task.spec.train.actor == ("proprio", "tactile_sensors") and task.spec.touch == "temperature"
        sensors = load(file.with_name(task.spec.document)).spec.sensors
        assert {name: sensor for name, sensor in sensors.items() if name != "heat"} == {
            name: sensor for name, sensor in plain.items() if name != "heat"
        }
        heat, material = sensors["heat"], sensors["heat"].material_of("right_hand_mid_link2")
        assert (material.conductivity, material.emissivity) == (setting.conductivity, setting.emissivity)
        is_physics, solid = setting.model == "physics", MATERIALS[hot_balls.LIKE[setting.conductivity]]
        assert material.density == pytest.approx(solid.density * (0.1 if is_physics else 1.0))
        assert heat.model == ("physical" if is_physics else "paper") and heat.source.flux == 500.0
        assert heat.contact_area == pytest.approx(1e-4 if is_physics else 3.1416e-3)
        assert heat.convection == (5.0 if is_physics else None)


def test_the_table_has_evaluations_and_the_papers_verdicts(tmp_path, capsys):
    def evaluation(name, score, task="hot_ball"):
        content = {"task": task, "score": score, "score_interval": [score - 0.1, score + 0.1], "episodes": 1000}
        (tmp_path / f"{name}.json").write_text(json.dumps(content))

    evaluation("physics_150_0.5", 3.0)
    evaluation("paper_10_0.5", 11.25)
    hot_balls.main(["table", str(tmp_path)])
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| physics, thin walls | 150 | 0.5 | 3.00 | 2.90 to 3.10 | 1000 | ✓ |",
        "| the paper's formula | 10 | 0.5 | 11.25 | 11.15 to 11.35 | 1000 | – |",
    ]
    one = {"task": "hot_ball", "score": 2.0, "score_interval": [None, None], "episodes": 1}
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "physics_10_0.5.json").write_text(json.dumps(one))
    assert hot_balls.table(tmp_path / "one").endswith("| 10 | 0.5 | 2.00 | – | 1 | – |")
    evaluation("paper_1_0.5", 1.0, task="grip_force")
    for folder, message in (
        (tmp_path, 'an evaluation in "grip_force", expected one'),
        (tmp_path / "none", "no evaluation of"),
    ):
        with pytest.raises(SystemExit) as error:
            hot_balls.main(["table", str(folder)])
        assert error.value.code == 2 and message in capsys.readouterr().err
