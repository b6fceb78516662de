"""Contact audio in documents, and its mistakes: their places, names and corrections."""

import dataclasses

import numpy as np
import pytest
import torch
from oracles.setups.sounds import MODES, plate, plate_document, pressed

import tgdsl
from tgdsl.errors import SimulationError, SpecError
from tgdsl.modal import analysis
from tgdsl.modal.modes import Modes

HIGH = [{"frequency": 30000.0, "decay": 10.0}, {"frequency": 40000.0, "decay": 10.0}]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"modes": HIGH},
            'sensors.s.samples: the lowest mode of "plate" is at 30000 Hz, and 16 samples of a step of 0.001 s hold 7200 Hz; '
            "it needs `samples: 67`",
        ),
        ({"bodies": {"lid": MODES}}, 'sensors.s.bodies: `bodies`: no link of the sensor matches "lid"; it has plate'),
        ({"scale": "decibel"}, "`scale` has no effect without `outputs: bands`; remove it"),
        ({"modes": []}, "sensors.s.modes: found a list of 0, expected at least 1 entry"),
        ({"modes": [{"frequency": 100, "decay": 0}]}, "0 is out of range, expected more than 0"),
        ({"modes": [{"frequency": "100 kg", "decay": 1}]}, '"kg" is not a unit of frequency'),
        ({"modes": "stel"}, 'did you mean "steel"?'),
        ({"settling": 0}, "0 is out of range, expected more than 0"),
        ({"rate": 100}, "this sensor reads a block of samples at each call; leave `rate` out"),
        ({"history": 3}, "this sensor reads a block of samples at each call; leave `history` out"),
        ({"noise": {"white_noise": 1e-3}}, '"contact_audio" has no knob "white_noise"'),
    ],
)
def test_mistakes_name_their_place(tmp_path, given, message):
    with pytest.raises(SpecError) as caught:
        plate(tmp_path, **given)
    assert message in str(caught.value)


def test_the_suggested_number_of_samples_suffices(tmp_path):
    with pytest.warns(UserWarning, match="plate: a mode is left out, 40000 Hz: the sample rate is 67000 Hz"):
        touch = plate(tmp_path, modes=HIGH, samples=67)
    assert touch.outputs[0].shape == (67, 1, 1)
    with pytest.raises(SpecError, match="samples: 67"):
        plate(tmp_path, modes=HIGH, samples=66)


def test_inaudible_modes_are_dropped_by_name(tmp_path):
    """A warning and `explain` name them; the sound comes from the others."""
    with pytest.warns(UserWarning, match="contact audio of plate: a mode is left out, 2903 Hz: the sample rate is 6000 Hz"):
        touch = plate(tmp_path, samples=6, scrape=0)
    fewer = plate(tmp_path, samples=6, scrape=0, modes=MODES[:2])
    assert "plate: a mode is left out, 2903 Hz" in touch.explain()
    assert "6 samples per step of 0.001 s: 6000 Hz" in touch.explain()
    for force in (0.0, 2.0, 0.0, 0.0):
        state = pressed(touch, [force])
        torch.testing.assert_close(touch(state)["s"], fewer(state)["s"], rtol=0, atol=0)


def test_the_loudest_modes_have_the_most_energy(tmp_path):
    """As if only they were listed: g²/4d is 1, 2, 0.9 and 0.25 · 10⁻³ s/kg²."""
    listed = [
        {"frequency": 300.0, "decay": 250.0, "gain": 1.0},
        {"frequency": 500.0, "decay": 500.0, "gain": -2.0},
        {"frequency": 800.0, "decay": 25.0, "gain": 0.3},
        {"frequency": 1300.0, "decay": 1000.0, "gain": 1.0},
    ]
    energy = [mode["gain"] ** 2 / (4 * mode["decay"]) for mode in listed]
    for count in (1, 2, 3):
        indices = sorted(sorted(range(4), key=lambda i: -energy[i])[:count])
        few = plate(tmp_path, modes=listed, loudest=count, scrape=0)
        alone = plate(tmp_path, modes=[listed[i] for i in indices], scrape=0)
        for force in (0.0, 2.0, 0.0, 0.0):
            state = pressed(few, [force])
            torch.testing.assert_close(few(state)["s"], alone(state)["s"], rtol=0, atol=0)


def test_bands_do_not_depend_on_dropped_modes(tmp_path):
    """Bands of modes that are not computed remain, silent."""
    every, one = (plate(tmp_path, outputs="bands", loudest=count, scrape=0, substeps=1) for count in (None, 1))
    assert every.outputs[0].channels == one.outputs[0].channels
    for force in (0.0, 2.0, 0.0):
        state = pressed(one, [force])
        heard, few = every(state)["s"], one(state)["s"]
    is_kept = few > 0
    assert is_kept.sum() == 1 and (heard > 0).sum() == len(MODES)
    torch.testing.assert_close(few[is_kept], heard[is_kept], rtol=1e-6, atol=0)


def test_bodies_may_have_different_modes(tmp_path):
    """By name or wildcard; the first match counts."""
    modes_of_bodies = {"oth*": MODES[:1], "*": MODES[1:]}
    touch = plate(tmp_path, links=["plate", "other"], bodies=modes_of_bodies)
    frequency = touch.plan.sensors[0].constants["frequency"]
    np.testing.assert_array_equal(frequency, [[1171.0, 2903.0], [523.0, 0.0]])


@pytest.mark.parametrize("of", ["link", "object"])
def test_a_shape_is_analysed_in_its_bodys_frame(tmp_path, monkeypatch, of):
    """Modal analysis gets the surface of the ringing body and the highest audible frequency."""
    calls = []

    def analysed(name, surface, given, below, progress):
        calls.append((name, np.ptp(surface.vertices, axis=0).round(6).tolist(), given.material.name, below))
        return Modes(np.array([700.0]), np.array([3.0]), np.array([1.0]))

    monkeypatch.setattr(analysis, "analysed", analysed)
    touch = plate(tmp_path, modes="steel", of=of)
    assert touch.plan.sensors[0].constants["frequency"].tolist() == [[700.0]]
    size = [0.2, 0.2, 0.01] if of == "link" else [0.02, 0.02, 0.02]
    assert calls == [("plate" if of == "link" else "ball", size, "steel", pytest.approx(7200.0))]


def test_the_time_step_defaults_to_the_scenes(tmp_path):
    scene, custom = plate(tmp_path), plate(tmp_path, timestep="4 ms", samples=32)
    assert (scene.inputs.dt, custom.inputs.dt) == (0.001, 0.004)
    assert (scene.example_state(1).dt, custom.example_state(1).dt) == (0.001, 0.004)


def test_a_simulation_with_other_substeps_is_refused_or_warned_about(tmp_path):
    touch = plate(tmp_path, substeps=5)
    with pytest.raises(SimulationError, match="simulate with substeps=5"):
        tgdsl.simulate(touch, 1, substeps=2).step()
    once = plate(tmp_path)
    sim = tgdsl.simulate(once, 1, substeps=4)
    sim.step()
    with pytest.warns(UserWarning, match=r'"s" is compiled for 1 steps of 0.001 s per call, and the state\'s dt is 0.004 s'):
        once(sim.state())


def test_a_loaded_artefact_sounds_the_same(tmp_path):
    touch = plate(tmp_path)
    tgdsl.save(touch, tmp_path / "plate.safetensors")
    again = tgdsl.load(tmp_path / "plate.safetensors", dtype=torch.float64)
    for force in (0.0, 3.0, 1.0, 0.0):
        state = pressed(touch, [force, 2 * force], 0.2)
        assert torch.equal(touch(state)["s"], again(state)["s"])


def test_some_environments_can_be_read_alone(tmp_path):
    """A mask reads and strikes only its environments; the others stay where they were."""
    touch, whole = plate(tmp_path), plate(tmp_path)
    states = [pressed(touch, [force] * 3, 0.2) for force in (0.0, 3.0, 1.0, 0.5)]
    for state in states[:2]:
        touch(state), whole(state)
    previous = touch(states[2])["s"].clone()
    mask = torch.tensor([False, True, False])
    some = touch(states[3], mask=mask)["s"]
    whole(states[2])
    expected = whole(states[3])["s"]
    assert torch.equal(some[[0, 2]], previous[[0, 2]])
    torch.testing.assert_close(some[1], expected[1], rtol=0, atol=1e-15)


def test_a_policy_observes_bands(tmp_path):
    document = plate_document(tmp_path, outputs="bands", scale="decibel", substeps=2)
    document["observations"] = {"policy": [{"type": "reading", "of": "s"}]}
    touch = tgdsl.compile(document)
    state = touch.example_state(3)
    assert touch.observe(touch(state))["policy"].shape == (3, 2 * len(touch.outputs[0].channels))


def test_objects_that_share_a_body_strike_a_link_once(tmp_path):
    """Two objects of one body exert one force on the link."""
    document = plate_document(tmp_path, scrape=0)
    document["objects"]["same"] = {"body": "ball"}
    document["sensors"]["s"]["feels"] = ["ball", "same"]
    both, one = tgdsl.compile(document, dtype=torch.float64), plate(tmp_path, scrape=0)
    heard = []
    for touch in (one, both):
        states = [pressed(touch, [force]) for force in (0.0, 3.0, 0.0)]
        for i, state in enumerate(states):
            fields = {
                name: getattr(state, name)[:, :1].expand(-1, len(touch.inputs.pairs), *[-1] * rest)
                for name, rest in (
                    ("contact_force", 2),
                    ("contact_normal", 2),
                    ("contact_pos", 2),
                    ("contact_netforce", 1),
                    ("contact_found", 0),
                )
            }
            states[i] = dataclasses.replace(state, **fields)
        heard.append([touch(state)["s"] for state in states][-1])
    torch.testing.assert_close(heard[1], heard[0], rtol=0, atol=1e-15)
