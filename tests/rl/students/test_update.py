"""An update of a stack, against students trained one by one in plain torch, in float64."""

import itertools
import math
import random
from functools import partial
from statistics import fmean
from typing import NamedTuple

import pytest
import torch
from felt_tasks import felt_task
from torch import Tensor
from written_teachers import teacher

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.students import learner
from tgdsl.rl.students.keys import Teacher, student_keys, touches
from tgdsl.rl.students.learner import Distiller
from tgdsl.rl.students.student import Stack, Student

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")
UPDATES = 1e-9  # float64, 18 steps of Adam
STEPS, LENGTH, ROWS, EPOCHS, NUM_UPDATES, RATE = 6, 3, 4, 3, 3, 1e-2
STD = (0.5, 0.25)  # of the teacher's actions
SCALES, WEIGHTS = (20.0, 1.0), (0.5, 2.0)  # of the decoders
KINDS = {
    "mlp": {"kind": "mlp", "touch_kind": "mlp"},
    "lstm": {"kind": "lstm", "touch_kind": "lstm"},
    "convrnn": {"kind": "mlp", "touch_kind": "convrnn"},
}


class Chosen(NamedTuple):
    """Settings of `distill:` that differ between the cases."""

    loss: str = "mse"
    clip: float | None = None
    max_grad_norm: float | None = None
    num_decoders: int = 0
    aggregate: int = 1
    final_learning_rate: float | None = None
    normalise: bool = False
    gates: int | None = None


CHOSEN = {
    "plain": Chosen(),
    "huber": Chosen("huber", clip=0.02, normalise=True, final_learning_rate=1e-4, gates=1),
    "all": Chosen("inverse_variance", clip=0.02, max_grad_norm=4.0, num_decoders=2, aggregate=2, gates=2),
}


class Lesson(NamedTuple):
    """A rollout of one student, (step, row, …); `begun` is (row, memory)."""

    x: Tensor
    before: Tensor
    label: Tensor
    target: Tensor
    ended: Tensor
    begun: Tensor


class Alone:
    """A student trained separately."""

    def __init__(self, student: Student, number: int, chosen: Chosen):
        self.student, self.number, self.chosen = student, number, chosen
        self.optimiser = torch.optim.Adam(student.parameters(), lr=RATE)
        self.seen: list[Tensor] = []
        self.label_std: Tensor | None = None  # over all of the teacher's actions so far
        self.norms: list[float] = []

    def fall(self, share: float) -> None:
        """Set the learning rate for a finished share of the run."""
        if self.chosen.final_learning_rate is not None:
            logarithm = math.log(RATE) + share * (math.log(self.chosen.final_learning_rate) - math.log(RATE))
            self.optimiser.param_groups[0]["lr"] = math.exp(logarithm)

    def acted(self, lesson: Lesson) -> Tensor:
        """Return its current actions, (step, row, joint)."""
        actions, memory = [], lesson.begun
        with torch.no_grad():
            for x, ended in zip(lesson.x, lesson.ended, strict=True):
                output = self.student(x, memory)
                actions.append(output.action)
                memory = output.memory * ~ended[:, None]
        return torch.stack(actions)

    def passed(self, lesson: Lesson, is_latest: bool) -> float:
        """Train on a rollout once; return the mean error of the actions."""
        old_actions = lesson.before if is_latest else self.acted(lesson)
        memory, errors = lesson.begun, []
        for first in range(0, STEPS, LENGTH):
            behaviour, decoded, noise = [], [], gate_noise(self.number, len(self.norms)) if self.student.gates else None
            for t in range(first, first + LENGTH):
                action, numbers, memory = self.student(lesson.x[t], memory, noise)
                memory = memory * ~lesson.ended[t][:, None]
                behaviour.append(self.behaviour(action, lesson.label[t], old_actions[t]).mean())
                for k in range(self.chosen.num_decoders):
                    off = numbers[:, k] - SCALES[k] * lesson.target[t][:, k]
                    decoded.append(WEIGHTS[k] * off.square().mean())
            error = torch.stack(behaviour).mean()
            self.optimiser.zero_grad()
            (error + sum(decoded) / LENGTH + self.penalty()).backward()
            norm = torch.nn.utils.clip_grad_norm_(self.student.parameters(), self.chosen.max_grad_norm or torch.inf)
            self.norms.append(float(norm))
            self.optimiser.step()
            memory = memory.detach()
            errors.append(float(error.detach()))
        return fmean(errors)

    def penalty(self) -> Tensor | float:
        """Return the loss of open gates."""
        if self.student.gates is None:
            return 0.0
        is_open = torch.sigmoid(20.0 * self.student.gates.weight - 2 / 3 * math.log(0.1 / 1.1))
        return 0.5 * torch.clamp(is_open.sum() - (self.chosen.gates or 0), min=0.0) / len(is_open)

    def behaviour(self, action: Tensor, label: Tensor, before: Tensor) -> Tensor:
        """Return the error of each action."""
        bound = self.chosen.clip
        error = self.loss(action - label)
        if bound is not None:
            bounded = torch.minimum(torch.maximum(action, before - bound), before + bound)
            error = torch.maximum(error, self.loss(bounded - label))
        return error

    def loss(self, error: Tensor) -> Tensor:
        """Return the loss of a difference, as documented in `losses`."""
        error = error / torch.tensor(STD) if self.chosen.loss == "inverse_variance" else error
        error = error / self.label_std if self.label_std is not None else error
        if self.chosen.loss == "huber":
            return 2.0 * torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
        return error**2

    def look(self, lesson: Lesson) -> None:
        """Normalise from now on by all rows seen so far."""
        self.seen.append(lesson.x.flatten(0, 1))
        rows = torch.cat(self.seen)
        self.student.mean.copy_(rows.mean(dim=0))
        self.student.var.copy_(rows.var(dim=0, correction=0))


def gate_noise(student: int, step: int) -> Tensor:
    """Return the noise of a student's four gates in a gradient step."""
    return torch.randn(4, generator=torch.Generator().manual_seed(1000 * student + step))


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the task's document and a teacher."""
    folder = tmp_path_factory.mktemp("task")
    task = felt_task(folder)
    return task, teacher(folder / "teacher.pt", load_task(task), ["priv_proprio"], std=list(STD))


@pytest.fixture
def make(files, monkeypatch):
    """Return a function that makes a float64 distiller of three students in two stacks."""
    envs, (task, file) = [], files

    def distiller(kind: str, chosen: Chosen) -> Distiller:
        decoders = [f"{{scale: {scale}, weight: {weight}, hidden: [4]}}" for scale, weight in zip(SCALES, WEIGHTS, strict=True)]
        named = [
            f"{name}: {student_teacher}"
            for name, student_teacher in zip(("object_size", "goal_distance"), decoders, strict=True)
        ]
        spec = {"steps": STEPS, "gradient_length": LENGTH, "epochs": EPOCHS, "learning_rate": RATE}
        spec |= {"loss": chosen.loss, "aggregate": chosen.aggregate, "normalise": chosen.normalise}
        spec |= {name: getattr(chosen, name) or "null" for name in ("clip", "max_grad_norm", "final_learning_rate")}
        spec["decoders"] = "{" + ", ".join(named[: chosen.num_decoders]) + "}"
        spec["gates"] = "null" if chosen.gates is None else f"{{taxels: {chosen.gates}, weight: 0.5}}"
        widths = {"encoder.hidden": "[5]", "encoder.size": 4, "hidden": "[8]", "touch_encoder.hidden": "[6]"}
        widths |= {"touch_encoder.size": 6, "convolution.channels": "[2]"} | KINDS[kind]
        spec |= {f"networks.{name}": value for name, value in widths.items()}
        loaded = load_task(task, {f"distill.{name}": value for name, value in spec.items()})
        keys = student_keys(["depth", "bool", "none"], ["ends"], ["clean"], 1)
        student_teacher = Teacher(file, loaded)
        envs.append(TouchEnv(loaded, ROWS * len(keys), seed=1, threads=1, touches=touches(keys, student_teacher.touch)))
        bound = student_teacher.bound(envs[-1])
        steps = itertools.count()  # only the stack of both types of touch has gates

        def noise_like(log_alpha: Tensor) -> Tensor:
            step = next(steps)
            return torch.stack([gate_noise(student, step) for student in range(len(log_alpha))])

        monkeypatch.setattr(learner, "noise_like", noise_like)
        monkeypatch.setattr(learner, "Stack", partial(Stack, dtype=torch.float64))
        torch.set_default_dtype(torch.float64)
        return Distiller(envs[-1], loaded, bound, keys, 0)

    yield distiller
    torch.set_default_dtype(torch.float32)
    for env in envs:
        env.close()


def fill_rollouts(distiller: Distiller, generator: torch.Generator) -> list[Lesson]:
    """Fill rollouts with made-up data; return each student's. Episodes end at random, features have offsets."""
    lessons = []
    for rollout in distiller.rollouts:
        for i in range(len(rollout.keys)):
            block = slice(rollout.first + i * rollout.rows, rollout.first + (i + 1) * rollout.rows)
            x, old_action, label, target = (
                torch.randn((STEPS, ROWS, size), generator=generator)
                for size in (rollout.x.shape[-1], 2, 2, distiller._privileged.shape[-1])
            )
            ended = torch.rand((STEPS, ROWS), generator=generator) < 0.3
            begun = torch.randn((ROWS, rollout.stack.memory), generator=generator)
            lesson = Lesson(1.0 + 3.0 * x, 0.5 * old_action, label, 0.1 * target, ended, begun)
            lessons.append(lesson)
            for buffer, values in (
                (rollout.x[:, i], lesson.x),
                (rollout.before[:, i], lesson.before),
                (rollout.begun[i], lesson.begun),
                (distiller._labels[:, block], lesson.label),
                (distiller._privileged[:, block], lesson.target),
                (distiller._ended[:, block], lesson.ended),
            ):
                buffer.copy_(values)
    return lessons


@pytest.mark.parametrize(("kind", "chosen"), [("mlp", "plain"), ("mlp", "huber"), ("lstm", "all"), ("convrnn", "all")])
def test_an_update_equals_that_of_separate_students(make, kind, chosen):
    """Weights, normalisation and losses after several updates."""
    options = CHOSEN[chosen]
    distiller, generator, chance = make(kind, options), torch.Generator().manual_seed(0), random.Random(5)
    distiller._chance.seed(5)
    alone = [Alone(distiller.student(i), i, options) for i in range(len(distiller.keys))]
    recent: list[list[Lesson]] = []
    labels: list[Tensor] = []
    for number in range(NUM_UPDATES):
        distiller.set_rate(number / NUM_UPDATES)
        for each in alone:
            each.fall(number / NUM_UPDATES)
        recent = [*recent, fill_rollouts(distiller, generator)][-options.aggregate :]
        latest = len(recent) - 1
        if options.normalise:
            labels += [lesson.label.flatten(0, 1) for lesson in recent[-1]]
            for each in alone:
                each.label_std = torch.cat(labels).std(dim=0, correction=0)
        passes = [latest] + [chance.randrange(len(recent)) if options.aggregate > 1 else latest for _ in range(EPOCHS - 1)]
        errors = [[each.passed(recent[i][n], i == latest) for i in passes] for n, each in enumerate(alone)]
        for each, lesson in zip(alone, recent[-1], strict=True):
            each.look(lesson)
        distiller.learn()
        losses = distiller._losses * LENGTH / (EPOCHS * STEPS)
        expected = torch.tensor(errors).mean(dim=1)
        torch.testing.assert_close(losses, expected, rtol=UPDATES, atol=UPDATES)
    for i, each in enumerate(alone):
        state = distiller.student(i).state_dict()
        for name, value in each.student.state_dict().items():
            torch.testing.assert_close(state[name], value, rtol=UPDATES, atol=UPDATES)
    norms = [norm for each in alone for norm in each.norms]
    assert options.max_grad_norm is None or min(norms) < options.max_grad_norm < max(norms)
