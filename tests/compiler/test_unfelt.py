"""Taxels that cannot feel: compile, explain and artefacts name and count those of sensors."""

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
        link: {"method": "points", "radius": "2 mm", "points": [{"pos": pos, "normal": [0, 0, 1]} for pos in positions]}
        for link, positions in (points or POINTS).items()
    }
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "hand.xml"), "layout": {"resolutions": {"only": lists}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": sensors,
    }


def warnings_and_records(description: dict) -> tuple[list[str], list[str]]:
    """Return the warnings of compiling, and the records in the plan."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan = compile_document(description).plan
    assert all(issubclass(warning.category, UnfeltWarning) for warning in caught)
    return [str(warning.message) for warning in caught], [str(record) for record in plan.unfelt]


def test_one_warning_names_and_counts_all_taxels(tmp_path):
    """One per document, however many sensors there are on a taxel."""
    messages, records = warnings_and_records(document(tmp_path, {"a": DEPTH, "b": {**DEPTH, "kind": "contact"}}))
    assert records == [BURIED, INSIDE, BARE, THUMB]
    hint = "in the layout `surface: collision` and `exposed: true` would place them elsewhere"
    assert messages == [f"<mapping>: 5 of 7 taxels cannot feel: {'; '.join(records)}; {hint}"]


def test_geometric_gates_need_no_colliders(tmp_path):
    """A taxel without colliders feels by distance; a buried one does not, because the cube stays out of the hull."""
    geometric = {**DEPTH, "gate": "geometric"}
    assert warnings_and_records(document(tmp_path, {"a": geometric}))[1] == [BURIED, INSIDE, THUMB]
    sums = {"kind": "proximity", "links": "*", "feels": ["cube"], "backend": "points", "points": 30}
    assert warnings_and_records(document(tmp_path, {"a": sums}))[1] == [BURIED, INSIDE, THUMB]
    # One of the two sensors on the link cannot feel.
    mixed = {"a": geometric, "b": {**DEPTH, "links": ["the tip", "finger"]}}
    assert warnings_and_records(document(tmp_path, mixed))[1] == [BURIED, INSIDE, BARE, THUMB]


def test_forces_of_contacts_need_contacts_whatever_the_gate(tmp_path):
    force = {"kind": "force_taxel", "links": ["the tip", "finger"], "feels": ["cube"], "gate": "geometric"}
    assert warnings_and_records(document(tmp_path, {"a": force}))[1] == [BARE]


@pytest.mark.parametrize(
    "change",
    [
        ('<exclude body1="finger" body2="cube"/>', "</contact>", '<exclude body1="finger" body2="cube"/></contact>'),
        ("masks", 'name="finger" type="box"', 'name="finger" type="box" contype="2" conaffinity="2"'),
    ],
    ids=["exclude", "masks"],
)
def test_links_that_never_touch_their_objects_are_named(tmp_path, change):
    """By an excluded pair or by masks, the finger never collides with the object of its sensor."""
    _, old, new = change
    text = hand().replace(old, new)
    record = (
        "finger: 1 of 1 taxels on a body that is never in contact with its sensor's objects, which it reads by contact alone"
    )
    assert warnings_and_records(document(tmp_path, {"a": {**DEPTH, "links": ["finger", "palm"]}}, text))[1] == [
        BURIED,
        INSIDE,
        record,
    ]
    # Nothing keeps the cube out of the finger then, so taxels inside it feel by distance.
    inner = {"finger": [[0.02, 0, 0]], "palm": [[0, 0.025, 0.03]]}
    geometric = {**DEPTH, "links": ["finger", "palm"], "gate": "geometric"}
    assert warnings_and_records(document(tmp_path, {"a": geometric}, text, **inner)) == ([], [])
    assert len(warnings_and_records(document(tmp_path, {"a": geometric}, **inner))[1]) == 1


def test_taxels_without_sensors_do_not_count(tmp_path):
    """The net force on a body is no reading of its taxels either."""
    assert warnings_and_records(document(tmp_path, {"a": {**DEPTH, "links": "finger"}})) == ([], [])
    link = {"kind": "link_contact", "links": ["palm", "the tip"], "feels": ["cube"]}
    assert warnings_and_records(document(tmp_path, {"a": {**DEPTH, "links": "finger"}, "b": link})) == ([], [])


def test_explain_and_artefacts_keep_the_records(tmp_path):
    with pytest.warns(UnfeltWarning, match="5 of 7 taxels cannot feel"):
        touch = tgdsl.compile(document(tmp_path, {"a": DEPTH}))
    lines = "\n".join(["5 taxels cannot feel", *(f"  {record}" for record in (BURIED, INSIDE, BARE, THUMB))])
    assert lines in touch.explain()
    tgdsl.save(touch, tmp_path / "hand.safetensors")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = tgdsl.load(tmp_path / "hand.safetensors")
    assert loaded.explain() == touch.explain()
    assert [record.taxels.tolist() for record in loaded.plan.unfelt] == [[0], [1], [4, 5], [6]]
    clean = tgdsl.compile(document(tmp_path, {"a": {**DEPTH, "links": "finger"}}))
    assert "cannot feel" not in clean.explain() and clean.plan.unfelt == ()


def test_taxels_that_cannot_feel_are_not_moved(tmp_path):
    with pytest.warns(UnfeltWarning):
        plan = compile_document(document(tmp_path, {"a": DEPTH})).plan
    assert plan.layout.pos.tolist() == [pos for positions in POINTS.values() for pos in positions]


def test_the_warning_names_the_first_of_many_links(tmp_path):
    bodies = "".join(
        f'<body name="l{i}" pos="{i} 0 0"><joint/><geom size=".01" contype="0" conaffinity="0"/></body>' for i in range(11)
    )
    text = hand().replace('<body name="cube"', f'{bodies}<body name="cube"')
    points = {"finger": [[0.02, 0.003, 0]], **{f"l{i}": [[0, 0, 0]] for i in range(11)}}
    ((message,), records) = warnings_and_records(document(tmp_path, {"a": DEPTH}, text, **points))
    assert len(records) == 11 and message.count(" taxels on a body") == 8 and message.endswith("; and 3 more, see `explain`")


def test_pictures_mark_taxels_that_cannot_feel_without_sensors(tmp_path):
    description = document(tmp_path, {})
    placement = placed({key: description[key] for key in ("tgdsl", "robot")})
    assert [str(record) for record in placement.unfelt["only"]] == [BURIED, INSIDE, BARE, THUMB]


@pytest.mark.filterwarnings("default::tgdsl.errors.UnfeltWarning")
def test_commands_count_taxels_that_cannot_feel(tmp_path, here):
    """Render prints the counts of documents and artefacts; compile warns once, on stderr."""
    description = document(tmp_path, {"a": DEPTH})
    (tmp_path / "hand.yaml").write_text(json.dumps(description))
    code, output, error = here(tmp_path, "compile", "hand.yaml")
    assert code == 0 and output.startswith("7 taxels on 4 links")
    assert re.fullmatch(r"tgdsl: warning: hand\.yaml: 5 of 7 taxels cannot feel: .*\n", error.splitlines(keepends=True)[-1])
    for name in ("hand.yaml", "hand.safetensors"):
        code, output, error = here(tmp_path, "render", name, "--size", "300", "300")
        assert code == 0, error
        assert output.splitlines()[:2] == [
            "only: 7 taxels",
            "only: 5 taxels cannot feel: not collided 2, buried 2, covered at rest 1",
        ]
