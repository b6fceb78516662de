"""No taxel of a proposed layout is buried, covered or not collided unless the proposal says so; at every resolution."""

import pytest
from covered_hands import hand, shell
from odd_hands import HANDS

from tgdsl.compiler.pipeline import placed
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import FACTORS, propose
from tgdsl.schema.load import load_layout

SIDES = pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])


def proposed(folder, here, text: str, *options: str) -> tuple[str, str]:
    """Return the text of the layout that the command writes, and what it says."""
    (folder / "hand.xml").write_text(text)
    code, said, error = here(folder, "layout", "new", "hand.xml", *options)
    assert code == 0, error
    return (folder / "layout.yaml").read_text(), said


def unfelt(folder) -> dict[str, list[str]]:
    """Return the taxels that cannot feel of the layout that was written, by resolution."""
    found = placed({"tgdsl": 1, "robot": {"model": str(folder / "hand.xml"), "layout": str(folder / "layout.yaml")}})
    assert set(found.layouts) == set(FACTORS)
    return {name: [str(own) for own in records] for name, records in found.unfelt.items()}


@SIDES
def test_every_taxel_can_feel(tmp_path, here, side):
    """The palm goes to its hull, and without what plate and finger cover; the plate and the finger lose what is in the palm."""
    text, said = proposed(tmp_path, here, hand(side))
    assert unfelt(tmp_path) == {"low": [], "med": [], "high": []}
    placements = load_layout(tmp_path / "layout.yaml").spec.resolutions
    for name in FACTORS:
        options = {link: (own.surface, own.exposed) for link, own in placements[name].items()}
        assert options == {
            "palm": ("collision", True),
            "plate": ("mesh", True),
            "finger": ("mesh", True),
            "thumb": ("collision", False),
        }
    hull = "on the collision geometry: the surface is deeper inside it than taxels reach"
    exposed = "without the parts that are inside other collision geoms in the initial state"
    assert f"    # {hull}\n    # {exposed}\n    palm: {{method: poisson, count: " in text
    assert "surface: collision, exposed: true" in text
    lines = said.splitlines()
    assert f"surface: collision: palm, thumb: {hull}" in lines and f"exposed: true: palm, plate, finger: {exposed}" in lines
    bare = '"the tip": the simulator does not collide it, so contacts never reach it'
    assert f"left out: {bare}" in lines and f"# Left out: {bare}\n" in text
    assert "not collided" not in said


@SIDES
def test_areas_are_those_of_what_is_sampled(tmp_path, side):
    """Of the finger's box, 40 × 6 × 6 mm, the first 8 mm are inside the palm: an end and the last 32 mm of four sides are left."""
    (tmp_path / "hand.xml").write_text(hand(side))
    links = {link.name: link for link in propose(load_model(tmp_path / "hand.xml"), 1e6, with_groups=False).links}
    assert links["finger"].facing is None
    assert links["finger"].area == pytest.approx(4 * 0.032 * 0.006 + 0.006**2, rel=0.02)
    # The thumb's hull: a prism 40 mm high over an L of 500 mm² and a triangle of 200 mm².
    perimeter = 0.03 + 0.01 + 0.02 * 2**0.5 + 0.01 + 0.03
    assert links["thumb"].area == pytest.approx(2 * 7e-4 + 0.04 * perimeter, rel=0.02)


def test_a_link_that_others_cover_is_left_out(tmp_path, here):
    inner = '<body name="plug" pos=".005 .005 .02"><joint/><geom type="box" size=".003 .003 .003"/></body>'
    text, said = proposed(tmp_path, here, hand().replace('<body name="plate"', f'{inner}<body name="plate"'))
    assert "left out: plug: all of it is inside other links in the initial state" in said.splitlines()
    assert "    plug:" not in text and not any(unfelt(tmp_path).values())


def test_a_robot_of_which_nothing_is_collided_keeps_its_taxels_and_says_so(tmp_path, here):
    """They feel by distance, so they are kept; what cannot be felt by contact is named."""
    text, said = proposed(tmp_path, here, HANDS["visual"].text)
    mind = "none of these links collides in the simulator, so their taxels need `gate: geometric`"
    assert f"# Note: {mind}.\n" in text and f"not collided: {mind}" in said.splitlines()
    assert "surface:" not in text and "exposed:" not in text
    found = unfelt(tmp_path)["med"]
    assert len(found) == 2 and all("on a body that the simulator does not collide" in own for own in found)


def test_scenery_that_collides_does_not_make_a_hand_do_so(tmp_path, here):
    """Jaws that are only seen keep their taxels beside a table that collides."""
    table = '<body name="table" pos="0 0 -.5"><geom type="box" size=".2 .2 .1"'
    text, said = proposed(tmp_path, here, HANDS["visual"].text.replace(table, f'{table} contype="1"'))
    assert "not collided: " in said and '"jaw a": {method' in text


def test_options_only_where_they_are_needed(tmp_path, here):
    """Links apart from one another that are convex, or whose hollows are no deeper than a taxel feels, get none."""
    text = f"""<mujoco><asset>{shell()}</asset><worldbody><body name="palm"><geom type="box" size=".03 .03 .01"/>
      <body name="finger" pos="0 0 .02"><joint axis="0 1 0" range="0 1"/><geom type="capsule" size=".005 .01" pos="0 0 .01"/></body>
      <body name="shell" pos=".06 0 .02"><joint axis="0 1 0" range="0 1"/><geom type="mesh" mesh="shell"/></body>
    </body></worldbody></mujoco>"""
    layout, said = proposed(tmp_path, here, text)
    assert "exposed" not in said and "surface: collision: shell: " in said
    assert not any(unfelt(tmp_path).values())
    # At 0.1/cm² the least radius is 12 mm; the hollow is 10 mm deep.
    layout, said = proposed(tmp_path, here, text, "--density", "0.1/cm2", "--force")
    assert "surface:" not in layout and "exposed:" not in layout and not any(unfelt(tmp_path).values())


@pytest.mark.parametrize("robot", ["xhand1_right", pytest.param("sharpa_right", marks=pytest.mark.slow)])
def test_the_hands_that_come_with_tgdsl_have_no_taxels_that_cannot_feel(robot):
    """Of their own layouts, at every resolution."""
    found = placed({"tgdsl": 1, "robot": {"model": robot}})
    assert set(found.unfelt) == {"low", "med", "high"} and not any(found.unfelt.values())
