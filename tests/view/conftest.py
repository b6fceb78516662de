"""The document of the page's tests, and clicks on a page."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import viser
from press_scene import DOCUMENT, SCENE


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("press")
    (folder / "press.xml").write_text(SCENE)
    (folder / "press.yaml").write_text(DOCUMENT)
    return folder / "press.yaml"


@pytest.fixture
def clicks(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[Any], object]]:
    """The functions that viser calls on a click, by the label of a button or the name of a node in the scene."""
    acts: dict[str, Callable[[Any], object]] = {}
    for kind in (viser.GuiButtonHandle, viser.GuiButtonGroupHandle):
        monkeypatch.setattr(kind, "on_click", lambda handle, act: acts.update({handle.label: act}))
    for kind in (viser.MeshHandle, viser.BatchedMeshHandle):
        monkeypatch.setattr(kind, "on_click", lambda handle, act: acts.update({handle.name: act}))
    return acts
