"""A bench of a sensor whose fields `accuracy` chose."""

import json

import pytest
from chosen_pads import chosen_document

from tgdsl.report.bench.bench import Bench, Options, bench
from tgdsl.report.bench.page import write_bench
from tgdsl.tuning import choose as choosing


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    document = chosen_document(folder, "depth: {kind: contact_depth, gate: geometric, accuracy: 10 %}")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choosing, "ENVS", 6)
        patch.setattr(choosing, "STEPS", 30)
        patch.setenv("TGDSL_CACHE", str(folder / "cache"))
        work = Bench(document, sensors=("depth",), state_envs=4, steps=9, options=Options(num_envs=(2,), repeats=1))
        yield bench(work)


@pytest.mark.slow
def test_the_current_point_is_the_one_that_accuracy_chose(report):
    (depth,) = report.subjects
    assert depth.own.label == "grid, 1 mm" and depth.reference == "raycast, float64"
    assert depth.chosen[0] == "accuracy 10 %: grid, 1 mm"
    labels = [point.label for point in depth.points if point.precision == "float32"]
    assert labels == ["grid, 1 mm", "grid, 0.2 mm", "grid, 0.05 mm", "grid, 0.01 mm", "raycast"]


@pytest.mark.slow
def test_files_give_the_reason_of_the_choice(report, tmp_path):
    files = {file.suffix: file.read_text() for file in write_bench(report, tmp_path)}
    assert "accuracy 10 %: grid, 1 mm<br>" in files[".html"]
    assert json.loads(files[".json"])["subjects"][0]["chosen"][0] == "accuracy 10 %: grid, 1 mm"
