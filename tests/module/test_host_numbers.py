"""A step makes no tensor of numbers that the host holds: on a GPU that is a copy, which a CUDA graph cannot hold."""

import traceback
from pathlib import Path

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import tgdsl

EXAMPLES = Path(__file__).parents[2] / "examples"


class HostNumbers(TorchDispatchMode):
    """Notes where tensors are made of Python's numbers, by `torch.tensor`, `new_tensor` or an item that is set."""

    def __init__(self):
        super().__init__()
        self.places = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func is torch.ops.aten.lift_fresh.default:
            own = [
                f"{Path(frame.filename).name}:{frame.lineno}"
                for frame in traceback.extract_stack()
                if "torch" not in frame.filename
            ]
            self.places.append(own[-2])  # the last one is here
        return func(*args, **(kwargs or {}))


def test_they_are_seen():
    with HostNumbers() as seen:
        torch.zeros(2).new_tensor([1.0, 2.0])
    assert len(seen.places) == 1


@pytest.mark.slow
@pytest.mark.parametrize("document", ["every_sensor.yaml", "tasks/bin.yaml", "tasks/grip.yaml"])
def test_a_step_makes_none(document):
    touch = tgdsl.compile(EXAMPLES / document)
    state = touch.example_state(4, spread=0.02)
    with torch.no_grad():
        touch(state)
        with HostNumbers() as seen:
            touch(state)
    assert not seen.places
