"""Things that installed packages bring: by package and name, without those that fail, and none of two by one name."""

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
    """Return a group of entry points of this test's own, each to a name of this file."""

    def of(*names: str) -> str:
        group = f"{request.node.name}/{names}"
        points = [EntryPoint(f"p{i}", f"{__name__}:{name}", group) for i, name in enumerate(names)]
        monkeypatch.setattr(EntryPoint, "load", lambda point: globals()[point.attr])
        monkeypatch.setattr(plugins, "entry_points", lambda group: [point for point in points if point.group == group])
        return group

    return of


def test_own_things_come_first_then_installed_ones_then_given_ones(installed):
    group = installed("TWO")
    assert known(group, [ONE], [Thing("three")]) == ["one", "two", "three"]
    assert known(group, [ONE], [TWO]) == ["one", "two"], "one that is installed may be given too"


def test_two_of_one_name_are_refused(installed):
    for own, given, whence in (
        ([SAME], [], "tgdsl, one of an unknown package"),
        ([], [SAME], "an unknown package, one of `things`"),
    ):
        with pytest.raises(TgdslError) as caught:
            known(installed("ONE"), own, given)
        assert str(caught.value) == f'two things are called "one": one of {whence}; rename or remove one'


def test_what_is_no_thing_is_left_out_with_a_warning_and_refused_where_it_is_given(installed):
    group = installed("NUMBER", "TWO", "missing")
    with pytest.warns(UserWarning, match="is left out") as caught:
        assert known(group) == ["two"]
    first, second = (str(warning.message) for warning in caught)
    assert first == f'the thing "p0" of an unknown package ({__name__}:NUMBER) is left out: 3 is no thing'
    assert second == f"the thing \"p2\" of an unknown package ({__name__}:missing) is left out: KeyError: 'missing'"
    assert ".known(given)" in linecache.getline(caught[0].filename, caught[0].lineno)
    with pytest.raises(TgdslError, match=r"^`things`: 3 is no thing$"):
        known("none", given=[NUMBER])


def test_packages_are_named_by_their_version(installed, monkeypatch):
    group = installed("ONE")
    (point,) = plugins.entry_points(group=group)
    of_package = point._for(SimpleNamespace(name="fingers", version="1.2"))
    monkeypatch.setattr(plugins, "entry_points", lambda group: [of_package])
    assert plugins.installed(group, "thing", wrong) == ((ONE, "fingers 1.2"),)
