"""What a microphone hears of sources at rest and in motion, against closed forms, in a simulation."""

import numpy as np
import pytest
import torch

import tgdsl
from tests.helpers.tone import TONE
from tgdsl.errors import SpecError

SCENE = """<mujoco><option timestep=".001" gravity="0 0 0"/><worldbody>
  <body name="a"><freejoint/><geom size=".01"/></body>
  <body name="b"><freejoint/><geom size=".01"/></body>
</worldbody></mujoco>"""
RATE, SPEED = 20000.0, 343.0


@pytest.fixture
def build(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)

    def compiled(mic=None, tone=None, dtype="float64", **sensors):
        document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}}
        tone = {"kind": "tone", "links": "a", "samples": 20, "frequency": 3000.0, **(tone or {})}
        document["sensors"] = {"mic": {"kind": "microphone", "body": "b", **(mic or {})}, "tone": tone, **sensors}
        return tgdsl.compile(document, kinds=[TONE], dtype=dtype)

    return compiled


def heard(touch, steps, source=(0.0, 0, 0), listener=(0.0, 0, 0), speeds=(0.0, 0.0), names=("mic",)):
    """Return all samples of some sensors, bodies moving along x from where they begin [m, m/s].

    Of several environments, whose source, listener or speeds are lists, (env, sample, row); of one (sample, row), and of a
    microphone alone (sample,).
    """
    source, listener, speeds = (np.atleast_2d(np.asarray(value, dtype=np.float64)) for value in (source, listener, speeds))
    num = max(len(source), len(listener), len(speeds))
    sim = tgdsl.simulate(touch, num)
    sim.qpos[:, :3], sim.qpos[:, 7:10] = torch.from_numpy(source), torch.from_numpy(listener)
    sim.qvel[:, [0, 6]] = torch.from_numpy(np.broadcast_to(speeds, (num, 2)).copy())
    sim.forward()
    blocks = {name: [] for name in names}
    for _ in range(steps):
        sim.step()
        readings = touch(sim.state())
        for name in names:
            blocks[name].append(readings[name][:, :, :, 0])
    found = [torch.cat(blocks[name], dim=1).double().numpy() for name in names]
    found = [own if num > 1 else own[0] for own in found]
    return found if len(found) > 1 else found[0][..., 0]


def frequency_of(samples):
    """Return the frequency of a tone [Hz], by the peak of its windowed spectrum."""
    spectrum = np.abs(np.fft.rfft(samples / np.abs(samples).max() * np.hanning(len(samples)), 1 << 20))
    k = int(spectrum.argmax())
    left, top, right = np.log(spectrum[k - 1 : k + 2])
    return (k + 0.5 * (left - right) / (left - 2 * top + right)) * RATE / (1 << 20)


def away(distances):
    """Return places at some distances along x [m]."""
    return np.outer(distances, [1.0, 0, 0])


@pytest.mark.parametrize("falloff", [1.0, 2.0, 0.5])
def test_level_is_that_of_the_inverse_law(build, falloff):
    """To 1e-3, from 25 cm to 8 m: the amplitude of a tone is 1/r^p."""
    distances = np.array([0.25, 0.5, 1.0, 2.7, 8.0])
    samples = heard(build({"falloff": falloff}), 50, source=away(distances))[:, -400:]
    amplitude = np.sqrt(2 * np.mean(samples**2, axis=1))  # over 60 periods
    np.testing.assert_allclose(amplitude, distances**-falloff, rtol=1e-3)


def test_nearer_than_nearest_it_gets_no_louder(build):
    touch = build({"nearest": 0.4})
    samples = heard(touch, 40, source=(0.25, 0, 0))[-400:]
    assert np.sqrt(2 * np.mean(samples**2)) == pytest.approx(1 / 0.4, rel=1e-3)


@pytest.mark.parametrize("frequency", [400.0, 3000.0, 7000.0])
def test_delay_is_that_of_the_distance(build, frequency):
    """To 1/20 of a sample: the phase of a tone is that of r/c, at distances of no whole number of samples."""
    distances = np.array([0.31, 0.5, 1.3333, 4.021])
    samples = heard(build(tone={"frequency": frequency}), 60, source=away(distances))
    # The first call of an episode is at its start; the tone is 0 up to then.
    late = ((np.arange(samples.shape[1]) + 1) / RATE - 1 / 1000)[-800:]
    basis = np.stack([np.sin(2 * np.pi * frequency * late), np.cos(2 * np.pi * frequency * late)], axis=1)
    along, across = np.linalg.lstsq(basis, samples[:, -800:].T, rcond=None)[0]
    phase = np.angle(np.exp(1j * (np.arctan2(-across, along) - 2 * np.pi * frequency * distances / SPEED)))
    assert (np.abs(phase / (2 * np.pi * frequency) * RATE) < 1 / 20).all()


def test_a_pulse_arrives_when_sound_does(build):
    """The centre of a band-limited pulse is r/c after it, to 1/20 of a sample, and nothing is heard long before."""
    distances = np.array([0.25, 0.777, 3.2])
    every, made = heard(build(tone={"pulse": 7}), 40, source=away(distances), names=("mic", "tone"))
    emitted = int(np.flatnonzero(made[0, :, 0])[0])
    for samples, distance in zip(every[..., 0], distances, strict=True):
        spectrum = np.fft.rfft(np.roll(samples, -emitted))
        omega = 2 * np.pi * np.arange(len(spectrum)) / len(samples)
        low = slice(1, int(0.3 * len(samples)))
        delay = -np.polyfit(omega[low], np.unwrap(np.angle(spectrum[low])), 1)[0]
        assert delay == pytest.approx(distance / SPEED * RATE, abs=1 / 20)
        assert np.abs(samples[: emitted + int(distance / SPEED * RATE) - 12]).max() == 0


def test_doppler_shift(build):
    """f′ − f to 1 %: f/(1 + v/c) of a source that moves away with v, f (1 − v/c) of a microphone that does."""
    speeds = np.array([-30.0, -10.0, 10.0, 30.0])
    both = np.concatenate([np.outer(speeds, [1, 0]), np.outer(speeds, [0, -1])])
    begun = away(np.tile(np.where(speeds > 0, 1.0, 9.0), 2))
    samples = heard(build({"reach": 15.0}), 160, source=begun, speeds=both)[:, -2400:]
    expected = np.concatenate([3000.0 / (1 + speeds / SPEED), 3000.0 * (1 - speeds / SPEED)])
    found = np.array([frequency_of(own) for own in samples])
    np.testing.assert_allclose(found - 3000.0, expected - 3000.0, rtol=0.01)


def test_of_both_in_motion_the_shift_is_the_product(build):
    samples = heard(build(), 160, source=(1.0, 0, 0), speeds=(20.0, -15.0))[-2400:]
    assert frequency_of(samples) == pytest.approx(3000.0 * (1 - 15 / SPEED) / (1 + 20 / SPEED), abs=0.5)


def test_a_source_that_flies_by_is_heard_without_a_jump(build):
    """At 30 m/s and 30 cm: successive samples of a low tone differ by no more than its slope and level allow."""
    touch = build(tone={"frequency": 200.0})
    samples = heard(touch, 200, source=(-3.0, 0.3, 0), speeds=(30.0, 0.0))
    assert np.abs(np.diff(samples)).max() < 1.3 * (2 * np.pi * 200.0 * 1.1 / RATE) / 0.3


def test_sounds_add_up(build):
    """Two sensors, one of two rows: what is heard of all is the sum of what is heard of each."""
    other = {"kind": "tone", "links": ["a", "b"], "samples": 20, "frequency": 900.0}
    mics = {name: {"kind": "microphone", "pos": [0.5, 1, 0], "hears": [name]} for name in ("tone", "other")}
    touch = build({"pos": [0.5, 1, 0], "body": None, "levels": {"other": 0.5}}, other=other, m1=mics["tone"], m2=mics["other"])
    every, one, two = heard(touch, 30, source=(1.0, 0, 0), names=("mic", "m1", "m2"))
    assert np.abs(one).max() > 0.1 and np.abs(two).max() > 0.1
    np.testing.assert_allclose(every, one + 0.5 * two, atol=1e-12)


def test_blocks_of_substeps_are_those_of_single_steps(build):
    found = []
    for substeps in (1, 4):
        touch = build(tone={"substeps": substeps})
        sim = tgdsl.simulate(touch, 1, substeps=substeps)
        sim.qpos[0, 0], sim.qvel[0, 0], sim.qvel[0, 6] = 0.7, 9.0, -4.0
        sim.forward()
        blocks = [touch(sim.state())["mic"]]
        for _ in range(40 // substeps):
            sim.step()
            blocks.append(touch(sim.state())["mic"])
        found.append(torch.cat(blocks[1:], dim=1)[0, :, 0, 0].numpy())
    assert np.abs(found[0]).max() > 1
    np.testing.assert_allclose(found[1], found[0], atol=1e-12)


def test_after_a_reset_what_was_on_its_way_is_gone(build):
    touch = build()
    sim = tgdsl.simulate(touch, 3)
    for _ in range(30):
        sim.qpos[:, 0] = 2.0
        sim.step()
        before = touch(sim.state())["mic"]
    sim.reset([1], qpos=sim.qpos[[1]])
    state = sim.state()
    after = touch(state, env_ids=[1])["mic"]
    assert torch.equal(after[[0, 2]], before[[0, 2]]) and before.abs().amin(dim=0).max() > 0
    assert (after[1] == 0).all()
    sim.step()
    after = touch(sim.state())["mic"]
    assert (after[1] == 0).all() and (after[[0, 2]].abs().amax(dim=1) > 0.1).all()


def test_what_is_beyond_reach_is_not_heard_and_warned_of_once(build):
    touch = build({"reach": 2.0})
    with pytest.warns(UserWarning, match=r'"mic" does not hear tone\[0\]: it was farther than `reach`, 2 m') as said:
        samples = heard(touch, 30, source=(2.5, 0, 0))
    assert (samples == 0).all() and len(said) == 1
    touch.free()
    assert np.abs(heard(touch, 30, source=(1.9, 0, 0))).max() > 0.4


def test_a_jump_without_a_reset_is_heard_as_one_and_nothing_lasts(build):
    """A body that is put elsewhere is faster than sound for a step: what is heard stays finite, and is right afterwards."""
    touch = build()
    sim = tgdsl.simulate(touch, 1)
    sim.qpos[0, 0] = 1.0
    for k in range(90):
        if k == 40:
            sim.qpos[0, 0] = 4.0
        sim.step()
        samples = touch(sim.state())["mic"][0, :, 0, 0]
        assert torch.isfinite(samples).all()
    assert samples.square().mean().mul(2).sqrt() == pytest.approx(0.25, rel=1e-2)


def test_single_precision_hears_the_same_for_long(build):
    """A kilometre from the origin: samples as the float64 module has them, to what the time of a float32 clock is worth."""
    found = [
        heard(
            build(dtype=dtype, tone={"frequency": 200.0}),
            200,
            source=(1000.0, 0, 0),
            listener=(1001.3, 0.2, 0),
            speeds=(2.0, 0.0),
        )[-400:]
        for dtype in ("float64", "float32")
    ]
    assert np.abs(found[0]).max() > 0.5
    np.testing.assert_allclose(found[1], found[0], atol=5e-4)


@pytest.mark.parametrize(
    ("mic", "message"),
    [
        ({"hears": ["knock"]}, r'sensors\.mic\.hears\[0\]: unknown sensor "knock"'),
        ({"hears": ["tone", "tone"]}, r'sensors\.mic\.hears\[1\]: sensor "tone" is listed twice'),
        (
            {"hears": ["mic"]},
            r'sensors\.mic\.hears\[0\]: "mic" \(microphone\) makes no sound, as it is written; those that do: tone',
        ),
        ({"levels": {"ton": 2.0}}, r'sensors\.mic\.levels: it does not hear "ton"; did you mean "tone"'),
        ({"body": "c"}, r'sensors\.mic\.body: the scene has no body "c"'),
        ({"body": None}, r"expected `pos`, in the world, or `body`, or both"),
        ({"nearest": 12.0}, r"nearest 12 m is not below reach 10 m"),
        ({"history": 3}, r"sensors\.mic\.history: this sensor reads a block of samples"),
    ],
)
def test_mistakes_are_located(build, mic, message):
    with pytest.raises(SpecError, match=message):
        build(mic)


def test_sources_are_of_one_rate(build):
    other = {"kind": "tone", "links": "b", "samples": 10}
    with pytest.raises(SpecError, match=r'sensors\.mic\.hears: "other" makes 10 samples per physics step, "tone" 20'):
        build(other=other)


def test_without_sources_there_is_nothing_to_hear(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    sensors = {"mic": {"kind": "microphone", "pos": [0, 0, 0]}}
    with pytest.raises(SpecError, match=r"sensors\.mic: no sensor of the document makes sound"):
        tgdsl.compile({"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors})


def test_a_chosen_microphone_brings_what_it_hears(tmp_path, build):
    (tmp_path / "scene.xml").write_text(SCENE)
    tones = {name: {"kind": "tone", "links": link} for name, link in (("one", "a"), ("two", "b"))}
    sensors = {"mic": {"kind": "microphone", "body": "b", "hears": ["two"]}, **tones}
    document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors}
    touch = tgdsl.compile(document, kinds=[TONE], sensors=["mic"])
    assert [output.name for output in touch.outputs] == ["mic", "two"]
