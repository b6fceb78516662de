"""Evaluations of the small task, whose episodes last 8 control steps, end soon after the last episode."""

import pytest


@pytest.fixture(autouse=True)
def checked_often(monkeypatch):
    """Look after each episode's length whether all have ended."""
    monkeypatch.setattr("tgdsl.rl.playing.evaluation.CHECK_INTERVAL", 8)
