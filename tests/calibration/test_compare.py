"""Several models fitted to one recording, in one table."""

import numpy as np
import pytest
from recorded_presses import document, recording

import tgdsl
from tgdsl.errors import SpecError, TgdslError

MODELS = """\
tgdsl: 1
compare:
  power law: {fit: [touch.normal_stiffness, touch.depth_exponent]}
  linear spring: {set: {sensors.touch.depth_exponent: 1}, fit: [touch.normal_stiffness]}
  as written: {}
"""


def test_only_the_true_law_reaches_the_noise_floor(tmp_path):
    path = document(tmp_path)
    (tmp_path / "models.yaml").write_text(MODELS)
    result = tgdsl.compare(path, recording(path), tmp_path / "models.yaml", starts=1, intervals="none")
    true, linear, written = (result.fits[name].errors[0] for name in ("power law", "linear spring", "as written"))
    assert true.floor is not None
    assert true.error == pytest.approx(true.floor, rel=0.1)
    assert linear.error > 2 * true.error and written.error > linear.error
    lines = str(result).splitlines()
    assert [line.split("  ")[0] for line in lines[2:5]] == ["power law", "linear spring", "as written"]
    assert f"{true.error:.3f}" in lines[2] and "touch.depth_exponent 1." in lines[2]


def test_mistakes_are_located(tmp_path):
    (tmp_path / "models.yaml").write_text(MODELS.replace("set:", "sett:"))
    with pytest.raises(SpecError, match=r"models\.yaml:4:\d+: compare\.linear spring"):
        tgdsl.compare(document(tmp_path), {}, tmp_path / "models.yaml")
    with pytest.raises(SpecError, match=r'compare\.linear spring\.sett: unknown key "sett"'):
        tgdsl.compare(document(tmp_path), {}, {"linear spring": {"sett": {}}})
    with pytest.raises(TgdslError, match=r"touch\.loop: the document gives no value, expected one to start from"):
        tgdsl.compare(document(tmp_path), {}, {"rubber": {"fit": ["touch.loop.force"]}})


def test_the_command_prints_the_table(tmp_path, here):
    path = document(tmp_path)
    (tmp_path / "models.yaml").write_text(MODELS)
    np.savez(tmp_path / "press.npz", **recording(path, num=20))  # type: ignore[arg-type]
    words = ("calibrate", "sensor", "touch.yaml", "press.npz", "--compare", "models.yaml", "--intervals", "none")
    code, out, errors = here(tmp_path, *words, "--starts", "1")
    assert code == 0, errors
    assert "linear spring" in out and "as written" in out
    code, _, errors = here(tmp_path, *words, "--fit", "touch.normal_stiffness")
    assert code != 0 and "expected no --fit" in errors
