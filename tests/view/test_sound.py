"""Files and spectrograms of sound."""

import numpy as np
import pytest
import soundfile

from tgdsl.view.sound import PEAK, RANGE, RollingSound, Sound, draw, spectrogram, write_wav

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


def test_a_picture_has_a_spectrogram_for_each_sound_and_marks(monkeypatch, tmp_path):
    figures = []
    monkeypatch.setattr("tgdsl.view.sound.save_figure", lambda figure, path: figures.append(figure))
    draw([decaying((440.0, 5.0)), Sound("nothing", "Pa", RATE, np.zeros(8000))], tmp_path / "x.png", "two", {"bell": [440.0]})
    (figure,) = figures
    bell, nothing, bar = figure.axes
    assert figure.get_suptitle() == "two"
    assert (bell.get_ylabel(), nothing.get_ylabel()) == ("bell\n[kHz]", "nothing\n[kHz]")
    assert (bell.get_xlabel(), nothing.get_xlabel()) == ("", "time [s]") and bell.get_xlim() == (0, 1)
    (image,), (mark,) = bell.collections, bell.lines
    level, places = image.get_array(), image.get_coordinates()
    row, column = np.unravel_index(level.argmax(), level.shape)
    assert places[row, 0, 1] <= 0.44 <= places[row + 1, 0, 1]
    assert 0.48 < places[0, column, 0] < 0.52  # half a second of silence comes first
    assert mark.get_ydata() == [0.44] and not nothing.lines
    assert (nothing.collections[0].get_array() == -RANGE).all()
    assert bar.get_ylabel() == "power, of the loudest [dB]" and bar.get_ylim() == (-RANGE, 0)


def test_a_rolling_sound_keeps_its_last_seconds_and_restarts_after_a_gap():
    rate, step, frequency = 8000.0, 0.01, 1000.0
    rolling = RollingSound("hum", "m/s", 0.5)
    num = round(rate * step)
    for i in range(200):
        time = (i * num + np.arange(num)) / rate
        rolling.add(np.sin(2 * np.pi * frequency * time), (i + 1) * step, step)
        if i == 24:  # half of the time that it keeps
            loud = rolling.image(64, 50).astype(int).sum(axis=2).max(axis=0)
            assert (loud[:24] == loud[0]).all() and loud[26:].min() > 2 * loud[0]
    assert len(rolling.sound.samples) == 0.5 * rate
    image = rolling.image(64, 50).astype(int).sum(axis=2)
    assert abs(image[:, 25].argmax() - 64 * (1 - frequency / (rate / 2))) <= 1  # the bright row: 1 kHz of 4, from below
    rolling.add(np.zeros(num), 5.0, step)
    assert len(rolling.sound.samples) == num
    quiet = rolling.image(64, 50)
    assert (quiet == quiet[0, 0]).all()
