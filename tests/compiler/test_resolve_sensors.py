"""Sensors, objects and scenes resolved on a robot, and one located message per mistake."""

from pathlib import Path

import pytest
from resolve_cases import DOCUMENT, HAND, PLACE, problems, resolved

import tgdsl


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    return tmp_path


def test_an_unknown_link_is_reported(folder):
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


def text_and_message(text: str, line: str) -> tuple[str, str]:
    """Return the text of a document that a message points to, and the message."""
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
def test_an_excluded_plain_name_must_exist(folder, old, new, expected):
    text = DOCUMENT.replace(old, new)
    located = [text_and_message(text, line) for line in problems(folder, text=text)]
    assert [message for _, message in located] == list(expected.values())
    assert all(text_there.startswith(start) for (text_there, _), start in zip(located, expected, strict=True))


def test_links_without_taxels_may_be_excluded(folder):
    assert resolved(folder, DOCUMENT.replace("resolution: low", "resolution: tip")).links == {"touch": ("index_2",)}
    text = DOCUMENT.replace("resolution: low", "resolution: tip").replace(
        "links: all", "links: {include: [all], exclude: [palm]}"
    )
    assert resolved(folder, text).links == {"touch": ("index_2",)}


def test_a_geom_that_a_region_excludes_must_exist(folder):
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
        text_there, message = text_and_message(text, line)
        expected = 'no geom or mesh matches "thumb_pda"; did you mean "thumb_pad"?'
        assert message == f"robot.layout.resolutions.low.palm.{dotted}: {expected}"
        assert text_there.startswith("thumb_pda")
    fine = "{geoms: {include: ['*'], exclude: [thumb_pad]}}"  # on another link, as when several links share a region
    resolved(folder, DOCUMENT.replace(f"palm: {PLACE}", f"palm: {patch.replace('REGION', fine)}"))


def test_unknown_objects_are_reported(folder):
    assert problems(folder, ("{body: cube}", "{body: cub}")) == [
        'd.yaml:18:24: objects.cube.body: no body is named "cub"; did you mean "cube"?'
    ]
    assert problems(folder, ("{body: cube}", "{body: nothing}")) == [
        'd.yaml:18:24: objects.cube.body: body "nothing" has no geoms to feel'
    ]
    assert problems(folder, ("{body: cube}", "{body: rock, surface: pebbel}")) == [
        'd.yaml:18:24: objects.cube.body: no geom or mesh of body "rock" matches "pebbel"; it has pebble, skin'
    ]


def test_objects_that_never_touch_are_refused_behind_a_contact_gate(folder):
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


@pytest.mark.parametrize("flag", ["contact", "constraint"])
def test_a_scene_without_contacts_names_the_flag(folder, flag):
    scene = HAND.replace("<mujoco>", f'<mujoco><option><flag {flag}="disable"/></option>')
    (folder / "hand.xml").write_text(scene)
    (message, *_) = problems(folder)
    assert message.endswith(f'the scene\'s <option> has <flag {flag}="disable"/>; take it out, or use `gate: geometric`')


@pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning")
def test_pairs_that_never_meet_are_dropped_and_listed(folder):
    """MuJoCo does not collide the palm with its child bodies, only with the fingertips."""
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
    messages = problems(
        folder, (f"        palm: {PLACE}", f"        palm: {grid}"), (f"        index_1: {PLACE}", f"        index_1: {grid}")
    )
    assert [line.split(": ")[:3] for line in messages] == [
        ["d.yaml:12:15", "robot.layout.resolutions.low.palm", 'link "palm"'],
        ["d.yaml:13:18", "robot.layout.resolutions.low.index_1", 'link "index_1"'],
    ]


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


def test_eight_mistakes_are_eight_lines(folder, here):
    text = EIGHT.replace("        index_1: ", "        index_3: ").replace("objects: {", "objects: {ball: {body: bal}, ")
    text = text.replace('tips: ["*_2"]', 'tips: ["*_22"]')
    (folder / "bad.yaml").write_text(text)
    code, output, error = here(folder, "compile", "bad.yaml")
    assert code == 2
    assert output == ""
    lines = error.splitlines()
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
    ], error
