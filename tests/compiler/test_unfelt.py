"""What compile, explain and artefacts say of taxels that cannot feel: only where it matters to a sensor, by name and count."""

import json
import re
import warnings

import pytest
from covered_hands import hand

import tgdsl
from tgdsl.compiler.pipeline import compile_document, placed
from tgdsl.errors import UnfeltWarning

POINTS = {
    "palm": [[0.01, 0.02, 0.02], [0.03, 0.005, 0.02], [0, 0.025, 0.03]],  # in the hollow, in the finger, free
    "finger": [[0.02, 0.003, 0]],
    "the tip": [[0.004, 0, 0], [-0.004, 0, 0]],
    "thumb": [[0.01, 0.01, 0.02]],
}
DEPTH = {"kind": "contact_depth", "links": "*", "feels": ["cube"]}
BURIED = "palm: 1 of 3 taxels buried in the link's own colliding geoms, up to 7.1 mm deep, beyond their radius"
INSIDE = 'palm: 1 of 3 taxels inside "finger" in the initial state'
BARE = "the tip: 2 of 2 taxels on a body that the simulator does not collide"
THUMB = "thumb: 1 of 1 taxels buried in the link's own colliding geoms, up to 10 mm deep, beyond their radius"


def document(folder, sensors: dict, text: str = hand(), **points: list) -> dict:
    (folder / "hand.xml").write_text(text)
    lists = {
        link: {"method": "points", "radius": "2 mm", "points": [{"pos": pos, "normal": [0, 0, 1]} for pos in own]}
        for link, own in (points or POINTS).items()
    }
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": {"resolutions": {"only": lists}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": sensors,
    }


def told(made: dict) -> tuple[list[str], list[str]]:
    """Return what compiling warns of, and what the plan keeps."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan = compile_document(made).plan
    assert all(issubclass(warning.category, UnfeltWarning) for warning in caught)
    return [str(warning.message) for warning in caught], [str(own) for own in plan.unfelt]


def test_one_warning_names_and_counts_all(tmp_path):
    """One per document, however many sensors there are on a taxel."""
    found, kept = told(document(tmp_path, {"a": DEPTH, "b": {**DEPTH, "kind": "contact"}}))
    assert kept == [BURIED, INSIDE, BARE, THUMB]
    hint = "in the layout `surface: collision` and `exposed: true` would place them elsewhere"
    assert found == [f"<mapping>: 5 of 7 taxels cannot feel: {'; '.join(kept)}; {hint}"]


def test_what_is_gated_by_geometry_feels_without_colliders(tmp_path):
    """A taxel that nothing collides feels by distance; a buried one does not, as the cube stays out of the hull."""
    geometric = {**DEPTH, "gate": "geometric"}
    assert told(document(tmp_path, {"a": geometric}))[1] == [BURIED, INSIDE, THUMB]
    assert told(document(tmp_path, {"a": {"kind": "proximity", "links": "*", "feels": ["cube"]}}))[1] == [BURIED, INSIDE, THUMB]
    # One of two sensors on the link cannot.
    mixed = {"a": geometric, "b": {**DEPTH, "links": ["the tip", "finger"]}}
    assert told(document(tmp_path, mixed))[1] == [BURIED, INSIDE, BARE, THUMB]


def test_forces_of_contacts_need_contacts_whatever_the_gate(tmp_path):
    force = {"kind": "force_taxel", "links": ["the tip", "finger"], "feels": ["cube"], "gate": "geometric"}
    assert told(document(tmp_path, {"a": force}))[1] == [BARE]


@pytest.mark.parametrize(
    "change",
    [
        ('<exclude body1="finger" body2="cube"/>', "</contact>", '<exclude body1="finger" body2="cube"/></contact>'),
        ("masks", 'name="finger" type="box"', 'name="finger" type="box" contype="2" conaffinity="2"'),
    ],
    ids=["exclude", "masks"],
)
def test_contacts_that_can_never_be(tmp_path, change):
    """An excluded pair, and masks that do not meet: the finger collides, but never with what its sensor feels by contact."""
    _, old, new = change
    text = hand().replace(old, new)
    why = "finger: 1 of 1 taxels on a body that is never in contact with its sensor's objects, which it reads by contact alone"
    assert told(document(tmp_path, {"a": {**DEPTH, "links": ["finger", "palm"]}}, text))[1] == [BURIED, INSIDE, why]
    # Nothing keeps the cube out of the finger then, so what is inside it feels by distance.
    inner = {"finger": [[0.02, 0, 0]], "palm": [[0, 0.025, 0.03]]}
    geometric = {**DEPTH, "links": ["finger", "palm"], "gate": "geometric"}
    assert told(document(tmp_path, {"a": geometric}, text, **inner)) == ([], [])
    assert len(told(document(tmp_path, {"a": geometric}, **inner))[1]) == 1


def test_links_that_no_sensor_is_on_and_kinds_that_feel_no_object(tmp_path):
    """Only what sensors have counts; the net force on a body is no reading of its taxels."""
    assert told(document(tmp_path, {"a": {**DEPTH, "links": "finger"}})) == ([], [])
    link = {"kind": "link_contact", "links": ["palm", "the tip"], "feels": ["cube"]}
    assert told(document(tmp_path, {"a": {**DEPTH, "links": "finger"}, "b": link})) == ([], [])


def test_the_account_and_the_artefact_say_the_same(tmp_path):
    with pytest.warns(UnfeltWarning, match="5 of 7 taxels cannot feel"):
        touch = tgdsl.compile(document(tmp_path, {"a": DEPTH}))
    lines = "\n".join(["5 taxels cannot feel", *(f"  {own}" for own in (BURIED, INSIDE, BARE, THUMB))])
    assert lines in touch.explain()
    tgdsl.save(touch, tmp_path / "hand.safetensors")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = tgdsl.load(tmp_path / "hand.safetensors")
    assert again.explain() == touch.explain()
    assert [own.taxels.tolist() for own in again.plan.unfelt] == [[0], [1], [4, 5], [6]]
    clean = tgdsl.compile(document(tmp_path, {"a": {**DEPTH, "links": "finger"}}))
    assert "cannot feel" not in clean.explain() and clean.plan.unfelt == ()


def test_taxels_stay_where_they_are(tmp_path):
    """What cannot feel is told, not moved."""
    with pytest.warns(UnfeltWarning):
        plan = compile_document(document(tmp_path, {"a": DEPTH})).plan
    assert plan.layout.pos.tolist() == [pos for own in POINTS.values() for pos in own]


def test_of_many_links_the_warning_names_the_first(tmp_path):
    bodies = "".join(
        f'<body name="l{i}" pos="{i} 0 0"><joint/><geom size=".01" contype="0" conaffinity="0"/></body>' for i in range(11)
    )
    text = hand().replace('<body name="cube"', f'{bodies}<body name="cube"')
    points = {"finger": [[0.02, 0.003, 0]], **{f"l{i}": [[0, 0, 0]] for i in range(11)}}
    ((message,), kept) = told(document(tmp_path, {"a": DEPTH}, text, **points))
    assert len(kept) == 11 and message.count(" taxels on a body") == 8 and message.endswith("; and 3 more, see `explain`")


def test_pictures_know_them_without_sensors(tmp_path):
    made = document(tmp_path, {})
    found = placed({key: made[key] for key in ("tgdsl", "robot")})
    assert [str(own) for own in found.unfelt["only"]] == [BURIED, INSIDE, BARE, THUMB]


@pytest.mark.filterwarnings("default::tgdsl.errors.UnfeltWarning")
def test_commands_count_them(tmp_path, here):
    """Render prints the count of a document's layout and of an artefact's; compile warns once, on its error stream."""
    made = document(tmp_path, {"a": DEPTH})
    (tmp_path / "hand.yaml").write_text(json.dumps(made))
    code, said, error = here(tmp_path, "compile", "hand.yaml")
    assert code == 0 and said.startswith("7 taxels on 4 links")
    assert re.fullmatch(r"tgdsl: warning: hand\.yaml: 5 of 7 taxels cannot feel: .*\n", error.splitlines(keepends=True)[-1])
    for name in ("hand.yaml", "hand.safetensors"):
        code, said, error = here(tmp_path, "render", name, "--size", "300", "300")
        assert code == 0, error
        assert said.splitlines()[:2] == [
            "only: 7 taxels",
            "only: 5 taxels cannot feel: not collided 2, buried 2, covered at rest 1",
        ]
