"""YAML text to plain values, with the place of every value kept. YAML 1.2: `no` is a string, `1e-3` a number."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, ReusedAnchorWarning, YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, ScalarNode, SequenceNode

from tgdsl.errors import Problem, did_you_mean

Path = tuple[str | int, ...]

MAX_DEPTH = 50  # values that are nested more deeply are refused, before Python's own limit is reached in some odd place
MAX_BYTES = 2 * 2**20  # size of the largest file that is read, comments included
MAX_NODES = 100_000  # most names and values of a document, each alias counted as what it stands for: some 7,000 points in line
MAX_TEXT = 10_000  # characters of the longest name or value
_TOO_DEEP = f"nested more than {MAX_DEPTH} deep"
_TOO_MANY = f"more than {MAX_NODES} names and values, aliases counted as what they stand for"
_HINT = "long lists of points go into a CSV file beside the layout"


class Unreadable:
    """Stands, itself, for a value that could not be read: what is wrong with it is noted already."""


class Mark(NamedTuple):
    """A place in a file; line and column from 1, or 0 where there is none."""

    file: str
    line: int
    column: int


@dataclass
class Source:
    """A document as found: its plain value, where each part of it stands, and what is wrong with it as YAML."""

    file: str  # name of the file
    value: Any = None  # mappings, lists and scalars
    keys: dict[Path, Mark] = field(default_factory=dict)  # place of the key of each mapping entry, by its path
    values: dict[Path, Mark] = field(default_factory=dict)  # place of each value, by its path
    problems: list[Problem] = field(default_factory=list)  # mistakes found while reading

    def problem(self, path: Path, what: str, hint: str = "", on_key: bool = False) -> Problem:
        """Return a mistake at a path, placed at the nearest part of it that the document holds."""
        first, second = (self.keys, self.values) if on_key else (self.values, self.keys)
        near = path
        while near and near not in first and near not in second:
            near = near[:-1]
        mark = first.get(near) or second.get(near) or Mark(self.file, 0, 0)
        return Problem(*mark, path=path_text(path), what=what, hint=hint)

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
        """Leave out all entries of a mapping but some; those that it does not have are a mistake."""
        own = self.value.get(key) if isinstance(self.value, dict) else None
        if not isinstance(own, dict):
            return
        for name in names:
            if name not in own:
                self.problems.append(self.problem((key,), f'there is no "{name}"', did_you_mean(name, own, key)))
        self.value[key] = {name: value for name, value in own.items() if name in names}

    def set(self, dotted: str, value: Any) -> None:
        """Override one value, as the command line's `--set key.key=value` does; a text is YAML, all else a plain value."""
        path: Path = tuple(str(dotted).split("."))
        name = f"--set {dotted}={value}"
        parsed = parse(value, name) if isinstance(value, str) else from_mapping({path[-1]: value}, name)
        parsed.value = parsed.value if isinstance(value, str) else parsed.value[path[-1]]
        self.problems += parsed.problems
        if parsed.problems:
            return
        parent = self.value
        for part in path[:-1]:
            parent = parent.setdefault(part, {}) if isinstance(parent, dict) else None
        if not isinstance(parent, dict):
            self.problems.append(Problem(parsed.file, 0, 0, dotted, "does not lead to a key of a mapping"))
            return
        for marks in (self.keys, self.values):
            for stale in [known for known in marks if known[: len(path)] == path]:
                del marks[stale]
        parent[path[-1]] = parsed.value
        self.values[path] = Mark(parsed.file, 0, 0)


def path_text(path: Path) -> str:
    """Return a path as users write it: `observations.policy[0].of`."""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


class _TooManyError(Exception):
    """Ends the reading of a document that has more than `MAX_NODES` names and values.

    Attributes:
        line: Line of the value that has too many, from 1; 0 where there is none.
        column: Its column.
        path: Its path, if that is known.
    """

    def __init__(self, line: int, column: int, path: Path):
        self.line, self.column, self.path = line, column, path


class _BoundedComposer(Composer):
    """Composes no value that holds more than a document may, aliases unfolded, and none that is nested much too deep."""

    num_open = 0

    def __init__(self, loader: Any = None):
        super().__init__(loader=loader)
        self.num_nodes = 0
        self.sizes: dict[int, int] = {}  # names and values in each node that is whole; aliases leave out those that are not

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose one node and those in it."""
        mark = self.parser.peek_event().start_mark
        self.num_nodes += 1
        self.num_open += 1
        if self.num_open > 2 * MAX_DEPTH:
            raise RecursionError  # a value that is only a little too deep is named by its path when it is read
        node = super().compose_node(parent, index)
        self.num_open -= 1
        inner = [part for pair in node.value for part in pair] if isinstance(node, MappingNode) else node.value
        parts = inner if isinstance(node, CollectionNode) else ()
        size = self.sizes.setdefault(id(node), 1 + sum(self.sizes.get(id(part), 1) for part in parts))
        if max(size, self.num_nodes) > MAX_NODES:
            raise _TooManyError(mark.line + 1, mark.column + 1, ())
        return node


def too_large(content: bytes, file: str) -> Problem | None:
    """Return what is wrong with a file's content, or with its first `MAX_BYTES` + 1 bytes; None if nothing is."""
    if len(content) <= MAX_BYTES:
        return None
    line = content.count(b"\n", 0, MAX_BYTES) + 1
    return Problem(file, line, 1, "", f"more than {MAX_BYTES} bytes, comments included", _HINT)


def parse(text: str, file: str) -> Source:
    """Read one YAML document; mistakes are noted in the result, not raised."""
    source = Source(file)
    yaml = YAML(typ="safe", pure=True)
    yaml.Composer = _BoundedComposer
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
    except _TooManyError as error:
        _refuse(source, error)
    return source


def from_mapping(value: Mapping[str, Any], file: str) -> Source:
    """Return a document that was built in Python; its mistakes have paths but no lines."""
    source = Source(file)
    try:
        source.value = _plain(value, (), source, count())
    except _TooManyError as error:
        _refuse(source, error)
    return source


def _refuse(source: Source, error: _TooManyError) -> None:
    source.value = None
    source.problems = [Problem(source.file, error.line, error.column, path_text(error.path), _TOO_MANY, _HINT)]


def _plain(value: Any, path: Path, source: Source, counter: count[int]) -> Any:
    if next(counter) >= MAX_NODES:
        raise _TooManyError(0, 0, path)
    if len(path) > MAX_DEPTH:
        source.problems.append(Problem(source.file, 0, 0, path_text(path), _TOO_DEEP))
        return Unreadable
    if isinstance(value, Mapping):
        return {str(key): _plain(part, (*path, str(key)), source, counter) for key, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, (str, bytes)):
        return [_plain(part, (*path, i), source, counter) for i, part in enumerate(value)]
    if isinstance(value, str) and (wrong := _wrong_text(value)):
        source.problems.append(Problem(source.file, 0, 0, path_text(path), wrong))
        return Unreadable
    return value


class _Reader:
    def __init__(self, source: Source, yaml: YAML):
        self.source = source
        self.constructor = yaml.constructor

    def mark(self, node: Node) -> Mark:
        return Mark(self.source.file, node.start_mark.line + 1, node.start_mark.column + 1)

    def note(self, node: Node, path: Path, what: str) -> None:
        self.source.problems.append(Problem(*self.mark(node), path=path_text(path), what=what))

    def read(self, node: Node, path: Path, inside: tuple[int, ...]) -> Any:
        self.source.values[path] = self.mark(node)
        if id(node) in inside or len(inside) > MAX_DEPTH:
            self.note(node, path, "this alias contains itself" if id(node) in inside else _TOO_DEEP)
            return Unreadable
        if isinstance(node, MappingNode):
            return self.mapping(node, path, (*inside, id(node)))
        if isinstance(node, SequenceNode):
            return [self.read(part, (*path, i), (*inside, id(node))) for i, part in enumerate(node.value)]
        if wrong := _wrong_text(node.value):
            self.note(node, path, wrong)
            return Unreadable
        try:
            return self.constructor.construct_object(node)
        except Exception as error:  # ruamel lets through whatever Python raises on, say, `!!bool maybe`
            self.note(node, path, f"cannot read this value: {getattr(error, 'problem', None) or error}")
            return Unreadable

    def mapping(self, node: MappingNode, path: Path, inside: tuple[int, ...]) -> dict[str, Any]:
        """Return a mapping; its own keys count before those merged in, and so do their places."""
        is_merge = [key.tag == "tag:yaml.org,2002:merge" or key.value == "<<" for key, _ in node.value]
        result: dict[str, Any] = {}
        for (_, value_node), is_merged in reversed(list(zip(node.value, is_merge, strict=True))):
            if is_merged:
                result |= self.merged(value_node, path, inside)
        self.source.values[path] = self.mark(node)
        own: set[str] = set()
        for (key_node, value_node), is_merged in zip(node.value, is_merge, strict=True):
            if is_merged:
                continue
            if not isinstance(key_node, ScalarNode) or _wrong_text(key_node.value):
                self.note(key_node, path, "a key must be a plain name")
                continue
            key = str(key_node.value)
            if key in own:
                first = self.source.keys[(*path, key)].line
                self.note(key_node, (*path, key), f"this key stands twice, first in line {first}")
                continue
            own.add(key)
            self.source.keys[(*path, key)] = self.mark(key_node)
            result[key] = self.read(value_node, (*path, key), inside)
        return result

    def merged(self, node: Node, path: Path, inside: tuple[int, ...]) -> dict[str, Any]:
        """Return what `<<` brings in: a mapping, or a list of mappings of which the first counts most."""
        result: dict[str, Any] = {}
        for part in reversed(node.value if isinstance(node, SequenceNode) else [node]):
            found = self.read(part, path, inside)
            if isinstance(found, dict):
                result |= found
            elif found is not Unreadable:
                self.note(part, path, "only a mapping can be merged in")
        return result


def _wrong_text(text: str) -> str:
    """Return what is wrong with a name or a value as text, or nothing."""
    if len(text) > MAX_TEXT:
        return f"found a text of {len(text)} characters, expected at most {MAX_TEXT}"
    has_half = any("\ud800" <= character <= "\udfff" for character in text)
    return "half of a surrogate pair is no text" if has_half else ""
