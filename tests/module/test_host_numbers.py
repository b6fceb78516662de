"""A step creates no tensor from host numbers: on a GPU that is a copy, which a CUDA graph cannot contain."""

import traceback
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import tgdsl

EXAMPLES = Path(__file__).parents[2] / "examples"


class HostNumbers(TorchDispatchMode):
    """Records where tensors are created from Python numbers, by `torch.tensor`, `new_tensor` or item assignment."""

    def __init__(self):
        super().__init__()
        self.places = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten.lift_fresh.default:
            frames = [
                f"{Path(frame.filename).name}:{frame.lineno}"
                for frame in traceback.extract_stack()
                if "torch" not in frame.filename
            ]
            self.places.append(frames[-2])  # the last frame is this one
        return func(*args, **(kwargs or {}))


def test_a_tensor_from_host_numbers_is_recorded():
    with HostNumbers() as recorder:
        torch.zeros(2).new_tensor([1.0, 2.0])
    assert len(recorder.places) == 1


@pytest.mark.slow
@pytest.mark.parametrize("document", ["every_sensor.yaml", "tasks/bin.yaml", "tasks/grip.yaml"])
def test_a_step_creates_no_tensor_from_host_numbers(document):
    touch = tgdsl.compile(EXAMPLES / document)
    state = touch.example_state(4, spread=0.02)
    with torch.no_grad():
        touch(state)
        with HostNumbers() as recorder:
            touch(state)
    assert not recorder.places
