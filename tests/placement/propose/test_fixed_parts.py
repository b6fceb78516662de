"""Linkages with fingers below their tips in the tree, and parts fixed to links and palms."""

import numpy as np
import pytest
from closing_hands import INNER, finger, palm_and_fingers, parallel_jaws, slides, thumb, world

from tgdsl.compiler.pipeline import placed
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import Proposal, propose
from tgdsl.placement.propose.text import layout_text

DENSITY = 1e4
HIDDEN = "behind bodies fixed in front of it; --include adds it"


def proposal_of(tmp_path, text: str, density: float = DENSITY) -> Proposal:
    (tmp_path / "hand.xml").write_text(text)
    return propose(load_model(tmp_path / "hand.xml"), density)


def facing_of(proposal: Proposal) -> dict[str, tuple[float, ...] | None]:
    return {link.name: link.facing for link in proposal.links}


def lever_finger(name: str, x: float, turn: int) -> str:
    """Return a chain of a lever, a finger's outer link and its inner link, which a connect joins to the base."""
    hinge = '<joint {} axis="0 1 0" range="{}"/>'
    return f"""<body name="{name}_lever" pos="{x} 0 .01" euler="0 0 {turn}">{hinge.format(f'name="{name}_drive"', "0 60")}
      <geom type="box" size=".003 .006 .018" pos="0 0 .02"/>
      <body name="{name}_outer" pos="0 0 .04">{hinge.format("", "-90 90")}<geom type="box" size=".004 .008 .02" pos=".006 0 .02"/>
        <body name="{name}_inner" pos=".012 0 0">{hinge.format("", "-90 90")}
          <geom type="box" size=".003 .006 .018" pos="0 0 -.02"/></body></body></body>"""


def test_a_tip_may_be_the_parent_of_its_finger_in_the_tree(tmp_path):
    """Levers and inner links of 4 cm, 12 mm apart, form parallelograms: all links move inward equally."""
    fingers = lever_finger("left", 0.04, 180) + lever_finger("right", -0.04, 0)
    loops = "".join(f'<connect body1="{side}_inner" body2="base" anchor="0 0 -.04"/>' for side in ("left", "right"))
    text = f'<body name="base"><geom type="box" size=".05 .02 .01"/>{fingers}</body>'
    proposal = proposal_of(tmp_path, f"<mujoco><worldbody>{text}</worldbody><equality>{loops}</equality></mujoco>")
    assert set(proposal.groups["tips"]) == {"left_outer", "right_outer"}
    parts = {f"{side}_{part}": INNER for side in ("left", "right") for part in ("lever", "inner", "outer")}
    assert facing_of(proposal) == {"base": (0, 0, 1), **parts}


TOWER = '<geom type="box" size=".02 .03 .05" pos="0 .07 .05"/>'
"""A tower next to the gripper, as high as its jaws: 0.1 m."""


def test_a_tower_on_a_palm_has_no_taxels(tmp_path):
    """The gripper's top has 48 cm²; the tower's would add 24 cm² and shift the palm's centre."""
    text = world(slides().replace("<geom", f"{TOWER}<geom", 1))
    proposal = proposal_of(tmp_path, text)
    link = next(link for link in proposal.links if link.name == "gripper")
    assert link.facing == (0, 0, 1)
    assert link.counts["med"] == pytest.approx(48, abs=3)
    (tmp_path / "layout.yaml").write_text(layout_text(proposal, "hand.xml"))
    layout = placed(
        {"tgdsl": 1, "robot": {"model": str(tmp_path / "hand.xml"), "layout": str(tmp_path / "layout.yaml")}}
    ).layouts["med"]
    taxels = layout.pos[layout.taxels_of(("gripper",))]
    assert len(taxels) == link.counts["med"] and np.abs(taxels[:, 2] - 0.02).max() < 1e-6


def test_a_tower_that_is_a_body_is_no_part_of_the_hand(tmp_path):
    tower = f'<body name="tower">{TOWER}</body>'
    proposal = proposal_of(tmp_path, world(slides().replace('<body name="jaw0"', f'{tower}<body name="jaw0"')))
    assert facing_of(proposal).keys() == {"gripper", "jaw0", "jaw1"}
    assert dict(proposal.left_out)["tower"] == "no part of a hand; --include adds it"


def halves(order: str) -> str:
    """Return a palm in two fixed halves; the second carries the fingers."""
    text = palm_and_fingers(thumb(1))
    whole = '<geom type="box" size=".012 .04 .04" pos="0 0 .04"/>'
    half = '<geom type="box" size=".012 .02 .04" pos="0 {} .04"/>'
    first_half, second_half = (half.format(y) for y in ((0.02, -0.02) if order == "thumb_first" else (-0.02, 0.02)))
    assert whole in text
    return (
        text.replace(
            '<body name="palm" pos="0 0 .2">', f'<body name="first" pos="0 0 .2">{first_half}<body name="palm">'
        ).replace(whole, second_half)
        + "</body>"
    )


@pytest.mark.parametrize("order", ["thumb_first", "thumb_last"])
def test_both_halves_of_a_palm_are_the_palm(tmp_path, order):
    proposal = proposal_of(tmp_path, world(halves(order)))
    assert set(proposal.groups["palm"]) == {"first", "palm"}
    assert set(facing_of(proposal).values()) == {INNER}


@pytest.mark.parametrize("z", [-0.03, 0.04], ids=["before", "beside"])
def test_a_wrist_is_no_part_of_a_palm(tmp_path, z):
    """A thumb points back over a box fixed to the palm: a box below is a wrist, one at its height a half of the palm."""
    wrist = f'<body name="wrist" pos="0 0 .2"><geom type="box" size=".012 .025 {abs(z)}" pos="0 -.02 {z}"/>'
    back = finger("thumb", ".02 -.02 0", "180 0 0")
    text = palm_and_fingers(back if z < 0 else thumb(1)).replace(
        '<body name="palm" pos="0 0 .2">', f'{wrist}<body name="palm">'
    )
    if z > 0:
        text = text.replace('size=".012 .04 .04" pos="0 0 .04"', 'size=".012 .02 .04" pos="0 .02 .04"')
    proposal = proposal_of(tmp_path, world(text + "</body>"))
    assert proposal.groups["palm"] == (("palm",) if z < 0 else ("wrist", "palm"))
    assert ("wrist" in {name for name, _ in proposal.left_out}) == (z < 0)


def test_a_ball_that_touches_nothing_is_a_marker(tmp_path):
    """Balls of 3 mm: one 60 mm before the palm, and one in a fingertip, which sticks out by 2 mm."""
    ball = '<body name="{}" pos="{}"><geom size=".003"/></body>'
    text = palm_and_fingers(thumb(1) + ball.format("tool", ".08 0 .04"))
    geom = '<geom type="box" size=".006 .008 .014" pos="0 0 .016"/>'
    index = text.index(geom, text.index('name="f1_3"')) + len(geom)
    proposal = proposal_of(tmp_path, world(text[:index] + ball.format("mark", ".005 0 .02") + text[index:]))
    assert proposal.left_out == (("tool", "a marker: it touches nothing that it is fixed to"),)
    assert set(proposal.groups["tips"]) == {"f0_3", "f1_3", "f2_3", "f3_3", "thumb3"} and "mark" in proposal.groups["fingers"]


def test_a_free_body_welded_to_a_link_is_part_of_it(tmp_path):
    """Caps on two fingertips, separate trees held by equalities, count as tips and face like them."""
    box = '<geom type="box" size=".006 .008 .006"/>'
    caps = "".join(f'<body name="cap{i}" pos="0 {0.03 - 0.02 * i:.3g} .387"><freejoint/>{box}</body>' for i in range(2))
    welds = "".join(f'<weld body1="{one}" body2="{two}"/>' for one, two in (("f0_3", "cap0"), ("cap1", "f1_3")))
    text = world(palm_and_fingers(thumb(1)) + caps).replace("</mujoco>", f"<equality>{welds}</equality></mujoco>")
    proposal = proposal_of(tmp_path, text)
    assert proposal.left_out == ()
    assert set(proposal.groups["tips"]) == {"f0_3", "f1_3", "f2_3", "f3_3", "thumb3", "cap0", "cap1"}
    facing = facing_of(proposal)
    assert facing["cap0"] == facing["cap1"] == facing["f0_3"] == INNER


def test_the_second_bar_of_a_linkage_faces_like_the_first(tmp_path):
    """Its centre lies at its hinge and does not move."""
    bar = '<geom type="box" size=".002 .006 .02" pos="0 0 .03"/>'
    text = parallel_jaws().replace(bar, bar.replace('pos="0 0 .03"', ""))
    facing = facing_of(proposal_of(tmp_path, text))
    assert facing["left_second"] == facing["right_second"] == INNER


def test_covers_face_like_their_link(tmp_path):
    """One cover lies behind its link, one in front and one at the side; the last faces like its link."""
    text = palm_and_fingers(thumb(1))
    parts = {
        "f0_2": '<body name="back"><geom type="box" size=".002 .008 .014" pos="-.008 0 .016"/></body>',
        "f1_3": '<body name="pad"><geom type="box" size=".002 .008 .014" pos=".0081 0 .016"/></body>',
        "f2_2": '<body name="side"><geom type="box" size=".003 .002 .004" pos=".02 .012 .01"/></body>',
    }
    geom = '<geom type="box" size=".006 .008 .014" pos="0 0 .016"/>'
    for name, part in parts.items():
        index = text.index(geom, text.index(f'name="{name}"')) + len(geom)
        text = text[:index] + part + text[index:]
    proposal = proposal_of(tmp_path, world(text))
    assert [name for name, why in proposal.left_out if why == HIDDEN] == ["back", "f1_3"]
    assert set(facing_of(proposal).values()) == {INNER}
    assert "pad" in proposal.groups["tips"] and "side" in proposal.groups["fingers"]


def test_spreading_joints_do_not_turn_inner_sides(tmp_path):
    """Three fingers at 120° bend both ways from straight; their first joints swing them sideways."""
    fingers = ""
    for i in range(3):
        knuckle = finger(f"f{i}_", "0 0 .02", num=2, span="-90 90")
        fingers += (
            f'<body name="k{i}" pos="{-0.05 * np.cos(2.0944 * i):.5f} {-0.05 * np.sin(2.0944 * i):.5f} .01" euler="0 0 {120 * i}">'
            f'<joint name="spread{i}" axis="1 0 0" range="-75 30"/><geom type="box" size=".006 .006 .009" pos="0 0 .01"/>{knuckle}</body>'
        )
    proposal = proposal_of(tmp_path, world(f'<body name="palm"><geom type="cylinder" size=".06 .01"/>{fingers}</body>'))
    assert facing_of(proposal) == {"palm": (0, 0, 1)} | {
        f"{link}{i}{n}": INNER for i in range(3) for link, n in (("k", ""), ("f", "_1"), ("f", "_2"))
    }
