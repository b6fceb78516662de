"""A third-party noise stage in documents, modules, artefacts and definitions."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from installed_packages import installing
from noise_documents import document, mistakes
from noisy_modules import document as pads
from noisy_modules import read
from oracles.setups.signals import Noise

import tgdsl
from tgdsl.errors import TgdslError
from tgdsl.schema.document import json_schema
from tgdsl.sensors.noise import NoiseSpec, pipeline, register
from tgdsl.sensors.noise.profiles import noise_model

FILE = Path(__file__).parents[3] / "examples" / "plugins" / "saturation.py"


@pytest.fixture
def saturation(monkeypatch):
    """The stage of the example, registered for one test."""
    monkeypatch.setattr(pipeline.REGISTRY, "registered", ())
    spec = importlib.util.spec_from_file_location("saturation", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "saturation", module)
    spec.loader.exec_module(module)
    register(module.Saturation)
    return module.Saturation


KNOBS = {"bias": {"force": 0.3}, "saturation": {"force": [0.2, 0.4]}, "quantization": {"force": 1e-3}, "like": "clean"}


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_module_clips_between_offset_and_quantiser(tmp_path, saturation, compiled):
    sensors = {"s": {"noise": KNOBS}, "c": {"noise": {name: v for name, v in KNOBS.items() if name != "saturation"}}}
    touch = tgdsl.compile(pads(tmp_path, sensors), dtype=torch.float64)
    assert touch.plan.sensors[0].noise.terms == ("bias", "saturation", "quantization")
    assert "saturation force [0.2, 0.4] N" in touch.explain()
    if compiled:
        touch.compile(backend="eager")
    (readings,) = read(touch, range(1))
    clipped, other = readings["s"], readings["c"]
    assert (other[..., :3] > 0.4).any()
    end = clipped[..., :3].flatten(1).abs().amax(dim=1)
    assert len(end.unique()) > 2 and (end <= 0.4 + 1e-3).all()
    inside = other[..., :3].abs() < 0.2
    assert torch.equal(clipped[..., :3][inside], other[..., :3][inside])
    assert torch.equal(clipped[..., 3:], other[..., 3:])


def test_the_batched_form_matches_the_definition(saturation, monkeypatch):
    monkeypatch.setattr("oracles.setups.signals.Knobs", noise_model((saturation.Knobs,)).plain)
    noise = Noise({name: value for name, value in KNOBS.items() if name != "like"}, 5, ("force_x",), num_envs=3)
    signal = np.linspace(-1, 1, 5)[:, None]
    expected = [definition.read(signal, 0.0) for definition in noise.references()]
    np.testing.assert_allclose(noise.read(signal).numpy(), expected, atol=1e-12)
    assert np.abs(expected).max() <= 0.4 + 1e-3


def test_profiles_links_and_artefacts_accept_the_stage(tmp_path, saturation, monkeypatch):
    profiles = {"mine": {"saturation": 0.1, "links": {"palm": {"saturation": 0.5}}}}
    touch = tgdsl.compile(document(tmp_path, "kinematic_taxel", "mine", profiles))
    values = touch.plan.arrays["sensors/s/noise/saturation"]
    assert values.shape == (1, 6) and sorted(set(values[0].tolist())) == [0.1, 0.5]
    tgdsl.save(touch, tmp_path / "touch.safetensors")
    state = touch.example_state(2)
    assert torch.equal(tgdsl.load(tmp_path / "touch.safetensors")(state)["s"], touch(state)["s"])
    monkeypatch.setattr(pipeline.REGISTRY, "registered", ())
    with pytest.raises(TgdslError, match=r'the noise stage "saturation" is not known; install its package, or `tgdsl'):
        tgdsl.load(tmp_path / "touch.safetensors")


def test_mistakes_in_its_knobs_name_their_place(tmp_path, saturation):
    (message,) = mistakes(tmp_path, "kinematic_taxel", {"saturation": -1})
    assert message == "sensors.s.noise.saturation: -1 is out of range, expected at least 0"
    (message,) = mistakes(tmp_path, "contact_depth", {"saturation": {"force": 1}})
    assert message == 'sensors.s.noise: "saturation" names "force", which this sensor does not read'
    (message,) = mistakes(tmp_path, "contact_audio", {"saturation": 1})
    assert message == 'sensors.s.noise.saturation: "contact_audio" has no knob "saturation"'
    assert "saturation" in json_schema()["$defs"]["NoiseSpec"]["properties"]


def test_the_knob_is_unknown_without_the_stage(tmp_path):
    (message,) = mistakes(tmp_path, "kinematic_taxel", {"saturation": 1})
    assert message == 'sensors.s.noise.saturation: unknown key "saturation"'
    assert "saturation" not in NoiseSpec.model_fields


def test_two_stages_with_the_same_draw_are_an_error(saturation, tmp_path, monkeypatch):
    number = dataclasses.replace(saturation.numbers["saturation"], draw=12)
    monkeypatch.setattr(saturation, "numbers", {"saturation": number})
    with pytest.raises(TgdslError, match=r'the noise stages "quantization" and "saturation" both have the draw 12'):
        tgdsl.compile(document(tmp_path, "contact_depth", {}))


def test_an_installed_stage_needs_no_registration(tmp_path, monkeypatch):
    with installing(tmp_path, monkeypatch, pipeline.REGISTRY.group, FILE.read_text()) as install:
        install("clips", "1.0", saturation="clips:Saturation")
        touch = tgdsl.compile(document(tmp_path, "kinematic_taxel", {"saturation": 0.1}))
        assert touch.plan.sensors[0].noise.terms == ("saturation",)
