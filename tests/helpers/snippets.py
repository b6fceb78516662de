"""Blocks of code in Markdown pages, and which of them run or are checked.

A comment before a block directs it: `<!-- snippet: parse, WHY -->` (not run), `slow`, `file NAME` (written to the page's folder),
`with CODE` (Python that is run before it; a page need not show it).
"""

import re
import shlex
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from tgdsl.commands.cli import Command
from tgdsl.commands.sweep_document import load_sweep
from tgdsl.rl.load import load_task
from tgdsl.schema.load import load, load_layout

REPOSITORY = Path(__file__).parents[2]
FENCE = re.compile(r"^(?P<directives>(?:<!-- snippet: .*? -->\n+)*)```(?P<language>[^\n]*)\n(?P<text>.*?)^```$", re.M | re.S)
DIRECTIVE = re.compile(r"<!-- snippet: (\w+),? ?(.*?) -->", re.S)
LANGUAGES = {"python", "yaml", "sh", "toml", "xml", "text"}
FOLDERS = ("start", "how-to", "reference", "background")
"""Of docs/; the pages of docs/records stay as they were written."""
BASE = {
    "tgdsl": "tgdsl: 1\n",
    "robot": "robot: {model: xhand1}\n",
    "resolution": "resolution: low\n",
    "objects": "objects: {cube: {body: cube}, ball: {body: ball}}\n",
    "sensors": "sensors: {any: {kind: contact, links: hand, feels: [OBJECT]}}\n",
}
"""What completes a part of a document."""


@dataclass(frozen=True)
class Snippet:
    """A block: where it is, what it holds, and its directives by name."""

    page: Path
    line: int
    language: str
    text: str
    directives: dict[str, str]

    @property
    def place(self) -> str:
        return f"{self.page.relative_to(REPOSITORY)}:{self.line}"


def pages() -> list[Path]:
    """Return the READMEs and all pages that are written by hand."""
    return [
        REPOSITORY / "README.md",
        REPOSITORY / "examples" / "README.md",
        REPOSITORY / "docs" / "index.md",
        *sorted(page for folder in FOLDERS for page in (REPOSITORY / "docs" / folder).glob("*.md")),
    ]


def snippets(page: Path) -> list[Snippet]:
    """Return the blocks of a page, in order; not Sphinx's directives."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        if not match["language"].startswith("{"):
            line = text[: match.start("text")].count("\n") + 1
            directives = dict(DIRECTIVE.findall(match["directives"]))
            found.append(Snippet(page, line, match["language"], match["text"], directives))
    return found


def command_lines(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of a block of shell, lines that end in a backslash joined."""
    for line in text.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            yield words


def tgdsl_arguments(words: list[str]) -> list[str] | None:
    """Return the arguments of a command line that calls tgdsl; None if it calls something else."""
    if words[0] == "tgdsl":
        return words[1:]
    for i in range(len(words) - 1):
        if words[i : i + 2] == ["-m", "tgdsl"]:
            return words[i + 2 :]
    return None


def parse(arguments: list[str]) -> None:
    """Parse the arguments of tgdsl as it does itself; `SystemExit` if they are wrong."""
    if "--help" not in arguments and arguments != ["--version"]:
        tyro.cli(Command, prog="tgdsl", args=arguments)  # type: ignore[arg-type]


def check_other(words: list[str]) -> None:
    """Check a command line that does not call tgdsl: targets, scripts and extras exist; anything else is an error."""
    if words[0] == "make":
        makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
        for target in words[1:]:
            name = target.split("=")[0]
            assert re.search(rf"^{name}(:| \?=)", makefile, re.M), f"make {target}"
    elif words[0] == "python" and words[1].endswith(".py"):
        assert (REPOSITORY / words[1]).is_file(), words[1]
    elif words[:2] == ["pip", "install"]:
        extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
        for named in re.findall(r"(?:tgdsl|\.)\[([\w,]+)\]", " ".join(words)):
            assert set(named.split(",")) <= extras.keys(), named
    else:
        assert words[0] in {"git", "cd", "source", "python", "tensorboard", ".", "pytest"}, words


def check_yaml(text: str, folder: Path) -> None:
    """Read a document, layout, task, sweep, or a part of one."""
    keys = re.findall(r"^(\w+):", text, re.M)
    path = folder / ("tasks" if "matrix" in keys else "") / "snippet.yaml"
    path.write_text(text, encoding="utf-8")
    if "resolutions" in keys:
        load_layout(path)
    elif "matrix" in keys:
        load_sweep(path)
    elif "task" in keys:
        load_task(path)
    else:
        objects = re.search(r"^objects:\n? *\{?(\w+):", text, re.M)
        missing = "".join(part for key, part in BASE.items() if key not in keys)
        path.write_text(text + missing.replace("OBJECT", objects[1] if objects else "cube"), encoding="utf-8")
        load(path).raise_problems()


def check_text(snippet: Snippet) -> None:
    """Check what needs no run: syntax, and every command line."""
    assert snippet.language in LANGUAGES, (
        f'{snippet.place}: found the language "{snippet.language}", expected one of {LANGUAGES}'
    )
    if snippet.language == "python":
        compile(snippet.text, snippet.place, "exec")
    elif snippet.language == "toml":
        tomllib.loads(snippet.text)
    elif snippet.language == "xml":
        ElementTree.fromstring(snippet.text)
    elif snippet.language == "sh":
        for words in command_lines(snippet.text):
            arguments = tgdsl_arguments(words)
            if arguments is None:
                check_other(words)
            else:
                parse(arguments)
