"""Noise of the probes' radii."""

import dataclasses

import numpy as np
import pytest
import torch
from noisy_modules import SCENE, circumstances, document, felt_state, read

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.sensors.noise.stages import Radius
from tgdsl.testing import only
from tgdsl.testing.reference import full_scale_error


def test_a_disturbed_radius_acts_like_another_radius(build, tmp_path):
    """Depths match a module compiled with the drawn radii exactly."""
    touch = build(s={"kind": "contact_depth", "noise": {"radius_noise": 2e-3}})
    spec, drawn, num_felt = document(tmp_path, {"s": {"kind": "contact_depth"}}), [], 0
    for call in range(4):
        state = felt_state(touch, 2, call)
        memory = touch.memory.tensors(2, None, touch.dtype, touch.device)
        nows, noise = circumstances(touch, memory)
        (radius,) = noise["s"]
        assert isinstance(radius, Radius)
        shift = radius.shift(nows["s"], torch.zeros(2, 17, dtype=torch.float64))
        readings = touch(state)["s"]
        drawn.append(shift)
        for env in range(2):
            for link, first in (("pad", 0), ("tip", 12)):
                for i, point in enumerate(spec["robot"]["layout"]["resolutions"]["r"][link]["points"]):
                    point["radius"] = 4e-3 + shift[env, first + i].item()
            expected = tgdsl.compile(spec, dtype=torch.float64)(only(state, slice(env, env + 1)))["s"]
            torch.testing.assert_close(readings[env : env + 1], expected, rtol=1e-12, atol=1e-17)
            num_felt += int(expected.count_nonzero())
    assert num_felt > 5
    values = torch.stack(drawn)
    assert values.abs().max() <= 2e-3 and len(values.unique()) == values.numel()
    assert values.min() < -1.5e-3 and values.max() > 1.5e-3


def test_a_radius_is_never_negative(build):
    """R̃ = max(0, R + ε): at R̃ = 0 a probe still reads the depth of its centre, by max(0, R̃ − φ)."""
    touch = build(s={"kind": "contact_depth", "gate": "geometric", "noise": {"radius_noise": 0.02}, "readout": "both"})
    state = touch.example_state(40, spread=0.01)
    readings = touch(state)
    measured, clean = readings["s"], readings["s/clean"]
    deep = clean > 4e-3  # the centre is inside
    assert deep.any() and (measured[deep] >= clean[deep] - 4e-3 - 1e-12).all()
    assert torch.isclose(measured[deep], clean[deep] - 4e-3, rtol=0, atol=1e-12).float().mean() > 0.2  # P(ε < −4 mm) = 0.4
    assert (measured >= 0).all()


RADIUS_ERRORS = {"points": 1e-12, "field": 0.1}
"""Largest error over full scale at R ± ρ, against a module compiled with that radius."""


@pytest.mark.parametrize("backend", ["points", "field"])
def test_radius_noise_of_proximity(tmp_path, monkeypatch, backend):
    fields = {"points": 1000} if backend == "points" else {"tolerance": 0.02}
    spec = document(tmp_path, {"s": {"kind": "proximity", "backend": backend, **fields}})
    (tmp_path / "scene.xml").write_text(SCENE.replace('type="sphere" size=".025"', 'type="box" size=".01 .01 .01"'))

    def compiled(radius: float, noise: dict) -> TactileModule:
        for link_layout in spec["robot"]["layout"]["resolutions"]["r"].values():
            link_layout["radius"] = radius
        spec["sensors"]["s"]["noise"] = noise
        return tgdsl.compile(spec, dtype=torch.float64)

    touch = compiled(0.01, {"radius_noise": "0.6 mm"})
    state = felt_state(touch, 100)
    for sign in (1, -1):
        exact = compiled(0.01 + sign * 6e-4, {})
        if backend == "points":  # points depend on the radius; the law is compared on the same ones
            moments = dataclasses.replace(exact.plan.quantities["moments"], tables=touch.plan.quantities["moments"].tables)
            plan = dataclasses.replace(exact.plan, quantities={**exact.plan.quantities, "moments": moments})
            exact = TactileModule(plan, dtype=torch.float64)
        monkeypatch.setattr(Radius, "shift", lambda stage, *_, sign=sign: (sign * stage.radius_noise[:, 0]).expand(100, 17))
        error = full_scale_error(touch(state)["s"], exact(state)["s"].numpy())
        print(f"{backend}, R {sign:+d} ρ: largest error {error.max():.2g} of full scale, RMS {np.sqrt(np.mean(error**2)):.2g}")
        assert error.max() < RADIUS_ERRORS[backend]


def test_the_clean_reading_of_points_equals_a_sensors_without_noise(build):
    """Radius noise leaves the clean reading alone: it samples the object at the same points."""
    sensor = {"kind": "proximity", "backend": "points", "points": 200}
    both, clean = build(s={**sensor, "noise": {"radius_noise": "0.6 mm"}, "readout": "both"}), build(s=sensor)
    for a, b in zip(read(both, range(3)), read(clean, range(3)), strict=True):
        assert full_scale_error(a["s/clean"], b["s"].numpy()).max() < 1e-12
