"""Random numbers depend on seed, environment and call, and on nothing else."""

import pytest
import torch
from noisy_modules import CONTACT_NOISE, EVERY_KNOB, FLOAT32_TOLERANCE, RANGES, assert_same, document, read, read_of_rank

import tgdsl
from tgdsl.testing.reference import full_scale_error


def test_another_sensor_changes_no_noise(build):
    """Neither before it nor after it, on the same taxels or on others."""
    first = {"noise": EVERY_KNOB, "rate": 60}
    alone = read(build(first=first), range(5))
    contact = {"kind": "contact", "noise": CONTACT_NOISE}
    for sensors in (
        {"first": first, "second": first, "third": contact},
        {"second": first, "third": contact, "first": first},
        {"third": {**contact, "links": "tip"}, "first": first},
    ):
        results = read(build(**sensors), range(5))
        assert_same([{"first": readings["first"]} for readings in results], alone)
    both = read(build(first=first, second=first), range(5))
    assert not any(torch.equal(readings["first"], readings["second"]) for readings in both)


def test_more_environments_change_no_noise(build):
    noisy = {"noise": EVERY_KNOB}
    many = read(build(s=noisy), range(5))
    assert_same(read(build(s=noisy), range(5), envs=slice(0, 3)), many, slice(0, 3))


@pytest.mark.parametrize("seed", [0, 12345, -7, 2**40])
def test_a_split_batch_equals_the_whole(build, seed):
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


def test_seeding_restarts_the_count(build):
    touch = build(s={"noise": RANGES})
    first = read(touch.seed(5), range(4))
    read(touch, range(4, 7))
    assert_same(read(touch.seed(5), range(4)), first)


@pytest.mark.slow
def test_the_second_process_has_the_second_half(tmp_path):
    """Two processes of 4 environments in a distributed run find their ranks, and read what one process of 8 reads."""
    spec = document(tmp_path, {"s": {"noise": RANGES}})
    arguments = str(tmp_path / "store"), spec, str(tmp_path)
    process = torch.multiprocessing.get_context("spawn").Process(target=read_of_rank, args=(1, *arguments))
    process.start()
    read_of_rank(0, *arguments)
    process.join()
    whole = read(tgdsl.compile(spec, dtype=torch.float64), range(4))
    for rank in (0, 1):
        part = slice(4 * rank, 4 * rank + 4)
        assert_same(torch.load(tmp_path / f"{rank}.pt"), whole, part)


@pytest.mark.parametrize("noise", [EVERY_KNOB, RANGES])
def test_float32_draws_the_same_as_float64(build, noise):
    exact, rounded = build(s={"noise": noise}), build(torch.float32, s={"noise": noise})
    for a, b in zip(read(rounded, range(8)), read(exact, range(8)), strict=True):
        assert a["s"].dtype == torch.float32
        assert full_scale_error(a["s"], b["s"].numpy()).max() < FLOAT32_TOLERANCE


def test_everything_stays_on_its_device(build):
    """On the meta device: no stage mixes a CPU tensor with the module's."""
    touch = build(torch.float32, s={"noise": RANGES, "rate": 60}, c={"kind": "contact", "noise": CONTACT_NOISE})
    state = touch.example_state(4)
    memory = touch.memory.tensors(4, state.dt, touch.dtype, touch.device)
    tensors = {name: torch.as_tensor(getattr(state, name)).to("meta") for name in touch.inputs.fields}
    readings, updated = touch.to("meta").core(tensors, {name: value.to("meta") for name, value in memory.items()})
    assert {value.device.type for value in [*readings.values(), *updated.values()]} == {"meta"}
