"""`tgdsl sweep`: one command for every combination of some settings, on Ray."""

from __future__ import annotations

import json
import runpy
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import Document
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    from tgdsl.commands.learning.sweep_document import Trial


@dataclass(frozen=True)
class Sweep:
    """Run every combination of a sweep's settings, each in a folder of its own; runs whose worker dies go on elsewhere."""

    document: Document
    address: str | None = None
    """A Ray cluster, as ray.init takes it; default: this machine, by its cores and GPUs."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """Folder of all runs; default: out/NAME of the document. Runs that it holds whole are not made again; others go on."""

    def run(self) -> None:
        """Run them, and say how each ended.

        Raises:
            TgdslError: If Ray is not installed, or some run failed.
        """
        from tgdsl.commands.learning.sweep_document import load_sweep

        spec, trials = load_sweep(self.document)
        try:
            import ray
            from ray.exceptions import RayError
        except ImportError as error:
            raise TgdslError(f'a sweep needs Ray: pip install "tgdsl[sweep]" ({error})') from error
        out = (self.out or Path("out") / self.document.stem).resolve()
        ray.init(address=self.address, log_to_driver=False, include_dashboard=False, ignore_reinit_error=True)
        try:
            largest = {name: max(node["Resources"].get(name, 0.0) for node in ray.nodes()) for name in ("CPU", "GPU")}
            if spec.cpus > largest["CPU"] or spec.gpus > largest["GPU"]:
                what = f"a run takes {spec.cpus:g} processors and {spec.gpus:g} GPUs"
                raise TgdslError(f"{self.document}: {what}, no machine has more than {largest['CPU']:g} and {largest['GPU']:g}")
            asked = {"num_cpus": spec.cpus, "num_gpus": spec.gpus, "max_retries": spec.retries, "max_calls": 1}
            work = ray.remote(**asked)(run_trial)
            waiting = {work.remote(trial, str(out / trial.name)): trial for trial in trials}
            failed = []
            while waiting:
                (done, *_), _ = ray.wait(list(waiting))
                trial = waiting.pop(done)
                try:
                    told = ray.get(done)
                except RayError as error:
                    told = f"failed: its worker died {spec.retries + 1} times ({type(error).__name__})"
                failed += [trial.name] if told.startswith("failed") else []
                print(f"{len(trials) - len(waiting)}/{len(trials)} {trial.name}: {told}", flush=True)
        finally:
            ray.shutdown()
        if failed:
            raise TgdslError(f"{len(failed)} of {len(trials)} runs failed; what they printed is in log.txt of each folder")


def run_trial(trial: Trial, folder: str) -> str:
    """Run a trial in this process, in which nothing else runs; go on where its folder holds a checkpoint; say how it ended."""
    from tgdsl.files.write import atomic_write

    place = Path(folder)
    end, words = place / "ended.json", [*trial.words, "--out", folder]
    if end.is_file():
        return "was made before"
    if (place / "checkpoint.pt").is_file():
        words = [*_left(words, place), "--resume", folder]
    place.mkdir(parents=True, exist_ok=True)
    with (place / "log.txt").open("a") as log:
        sys.argv, sys.stdout, sys.stderr = ["tgdsl", *words], log, log
        try:
            runpy.run_module("tgdsl", run_name="__main__")  # the command line itself; commands.cli imports this file
        except SystemExit as ended:
            if ended.code:
                return f"failed: exit code {ended.code}"
    atomic_write(end, json.dumps(trial.settings).encode())
    found = place / "evaluation.json"
    if not found.is_file():
        return "done"
    score = json.loads(found.read_text())
    return "score {score:.3g} [{score_interval[0]:.3g}, {score_interval[1]:.3g}] {unit}".format(**score)


def _left(words: list[str], folder: Path) -> list[str]:
    """Return a command's words with those minutes alone that a run has not learned yet."""
    from tgdsl.rl.train.folder import RunFolder

    rows = RunFolder(folder).rows()
    if "--minutes" not in words or not rows:
        return words
    at = words.index("--minutes") + 1
    left = max(0.0, float(words[at]) - float(rows[-1]["seconds"]) / 60.0)
    return [*words[:at], str(left), *words[at + 1 :]]
