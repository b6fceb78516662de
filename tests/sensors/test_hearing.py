"""Microphone readings of sources at rest and in motion, against closed forms, in a simulation."""

import numpy as np
import pytest
import torch
from oracles.setups.listening import RATE, SCENE, TONE, heard, listening

import tgdsl
from tgdsl.errors import SpecError


@pytest.fixture
def build(tmp_path):
    def compiled(mic=None, tone=None, dtype="float64", **sensors):
        return listening(tmp_path, mic, tone, dtype, **sensors)

    return compiled


def test_a_passing_source_is_heard_without_a_jump(build):
    """At 30 m/s and 30 cm successive samples of a low tone differ no more than its slope and level allow."""
    touch = build(tone={"frequency": 200.0})
    samples = heard(touch, 200, source=(-3.0, 0.3, 0), speeds=(30.0, 0.0))
    assert np.abs(np.diff(samples)).max() < 1.3 * (2 * np.pi * 200.0 * 1.1 / RATE) / 0.3


def test_blocks_of_substeps_equal_single_steps(build):
    samples = []
    for substeps in (1, 4):
        touch = build(tone={"substeps": substeps})
        sim = tgdsl.simulate(touch, 1, substeps=substeps)
        sim.qpos[0, 0], sim.qvel[0, 0], sim.qvel[0, 6] = 0.7, 9.0, -4.0
        sim.forward()
        blocks = [touch(sim.state())["mic"]]
        for _ in range(40 // substeps):
            sim.step()
            blocks.append(touch(sim.state())["mic"])
        samples.append(torch.cat(blocks[1:], dim=1)[0, :, 0, 0].numpy())
    assert np.abs(samples[0]).max() > 1
    np.testing.assert_allclose(samples[1], samples[0], atol=1e-12)


def test_a_reset_drops_sound_on_its_way(build):
    touch = build()
    sim = tgdsl.simulate(touch, 3)
    for _ in range(30):
        sim.qpos[:, 0] = 2.0
        sim.step()
        previous = touch(sim.state())["mic"]
    sim.reset([1], qpos=sim.qpos[[1]])
    state = sim.state()
    after = touch(state, env_ids=[1])["mic"]
    assert torch.equal(after[[0, 2]], previous[[0, 2]]) and previous.abs().amin(dim=0).max() > 0
    assert (after[1] == 0).all()
    sim.step()
    after = touch(sim.state())["mic"]
    assert (after[1] == 0).all() and (after[[0, 2]].abs().amax(dim=1) > 0.1).all()


def test_a_source_beyond_reach_is_silent_and_warned_about_once(build):
    touch = build({"reach": 2.0})
    with pytest.warns(UserWarning, match=r'"mic" does not hear tone\[0\]: it was farther than `reach`, 2 m') as caught:
        samples = heard(touch, 30, source=(2.5, 0, 0))
    assert (samples == 0).all() and len(caught) == 1
    touch.free()
    assert np.abs(heard(touch, 30, source=(1.9, 0, 0))).max() > 0.4


def test_a_jump_without_a_reset_has_no_lasting_effect(build):
    """A body put elsewhere is faster than sound for a step: samples stay finite, and are right afterwards."""
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
    """A kilometre from the origin: samples match float64's, within the resolution of a float32 clock."""
    samples = [
        heard(
            build(dtype=dtype, tone={"frequency": 200.0}),
            200,
            source=(1000.0, 0, 0),
            listener=(1001.3, 0.2, 0),
            speeds=(2.0, 0.0),
        )[-400:]
        for dtype in ("float64", "float32")
    ]
    assert np.abs(samples[0]).max() > 0.5
    np.testing.assert_allclose(samples[1], samples[0], atol=5e-4)


@pytest.mark.parametrize(
    ("mic", "message"),
    [
        ({"hears": ["knock"]}, r'sensors\.mic\.hears\[0\]: unknown sensor "knock"'),
        ({"hears": ["tone", "tone"]}, r'sensors\.mic\.hears\[1\]: sensor "tone" is listed twice'),
        (
            {"hears": ["mic"]},
            r'sensors\.mic\.hears\[0\]: "mic" \(microphone\) makes no sound, as it is written; sensors that do: tone',
        ),
        ({"levels": {"ton": 2.0}}, r'sensors\.mic\.levels: it does not hear "ton"; did you mean "tone"'),
        ({"body": "c"}, r'sensors\.mic\.body: the scene has no body "c"'),
        ({"body": None}, r"expected `pos`, in the world, or `body`, or both"),
        ({"nearest": 12.0}, r"nearest 12 m is not below reach 10 m"),
        ({"history": 3}, r"sensors\.mic\.history: this sensor reads a block of samples"),
    ],
)
def test_mistakes_name_their_place(build, mic, message):
    with pytest.raises(SpecError, match=message):
        build(mic)


def test_sources_need_one_rate(build):
    other = {"kind": "tone", "links": "b", "samples": 10}
    with pytest.raises(SpecError, match=r'sensors\.mic\.hears: "other" makes 10 samples per physics step, "tone" 20'):
        build(other=other)


def test_a_microphone_without_sources_is_a_mistake(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    sensors = {"mic": {"kind": "microphone", "pos": [0, 0, 0]}}
    with pytest.raises(SpecError, match=r"sensors\.mic: no sensor of the document makes sound"):
        tgdsl.compile({"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors})


def test_a_selected_microphone_brings_its_sources(tmp_path, build):
    (tmp_path / "scene.xml").write_text(SCENE)
    tones = {name: {"kind": "tone", "links": link} for name, link in (("one", "a"), ("two", "b"))}
    sensors = {"mic": {"kind": "microphone", "body": "b", "hears": ["two"]}, **tones}
    document = {"tgdsl": 1, "robot": {"model": str(tmp_path / "scene.xml")}, "sensors": sensors}
    touch = tgdsl.compile(document, kinds=[TONE], sensors=["mic"])
    assert [output.name for output in touch.outputs] == ["mic", "two"]
