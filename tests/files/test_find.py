"""Files by name: of a folder of robots that is made here."""

from pathlib import Path

import pytest

from tgdsl.files import find


@pytest.fixture
def robots(tmp_path, monkeypatch) -> Path:
    """Two hands: `grip` has both sides, layouts of one side and of all, and colliders of all; `claw` has one model of its own name."""
    place = tmp_path / "robots"
    for name in (
        *("grip/grip_left.xml", "grip/grip_right.xml", "grip/layout.yaml", "grip/layout_left.yaml", "grip/colliders.yaml"),
        *("claw/claw.xml", "README.xml"),
    ):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).touch()
    monkeypatch.setattr(find, "robots_folder", lambda: place)
    return place


def test_a_folders_own_name_is_its_right_hand(robots):
    left, right = robots / "grip" / "grip_left.xml", robots / "grip" / "grip_right.xml"
    assert find.robot_names() == {
        "claw": robots / "claw" / "claw.xml",
        "grip_left": left,
        "grip_right": right,
        "grip": right,
    }


def test_a_model_of_the_folders_own_name_comes_before_its_right_hand(robots):
    (robots / "grip" / "grip.xml").touch()
    assert find.robot_names()["grip"] == robots / "grip" / "grip.xml"


def test_a_robot_is_given_by_name_or_by_its_file(robots, tmp_path):
    (tmp_path / "mine.xml").touch()
    (tmp_path / "folder.xml").mkdir()
    assert find.robot_file("grip", tmp_path) == robots / "grip" / "grip_right.xml"
    assert find.robot_file("mine.xml", tmp_path) == tmp_path / "mine.xml"
    for name in ("folder.xml", "none.xml", "a\0b.xml"):
        assert find.robot_file(name, tmp_path) is None


def test_what_lies_beside_a_model_is_of_its_side_or_of_all(robots):
    left, right, claw = (robots / name for name in ("grip/grip_left.xml", "grip/grip_right.xml", "claw/claw.xml"))
    assert find.layout_file(left) == robots / "grip" / "layout_left.yaml"
    assert find.layout_file(right) == find.layout_of("grip") == robots / "grip" / "layout.yaml"
    assert find.colliders_file(left) == robots / "grip" / "colliders.yaml"
    assert find.layout_file(claw) is None and find.colliders_file(claw) is None
    assert find.layout_of("claw") is None and find.layout_of("none") is None
