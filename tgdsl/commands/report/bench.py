"""`tgdsl bench`: speed against error on a document's own scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import FILE, OptionalFile, Overrides, parsed_overrides

if TYPE_CHECKING:
    from tgdsl.report.bench.bench import Bench as Work
    from tgdsl.report.bench.results import Report


def _numbers(text: str) -> tuple[int, ...]:
    from tgdsl.errors import TgdslError

    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise TgdslError(f"--envs {text}: expected whole numbers joined by commas, such as 1024,4096") from None


@dataclass(frozen=True)
class Bench:
    """Measure what trades speed for error: of each sensor its variants and precisions, of the physics its options.

    Errors are of states of the document's own scene, run as by `tgdsl run`, against the finest variant in float64.
    """

    document: Annotated[tyro.conf.Positional[Path | None], FILE] = None
    """The YAML document; not for `--oracles` and `--hard`."""
    oracles: bool = False
    """In a clone, compare the package with all closed forms instead: ours, exact, and the paper's formula where it differs."""
    hard: bool = False
    """In a clone, run the numerical hard cases of all kinds instead."""
    device: str = "cpu"
    """Where sensors are computed: cpu, cuda or cuda:1."""
    envs: Annotated[str, tyro.conf.arg(metavar="N,N…")] = "256"
    """Environments of timed calls; the front is drawn at the most."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("report")
    """Folder for bench.html, bench.csv and bench.json."""
    sensors: tuple[str, ...] = ()
    """Sensors to measure, `physics` among them; default: all, and physics."""
    states: OptionalFile = None
    """States to measure errors on, an .npz file that `--save-states` wrote; default: a run of the scene."""
    save_states: OptionalFile = None
    """Write the states of the run to this file."""
    against: OptionalFile = None
    """The bench.json of an earlier run: says whether errors are the same, and which variants have changed places in time."""
    state_envs: int = 16
    """Environments of that run, which go differently far; half of them verify the errors of the others."""
    steps: int = 90
    """Control steps of that run, about."""
    substeps: int = 5
    """Physics steps per control step."""
    repeats: int = 11
    """Timed calls of each variant."""
    compiled: bool = False
    """Fuse the modules with torch.compile first."""
    seed: int = 0
    """Seed of the environments, the bootstraps and the states that are timed."""
    set: Overrides = ()

    def run(self) -> None:
        """Measure, print a table, write the files."""
        if self.document is None or self.oracles or self.hard:
            self._run_without_document()
            return
        from tgdsl.files.write import check_writable
        from tgdsl.report.bench.bench import Bench as Work
        from tgdsl.report.bench.compare import compared, read_rows
        from tgdsl.report.bench.page import write_bench
        from tgdsl.report.bench.sensors import Options
        from tgdsl.report.files import check_report_files
        from tgdsl.tensors.devices import device_of

        options = Options(device_of(self.device), _numbers(self.envs), self.repeats, self.compiled, self.seed)
        check_report_files(self.out, "bench")
        earlier = None if self.against is None else read_rows(self.against)
        if self.save_states is not None:
            check_writable(self.save_states)
        work = Work(
            self.document,
            parsed_overrides(self.set),
            self.sensors,
            self.states,
            self.save_states,
            self.state_envs,
            self.steps,
            self.substeps,
            options,
        )
        report = _measured(work)
        print(_text(report))
        if earlier is not None:
            print("\n".join(["", f"against {self.against}", *compared(report, earlier).lines()]))
        print("\n".join(["", *map(str, write_bench(report, self.out))]))

    def _run_without_document(self) -> None:
        """Run `--oracles` and `--hard`."""
        from tgdsl.commands.report.sheets import report
        from tgdsl.errors import TgdslError

        if not (self.oracles or self.hard):
            raise TgdslError("bench: found no document, expected one, --oracles or --hard")
        if self.document is not None:
            raise TgdslError(f"bench {self.document}: --oracles and --hard need no document, expected one or the other")
        report(self.oracles, self.hard, self.out)


def _measured(work: Work) -> Report:
    """Measure under a progress bar."""
    from tqdm import tqdm

    from tgdsl.report.bench.bench import bench

    with tqdm(desc="compiling", total=1, disable=None, leave=False, bar_format="{n_fmt}/{total_fmt} |{bar:20}| {desc}") as bar:

        def begun(done: int, of: int) -> None:
            bar.total, bar.n = of, done
            bar.refresh()

        return bench(work, lambda what: bar.set_description_str(what), begun)


def _text(report: Report) -> str:
    """Return the printed text."""
    from tgdsl.console.tables import text_table
    from tgdsl.report.bench.page import cells_of

    parts = [f"{report.document}: {report.states}\n{report.machine}"]
    for subject in report.subjects:
        header, *rows = cells_of(subject)
        marks = [("now" if p.is_own else "") + (" ●" if p.is_on_front else "") for p in subject.points]
        table = text_table((*header, ""), [(*row, mark.strip()) for row, mark in zip(rows, marks, strict=True)])
        lines = [
            f"{subject.name} ({subject.kind}), against {subject.reference}",
            *([subject.check] if subject.check else []),
            *subject.chosen,
        ]
        lines += [table, *(f"not to be had: {label}: {why}" for label, why in subject.left_out)]
        parts.append("\n".join(lines))
    parts.append("now: what the compiler takes; ●: on the front of time and RMS error, overlapping intervals being equal")
    return "\n\n".join(parts)
