"""One run of a sweep, in a process of its own."""

from __future__ import annotations

import json
import runpy
import shlex
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tgdsl.commands.learning.sweep_document import Trial


def run_trial(trial: Trial, folder: str) -> str:
    """Run a trial in this process, in which nothing else runs; go on where its folder holds a checkpoint; say how it ended.

    `trial.json` has its words, which identify its settings; `ended.json` is there once it is complete.
    """
    from tgdsl.files.write import atomic_write

    place = Path(folder)
    words_file, end, words = place / "trial.json", place / "ended.json", [*trial.words, "--out", folder]
    if words_file.is_file() and (last_words := json.loads(words_file.read_text())) != list(trial.words):
        return f"failed: its folder holds a run of other settings, `tgdsl {shlex.join(last_words)}`; give another --out"
    if end.is_file():
        return "was made before"
    place.mkdir(parents=True, exist_ok=True)
    atomic_write(words_file, json.dumps(trial.words).encode())
    with (place / "log.txt").open("a") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            if (place / "checkpoint.pt").is_file() or (place / "distill.json").is_file():
                words = [*left([*trial.words], place), "--resume", folder]
            sys.argv = ["tgdsl", *words]
            runpy.run_module("tgdsl", run_name="__main__")  # the command line itself; commands.cli imports this package
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
    """Return a command's words with those minutes alone that a run had not learned at its last checkpoint.

    Students keep theirs in the folder of their resolution; with `--minutes` there is only one.
    """
    from tgdsl.rl.train.folder import read_checkpoint

    checkpoints = [*folder.glob("checkpoint.pt"), *folder.glob("*/checkpoint.pt")]
    if "--minutes" not in words or not checkpoints:
        return words
    at = words.index("--minutes") + 1
    left = max(0.0, float(words[at]) - read_checkpoint(checkpoints[0])["seconds"] / 60.0)
    return [*words[:at], str(left), *words[at + 1 :]]
