"""Clean and measured readings, the memory of each knob, and what `explain` reports."""

from pathlib import Path

import pytest
import torch
from noisy_modules import EVERY_KNOB, EXAMPLE, RANGES, assert_same, document, read
from ruamel.yaml import YAML

import tgdsl
from tgdsl.sensors import KINDS
from tgdsl.sensors.noise import PROFILES


def example_document(folder: Path, kind: str, **changes) -> dict:
    """Return a document with the example's sensor of a kind, on two small links."""
    (example,) = (sensor for sensor in YAML(typ="safe").load(EXAMPLE)["sensors"].values() if sensor["kind"] == kind)
    coarse = {"proximity": {"tolerance": 0.1}}.get(kind, {})
    spec = document(folder, {"s": {**example, "links": ["pad", "tip"], "feels": ["item"], **coarse, **changes}})
    spec["objects"]["item"] |= {"material": "aluminium", "temperature": 45.0}
    return spec


@pytest.mark.parametrize("kind", [kind.name for kind in KINDS if kind.knobs])
@pytest.mark.filterwarnings("ignore:sensor .* the profile .noisy. has no knobs:UserWarning")
def test_both_readouts(tmp_path, kind):
    """`s` equals the reading of a measured sensor; `s/clean` equals, to the bit, that without noise."""
    both = tgdsl.compile(example_document(tmp_path, kind, noise="noisy", readout="both"))
    measured = tgdsl.compile(example_document(tmp_path, kind, noise="noisy"))
    clean = tgdsl.compile(example_document(tmp_path, kind))
    shapes = {output.name: output.shape for output in both.outputs}
    assert shapes["s"] == shapes["s/clean"] == clean.outputs[0].shape
    is_noisy = kind in PROFILES["noisy"]
    differs = False
    for seed in range(4):
        state = both.example_state(4, seed=seed)
        readings, alone, expected = both(state), measured(state), clean(state)
        assert set(readings) == {*expected, "s/clean"}
        assert torch.equal(readings["s/clean"], expected["s"])
        assert torch.equal(readings["s"], alone["s"])
        assert all(torch.equal(readings[name], expected[name]) for name in expected if name != "s")
        differs |= not torch.equal(readings["s"], readings["s/clean"])
    assert differs == is_noisy


@pytest.mark.parametrize("noise", ["clean", {}, {"white_noise": 0, "gain": [1, 1], "read_delay": 0, "bias": {"force": 0}}])
@pytest.mark.parametrize("readout", ["measured", "clean", "both"])
def test_a_clean_sensor_has_no_state_and_costs_nothing(build, noise, readout):
    plain, clean = build(s={"readout": readout}), build(s={"noise": noise, "readout": readout})
    assert not clean.has_state
    read(clean, range(2))
    assert not clean.state_dict() and clean.num_envs is None
    assert clean.operations_per_env() == plain.operations_per_env()
    assert clean.inputs == plain.inputs
    text = clean.explain()
    assert "no state" in text and "noise" not in text and "remembers             0 bytes" in text


def test_a_clean_readout_computes_no_noise(build):
    plain, clean = build(s={}), build(s={"noise": EVERY_KNOB, "readout": "clean"})
    assert clean.operations_per_env() == plain.operations_per_env()
    assert clean.plan.arrays.keys() == plain.plan.arrays.keys() and clean.inputs == plain.inputs
    assert_same(read(clean, range(2)), read(plain, range(2)))
    assert not clean.state_dict() and not clean.has_state


CLOCK = {f"memory.clock.{name}" for name in ("seed", "first_env", "step", "episode", "reset_step")}
OWN_BUFFERS = {
    "radius_noise": ([], True, False),
    "gain": ([], True, False),
    "hysteresis": (["lag", "last"], True, True),
    "crosstalk": ([], False, False),
    "read_delay": (["ring"], True, True),
    "jitter": (["ring"], True, True),
    "bias": ([], False, False),
    "white_noise": ([], True, False),
    "drift": (["walk"], True, False),
    "quantization": ([], False, False),
    "dead_probability": ([], True, False),
}
"""Per knob: what it remembers of each channel, whether it needs the clock, and whether it needs dt."""


FILTERS = ("hysteresis", "read_delay", "jitter")
"""Knobs that change nothing in the first reading."""


@pytest.mark.parametrize("knob", OWN_BUFFERS)
def test_each_knob_remembers_its_own_state(build, knob):
    names, is_timed, needs_dt = OWN_BUFFERS[knob]
    touch, plain = build(s={"noise": {knob: EVERY_KNOB[knob]}}), build(s={})
    disturbed, clean = (
        read(module, range(2), num_envs=64) for module in (touch, plain)
    )  # enough for a dead taxel with contact
    is_disturbed = [not torch.equal(a["s"], b["s"]) for a, b in zip(disturbed, clean, strict=True)]
    assert is_disturbed == [knob not in FILTERS, True]
    expected = {f"memory.s:noise/{name}" for name in names}
    ages = {"memory.clock.ages"} if "ring" in names else set()
    assert set(touch.state_dict()) == expected | ages | (CLOCK if is_timed else set())
    assert set(touch.inputs.fields) - set(plain.inputs.fields) == ({"dt"} if needs_dt else set())


def test_a_range_needs_only_the_clock(build):
    touch = build(s={"noise": {"bias": [0, 1], "quantization": [1e-3, 2e-3], "crosstalk": RANGES["crosstalk"]}})
    touch(touch.example_state(2))
    assert set(touch.state_dict()) == CLOCK


def test_knobs_of_a_contact_sensor_act_before_its_threshold(build):
    """A bias above the threshold switches every taxel on; readings are bits."""
    noise = {"bias": 1e-3, "white_noise": 1e-5}
    touch = build(
        c={"kind": "contact", "threshold": 5e-4, "noise": noise}, d={"kind": "contact", "noise": {"white_noise": 2e-4}}
    )
    (readings,) = read(touch, range(1))
    assert (readings["c"] == 1).all()
    assert set(readings["d"].unique().tolist()) == {0.0, 1.0}


def test_explain_lists_the_stages_and_their_values(build):
    noise = {
        **{name: EVERY_KNOB[name] for name in ("radius_noise", "gain", "hysteresis", "bias", "white_noise")},
        "drift": {"force": [1e-4, 2e-4]},
        "read_delay": 0.02,
        "dead_probability": 0.05,
        "dead_range": [-1, 1],
        "links": {"tip": {"white_noise": 0.25, "read_delay": 0.03}},
    }
    text = build(torch.float32, s={"noise": noise, "rate": 60, "history": 4}).explain()
    rows = [line.strip() for line in text.splitlines() if line.startswith("    ") and "noise:" in line]
    assert rows == [
        "noise: radius_noise 0.0003 m",
        "noise: gain from 0.8, to 1.2",
        "noise: hysteresis strength 0.5, time constant 0.05 s",
        "noise: delay 0.02–0.03 s",
        "noise: bias force 0.02 N, torque -0.0001 N·m",
        "noise: white_noise force 0.005–0.25 N, torque 1e-05–0.25 N·m",
        "noise: drift force [0.0001, 0.0002] N, torque [0, 0] N·m",
        "noise: dead probability 5 %, stuck from force -1 N, torque -1 N·m, to force 1 N, torque 1 N·m",
    ]
    assert "rate: 60 Hz" in text and "history: stack of 4 calls" in text
    num = 17 * 6 * 4
    fixed = 4 * num + 4 + 4 * num  # lag, last, walk and held sample; phase; the history
    memory = "noise lag, noise last, noise ring, noise walk, sample phase, sample measured, history"
    per_taxel = f"{fixed / 17:.3g} per taxel, and for each call of the last 0.03 s {num} bytes, 24 per taxel"
    assert f"remembers {memory} ({fixed} bytes per environment), {per_taxel}" in text
    assert f"remembers    {fixed + 24:>10} bytes, and {num} for each call of the delays" in text


def test_explain_names_the_taxels_with_noise(build):
    """With noise on named links: numbers cover only the noisy taxels, shares are percentages."""
    noise = {"links": {"tip": {"gain": [0.9, 1.1], "white_noise": {"force": 0.25}, "dead_probability": 0.0005}}}
    touch = build(torch.float32, s={"noise": noise})
    num = int((touch.plan.layout.link_id == [link.name for link in touch.plan.layout.links].index("tip")).sum())
    where = f"{num} of {touch.plan.layout.num_taxels} taxels: tip"
    rows = [line.strip() for line in touch.explain().splitlines() if "noise: " in line]
    assert 0 < num < touch.plan.layout.num_taxels
    assert rows == [
        f"noise: gain from 0.9, to 1.1; {where}",
        f"noise: white_noise force 0.25 N, torque 0 N·m; {where}",
        f"noise: dead probability 0.05 %, stuck at force 0 N, torque 0 N·m; {where}",
    ]


@pytest.mark.parametrize("history", [{}, {"history": 3}, {"history": {"length": 5, "reduce": "mean"}}, {"history": {"length": 5, "reduce": "last"}}])  # fmt: skip
@pytest.mark.parametrize("knobs", [[], ["drift"], ["read_delay", "jitter"], ["gain"], list(EVERY_KNOB)])
def test_explain_counts_the_bytes_of_the_buffers(build, history, knobs):
    """The stated bytes are what the buffers hold after a call."""
    noise = {knob: EVERY_KNOB[knob] for knob in knobs}
    touch = build(
        torch.float32, s={"noise": noise, "readout": "both", **history}, c={"kind": "contact", "release_threshold": 1e-4}
    )
    state = touch.example_state(5)
    state.dt = 0.01 if "dt" in touch.inputs.fields else None
    (line,) = (line for line in touch.explain().splitlines() if "remembers  " in line)
    words = line.replace(",", "").split()
    stated = int(words[1]) + (3 * int(words[4]) if "delays" in line else 0)  # 13 + 11 ms are within three calls
    touch(state)
    buffers = [
        buffer
        for name, buffer in touch.state_dict().items()
        if isinstance(buffer, torch.Tensor)
        and buffer.ndim > 0
        and not name.endswith("clock.ages")  # the same for all environments
    ]
    assert stated == sum(buffer[0].numel() * buffer.element_size() for buffer in buffers)
