"""Noise of whole modules: what it depends on, what it costs, what it leaves alone. Statistics are tested with the stages."""

import dataclasses
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch
from ruamel.yaml import YAML

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors import KINDS
from tgdsl.sensors.noise import PROFILES, stages
from tgdsl.testing import only
from tgdsl.testing.reference import full_scale_error

EXAMPLE = Path(__file__).parents[3] / "examples" / "every_sensor.yaml"
FLOAT32_TOLERANCE = 1e-5
"""Largest error over the largest magnitude of the channel, as for clean readings: some 80 roundings of 2⁻²⁴."""
SCENE = """
<mujoco><worldbody>
  <body name="pad"><freejoint/><geom type="box" size=".03 .03 .01"/></body>
  <body name="tip"><freejoint/><geom type="sphere" size=".02"/></body>
  <body name="item"><freejoint/><geom type="sphere" size=".025"/></body>
</worldbody></mujoco>
"""
EVERY_KNOB = {
    "radius_noise": 3e-4,
    "gain": [0.8, 1.2],
    "hysteresis": {"strength": 0.5, "time_constant": 0.05},
    "crosstalk": {"strength": 0.2, "sigma": "5 mm"},
    "read_delay": 0.013,
    "jitter": 0.011,
    "bias": {"force": 0.02, "torque": -1e-4},
    "white_noise": {"force": 5e-3, "torque": 1e-5},
    "drift": {"force": 1e-3, "torque": 1e-6},
    "quantization": {"force": 1e-6, "torque": 1e-9},  # one step is within the tolerance
    "dead_probability": 0.1,
    "dead_range": [-0.3, 0.3],
}
RANGES = {
    "radius_noise": [2e-4, 4e-4],
    "gain": [[0.7, 0.8], [1.2, 1.3]],
    "hysteresis": {"strength": [0.3, 0.6], "time_constant": [0.03, 0.06]},
    "crosstalk": {"strength": [0.1, 0.3], "sigma": [0.004, 0.008]},
    "read_delay": [0.01, 0.02],
    "jitter": [0.0, 0.02],
    "bias": {"force": [-0.02, 0.02]},
    "white_noise": {"force": [1e-3, 5e-3], "torque": [1e-6, 1e-5]},
    "drift": {"force": [1e-4, 1e-3]},
    "quantization": {"force": [5e-7, 1e-6]},
    "dead_probability": [0.1, 0.3],
    "dead_range": [[-0.3, -0.2], [0.2, 0.3]],
}
CONTACT_NOISE = {"white_noise": 2e-4, "release_threshold": "0.1 mm", "read_delay": "7 ms", "drift": 1e-5}


def document(folder: Path, sensors: dict, **rest) -> dict:
    """A document with sensors on 12 taxels of a pad and 5 of a tip that feel a sphere."""
    (folder / "scene.xml").write_text(SCENE)
    pad = [{"pos": [0.006 * x, 0.006 * y, 0.01], "normal": [0, 0, 1]} for x in range(-1, 2) for y in range(-2, 2)]
    tip = [{"pos": [0.01 * np.sin(a), 0, 0.01 * np.cos(a)], "normal": [np.sin(a), 0, np.cos(a)]} for a in np.linspace(-1, 1, 5)]
    layout = {name: {"method": "points", "points": points, "radius": "4 mm"} for name, points in (("pad", pad), ("tip", tip))}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": layout}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {
            name: {"kind": "kinematic_taxel", "links": "*", "feels": ["item"], **sensor} for name, sensor in sensors.items()
        },
        **rest,
    }


@pytest.fixture
def build(tmp_path):
    def compiled(dtype=torch.float64, **sensors) -> TactileModule:
        return tgdsl.compile(document(tmp_path, sensors), dtype=dtype)

    return compiled


def felt_state(touch: TactileModule, num_envs=4, seed=0):
    """A state in which most taxels feel something, and some do not."""
    return touch.example_state(num_envs, seed=seed, spread=0.015)


def held_state(touch: TactileModule, num_envs=4):
    """A state in which every taxel is deep in the object, everywhere alike."""
    state = touch.example_state(num_envs)
    assert state.body_pos is not None and state.body_quat is not None and state.contact_found is not None
    upright = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(state.body_quat)
    found = torch.ones_like(state.contact_found)
    return dataclasses.replace(state, body_pos=torch.zeros_like(state.body_pos), body_quat=upright, contact_found=found)


def read(touch: TactileModule, calls: range, num_envs=8, envs=None) -> list[dict[str, torch.Tensor]]:
    """Return the readings of the states with these seeds; `envs` are those of a larger batch that are fed."""
    found = []
    for call in calls:
        state = felt_state(touch, num_envs, call)
        found.append({name: value.clone() for name, value in touch(state if envs is None else only(state, envs)).items()})
    return found


def assert_same(found, expected, pick=slice(None)):
    for a, b in zip(found, expected, strict=True):
        for name in a:
            assert torch.equal(a[name], b[name][pick]), name


# what random numbers depend on


def test_another_sensor_changes_no_noise(build):
    """Neither one before it nor one behind it, on the same taxels or on others."""
    first = {"noise": EVERY_KNOB, "rate": 60}
    alone = read(build(first=first), range(5))
    contact = {"kind": "contact", "noise": CONTACT_NOISE}
    for sensors in (
        {"first": first, "second": first, "third": contact},
        {"second": first, "third": contact, "first": first},
        {"third": {**contact, "links": "tip"}, "first": first},
    ):
        found = read(build(**sensors), range(5))
        assert_same([{"first": readings["first"]} for readings in found], alone)
    both = read(build(first=first, second=first), range(5))
    assert not any(torch.equal(readings["first"], readings["second"]) for readings in both)


def test_more_environments_change_no_noise(build):
    noisy = {"noise": EVERY_KNOB}
    many = read(build(s=noisy), range(5))
    assert_same(read(build(s=noisy), range(5), envs=slice(0, 3)), many, slice(0, 3))


@pytest.mark.parametrize("seed", [0, 12345, -7, 2**40])
def test_a_split_batch_is_the_whole_one(build, seed):
    sensors = {"s": {"noise": RANGES, "rate": 60}, "c": {"kind": "contact", "noise": CONTACT_NOISE}}
    whole = read(build(**sensors).seed(seed), range(6))
    for first in (0, 4):
        part = slice(first, first + 4)
        assert_same(read(build(**sensors).seed(seed, first_env=first), range(6), envs=part), whole, part)


def test_other_seeds_and_environments_give_other_noise(build):
    white = {"noise": {"white_noise": 1.0}}
    seeds = [read(build(s=white).seed(seed), range(1))[0]["s"] for seed in (0, 1, 2)]
    environments = [seeds[0][:4], seeds[0][4:], read(build(s=white).seed(0, first_env=100), range(1), 4)[0]["s"]]
    for group in (seeds, environments):
        for i, a in enumerate(group):
            for b in group[:i]:
                assert (a != b).float().mean() > 0.99


def test_a_seed_counts_from_the_start_again(build):
    touch = build(s={"noise": RANGES})
    first = read(touch.seed(5), range(4))
    read(touch, range(4, 7))
    assert_same(read(touch.seed(5), range(4)), first)


def _of_rank(rank: int, file: str, made: dict, folder: str) -> None:
    torch.distributed.init_process_group("gloo", init_method=f"file://{file}", rank=rank, world_size=2)
    touch = tgdsl.compile(made, dtype=torch.float64)
    part = slice(4 * rank, 4 * rank + 4)
    torch.save(read(touch, range(4), envs=part), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_the_second_process_has_the_second_half(tmp_path):
    """Two processes of a distributed run, of 4 environments each, read what one of 8 reads, without being told who they are."""
    made = document(tmp_path, {"s": {"noise": RANGES}})
    torch.multiprocessing.spawn(_of_rank, (str(tmp_path / "store"), made, str(tmp_path)), nprocs=2)
    whole = read(tgdsl.compile(made, dtype=torch.float64), range(4))
    for rank in (0, 1):
        part = slice(4 * rank, 4 * rank + 4)
        assert_same(torch.load(tmp_path / f"{rank}.pt"), whole, part)


@pytest.mark.parametrize("noise", [EVERY_KNOB, RANGES])
def test_float32_draws_what_float64_draws(build, noise):
    exact, rounded = build(s={"noise": noise}), build(torch.float32, s={"noise": noise})
    for a, b in zip(read(rounded, range(8)), read(exact, range(8)), strict=True):
        assert a["s"].dtype == torch.float32
        assert full_scale_error(a["s"], b["s"].numpy()).max() < FLOAT32_TOLERANCE


def test_everything_stays_on_its_device(build):
    """On a device that holds no numbers: no stage makes a tensor on the CPU that it then mixes with the module's."""
    touch = build(torch.float32, s={"noise": RANGES, "rate": 60}, c={"kind": "contact", "noise": CONTACT_NOISE})
    state = touch.example_state(4)
    memory = touch.memory.tensors(4, state.dt, touch.dtype, touch.device)
    tensors = {name: torch.as_tensor(getattr(state, name)).to("meta") for name in touch.inputs.fields}
    readings, updated = touch.to("meta").core(tensors, {name: value.to("meta") for name, value in memory.items()})
    assert {value.device.type for value in [*readings.values(), *updated.values()]} == {"meta"}


# kill and resume, reset


def test_kill_and_resume(build, tmp_path):
    """Through a file and a fresh module, wherever it is cut: noise, delay, hysteresis, drift, rate, history, bits."""
    sensors = {
        "s": {"noise": EVERY_KNOB, "rate": 60, "history": {"length": 3, "reduce": "mean"}, "readout": "both"},
        "r": {"noise": RANGES, "history": 4},
        "c": {"kind": "contact", "noise": CONTACT_NOISE, "rate": 40},
    }
    through = build(torch.float32, **sensors).seed(3, first_env=1000)
    expected = read(through, range(5), 4)
    through.reset([2])
    expected += read(through, range(5, 14), 4)
    for cut in (1, 5, 6, 10):
        killed = build(torch.float32, **sensors).seed(3, first_env=1000)
        read(killed, range(min(cut, 5)), 4)
        if cut > 5:
            killed.reset([2])
            read(killed, range(5, cut), 4)
        torch.save(killed.state_dict(), tmp_path / "state.pt")
        del killed
        resumed = build(torch.float32, **sensors)
        resumed.load_state_dict(torch.load(tmp_path / "state.pt"))
        assert resumed.num_envs == 4
        if cut <= 5:
            assert_same(read(resumed, range(cut, 5), 4), expected[cut:5])
            resumed.reset([2])
        assert_same(read(resumed, range(max(cut, 5), 14), 4), expected[max(cut, 5) :])


def test_resume_in_a_module_that_has_run(build):
    """What it remembered, its number of environments and its seed are those of the state that is loaded."""
    sensors = {"s": {"noise": RANGES, "history": {"length": 3, "reduce": "median"}, "rate": 60}}
    one, other = build(**sensors).seed(1), build(**sensors).seed(2)
    read(one, range(3), 4)
    read(other, range(5), 6)
    other.load_state_dict(one.state_dict())
    assert_same(read(other, range(3, 8), 4), read(one, range(3, 8), 4))


CHOSEN = [[1, 3], torch.tensor([3, 1]), torch.tensor([False, True, False, True])]


@pytest.mark.parametrize("chosen", CHOSEN)
def test_filters_start_from_the_true_value(build, chosen):
    """No glitch: after a reset the first reading is the clean one to the bit, and nothing changes elsewhere."""
    noise = {"hysteresis": EVERY_KNOB["hysteresis"], "read_delay": [0.02, 0.04], "jitter": 0.02}
    sensor = {"noise": noise, "readout": "both", "rate": 60, "history": {"length": 4, "reduce": "mean"}}
    touch, untouched = build(s=sensor), build(s=sensor)
    first = read(touch, range(1), 4)[0]
    assert torch.equal(first["s"], first["s/clean"])
    read(untouched, range(1), 4)
    assert_same(read(touch, range(1, 6), 4), read(untouched, range(1, 6), 4))
    touch.reset(chosen)
    (after,), (expected,) = read(touch, range(6, 7), 4), read(untouched, range(6, 7), 4)
    clean = read(build(s={}), range(6, 7), 4)[0]["s"]
    assert torch.equal(after["s"][[1, 3]], clean[[1, 3]]) and clean[[1, 3]].abs().max() > 0
    assert torch.equal(after["s"][[0, 2]], expected["s"][[0, 2]])
    assert not torch.equal(expected["s"], expected["s/clean"])
    for call in range(7, 10):
        (found,), (other,) = read(touch, range(call, call + 1), 4), read(untouched, range(call, call + 1), 4)
        assert torch.equal(found["s"][[0, 2]], other["s"][[0, 2]])


@pytest.mark.parametrize("chosen", CHOSEN)
def test_gains_and_dead_taxels_are_drawn_anew(build, chosen):
    noise = {"gain": [0.5, 2.0], "dead_probability": 0.3, "dead_range": [100.0, 200.0]}
    touch = build(s={"kind": "contact_depth", "noise": noise, "readout": "both"})

    def drawn():
        """Return stuck readings and, where there are none, the gains; NaN where nothing is felt."""
        readings = touch(held_state(touch, 4))
        measured, clean = readings["s"], readings["s/clean"]
        stuck = torch.where(measured > 50, measured, torch.nan)
        return stuck, torch.where(stuck.isnan() & (clean > 0), measured / clean, torch.nan)

    assert_close = torch.testing.assert_close
    before, again = drawn(), drawn()
    for a, b in zip(before, again, strict=True):
        assert_close(a, b, rtol=0, atol=0, equal_nan=True)
        assert a.isfinite().any(dim=1).all()
    touch.reset(chosen)
    after = drawn()
    for a, b in zip(before, after, strict=True):
        assert_close(a[[0, 2]], b[[0, 2]], rtol=0, atol=0, equal_nan=True)
        assert not (a == b)[[1, 3]].any()
    assert (before[0].isnan() != after[0].isnan())[[1, 3]].any(dim=1).all()


# clean and measured


def example_of(kind: str, **changes) -> dict:
    """The example with one sensor, of a kind, at low resolution."""
    made = YAML(typ="safe").load(EXAMPLE)
    made["robot"] = {
        "model": str(EXAMPLE.parent / made["robot"]["model"]),
        "layout": str(EXAMPLE.parent / made["robot"]["layout"]),
    }
    made["scene"] = {"model": str(EXAMPLE.parent / made["scene"]["model"])}
    (own,) = (sensor for sensor in made["sensors"].values() if sensor["kind"] == kind)
    return {**made, "resolution": "low", "sensors": {"s": {**own, **changes}}, "observations": {}}


@pytest.mark.parametrize("kind", [kind.name for kind in KINDS])
@pytest.mark.filterwarnings("ignore:sensor .* the profile .noisy. has no knobs:UserWarning")
def test_both_readouts(kind):
    """`s` is what a measured sensor reads, and `s/clean` is to the bit what one without noise reads."""
    both = tgdsl.compile(example_of(kind, noise="noisy", readout="both"))
    measured = tgdsl.compile(example_of(kind, noise="noisy"))
    clean = tgdsl.compile(example_of(kind))
    shapes = {output.name: output.shape for output in both.outputs}
    assert shapes["s"] == shapes["s/clean"] == clean.outputs[0].shape
    is_noisy = kind in PROFILES["noisy"]
    differs = False
    for seed in range(4):
        state = both.example_state(4, seed=seed)
        found, alone, expected = both(state), measured(state), clean(state)
        assert set(found) == {*expected, "s/clean"}
        assert torch.equal(found["s/clean"], expected["s"])
        assert torch.equal(found["s"], alone["s"])
        assert all(torch.equal(found[name], expected[name]) for name in expected if name != "s")
        differs |= not torch.equal(found["s"], found["s/clean"])
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


CLOCK = {f"memory.clock.{name}" for name in ("seed", "first_env", "step", "episode", "age")}
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
"""Of each knob what is remembered of each channel, whether the clock is needed, and whether dt is."""


FILTERS = ("hysteresis", "read_delay", "jitter")
"""Knobs that change nothing in the first reading."""


@pytest.mark.parametrize("knob", OWN_BUFFERS)
def test_each_knob_remembers_its_own(build, knob):
    names, is_timed, wants_dt = OWN_BUFFERS[knob]
    touch, plain = build(s={"noise": {knob: EVERY_KNOB[knob]}}), build(s={})
    disturbed, clean = (read(module, range(2), num_envs=64) for module in (touch, plain))  # so many that a dead taxel is felt
    is_disturbed = [not torch.equal(a["s"], b["s"]) for a, b in zip(disturbed, clean, strict=True)]
    assert is_disturbed == [knob not in FILTERS, True]
    expected = {f"memory.s:noise/{name}" for name in names}
    ages = {"memory.clock.ages"} if "ring" in names else set()
    assert set(touch.state_dict()) == expected | ages | (CLOCK if is_timed else set())
    assert set(touch.inputs.fields) - set(plain.inputs.fields) == ({"dt"} if wants_dt else set())


def test_a_range_needs_the_clock_alone(build):
    touch = build(s={"noise": {"bias": [0, 1], "quantization": [1e-3, 2e-3], "crosstalk": RANGES["crosstalk"]}})
    touch(touch.example_state(2))
    assert set(touch.state_dict()) == CLOCK


def test_the_knobs_of_a_contact_act_before_its_threshold(build):
    """A bias above the threshold switches every taxel on; nothing but bits is read."""
    noise = {"bias": 1e-3, "white_noise": 1e-5}
    touch = build(
        c={"kind": "contact", "threshold": 5e-4, "noise": noise}, d={"kind": "contact", "noise": {"white_noise": 2e-4}}
    )
    (readings,) = read(touch, range(1))
    assert (readings["c"] == 1).all()
    assert set(readings["d"].unique().tolist()) == {0.0, 1.0}


# explain


def test_explain_tells_the_stages_and_their_values(build):
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
        "noise: dead probability 0.05, stuck from force -1 N, torque -1 N·m, to force 1 N, torque 1 N·m",
    ]
    assert "rate: 60 Hz" in text and "history: stack of 4 calls" in text
    num = 17 * 6 * 4
    fixed = 4 * num + 4 + 4 * num  # lag, last, walk and held sample; phase; the history
    what = "noise lag, noise last, noise ring, noise walk, sample phase, sample measured, history"
    per_taxel = f"{fixed / 17:.3g} per taxel, and for each call of the last 0.03 s {num} bytes, 24 per taxel"
    assert f"remembers {what} ({fixed} bytes per environment), {per_taxel}" in text
    assert f"remembers    {fixed + 24:>10} bytes, and {num} for each call of the delays" in text


@pytest.mark.parametrize("history", [{}, {"history": 3}, {"history": {"length": 5, "reduce": "mean"}}, {"history": {"length": 5, "reduce": "last"}}])  # fmt: skip
@pytest.mark.parametrize("knobs", [[], ["drift"], ["read_delay", "jitter"], ["gain"], list(EVERY_KNOB)])
def test_explain_counts_the_bytes_that_are_there(build, history, knobs):
    """What it says is what buffers hold after a call."""
    noise = {knob: EVERY_KNOB[knob] for knob in knobs}
    touch = build(
        torch.float32, s={"noise": noise, "readout": "both", **history}, c={"kind": "contact", "release_threshold": 1e-4}
    )
    state = touch.example_state(5)
    state.dt = 0.01 if "dt" in touch.inputs.fields else None
    (line,) = (line for line in touch.explain().splitlines() if "remembers  " in line)
    words = line.replace(",", "").split()
    said = int(words[1]) + (3 * int(words[4]) if "delays" in line else 0)  # 13 + 11 ms are within three calls
    touch(state)
    held = [
        buffer
        for name, buffer in touch.state_dict().items()
        if isinstance(buffer, torch.Tensor)
        and buffer.ndim > 0
        and not name.endswith("clock.ages")  # the same for all environments
    ]
    assert said == sum(buffer[0].numel() * buffer.element_size() for buffer in held)


# radius noise


def test_a_disturbed_radius_is_another_radius(build, tmp_path):
    """Depths are exactly those of a module that is compiled with the radii that were drawn."""
    touch = build(s={"kind": "contact_depth", "noise": {"radius_noise": 2e-3}})
    made, drawn, num_felt = document(tmp_path, {"s": {"kind": "contact_depth"}}), [], 0
    for call in range(4):
        state = felt_state(touch, 2, call)
        memory = touch.memory.tensors(2, None, touch.dtype, touch.device)
        nows, knobs = touch._circumstances({}, memory)
        shift = stages.radius_shift(knobs["s"]["radius_noise"], nows["s"], torch.zeros(2, 17, dtype=torch.float64))
        readings = touch(state)["s"]
        drawn.append(shift)
        for env in range(2):
            for link, first in (("pad", 0), ("tip", 12)):
                for i, point in enumerate(made["robot"]["layout"]["resolutions"]["r"][link]["points"]):
                    point["radius"] = 4e-3 + shift[env, first + i].item()
            expected = tgdsl.compile(made, dtype=torch.float64)(only(state, slice(env, env + 1)))["s"]
            torch.testing.assert_close(readings[env : env + 1], expected, rtol=1e-12, atol=1e-17)
            num_felt += int(expected.count_nonzero())
    assert num_felt > 5
    values = torch.stack(drawn)
    assert values.abs().max() <= 2e-3 and len(values.unique()) == values.numel()
    assert values.min() < -1.5e-3 and values.max() > 1.5e-3


def test_a_radius_is_never_negative(build):
    """R̃ = max(0, R + ε): where R is gone a probe still reads how deep its centre is, as max(0, R̃ − φ) says."""
    touch = build(s={"kind": "contact_depth", "gate": "geometric", "noise": {"radius_noise": 0.02}, "readout": "both"})
    state = touch.example_state(40, spread=0.01)
    readings = touch(state)
    measured, clean = readings["s"], readings["s/clean"]
    deep = clean > 4e-3  # the centre is inside
    assert deep.any() and (measured[deep] >= clean[deep] - 4e-3 - 1e-12).all()
    assert torch.isclose(measured[deep], clean[deep] - 4e-3, rtol=0, atol=1e-12).float().mean() > 0.2  # P(ε < −4 mm) = 0.4
    assert (measured >= 0).all()


RADIUS_ERRORS = {"points": 1e-12, "field": 0.1}
"""Largest error over full scale at R ± ρ, against a module that is compiled with that radius."""


@pytest.mark.parametrize("backend", ["points", pytest.param("field", marks=pytest.mark.slow)])
def test_radius_noise_of_proximity(tmp_path, monkeypatch, backend):
    made = document(tmp_path, {"s": {"kind": "proximity", "backend": backend, "tolerance": 0.02, "points": 1000}})
    (tmp_path / "scene.xml").write_text(SCENE.replace('type="sphere" size=".025"', 'type="box" size=".01 .01 .01"'))

    def of_radius(radius: float, noise: dict) -> TactileModule:
        for own in made["robot"]["layout"]["resolutions"]["r"].values():
            own["radius"] = radius
        made["sensors"]["s"]["noise"] = noise
        return tgdsl.compile(made, dtype=torch.float64)

    touch = of_radius(0.01, {"radius_noise": "0.6 mm"})
    state = felt_state(touch, 100)
    for sign in (1, -1):
        exact = of_radius(0.01 + sign * 6e-4, {})
        if backend == "points":  # which points there are depends on the radius; the law is compared on the same ones
            cloud = {name: value for name, value in touch.plan.arrays.items() if name.startswith("objects/item/moments/")}
            exact = TactileModule(dataclasses.replace(exact.plan, arrays={**exact.plan.arrays, **cloud}), dtype=torch.float64)
        monkeypatch.setattr(stages, "radius_shift", lambda half_width, *_, sign=sign: (sign * half_width[:, 0]).expand(100, 17))
        error = full_scale_error(touch(state)["s"], exact(state)["s"].numpy())
        print(f"{backend}, R {sign:+d} ρ: largest error {error.max():.2g} of full scale, RMS {np.sqrt(np.mean(error**2)):.2g}")
        assert error.max() < RADIUS_ERRORS[backend]


def test_the_clean_reading_of_points_is_that_of_a_sensor_without_noise(build):
    """Radius noise of the measured reading leaves the clean one alone: the object is sampled in the same points."""
    sensor = {"kind": "proximity", "backend": "points", "points": 200}
    both, clean = build(s={**sensor, "noise": {"radius_noise": "0.6 mm"}, "readout": "both"}), build(s=sensor)
    for a, b in zip(read(both, range(3)), read(clean, range(3)), strict=True):
        assert full_scale_error(a["s/clean"], b["s"].numpy()).max() < 1e-12


# gradients


def gradients(touch, state, weight=None, name="s"):
    """Return the derivatives of the weighted sum of a reading with respect to poses."""
    tensors = {n: getattr(state, n).clone().requires_grad_() for n in ("body_pos", "body_quat")}
    reading = touch(dataclasses.replace(state, **tensors))[name]
    return torch.autograd.grad(
        (reading * (torch.ones_like(reading) if weight is None else weight)).sum(), list(tensors.values())
    )


@pytest.mark.parametrize("noise", [EVERY_KNOB, RANGES])
def test_gradients_are_finite(build, noise):
    touch = build(s={"noise": noise})
    for seed in range(3):
        touch.reset()
        for call in range(3):
            for gradient in gradients(touch, felt_state(touch, 4, 10 * seed + call)):
                assert gradient.isfinite().all()
                assert call > 0 or gradient.abs().max() > 0  # later readings may be of earlier calls alone


def test_gradients_are_the_clean_ones_times_the_gain(build):
    touch, clean = build(s={"noise": {"gain": [0.5, 2.0]}}), build(s={})
    state = felt_state(touch)
    with torch.no_grad():
        a, b = touch(state)["s"], clean(state)["s"]
        ratio = torch.where(b.abs() > 0, a / b, 0.0)
    weight = torch.randn(a.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for found, expected in zip(gradients(touch, state, weight), gradients(clean, state, weight * ratio), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-12)
    tensors = [state.body_pos.clone().requires_grad_(), state.body_quat.clone().requires_grad_()]

    def readings(pos, quat):
        return touch(dataclasses.replace(state, body_pos=pos, body_quat=quat))["s"]

    assert torch.autograd.gradcheck(readings, tensors, eps=1e-7, atol=1e-4, rtol=1e-4, fast_mode=True)


def test_gradients_pass_the_quantiser_and_are_gone_where_a_taxel_is_dead(build):
    fine, coarse = build(s={}), build(s={"noise": {"quantization": 0.1}})
    state = felt_state(fine)
    with torch.no_grad():
        reading = coarse(state)["s"]
    assert (reading / 0.1 - (reading / 0.1).round()).abs().max() < 1e-9 and reading.abs().max() > 0
    for found, expected in zip(gradients(coarse, state), gradients(fine, state), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
    tensor = state.body_pos.clone().requires_grad_()
    with_grad = coarse(dataclasses.replace(state, body_pos=tensor))["s"]
    torch.testing.assert_close(with_grad.detach(), reading, rtol=0, atol=1e-15)
    dead = build(s={"noise": {"dead_probability": 1.0}})
    assert not any(gradient.any() for gradient in gradients(dead, state))


# compiled


@pytest.mark.slow
def test_compiled_equals_eager(build, monkeypatch):
    """At two numbers of environments: the second takes over the state of another module."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)  # torch.compile cannot trace run-time checks
    sensors = {
        "s": {"noise": EVERY_KNOB, "rate": 60, "history": 3, "readout": "both"},
        "r": {"noise": RANGES, "history": {"length": 3, "reduce": "mean"}},
        "d": {"kind": "contact_depth", "noise": {"white_noise": 1e-4, "read_delay": 0.013}, "rate": 60},
    }
    torch.compiler.reset()
    eager, more, compiled = (build(torch.float32, **sensors) for _ in range(3))
    compiled.compile()
    agree_over_calls(compiled, eager, 4, range(8))
    read(more, range(2), 37)
    compiled.load_state_dict(more.state_dict())
    agree_over_calls(compiled, more, 37, range(2, 8))


def agree_over_calls(compiled, eager, num_envs, calls):
    for call in calls:
        if call == 5:
            for touch in (eager, compiled):
                touch.reset([1, 3])
        (found,), (expected,) = (read(touch, range(call, call + 1), num_envs) for touch in (compiled, eager))
        for name in expected:
            a, b = (reading[name].flatten(0, -3) for reading in (found, expected))
            assert full_scale_error(a, b.double().numpy()).max() < FLOAT32_TOLERANCE, name


@pytest.mark.parametrize("nobody", [[], torch.tensor([], dtype=torch.int64), torch.zeros(4, dtype=torch.bool)])
def test_reset_of_no_environment_changes_nothing(build, nobody):
    touch, other = (build(s={"noise": EVERY_KNOB, "history": 2}) for _ in range(2))
    for module in (touch, other):
        module(module.example_state(4))
    touch.reset(nobody)
    state = touch.example_state(4, seed=1)
    torch.testing.assert_close(touch(state)["s"], other(state)["s"], rtol=0, atol=0)
