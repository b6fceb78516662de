"""The table of a robot's links: areas against closed forms, columns, groups."""

import warnings

import mujoco
import numpy as np
import pytest

from tgdsl.formats.robot import load_model
from tgdsl.placement.links import links_table

SHAPES = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <body name="box"><freejoint name="base"/><geom name="b" type="box" size=".01 .02 .03" mass=".1"/>
      <geom name="shown" type="sphere" size=".05" contype="0" conaffinity="0" mass="0"/>
      <body name="ball" pos=".1 0 0"><joint name="turn" axis="0 0 1" range="-45 90"/><joint type="slide" axis="1 0 0" range="0 .02"/>
        <geom type="sphere" size=".02" mass=".2"/>
        <body name="rod" pos=".1 0 0"><joint type="ball"/><geom type="cylinder" size=".01 .03" mass=".3"/></body>
      </body>
      <body pos="0 .1 0"><geom type="box" size=".01 .01 .01" contype="0" conaffinity="0"/></body>
      <body name="frame"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def shapes(tmp_path):
    (tmp_path / "shapes.xml").write_text(SHAPES)
    return tmp_path


def cells(line: str) -> list[str]:
    """Return the cells of a line: columns are at least two blanks apart."""
    return [cell for cell in line.strip().split("  ") if cell.strip()]


def test_links_areas_have_closed_forms(shapes, here):
    _, output, _ = here(shapes, "links", "shapes.xml")
    lines = {line.split()[0]: line for line in output.splitlines() if not line.startswith(" " * 20)}
    for name, area, rtol in (
        ("box", 8 * (1 * 2 + 2 * 3 + 1 * 3), 1e-3),
        ("ball", 4 * np.pi * 2**2, 3e-3),
        ("rod", 2 * np.pi * 1 * (1 + 6), 2e-3),
    ):
        printed = next(float(cell) for cell in cells(lines[name])[1:] if cell.strip().replace(".", "").isdigit())
        assert printed == pytest.approx(area, rel=rtol), name


def test_links_table(shapes, here):
    layout = "groups: {first: box, others: {include: [ball, rod]}, all: [first, others]}\n"
    (shapes / "layout.yaml").write_text(layout + "resolutions: {low: {box: {method: poisson, count: 3, radius: 1 mm}}}\n")
    code, output, error = here(shapes, "links", "shapes.xml", "--layout", "layout.yaml")
    assert code == 0, error
    assert output.splitlines() == links_table(load_model(shapes / "shapes.xml"), shapes / "layout.yaml")
    assert (
        output
        == """\
body         joints                     geoms                     area [cm²]  mass [g]  groups
world                                   ground: plane, colliding   unbounded
  box        base: free                 b: box, colliding              88.00     100.0  first, all
                                        shown: sphere, visual
    ball     turn: hinge -45 to 90 deg  sphere, colliding              50.21     200.0  others, all
             slide 0 to 20 mm
      rod    ball unlimited             cylinder, colliding            43.97     300.0  others, all
    box/[2]  -                          box, visual                        -       8.0
    frame    -                          -                                  -       0.0
"""
    )


def test_links_of_a_robot_by_name_shows_its_groups(tmp_path, here):
    code, output, error = here(tmp_path, "links", "xhand1")
    assert code == 0, error
    (line,) = [line for line in output.splitlines() if line.strip().startswith("right_hand_mid_link2")]
    assert line.startswith("      right_hand_mid_link2 ") and line.endswith("tips, fingers, hand")
    assert "hinge 0 to 110 deg" in line


def test_links_reports_mistakes_of_a_layout(shapes, here):
    (shapes / "layout.yaml").write_text(
        "groups: {first: bux}\nresolutions: {low: {box: {method: poisson, count: 3, radius: 1 mm}}}\n"
    )
    code, _, error = here(shapes, "links", "shapes.xml", "--layout", "layout.yaml")
    assert code == 2
    assert error.splitlines()[0] == 'layout.yaml:1:17: groups.first: no link matches "bux"; did you mean "box"?'
    code, _, error = here(shapes, "links", "shapes.xml", "--layout", "none.yaml")
    assert (code, error) == (2, "none.yaml: cannot read this file: No such file or directory\n1 mistake\n")


def test_links_shows_the_groups_of_the_layout_next_to_a_file(shapes, here):
    rest = "resolutions: {low: {box: {method: poisson, count: 3, radius: 1 mm}}}\n"
    (shapes / "layout.yaml").write_text("groups: {first: box}\n" + rest)
    code, output, error = here(shapes.parent, "links", f"{shapes.name}/shapes.xml")
    assert (code, error) == (0, "")
    assert next(line for line in output.splitlines() if line.startswith("  box ")).endswith("  first")
    (shapes / "layout.yaml").write_text("groups: {first: bux}\n" + rest)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        code, output, error = here(shapes, "links", "shapes.xml")
    assert code == 0 and "ball unlimited" in output and "first" not in output
    hint = "the layout next to this robot does not fit it, so no groups are shown"
    assert error.startswith('tgdsl: warning: layout.yaml:1:17: groups.first: no link matches "bux"') and error.endswith(
        f"; {hint}\n"
    )


def test_unnamed_bodies_are_identified_by_their_path(tmp_path):
    inner = "<body><geom size='.01'/><body name='{}'/><body><geom size='.01'/></body></body>"
    bodies = f"<body name='a'/>{inner.format('b')}<body name='c'>{inner.format('d')}</body>"
    (tmp_path / "r.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    robot = load_model(tmp_path / "r.xml")
    paths = [robot.body_path(i) for i in range(robot.compiled.nbody)]
    assert paths == ["world", "a", "world/[2]", "b", "world/[2]/[2]", "c", "c/[1]", "d", "c/[1]/[2]"]


def test_links_reports_contacts_in_the_initial_pose(tmp_path, here):
    """Two balls that overlap by 1 mm, with MuJoCo's contact force."""
    model = tmp_path / "hand.xml"
    finger = '<body name="{}" pos="{} 0 0"><joint type="slide" axis="1 0 0"/><geom size=".01" mass="1"/></body>'
    model.write_text(
        f"<mujoco><option cone='elliptic'/><worldbody>{finger.format('one', 0)}{finger.format('two', 0.019)}</worldbody></mujoco>"
    )
    compiled = mujoco.MjModel.from_xml_path(str(model))
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    code, out, _ = here(tmp_path, "links", str(model))
    assert code == 0
    assert out.splitlines()[-1] == f"in the initial pose one and two press on each other with {data.efc_force[0]:.3g} N"
