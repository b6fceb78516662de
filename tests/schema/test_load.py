"""All mistakes of a document are reported at once, located and with hints."""

import pytest
from documents import DOCUMENT, LAYOUT, POISSON, mistakes, read, write
from wrong import WRONG, WRONG_LAYOUT

from tgdsl.errors import SpecError, did_you_mean, listed
from tgdsl.schema.load import load, load_layout
from tgdsl.schema.yaml import parse


def test_a_valid_document_is_loaded(tmp_path):
    loaded = read(tmp_path, DOCUMENT + "    threshold: 1 mm\nobservations:\n  policy: [{type: bool, of: touch/clean}]\n")
    assert loaded.resolution == "low"
    assert loaded.spec.sensors["touch"].threshold == 1e-3
    assert loaded.layout.spec.resolutions["high"]["index_tip"].count == 9
    assert loaded.layout.raw(("groups", "tips", 0)) == "*_tip"
    assert loaded.robot_file.name == "xhand1_right.xml"


@pytest.mark.parametrize("name", WRONG)
def test_each_mistake_gives_one_message(tmp_path, name):
    document, message = WRONG[name]
    assert mistakes(tmp_path, document) == [message]


@pytest.mark.parametrize("name", WRONG_LAYOUT)
def test_mistakes_of_a_layout_name_its_file(tmp_path, name):
    more, message = WRONG_LAYOUT[name]
    layout = LAYOUT.replace(POISSON, f"{POISSON[:-1]}, {more}}}", 1)
    assert mistakes(tmp_path, layout=layout) == [message]


def test_mistakes_in_points_name_their_field(tmp_path):
    points = "{method: points, points: [{pos: [0, 0, 0], normal: [0, 0, 1]}], radius: x}"
    assert mistakes(tmp_path, layout=LAYOUT.replace(POISSON, points)) == [
        'layout.yaml:5:88: resolutions.low.index_tip.radius: "x" is not a quantity, '
        'expected a number in m or a string such as "4 µm"'
    ]
    bare = points.replace(", radius: x", "")
    assert mistakes(tmp_path, layout=LAYOUT.replace(POISSON, bare)) == [
        "layout.yaml:5:16: resolutions.low.index_tip: points[0] has no radius, and the list gives none for all"
    ]


def test_invalid_yaml_of_a_layout_is_reported(tmp_path):
    assert mistakes(tmp_path, layout="a: [\n") == [
        "layout.yaml:2:1: not YAML: expected the node content, but found '<stream end>'"
    ]
    assert mistakes(tmp_path, layout="") == ["layout.yaml:1:1: the document is empty"]
    assert mistakes(tmp_path, layout="groups: {}\n") == ['layout.yaml:1:1: missing key "resolutions"']


def test_a_layout_with_a_repeated_key_is_refused(tmp_path):
    (tmp_path / "layout.yaml").write_text(LAYOUT)
    assert set(load_layout(tmp_path / "layout.yaml").spec.resolutions) == {"low", "high"}
    (tmp_path / "layout.yaml").write_text(f"{LAYOUT}resolutions: {{}}\n")
    with pytest.raises(SpecError, match="resolutions"):
        load_layout(tmp_path / "layout.yaml")


def test_unreadable_files_are_reported(tmp_path):
    with pytest.raises(SpecError) as caught:
        load(tmp_path / "no.yaml")
    assert str(caught.value) == f"{tmp_path}/no.yaml: cannot read this file: No such file or directory"
    (tmp_path / "hand.yaml").write_bytes(b"tgdsl: \xff")
    with pytest.raises(SpecError) as caught:
        load(tmp_path / "hand.yaml")
    assert str(caught.value) == f"{tmp_path}/hand.yaml: not UTF-8 text: byte 7 is invalid start byte"


MANY = """\
tgdsl: 1
robot: {model: xhand1, layout: layout.yaml, colour: red}
objects:
  ball: {bodi: ball}
sensors:
  touch: {kind: contact, links: tips, feels: [ball], gate: far}
  depth: {kind: contact_depth, links: tips, feels: [ball, cube]}
noise:
  noisy: {gain: [2, 1]}
observations:
  policy:
    - {type: bool, of: touch}
    - {type: dept, of: depth}
    - {type: depth, of: deep}
resolution: middle
"""


def test_many_mistakes_are_sorted_and_cause_no_others(tmp_path):
    assert mistakes(tmp_path, MANY, LAYOUT.replace("2 mm", "2 mn", 1)) == [
        'hand.yaml:2:45: robot.colour: unknown key "colour"; known keys: collision, layout, model',
        'hand.yaml:4:10: objects.ball.bodi: unknown key "bodi"; did you mean "body"?',
        "hand.yaml:6:60: sensors.touch.gate: found \"far\", expected 'contact_pair' or 'geometric'",
        'hand.yaml:7:59: sensors.depth.feels[1]: unknown object "cube"; known objects: ball',
        "hand.yaml:9:10: noise.noisy: gain [2, 1] is not ordered, expected [low, high]",
        'hand.yaml:13:14: observations.policy[1].type: unknown type "dept"; did you mean "depth"?',
        'hand.yaml:14:25: observations.policy[2].of: unknown sensor "deep"; did you mean "depth"?',
        'hand.yaml:15:13: resolution: unknown resolution "middle"; known resolutions: high, low',
        'layout.yaml:5:52: resolutions.low.index_tip.radius: "mn" is not a unit of length, expected one of m, cm, mm, um, µm',
    ]


@pytest.mark.parametrize("found", ["3", "[{body: ball}]", "", "ball"])
def test_a_part_of_a_wrong_type_causes_no_unknown_names(tmp_path, found):
    expected = {"3": "3", "": "nothing", "ball": '"ball"'}.get(found, "a list of 1")
    document = DOCUMENT.replace("objects:\n  ball: {body: ball}\n  cube: {body: cube}\n", f"objects: {found}\n")
    document += f"    noise: mine\nnoise: {found}\nobservations: {found}\n"
    messages = [text.split(": ", 1)[1] for text in mistakes(tmp_path, document)]
    assert messages == [f"{key}: found {expected}, expected a mapping" for key in ("objects", "noise", "observations")]


def test_a_broken_profile_does_not_fall_back_to_a_built_in_one(tmp_path):
    assert mistakes(tmp_path, DOCUMENT + "    noise: noisy\nnoise:\n  noisy: {bias: x}\n") == [
        'hand.yaml:14:17: noise.noisy.bias: "x" is not a quantity, expected a number'
    ]


def test_an_alias_that_contains_itself_causes_no_others(tmp_path):
    document = DOCUMENT.replace("[ball]", "&a [ball, *a]")
    assert mistakes(tmp_path, document) == ["hand.yaml:11:12: sensors.touch.feels[1]: this alias contains itself"]


def test_mistakes_in_merged_sensors_are_located_at_the_value_used(tmp_path):
    document = DOCUMENT.replace("  touch:\n", "  touch: &touch\n")
    document += "  depth:\n    gate: far\n    kind: contact_depth\n    <<: *touch\n"
    assert mistakes(tmp_path, document) == [
        "hand.yaml:13:11: sensors.depth.gate: found \"far\", expected 'contact_pair' or 'geometric'"
    ]
    assert read(tmp_path, document.replace("far", "geometric")).spec.sensors["depth"].feels == ("ball",)


# Overrides and mappings ----------------------------------------------------------------------------------------------


def test_overrides_replace_values(tmp_path):
    overrides = {"resolution": "high", "sensors.touch.threshold": "2 mm", "noise.mine.bias": "0", "scene": "null"}
    loaded = read(tmp_path, overrides=overrides)
    assert loaded.resolution == "high"
    assert loaded.spec.sensors["touch"].threshold == 2e-3
    assert loaded.spec.noise["mine"].bias == {"*": (0.0, 0.0)}


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("resolution", "hi", '--set resolution=hi: resolution: unknown resolution "hi"; did you mean "high"?'),
        (
            "sensors.touch.gate",
            "far",
            "--set sensors.touch.gate=far: sensors.touch.gate: found \"far\", expected 'contact_pair' or 'geometric'",
        ),
        ("sensors.touch", "{kind: contact}", '--set sensors.touch={kind: contact}: sensors.touch: missing key "links"'),
        (
            "sensors.tuch.noise",
            "clean",
            '--set sensors.tuch.noise=clean: sensors.tuch: missing key "kind"; "tuch" is new: did you mean "touch"?',
        ),
        ("tgdsl.x", "1", "--set tgdsl.x=1: tgdsl.x: does not lead to a key of a mapping"),
        ("sensors.touch.feels.0", "cube", None),
        ("resolution", "", "--set resolution=:1:1: the document is empty"),
        ("resolution", "[", "--set resolution=[:1:2: not YAML: expected the node content, but found '<stream end>'"),
    ],
)
def test_wrong_overrides_are_refused(tmp_path, key, text, message):
    message = message or f"--set {key}={text}: {key}: does not lead to a key of a mapping"
    messages = mistakes(tmp_path, overrides={key: text})
    assert message in messages
    assert all(line.startswith("--set ") for line in messages)


def test_new_entries_are_compared_with_other_mappings():
    """`gates` is no misspelt `steps`, whose value leads nowhere."""
    source = parse("steps: 8\ntouch: {kind: contact}\n", "task.yaml")
    source.set("gates.taxels", "0")
    source.set("tuch.links", "tips")
    assert source.added == {"tuch": '"tuch" is new: did you mean "touch"?'}


def test_documents_can_be_mappings(tmp_path, monkeypatch):
    write(tmp_path)
    monkeypatch.chdir(tmp_path)
    document = {
        "tgdsl": 1,
        "robot": {"model": "xhand1", "layout": "layout.yaml"},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"touch": {"kind": "contact", "links": ("tips",), "feels": ("ball",)}},
    }
    assert load(document, {"resolution": "low"}).problems == []
    with pytest.raises(SpecError) as caught:
        load(document | {"objects": {1: {"body": "x"}}}, {"resolution": "lo"}).raise_problems()
    assert str(caught.value).split("\n") == [
        '--set resolution=lo: resolution: unknown resolution "lo"; did you mean "low"?',
        '<mapping>: objects.1: "1" is not a name, expected letters, digits, "_" and "-", first a letter or "_"',
        '<mapping>: sensors.touch.feels[0]: unknown object "ball"; known objects: 1',
    ]


def test_hints_list_what_exists():
    assert did_you_mean("x", [], "objects") == "there are no objects"
    assert did_you_mean("bal", ["ball", "cube"]) == 'did you mean "ball"?'
    assert did_you_mean("xyz", ["ball", "cube", "ball"]) == "known names: ball, cube"
    assert did_you_mean("gaussian", ["gain", "white_noise"]) == "known names: gain, white_noise"
    assert did_you_mean("normal_stiff", ["normal_stiffness"]) == 'did you mean "normal_stiffness"?'
    assert listed([str(i) for i in range(14)]) == "0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11 and 2 more"
