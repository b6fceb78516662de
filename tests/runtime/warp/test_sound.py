"""Sound from MuJoCo Warp and from MuJoCo: joints and positions at each physics step of a control step."""

import pytest
import torch
from warp_cases import SCENE, warp

import tgdsl
from tgdsl.modal import analysis as spectra
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation


@pytest.mark.slow
def test_motors_and_microphones_agree_in_both_simulators(tmp_path):
    """Two moving arms, heard on one of them and in the room: equal to a thousandth of the maximum over 30 control steps."""
    (tmp_path / "scene.xml").write_text(SCENE)
    block = {"samples": 20, "substeps": 3}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml")},
        "sensors": {
            "motors": {"kind": "actuation_audio", **block, "friction": 0.0, "pitch": 50.0},
            "ear": {"kind": "microphone", "body": "pad", "pos": [0.02, 0, 0.3]},
            "room": {"kind": "microphone", "pos": [0, 0.5, 0.5]},
        },
    }
    plan = tgdsl.compile(document).plan
    control, readings = torch.tensor([0.6, -0.3]), []
    for simulator in (warp, BatchSimulation):
        touch = TactileModule(plan)
        sim, blocks = simulator(touch, 2, substeps=3), []
        for _ in range(30):
            sim.step(control)
            blocks.append(touch(sim.state()))
        readings.append({name: torch.cat([step[name] for step in blocks], dim=1) for name in ("motors", "ear", "room")})
    for name, expected in readings[1].items():
        assert expected.shape[1] == 30 * 60 and expected.abs().max() > 1e-4
        error = (readings[0][name] - expected).abs().amax() / expected.abs().amax()
        assert error < 1e-3, f"{name} differs by {error:.1e}"


@pytest.mark.slow
def test_contact_audio_agrees_in_both_simulators(tmp_path, monkeypatch):
    """A cube falls 2 mm onto a table, off centre: equal to a hundredth of the maximum.

    Simulators distribute a face's load among its corners differently; centre and mean normal agree.
    """
    monkeypatch.setattr(spectra, "UNKNOWNS", 2500)
    (tmp_path / "scene.xml").write_text(SCENE.replace('name="cube" pos="0 0 .0299"', 'name="cube" pos=".02 .01 .032"'))
    sensor = {"kind": "contact_audio", "links": "table", "feels": ["cube"], "samples": 100, "substeps": 2, "scrape": 0}
    material = {"like": "steel", "youngs_modulus": 2e9}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml")},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"s": {**sensor, "modes": {"material": material, "count": 6}, "gains": "contact"}},
    }
    plan, sounds = tgdsl.compile(document).plan, []
    for simulator in (warp, BatchSimulation):
        touch = TactileModule(plan)
        sim, blocks = simulator(touch, 2, substeps=2), []
        for _ in range(15):
            sim.step()
            blocks.append(touch(sim.state())["s"].cpu())
        sounds.append(torch.cat(blocks, dim=1))
    assert sounds[1].abs().max() > 1e-6
    error = (sounds[0] - sounds[1]).abs().max() / sounds[1].abs().max()
    assert error < 0.01, f"differs by {error:.1e}"
