"""Two benches beside each other, by rows written out."""

import json

import pytest

from tgdsl.errors import TgdslError
from tgdsl.report.bench.compare import compared_rows, read_rows


def row(variant, seconds, half=0.1, rms=1e-3, is_on_front=True, subject="touch", **more):
    times = {"seconds_256_envs": seconds, "seconds_256_envs_low": seconds - half, "seconds_256_envs_high": seconds + half}
    known = {"subject": subject, "kind": "contact", "variant": variant, "precision": "float32"}
    return known | {"is_own": False, "is_on_front": is_on_front, "rms": rms, "times_own": seconds} | times | more


def test_the_same_twice():
    """Times differ, and nothing is said of that."""
    found = compared_rows([row("a", 1.0), row("b", 2.0)], [row("a", 1.3), row("b", 2.4)])
    assert found.lines() == ["errors and counts are as in the earlier bench", "the front is as in the earlier bench"]


def test_who_is_as_fast_may_change_places():
    """First a alone is on the front; then both are, as their intervals overlap."""
    before = [row("a", 1.0), row("b", 1.3, is_on_front=False)]
    found = compared_rows([row("a", 1.2), row("b", 1.1)], before)
    assert found.turned == () and found.tied == ("touch: b, float32",)
    assert found.lines()[-1] == "the front is as in the earlier bench, except for ties: touch: b, float32"


def test_who_was_faster_and_is_slower_is_named():
    found = compared_rows([row("a", 2.0, is_on_front=False), row("b", 1.0)], [row("a", 1.0), row("b", 2.0, is_on_front=False)])
    assert found.turned == (("touch: a, float32", "touch: b, float32"),) and found.tied == ()
    assert found.lines()[0] == "touch: a, float32 was faster than touch: b, float32, and is slower now"


def test_sensors_are_not_compared_with_each_other():
    before = [row("a", 1.0), row("b", 2.0, subject="skin")]
    assert compared_rows([row("a", 2.0), row("b", 1.0, subject="skin")], before).turned == ()


def test_the_most_environments_that_both_have_count():
    large = {"seconds_1024_envs": 9.0, "seconds_1024_envs_low": 8.9, "seconds_1024_envs_high": 9.1}
    before = [row("a", 1.0), row("b", 2.0)]
    assert compared_rows([row("a", 1.0, **large), row("b", 2.0)], before).turned == ()


def test_other_errors_and_variants_are_named():
    before = [row("a", 1.0, operations=12), row("old", 1.0), row("c", 1.0, subject="gone")]
    found = compared_rows([row("a", 1.0, rms=2e-3, operations=13), row("new", 1.0)], before)
    assert (found.only_before, found.only_now) == (("touch: old, float32",), ("touch: new, float32",))
    assert found.changed == {"touch: a, float32": ("rms 0.001 → 0.002", "operations 12 → 13")}
    assert "errors and counts are as in the earlier bench" not in found.lines()


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"rows": [{"subject": 1}]}', '{"rows": 3}', '{"rows": [3]}'])
def test_a_file_that_is_no_bench_is_named(tmp_path, text):
    (tmp_path / "b.json").write_text(text)
    with pytest.raises(TgdslError, match=r"b\.json: found no rows of a bench, expected the bench\.json of one"):
        read_rows(tmp_path / "b.json")


def test_a_file_is_read_as_it_was_written(tmp_path):
    (tmp_path / "b.json").write_text(json.dumps({"rows": [row("a", 1.0)]}))
    assert read_rows(tmp_path / "b.json") == [row("a", 1.0)]
    with pytest.raises(TgdslError, match="cannot read this file: No such file"):
        read_rows(tmp_path / "c.json")
