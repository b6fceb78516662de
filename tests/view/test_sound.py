"""Files and spectrograms of sound."""

import numpy as np
import pytest
import soundfile

from tgdsl.view.sound import PEAK, RollingSound, Sound, draw, spectrogram, write_wav

RATE = 8000.0


def decaying(*modes):
    """Return half a second of silence, then ringing modes, each with a frequency [Hz] and a decay [1/s]."""
    time = np.arange(4000) / RATE
    ring = sum(np.exp(-decay * time) * np.sin(2 * np.pi * frequency * time) for frequency, decay in modes)
    return Sound("bell", "m/s", RATE, np.concatenate([np.zeros(4000), 0.02 * ring]))


def test_a_file_holds_the_samples_times_the_returned_gain(tmp_path):
    sound = decaying((440.0, 5.0))
    gain = write_wav(sound, tmp_path / "folder" / "bell.wav")
    samples, rate = soundfile.read(tmp_path / "folder" / "bell.wav")
    assert rate == 8000 and np.abs(samples).max() == pytest.approx(PEAK, abs=1e-4)
    np.testing.assert_allclose(samples / gain, sound.samples, atol=1.01 * 0.5**15 / gain)


def test_silence_is_silent(tmp_path):
    sound = Sound("nothing", "Pa", RATE, np.zeros(800))
    assert write_wav(sound, tmp_path / "nothing.wav") == 1.0
    assert not soundfile.read(tmp_path / "nothing.wav")[0].any()
    assert (spectrogram(sound).level == -np.inf).all()
    assert draw([sound], tmp_path / "nothing.png").stat().st_size > 1000


def test_a_spectrogram_has_modes_at_their_frequencies_and_decay_rates():
    """The level of a mode's row falls by 20 d/ln 10 dB a second after the impact; before, there is silence."""
    modes = ((600.0, 12.0), (1500.0, 40.0))
    result = spectrogram(decaying(*modes))
    late = result.time > 0.52
    for frequency, decay in modes:
        row = int(np.abs(result.frequency - frequency).argmin())
        assert result.frequency[row] == frequency
        assert result.level[row, late][0] > result.level[row + 3, late][0] + 20
        early = late & (result.time < 0.6)
        slope = np.polyfit(result.time[early], result.level[row, early], 1)[0]
        assert slope == pytest.approx(-20 * decay / np.log(10), rel=0.03)
    assert (result.level[:, result.time < 0.48] == -np.inf).all()


def test_a_sound_shorter_than_a_window_has_one_window(tmp_path):
    sound = Sound("click", "Pa", RATE, np.array([0.0, 1.0, 0.0]))
    assert spectrogram(sound).level.shape[1] == 1
    draw([sound, decaying((440.0, 5.0))], tmp_path / "two.png", "two", {"bell": [440.0]})
    assert (tmp_path / "two.png").stat().st_size > 1000


def test_a_rolling_sound_keeps_its_last_seconds_and_restarts_after_a_gap():
    rate, step, frequency = 8000.0, 0.01, 1000.0
    rolling = RollingSound("hum", "m/s", 0.5)
    num = round(rate * step)
    for i in range(200):
        time = (i * num + np.arange(num)) / rate
        rolling.add(np.sin(2 * np.pi * frequency * time), (i + 1) * step, step)
    assert len(rolling.sound.samples) == 0.5 * rate
    image = rolling.image(64, 50).astype(int).sum(axis=2)
    assert abs(image[:, 25].argmax() - 64 * (1 - frequency / (rate / 2))) <= 1  # the bright row: 1 kHz of 4, from below
    rolling.add(np.zeros(num), 5.0, step)
    assert len(rolling.sound.samples) == num
    quiet = rolling.image(64, 50)
    assert (quiet == quiet[0, 0]).all()
