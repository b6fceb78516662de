"""Types and shapes are checked while tests run: `tests/helpers/quick_checks.py`, in place of jaxtyping's own decorator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import jaxtyping
import pytest
import torch
from beartype import beartype
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import Float
from quick_checks import checked
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.geometry.rotations import product
from tgdsl.runtime.simulators.faults import EnvFaults
from tgdsl.surfaces.geom import Geom


def pair(one: Float[Tensor, "n 3"], other: Float[Tensor, "n 3"], scale: float = 1.0) -> Float[Tensor, "n 3"]:
    return scale * (one + other) if scale > 0 else one[:1]


def either(one: Float[Tensor, "n 3"] | Float[Tensor, "m 4"], other: Float[Tensor, " n"]) -> None:
    pass


def later(made: Made) -> list[Made]:
    return [made]


class Made:
    pass


def never(text: str) -> NoReturn:
    raise SimulationError(text)


def outer(size: int):
    def inner(values: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        return values[:size]

    return checked(inner, beartype)


def refused(function, *arguments, **named):
    with pytest.raises(BeartypeCallHintViolation) as raised:
        function(*arguments, **named)
    return str(raised.value)


def test_parameters_and_results_and_axes_of_one_name():
    function, three, four = checked(pair, beartype), torch.zeros(3, 3), torch.zeros(4, 3)
    assert function(three, three).shape == (3, 3) and function(four, other=four).shape == (4, 3)
    assert "other" in refused(function, three, four)
    assert "one" in refused(function, three.long(), three)
    assert "scale" in refused(function, three, three, "1")
    assert "result" in refused(function, three, three, scale=-1.0)
    assert function.__name__ == "pair" and function.__wrapped__ is pair
    with pytest.raises(TypeError, match="other"):
        function(three)


def test_arrays_like_those_that_were_right_are_looked_at_again():
    function, three = checked(pair, beartype), torch.zeros(3, 3)
    for _ in range(2):
        assert function(three, three).shape == (3, 3)
        assert "other" in refused(function, three, torch.zeros(4, 3))
        assert "one" in refused(function, torch.zeros(3, 4), three)
        assert "one" in refused(function, torch.zeros(3), three)
        assert "one" in refused(function, three.long(), three)
        assert "one" in refused(function, three.numpy(), three)
        assert "result" in refused(function, three, three, scale=-1.0)


def test_lengths_of_what_an_array_is_not_are_forgotten():
    function = checked(either, beartype)
    for _ in range(2):
        function(torch.zeros(2, 3), torch.zeros(2))
        function(torch.zeros(2, 4), torch.zeros(5))
        assert "other" in refused(function, torch.zeros(2, 3), torch.zeros(5))


def test_names_that_stand_further_below_and_what_never_returns():
    function = checked(later, beartype)
    assert len(function(Made())) == 1
    assert "made" in refused(function, 3)
    with pytest.raises(SimulationError, match="so it is"):
        checked(never, beartype)("so it is")


def test_inner_functions_are_checked_each_with_its_own_values():
    assert outer(2)(torch.zeros(2)).shape == (2,)
    assert "result" in refused(outer(1), torch.zeros(2))
    assert outer(3)(torch.zeros(2)).shape == (2,)


def test_constructors_of_data_classes_with_equal_code():
    @dataclass
    class One:
        value: int

    @dataclass
    class Other:
        value: str

    for kind, right, wrong in ((One, 1, "a"), (Other, "a", 1)):
        kind.__init__ = checked(kind.__init__, beartype)
        assert kind(right).value == right
        assert "value" in refused(kind, wrong)
    assert One.__init__.__wrapped__.__code__ == Other.__init__.__wrapped__.__code__


def test_the_package_is_checked_and_left_alone_where_torch_compiles(monkeypatch):
    """Functions, methods, constructors."""
    refused(product, torch.zeros(2, 4), torch.zeros(3, 4))
    refused(Geom, 0, "", "", "body", "box", torch.zeros(3).numpy(), torch.zeros(2).numpy(), torch.eye(3).numpy(), True)
    refused(EnvFaults(2, torch.device("cpu"), "note").note, "diverged", torch.zeros(2))
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    with pytest.raises(RuntimeError, match="size of tensor"):
        product(torch.zeros(2, 4), torch.zeros(3, 4))
