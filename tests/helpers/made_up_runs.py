"""Folders as `tgdsl distill` writes them, of students whose curves and scores are known."""

import csv
import json

from tgdsl.rl.sensors import PolicyTouch
from tgdsl.rl.students.keys import NONE, StudentKey
from tgdsl.rl.students.results import Row, write_table

ITERATIONS, STEPS, ROWS = 300, 24, 10
"""Iterations; control steps of each, and environments of each student."""
LEGS, PART = (0, 240), 17
"""Iterations after which a leg begins, and the next ones, which 10 s of 0.025 s touch: their scores are nonsense."""


def made_up_run(
    folder, scores, seeds=2, places=(("hand", "med", "clean"),), task="in_palm_rotate", is_stale=False, overrides=None
):
    """Write a run; return its folder.

    Args:
        folder: Where to.
        scores: Function of progress from 0 to 1 by type: the score of the first seed; others have 0.01 more each.
        seeds: Students of each kind.
        places: Placement, resolution and noise of each type; what feels nothing is in each resolution.
        task: The task's name, whose document is that of the examples.
        is_stale: Whether the curve goes on for an iteration beyond the table.
        overrides: Of the document.
    """
    resolutions = list(dict.fromkeys(place[1] for place in places))
    asked = {"teacher": "policies/x.pt", "types": list(scores), "placements": [], "noise": [], "seeds": seeds}
    asked |= {"resolutions": resolutions, "envs": None, "seed": 0, "overrides": overrides or {}}
    rows = []
    for resolution in resolutions:
        kinds = [
            (type_, None if type_ == NONE else PolicyTouch(type_, place[0], place[2]))
            for type_ in scores
            for place in ([("", resolution, "")] if type_ == NONE else places)
            if place[1] == resolution
        ]
        keys = [(type_, StudentKey(touch, seed)) for type_, touch in kinds for seed in range(seeds)]
        (folder / resolution).mkdir(parents=True)
        _curve(folder / resolution / "curve.csv", scores, keys, is_stale)
        own = {key.name: _evaluation(task, scores[type_](1.0) + 0.01 * key.seed) for type_, key in keys}
        (folder / resolution / "evaluation.json").write_text(json.dumps(own))
        start = {"task": f"examples/tasks/{task}.yaml", "device": "made up", "envs": ROWS * len(keys), "versions": {}}
        physics = {"timestep": 0.005, "substeps": 5}
        start["spec"] = {"task": task, "episode": 10.0, "physics": physics, "distill": {"steps": STEPS, "learning_rate": 1e-4}}
        starts = [start | {"iteration": first} for first in LEGS]
        (folder / resolution / "run.json").write_text(json.dumps({"starts": starts}))
        for type_, touch in kinds:
            score = scores[type_](1.0) + 0.005 * (seeds - 1)
            place = (touch.placement, resolution, touch.noise) if touch else ("", resolution, "")
            bounds = (score, score - 0.1, score + 0.1)
            rows.append(Row(type_, *place, seeds, *bounds, 0.9, 100 * seeds, ITERATIONS * STEPS * ROWS, 25.0))
    write_table(rows, folder / "table.csv")
    (folder / "distill.json").write_text(json.dumps(asked))
    return folder


def _curve(file, scores, keys, is_stale):
    with file.open("w", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        names = [start + key.name for start in ("Score/", "Loss/") for _, key in keys]
        writer.writerow(["iteration", "samples", "seconds", "episodes", "Episode/score", *names])
        for i in range(1, ITERATIONS + 1 + is_stale):
            score = [scores[type_](i / ITERATIONS) + 0.01 * key.seed for type_, key in keys]
            is_part = any(first < i <= first + PART for first in LEGS)
            told = [-1e3] * len(keys) if is_part else score if i % 3 else ["nan"] * len(keys)
            writer.writerow([i, i * STEPS * ROWS * len(keys), 5.0 * i, 7, 0.0, *told, *[1.0 / i] * len(keys)])


def _evaluation(task, score):
    own = {"task": task, "unit": "quarter turns", "episodes": 100, "envs": ROWS, "seed": 1, "score": score}
    own |= {"score_interval": [score - 0.1, score + 0.1], "held": 0.9, "held_interval": [0.8, 0.95]}
    return own | {"episode_return": 1.0, "seconds": 9.0, "faults": 0}
