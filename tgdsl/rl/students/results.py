"""Results of students: a policy file each, a table of their scores, and the layout of the taxels that one has chosen.

An interval over seeds and episodes is the wider one of two: Student's, of the seeds' means, which vary by both but are few; and
the interval of all episodes, as if seeds made no difference.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from glob import escape
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int
from scipy.stats import t as student_t

from tgdsl.compiler.pipeline import all_layouts
from tgdsl.console.progress import Progress
from tgdsl.console.tables import text_table
from tgdsl.fields.models import Selection
from tgdsl.files.write import atomic_write, with_folder
from tgdsl.layout.layout import Layout
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.playing.evaluation import Evaluation
from tgdsl.rl.playing.policy import PolicyError, PolicyFile, card_texts, check_card, write_onnx_policy, write_policy
from tgdsl.rl.sensors import GROUP, PolicyTouch, TaskSensors, compile_sensors
from tgdsl.rl.students.gates import openings
from tgdsl.rl.students.keys import StudentKey, own_task
from tgdsl.rl.students.learner import Distiller
from tgdsl.rl.students.student import acting, deployed
from tgdsl.schema.placement import LayoutSpec


class Row(NamedTuple):
    """Students that differ in their seeds alone: their touch, their mean score with its 95 % interval, `low` to `high`.

    `held` is the share of episodes of full length, `samples` are the control steps of each student, `minutes` the training
    time, together with all other students of the simulation [min].
    """

    type: str
    placement: str
    resolution: str
    noise: str
    seeds: int
    score: float
    low: float
    high: float
    held: float
    episodes: int
    samples: int
    minutes: float


def rows_of(
    keys: Sequence[StudentKey],
    evaluations: Sequence[Evaluation],
    score_range: tuple[float, float],
    resolution: str,
    samples: int,
    minutes: float,
) -> list[Row]:
    """Return the rows of students, with intervals within the range of the task's scores."""
    kinds: dict[tuple[str, str, str], list[Evaluation]] = {}
    for key, evaluation in zip(keys, evaluations, strict=True):
        kinds.setdefault(key.kind, []).append(evaluation)
    rows = []
    for (type_, placement, noise), each in kinds.items():
        score, held = fmean(one.score for one in each), fmean(one.held for one in each)
        low, high = interval(each)
        if math.isfinite(low) and math.isfinite(high):
            low, high = max(low, score_range[0]), min(high, score_range[1])
        episodes = sum(one.episodes for one in each)
        rows.append(Row(type_, placement, resolution, noise, len(each), score, low, high, held, episodes, samples, minutes))
    return rows


def interval(evaluations: Sequence[Evaluation]) -> tuple[float, float]:
    """Return the 95 % interval of the mean score over seeds and episodes."""
    scores, num = [each.score for each in evaluations], len(evaluations)
    halves = [0.5 * (each.score_interval[1] - each.score_interval[0]) for each in evaluations]
    half = math.sqrt(sum(half_width**2 for half_width in halves)) / num
    if num > 1:
        with np.errstate(invalid="ignore"):  # a score that is not finite has no interval
            half = max(half, float(student_t.ppf(0.975, num - 1) * np.std(scores, ddof=1)) / math.sqrt(num))
    return fmean(scores) - half, fmean(scores) + half


def write_table(rows: Sequence[Row], file: Path) -> None:
    """Write rows as CSV; raise `FileError` if the file cannot be written."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
    atomic_write(file, text.getvalue().encode())


def shown(rows: Sequence[Row], unit: str, is_less_better: bool = False) -> str:
    """Return rows as a table for people, the best first."""
    cells = []
    for row in sorted(rows, key=lambda each: each.score if is_less_better else -each.score):
        place = " ".join(part for part in (row.placement, row.resolution, row.noise) if part)
        bounds = f"{row.low:.3f} to {row.high:.3f}" if math.isfinite(row.low) else "–"
        cells.append((row.type, place, f"{row.seeds}", f"{row.score:.3f}", bounds, f"{row.held:.1%}", f"{row.samples:,}"))
    return text_table(("type", "where", "seeds", f"score [{unit}]", "95 %", "held", "steps of each"), cells)


def write_students(
    distiller: Distiller,
    loaded: LoadedTask,
    origin: Mapping[str, Any],
    seconds: float,
    command: str,
    evaluations: Sequence[Evaluation],
    folder: Path,
    progress: Progress,
) -> None:
    """Write each student as a policy file, with its card, for `tgdsl play --policy` and `tgdsl evaluate`."""
    with_folder(folder / "any")
    alone: dict[PolicyTouch | None, Any] = {}
    for i, key in enumerate(distiller.keys):
        if key.touch not in alone:
            progress(f"taxels of {key.name}")
            alone[key.touch] = compile_sensors(own_task(loaded, key.touch), "cpu").touch
        touch, names = alone[key.touch], distiller.groups[key.name]
        sizes = {GROUP if key.touch and name == key.touch.group else name: distiller.env.groups[name] for name in names}
        spec = own_task(loaded, key.touch).spec.model_dump(mode="json")
        run = dict(origin) | {"spec": spec, "taxels": touch.taxels_id, "seed": key.seed}
        run["overrides"] = dict(origin["overrides"]) | {name: spec[name] for name in ("touch", "placement", "noise")}
        card = distiller.card(run, seconds, command, sizes)
        card["samples"] = distiller.samples // len(distiller.keys)
        card |= {"teacher": origin["teacher"], "score": evaluations[i].plain() if evaluations else None}
        network = acting(distiller.student(i))
        if network.student.gates is not None:
            card["gates"] = network.student.gates.log_alpha.tolist()
        texts = card_texts(touch, card)
        write_policy(deployed(network), texts, folder / f"{key.name}.pt")
        write_onnx_policy(network, texts, folder / f"{key.name}.onnx")


CHOSEN = "chosen"  # the group of links with chosen taxels


def chosen_layout(saved: PolicyFile, taxels: int | None, progress: Progress) -> tuple[LayoutSpec, dict[str, Layout]]:
    """Return a student's layout with the taxels of its widest gates alone (None: of all open ones): see `reduced_layout`."""
    card, file = saved.card or {}, saved.file
    if "gates" not in card:
        raise PolicyError(f"{file}: this policy has no gates; teach a student with distill.gates")
    log_alpha = np.array(card["gates"])
    count = taxels or int((openings(torch.from_numpy(log_alpha)) > 0.0).sum())
    if not 0 < count <= len(log_alpha):
        raise PolicyError(f"{file}: {count or 'none'} of its {len(log_alpha)} taxels; give --taxels from 1 to {len(log_alpha)}")
    if not Path(card["task"]).is_file():
        raise PolicyError(f"{file}: its task, {card['task']}, is not here; run this in the folder where the student was taught")
    loaded = load_task(card["task"], card["overrides"])
    sensors = compile_sensors(loaded, "cpu", progress)
    check_card(saved, card["joints"], sensors.touch)
    return reduced_layout(loaded, sensors, np.argsort(-log_alpha, kind="stable")[:count])


def reduced_layout(
    loaded: LoadedTask, sensors: TaskSensors, rows: Int[np.ndarray, " chosen"]
) -> tuple[LayoutSpec, dict[str, Layout]]:
    """Return a task's layout with only some taxels of its touch, at its resolution; their links are the group `chosen`.

    Links without any are left as they are, as other sensors and the teacher may need them.
    """
    name, touch = sensors.touch.plan.origin.resolution, sensors.groups[GROUP].layout
    spec, layouts = all_layouts(loaded.folder / loaded.spec.document, {}, [name])
    layout = layouts[name]
    chosen = layout.taxels_of(tuple(link.name for link in touch.links))[rows]
    on_chosen_links = np.isin(layout.link_id, layout.link_id[chosen])
    kept = np.union1d(chosen, np.flatnonzero(~on_chosen_links))
    links = tuple(escape(layout.links[i].name) for i in np.unique(layout.link_id[chosen]))
    update = {"groups": {**spec.groups, CHOSEN: Selection(include=links)}, "resolutions": {name: spec.resolutions[name]}}
    return spec.model_copy(update=update), {name: layout.take(kept)}
