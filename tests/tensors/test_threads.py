"""Small tensors on the host: copies that arrive later, and operations by one thread."""

from types import SimpleNamespace

import pytest
import torch

from tgdsl.tensors.on_host import HostCopy, one_thread


@pytest.fixture
def three_threads():
    num_threads = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(num_threads)


def test_one_thread_restores_the_number_of_threads(three_threads):
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
    with pytest.raises(ValueError, match="wrong"), one_thread():
        raise ValueError("wrong")
    assert torch.get_num_threads() == 3


class OnGpu(torch.Tensor):
    """A tensor that pretends to be on a GPU."""

    device = torch.device("cuda")


def test_values_of_a_gpu_arrive_at_a_later_call(monkeypatch):
    event = SimpleNamespace(record=lambda stream: None, query=lambda: False)
    pretended = {"Event": lambda: event, "is_current_stream_capturing": lambda: False, "current_stream": lambda device: None}
    for name, value in pretended.items():
        monkeypatch.setattr(torch.cuda, name, value)
    monkeypatch.setattr(torch, "empty", lambda *args, pin_memory, **keys: torch.zeros(*args, **keys))
    copy, first, second = HostCopy(), *(torch.tensor(values).as_subclass(OnGpu) for values in ([1, 2], [3, 4]))
    assert copy.poll(first) is None and copy.poll(second) is None  # the first is still under way
    event.query = lambda: True
    assert copy.poll(second).tolist() == [1, 2] and copy.poll(first).tolist() == [3, 4]
