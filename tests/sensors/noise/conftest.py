"""Fixtures of the noise tests."""

import pytest
import torch
from noisy_modules import document

import tgdsl
from tgdsl.module.module import TactileModule


@pytest.fixture
def build(tmp_path):
    def compiled(dtype=torch.float64, **sensors) -> TactileModule:
        return tgdsl.compile(document(tmp_path, sensors), dtype=dtype)

    return compiled
