"""YAML text to plain values with the place of every value. YAML 1.2: `no` is a string, `1e-3` a number."""

from __future__ import annotations

import pathlib
import warnings
from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from io import StringIO
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from tgdsl.errors import Problem, did_you_mean

Path = tuple[str | int, ...]
MAX_DEPTH = 50  # values that are nested more deeply are refused, before Python's recursion limit is reached
SET = "--set "  # in mistakes, prefix of an override, in the place of a file's name
_TOO_DEEP = f"nested more than {MAX_DEPTH} deep"


class Unreadable:
    """Placeholder, used as a class, for a value that could not be read: its mistake is noted already."""


class Mark(NamedTuple):
    """A place in a file; line and column from 1, or 0 where there is none."""

    file: str
    line: int
    column: int


@dataclass
class Source:
    """A parsed document: its plain value, the place of each part, and its mistakes as YAML."""

    file: str
    value: Any = None  # mappings, lists and scalars
    keys: dict[Path, Mark] = field(default_factory=dict)  # place of the key of each mapping entry, by its path
    values: dict[Path, Mark] = field(default_factory=dict)  # place of each value, by its path
    problems: list[Problem] = field(default_factory=list)
    added: dict[str, str] = field(default_factory=dict)  # hints by path, of new entries with a name like a sibling's

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path, placed at the nearest part of it that the document holds."""
        first, second = (self.keys, self.values) if on_key else (self.values, self.keys)
        near = path
        while near and near not in first and near not in second:
            near = near[:-1]
        mark = first.get(near) or second.get(near) or Mark(self.file, 0, 0)
        return Problem(*mark, path=path_text(path), what=what, hint=hint)

    def hinted(self, problems: Sequence[Problem]) -> list[Problem]:
        """Return mistakes; those in entries that overrides added name a similar entry."""
        result = list(problems)
        for i, problem in enumerate(problems):
            hints = [hint for path, hint in self.added.items() if f"{problem.path}.".startswith(f"{path}.")]
            if hints and not problem.hint.startswith("did you mean"):
                result[i] = replace(problem, hint=hints[0])
        return result

    def get(self, path: Path) -> Any:
        """Return the plain value at a path, or None."""
        value = self.value
        for part in path:
            try:
                value = value[part]
            except (KeyError, IndexError, TypeError):
                return None
        return value

    def keep(self, key: str, names: Collection[str]) -> None:
        """Keep only some entries of a mapping; names that it does not have are a mistake."""
        entries = self.get((key,))
        if not isinstance(entries, dict):
            return
        missing = [name for name in names if name not in entries]
        self.problems += [self.problem((key,), f'there is no "{name}"', did_you_mean(name, entries, key)) for name in missing]
        self.value[key] = {name: value for name, value in entries.items() if name in names}

    def set(self, dotted: str, value: Any) -> None:
        """Override one value, as the command line's `--set key.key=value` does; a string is read as YAML."""
        path: Path = tuple(str(dotted).split("."))
        name = f"{SET}{dotted}={value}"
        parsed = parse(value, name) if isinstance(value, str) else from_mapping({path[-1]: value}, name)
        self.problems += parsed.problems
        if parsed.problems:
            return
        parent = self.value
        for i, part in enumerate(path[:-1]):
            if isinstance(parent, dict) and part not in parent:
                near = did_you_mean(str(part), (str(key) for key, entry in parent.items() if isinstance(entry, dict)))
                if near.startswith("did"):
                    self.added[path_text(path[: i + 1])] = f'"{part}" is new: {near}'
                parent[part] = {}
                self.values[path[: i + 1]] = Mark(parsed.file, 0, 0)
            parent = parent[part] if isinstance(parent, dict) else None
        if not isinstance(parent, dict):
            self.problems.append(Problem(parsed.file, 0, 0, dotted, "does not lead to a key of a mapping"))
            return
        for marks in (self.keys, self.values):
            for stale in [marked for marked in marks if marked[: len(path)] == path]:
                del marks[stale]
        parent[path[-1]] = parsed.value if isinstance(value, str) else parsed.value[path[-1]]
        self.values[path] = Mark(parsed.file, 0, 0)


def path_text(path: Path) -> str:
    """Return a path as users write it: `observations.policy[0].of`."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def parse(text: str, file: str) -> Source:
    """Read one YAML document; mistakes are noted in the result, not raised.

    Texts are cached: a layout of hundreds of lines takes a second to read, and many documents share it.
    """
    source = _parsed(text, file)
    return Source(file, deepcopy(source.value), dict(source.keys), dict(source.values), list(source.problems))


@lru_cache(maxsize=64)
def _parsed(text: str, file: str) -> Source:
    source = Source(file)
    yaml = YAML(typ="safe", pure=True)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ReusedAnchorWarning)  # an anchor may be set again
            node = yaml.compose(text)
        if node is None:
            source.problems.append(Problem(file, 1, 1, "", "the document is empty"))
        else:
            source.value = _Reader(source, yaml).read(node, (), ())
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        source.problems.append(Problem(file, line, column, "", f"not YAML: {error.problem or error.context}"))
    except YAMLError as error:
        source.problems.append(Problem(file, 1, 1, "", f"not YAML: {' '.join(str(error).split())}"))
    except RecursionError:
        source.problems.append(Problem(file, 1, 1, "", _TOO_DEEP))
    return source


def from_mapping(value: Mapping[str, Any], file: str) -> Source:
    """Return a document built in Python; its mistakes have paths but no lines."""
    source = Source(file)

    def plain(value: Any, path: Path) -> Any:
        if len(path) > MAX_DEPTH:
            source.problems.append(Problem(file, 0, 0, path_text(path), _TOO_DEEP))
            return Unreadable
        if isinstance(value, Mapping):
            return {str(key): plain(part, (*path, str(key))) for key, part in value.items()}
        if isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
            return [plain(part, (*path, i)) for i, part in enumerate(value)]
        return value

    source.value = plain(value, ())
    return source


class _Reader:
    def __init__(self, source: Source, yaml: YAML):
        self.source, self.constructor = source, yaml.constructor

    def mark(self, node: Node) -> Mark:
        return Mark(self.source.file, node.start_mark.line + 1, node.start_mark.column + 1)

    def note(self, node: Node, path: Path, what: str) -> type[Unreadable]:
        self.source.problems.append(Problem(*self.mark(node), path=path_text(path), what=what))
        return Unreadable

    def read(self, node: Node, path: Path, inside: tuple[int, ...]) -> Any:
        self.source.values[path] = self.mark(node)
        if id(node) in inside or len(inside) > MAX_DEPTH:
            return self.note(node, path, "this alias contains itself" if id(node) in inside else _TOO_DEEP)
        if isinstance(node, MappingNode):
            return self.mapping(node, path, (*inside, id(node)))
        if isinstance(node, SequenceNode):
            return [self.read(part, (*path, i), (*inside, id(node))) for i, part in enumerate(node.value)]
        try:
            return self.constructor.construct_object(node)
        except Exception as error:  # ruamel passes on any exception of Python's, such as on `!!bool maybe`
            return self.note(node, path, f"cannot read this value: {getattr(error, 'problem', None) or error}")

    def mapping(self, node: MappingNode, path: Path, inside: tuple[int, ...]) -> dict[str, Any]:
        """Return a mapping; its keys, and their places, override merged ones."""
        is_merge = [key.tag == "tag:yaml.org,2002:merge" or key.value == "<<" for key, _ in node.value]
        result: dict[str, Any] = {}
        for (_, value_node), is_merged in reversed(list(zip(node.value, is_merge, strict=True))):
            if is_merged:
                result |= self.merged(value_node, path, inside)
        self.source.values[path] = self.mark(node)
        seen: set[str] = set()
        for (key_node, value_node), is_merged in zip(node.value, is_merge, strict=True):
            if is_merged:
                continue
            if not isinstance(key_node, ScalarNode):
                self.note(key_node, path, "a key must be a plain name")
                continue
            key = str(key_node.value)
            if key in seen:
                first = self.source.keys[(*path, key)].line
                self.note(key_node, (*path, key), f"this key stands twice, first in line {first}")
                continue
            seen.add(key)
            self.source.keys[(*path, key)] = self.mark(key_node)
            result[key] = self.read(value_node, (*path, key), inside)
        return result

    def merged(self, node: Node, path: Path, inside: tuple[int, ...]) -> dict[str, Any]:
        """Return the entries that `<<` merges in: from a mapping, or from a list of mappings, where earlier ones win."""
        result: dict[str, Any] = {}
        for part in reversed(node.value if isinstance(node, SequenceNode) else [node]):
            value = self.read(part, path, inside)
            if isinstance(value, dict):
                result |= value
            elif value is not Unreadable:
                self.note(part, path, "only a mapping can be merged in")
        return result


def with_values(file: pathlib.Path, values: Mapping[tuple[str, ...], tuple[Any, str]]) -> str:
    """Return a document's text with new values by path, each with a comment; its order and other comments stay."""
    yaml = YAML(typ="rt")
    yaml.preserve_quotes, yaml.width = True, 1000
    root = yaml.load(file.read_text(encoding="utf-8"))
    for path, (value, comment) in values.items():
        parent = root
        for part in path[:-1]:
            parent = parent.setdefault(part, CommentedMap())
        parent[path[-1]] = value
        if not parent.fa.flow_style():
            parent.yaml_add_eol_comment(comment, path[-1])
    out = StringIO()
    yaml.dump(root, out)
    return out.getvalue()
