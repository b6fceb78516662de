"""One module of all kinds, with memory, in one compiled graph; `make test-full` compiles each kind with its noise alone.

`make test` runs the graph that Dynamo traces, for which Inductor would write code for minutes.
"""

import pytest
import torch
from every_kind import SENSORS, every_kind
from noisy_modules import FLOAT32_TOLERANCE, read
from torch._dynamo.backends.registry import lookup_backend
from torch._inductor.compile_fx import compile_fx
from traced_graphs import number_inputs

from tgdsl.module.module import TactileModule
from tgdsl.sensors import KINDS
from tgdsl.tensors.torch_internals import num_compiled_graphs
from tgdsl.testing import full_scale_error

NOISY = ("contact", "touch")
"""Sensors whose noise is compiled: bits with hysteresis, and all stages with a history."""


@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_all_kinds_in_one_graph(tmp_path, backend):
    """Compiled readings equal eager ones, over states with memory and a reset, at two numbers of environments.

    No number of the code or the plan is an input of the graph.
    """
    assert {sensor["kind"] for sensor in SENSORS.values()} == {kind.name for kind in KINDS}
    quiet = {name: {key: value for key, value in sensor.items() if key != "noise"} for name, sensor in SENSORS.items()}
    touch = every_kind(tmp_path, quiet | {name: SENSORS[name] for name in NOISY})
    more, compiled = (TactileModule(touch.plan, dtype=torch.float32) for _ in range(2))
    torch.compiler.reset()
    num_graphs = num_compiled_graphs()
    # Code for vectors takes twice the time to write; to ask which vectors the processor has, five programs are compiled.
    options = {**compiled.inductor_options(), "cpp.simdlen": 1, "cpp.vec_isa_ok": False}
    numbers: list[str] = []

    def code_of(graph, inputs):
        numbers.extend(number_inputs(graph))
        if backend == "inductor":
            return compile_fx(graph, inputs, config_patches=options)
        return lookup_backend(backend)(graph, inputs)

    compiled.compile(backend=code_of)
    # 13 is no other size of the module: torch.compile takes equal sizes for one, and compiles again when they differ.
    assert_same_readings(compiled, touch, range(4), 13)
    read(more, range(2), 11)
    compiled.load_state_dict(more.state_dict())
    assert_same_readings(compiled, more, range(2, 5), 11)
    assert num_compiled_graphs() == num_graphs + 1 and numbers == []


def assert_same_readings(compiled, eager, calls, num_envs):
    """Assert that the readings of all calls agree; the last call follows a reset of two environments."""
    actual, expected = [], []
    for call in calls:
        for module, readings in ((compiled, actual), (eager, expected)):
            if call == calls[-1]:
                module.reset([1, 3])
            readings += read(module, range(call, call + 1), num_envs)
    assert actual[0].keys() == expected[0].keys() and len(actual[0]) > len(SENSORS)
    for name in actual[0]:
        compared, exact = (torch.stack([reading[name] for reading in readings]) for readings in (actual, expected))
        assert exact.isfinite().all() and (exact != 0).any(), name
        assert full_scale_error(compared, exact.double().numpy()).max() < FLOAT32_TOLERANCE, name
