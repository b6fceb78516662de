"""Every block of code in the README and in docs/: Python and `tgdsl` lines are run page by page, documents read, all of it parsed."""

import re
import sys
from pathlib import Path
from typing import Any

import pytest
import tyro
from snippets import REPOSITORY, Snippet, check_text, check_yaml, command_lines, pages, parse, snippets, tgdsl_arguments

from tgdsl.commands.cli import Command

PAGES = {str(page.relative_to(REPOSITORY)): page for page in pages()}
INLINE = re.compile(r"(?<!`)`tgdsl ([^`]+)`(?!`)")


def named(pages: dict[str, Path]) -> list[Any]:
    """Return the pages as parameters; what runs only when the slow parts of a page do is marked."""
    found: list[Any] = []
    for name, page in pages.items():
        blocks = snippets(page)
        if any(is_run(block) for block in blocks):
            found.append(pytest.param(page, False, id=name))
        if any("slow" in block.directives for block in blocks):
            found.append(pytest.param(page, True, id=f"{name}-all", marks=pytest.mark.slow))
    return found


def is_run(block: Snippet) -> bool:
    return block.language != "text" and not {"parse", "slow"} & block.directives.keys()


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder that looks like the repository, to which pages may write."""
    (tmp_path / "examples" / "tasks").mkdir(parents=True)
    for source in (REPOSITORY, REPOSITORY / "examples", REPOSITORY / "examples" / "tasks"):
        for path in source.iterdir():
            target = tmp_path / path.relative_to(REPOSITORY)
            if path.name in ("robots", "policies") or (source != REPOSITORY and not target.exists()):
                target.symlink_to(path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    return tmp_path


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("page", "with_slow"), named(PAGES))
def test_the_blocks_of_a_page_run_in_their_order(page, with_slow, folder, here):
    names: dict[str, Any] = {"__name__": "snippet"}
    for block in snippets(page):
        if is_run(block) or (with_slow and "slow" in block.directives):
            run(block, names, folder, here)


def run(block: Snippet, names: dict[str, Any], folder: Path, here: Any) -> None:
    if "file" in block.directives:
        path = folder / block.directives["file"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(block.text, encoding="utf-8")
    if block.language == "python" and path_of(block) is None:
        exec(block.directives.get("with", ""), names)
        exec(compile(block.text, block.place, "exec"), names)
    elif block.language == "yaml" and path_of(block) is None:
        check_yaml(block.text, folder / "examples")
    elif block.language == "sh":
        for words in command_lines(block.text):
            if (arguments := tgdsl_arguments(words)) is not None:
                code, out, errors = here(folder, *arguments)
                assert code == 0, f"{block.place}: {' '.join(words)}\n{out}\n{errors}"


def path_of(block: Snippet) -> str | None:
    return block.directives.get("file")


@pytest.mark.parametrize("name", PAGES)
def test_all_blocks_of_a_page_are_parsed(name):
    for block in snippets(PAGES[name]):
        try:
            check_text(block)
        except (SystemExit, AssertionError, SyntaxError, ValueError) as error:
            pytest.fail(f"{block.place}: {error}\n{block.text}")


def test_what_is_only_parsed_says_why():
    for page in PAGES.values():
        for block in snippets(page):
            assert len(block.directives.get("parse", "a reason")) > 5, block.place


COMMAND = re.compile(r"^[a-z-]+$")


@pytest.mark.parametrize("name", PAGES)
def test_commands_in_the_text_exist_with_their_options(name, capsys):
    """Commands that are named within a sentence, whose files are left out or stand for others."""
    text = re.sub(r"^```.*?^```$", "", PAGES[name].read_text(encoding="utf-8"), flags=re.M | re.S)
    for found in INLINE.findall(text):
        words = found.split()
        if words == ["--version"] or not COMMAND.match(words[0]):
            continue
        nested = words[0] in {"layout", "hand"} and len(words) > 1 and COMMAND.match(words[1])
        command = words[: 2 if nested else 1]
        said = help_of(command, capsys)
        for option in re.findall(r"(?<!\S)--[a-z-]+", found):
            assert re.search(rf"{option}\b", said), f"{name}: `tgdsl {found}`: {option} is no option"


HELP: dict[tuple[str, ...], str] = {}


def help_of(command, capsys):
    if (key := tuple(command)) not in HELP:
        with pytest.raises(SystemExit) as ended:
            tyro.cli(Command, prog="tgdsl", args=[*command, "--help"])  # type: ignore[arg-type]
        assert ended.value.code == 0, command
        HELP[key] = capsys.readouterr().out
    return HELP[key]


def test_a_wrong_line_is_found():
    with pytest.raises(SystemExit):
        parse(["compile", "--no-such-option"])
