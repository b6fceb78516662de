"""When a Triton kernel replaces torch's operations."""

import pytest
import torch

from tgdsl.tensors import operations


class OnGpu(torch.Tensor):
    """A tensor that claims to be on a GPU."""

    is_cuda = property(lambda self: True)  # type: ignore[assignment]


def on_gpu(dtype=torch.float32, requires_grad=False):
    return torch.zeros(2, dtype=dtype).as_subclass(OnGpu).requires_grad_(requires_grad)


@pytest.fixture(autouse=True)
def triton(monkeypatch):
    monkeypatch.setattr(operations, "HAS_TRITON", True)


def test_a_kernel_takes_float32_on_a_gpu():
    assert operations.are_kernel_inputs(on_gpu(), on_gpu())


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("other", [torch.zeros(2), on_gpu(torch.float64), on_gpu(requires_grad=True)])
def test_one_unsupported_tensor_rules_out_the_kernel(place, other):
    """One on the host, of another dtype, or that requires gradients."""
    tensors = [on_gpu() for _ in range(3)]
    tensors[place] = other
    assert not operations.are_kernel_inputs(*tensors)


def test_requires_grad_does_not_matter_under_no_grad():
    with torch.no_grad():
        assert operations.are_kernel_inputs(on_gpu(requires_grad=True), on_gpu())
