"""`tgdsl sweep`: one command for every combination of some settings, on Ray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import Document
from tgdsl.errors import TgdslError


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
        from tgdsl.commands.learning.sweep_trial import run_trial

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
                raise TgdslError(
                    f"{self.document}: {requirement}, no machine has more than {largest['CPU']:g} and {largest['GPU']:g}"
                )
            resources = {"num_cpus": spec.cpus, "num_gpus": spec.gpus, "max_retries": spec.retries, "max_calls": 1}
            work = ray.remote(**resources)(run_trial)
            waiting = {work.remote(trial, str(out / trial.name)): trial for trial in trials}
            failed = []
            while waiting:
                (done, *_), _ = ray.wait(list(waiting))
                trial = waiting.pop(done)
                try:
                    outcome = ray.get(done)
                except (LocalRayletDiedError, NodeDiedError, OutOfMemoryError, WorkerCrashedError) as error:
                    outcome = f"failed: its worker died {spec.retries + 1} times ({type(error).__name__})"
                except RayError as error:
                    outcome = f"failed: {type(error).__name__}: {(str(error).splitlines() or [''])[-1]}"
                failed += [trial.name] if outcome.startswith("failed") else []
                print(f"{len(trials) - len(waiting)}/{len(trials)} {trial.name}: {outcome}", flush=True)
        finally:
            ray.shutdown()
        if failed:
            raise TgdslError(f"{len(failed)} of {len(trials)} runs failed; what they printed is in log.txt of each folder")
