"""`benchmarks/gpu.py` without a GPU: bytes, errors and limits against values by hand, and a dry run."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import gpu
import gpu_plots
from gpu_plots import TARGETS, Row, judged, unmet
from gpu_scenes import CASES, EVERY_KNOB, bytes_of, document, make_artefacts, noise_of, state_of

import tgdsl
from tgdsl.module.outputs import Output

ROW = Row(
    case="kinematic",
    kind="kinematic_taxel",
    noise="clean",
    num_envs=16_384,
    num_taxels=100,
    num_objects=1,
    points=0,
    in_contact=0.6,
    error=1e-6,
    error_largest=1e-5,
    graph=0.025,
    plain=0.2,
    replayed=0.06,
    copy=0.0125,
    sets=4,
    moved=41_041_920,
    per_taxel=24.0,
    ring_per_taxel=0.0,
    anchors_per_taxel=0.0,
    per_anchor=0.0,
    transient=None,
    seconds=1.0,
)
DRY = ["--device", "cpu", "--eager", "--sets", "2", "--repeats", "1"]
"""Arguments of a run without a GPU."""


def module_of(name, tmp_path):
    return tgdsl.compile(document(CASES[name], tmp_path))


class TestBytes:
    def test_two_bodies_and_one_pair_give_six_numbers_per_taxel(self, tmp_path):
        size = bytes_of(module_of("kinematic", tmp_path))
        assert size.inputs == 2 * (3 + 4 + 3 + 3) * 4 + 1
        assert size.outputs == 100 * 6 * 4
        assert (size.state, size.anchors, size.ring_entry, size.num_taxels) == (0, 0, 0, 100)
        assert size.moved == size.held == 105 + 2400
        assert size.per_taxel == 24.0

    def test_noise_keeps_hysteresis_drift_and_counts(self, tmp_path):
        size = bytes_of(module_of("kinematic-noisy", tmp_path))
        assert size.state == 100 * 6 * 3 * 4 + 3 * 8
        assert size.moved == 105 + 2400 + 2 * 7224
        assert size.per_taxel == 24 + 72 + 0.24

    def test_a_ring_of_three_calls_is_held_whole_and_accessed_at_three_entries(self, tmp_path):
        size = bytes_of(module_of("kinematic-full", tmp_path))
        assert (size.ring_calls, size.ring_entry) == (3, 2400)
        assert size.moved == 105 + 2400 + 2 * 7224 + 3 * 2400
        assert size.held == 105 + 2400 + 7224 + 3 * 2400
        assert (size.per_taxel, size.ring_per_taxel) == (24 + 72 + 0.24, 3 * 24)

    def test_an_elastomer_tracks_each_point_in_four_numbers(self, tmp_path):
        size = bytes_of(module_of("elastomer-500-points", tmp_path))
        assert (size.num_anchors, size.anchors, size.per_anchor) == (500, 8000, 16.0)
        assert (size.outputs, size.state, size.per_taxel) == (1200, 0, 12.0)
        assert size.moved == 2 * (3 + 4) * 4 + 1 + 1200 + 2 * 8000

    def test_stacked_readings_are_refused(self, tmp_path):
        description = document(CASES["depth"], tmp_path)
        description["sensors"]["on_pad0"]["history"] = 3
        with pytest.raises(ValueError, match="expected sensors without `history`"):
            bytes_of(tgdsl.compile(description))


class TestLimits:
    def test_a_row_within_all_limits(self):
        assert unmet(ROW, None) == [] and judged(ROW, None) == "yes"

    @pytest.mark.parametrize(
        ("changes", "reason"),
        [
            ({"graph": 0.031}, "graph 0.031 ms > 0.03 ms"),
            ({"replayed": 0.09}, "from Python 0.09 ms > 0.08 ms"),
            ({"per_taxel": 41.0}, "41.0 B per taxel > 40 B"),
            ({"per_anchor": 20.0}, "20.0 B per tracked point > 16 B"),
            ({"error": 2e-5}, "error 2.0e-05 > 1e-05"),
        ],
    )
    def test_missed_limits_are_named(self, changes, reason):
        row = replace(ROW, **changes)
        assert unmet(row, None) == [reason] and judged(row, None) == f"no: {reason}"

    def test_the_rival_must_take_six_times_longer(self):
        row = replace(ROW, case="kinematic-10-objects", graph=0.41 / 5)
        assert unmet(row, None) == ["5.0 times less than the rival's, not 6"]
        assert unmet(replace(row, graph=0.41 / 6.01), None) == []

    def test_full_noise_is_compared_with_clean(self):
        row = replace(ROW, case="kinematic-full", noise="full", graph=0.075, per_taxel=96.0)
        assert judged(row, None) == "–"
        assert judged(row, ROW) == "yes"
        assert unmet(replace(row, graph=0.08), ROW) == ["3.20 × clean > 3 ×"]
        assert unmet(replace(row, per_taxel=121.0), ROW) == ["121.0 B per taxel > 120 B"]

    def test_rows_without_a_time_limit_are_checked_for_error_and_bytes(self):
        row = replace(ROW, num_envs=1_024, graph=9.0)
        assert judged(row, None) == "–"
        assert judged(replace(row, error=1.0), None).startswith("no: error")

    def test_every_limit_is_of_a_measured_case(self):
        assert all(num_envs in CASES[name].envs for name, num_envs in TARGETS)

    def test_rate_and_ratio(self):
        assert ROW.rate == pytest.approx(16_384 * 100 / 25e-6)
        line = gpu_plots.limits_table([ROW])[3]
        assert line == (
            "| kinematic | 16,384 × 100 | 1e-06 (1e-05) | 0.0250 | 0.03 | yes | 0.200 | 0.060 | 41.0 | 2.00 | 0.41 | 16.4 |"
        )
        assert "not measured" in gpu_plots.limits_table([ROW])[2]


class TestErrors:
    OUTPUTS = (
        Output("s", "s", "k", (2, 2), "taxel", ("pad",), ("force_x", "torque_x"), ("N", "N·m")),
        Output("s/missed", "s", "k", (1, 1), "body", ("pad",), ("missed_x",), ("N",)),
    )

    def errors(self, apart_s, apart_missed):
        want = {"s": np.array([[[4.0, 0.5], [-8.0, 0.0]]]), "s/missed": np.array([[[0.1]]])}
        readings = {"s": want["s"] + apart_s, "s/missed": want["s/missed"] + apart_missed}
        return gpu.full_scale_errors(self.OUTPUTS, readings, want)

    def test_each_channel_has_its_own_scale_and_a_remainder_its_units(self):
        errors = self.errors([[[0.8, 0.1], [0.0, 0.0]]], [[[0.4]]])
        assert errors == pytest.approx([0.1, 0.2, 0, 0, 0.05])

    def test_nonzero_readings_of_zero_have_infinite_errors(self):
        want = {"s": np.zeros((1, 1, 2)), "s/missed": np.zeros((1, 1, 1))}
        errors = {"s": np.array([[[1e-9, 0.0]]]), "s/missed": np.zeros((1, 1, 1))}
        assert gpu.full_scale_errors(self.OUTPUTS, errors, want).tolist() == [np.inf, 0, 0]

    def test_nan_is_refused(self):
        with pytest.raises(ValueError, match="s/missed is not finite"):
            self.errors(0.0, np.nan)


class TestGuard:
    def test_a_row_a_tenth_slower_or_missing_is_named(self):
        lines, is_met = gpu.compared(
            {"depth × 16,384": 3.31, "force × 16,384": 10.9}, {"depth × 16,384": 3.0, "force × 16,384": 10.0}
        )
        assert not is_met
        assert ["SLOWER" in line for line in lines] == [True, False]
        lines, is_met = gpu.compared({}, {"depth × 16,384": 3.0})
        assert not is_met and "not timed" in lines[0]

    def test_faster_rows_and_new_ones_pass(self):
        lines, is_met = gpu.compared({"depth × 16,384": 2.0, "new × 8": 1.0}, {"depth × 16,384": 3.0})
        assert is_met and "-33%" in lines[0] and "not recorded" in lines[1]

    def test_a_card_without_recorded_ratios_does_not_pass(self):
        assert not gpu.compared({"depth × 16,384": 2.0}, {})[1]

    def test_a_dry_run_records_ratios_and_compares_them(self, tmp_path, capsys, monkeypatch):
        make_artefacts(tmp_path / "art", [CASES["depth"]])
        file = tmp_path / "kept.json"
        files = ["--out", str(tmp_path / "rows.json"), "--kept", str(file)]
        rows = ["--check-envs", "2", "--envs", "3", "--rows", "depth"]
        command = ["guard", str(tmp_path / "art"), *files, *DRY, *rows]
        options = gpu.parsed([*command, "--keep"])
        with pytest.raises(SystemExit, match="0"):
            options.call(options)
        assert list(json.loads(file.read_text())["CPU"]) == ["depth × 3"]
        file.write_text('{"CPU": {"depth × 3": 1e-6}}')
        rows = (tmp_path / "rows.json").read_text()
        monkeypatch.setattr(gpu, "run", lambda options: options.out.write_text(rows))
        options = gpu.parsed(command)
        with pytest.raises(SystemExit, match="1"):
            options.call(options)
        assert "SLOWER" in capsys.readouterr().out


def test_sets_exceed_the_cache():
    assert gpu.num_sets(50e6) == 4
    assert gpu.num_sets(1e9) == 2
    assert gpu.num_sets(1e3) == gpu.MOST_SETS


def test_medians_skip_the_first_call_and_stop_when_slow():
    times = iter([99.0, 3.0, 1.0, 2.0])
    assert gpu.median_of(lambda: next(times), 3) == 2.0
    long = iter([1.0, 600.0, 500.0, 700.0])
    assert gpu.median_of(lambda: next(long), 30) == 600.0


def test_every_call_of_a_batch_is_made():
    calls = []
    gpu.median_ms(lambda: calls.append(1), 3, torch.device("cpu"), batch=5)
    assert len(calls) == 5 * (1 + 3)


def test_full_noise_sets_only_knobs_that_the_kind_has():
    assert noise_of(CASES["kinematic-full"]) == {"noise": EVERY_KNOB}
    assert "radius_noise" not in noise_of(CASES["link_contact-full"])["noise"]
    assert noise_of(CASES["kinematic"]) == {}


def test_part_of_the_taxels_feels_the_lowest_cube(tmp_path):
    for name in ("kinematic-5-sensors", "kinematic-10-objects"):
        touch = module_of(name, tmp_path)
        state = state_of(touch, 64, 0)
        state.contact_found[:] = True
        felt = torch.cat([reading.ne(0).any(dim=-1) for reading in touch(state).values()], dim=1).double().mean()
        assert 0.3 < felt < 0.95  # the cube covers 4/9 of a pad, or 2/3 if it extends past one side; probes reach 4 mm farther


@pytest.mark.slow
def test_a_dry_run_measures_writes_and_draws(tmp_path, capsys):
    """A row without an artefact fails, and the others go on."""
    names, results = ["depth", "kinematic-noisy"], tmp_path / "gpu.json"
    make_artefacts(tmp_path / "art", [CASES[name] for name in names])
    rows = ["--check-envs", "4", "--envs", "3", "5", "--rows", "kinematic", *names]
    options = gpu.parsed(["run", str(tmp_path / "art"), "--out", str(results), *DRY, *rows])
    options.call(options)
    output = capsys.readouterr().out
    assert "kinematic: FAILED" in output and "kinematic.safetensors" in output
    # A row that is measured again replaces the old one.
    versions = {name: value for name, value in json.loads(results.read_text()).items() if name != "rows"}
    gpu.write(results, gpu_plots.load_rows([results])[0], versions)
    content = json.loads(results.read_text())
    assert content["device"] == "CPU"
    rows = gpu_plots.load_rows([results])
    assert sorted(row.key for row in rows) == [(name, num_envs) for name in names for num_envs in (3, 5)]
    for row in rows:
        assert 0 <= row.error <= 1e-5
        assert min(row.graph, row.plain, row.copy) > 0
    noisy = next(row for row in rows if row.key == ("kinematic-noisy", 3))
    assert noisy.moved == 3 * (105 + 2400 + 2 * 7224)
    for command in (
        ["table", str(results)],
        ["plot", str(results), "--out", str(tmp_path / "images")],
        ["bytes", str(tmp_path / "art")],
    ):
        options = gpu.parsed(command)
        options.call(options)
    assert "| depth | 5 × 100 |" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == ["gpu_memory.png", "gpu_throughput.png"]


def test_rows_past_the_time_limit_are_named(tmp_path, capsys):
    arguments = ["--device", "cpu", "--eager", "--minutes", "-1", "--rows", "depth", "kinematic"]
    options = gpu.parsed(["run", str(tmp_path), "--out", str(tmp_path / "gpu.json"), *arguments])
    options.call(options)
    assert "not measured: depth kinematic" in capsys.readouterr().out
