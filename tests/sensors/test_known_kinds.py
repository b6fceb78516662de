"""Sensor kinds of installed packages in documents, artefacts, the command line and editors; and broken ones."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from installed_packages import installing

import tgdsl
from tgdsl.errors import SpecError, TgdslError
from tgdsl.schema.document import json_schema
from tgdsl.sensors import CONTACT, KINDS
from tgdsl.sensors.known import known_kinds

MODULE = '''
from typing import Literal

from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.sensors import Kind
from tgdsl.sensors.base import Channel, Lowered, ProbeSpec


class InverseSpec(ProbeSpec):
    """One over one plus depth."""

    kind: Literal["inverse"]
    """The kind."""
    scale: float = 2.0
    """Factor [1]."""


def lower(spec, layout, surface_of):
    return Lowered((Channel("inverse", "1"),), reports={}, requests=(ContactDepth(spec.objects, spec.is_gated),))


def forward(gathered, context, constants, state):
    return {"inverse": 1 / (1 + gathered[ContactDepth].depth)}, {}


def reference(spec, layout, gathered, context, state):
    return 1 / (1 + gathered[ContactDepth].depth[:, None]), {}


INVERSE = Kind(InverseSpec, lower, forward, reference)
OTHER = Kind(InverseSpec, lower, forward, reference)
NO_KIND = {"name": "inverse"}


class NamelessSpec(ProbeSpec):
    """Has no name."""


NAMELESS = Kind(NamelessSpec, lower, forward, reference)
'''
SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
  <body name="item" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""
DOCUMENT = """
tgdsl: 1
robot: {model: scene.xml, layout: {resolutions: {only: {pad: {method: points, radius: 4 mm, points: [{pos: [0, 0, 0.01], normal: [0, 0, 1]}]}}}}}
objects: {item: {body: item}}
sensors: {mine: {kind: inverse, links: pad, feels: [item], scale: 3}}
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package with kinds, as pip would, for one test."""
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    with installing(tmp_path, monkeypatch, "tgdsl.kinds", MODULE) as install:
        yield install


def test_a_kind_that_is_not_installed_is_unknown(install, tmp_path):
    assert known_kinds() == KINDS
    with pytest.raises(SpecError, match='unknown kind "inverse"'):
        tgdsl.compile(tmp_path / "hand.yaml")


def test_an_installed_kind_is_known_without_being_passed(install, tmp_path, here):
    install("touchy", "1.2", inverse="touchy:INVERSE")
    touch = tgdsl.compile(tmp_path / "hand.yaml")
    state = touch.example_state(3)
    assert [output.kind for output in touch.outputs] == ["inverse"]
    tgdsl.save(touch, tmp_path / "hand.safetensors")
    torch.testing.assert_close(tgdsl.load(tmp_path / "hand.safetensors")(state), touch(state), rtol=0, atol=0)
    assert "InverseSpec" in json_schema()["$defs"]
    code, out, errors = here(tmp_path, "compile", "hand.yaml", "-o", "again.safetensors")
    assert (code, errors) == (0, "") and "mine (inverse, 1)" in out
    assert here(tmp_path, "explain", "again.safetensors")[0] == 0
    assert here(tmp_path, "schema")[0] == 0
    assert "InverseSpec" in json.loads((tmp_path / "tgdsl.schema.json").read_text())["$defs"]
    assert (
        'unknown kind "invers"; did you mean "inverse"?'
        in here(tmp_path, "compile", "hand.yaml", "--set", "sensors.mine.kind=invers")[2]
    )


def test_a_kind_may_be_both_installed_and_passed(install, tmp_path):
    """Its author's tests pass it while it is installed."""
    install("touchy", "1.2", inverse="touchy:INVERSE", again="touchy:INVERSE")
    import touchy  # type: ignore[import-not-found]

    assert known_kinds([touchy.INVERSE]) == known_kinds() == (*KINDS, touchy.INVERSE)
    tgdsl.compile(tmp_path / "hand.yaml", kinds=[touchy.INVERSE])


def test_two_kinds_of_one_name_are_an_error(install, tmp_path):
    install("feely", "0.3", inverse="feely:INVERSE")
    install("touchy", "1.2", inverse="touchy:INVERSE")
    for call in (known_kinds, json_schema, lambda: tgdsl.compile(tmp_path / "hand.yaml")):
        with pytest.raises(TgdslError) as caught:
            call()
        assert str(caught.value) == 'two kinds are called "inverse": one of feely 0.3, one of touchy 1.2; rename or remove one'


def test_a_passed_kind_may_not_take_the_name_of_an_installed_one(install):
    install("touchy", "1.2", inverse="touchy:INVERSE")
    import touchy  # type: ignore[import-not-found]

    with pytest.raises(TgdslError, match=r'two kinds are called "inverse": one of touchy 1\.2, one of `kinds`; rename'):
        known_kinds([touchy.OTHER])
    with pytest.raises(TgdslError, match=r"`kinds`: the spec NamelessSpec has no field `kind: Literal\[\"its_name\"\]`"):
        known_kinds([touchy.NAMELESS])


BROKEN = {
    "missing": ("gone_module:KIND", "ModuleNotFoundError: No module named 'gone_module'"),
    "attribute": ("touchy:GONE", "AttributeError: module 'touchy' has no attribute 'GONE'"),
    "no kind": ("touchy:NO_KIND", "found dict, expected a tgdsl.sensors.Kind"),
    "nameless": ("touchy:NAMELESS", 'the spec NamelessSpec has no field `kind: Literal["its_name"]`'),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_kind_is_skipped_with_a_warning_that_names_its_package(install, case):
    value, reason = BROKEN[case]
    install("touchy", "1.2", broken=value, inverse="touchy:INVERSE")
    with pytest.warns(UserWarning, match="is left out") as caught:
        kinds = known_kinds()
    assert [str(warning.message) for warning in caught] == [
        f'the sensor kind "broken" of touchy 1.2 ({value}) is left out: {reason}'
    ]
    assert [kind.name for kind in kinds] == [*(kind.name for kind in KINDS), "inverse"], "the others are there"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert known_kinds() == kinds, "once"


def test_a_kind_may_not_take_the_name_of_a_builtin_one(install, tmp_path):
    install("touchy", "1.2", inverse="touchy:INVERSE")
    (tmp_path / "site_touchy" / "touchy.py").write_text(MODULE.replace('"inverse"]', '"contact"]'))
    with pytest.raises(
        TgdslError, match=r'two kinds are called "contact": one of tgdsl, one of touchy 1\.2; rename or remove one'
    ):
        known_kinds()
    assert CONTACT.name == "contact"


SIGNAL = (
    'kind "inverse" has a channel called "signal"; rename it: what `forward` returns as "signal" is all channels in one tensor'
)
RESERVED = {
    "channel": ('Lowered((Channel("signal", "1"),)', SIGNAL),
    "signal": ('Lowered((Channel("inverse", "1"),), signal=(Channel("signal", "1"),)', SIGNAL),
    "report's channel": ('Lowered((Channel("inverse", "1"),)|net": (Channel("signal", "1"),)', SIGNAL),
    "report": (
        'Lowered((Channel("inverse", "1"),)|signal": (Channel("n", "1"),)',
        'kind "inverse" has a report called "signal"; rename it: "<sensor>/signal" is the reading before its noise',
    ),
    "clean": (
        'Lowered((Channel("inverse", "1"),)|clean": (Channel("n", "1"),)',
        'kind "inverse" has a report called "clean"; rename it: "<sensor>/clean" is the reading without noise',
    ),
}


@pytest.mark.parametrize("case", RESERVED)
def test_names_reserved_for_readings_are_refused(install, tmp_path, case):
    install("touchy", "1.2", inverse="touchy:INVERSE")
    change, message = RESERVED[case]
    lowered, _, report = change.partition("|")
    text = MODULE.replace('Lowered((Channel("inverse", "1"),)', lowered)
    text = text.replace("reports={}", f'reports={{"{report}}}') if report else text
    (tmp_path / "site_touchy" / "touchy.py").write_text(text)
    with pytest.raises(TgdslError) as caught:
        tgdsl.compile(tmp_path / "hand.yaml")
    assert str(caught.value) == message


INHERITED = """
from touchy import INVERSE
from tgdsl.testing import KindConformance


class TestInverse(KindConformance):
    kind = INVERSE
"""


@pytest.mark.slow
def test_the_suite_adds_no_marks_to_other_peoples_pytest(tmp_path):
    (tmp_path / "touchy.py").write_text(MODULE)
    (tmp_path / "test_mine.py").write_text(INHERITED)
    options = ["--collect-only", "--strict-markers", "-W", "error", "-p", "no:cacheprovider", "--rootdir", "."]
    command = [sys.executable, "-m", "pytest", "-q", *options, "test_mine.py"]
    result = subprocess.run(
        command,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "test_mine.py::TestInverse::test_compiled_equals_eager" in result.stdout
