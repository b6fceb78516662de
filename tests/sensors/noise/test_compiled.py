"""Noise in compiled modules."""

import pytest
import torch
from noisy_modules import FLOAT32_TOLERANCE, RANGES, read
from traced_graphs import number_inputs

from tgdsl.testing.reference import full_scale_error


@pytest.mark.slow
def test_compiled_equals_eager(build):
    """At two numbers of environments: the second takes over the state of another module. No graph has numbers as inputs.

    Knobs are ranges; the graph of all kinds in `../test_compiled.py` has plain numbers.
    """
    sensors = {
        "r": {"noise": RANGES, "rate": 60, "history": {"length": 3, "reduce": "mean"}, "readout": "both"},
        "d": {"kind": "contact_depth", "noise": {"white_noise": 1e-4, "read_delay": 0.013, "quantization": 1e-8}, "rate": 60},
    }
    torch.compiler.reset()
    eager, more, compiled = (build(torch.float32, **sensors) for _ in range(3))
    numbers: list[str] = []
    compiled.compile(backend=lambda graph, _inputs: numbers.extend(number_inputs(graph)) or graph)
    agree_over_calls(compiled, eager, 4, range(8))
    read(more, range(2), 37)
    compiled.load_state_dict(more.state_dict())
    agree_over_calls(compiled, more, 37, range(2, 8))
    assert numbers == []


def agree_over_calls(compiled, eager, num_envs, calls):
    for call in calls:
        if call == 5:
            for touch in (eager, compiled):
                touch.reset([1, 3])
        (result,), (expected,) = (read(touch, range(call, call + 1), num_envs) for touch in (compiled, eager))
        for name in expected:
            a, b = (reading[name].flatten(0, -3) for reading in (result, expected))
            assert full_scale_error(a, b.double().numpy()).max() < FLOAT32_TOLERANCE, name
