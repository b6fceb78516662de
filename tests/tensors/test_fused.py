"""Methods that are compiled from their second call on do what they do as they stand."""

from functools import partial

import pytest
import torch

from tgdsl.tensors.fused import FusedCall


@pytest.fixture(autouse=True)
def without_inductor(monkeypatch):
    """Compile to graphs that are functional and run by torch: Inductor takes half a minute to begin."""
    monkeypatch.setattr(torch, "compile", partial(torch.compile, backend="aot_eager"))


class Counter:
    """Adds up what it is given in place, and makes what lasts at its first call."""

    def __init__(self):
        self.total, self.calls, self.made = torch.zeros(5), 0, {}

    def add(self, value, factor=1.0):
        self.calls += not torch.compiler.is_compiling()
        if "scale" not in self.made:
            self.made["scale"] = torch.tensor(float("0.5"))
        self.total += factor * self.made["scale"] * value
        return self.total.sin() + value


@pytest.mark.parametrize("is_compiled", [False, True])
def test_calls_are_those_of_the_method(is_compiled):
    one, other = Counter(), Counter()
    add = FusedCall(one.add, is_compiled)
    for i in range(4):
        value = torch.arange(5.0) + i
        torch.testing.assert_close(add(value, factor=2.0), other.add(value, factor=2.0))
        torch.testing.assert_close(one.total, other.total)
    assert one.calls == (1 if is_compiled else 4)


def test_shapes_may_differ_between_calls():
    double = FusedCall(Doubled().of, True, has_fixed_shapes=False)
    for num in (3, 1, 7, 2, 1, 9, 4, 5, 6, 8, 10, 11):
        assert torch.equal(double(torch.arange(num)), 2 * torch.arange(num))


class Doubled:
    def of(self, value):
        return 2 * value
