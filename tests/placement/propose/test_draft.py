"""Changes of a proposal before it is written reach its text and the compiled taxels."""

from pathlib import Path

import numpy as np
import pytest
from box_hands import BOX_HAND, TIP_AREA
from odd_hands import compiled

from tgdsl.errors import TgdslError
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import Draft
from tgdsl.placement.propose.text import layout_text, write_layout
from tgdsl.schema.load import load_layout

TIPS = ("left_tip", "right_tip")


def draft_of(folder: Path) -> Draft:
    (folder / "hand.xml").write_text(BOX_HAND)
    return Draft(load_model(folder / "hand.xml"), 4e4)


def taxels_of(draft: Draft, folder: Path) -> dict[str, np.ndarray]:
    """Write and compile a draft; return the taxels of each link at `med`."""
    write_layout(draft, folder / "layout.yaml")
    table = compiled(folder, {"hand": "geometric"}).taxels["hand"]
    return {link: table[table["link"] == link] for link in dict.fromkeys(table["link"])}


def lines_of(draft: Draft) -> list[str]:
    return layout_text(draft.proposal, "hand.xml").splitlines()


def test_the_density_of_some_links_can_change(tmp_path):
    draft = draft_of(tmp_path)
    original = lines_of(draft)
    draft.change(TIPS, density=10e4)
    taxels = taxels_of(draft, tmp_path)
    assert [len(taxels[tip]) for tip in TIPS] == [round(TIP_AREA / 10)] * 2
    changed = [line for line in lines_of(draft) if line not in original]
    comment = "    # 4.8 cm², 10 taxels per cm², inner side guessed from how the joints close"
    assert comment in changed and {line.split(":")[0].strip() for line in changed} == {
        *TIPS,
        comment.strip(),
        "low",
        "med",
        "high",
    }
    for tip in TIPS:
        samples = draft.samples(next(link for link in draft.proposal.links if link.name == tip), "med")
        assert np.array_equal(samples.pos, taxels[tip]["pos"]) and np.array_equal(samples.normal, taxels[tip]["normal"])


def test_one_density_for_all_links_gives_the_file_of_the_command(tmp_path, here):
    draft = draft_of(tmp_path)
    draft.change(TIPS, density=9e4)
    draft.change({link.name for link in draft.proposal.links}, density=7e4)
    assert here(tmp_path, "layout", "new", "hand.xml", "--density", "7/cm2")[0] == 0
    text = (tmp_path / "layout.yaml").read_text()
    assert layout_text(draft.proposal, "hand.xml") == text and "# Density: 7 taxels per cm²" in text


def test_sides_and_regions_can_change_and_return(tmp_path):
    draft = draft_of(tmp_path)
    guess = lines_of(draft)
    draft.change(["left_tip"], facing=(-1.0, 0.0, 0.0))
    low, high = draft.bounds("right_tip")
    draft.change(["right_tip"], box=((*low[:2], 0.016), high))
    draft.change(["palm"], facing=(0.0, 0.0, -1.0))  # the guess is the side on which the fingers stand
    taxels = taxels_of(draft, tmp_path)
    assert (taxels["left_tip"]["normal"] @ [-1, 0, 0]).min() > np.cos(np.radians(75))
    assert len(taxels["left_tip"]) == 19
    assert taxels["right_tip"]["pos"][:, 2].min() >= 0.016 - 1e-6 and len(taxels["right_tip"]) == 10  # half of 19.2
    assert (taxels["right_tip"]["normal"] @ [-1, 0, 0]).min() > 0.99
    assert len(taxels["palm"]) == 4 * 8 * 6  # 8 × 6 cm
    np.testing.assert_allclose(taxels["palm"]["normal"] @ [0, 0, -1], 1.0)
    text = lines_of(draft)
    assert text[0].endswith("and changed by hand; comments mark the guesses.")
    assert text[[line.startswith("    left_tip: {method") for line in text].index(True)].endswith(
        "region: {facing: [-1, 0, 0], within: 75 deg}}"
    )
    assert any(
        "right_tip" in line and "box: {min: [-0.006, -0.009, 0.016], max: [0.006, 0.009, 0.032]}" in line for line in text
    )
    assert [line for line in text if "guessed from how" in line] == [
        "    # 4.48 cm², inner side guessed from how the joints close"
    ] * 2
    draft.change(["left_tip"], facing=(1.0, 0.0, 0.0))
    draft.change(["right_tip"], box=None)
    draft.change(["palm"], facing=(0.0, 0.0, 1.0))
    assert lines_of(draft) == guess


def test_links_can_enter_and_leave_groups(tmp_path):
    draft = draft_of(tmp_path)
    guess = lines_of(draft)
    draft.set_group("tips", ["left_tip", "palm"])
    draft.set_group("palm", [])
    draft.set_group("hand", ["left", "left_tip", "right", "right_tip"])
    write_layout(draft, tmp_path / "layout.yaml")
    text = (tmp_path / "layout.yaml").read_text()
    assert "  tips: [palm, left_tip]\n" in text and "  hand: [fingers]\n" in text and "palm: [" not in text
    assert "guessed: the last" not in text and "  # all links that move" in text
    groups = compiled(tmp_path, {"hand": "geometric", "tips": "geometric"}).plan.layout.groups
    expected = {"tips": {"palm", "left_tip"}, "fingers": {"left", *TIPS, "right"}, "hand": {"left", *TIPS, "right"}}
    assert {name: set(links) for name, links in groups.items()} == expected
    draft.set_group("tips", TIPS)
    draft.set_group("palm", ["palm"])
    draft.set_group("hand", [link.name for link in draft.proposal.links])
    assert lines_of(draft) == guess
    assert load_layout(tmp_path / "layout.yaml").spec.groups.keys() == expected.keys()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"density": 0.0}, "density: 0/cm2 is out of range, expected more than 0"),
        ({"density": float("nan")}, "density: nan/cm2 is out of range"),
        ({"density": 1e13}, 'link "palm" would have'),
        ({"within": 0.0}, "within: 0 deg is out of range"),
        ({"box": ((0.1, 0.1, 0.1), (0.2, 0.2, 0.2))}, 'link "palm": its surface has nothing in this region'),
    ],
)
def test_an_invalid_change_changes_nothing(tmp_path, change, message):
    draft = draft_of(tmp_path)
    original = draft.proposal
    with pytest.raises(TgdslError) as error:
        draft.change(["palm"], **change)
    assert str(error.value).startswith(message)
    assert draft.proposal is original
