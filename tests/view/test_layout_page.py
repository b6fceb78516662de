"""The page of `tgdsl layout new --view`: controls change the layout, and a button writes the command's file."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from box_hands import BOX_HAND, TIP_AREA
from odd_hands import command

from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.text import layout_text, new_draft
from tgdsl.view.layers import LIFT
from tgdsl.view.layout_page import ALL_AROUND, CHOSEN, LayoutPage
from tgdsl.view.style import LIVE_REST


@contextmanager
def opened(folder: Path, is_forced: bool = False) -> Iterator[LayoutPage]:
    (folder / "hand.xml").write_text(BOX_HAND)
    out = folder / "layout.yaml"
    page = LayoutPage(new_draft(load_model(folder / "hand.xml"), "4/cm2", True, out, is_forced), out, is_forced, port=8340)
    try:
        yield page
    finally:
        page.close()


def discs(page: LayoutPage) -> dict[str, int]:
    return {name: len(handle.batched_positions) for name, (_, handle) in page._discs.items()}


def test_controls_change_the_chosen_links_and_the_button_writes_the_commands_file(tmp_path):
    with opened(tmp_path) as page:
        before = {name: handle for name, (_, handle) in page._discs.items()}
        page.chosen.value = "(tips)"
        page.react()
        assert page.density.value == 4.0
        page.density.value = 10.0
        page.run(seconds=1e-3)
        area = 2 * TIP_AREA / 100
        assert page.status.content.endswith(f" at med, {round(10 * area)} of them on the chosen {area:.3g} cm²")
        assert {name: num for name, num in discs(page).items() if "tip" in name} == {"left_tip": 48, "right_tip": 48}
        assert page._discs["palm"][1] is before["palm"]  # unchanged links are not drawn again
        assert {tuple(page._discs[name][1].batched_colors[0]) for name in ("left", "left_tip")} == {LIVE_REST, CHOSEN}
        page.chosen.value = "(all)"
        page.react()
        page.density.value = 5.0
        page.react()
        page._write()
        assert page.problem.content.endswith("layout.yaml: written")
        assert sum(discs(page).values()) == int(page.status.content.split()[0])
        text = page.out.read_text()
    assert command(tmp_path, "layout", "new", "hand.xml", "--density", "5/cm2", "-o", "again.yaml") == 0
    assert (tmp_path / "again.yaml").read_text() == text


def test_discs_are_polygons_of_16_corners(tmp_path):
    with opened(tmp_path) as page:
        handle = page._discs["palm"][1]
        a, b, c = (handle.vertices[handle.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
    np.testing.assert_allclose(normals[:, :2], 0.0, atol=1e-7)
    np.testing.assert_allclose(normals[:, 2], np.sin(2 * np.pi / 16), atol=1e-6)  # twice the area of each of 16 triangles


def test_the_camera_looks_at_the_hand_whose_bodies_are_where_the_model_has_them(tmp_path):
    with opened(tmp_path) as page:
        np.testing.assert_allclose(page._frames["left_tip"].position, [-0.03, 0, 0.014 + 0.032], atol=1e-9)
        camera = page.server.initial_camera
        np.testing.assert_allclose(camera.look_at, [0, 0, 0.04], atol=0.02)  # the middle of the hand
        assert 0.1 < np.linalg.norm(np.asarray(camera.position) - camera.look_at) < 0.3


def test_side_box_and_resolution_move_the_taxels(tmp_path, clicks):
    with opened(tmp_path) as page:
        tip = page.draft.robot.compiled.body("left_tip").id
        for node, chosen in (("taxels", "left_tip"), ("mesh0", "(all)"), ("mesh0", "left_tip")):
            clicks[f"/body{tip}/{node}"](None)
            page.react()
            assert page.chosen.value == chosen
        assert page.side.value == "+x"
        assert [name for name, frame in page._frames.items() if frame.show_axes] == ["left_tip"]
        assert page.side.options == (ALL_AROUND, "+x", "-x", "+y", "-y", "+z", "-z")
        ends = [(least, most, *slider.value) for slider, least, most in page._bounds]
        np.testing.assert_allclose(ends, [2 * (-6, 6), 2 * (-9, 9), 2 * (0, 32)], atol=0.05)  # the geom's with room of 1 mm
        page.side.value = "-y"
        page.react()
        handle = page._discs["left_tip"][1]
        np.testing.assert_allclose(handle.batched_positions[:, 1], -0.008 - LIFT)
        slider, lowest, _ = page._bounds[2]
        slider.value = (lowest, 16.0)
        page.react()
        assert page._discs["left_tip"][1].batched_positions[:, 2].max() <= 0.016 + 1e-6
        assert discs(page)["left_tip"] == 6  # 4 taxels on 1 cm² of 10 × 15 mm
        page.resolution.value = "high"
        page.react()
        assert discs(page)["left_tip"] == 24
        page.side.value = ALL_AROUND
        page.react()

        def text_of_tip() -> str:
            lines = layout_text(page.draft.proposal, "").splitlines()
            return next(line for line in lines if line.startswith("    left_tip"))

        assert "box" in text_of_tip()
        slider, lowest, highest = page._bounds[2]
        slider.value = (lowest, highest)
        page.react()
        assert "box" not in text_of_tip()


def test_links_can_leave_and_join_groups(tmp_path):
    with opened(tmp_path) as page:
        chosen = {group: {name for name, box in boxes.items() if box.value} for group, boxes in page.members.items()}
        assert chosen["tips"] == {"left_tip", "right_tip"} and chosen["palm"] == {"palm"}
        page.members["tips"]["left_tip"].value = False
        page.members["tips"]["palm"].value = True
        page.members["palm"]["palm"].value = False
        page.chosen.value = "(palm)"
        page.react()
        assert set(page.draft.proposal.members["tips"]) == {"palm", "right_tip"}
        assert "0 of them on the chosen 0 cm²" in page.status.content
        page.react()
        page.members["palm"]["palm"].value = True
        page.react()
        assert page.side.value == "+z"


def test_an_invalid_value_is_shown_and_blocks_writing(tmp_path, clicks):
    with opened(tmp_path) as page:
        num = sum(discs(page).values())
        page.density.value = 0.0
        page.react()
        assert "density: 0/cm2 is out of range, expected more than 0" in page.problem.content
        page._write()
        assert not page.out.exists() and "nothing is written" in page.problem.content
        assert sum(discs(page).values()) == num
        page.density.value = 4.0
        page.react()
        assert page.problem.content == ""
        clicks["write layout.yaml"](None)
        page.react()
        assert page.out.exists()


def test_a_foreign_file_is_replaced_only_with_force(tmp_path):
    with opened(tmp_path) as page:
        page._write()
        page._write()  # its own file is replaced
        page.out.write_text("mine")
        page._write()
        assert "this file is there already; give --force to replace it" in page.problem.content
        assert page.out.read_text() == "mine"
    with opened(tmp_path, is_forced=True) as page:
        page._write()
        assert page.out.read_text().startswith("# A layout for hand.xml")
