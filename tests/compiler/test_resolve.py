"""What a document means on a robot: selections, layouts, objects; and each mistake, told once and at its place."""

import json
import subprocess
import sys
from pathlib import Path

import igl
import numpy as np
import pytest

import tgdsl
from tgdsl.compiler.resolve import Resolved, resolve
from tgdsl.errors import SpecError
from tgdsl.schema.load import load

ROBOTS = Path(__file__).parents[2] / "robots"

HAND = """
<mujoco>
  <asset>
    <mesh name="skin" vertex="0 0 0  .01 0 0  0 .01 0  0 0 .01"/>
  </asset>
  <worldbody>
    <body name="palm">
      <freejoint/>
      <geom name="palm" type="box" size=".03 .03 .01"/>
      <geom name="back" type="box" size=".02 .02 .005" pos="0 0 -.015"/>
      <body name="index_1" pos=".04 0 0">
        <joint axis="0 1 0"/>
        <geom name="index_bone" type="box" size=".01 .01 .01" contype="0" conaffinity="0"/>
        <geom name="index_pad" type="box" size=".012 .01 .01"/>
        <body name="index_2" pos=".03 0 0"><joint axis="0 1 0"/><geom type="mesh" mesh="skin"/></body>
      </body>
      <body name="thumb_1" pos="0 .05 0">
        <joint axis="0 1 0"/>
        <geom name="thumb_pad" type="sphere" size=".01"/>
        <body name="thumb_2" pos="0 .03 0"><joint axis="0 1 0"/><geom type="mesh" mesh="skin"/></body>
        <body name="frame" pos="0 0 .1"/>
      </body>
    </body>
    <body name="cube" pos="0 0 1"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
    <body name="rock" pos="1 0 1"><freejoint/><geom name="pebble" type="mesh" mesh="skin"/></body>
    <body name="ghost" pos="2 0 1"><freejoint/><geom size=".1" mass="1" contype="0" conaffinity="0"/></body>
    <body name="nothing" pos="3 0 1"/>
  </worldbody>
</mujoco>
"""
POINT = {"method": "points", "points": [{"pos": [0, 0, 0], "normal": [0, 0, 1]}], "radius": 0.001}
PLACE = "{method: points, radius: 1 mm, points: [{pos: [0, 0, 0], normal: [0, 0, 1]}]}"
DOCUMENT = """tgdsl: 1
robot:
  model: hand.xml
  layout:
    groups:
      tips: ["*_2"]
      index: {include: ["index_*"]}
      thumb: {include: ["thumb*"], exclude: [tips]}
      all: {include: [index, thumb, palm]}
    resolutions:
      low:
        palm: PLACE
        index_1: PLACE
        index_2: PLACE
        thumb_pad: PLACE
      tip:
        index_2: PLACE
objects: {cube: {body: cube}}
resolution: low
sensors:
  touch: {kind: contact_depth, links: all, feels: [cube]}
""".replace("PLACE", PLACE)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    return tmp_path


def resolved(folder: Path, text: str = DOCUMENT) -> Resolved:
    (folder / "d.yaml").write_text(text)
    loaded = load(folder / "d.yaml")
    return resolve(loaded)


def with_layout(folder: Path, placements: dict, links: object = "*", **layout: object) -> Resolved:
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": {**layout, "resolutions": {"only": placements}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": {"kind": "contact_depth", "links": links, "feels": ["cube"]}},
    }
    return resolve(load(document))


def problems(folder: Path, *changes: tuple[str, str], text: str = DOCUMENT) -> list[str]:
    """Return the messages of a document with some text replaced, the file's folder left out."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "d.yaml").write_text(text)
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(folder / "d.yaml")
    return [line.removeprefix(f"{folder}/") for line in str(caught.value).splitlines()]


# layouts and selections


def test_groups_patterns_and_body_order(folder):
    found = resolved(folder)
    assert [(link.name, link.body) for link in found.layout.links] == [
        ("palm", "palm"),
        ("index_1", "index_1"),
        ("index_2", "index_2"),
        ("thumb_pad", "thumb_1"),
    ]
    assert found.links == {"touch": ("palm", "index_1", "index_2", "thumb_pad")}
    assert found.layout.groups == {
        "tips": ("index_2",),
        "index": ("index_1", "index_2"),
        "thumb": ("thumb_pad",),
        "all": ("palm", "index_1", "index_2", "thumb_pad"),
    }
    np.testing.assert_array_equal(found.layout.link_id, [0, 1, 2, 3])


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ("palm", ("palm",)),
        ("*_[12]", ("index_1", "index_2", "thumb_pad")),
        (["index_?", "palm"], ("palm", "index_1", "index_2")),
        ({"include": ["*"], "exclude": ["tips"]}, ("palm", "index_1", "thumb_pad")),
        ({"include": ["all"], "exclude": ["thumb", "*_1"]}, ("palm", "index_2")),
        ("thumb_1", ("thumb_pad",)),  # by the body that the geom belongs to
        ("skin", ("index_2",)),  # by the mesh that is sampled
        ({"include": ["palm"], "exclude": ["nobody*"]}, ("palm",)),
    ],
)
def test_selections(folder, links, expected):
    text = DOCUMENT.replace("links: all", f"links: {json.dumps(links)}")
    found = resolved(folder, text)
    assert found.links == {"touch": expected}
    assert {link.name for link in found.layout.links} == set(expected)


def test_links_that_no_sensor_has_are_not_sampled(folder):
    found = resolved(
        folder, DOCUMENT.replace("links: all", "links: palm").replace("objects: {", "objects: {rest: {body: thumb_1}, ")
    )
    assert found.layout.num_taxels == 1
    assert found.unused == (
        ("link index_1", "no sensor is on it"),
        ("link index_2", "no sensor is on it"),
        ("link thumb_pad", "no sensor is on it"),
        ("object rest", "no sensor feels it"),
    )


def test_a_body_is_sampled_where_it_collides_a_geom_where_it_is(folder):
    grid = {"method": "grid", "rows": 1, "columns": 1, "direction": [-1, 0, 0], "radius": 0.001}
    body = with_layout(folder, {"index_1": grid}).layout
    np.testing.assert_allclose(body.pos, [[0.012, 0, 0]], atol=1e-9)
    bone = with_layout(folder, {"index_bone": grid}).layout
    np.testing.assert_allclose(bone.pos, [[0.01, 0, 0]], atol=1e-9)
    assert [(link.name, link.body) for link in bone.links] == [("index_bone", "index_1")]


def test_keys_that_name_geoms_and_meshes(folder):
    found = with_layout(folder, {"*_pad": POINT, "back": POINT})
    assert [(link.name, link.body) for link in found.layout.links] == [
        ("back", "palm"),
        ("index_pad", "index_1"),
        ("thumb_pad", "thumb_1"),
    ]
    found = with_layout(folder, {"skin": POINT}, ["*_2"])
    assert [(link.name, link.body) for link in found.layout.links] == [("index_2/skin", "index_2"), ("thumb_2/skin", "thumb_2")]
    found = with_layout(folder, {"pebble": POINT, "palm": POINT}, "skin")
    assert [(link.name, link.body) for link in found.layout.links] == [("pebble", "rock")]


def test_a_pattern_for_several_bodies(folder):
    found = with_layout(folder, {"*_2": POINT, "palm": POINT})
    assert [link.name for link in found.layout.links] == ["palm", "index_2", "thumb_2"]


def test_two_layouts_for_one_link(folder):
    assert problems(
        folder, ("        index_2: " + PLACE + "\n        thumb", f'        "index_*": {PLACE}\n        thumb')
    ) == [
        'd.yaml:14:9: robot.layout.resolutions.low.index_*: link "index_1" already has a layout, by "index_1"; give each link one'
    ]


def test_layout_keys_that_name_nothing(folder):
    found = problems(folder, ("        index_1: ", "        index_3: "), ("        thumb_pad: ", "        frame: "))
    assert found == [
        'd.yaml:13:9: robot.layout.resolutions.low.index_3: no body, geom or mesh matches "index_3"; did you mean "index_2"?',
        'd.yaml:15:9: robot.layout.resolutions.low.frame: link "frame" has no geoms',
    ] or pytest.fail("\n".join(found))


# groups


def test_a_group_that_contains_itself(folder):
    """By way of another one, and in what that one leaves out."""
    found = problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", thumb]'))
    assert [line.split(": ")[1] for line in found] == ["robot.layout.groups.tips[1]", "robot.layout.groups.thumb.exclude[0]"]
    assert 'group "tips" contains itself' in found[0]
    assert 'group "thumb" contains itself' in found[1]


def test_a_group_right_inside_itself(folder):
    found = problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", tips]'))
    assert len(found) == 1
    assert 'group "tips" contains itself' in found[0]


def test_a_group_of_the_link_that_it_is_called_after(folder):
    """`palm: [palm]` is the link, wherever the group is named; and the same as without the group."""
    plain = resolved(folder)
    grouped = resolved(folder, DOCUMENT.replace('tips: ["*_2"]', 'palm: [palm]\n      tips: ["*_2"]'))
    assert dict(plain.links) == dict(grouped.links)
    assert grouped.layout.groups == {**plain.layout.groups, "palm": ("palm",)}


def test_a_layout_of_another_robot_is_one_mistake(folder):
    """However many links, groups and sensors it has; one link that is there makes it this robot's."""
    layout = {"groups": {"hand": ["a_*"], "tips": ["a_tip"]}, "resolutions": {"low": {"a_tip": POINT, "a_palm": POINT}}}
    touch = {"kind": "contact_depth", "feels": ["cube"]}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": layout},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"one": {**touch, "links": "hand"}, "two": {**touch, "links": "tips"}},
    }
    with pytest.raises(SpecError) as caught:
        resolve(load(document))
    assert str(caught.value) == (
        "<mapping>: robot.layout: this layout is for another robot: hand.xml has none of its 2 links; "
        "the layout has a_tip, a_palm; the robot has palm, index_1, index_2, thumb_1 and 6 more"
    )
    layout["resolutions"]["low"]["palm"] = POINT
    with pytest.raises(SpecError) as caught:
        resolve(load(document))
    assert len(caught.value.problems) == 6


def test_a_group_that_matches_nothing_is_told_where_it_is_defined(folder):
    assert problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", "*_tipp"]')) == [
        'd.yaml:6:21: robot.layout.groups.tips[1]: no link matches "*_tipp"; did you mean "tips"?'
    ]


# sensors


def test_a_link_that_nobody_has(folder):
    assert problems(folder, ("links: all", "links: [palm, indx_1]")) == [
        'd.yaml:21:46: sensors.touch.links[1]: no link matches "indx_1"; did you mean "index_1"?'
    ]
    assert problems(folder, ("links: all", "links: {include: [palms]}")) == [
        'd.yaml:21:50: sensors.touch.links.include[0]: no link matches "palms"; did you mean "palm"?'
    ]


def test_a_link_without_taxels_at_this_resolution(folder):
    assert problems(folder, ("resolution: low", "resolution: tip"), ("links: all", "links: palm")) == [
        'd.yaml:21:39: sensors.touch.links: the layout puts no taxels on what this selects at resolution "tip"; '
        "links with taxels: index_2"
    ]


def test_exclude_leaves_no_link(folder):
    assert problems(folder, ("links: all", 'links: {include: [index], exclude: ["*"]}')) == [
        "d.yaml:21:39: sensors.touch.links: `exclude` leaves no link"
    ]


def pointed(text: str, line: str) -> tuple[str, str]:
    """Return what stands in a document where a message points to, and the message."""
    _, row, column, message = line.split(":", 3)
    return text.splitlines()[int(row) - 1][int(column) - 1 :], message.strip()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "links: all",
            'links: {include: [all], exclude: [indx_1, "nobody*"]}',
            {'indx_1, "': 'sensors.touch.links.exclude[0]: no link matches "indx_1"; did you mean "index_1"?'},
        ),
        (
            "exclude: [tips]",
            "exclude: [tips, tip]",
            {"tip]": 'robot.layout.groups.thumb.exclude[1]: no link matches "tip"; did you mean "tips"?'},
        ),
        (
            "links: all",
            "links: {include: [indx_1], exclude: [palm, indx_1]}",
            {
                "indx_1], e": 'sensors.touch.links.include[0]: no link matches "indx_1"; did you mean "index_1"?',
                "indx_1]}": 'sensors.touch.links.exclude[1]: no link matches "indx_1"; did you mean "index_1"?',
            },
        ),
    ],
)
def test_a_plain_name_that_is_excluded_exists(folder, old, new, expected):
    text = DOCUMENT.replace(old, new)
    found = [pointed(text, line) for line in problems(folder, text=text)]
    assert [message for _, message in found] == list(expected.values())
    assert all(there.startswith(what) for (there, _), what in zip(found, expected, strict=True))


def test_what_has_no_taxels_at_this_resolution_may_be_excluded(folder):
    assert resolved(folder, DOCUMENT.replace("resolution: low", "resolution: tip")).links == {"touch": ("index_2",)}
    text = DOCUMENT.replace("resolution: low", "resolution: tip").replace(
        "links: all", "links: {include: [all], exclude: [palm]}"
    )
    assert resolved(folder, text).links == {"touch": ("index_2",)}


def test_a_geom_that_a_region_excludes_exists(folder):
    patch = "{method: poisson, count: 3, radius: 1 mm, region: REGION}"
    for region, where in (
        ("{geoms: {include: ['*'], exclude: [thumb_pda]}}", "geoms.exclude[0]"),
        (
            "[{facing: [0, 0, 1], within: 90 deg}, {geoms: {include: ['*'], exclude: ['zz*', thumb_pda]}}]",
            "[1].geoms.exclude[1]",
        ),
    ):
        text = DOCUMENT.replace(f"palm: {PLACE}", f"palm: {patch.replace('REGION', region)}")
        (line,) = problems(folder, text=text)
        dotted = f"region{where}" if where.startswith("[") else f"region.{where}"
        there, message = pointed(text, line)
        what = 'no geom or mesh matches "thumb_pda"; did you mean "thumb_pad"?'
        assert message == f"robot.layout.resolutions.low.palm.{dotted}: {what}"
        assert there.startswith("thumb_pda")
    fine = "{geoms: {include: ['*'], exclude: [thumb_pad]}}"  # on another link, as where one region is for several
    resolved(folder, DOCUMENT.replace(f"palm: {PLACE}", f"palm: {patch.replace('REGION', fine)}"))


# objects and scenes


def test_objects(folder):
    assert problems(folder, ("{body: cube}", "{body: cub}")) == [
        'd.yaml:18:24: objects.cube.body: no body is named "cub"; did you mean "cube"?'
    ]
    assert problems(folder, ("{body: cube}", "{body: nothing}")) == [
        'd.yaml:18:24: objects.cube.body: body "nothing" has no geoms to feel'
    ]
    assert problems(folder, ("{body: cube}", "{body: rock, surface: pebbel}")) == [
        'd.yaml:18:24: objects.cube.body: no geom or mesh of body "rock" matches "pebbel"; it has pebble, skin'
    ]


def test_what_can_never_be_in_contact(folder):
    place = "d.yaml:21:52: sensors.touch.feels[0]: "
    assert problems(folder, ("{body: cube}", "{body: ghost}")) == [
        f'{place}"cube" can never be in contact with a link of this sensor: the simulator does not collide them; '
        "let them collide, or use `gate: geometric`"
    ]
    (folder / "d.yaml").write_text(
        DOCUMENT.replace("{body: cube}", "{body: ghost}").replace("feels: [cube]", "feels: [cube], gate: geometric")
    )
    touch = tgdsl.compile(folder / "d.yaml")
    assert touch.inputs.pairs == ()
    assert touch.inputs.bodies == ("ghost", "index_1", "index_2", "palm", "thumb_1")


def test_pairs_that_never_meet_are_dropped_and_told(folder):
    """The palm is the parent of its fingers, which MuJoCo does not collide with it; the fingers' tips it does."""
    changes = DOCUMENT.replace("{body: cube}", "{body: thumb_1}")
    touch = tgdsl.compile({**_plain(folder, changes)})
    assert [(pair.link, pair.object) for pair in touch.inputs.pairs] == [("index_1", "cube"), ("index_2", "cube")]
    assert touch.plan.dropped == (
        ("pair palm – cube", "they can never be in contact"),
        ("pair thumb_1 – cube", "they can never be in contact"),
    )


def _plain(folder: Path, text: str) -> dict:
    from tgdsl.schema.yaml import parse

    value = parse(text, "d.yaml").value
    value["robot"]["model"] = str(folder / "hand.xml")
    return value


def test_a_scene_lacks_a_body_of_the_robot(folder):
    (folder / "scene.xml").write_text(HAND.replace('"index_2"', '"index_tip"'))
    assert problems(folder, ("objects:", "scene: {model: scene.xml}\nobjects:")) == [
        'd.yaml:18:16: scene.model: the scene has no body "index_2", which the robot has; '
        'a scene keeps the robot\'s names; did you mean "index_1"?'
    ]


def test_files_that_are_not_there(folder):
    assert problems(folder, ("model: hand.xml", "model: hnd.xml"), ("objects:", "scene: {model: scen.xml}\nobjects:")) == [
        'd.yaml:3:10: robot.model: there is no file or robot "hnd.xml"; ' + _robots(),
        'd.yaml:18:16: scene.model: there is no file "scen.xml"; paths are relative to this document',
    ]
    assert problems(folder, ("model: hand.xml", "model: ../hand.xml")) == [
        'd.yaml:3:10: robot.model: there is no file or robot "../hand.xml"; paths are relative to this document'
    ]


def _robots() -> str:
    from tgdsl.errors import did_you_mean
    from tgdsl.files.find import robot_names

    return did_you_mean("hnd.xml", robot_names(), "robots")


def test_a_placement_that_the_surface_cannot_satisfy(folder):
    grid = "{method: grid, rows: 2, columns: 2, direction: [0, 0, -1], radius: 1 mm, region: {box: {min: [1, 1, 1], max: [2, 2, 2]}}}"
    found = problems(
        folder, (f"        palm: {PLACE}", f"        palm: {grid}"), (f"        index_1: {PLACE}", f"        index_1: {grid}")
    )
    assert [line.split(": ")[:3] for line in found] == [
        ["d.yaml:12:15", "robot.layout.resolutions.low.palm", 'link "palm"'],
        ["d.yaml:13:18", "robot.layout.resolutions.low.index_1", 'link "index_1"'],
    ]


# all at once

EIGHT = (
    DOCUMENT
    + """  grip: {kind: contact_depth, links: tipps, feels: [cube]}
  hot: {kind: thermometer, links: palm, feels: [cube]}
  hit: {kind: contact, links: palm, feels: [cub]}
  hat: {kind: contact, links: palm, feels: [cube], threshold: 4 kg}
observations:
  policy: [{type: depth, of: touhc}]
"""
)


def test_eight_mistakes_are_eight_lines(folder):
    text = EIGHT.replace("        index_1: ", "        index_3: ").replace("objects: {", "objects: {ball: {body: bal}, ")
    text = text.replace('tips: ["*_2"]', 'tips: ["*_22"]')
    (folder / "bad.yaml").write_text(text)
    ran = subprocess.run(
        [sys.executable, "-m", "tgdsl", "compile", "bad.yaml"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 2
    assert ran.stdout == ""
    lines = ran.stderr.splitlines()
    assert lines[-1] == f"{len(lines) - 1} mistakes"
    assert [tuple(line.split(": ")[:2]) for line in lines[:-1]] == [
        ("bad.yaml:6:14", "robot.layout.groups.tips[0]"),
        ("bad.yaml:13:9", "robot.layout.resolutions.low.index_3"),
        ("bad.yaml:18:24", "objects.ball.body"),
        ("bad.yaml:22:38", "sensors.grip.links"),
        ("bad.yaml:23:15", "sensors.hot.kind"),
        ("bad.yaml:24:45", "sensors.hit.feels[0]"),
        ("bad.yaml:25:63", "sensors.hat.threshold"),
        ("bad.yaml:27:30", "observations.policy[0].of"),
    ], ran.stderr


@pytest.mark.slow
def test_the_xhand1_at_every_resolution():
    document = {
        "tgdsl": 1,
        "robot": {"model": "xhand1"},
        "scene": {"model": str(ROBOTS.parent / "examples" / "palm_cube.xml")},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": {"kind": "contact_depth", "links": "hand", "feels": ["cube"]}},
    }
    counts = {}
    for resolution in ("low", "med", "high"):
        found = resolve(load({**document, "resolution": resolution}))
        layout, robot = found.layout, found.robot
        counts[resolution] = layout.num_taxels
        np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, rtol=1e-9)
        for i, link in enumerate(layout.links):
            surface = robot.surface(robot.touchable(link.body))
            squared, *_ = igl.point_mesh_squared_distance(layout.pos[layout.link_id == i], surface.vertices, surface.faces)
            assert squared.max() < 1e-12
    assert counts == {"low": 90, "med": 199, "high": 667}
