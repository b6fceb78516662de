"""Noise that resumes where it stopped, and that restarts at a reset."""

import pytest
import torch
from noisy_modules import CONTACT_NOISE, EVERY_KNOB, RANGES, assert_same, held_state, read


def test_kill_and_resume(build, tmp_path):
    """Through a file and a fresh module, at any cut: noise, delay, hysteresis, drift, rate, history, bits."""
    sensors = {
        "s": {"noise": EVERY_KNOB, "rate": 60, "history": {"length": 3, "reduce": "mean"}, "readout": "both"},
        "r": {"noise": RANGES, "history": 4},
        "c": {"kind": "contact", "noise": CONTACT_NOISE, "rate": 40},
    }
    uninterrupted = build(torch.float32, **sensors).seed(3, first_env=1000)
    expected = read(uninterrupted, range(5), 4)
    uninterrupted.reset([2])
    expected += read(uninterrupted, range(5, 14), 4)
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
    """Memory, number of environments and seed come from the loaded state."""
    sensors = {"s": {"noise": RANGES, "history": {"length": 3, "reduce": "median"}, "rate": 60}}
    source, target = build(**sensors).seed(1), build(**sensors).seed(2)
    read(source, range(3), 4)
    read(target, range(5), 6)
    target.load_state_dict(source.state_dict())
    assert_same(read(target, range(3, 8), 4), read(source, range(3, 8), 4))


CHOSEN = [[1, 3], torch.tensor([3, 1]), torch.tensor([False, True, False, True])]


@pytest.mark.parametrize("chosen", CHOSEN)
def test_filters_start_from_the_true_value(build, chosen):
    """After a reset the first reading equals the clean one to the bit; other environments do not change."""
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
        (readings,), (untouched_readings,) = read(touch, range(call, call + 1), 4), read(untouched, range(call, call + 1), 4)
        assert torch.equal(readings["s"][[0, 2]], untouched_readings["s"][[0, 2]])


@pytest.mark.parametrize("chosen", CHOSEN)
def test_gains_and_dead_taxels_are_redrawn_at_a_reset(build, chosen):
    noise = {"gain": [0.5, 2.0], "dead_probability": 0.3, "dead_range": [100.0, 200.0]}
    touch = build(s={"kind": "contact_depth", "noise": noise, "readout": "both"})

    def drawn():
        """Return stuck readings and, elsewhere, the gains; NaN without contact."""
        readings = touch(held_state(touch, 4))
        measured, clean = readings["s"], readings["s/clean"]
        stuck = torch.where(measured > 50, measured, torch.nan)
        return stuck, torch.where(stuck.isnan() & (clean > 0), measured / clean, torch.nan)

    assert_close = torch.testing.assert_close
    initial, again = drawn(), drawn()
    for a, b in zip(initial, again, strict=True):
        assert_close(a, b, rtol=0, atol=0, equal_nan=True)
        assert a.isfinite().any(dim=1).all()
    touch.reset(chosen)
    after = drawn()
    for a, b in zip(initial, after, strict=True):
        assert_close(a[[0, 2]], b[[0, 2]], rtol=0, atol=0, equal_nan=True)
        assert not (a == b)[[1, 3]].any()
    assert (initial[0].isnan() != after[0].isnan())[[1, 3]].any(dim=1).all()


@pytest.mark.parametrize("nobody", [[], torch.tensor([], dtype=torch.int64), torch.zeros(4, dtype=torch.bool)])
def test_resetting_no_environment_changes_nothing(build, nobody):
    touch, other = (build(s={"noise": EVERY_KNOB, "history": 2}) for _ in range(2))
    for module in (touch, other):
        module(module.example_state(4))
    touch.reset(nobody)
    state = touch.example_state(4, seed=1)
    torch.testing.assert_close(touch(state)["s"], other(state)["s"], rtol=0, atol=0)
