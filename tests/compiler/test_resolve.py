"""Layouts resolved on a robot: links, groups, geoms and meshes; and one located message per mistake."""

import json
from pathlib import Path

import igl
import numpy as np
import pytest
from resolve_cases import DOCUMENT, HAND, PLACE, POINT, problems, resolved, with_layout

from tgdsl.compiler.resolve import resolve
from tgdsl.errors import SpecError
from tgdsl.schema.load import load

ROBOTS = Path(__file__).parents[2] / "robots"


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    return tmp_path


def test_groups_patterns_and_body_order(folder):
    result = resolved(folder)
    assert [(link.name, link.body) for link in result.layout.links] == [
        ("palm", "palm"),
        ("index_1", "index_1"),
        ("index_2", "index_2"),
        ("thumb_pad", "thumb_1"),
    ]
    assert result.links == {"touch": ("palm", "index_1", "index_2", "thumb_pad")}
    assert result.layout.groups == {
        "tips": ("index_2",),
        "index": ("index_1", "index_2"),
        "thumb": ("thumb_pad",),
        "all": ("palm", "index_1", "index_2", "thumb_pad"),
    }
    np.testing.assert_array_equal(result.layout.link_id, [0, 1, 2, 3])


@pytest.mark.parametrize(
    ("links", "expected"),
    [
        ("palm", ("palm",)),
        ("*_[12]", ("index_1", "index_2", "thumb_pad")),
        (["index_?", "palm"], ("palm", "index_1", "index_2")),
        ({"include": ["*"], "exclude": ["tips"]}, ("palm", "index_1", "thumb_pad")),
        ({"include": ["all"], "exclude": ["thumb", "*_1"]}, ("palm", "index_2")),
        ("thumb_1", ("thumb_pad",)),  # by the body of the geom
        ("skin", ("index_2",)),  # by the mesh that is sampled
        ({"include": ["palm"], "exclude": ["nobody*"]}, ("palm",)),
    ],
)
def test_selections(folder, links, expected):
    text = DOCUMENT.replace("links: all", f"links: {json.dumps(links)}")
    result = resolved(folder, text)
    assert result.links == {"touch": expected}
    assert {link.name for link in result.layout.links} == set(expected)


def test_links_without_sensors_are_not_sampled(folder):
    result = resolved(
        folder, DOCUMENT.replace("links: all", "links: palm").replace("objects: {", "objects: {rest: {body: thumb_1}, ")
    )
    assert result.layout.num_taxels == 1
    assert result.unused == (
        ("link index_1", "no sensor is on its taxels"),
        ("link index_2", "no sensor is on its taxels"),
        ("link thumb_pad", "no sensor is on its taxels"),
        ("object rest", "no sensor feels it"),
    )


def test_unfelt_bodies_of_the_scene_are_named_by_their_path(folder):
    """Bodies of the robot and of objects are not listed."""
    hand = HAND.replace('<body name="frame" pos="0 0 .1"/>', '<body pos="0 0 .1"><geom size=".001"/></body>')
    (folder / "hand.xml").write_text(hand)
    lid = '<body><geom size=".01"/></body>'
    bodies = f'<body name="box" pos="9 0 0"><freejoint/><geom size=".1"/>{lid}</body>'
    bodies += '<body name="lamp" pos="8 0 0"><geom size=".1"/><body/><body pos="0 0 1"><geom size=".1"/></body></body>'
    bodies += '<body pos="7 0 0"><geom size=".1"/></body>'
    (folder / "scene.xml").write_text(f'<mujoco><include file="hand.xml"/><worldbody>{bodies}</worldbody></mujoco>')
    text = DOCUMENT.replace("resolution: low", "scene: {model: scene.xml}\nresolution: low")
    text = text.replace("objects: {", "objects: {box: {body: box}, ").replace("feels: [", "feels: [box, ")
    assert dict(resolved(folder, text).unused) == {
        "body lamp": "not listed under `objects`",
        "body lamp/[2]": "no name, so `objects` cannot list it",
        "body world/[8]": "no name, so `objects` cannot list it",
    }


def test_a_body_is_sampled_on_colliding_geoms_and_a_geom_on_itself(folder):
    grid = {"method": "grid", "rows": 1, "columns": 1, "direction": [-1, 0, 0], "radius": 0.001}
    body = with_layout(folder, {"index_1": grid}).layout
    np.testing.assert_allclose(body.pos, [[0.012, 0, 0]], atol=1e-9)
    bone = with_layout(folder, {"index_bone": grid}).layout
    np.testing.assert_allclose(bone.pos, [[0.01, 0, 0]], atol=1e-9)
    assert [(link.name, link.body) for link in bone.links] == [("index_bone", "index_1")]


def test_keys_that_name_geoms_and_meshes(folder):
    result = with_layout(folder, {"*_pad": POINT, "back": POINT})
    assert [(link.name, link.body) for link in result.layout.links] == [
        ("back", "palm"),
        ("index_pad", "index_1"),
        ("thumb_pad", "thumb_1"),
    ]
    result = with_layout(folder, {"skin": POINT}, ["*_2"])
    assert [(link.name, link.body) for link in result.layout.links] == [
        ("index_2/skin", "index_2"),
        ("thumb_2/skin", "thumb_2"),
    ]
    result = with_layout(folder, {"pebble": POINT, "palm": POINT}, "skin")
    assert [(link.name, link.body) for link in result.layout.links] == [("pebble", "rock")]


def test_a_pattern_for_several_bodies(folder):
    result = with_layout(folder, {"*_2": POINT, "palm": POINT})
    assert [link.name for link in result.layout.links] == ["palm", "index_2", "thumb_2"]


def test_two_layouts_for_one_link(folder):
    assert problems(
        folder, ("        index_2: " + PLACE + "\n        thumb", f'        "index_*": {PLACE}\n        thumb')
    ) == [
        'd.yaml:14:9: robot.layout.resolutions.low.index_*: link "index_1" already has a layout, by "index_1"; give each link one'
    ]


def test_layout_keys_that_name_nothing(folder):
    messages = problems(folder, ("        index_1: ", "        index_3: "), ("        thumb_pad: ", "        frame: "))
    assert messages == [
        'd.yaml:13:9: robot.layout.resolutions.low.index_3: no body, geom or mesh matches "index_3"; did you mean "index_2"?',
        'd.yaml:15:9: robot.layout.resolutions.low.frame: link "frame" has no geoms',
    ] or pytest.fail("\n".join(messages))


def test_a_group_that_contains_itself(folder):
    """Through another group, and through what that group excludes."""
    messages = problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", thumb]'))
    assert [line.split(": ")[1] for line in messages] == ["robot.layout.groups.tips[1]", "robot.layout.groups.thumb.exclude[0]"]
    assert 'group "tips" contains itself' in messages[0]
    assert 'group "thumb" contains itself' in messages[1]


def test_a_group_that_directly_contains_itself(folder):
    messages = problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", tips]'))
    assert len(messages) == 1
    assert 'group "tips" contains itself' in messages[0]


def test_a_group_may_have_the_name_of_its_link(folder):
    """`palm: [palm]` selects the link, as without the group."""
    plain = resolved(folder)
    grouped = resolved(folder, DOCUMENT.replace('tips: ["*_2"]', 'palm: [palm]\n      tips: ["*_2"]'))
    assert dict(plain.links) == dict(grouped.links)
    assert grouped.layout.groups == {**plain.layout.groups, "palm": ("palm",)}


def test_a_layout_of_another_robot_is_one_mistake(folder):
    """However many links, groups and sensors it has; one link that exists makes it this robot's."""
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


def test_a_group_that_matches_nothing_is_reported_at_its_definition(folder):
    assert problems(folder, ('tips: ["*_2"]', 'tips: ["*_2", "*_tipp"]')) == [
        'd.yaml:6:21: robot.layout.groups.tips[1]: no link matches "*_tipp"; did you mean "tips"?'
    ]


def test_a_mistake_in_a_group_is_reported_once(folder):
    """References to the group add no messages."""
    assert problems(folder, ('tips: ["*_2"]', 'tips: {includ: ["*_2"]}')) == [
        'd.yaml:6:7: robot.layout.groups.tips: missing key "include"',
        'd.yaml:6:14: robot.layout.groups.tips.includ: unknown key "includ"; did you mean "include"?',
    ]
    assert problems(folder, ('tips: ["*_2"]', 'tips: ["*_tipp"]')) == [
        'd.yaml:6:14: robot.layout.groups.tips[0]: no link matches "*_tipp"; did you mean "tips"?'
    ]


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
        resolved_document = resolve(load({**document, "resolution": resolution}))
        layout, robot = resolved_document.layout, resolved_document.robot
        counts[resolution] = layout.num_taxels
        np.testing.assert_allclose(np.linalg.norm(layout.normal, axis=1), 1, rtol=1e-9)
        for i, link in enumerate(layout.links):
            surface = robot.surface(robot.touchable(link.body))
            squared, *_ = igl.point_mesh_squared_distance(layout.pos[layout.link_id == i], surface.vertices, surface.faces)
            assert squared.max() < 1e-12
    assert counts == {"low": 90, "med": 199, "high": 667}
