"""Gains at the contact point: which modes of a square plate are struck where, and how the impulse is passed on."""

import re

import numpy as np
import pytest
import torch
from oracles.setups.solids import box, surface_of
from oracles.setups.sounds import STEP, plate, plate_document, pressed
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.fields.materials import MATERIALS
from tgdsl.modal import analysis as spectra
from tgdsl.modal.analysis import analysed
from tgdsl.modal.modes import ShapeModes
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

GIVEN = {"modes": {"material": "steel", "count": 4}, "gains": "contact", "samples": 32}
PLACES = np.array([[0.0, 0.0, 0.005], [0.1, 0.1, 0.005], [0.1, 0.0, 0.005], [-0.043, 0.061, 0.005]])
"""Points on the plate's upper side, in its frame [m]."""
FORCE, ALONG = 2.0, np.array([0.0, 0.0, -1.0])


@pytest.fixture(autouse=True)
def shared_cache(tmp_path_factory, monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))
    monkeypatch.setattr(spectra, "UNKNOWNS", 2500)


def pressed_state(touch: TactileModule, places: np.ndarray, force: float, speed: float = 0.0) -> SceneState:
    """Return the state of a ball that presses on the plate from above, at one place per environment."""
    state = pressed(touch, [force] * len(places), speed)
    pair, link = [entry.link for entry in touch.inputs.pairs].index("plate"), touch.inputs.bodies.index("plate")
    turn = Rotation.from_quat(state.body_quat[:, link].numpy(), scalar_first=True)
    normal = torch.from_numpy(turn.apply(np.tile(ALONG, (len(places), 1))))
    state.contact_pos[:, pair, 0] = torch.from_numpy(turn.apply(places)) + state.body_pos[:, link]
    state.contact_normal[:, pair, 0] = normal * (force > 0)
    state.contact_force[:, pair, 0] = force * normal
    state.contact_netforce[:, pair] = force * normal
    return state


def phasors_after_a_blow(touch: TactileModule, places: np.ndarray, force: float = FORCE) -> np.ndarray:
    """Return the phasors of all modes after a blow of one step: (env, row, part, mode) [N·s]."""
    for load in (0.0, force, 0.0):
        touch(pressed_state(touch, places if load else np.zeros_like(places), load))
    phasors = touch.memory.get_buffer("s:phasors").double().numpy()
    return phasors.reshape(*phasors.shape[:2], 2, -1)


def expected_phasors(touch: TactileModule, places: np.ndarray) -> np.ndarray:
    """Return the phasors by modal analysis: J s e^((−d + 2πif) Δt), as (env, 1, part, mode)."""
    options = ShapeModes.model_construct(material=MATERIALS["steel"], count=4)
    shapes = analysed("plate", surface_of(box((0.2, 0.2, 0.01))), options, 0.45 * 32 / STEP).shapes
    constants = touch.plan.sensors[0].constants
    rate = -constants["decay"][:1] + 2j * np.pi * constants["frequency"][:1]
    phasors = FORCE * STEP * shapes.share(places, np.tile(ALONG, (len(places), 1))) * np.exp(rate * STEP)
    return np.stack([phasors.real, phasors.imag], axis=1)[:, None]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_a_blow_strikes_each_mode_by_its_shape(tmp_path, dtype, tolerance):
    """The plate is free again when the impulse is passed on: it acts where the plate was struck.

    Parts of a phasor below 1e-12 N·s are flushed to zero.
    """
    touch = plate(tmp_path, dtype, **GIVEN, scrape=0)
    phasors, expected = phasors_after_a_blow(touch, PLACES), expected_phasors(touch, PLACES)
    np.testing.assert_allclose(phasors, expected, rtol=0, atol=tolerance * np.abs(expected).max() + 1e-12)


def test_a_force_drives_each_mode_by_its_shape(tmp_path):
    """`model: force`: the force of one step gives z = s F (e^(λΔt) − 1)²/(λ²Δt)."""
    touch = plate(tmp_path, **GIVEN, scrape=0, model="force")
    constants = touch.plan.sensors[0].constants
    rate = -constants["decay"][:1] + 2j * np.pi * constants["frequency"][:1]
    blow = expected_phasors(touch, PLACES)[:, 0, 0] + 1j * expected_phasors(touch, PLACES)[:, 0, 1]
    blow = blow * np.expm1(rate * STEP) ** 2 / (rate * STEP) ** 2 / np.exp(rate * STEP)
    phasors = phasors_after_a_blow(touch, PLACES)[:, 0]
    np.testing.assert_allclose(phasors[:, 0] + 1j * phasors[:, 1], blow, rtol=0, atol=1e-12 * np.abs(blow).max() + 2e-12)


def test_the_centre_of_a_square_plate_rings_only_in_x2_plus_y2(tmp_path):
    """xy, x² − y² and the pair have a node there; the first is loudest at the corner."""
    touch = plate(tmp_path, **GIVEN, scrape=0)
    size = np.linalg.norm(phasors_after_a_blow(touch, PLACES), axis=2)[:, 0] / (FORCE * STEP)
    assert size[0, [0, 1, 3]] == pytest.approx(0.0, abs=5e-3)
    assert size[0, 2] > 0.7
    assert size[2, 0] == pytest.approx(0.0, abs=5e-3), "the middle of a side is on the node line x = 0 of xy"
    assert size[:, 0].argmax() == 1 and size[1, 0] > 2.0


def test_scraping_is_heard_where_a_mode_moves(tmp_path):
    """A mode's mean-square phasor is s² times that with mean gains, exactly: the noise is the same."""
    places = np.repeat(PLACES, 3, axis=0)
    energy = []
    for gains in ("contact", "mean"):
        touch = plate(tmp_path, **{**GIVEN, "gains": gains})
        for _ in range(4):
            touch(pressed_state(touch, places, 1.0, 0.3))
        phasors = touch.memory.get_buffer("s:phasors").numpy().reshape(len(places), 2, -1)
        energy.append((phasors**2).sum(axis=1))
    rate = expected_phasors(touch, places)[:, 0] / (FORCE * STEP)
    decay = np.exp(-2 * STEP * touch.plan.sensors[0].constants["decay"])
    np.testing.assert_allclose(energy[0], energy[1] * (rate**2).sum(axis=1) / decay, rtol=1e-9, atol=1e-25)


def test_environments_do_not_affect_each_other(tmp_path):
    together = phasors_after_a_blow(plate(tmp_path, **GIVEN, scrape=0), PLACES)
    alone = [phasors_after_a_blow(plate(tmp_path, **GIVEN, scrape=0), PLACES[i : i + 1]) for i in range(len(PLACES))]
    np.testing.assert_allclose(np.concatenate(alone), together, rtol=0, atol=1e-15)


def test_a_reset_drops_a_pending_blow(tmp_path):
    """Two environments are struck; the one that is reset before the blow is passed on stays silent."""
    touch = plate(tmp_path, **GIVEN, scrape=0)
    for load in (0.0, FORCE):
        touch(pressed_state(touch, PLACES[[1, 1]], load))
    touch.reset(torch.tensor([True, False]))
    heard = touch(pressed_state(touch, PLACES[[1, 1]], 0.0))["s"]
    assert not heard[0].any() and heard[1].any()


def test_an_artefact_contains_the_shapes(tmp_path):
    touch = plate(tmp_path, **GIVEN)
    tgdsl.save(touch, tmp_path / "plate.safetensors")
    again = tgdsl.load(tmp_path / "plate.safetensors", dtype=torch.float64)
    np.testing.assert_array_equal(phasors_after_a_blow(again, PLACES), phasors_after_a_blow(touch, PLACES))


def test_bodies_of_one_shape_share_a_table(tmp_path):
    """Two equal plates share nodes; a blow on one is not heard of the other."""
    one = plate(tmp_path, **GIVEN).plan.sensors[0].constants
    touch = plate(tmp_path, **GIVEN, links=["plate", "other"], scrape=0)
    constants = touch.plan.sensors[0].constants
    assert constants["shape_first"].tolist() == [0, 0]
    assert constants["shape_value"].shape == one["shape_value"].shape
    phasors = phasors_after_a_blow(touch, PLACES)
    np.testing.assert_allclose(phasors[:, :1], expected_phasors(touch, PLACES), rtol=0, atol=1e-12)
    assert not phasors[:, 1].any()


def test_explain_states_the_error_of_shapes(tmp_path):
    touch = plate(tmp_path, **GIVEN)
    pattern = r"plate: mode shapes on 2 × \d+ × \d+ nodes; interpolated within [01]\.\d% of a mode's mean on the surface"
    assert re.search(pattern, str(touch.explain()))
    assert "mode shapes" not in plate(tmp_path, **{**GIVEN, "gains": "mean"}).explain()


def test_listed_modes_have_no_shapes(tmp_path):
    """For one body of several too, which the message names."""
    message = (
        'sensors.s.gains: `gains: contact` wants mode shapes, and the modes of "{}" are listed; give `modes: {{material: …}}`'
    )
    with pytest.raises(SpecError) as caught:
        plate(tmp_path, gains="contact")
    assert message.format("plate") in str(caught.value)
    other_modes = {"other": [{"frequency": 500.0, "decay": 3.0}]}
    with pytest.raises(SpecError) as caught:
        plate(tmp_path, **GIVEN, links=["plate", "other"], bodies=other_modes)
    assert message.format("other") in str(caught.value)


@pytest.mark.parametrize("of", ["link", "object"])
def test_progress_of_modal_analysis(tmp_path, monkeypatch, of):
    """One line per long part, for each body; a cached result has none."""
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))
    for parts in (["a grid of cells", "stiffness and mass of", "eigenproblem of", "mode shapes on a grid"], []):
        lines: list[str] = []
        tgdsl.compile(plate_document(tmp_path, modes="steel", samples=400, of=of), progress=lines.append)
        name = "plate" if of == "link" else "ball"
        steps = [line.removeprefix(f"modes of {name}: ") for line in lines if line.startswith("modes of")]
        assert steps[0] == "closing its surface"
        assert [step.startswith(part) for step, part in zip(steps[1:], parts, strict=True)] == [True] * len(parts)


def test_a_ball_that_mujoco_drops_on_a_plate(tmp_path):
    """At the centre the plate's first mode, xy, hardly rings; near a corner it does. Both are struck."""
    touch = plate(tmp_path, **GIVEN, scrape=0)
    sim = tgdsl.simulate(touch, num_envs=2)
    sim.qpos[:, :2] = torch.tensor([[0.0, 0.0], [0.08, 0.08]], dtype=sim.qpos.dtype)
    largest = np.zeros((2, 4))
    for _ in range(80):
        sim.step()
        touch(sim.state())
        phasors = touch.memory.get_buffer("s:phasors").numpy().reshape(2, 2, 4)
        largest = np.maximum(largest, np.linalg.norm(phasors, axis=1))
    assert largest[0, 2] > 1e-4 and largest[1, 0] > 1e-4
    assert largest[0, 0] < 0.02 * largest[1, 0]
    assert largest[0, 0] < 0.02 * largest[0, 2]
