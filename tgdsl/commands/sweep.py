"""`tgdsl sweep`: one command for every combination of some settings, on Ray; and one of its runs, in a separate process."""

from __future__ import annotations

import json
import runpy
import shlex
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tgdsl.commands.arguments import Document, OptionalOutFolder, optional
from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write

if TYPE_CHECKING:
    from tgdsl.commands.sweep_document import Trial


@dataclass(frozen=True)
class Sweep:
    """Run every combination of a sweep's settings, each in its own folder; a run whose worker dies continues on another."""

    document: Annotated[Document, tyro.conf.arg(help="The sweep's YAML document.")]
    address: Annotated[str | None, optional("ADDRESS")] = None
    """Address of a Ray cluster, as for ray.init; default: this machine, with all its cores and GPUs."""
    out: OptionalOutFolder = None
    """Folder of all runs; default: out/NAME, by the document's name. Finished runs in it stay, others continue."""

    def run(self) -> None:
        from tgdsl.commands.sweep_document import load_sweep

        spec, trials = load_sweep(self.document)
        try:
            import ray
            from ray.exceptions import LocalRayletDiedError, NodeDiedError, OutOfMemoryError, RayError, WorkerCrashedError
        except ImportError as error:
            raise TgdslError(f'a sweep needs Ray: pip install "tgdsl[sweep]" ({error})') from error
        out = (self.out or Path("out") / self.document.stem).resolve()
        ray.init(address=self.address, log_to_driver=False, include_dashboard=False, ignore_reinit_error=True)
        try:
            largest = {name: max(node["Resources"].get(name, 0.0) for node in ray.nodes()) for name in ("CPU", "GPU")}
            if spec.cpus > largest["CPU"] or spec.gpus > largest["GPU"]:
                requirement = f"a run takes {spec.cpus:g} processors and {spec.gpus:g} GPUs"
                available = f"no machine has more than {largest['CPU']:g} and {largest['GPU']:g}"
                raise TgdslError(f"{self.document}: {requirement}, {available}")
            work = ray.remote(num_cpus=spec.cpus, num_gpus=spec.gpus, max_retries=spec.retries, max_calls=1)(run_trial)
            waiting = {work.remote(trial, str(out / trial.name)): trial for trial in trials}
            print(f"{len(trials)} runs; log.txt in each folder of {out} has a run's progress", flush=True)
            failed = 0
            while waiting:
                (done, *_), _ = ray.wait(list(waiting))
                trial = waiting.pop(done)
                try:
                    outcome = ray.get(done)
                except (LocalRayletDiedError, NodeDiedError, OutOfMemoryError, WorkerCrashedError) as error:
                    outcome = f"failed: its worker died {spec.retries + 1} times ({type(error).__name__})"
                except RayError as error:
                    outcome = f"failed: {type(error).__name__}: {(str(error).splitlines() or [''])[-1]}"
                failed += outcome.startswith("failed")
                print(f"{len(trials) - len(waiting)}/{len(trials)} {trial.name}: {outcome}", flush=True)
        finally:
            ray.shutdown()
        if failed:
            raise TgdslError(f"{failed} of {len(trials)} runs failed; what they printed is in log.txt of each folder")


def run_trial(trial: Trial, folder: str) -> str:
    """Run a trial in this process, alone; resume from a checkpoint in its folder; return its outcome as text.

    `trial.json` has its words, which identify its settings; `ended.json` is there once it is complete.
    """
    place = Path(folder)
    words_file, end, words = place / "trial.json", place / "ended.json", [*trial.words, "--out", folder]
    if words_file.is_file() and (last_words := json.loads(words_file.read_text())) != list(trial.words):
        return f"failed: its folder holds a run of other settings, `tgdsl {shlex.join(last_words)}`; give another --out"
    if end.is_file():
        return "finished earlier"
    place.mkdir(parents=True, exist_ok=True)
    atomic_write(words_file, json.dumps(trial.words).encode())
    with (place / "log.txt").open("a") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            if (place / "checkpoint.pt").is_file() or (place / "distill.json").is_file():
                words = [*left([*trial.words], place), "--resume", folder]
            sys.argv = ["tgdsl", *words]
            runpy.run_module("tgdsl", run_name="__main__")  # the command line itself; commands.cli imports this file
        except SystemExit as ended:
            if ended.code:
                return f"failed: exit code {ended.code}"
        except Exception as error:
            traceback.print_exc(file=log)
            return f"failed: {type(error).__name__}: {error}"
    atomic_write(end, json.dumps(trial.settings).encode())
    result_file = place / "evaluation.json"
    if not result_file.is_file():
        return "done"
    score = json.loads(result_file.read_text())
    low, high = ("–" if end is None else f"{end:.3g}" for end in score["score_interval"])  # of one episode there is none
    return f"score {score['score']:.3g} [{low}, {high}] {score['unit']}"


def left(words: list[str], folder: Path) -> list[str]:
    """Return a command's words with only those minutes that a run had not learned at its last checkpoint.

    Students keep theirs in the folder of their resolution; with `--minutes` there is only one.
    """
    from tgdsl.rl.train.folder import read_checkpoint

    checkpoints = [*folder.glob("checkpoint.pt"), *folder.glob("*/checkpoint.pt")]
    if "--minutes" not in words or not checkpoints:
        return words
    at = words.index("--minutes") + 1
    minutes = max(0.0, float(words[at]) - read_checkpoint(checkpoints[0])["seconds"] / 60.0)
    return [*words[:at], str(minutes), *words[at + 1 :]]
