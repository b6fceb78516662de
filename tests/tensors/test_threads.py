"""Small operations by one thread."""

import pytest
import torch

from tgdsl.tensors.on_host import one_thread


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
