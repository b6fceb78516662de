"""Files by name, in a folder of robots made for the test."""

from pathlib import Path

import pytest

from tgdsl.files import find


@pytest.fixture
def robots(tmp_path, monkeypatch) -> Path:
    """Two hands: `grip` has both sides, a layout for the left and one for both, and colliders; `claw` has one model."""
    place = tmp_path / "robots"
    for name in (
        *("grip/grip_left.xml", "grip/grip_right.xml", "grip/layout.yaml", "grip/layout_left.yaml", "grip/colliders.yaml"),
        *("claw/claw.xml", "README.xml"),
    ):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).touch()
    monkeypatch.setattr(find, "robots_folder", lambda: place)
    return place


def test_a_folders_name_means_its_right_hand(robots):
    left, right = robots / "grip" / "grip_left.xml", robots / "grip" / "grip_right.xml"
    assert find.robot_names() == {
        "claw": robots / "claw" / "claw.xml",
        "grip_left": left,
        "grip_right": right,
        "grip": right,
    }


def test_a_model_with_the_folders_name_comes_before_its_right_hand(robots):
    (robots / "grip" / "grip.xml").touch()
    assert find.robot_names()["grip"] == robots / "grip" / "grip.xml"


def test_a_robot_is_found_by_name_or_file(robots, tmp_path):
    (tmp_path / "mine.xml").touch()
    (tmp_path / "folder.xml").mkdir()
    assert find.robot_file("grip", tmp_path) == robots / "grip" / "grip_right.xml"
    assert find.robot_file("mine.xml", tmp_path) == tmp_path / "mine.xml"
    for name in ("folder.xml", "none.xml", "a\0b.xml"):
        assert find.robot_file(name, tmp_path) is None


def test_layouts_and_colliders_belong_to_one_side_or_both(robots):
    left, right, claw = (robots / name for name in ("grip/grip_left.xml", "grip/grip_right.xml", "claw/claw.xml"))
    assert find.layout_file(left) == robots / "grip" / "layout_left.yaml"
    assert find.layout_file(right) == find.layout_of("grip") == robots / "grip" / "layout.yaml"
    assert find.colliders_file(left) == robots / "grip" / "colliders.yaml"
    assert find.layout_file(claw) is None and find.colliders_file(claw) is None
    assert find.layout_of("claw") is None and find.layout_of("none") is None
