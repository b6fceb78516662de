"""Names, wildcards and groups against what a shell would take."""

from tgdsl.fields.models import Selection
from tgdsl.schema.select import matching, select

LINKS = [["palm"], ["index_tip", "index_mesh"], ["index_mid"], ["thumb_tip", "thumb_mesh"]]


def chosen(include, exclude=(), groups=None, **more) -> tuple[list[int], list[tuple[str, str, str]]]:
    named = {name: Selection(include=tuple(parts)) for name, parts in (groups or {}).items()}
    said: list[tuple[str, str, str]] = []
    selection = Selection(include=tuple(include), exclude=tuple(exclude))

    def report(where: tuple[str, int], what: str, hint: str) -> None:
        said.append((getattr(selection, where[0])[where[1]], what, hint))

    found = select(selection, LINKS, named, report, **more)
    return found, said


def test_wildcards_take_names_in_the_order_of_the_links_and_heed_case():
    assert chosen(["thumb_*", "index_*"]) == ([1, 2, 3], [])
    assert chosen(["*_mesh"]) == ([1, 3], [])
    assert chosen(["index_m[ie]*"]) == ([1, 2], [])
    assert chosen(["palm", "palm", "p?lm"]) == ([0], [])
    assert matching("P*", ["palm", "Palm"]) == ["Palm"]


def test_exclude_takes_away_and_its_wildcards_may_match_nothing():
    assert chosen(["*"], ["*_tip", "nobody*"]) == ([0, 2], [])
    assert chosen(["palm"], ["*"]) == ([], [])
    assert chosen(["palm"], ["none"], {"none": ["zzz"]}) == ([0], [])


def test_a_plain_name_in_exclude_exists():
    assert chosen(["*"], ["*_tip", "thumb_mseh"]) == (
        [0, 2],
        [("thumb_mseh", 'no link matches "thumb_mseh"', 'did you mean "thumb_mesh"?')],
    )
    assert chosen(["*"], ["pal"], {"palms": ["palm"]}) == (
        [0, 1, 2, 3],
        [("pal", 'no link matches "pal"', 'did you mean "palm"?')],
    )
    assert chosen(["*"], ["back"], elsewhere=["back"]) == ([0, 1, 2, 3], [])
    _, ((_, _, hint),) = chosen(["*"], ["bakc"], elsewhere=["back"])
    assert hint == 'did you mean "back"?'


def test_groups_may_hold_groups():
    groups = {"tips": ["*_tip"], "index": ["index_*"], "both": ["tips", "palm"]}
    assert chosen(["both"], groups=groups) == ([0, 1, 3], [])
    assert chosen(["both"], ["index"], groups) == ([0, 3], [])


def test_a_group_counts_before_a_link_of_its_name():
    assert chosen(["palm"], groups={"palm": ["index_mid"]}) == ([2], [])


def test_in_its_own_group_a_name_is_the_link():
    """Whoever lists the link that a group is called after means the link, also from within other groups."""
    assert chosen(["palm"], groups={"palm": ["palm"]}) == ([0], [])
    assert chosen(["palm"], groups={"palm": ["palm", "index_mid"]}) == ([0, 2], [])
    assert chosen(["hand"], groups={"palm": ["palm"], "hand": ["palm", "thumb_tip"]}) == ([0, 3], [])
    assert chosen(["hand"], ["palm"], {"palm": ["palm"], "hand": ["*"]}) == ([1, 2, 3], [])


def test_only_a_group_of_a_links_name_may_list_itself():
    def said(groups, group):
        named = {name: Selection(include=tuple(parts)) for name, parts in groups.items()}
        found = []
        select(named[group], LINKS, named, lambda where, what, hint: found.append((what, hint)), group)
        return found

    assert said({"palm": ["palm"]}, "palm") == []
    assert said({"palm": ["palm", "tips"], "tips": ["palm"]}, "palm") == [
        ('group "palm" contains itself', "palm → tips → palm")
    ]
    assert said({"tips": ["tips", "*_tip"]}, "tips") == [('group "tips" contains itself', "tips → tips")]


def test_what_matches_nothing_is_named():
    assert chosen(["palm", "pam"]) == ([0], [("pam", 'no link matches "pam"', 'did you mean "palm"?')])
    hint = "known links: index_mesh, index_mid, index_tip, palm, thumb_mesh, thumb_tip, tips"
    assert chosen(["zzz"], groups={"tips": ["x"]}) == ([], [("zzz", 'no link matches "zzz"', hint)])
    assert chosen(["tips"], groups={"tips": ["x"]}) == ([], [("tips", 'group "tips" holds no link', "")])


def test_groups_that_contain_themselves_end():
    assert chosen(["a", "palm"], groups={"a": ["b"], "b": ["a", "thumb_tip"]}) == ([0, 3], [])
    assert chosen(["a"], groups={"a": ["a"]}) == ([], [("a", 'group "a" holds no link', "")])
