"""Methods compiled from their second call on return what they return uncompiled."""

from functools import partial

import pytest
import torch

from tgdsl.tensors.fused import FusedCall


@pytest.fixture(autouse=True)
def without_inductor(monkeypatch):
    """Compile to functional graphs that torch runs: Inductor takes half a minute to start."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))


class Counter:
    """Accumulates its argument in place; creates what lasts at the first call."""

    def __init__(self):
        self.total, self.calls, self.made = torch.zeros(5), 0, {}

    def add(self, value, factor=1.0):
        self.calls += not torch.compiler.is_compiling()
        if "scale" not in self.made:
            self.made["scale"] = torch.tensor(float("0.5"))
        self.total += factor * self.made["scale"] * value
        return self.total.sin() + value


@pytest.mark.parametrize("is_compiled", [False, True])
def test_fused_calls_equal_the_method(is_compiled):
    counter, expected = Counter(), Counter()
    add = FusedCall(counter.add, is_compiled)
    for i in range(4):
        value = torch.arange(5.0) + i
        torch.testing.assert_close(add(value, factor=2.0), expected.add(value, factor=2.0))
        torch.testing.assert_close(counter.total, expected.total)
    assert counter.calls == (1 if is_compiled else 4)


def test_shapes_may_differ_between_calls():
    double = FusedCall(Doubled().of, True, has_fixed_shapes=False)
    for num in (3, 1, 7, 2, 1, 9, 4, 5, 6, 8, 10, 11):
        assert torch.equal(double(torch.arange(num)), 2 * torch.arange(num))


def test_shapes_that_may_differ_are_compiled_once(monkeypatch):
    graphs = []
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend=lambda graph, inputs: graphs.append(graph) or graph))
    double = FusedCall(Doubled().of, True, has_fixed_shapes=False)
    for num in (3, 7, 2, 9):
        assert torch.equal(double(torch.arange(num)), 2 * torch.arange(num))
    assert len(graphs) == 1


class Doubled:
    def of(self, value):
        return 2 * value
