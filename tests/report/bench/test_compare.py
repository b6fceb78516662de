"""Comparisons of two benches, from rows written by hand."""

import json

import pytest

from tgdsl.errors import TgdslError
from tgdsl.report.bench.compare import compared_rows, read_rows


def row(variant, seconds, half=0.1, rms=1e-3, is_on_front=True, subject="touch", **more):
    times = {"seconds_256_envs": seconds, "seconds_256_envs_low": seconds - half, "seconds_256_envs_high": seconds + half}
    labels = {"subject": subject, "kind": "contact", "variant": variant, "precision": "float32"}
    return labels | {"is_own": False, "is_on_front": is_on_front, "rms": rms, "times_own": seconds} | times | more


def test_changed_times_alone_are_no_difference():
    comparison = compared_rows([row("a", 1.0), row("b", 2.0)], [row("a", 1.3), row("b", 2.4)])
    assert comparison.lines() == ["errors and counts are as in the earlier bench", "the front is as in the earlier bench"]


def test_variants_with_overlapping_times_may_swap():
    """First only a is on the front, then both: their intervals overlap."""
    earlier = [row("a", 1.0), row("b", 1.3, is_on_front=False)]
    comparison = compared_rows([row("a", 1.2), row("b", 1.1)], earlier)
    assert comparison.turned == () and comparison.tied == ("touch: b, float32",)
    assert comparison.lines()[-1] == "the front is as in the earlier bench, except for ties: touch: b, float32"


def test_reversed_orders_are_named():
    comparison = compared_rows(
        [row("a", 2.0, is_on_front=False), row("b", 1.0)], [row("a", 1.0), row("b", 2.0, is_on_front=False)]
    )
    assert comparison.turned == (("touch: a, float32", "touch: b, float32"),) and comparison.tied == ()
    assert comparison.lines()[0] == "touch: a, float32 was faster than touch: b, float32, and is slower now"


def test_sensors_are_not_compared_with_each_other():
    earlier = [row("a", 1.0), row("b", 2.0, subject="skin")]
    assert compared_rows([row("a", 2.0), row("b", 1.0, subject="skin")], earlier).turned == ()


def test_the_largest_common_number_of_environments_counts():
    large = {"seconds_1024_envs": 9.0, "seconds_1024_envs_low": 8.9, "seconds_1024_envs_high": 9.1}
    earlier = [row("a", 1.0), row("b", 2.0)]
    assert compared_rows([row("a", 1.0, **large), row("b", 2.0)], earlier).turned == ()


def test_changed_errors_and_variants_are_named():
    earlier = [row("a", 1.0, operations=12), row("old", 1.0), row("c", 1.0, subject="gone")]
    comparison = compared_rows([row("a", 1.0, rms=2e-3, operations=13), row("new", 1.0)], earlier)
    assert (comparison.only_before, comparison.only_now) == (("touch: old, float32",), ("touch: new, float32",))
    assert comparison.changed == {"touch: a, float32": ("rms 0.001 → 0.002", "operations 12 → 13")}
    assert "errors and counts are as in the earlier bench" not in comparison.lines()


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"rows": [{"subject": 1}]}', '{"rows": 3}', '{"rows": {}}', '{"rows": [3]}']
)
def test_a_file_without_a_bench_is_named(tmp_path, text):
    (tmp_path / "b.json").write_text(text)
    with pytest.raises(TgdslError, match=r"b\.json: found no rows of a bench, expected the bench\.json of one"):
        read_rows(tmp_path / "b.json")


def test_rows_are_read_as_written(tmp_path):
    (tmp_path / "b.json").write_text(json.dumps({"rows": [row("a", 1.0)]}))
    assert read_rows(tmp_path / "b.json") == [row("a", 1.0)]
    with pytest.raises(TgdslError, match="cannot read this file: No such file"):
        read_rows(tmp_path / "c.json")
