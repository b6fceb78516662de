"""Plugins of installed packages: named by package and version, without broken ones and without duplicates."""

import linecache
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest

from tgdsl.errors import TgdslError
from tgdsl.files import plugins


@dataclass(frozen=True, eq=False)
class Thing:
    name: str


ONE, TWO, SAME = Thing("one"), Thing("two"), Thing("one")
NUMBER = 3


def wrong(thing: object) -> str:
    return "" if isinstance(thing, Thing) else f"{thing!r} is no thing"


def known(group: str, own=(), given=()) -> list[str]:
    return [thing.name for thing in plugins.Registry(group, "thing", "things", own, wrong).known(given)]


@pytest.fixture
def installed(monkeypatch, request):
    """Return a function that creates this test's group of entry points to names of this file."""

    def of(*names: str) -> str:
        group = f"{request.node.name}/{names}"
        points = [EntryPoint(f"p{i}", f"{__name__}:{name}", group) for i, name in enumerate(names)]
        monkeypatch.setattr(EntryPoint, "load", lambda point: globals()[point.attr])
        monkeypatch.setattr(plugins, "entry_points", lambda group: [point for point in points if point.group == group])
        return group

    return of


def test_builtin_things_come_first_then_installed_then_given_ones(installed):
    group = installed("TWO")
    assert known(group, [ONE], [Thing("three")]) == ["one", "two", "three"]
    assert known(group, [ONE], [TWO]) == ["one", "two"], "one that is installed may be given too"


def test_two_things_with_one_name_are_refused(installed):
    for builtin, extra, packages in (
        ([SAME], [], "tgdsl, one of an unknown package"),
        ([], [SAME], "an unknown package, one of `things`"),
    ):
        with pytest.raises(TgdslError) as caught:
            known(installed("ONE"), builtin, extra)
        assert str(caught.value) == f'two things are called "one": one of {packages}; rename or remove one'


def test_an_invalid_thing_is_left_out_if_installed_and_refused_if_given(installed):
    group = installed("NUMBER", "TWO", "missing")
    with pytest.warns(UserWarning, match="is left out") as caught:
        assert known(group) == ["two"]
    first, second = (str(warning.message) for warning in caught)
    assert first == f'the thing "p0" of an unknown package ({__name__}:NUMBER) is left out: 3 is no thing'
    assert second == f"the thing \"p2\" of an unknown package ({__name__}:missing) is left out: KeyError: 'missing'"
    assert ".known(given)" in linecache.getline(caught[0].filename, caught[0].lineno)
    with pytest.raises(TgdslError, match=r"^`things`: 3 is no thing$"):
        known("none", given=[NUMBER])


def test_packages_are_named_with_their_version(installed, monkeypatch):
    group = installed("ONE")
    (point,) = plugins.entry_points(group=group)
    packaged = point._for(SimpleNamespace(name="fingers", version="1.2"))
    monkeypatch.setattr(plugins, "entry_points", lambda group: [packaged])
    assert plugins.installed(group, "thing", wrong) == ((ONE, "fingers 1.2"),)
