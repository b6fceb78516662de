import pytest
import torch
from oracles.setups.scenes import module, state

from tgdsl.errors import SpecError
from tgdsl.sensors.contact import CONTACT
from tgdsl.testing import KindConformance


class TestContact(KindConformance):
    kind = CONTACT
    is_differentiable = False
    test_compiled_equals_eager = None  # part of another compiled graph


class TestContactWithHysteresis(KindConformance):
    kind = CONTACT
    parameters = {"threshold": "2 mm", "release_threshold": "0.5 mm"}
    is_differentiable = False


SPHERE = '<geom type="sphere" size=".02"/>'


def bits(touch, depths):
    """Return the bits of a 10 mm probe at the origin, pressed to each depth in turn, in mm."""
    return [int(touch(state(touch, pos=[0.03 - 1e-3 * depth, 0, 0]))["s"].item()) for depth in depths]


def test_without_release_there_is_no_memory(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], SPHERE, kind="contact", threshold="0.5 mm")
    assert bits(touch, [0.4, 0.6, 0.4, 0.6]) == [0, 1, 0, 1]
    assert not touch.has_state
    assert not list(touch.memory.buffers())


def test_default_threshold_is_the_papers(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], SPHERE, kind="contact")
    assert bits(touch, [0.49, 0.51]) == [0, 1]


def test_bits_have_the_modules_dtype(tmp_path):
    touch = module(tmp_path, [(0, 0, 0)], SPHERE, kind="contact", dtype=torch.float32)
    assert touch(state(touch))["s"].dtype == torch.float32


def test_release_above_threshold_is_refused(tmp_path):
    with pytest.raises(
        SpecError, match=r"sensors\.s: release_threshold 0\.0006 m is above threshold 0\.0005 m, expected at most"
    ):
        module(tmp_path, [(0, 0, 0)], SPHERE, kind="contact", threshold="0.5 mm", release_threshold="0.6 mm")
