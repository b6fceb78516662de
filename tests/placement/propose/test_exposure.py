"""At every resolution, no taxel of a proposed layout is buried, covered or not collided without a note."""

import numpy as np
import pytest
from covered_hands import hand, shell
from odd_hands import HANDS

from tgdsl.compiler.pipeline import placed
from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import FACTORS, Draft, propose
from tgdsl.placement.propose.text import write_layout
from tgdsl.schema.load import load_layout

SIDES = pytest.mark.parametrize("side", [1, -1], ids=["right", "left"])


def proposed(folder, here, text: str, *options: str) -> tuple[str, str]:
    """Return the text of the layout that the command writes, and its output."""
    (folder / "hand.xml").write_text(text)
    code, output, error = here(folder, "layout", "new", "hand.xml", *options)
    assert code == 0, error
    return (folder / "layout.yaml").read_text(), output


def unfelt(folder) -> dict[str, list[str]]:
    """Return the records of taxels of the written layout that cannot feel, by resolution."""
    placement = placed({"tgdsl": 1, "robot": {"model": str(folder / "hand.xml"), "layout": str(folder / "layout.yaml")}})
    assert set(placement.layouts) == set(FACTORS)
    return {name: [str(record) for record in records] for name, records in placement.unfelt.items()}


@SIDES
def test_every_taxel_can_feel(tmp_path, here, side):
    """The palm is sampled on its hull without covered parts; plate and finger lose the parts inside the palm."""
    text, output = proposed(tmp_path, here, hand(side))
    assert unfelt(tmp_path) == {"low": [], "med": [], "high": []}
    placements = load_layout(tmp_path / "layout.yaml").spec.resolutions
    for name in FACTORS:
        options = {
            link: (options_of_link.surface, options_of_link.exposed) for link, options_of_link in placements[name].items()
        }
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
    lines = output.splitlines()
    assert f"surface: collision: palm, thumb: {hull}" in lines and f"exposed: true: palm, plate, finger: {exposed}" in lines
    bare = '"the tip": the simulator does not collide it, so contacts never reach it'
    assert f"left out: {bare}" in lines and f"# Left out: {bare}\n" in text
    assert "not collided" not in output


def test_a_draft_samples_the_surfaces_of_its_file(tmp_path):
    """The collision geometry of the palm and the thumb, the meshes of the others."""
    (tmp_path / "hand.xml").write_text(hand(1))
    draft = Draft(load_model(tmp_path / "hand.xml"), 4e4)
    write_layout(draft, tmp_path / "layout.yaml")
    robot = {"model": str(tmp_path / "hand.xml"), "layout": str(tmp_path / "layout.yaml")}
    layout = placed({"tgdsl": 1, "robot": robot}).layouts["med"]
    for i, link in enumerate(layout.links):
        proposal = next(each for each in draft.proposal.links if each.name == link.name)
        assert np.array_equal(draft.samples(proposal, "med").pos, layout.pos[layout.link_id == i])


@SIDES
def test_areas_count_only_the_sampled_surface(tmp_path, side):
    """The first 8 mm of the finger's box of 40 × 6 × 6 mm are inside the palm: one end and 32 mm of four sides remain."""
    (tmp_path / "hand.xml").write_text(hand(side))
    links = {link.name: link for link in propose(load_model(tmp_path / "hand.xml"), 1e6, with_groups=False).links}
    assert links["finger"].facing is None
    assert links["finger"].area == pytest.approx(4 * 0.032 * 0.006 + 0.006**2, rel=0.02)
    # The thumb's hull: a prism 40 mm high over an L of 500 mm² and a triangle of 200 mm².
    perimeter = 0.03 + 0.01 + 0.02 * 2**0.5 + 0.01 + 0.03
    assert links["thumb"].area == pytest.approx(2 * 7e-4 + 0.04 * perimeter, rel=0.02)


def test_a_link_that_others_cover_is_left_out(tmp_path, here):
    inner = '<body name="plug" pos=".005 .005 .02"><joint/><geom type="box" size=".003 .003 .003"/></body>'
    text, output = proposed(tmp_path, here, hand().replace('<body name="plate"', f'{inner}<body name="plate"'))
    assert "left out: plug: all of it is inside other links in the initial state" in output.splitlines()
    assert "    plug:" not in text and not any(unfelt(tmp_path).values())


def test_a_robot_without_colliders_keeps_its_taxels_with_a_note(tmp_path, here):
    """They feel by distance, so they stay; those that contacts never reach are named."""
    text, output = proposed(tmp_path, here, HANDS["visual"].text)
    note = "none of these links collides in the simulator, so their taxels need `gate: geometric`"
    assert f"# Note: {note}.\n" in text and f"not collided: {note}" in output.splitlines()
    assert "surface:" not in text and "exposed:" not in text
    records = unfelt(tmp_path)["med"]
    assert len(records) == 2 and all("on a body that the simulator does not collide" in record for record in records)


def test_colliding_scenery_does_not_count_as_the_hand(tmp_path, here):
    """Visual jaws keep their taxels next to a colliding table."""
    table = '<body name="table" pos="0 0 -.5"><geom type="box" size=".2 .2 .1"'
    text, output = proposed(tmp_path, here, HANDS["visual"].text.replace(table, f'{table} contype="1"'))
    assert "not collided: " in output and '"jaw a": {method' in text


def test_options_are_written_only_where_needed(tmp_path, here):
    """Separate links get no options if they are convex, or if their hollows are shallower than taxels feel."""
    text = f"""<mujoco><asset>{shell()}</asset><worldbody><body name="palm"><geom type="box" size=".03 .03 .01"/>
      <body name="finger" pos="0 0 .02"><joint axis="0 1 0" range="0 1"/><geom type="capsule" size=".005 .01" pos="0 0 .01"/></body>
      <body name="shell" pos=".06 0 .02"><joint axis="0 1 0" range="0 1"/><geom type="mesh" mesh="shell"/></body>
    </body></worldbody></mujoco>"""
    layout, output = proposed(tmp_path, here, text)
    assert "exposed" not in output and "surface: collision: shell: " in output
    assert not any(unfelt(tmp_path).values())
    # At 0.1/cm² the least radius is 12 mm; the hollow is 10 mm deep.
    layout, output = proposed(tmp_path, here, text, "--density", "0.1/cm2", "--force")
    assert "surface:" not in layout and "exposed:" not in layout and not any(unfelt(tmp_path).values())


@pytest.mark.parametrize("robot", ["xhand1_right", pytest.param("sharpa_right", marks=pytest.mark.slow)])
def test_taxels_of_included_hands_can_all_feel(robot):
    """With their own layouts, at every resolution."""
    placement = placed({"tgdsl": 1, "robot": {"model": robot}})
    assert set(placement.unfelt) == {"low", "med", "high"} and not any(placement.unfelt.values())
