"""Selections by names, wildcards and groups."""

from tgdsl.fields.models import Selection
from tgdsl.schema.select import matching, select

LINKS = [["palm"], ["index_tip", "index_mesh"], ["index_mid"], ["thumb_tip", "thumb_mesh"]]


def selected(include, exclude=(), groups=None, **more) -> tuple[list[int], list[tuple[str, str, str]]]:
    named = {name: Selection(include=tuple(parts)) for name, parts in (groups or {}).items()}
    messages: list[tuple[str, str, str]] = []
    selection = Selection(include=tuple(include), exclude=tuple(exclude))

    def report(where: tuple[str, int], what: str, hint: str) -> None:
        messages.append((getattr(selection, where[0])[where[1]], what, hint))

    indices = select(selection, LINKS, named, report, **more)
    return indices, messages


def test_wildcards_keep_the_order_of_links_and_are_case_sensitive():
    assert selected(["thumb_*", "index_*"]) == ([1, 2, 3], [])
    assert selected(["*_mesh"]) == ([1, 3], [])
    assert selected(["index_m[ie]*"]) == ([1, 2], [])
    assert selected(["palm", "palm", "p?lm"]) == ([0], [])
    assert matching("P*", ["palm", "Palm"]) == ["Palm"]


def test_exclude_removes_links_and_its_wildcards_may_match_nothing():
    assert selected(["*"], ["*_tip", "nobody*"]) == ([0, 2], [])
    assert selected(["palm"], ["*"]) == ([], [])
    assert selected(["palm"], ["none"], {"none": ["zzz"]}) == ([0], [])


def test_a_plain_name_in_exclude_must_exist():
    assert selected(["*"], ["*_tip", "thumb_mseh"]) == (
        [0, 2],
        [("thumb_mseh", 'no link matches "thumb_mseh"', 'did you mean "thumb_mesh"?')],
    )
    assert selected(["*"], ["pal"], {"palms": ["palm"]}) == (
        [0, 1, 2, 3],
        [("pal", 'no link matches "pal"', 'did you mean "palm"?')],
    )
    assert selected(["*"], ["back"], elsewhere=["back"]) == ([0, 1, 2, 3], [])
    _, ((_, _, hint),) = selected(["*"], ["bakc"], elsewhere=["back"])
    assert hint == 'did you mean "back"?'


def test_groups_may_hold_groups():
    groups = {"tips": ["*_tip"], "index": ["index_*"], "both": ["tips", "palm"]}
    assert selected(["both"], groups=groups) == ([0, 1, 3], [])
    assert selected(["both"], ["index"], groups) == ([0, 3], [])


def test_a_group_has_precedence_over_a_link_of_its_name():
    assert selected(["palm"], groups={"palm": ["index_mid"]}) == ([2], [])


def test_in_a_group_of_its_name_a_name_means_the_link():
    """A group that lists its own name means the link, also if other groups contain it."""
    assert selected(["palm"], groups={"palm": ["palm"]}) == ([0], [])
    assert selected(["palm"], groups={"palm": ["palm", "index_mid"]}) == ([0, 2], [])
    assert selected(["hand"], groups={"palm": ["palm"], "hand": ["palm", "thumb_tip"]}) == ([0, 3], [])
    assert selected(["hand"], ["palm"], {"palm": ["palm"], "hand": ["*"]}) == ([1, 2, 3], [])


def test_only_a_group_of_a_links_name_may_list_itself():
    def messages_of(groups, group):
        named = {name: Selection(include=tuple(parts)) for name, parts in groups.items()}
        messages = []
        select(named[group], LINKS, named, lambda where, what, hint: messages.append((what, hint)), group)
        return messages

    assert messages_of({"palm": ["palm"]}, "palm") == []
    assert messages_of({"palm": ["palm", "tips"], "tips": ["palm"]}, "palm") == [
        ('group "palm" contains itself', "palm → tips → palm")
    ]
    assert messages_of({"tips": ["tips", "*_tip"]}, "tips") == [('group "tips" contains itself', "tips → tips")]


def test_names_that_match_nothing_are_reported():
    assert selected(["palm", "pam"]) == ([0], [("pam", 'no link matches "pam"', 'did you mean "palm"?')])
    hint = "known links: index_mesh, index_mid, index_tip, palm, thumb_mesh, thumb_tip, tips"
    assert selected(["zzz"], groups={"tips": ["x"]}) == ([], [("zzz", 'no link matches "zzz"', hint)])
    assert selected(["tips"], groups={"tips": ["x"]}) == ([], [("tips", 'group "tips" holds no link', "")])


def test_cyclic_groups_terminate():
    assert selected(["a", "palm"], groups={"a": ["b"], "b": ["a", "thumb_tip"]}) == ([0, 3], [])
    assert selected(["a"], groups={"a": ["a"]}) == ([], [("a", 'group "a" holds no link', "")])
