"""The document of the page's tests."""

from pathlib import Path

import pytest
from press_scene import DOCUMENT, SCENE


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("press")
    (folder / "press.xml").write_text(SCENE)
    (folder / "press.yaml").write_text(DOCUMENT)
    return folder / "press.yaml"
