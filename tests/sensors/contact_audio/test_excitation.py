"""Excitation: impulses of collisions over any number of steps, and the noise of sliding."""

import math

import numpy as np
import pytest
import torch
from oracles.setups.sounds import STEP, half_sine, plate, pressed, sound, struck
from oracles.sound import RUBS

MODE = [{"frequency": 1000.0, "decay": 10.0, "gain": 1.0}]


def test_twice_the_force_sounds_twice_as_loud(tmp_path):
    one, two = (sound(plate(tmp_path, scrape=0), np.array(half_sine(0.003, STEP, rest=0.01)) * k) for k in (1, 2))
    np.testing.assert_allclose(two, 2 * one, rtol=0, atol=1e-12 * abs(one).max())


def test_a_steady_load_makes_no_sound(tmp_path):
    """Neither a load present from the start, nor a settled one, nor its release."""
    signal = sound(plate(tmp_path, scrape=0), [5.0, *[5.0] * 20, *[0.0] * 20])
    assert not signal.any()


def test_a_slow_load_hardly_sounds(tmp_path):
    """A load that rises for 0.15 s strikes once it stops rising, with R τ²; a blow ΔF of one step would strike with ΔF Δt."""
    rate = 200.0
    loads = np.minimum(np.arange(200) * STEP, 0.15) * rate
    impulse, last = struck(plate(tmp_path, modes=MODE, scrape=0), loads, MODE[0]["decay"])
    assert impulse == pytest.approx(rate * 0.02**2, rel=0.1)
    assert 150 <= last <= 153


def test_successive_collisions_are_heard_separately(tmp_path):
    """A bouncing ball: two blows 30 ms apart, on a plate under another, constant load."""
    touch = plate(tmp_path, modes=MODE, samples=16, scrape=0)
    forces = np.full(80, 2.0)
    forces[10] += 8.0
    forces[40] += 4.0
    signal = sound(touch, forces)[0]
    time = np.arange(1, len(signal) + 1) * STEP / 16
    waves = [
        j * np.exp(-10 * np.maximum(time - t, 0)) * np.sin(2000 * math.pi * (time - t)) * (time >= t)
        for j, t in ((8e-3, 11e-3), (4e-3, 41e-3))
    ]
    np.testing.assert_allclose(signal, sum(waves), rtol=0, atol=1e-12)


def test_ten_times_the_force_or_the_speed_scrapes_ten_decibels_louder(tmp_path):
    """The noise is the same; `oracles.sound.scraping` compares its level."""
    touch = [plate(tmp_path, modes=MODE, scrape=1e-3) for _ in RUBS]
    heard = [sound(each, np.full((5, 4), force), speed) for each, (force, speed) in zip(touch, RUBS, strict=True)]
    level = [10 * np.log10((each**2).mean()) for each in heard]
    np.testing.assert_allclose(np.array(level[1:]) - level[0], 10, atol=1e-9)


def test_scraping_has_the_spectrum_of_the_modes(tmp_path):
    """The noise is white: a low and a high mode of the same decay and gain are equally loud."""
    modes = [{"frequency": f, "decay": 300.0, "gain": 1.0} for f in (400.0, 4100.0)]
    touch = plate(tmp_path, modes=modes, samples=10, scrape=1e-3)
    heard = sound(touch, np.full((90, 400), 1.0), 0.5)[:, 300:]
    spectrum = (np.abs(np.fft.rfft(heard * np.hanning(heard.shape[1]), axis=1)) ** 2).mean(axis=0)
    frequency = np.fft.rfftfreq(heard.shape[1], STEP / 10)
    low, high = (spectrum[abs(frequency - mode["frequency"]) < 150].sum() for mode in modes)
    assert 0.85 < low / high < 1.18


def test_scraping_differs_between_environments_whatever_their_number(tmp_path):
    """Random numbers are counted: they do not depend on the number of environments, and a seed repeats them."""
    force = np.full((5, 4), 2.0)
    four, two, again, other = (
        sound(plate(tmp_path).seed(seed), force[:, :count], 0.3) for seed, count in ((7, 4), (7, 2), (7, 4), (8, 4))
    )
    np.testing.assert_array_equal(four, again)
    np.testing.assert_allclose(four[:2], two, rtol=0, atol=1e-15)
    correlation = np.corrcoef(np.concatenate([four, other]))
    assert abs(correlation - np.eye(8)).max() < 0.9


def test_only_the_struck_link_or_object_sounds(tmp_path):
    """The other plate is silent; with `of: object` the ball rings, whichever plate it strikes."""
    touch = plate(tmp_path, links=["plate", "other"], modes=MODE, scrape=0)
    heard = torch.cat([touch(pressed(touch, [f]))["s"] for f in (0.0, 3.0, 0.0)], dim=1)[0, :, :, 0]
    assert touch.rows["s"]["body"].tolist() == ["plate", "other"]
    assert heard[:, 0].any() and not heard[:, 1].any()
    rung = plate(tmp_path, of="object", links=["plate", "other"], modes=MODE, scrape=0)
    again = torch.cat([rung(pressed(rung, [f]))["s"] for f in (0.0, 3.0, 0.0)], dim=1)[0, :, :, 0]
    assert rung.rows["s"]["object"].tolist() == ["ball"]
    torch.testing.assert_close(again[:, 0], heard[:, 0], rtol=0, atol=0)
