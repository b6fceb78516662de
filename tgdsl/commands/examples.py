"""`tgdsl examples`: documents, tasks and scripts that come with tgdsl."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands import arguments as args
from tgdsl.errors import TgdslError, did_you_mean, listed
from tgdsl.files.find import shared_folder
from tgdsl.files.write import atomic_write_all

SUFFIXES = (".cpp", ".py", ".yaml")  # of a script and a document of one name, the document is the example
FILE_NAME = re.compile(r"[\w./-]+\.\w+")


@dataclass(frozen=True)
class List:
    """List the examples, by the names that `copy` takes, and the policies that come with them."""

    def run(self) -> None:
        names = example_names()
        width = max(map(len, names))
        print("\n".join(f"{name:<{width}}  {summary_of(file)}" for name, file in sorted(names.items())))
        policies = sorted(file.stem for file in (shared_folder() / "policies").glob("*.pt"))
        print(f"\npolicies, copied with their tasks: {', '.join(policies)}")


@dataclass(frozen=True)
class Copy:
    """Copy examples and all files that they name: scenes, robots, tasks, and the policies that come with a task.

    The files have the same paths as in the repository, so commands of the documentation work in the folder.
    """

    names: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[NAME ...]", help_behavior_hint="")] = ()
    """Names from `tgdsl examples list`, such as xhand1_palm or tasks/find_ridge; default: all."""
    out: args.OutFolder = Path()
    """Folder in which examples/, robots/ and policies/ are created."""

    def run(self) -> None:
        examples, top = example_names(), shared_folder().resolve()
        names = [name.removeprefix("examples/").removesuffix(".yaml") for name in self.names]
        for name in names:
            if name not in examples:
                raise TgdslError(f'there is no example "{name}"; {did_you_mean(name, examples, "examples")}')
        files = files_named_by([examples[name] for name in names or examples])
        contents = {self.out / file.relative_to(top): file.read_bytes() for file in files}
        if changed := [str(file) for file, content in contents.items() if file.exists() and file.read_bytes() != content]:
            raise TgdslError(f"already there, with other content: {listed(changed)}; remove them, or name another folder by -o")
        atomic_write_all({file: content for file, content in contents.items() if not file.exists()})
        print("\n".join(str(self.out / file.relative_to(top)) for file in files if top / "robots" not in file.parents))
        print(f"with robots: {len(contents)} files, {sum(map(len, contents.values())) / 1e6:.1f} MB")


@dataclass(frozen=True)
class Examples:
    """List or copy the examples that come with tgdsl."""

    action: Annotated[args.subcommands(List, Copy), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    """What to do."""

    def run(self) -> None:
        self.action.run()


def example_names() -> dict[str, Path]:
    """Return the examples by their path below `examples` without its ending."""
    folder = shared_folder() / "examples"
    files = [file for suffix in SUFFIXES for file in sorted(folder.rglob(f"*{suffix}"))]
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}


def summary_of(file: Path) -> str:
    """Return the first sentence of an example's opening comment or docstring."""
    head = re.sub(r"^# yaml-language-server.*\n", "", file.read_text(encoding="utf-8"))
    opening = re.match(r'"""(.*)|((?:(?:#|//) .*\n)+)', head)
    return re.split(r"[.:](?:\s|$)", re.sub(r"\n?(?:#|//) ", " ", opening[1] or opening[2]).strip())[0] if opening else ""


def files_named_by(files: list[Path]) -> list[Path]:
    """Return files and, recursively, the files that they name: for a robot its folder, for a task its policies too."""
    result: set[Path] = set()
    queue = [file.resolve() for file in files]
    while queue:
        if (file := queue.pop()) not in result:
            result.add(file)
            queue += _named_in(file, shared_folder().resolve())
    return sorted(result)


def _named_in(file: Path, top: Path) -> Iterator[Path]:
    if top / "examples" not in file.parents:
        return
    for word in FILE_NAME.findall(file.read_text(encoding="utf-8")):
        named = (file.parent / word).resolve()
        if top / "robots" in named.parents and named.is_file():
            yield from (other for other in named.parent.rglob("*") if other.is_file() and other.suffix != ".pyc")
        elif top / "examples" in named.parents and named.is_file():
            yield named
    for card in (top / "policies").glob("*.json"):
        if json.loads(card.read_text(encoding="utf-8"))["task"] == file.relative_to(top).as_posix():
            yield from (card, card.with_suffix(".pt"))
