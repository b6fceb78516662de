"""Mutation testing: change one thing in the code of a room, run the tests that reach it, and list the changes that no test notices.

    make mutate ROOM=sensors                       # 30 changes, chosen by a seed
    python tests/mutate.py sensors --count 100 --seed 1
    python tests/mutate.py sensors/noise module    # several rooms, folders or files

A change is a sign, an operator, a comparison, a number, an index, a swapped name or a dropped statement. Each runs in a fork of
a process that has the libraries imported, with the changed module in place of the real one; the files stay as they are. The
tests that reach the changed line are known from one run of `make test` and the oracles under coverage. It is kept in
`build/mutate` and made again with `--refresh`; tests that fail then are left out. A change is killed when a test fails or hangs. What survives
`--limit` seconds of tests, near and short ones first, is given ten times as many.

A survivor means one of three things: a test is missing, the code has no effect and can go, or the change is equivalent.
"""

from __future__ import annotations

import argparse
import ast
import copy
import importlib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
RECORDS = REPOSITORY / "build" / "mutate"
LIBRARIES = ("torch", "numpy", "scipy.spatial", "scipy.sparse.linalg", "scipy.optimize", "mujoco", "pydantic", "ruamel.yaml")
"""Imported before forking: they take most of a process's start."""

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Div, ast.Mod: ast.FloorDiv, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {
    "min": "max",
    "minimum": "maximum",
    "amin": "amax",
    "sin": "cos",
    "any": "all",
    "floor": "ceil",
    "clamp_min": "clamp_max",
}
LARGE = 16
"""Integers from here on are counts and sizes rather than indices, and are doubled."""
NAMES |= {other: name for name, other in NAMES.items()}


@dataclass(frozen=True)
class Mutant:
    """One change of one file."""

    file: Path
    line: int
    source: str
    """The changed file's text."""
    change: str
    """The statement before and after."""


# Changes ---------------------------------------------------------------------------------------------------------------------


class Sites(ast.NodeVisitor):
    """Collect the nodes of a file that can be changed: no messages, annotations, assertions, `strict` or GPU kernels."""

    def __init__(self) -> None:
        """Start with none."""
        self.nodes: list[tuple[ast.AST, ast.stmt]] = []
        self._statement: ast.stmt | None = None

    def visit(self, node: ast.AST) -> None:
        """Collect a node and its descendants."""
        skipped = ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom | ast.arg
        is_strict = isinstance(node, ast.keyword) and node.arg == "strict"
        if isinstance(node, skipped) or is_strict or _is_kernel(node) or _is_guard(node) or _is_docstring(node):
            return
        if isinstance(node, ast.AnnAssign):
            if node.value is not None:
                self._statement = node
                self.visit(node.value)
            return
        if isinstance(node, ast.stmt):
            self._statement = node
        if self._statement is not None and next(iter(changes_of(node)), None) is not None:
            self.nodes.append((node, self._statement))
        for name, value in ast.iter_fields(node):
            if name in ("returns", "annotation", "type_params", "decorator_list"):
                continue
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST):
                    self.visit(child)


def _is_kernel(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef) and any("jit" in ast.unparse(d) for d in node.decorator_list)


def _is_guard(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'")


def _is_docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def changes_of(node: ast.AST) -> Iterator[ast.AST]:
    """Yield changed copies of a node."""
    new = copy.copy(node)
    match new:
        case ast.Compare(ops=[op]) if type(op) in COMPARISONS:
            new.ops = [COMPARISONS[type(op)]()]
        case ast.BinOp(op=op) if type(op) in OPERATORS and not _is_text_or_type(new):
            new.op = OPERATORS[type(op)]()
        case ast.AugAssign(op=op) if type(op) in OPERATORS:
            new.op = OPERATORS[type(op)]()
        case ast.UnaryOp(op=ast.USub() | ast.Not(), operand=operand):
            new = operand
        case ast.BoolOp(op=op):
            new.op = ast.Or() if isinstance(op, ast.And) else ast.And()
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value)):
            new.value = value + 1 if abs(value) < LARGE else 2 * value
        case ast.Constant(value=float(value)):
            new.value = 2 * value if value else 1.0
        case ast.Name(id=name) if name in NAMES:
            new.id = NAMES[name]
        case ast.Attribute(attr=name) if name in NAMES:
            new.attr = NAMES[name]
        case ast.Expr(value=ast.Call()):
            new = ast.copy_location(ast.Pass(), node)
        case _:
            return
    yield new


def _is_text_or_type(node: ast.BinOp) -> bool:
    """Whether an operator joins text, or types as in `Box | Sphere`."""
    if isinstance(node.op, ast.BitOr) and re.fullmatch(r"[A-Z]\w*[a-z]\w*( \| \w+)*", ast.unparse(node)):
        return True
    sides = (node.left, node.right)
    return any(isinstance(s, ast.JoinedStr) or (isinstance(s, ast.Constant) and isinstance(s.value, str | None)) for s in sides)


def mutants_of(files: list[Path], count: int, seed: int) -> list[Mutant]:
    """Return one change each of statements chosen at random, so that a table of numbers counts as one statement."""
    sites: dict[ast.stmt, tuple[Path, ast.Module, list[ast.AST]]] = {}
    for file in files:
        tree = ast.parse(file.read_text(encoding="utf-8"))
        collected = Sites()
        collected.visit(tree)
        for node, statement in collected.nodes:
            sites.setdefault(statement, (file, tree, []))[2].append(node)
    chance = random.Random(seed)
    chosen = chance.sample(list(sites.values()), min(count, len(sites)))
    mutants = [_mutant(file, tree, chance.choice(nodes)) for file, tree, nodes in chosen]
    return sorted(mutants, key=lambda mutant: (str(mutant.file), mutant.line))


def _mutant(file: Path, tree: ast.Module, node: ast.AST) -> Mutant:
    new = next(changes_of(node))
    line = file.read_text(encoding="utf-8").splitlines()[node.lineno - 1].strip()
    change = f"{line}  [{ast.unparse(node)} → {ast.unparse(new)}]"
    return Mutant(file, node.lineno, ast.unparse(_copied(tree, node, new)), change)


def _copied(tree: ast.AST, node: ast.AST, new: ast.AST) -> ast.AST:
    """Return a tree in which one node is another."""
    if tree is node:
        return ast.copy_location(new, node)
    result = copy.copy(tree)
    for name, value in ast.iter_fields(tree):
        if isinstance(value, ast.AST):
            setattr(result, name, _copied(value, node, new))
        elif isinstance(value, list):
            setattr(result, name, [_copied(item, node, new) if isinstance(item, ast.AST) else item for item in value])
    return result


# Tests that reach a line -----------------------------------------------------------------------------------------------------


def record(selection: list[str]) -> None:
    """Run the tests once under coverage; keep which test reaches which line, and how long each takes."""
    shutil.rmtree(RECORDS, ignore_errors=True)
    RECORDS.mkdir(parents=True)
    settings = RECORDS / "coveragerc"
    settings.write_text(
        f"[run]\nsource = {REPOSITORY / 'tgdsl'}\ndata_file = {RECORDS / 'coverage'}\ndisable_warnings = no-ctracer\n"
    )
    command = [
        *(sys.executable, "-m", "pytest", "--numprocesses", "auto", "--dist", "worksteal", "-q", "-p", "no:cacheprovider"),
        *("--cov", "--cov-context=test", "--cov-report=", f"--cov-config={settings}", f"--junitxml={RECORDS / 'times.xml'}"),
        *selection,
    ]
    subprocess.run(command, cwd=REPOSITORY, check=False)


class Reached:
    """The tests that reach a line, from the kept records."""

    def __init__(self) -> None:
        """Read the records."""
        from coverage import CoverageData

        self._data = CoverageData(str(RECORDS / "coverage"))
        self._data.read()
        cases = [
            ((case.get("classname"), case.get("name")), case)
            for case in ElementTree.parse(RECORDS / "times.xml").iter("testcase")
        ]
        self._seconds = {key: float(case.get("time") or 0) for key, case in cases}
        self._failed = {key for key, case in cases if case.find("failure") is not None or case.find("error") is not None}
        self._lines: dict[Path, dict[int, list[str]]] = {}
        self._tests = self._passing(self._data.measured_contexts())

    def tests(self, mutant: Mutant, limit: float) -> list[str]:
        """Return the tests that reach a change, near ones first, then short ones, as many as fit into a time [s]."""
        if mutant.file not in self._lines:
            self._lines[mutant.file] = self._data.contexts_by_lineno(str(mutant.file))
        lines = self._lines[mutant.file]
        tests = self._passing(lines.get(mutant.line, []))
        near = str("tests" / mutant.file.relative_to(REPOSITORY / "tgdsl").parent)
        if not tests:  # a statement of the module, run at import: tests of the folder may only read a table
            tests = self._passing(context for contexts in lines.values() for context in contexts)
            tests |= {test for test in self._tests if test.startswith(f"{near}/")}
        ordered = sorted(tests, key=lambda test: (not test.startswith(near), self._time(test)))
        total, kept = 0.0, []
        for test in ordered:
            total += self._time(test)
            if kept and total > limit:
                break
            kept.append(test)
        return kept

    def _passing(self, contexts: Iterable[str]) -> set[str]:
        """Return the tests of coverage's contexts but those that failed without any change."""
        tests = {context.rsplit("|", 1)[0] for context in contexts if context}
        return {test for test in tests if _key(test) not in self._failed}

    def _time(self, test: str) -> float:
        return self._seconds.get(_key(test), 1.0)


def _key(test: str) -> tuple[str, str]:
    """Return the class name and name under which pytest's report has a test."""
    path, *names = test.split("::")
    return ".".join([path.removesuffix(".py").replace("/", "."), *names[:-1]]), names[-1]


# Runs ------------------------------------------------------------------------------------------------------------------------


class ChangedModule(MetaPathFinder):
    """Import one module from changed source."""

    def __init__(self, mutant: Mutant) -> None:
        """Take the module's name from its file's place."""
        parts = mutant.file.relative_to(REPOSITORY).with_suffix("").parts
        self._name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        self._mutant = mutant

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Find the one module; leave the others to Python."""
        if name != self._name:
            return None
        mutant = self._mutant

        class Loader(SourceFileLoader):
            def get_code(self, fullname: str) -> object:
                return compile(mutant.source, str(mutant.file), "exec", dont_inherit=True)

        return spec_from_file_location(name, mutant.file, loader=Loader(name, str(mutant.file)))


def verdict_of(mutant: Mutant, selections: Sequence[list[str]], log: Path) -> str:
    """Return whether tests notice a change, the first selection of them or those that later ones add."""
    verdict, done = "unreached", set[str]()
    for tests in selections:
        more = [test for test in tests if test not in done]
        if more and verdict in ("unreached", "survived"):
            verdict, done = run(mutant, more, log), done.union(more)
    return verdict


def run(mutant: Mutant, tests: list[str], log: Path, limit: float = 900.0) -> str:
    """Return whether tests notice a change: "killed", "survived" or "timeout"."""
    child = os.fork()
    if child == 0:
        _run_in_child(mutant, tests, log)
    deadline = time.monotonic() + limit
    while time.monotonic() < deadline:
        finished, status = os.waitpid(child, os.WNOHANG)
        if finished:
            return "survived" if os.waitstatus_to_exitcode(status) == 0 else "killed"
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "timeout"


def _run_in_child(mutant: Mutant, tests: list[str], log: Path) -> None:
    code = 1
    try:
        os.setpgid(0, 0)
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        sys.meta_path.insert(0, ChangedModule(mutant))
        import pytest

        code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:randomly", *tests]))
    finally:
        os._exit(code)


def files_of(place: str) -> list[Path]:
    """Return the files of a room, folder or file below `tgdsl/`; tests of kernels interpret them in processes of their own."""
    path = REPOSITORY / "tgdsl" / place
    if not path.exists():
        names = sorted(folder.name for folder in (REPOSITORY / "tgdsl").iterdir() if (folder / "__init__.py").exists())
        raise SystemExit(f'no room "{place}"; expected one of {", ".join(names)}, or a folder or file in it')
    return sorted(file for file in path.rglob("*.py") if not file.stem.endswith("_kernel")) if path.is_dir() else [path]


def main() -> None:
    """Mutate each room and print a table; exit 1 if a room's share of killed changes is below `--least`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rooms", nargs="+", help="rooms, folders or files below tgdsl/")
    parser.add_argument("--count", type=int, default=30, help="changes per room")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of tests per change")
    parser.add_argument("--least", type=float, default=0.0, help="least share of killed changes")
    parser.add_argument("--refresh", action="store_true", help="record again which test reaches which line")
    parser.add_argument(
        "--tests",
        nargs=argparse.REMAINDER,
        default=["-m", "not slow or oracle"],
        help="last: arguments of pytest for the record",
    )
    options = parser.parse_args()
    os.chdir(REPOSITORY)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if options.refresh or not (RECORDS / "coverage").exists():
        record(options.tests)
    for name in LIBRARIES:
        importlib.import_module(name)
    reached, rows = Reached(), []
    for room in options.rooms:
        mutants = mutants_of(files_of(room), options.count, options.seed)
        selected = [[reached.tests(mutant, limit) for limit in (options.limit, 10 * options.limit)] for mutant in mutants]
        logs = [RECORDS / f"{room.replace('/', '_')}_{i}.log" for i in range(len(mutants))]
        with ThreadPoolExecutor(options.jobs) as pool:
            verdicts = []
            for mutant, verdict in zip(mutants, pool.map(verdict_of, mutants, selected, logs), strict=True):
                verdicts.append(verdict)
                if verdict in ("survived", "unreached"):
                    print(f"{mutant.file.relative_to(REPOSITORY)}:{mutant.line}: {verdict}: {mutant.change}", flush=True)
        killed = sum(verdict in ("killed", "timeout") for verdict in verdicts)
        rows.append((room, killed, len(mutants)))
        print(f"{room}: {killed} of {len(mutants)} killed", flush=True)
    raise SystemExit(any(killed < options.least * number for _, killed, number in rows))


if __name__ == "__main__":
    main()
