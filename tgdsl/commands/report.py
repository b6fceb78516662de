"""Commands about an installation: its speed, its accuracy and its parts."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands import arguments as args
from tgdsl.errors import TgdslError
from tgdsl.files.write import check_writable

if TYPE_CHECKING:
    from tgdsl.console.bar import Bar

BAR_FORMAT = "{n_fmt}/{total_fmt} |{bar:20}| {desc}"


@dataclass(frozen=True)
class Bench:
    """Measure speed against error: variants and precisions of each sensor, and options of the physics.

    The states are from a run of the document's scene, as by `tgdsl run`. Errors are against the finest variant in float64.
    """

    document: Annotated[tyro.conf.Positional[Path | None], args.optional("FILE")] = None
    """The YAML document; required, except with --oracles or --hard."""
    oracles: bool = False
    """Compare the package with all closed forms instead, and with the paper's formulas; needs a clone of the repository."""
    hard: bool = False
    """Run the numerical hard cases of all kinds instead; needs a clone of the repository."""
    device: args.DeviceName = "cpu"
    """Device of the sensors: cpu, cuda or cuda:1."""
    envs: Annotated[str, tyro.conf.arg(metavar="N,N…")] = "256"
    """Numbers of environments to time; plots show the largest."""
    out: args.OutFolder = Path("report")
    """Folder for bench.html, bench.csv and bench.json."""
    sensors: args.Names = ()
    """Sensors to measure, and `physics`; default: all of them, and physics."""
    states: args.OptionalFile = None
    """States on which to measure errors: an .npz file of --save-states; default: a new run of the scene."""
    save_states: args.OptionalFile = None
    """An .npz file for the states of the run; default: no file."""
    against: args.OptionalFile = None
    """The bench.json of an earlier run, to compare errors and the order of variants by time; default: no comparison."""
    state_envs: int = 16
    """Environments of that run, with motions of different amplitude; half of them check the errors of the other half."""
    steps: int = 90
    """Approximate number of control steps of that run."""
    substeps: int = 5
    """Physics steps per control step."""
    repeats: int = 11
    """Timed calls per variant."""
    compiled: args.Compiled = False
    seed: int = 0
    """Seed of environments, bootstraps and timed states."""
    set: args.Overrides = ()

    def run(self) -> None:
        if self.document is None and not (self.oracles or self.hard):
            raise TgdslError("bench: found no document, expected one, --oracles or --hard")
        if self.document is None:
            _run_tests([name for name in ("oracles", "hard") if getattr(self, name)], self.out)
            return
        if self.oracles or self.hard:
            raise TgdslError(f"bench {self.document}: --oracles and --hard need no document, expected one or the other")
        from tgdsl.console.bar import Bar
        from tgdsl.report.bench.bench import Bench as Work
        from tgdsl.report.bench.bench import Options, bench
        from tgdsl.report.bench.compare import compared, read_rows
        from tgdsl.report.bench.page import bench_text, write_bench
        from tgdsl.report.files import check_report_files
        from tgdsl.tensors.devices import device_of

        try:
            envs = tuple(int(part) for part in self.envs.split(","))
        except ValueError:
            raise TgdslError(f"--envs {self.envs}: expected whole numbers joined by commas, such as 1024,4096") from None
        options = Options(device_of(self.device), envs, self.repeats, self.compiled, self.seed)
        check_report_files(self.out, "bench")
        earlier = None if self.against is None else read_rows(self.against)
        if self.save_states is not None:
            check_writable(self.save_states)
        run = {name: getattr(self, name) for name in ("sensors", "states", "save_states", "state_envs", "steps", "substeps")}
        work = Work(self.document, args.parsed_overrides(self.set), **run, options=options)
        with Bar("compiling", 1, "variant", bar_format=BAR_FORMAT) as bar:
            report = bench(work, bar.set_description_str, lambda done, of: _show(bar, done, of))
        print(bench_text(report))
        if earlier is not None:
            print("\n".join(["", f"against {self.against}", *compared(report, earlier).lines()]))
        print("\n".join(["", *map(str, write_bench(report, self.out))]))


def _show(bar: Bar, done: int, total: int) -> None:
    bar.total, bar.n = total, done
    bar.refresh()


def _run_tests(names: list[str], out: Path) -> None:
    """Compute the reports `oracles` and `hard`, print their tables and write their files; a wrong result is an error."""
    from tgdsl.report.files import check_report_files

    tests = tests_of_clone()
    for name in names:
        check_report_files(out, name)
    if failed := sum(_run_sheet(name, tests, out) for name in names):
        raise TgdslError(f"{failed} results are not as they should be; they are marked in {out}")


def _run_sheet(name: str, tests: ModuleType, out: Path) -> int:
    """Compute a report, print its table and write its files; return the number of wrong results."""
    from tgdsl.console.bar import Bar

    with Bar(name, 1, "section", bar_format=BAR_FORMAT) as bar:

        def begun(section: str, done: int, total: int) -> None:
            bar.set_description_str(f"{name}: {section}", refresh=False)
            _show(bar, done, total)

        sheet = tests.sheet(name, begun)
    sheets = importlib.import_module("oracles.sheet")
    print(sheets.sheet_text(sheet))
    print("\n".join(["", *map(str, sheets.write_sheet(sheet, out)), ""]))
    return len(sheet.failed)


def tests_of_clone() -> ModuleType:
    """Import `oracles.report`, which is in `tests/` of a clone; raise an error if tgdsl is not imported from one."""
    tests = Path(__file__).parents[2] / "tests"
    if not (tests / "oracles" / "report.py").is_file():
        raise TgdslError(
            "bench --oracles and --hard run tgdsl's tests, which an installed package does not contain: in a clone of the "
            "repository, run `pip install -e .` and then the command again"
        )
    if str(tests) not in sys.path:
        sys.path.insert(0, str(tests))
    return importlib.import_module("oracles.report")


@dataclass(frozen=True)
class Doctor:
    """Show versions, devices, compilers, OpenGL and caches, with faults and their fallbacks; exit code 1 at a fault."""

    json: bool = False
    """Print JSON, for a report."""

    def run(self) -> None:
        from tgdsl.report.doctor import examine

        examination = examine()
        print(json.dumps(asdict(examination), indent=2, ensure_ascii=False) if self.json else examination)
        if not examination.is_sound:
            sys.exit(1)
