"""A proposed layout: its file, its text and errors."""

import pytest
from odd_hands import FOUR_BAR, compiled

from tgdsl.formats.robot import load_model
from tgdsl.placement.propose.propose import propose
from tgdsl.schema.load import load_layout
from tgdsl.schema.placement import LayoutSpec

URDF = """<robot name="jaws">
  <link name="base"><collision><geometry><box size=".1 .1 .02"/></geometry></collision></link>
  <link name="left"><collision><origin xyz="0 0 .03"/><geometry><box size=".01 .02 .06"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0 0 .03"/><geometry><box size=".01 .02 .06"/></geometry></collision></link>
  <joint name="l" type="prismatic"><parent link="base"/><child link="left"/><origin xyz="-.04 0 .01"/><axis xyz="1 0 0"/>
    <limit lower="0" upper=".03" effort="1" velocity="1"/></joint>
  <joint name="r" type="prismatic"><parent link="base"/><child link="right"/><origin xyz=".04 0 .01"/><axis xyz="1 0 0"/>
    <limit lower="-.03" upper="0" effort="1" velocity="1"/></joint>
</robot>
"""


def test_the_file_holds_the_proposal(tmp_path, here):
    """A URDF gripper: its jaws close from opposite ends of their ranges."""
    (tmp_path / "jaws.urdf").write_text(URDF)
    code, output, error = here(tmp_path, "layout", "new", "jaws.urdf", "--density", "1/cm2")
    assert code == 0, error
    proposal = propose(load_model(tmp_path / "jaws.urdf"), 1e4)
    assert load_layout(tmp_path / "layout.yaml").spec == LayoutSpec.model_validate(proposal.mapping())
    links = {link.name: (link.facing, link.counts) for link in proposal.links}
    assert links["left"] == ((1, 0, 0), {"low": 3, "med": 12, "high": 48})
    assert links["right"] == ((-1, 0, 0), {"low": 3, "med": 12, "high": 48})
    assert links["base"] == ((0, 0, 1), {"low": 25, "med": 100, "high": 400})
    assert output.splitlines()[0] == "3 links: 31 taxels at low, 124 taxels at med, 496 taxels at high"


def test_groups_can_be_left_out(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    assert here(tmp_path, "layout", "new", "hand.xml", "--groups", "none")[0] == 0
    layout = load_layout(tmp_path / "layout.yaml").spec
    assert layout.groups == {} and set(layout.resolutions) == {"low", "med", "high"}
    assert "groups:" not in (tmp_path / "layout.yaml").read_text()


def test_the_geoms_of_a_link_are_named(tmp_path, here):
    """A link of several geoms lists them, and a layout may name one of them instead."""
    body = """<body name="{0}" pos="{1} 0 -.02"><joint type="slide" axis="{2} 0 0" range="0 .02"/>
        <geom name="{0}_arm" type="box" size=".004 .01 .02"/><geom name="{0}_pad" type="box" size=".004 .01 .01" pos="0 0 -.03"/></body>"""
    fingers = body.format("left", -0.03, 1) + body.format("right", 0.03, -1)
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><worldbody><body name="base"><geom type="box" size=".05 .02 .01"/>{fingers}</body></worldbody></mujoco>'
    )
    assert here(tmp_path, "layout", "new", "hand.xml")[0] == 0
    file = tmp_path / "layout.yaml"
    comments = [line.strip() for line in file.read_text().splitlines() if "one geom" in line]
    names = ("left_arm, left_pad", "right_arm, right_pad")
    assert comments == [f"# for taxels on one geom, write its name instead: {geoms}" for geoms in names]
    file.write_text(file.read_text().replace("    left:", "    left_pad:"))
    taxels = compiled(tmp_path, {"tips": "geometric"}).taxels["tips"]
    assert set(taxels["link"]) == {"left_pad", "right"}
    assert taxels["pos"][taxels["link"] == "left_pad"][:, 2].max() < -0.02  # the pad's upper end [m]
    assert taxels["pos"][taxels["link"] == "right"][:, 2].max() > 0  # the arm has taxels too


def test_a_file_is_not_overwritten(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    (tmp_path / "layout.yaml").write_text("mine")
    code, _, error = here(tmp_path, "layout", "new", "hand.xml")
    assert (code, error) == (
        2,
        "tgdsl: layout.yaml: this file is there already; give --force to replace it, or --out for another\n",
    )
    assert (tmp_path / "layout.yaml").read_text() == "mine"
    assert here(tmp_path, "layout", "new", "hand.xml", "--force")[0] == 0
    assert (tmp_path / "layout.yaml").read_text().startswith("# A layout for hand.xml, proposed by")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.xml", "layout.yaml"]


@pytest.mark.parametrize(
    ("density", "message"),
    [
        ("many", '--density: "many" is not a quantity, expected a number in /m2 or a string such as "4 /mm2"'),
        ("4 cm2", '--density: "cm2" is not a unit of density, expected one of /m2, /cm2, /mm2'),
        ("0/cm2", "--density: 0/cm2 is out of range, expected more than 0"),
        ("-1/cm2", "--density: -1/cm2 is out of range, expected more than 0"),
        ("1e9/cm2", 'link "base" would have'),
    ],
)
def test_an_invalid_density_is_refused(tmp_path, here, density, message):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    code, _, error = here(tmp_path, "layout", "new", "hand.xml", f"--density={density}")
    assert code == 2
    assert error.startswith(f"tgdsl: {message}")
    assert not (tmp_path / "layout.yaml").exists()


def test_the_same_density_in_another_unit_gives_the_same_file(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    for density, name in (("2/cm2", "layout.yaml"), ("2e4", "new/again.yaml")):
        assert here(tmp_path, "layout", "new", "hand.xml", "--density", density, "-o", name)[0] == 0
    text = (tmp_path / "layout.yaml").read_text()
    assert (tmp_path / "new/again.yaml").read_text() == text
    assert str(tmp_path) not in text


def test_robots_without_surface_and_missing_robots_are_refused(tmp_path, here):
    (tmp_path / "hand.xml").write_text('<mujoco><worldbody><body name="frame"/></worldbody></mujoco>')
    code, _, error = here(tmp_path, "layout", "new", "hand.xml")
    assert (code, error) == (2, 'tgdsl: hand.xml: no link has a surface for taxels ("frame": no geoms)\n')
    for command in (("layout", "new"), ("links",)):
        code, _, error = here(tmp_path, *command, "xhand2")
        assert code == 2 and error.startswith('tgdsl: there is no file or robot "xhand2"; did you mean "xhand1')


def test_names_are_escaped_for_yaml_and_selections(tmp_path, here):
    names = ["no", "1e3", "a: b", "#c", "[d]", "*", "e?", 'f"g\\h', "i\u2028j", "😀", "- k", "hand", "{l}", "&m", "!n", "~"]
    parts = "".join(
        f'<body name="{name.replace("&", "&amp;").replace(chr(34), "&quot;")}"><joint axis="{1 + i} 1 0"/><geom type="box" size=".01 .01 .01" pos="{i} 0 0"/></body>'
        for i, name in enumerate(names)
    )
    (tmp_path / "hand.xml").write_text(f"<mujoco><worldbody>{parts}</worldbody></mujoco>", encoding="utf-8")
    code, _, error = here(tmp_path, "layout", "new", "hand.xml", "--density", "1/cm2")
    assert code == 0, error
    groups = compiled(tmp_path, {"hand": "geometric"}, "low").plan.layout.groups
    assert groups == {"tips": tuple(names), "fingers": tuple(names), "hand": tuple(names)}


def test_a_shared_name_is_noted(tmp_path, here):
    text = FOUR_BAR.replace('name="left_rubber"', 'name="right_finger"')
    (tmp_path / "hand.xml").write_text(text)
    here(tmp_path, "layout", "new", "hand.xml")
    line = "# Note: geoms or meshes of other links are also called right_finger; a selection by that name takes both.\n"
    assert line in (tmp_path / "layout.yaml").read_text()


def test_links_with_names_of_groups_are_printed_plainly(tmp_path, here):
    finger = '<body name="{}" pos="{} 0 0"><joint axis="0 1 0" range="0 90"/><geom size=".01"/></body>'
    fingers = finger.format("tips", 0.03) + finger.format("hand", -0.03)
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><worldbody><body name="palm"><geom type="box" size=".03 .03 .01"/>{fingers}</body></worldbody></mujoco>'
    )
    _, output, _ = here(tmp_path, "layout", "new", "hand.xml")
    assert "group palm: palm\n" in output and "group tips: tips, hand\n" in output
    text = (tmp_path / "layout.yaml").read_text()
    assert "  palm: [palm]\n" in text and '  tips: [tips, "[h]and"]\n' in text
    groups = compiled(tmp_path, {"hand": "geometric"}, "low").plan.layout.groups
    assert (groups["palm"], groups["tips"]) == (("palm",), ("tips", "hand"))


def test_a_proposal_reports_which_link_it_samples(tmp_path):
    (tmp_path / "hand.urdf").write_text(URDF)
    output = []
    propose(load_model(tmp_path / "hand.urdf"), 1e4, progress=output.append)
    assert output == [f"sampling {name} ({i} of 3 links)" for i, name in enumerate(("base", "left", "right"), 1)]
