"""DAgger: students act, each in its block of environments, and learn the teacher's actions there.

An iteration is a rollout of `steps` control steps and `epochs` passes through it, a gradient step per `gradient_length` control
steps. On a GPU, acting and each pass are CUDA graphs.

With a_s a student's action, a_t the teacher's, σ_t the standard deviation of the teacher's exploration (`inverse_variance`) or
actions (`normalise`), else 1, a_0 the student's action in the rollout (in a stored earlier one: with the weights at the start
of the pass), a_c = a_0 + clamp(a_s − a_0, ±clip), and h(e) = e², or for `huber` e² up to |e| = 1 and 2|e| − 1 beyond:

    action error     mean of h((a_s − a_t)/σ_t);  with a clip, of max(h((a_s − a_t)/σ_t), h((a_c − a_t)/σ_t))
    decoder k        w_k · mean of (d_k − s_k y_k)²,  y_k being the privileged number
    gates            the penalty of `gates.py`

Source: Chung et al., *Tactile Genesis*, appendix. It names the loss, "inv-var MSE", and a clip parameter of 0.1; the formulas
are ours: σ_t² as the variance, and the clip as PPO bounds values. Normalised actions and Huber's loss follow the authors'
public code: see docs/records/paper.md; its bound of 1 is ours.

Shapes: `env` environments, `student` students of a stack, `row` environments of a block, `joint`, `target` as in `student.py`.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from tgdsl.errors import did_you_mean
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.policy import Policy
from tgdsl.rl.playing.rollout import Actor, Moment
from tgdsl.rl.students.gates import noise_like, openings, penalty
from tgdsl.rl.students.keys import StudentKey, architecture, groups_of, seen_by
from tgdsl.rl.students.spec import DistillSpec
from tgdsl.rl.students.student import Architecture, Stack, Student, forgotten
from tgdsl.rl.train.graphs import Captured, SideBySide
from tgdsl.rl.train.learner import Learning
from tgdsl.rl.train.model import Normalisation
from tgdsl.rl.train.ranks import Ranks
from tgdsl.tensors.torch_internals import copy_each

Actions = Float[Tensor, "student row joint"]
Targets = Float[Tensor, "student row target"]


def action_error(
    action: Actions,
    label: Actions,
    before: Actions,
    std: Float[Tensor, " joint"] | None,
    clip: float | None,
    *,
    is_huber: bool = False,
) -> Float[Tensor, " student"]:
    """Return the error of actions."""
    error = (action - label).abs()
    if clip is not None:
        bounded = before + (action - before).clamp(-clip, clip)
        error = torch.maximum(error, (bounded - label).abs())
    if std is not None:
        error = error / std
    loss = torch.where(error <= 1.0, error.square(), 2.0 * error - 1.0) if is_huber else error.square()
    return loss.mean(dim=(1, 2))


def decoder_error(
    output: Targets, targets: Targets, scales: Float[Tensor, " target"], weights: Float[Tensor, " target"]
) -> Float[Tensor, " student"]:
    """Return the weighted error of the decoders; zeros if there are none."""
    return ((output - scales * targets).square().mean(dim=1) * weights).sum(dim=1)


RISE, START, END = 0.3, 1 / 25, 1 / 25e4  # one cycle: the share of its rise; its first and last rate, relative to the largest


def one_cycle(highest: float, last: float | None, share: float) -> float:
    """Return the learning rate at a finished share of the run, with torch's defaults of `OneCycleLR`."""
    start, end, part = highest * START, highest, share / RISE
    if share > RISE:
        start, end, part = highest, highest * END if last is None else last, (share - RISE) / (1.0 - RISE)
    return end + (start - end) * 0.5 * (1.0 + math.cos(math.pi * part))


LEAST_STD = 1e-3  # least deviation of the teacher's actions that divides an error


class Rollout:
    """Students of one stack in blocks of `rows` environments from `first` on; `seen`: each one's groups."""

    def __init__(
        self,
        networks: Architecture,
        keys: Sequence[StudentKey],
        seen: Sequence[Sequence[str]],
        first: int,
        rows: int,
        spec: DistillSpec,
        device: torch.device,
    ):
        self.keys, self.seen, self.first, self.rows = keys, seen, first, rows
        self.stack = Stack(networks, [key.seed for key in keys], spec.learning_rate, spec.max_grad_norm, device)
        shape = (len(keys), rows)
        # their memory now, and at the start of the rollout: (student, row, memory)
        self.memory, self.begun = (torch.zeros((*shape, self.stack.memory), device=device) for _ in range(2))
        # their observations and actions in the rollout: (step, student, row, …)
        self.x = torch.zeros((spec.steps, *shape, networks.num_features), device=device)
        self.before = torch.zeros((spec.steps, *shape, networks.actions), device=device)

    @property
    def envs(self) -> slice:
        """Its environments."""
        return slice(self.first, self.first + self.rows * len(self.keys))

    def split(self, values: Tensor, dim: int = 0) -> Tensor:
        """Return values per environment, (…, env, …), as (…, student, row, …)."""
        selected = values.narrow(dim, self.first, self.rows * len(self.keys))
        return selected.unflatten(dim, (len(self.keys), self.rows))

    def inputs(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return each student's observations: its groups in its environments, (student, row, feature)."""
        blocks = [slice(self.first + i * self.rows, self.first + (i + 1) * self.rows) for i in range(len(self.keys))]
        each = zip(blocks, self.seen, strict=True)
        return torch.stack([torch.cat([obs[name][block] for name in names], dim=1) for block, names in each])


def joined(values: Shaped[Tensor, "step student row feature"]) -> Shaped[Tensor, "student rows feature"]:
    """Return the rows of all steps, concatenated."""
    return values.transpose(0, 1).flatten(1, 2)


class Distiller(Learning):
    """Teaches students: `keys`, by stack `rollouts`, in the order of their blocks."""

    rates = "distill.learning_rate"

    def __init__(self, env: TouchEnv, loaded: LoadedTask, teacher: Policy, keys: Sequence[StudentKey], seed: int):
        """Make the students; torch's own random generators are seeded."""
        self._teacher, self._spec = teacher, loaded.spec.distill
        super().__init__(env, Ranks(), self._spec.steps)
        self._targets = list(self._spec.decoders)
        numbers = list(env.task.decoded(env.now)) if self._targets else []
        for name in self._targets:
            if name not in numbers:
                problem = f'the task has no privileged number "{name}"'
                raise loaded.error(("distill", "decoders", name), problem, did_you_mean(name, numbers, "numbers"))
        names = groups_of(loaded, env.groups)
        stacked: dict[Architecture, list[StudentKey]] = {}
        for key in keys:
            stacked.setdefault(architecture(loaded, env, key, names), []).append(key)
        self.rollouts: list[Rollout] = []
        for networks, members in stacked.items():
            first, rows = self.rollouts[-1].envs.stop if self.rollouts else 0, env.num_envs // len(keys)
            seen = [seen_by(key, names) for key in members]
            self.rollouts.append(Rollout(networks, members, seen, first, rows, self._spec, env.device))
        if self._spec.gates is not None and all(networks.gates is None for networks in stacked):
            raise loaded.error(("distill", "gates"), "no student has touch, so there are no taxels to choose")
        self.keys = [key for each in self.rollouts for key in each.keys]
        seen_groups = [groups for each in self.rollouts for groups in each.seen]
        self.groups = {key.name: list(groups) for key, groups in zip(self.keys, seen_groups, strict=True)}
        self._allocate()
        torch.manual_seed(seed)

    @property
    def episode_names(self) -> list[str]:
        """Numbers of the episodes that ended, from iterations in which any did."""
        return [*super().episode_names, *(f"Score/{key.name}" for key in self.keys)]

    @property
    def is_warming_up(self) -> bool:
        """Whether the teacher acts in this iteration."""
        return self.iteration < self._spec.warm_start

    def set_rate(self, share: float) -> None:
        """Set the learning rate for the finished share of the run."""
        first, last = self._spec.learning_rate, self._spec.final_learning_rate
        if self._spec.schedule == "one_cycle":
            self._rate = one_cycle(first, last, share)
        else:
            self._rate = first if last is None else first * (last / first) ** share
        for each in self.rollouts:
            each.stack.set_rate(self._rate)

    def __call__(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the students' actions, or the teacher's in a warm start; store both, and the observations."""
        copy_each(list(self._seen.values()), [obs[name] for name in self._seen])
        self._chosen()
        t = self._step
        self._labels[t].copy_(self._label)
        for each, x in zip(self.rollouts, self._inputs, strict=True):
            each.x[t].copy_(x)
            each.before[t].copy_(each.split(self._asked))
        if self._targets:
            privileged = self.env.task.decoded(self.env.now)
            self._privileged[t].copy_(torch.stack([privileged[name] for name in self._targets], dim=1))
        return self._label if self.is_warming_up else self._action

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        for each in self.rollouts:
            each.memory.copy_(forgotten(each.memory, each.split(ended)))
        self._teacher.begin(ended)

    def state_dict(self) -> dict[str, Any]:
        actions = {} if self._teacher_actions is None else {"actions": self._teacher_actions.state_dict()}
        return {"stacks": [rollout.stack.state_dict() for rollout in self.rollouts]} | actions

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for rollout, saved in zip(self.rollouts, state["stacks"], strict=True):
            rollout.stack.load_state_dict(saved)
        if self._teacher_actions is not None and "actions" in state:
            self._teacher_actions.load_state_dict(state["actions"])
        for captured in (self._chosen, self._answered, self._learned, self._looked):
            captured.forget()

    def student(self, index: int) -> Student:
        """Return a copy of a student, on the CPU, by its number among `keys`."""
        stacked = [(rollout.stack, i) for rollout in self.rollouts for i in range(len(rollout.keys))]
        stack, place = stacked[index]
        return stack.student(place)

    def acting(self) -> Actor:
        """Return an actor for all environments: each student in its block."""
        return ActingStudents(self)

    # Captured functions

    def _choose(self) -> None:
        with torch.no_grad():
            acting = [partial(self._act, rollout, x) for rollout, x in zip(self.rollouts, self._inputs, strict=True)]
            self._beside([lambda: self._label.copy_(self._teacher(self._seen)), *acting])
            self._action.copy_(self._asked)
            if self._spec.std:
                self._action.add_(torch.randn_like(self._action), alpha=self._spec.std)

    def _act(self, rollout: Rollout, x: Tensor) -> None:
        x.copy_(rollout.inputs(self._seen))
        action = rollout.stack(x, rollout.memory)
        rollout.memory.copy_(action.memory)
        self._asked[rollout.envs].copy_(action.action.flatten(0, 1))

    def _answer(self) -> None:
        """Compute a_0 of an earlier rollout again, by the present weights."""

        def answer(rollout: Rollout) -> None:
            memory = rollout.begun
            for x, previous, ended in zip(rollout.x, rollout.before, self._ended, strict=True):
                output = rollout.stack(x, memory)
                previous.copy_(output.action)
                memory = forgotten(output.memory, rollout.split(ended))

        with torch.no_grad():
            self._beside([partial(answer, rollout) for rollout in self.rollouts])

    def _epoch(self) -> None:
        each = self._losses.split([len(rollout.keys) for rollout in self.rollouts])
        self._beside([partial(self._pass, rollout, errors) for rollout, errors in zip(self.rollouts, each, strict=True)])

    def _pass(self, rollout: Rollout, errors: Float[Tensor, " student"]) -> None:
        """Make one pass of a stack through the rollout; add the errors of its actions."""
        memory = rollout.begun
        for first in range(0, self._spec.steps, self._spec.gradient_length):
            step_error, memory = self._descend(rollout, slice(first, first + self._spec.gradient_length), memory)
            errors += step_error

    def _descend(self, rollout: Rollout, steps: slice, memory: Tensor) -> tuple[Float[Tensor, " student"], Tensor]:
        """Take one gradient step of a stack; return the errors of its actions, and its next memory."""
        spec = self._spec
        detached = total = torch.zeros(len(rollout.keys), device=memory.device)
        parts = [steps] if rollout.stack.memory == 0 else [slice(t, t + 1) for t in range(steps.start, steps.stop)]
        with torch.enable_grad():
            log_alpha = rollout.stack.log_alpha
            noise = None if log_alpha is None else noise_like(log_alpha)
            for part in parts:  # without memory all steps are rows
                x, target = (joined(values[part]) for values in (rollout.x, rollout.before))
                label, targets, ended = (
                    joined(rollout.split(values[part], 1))
                    for values in (self._labels, self._privileged, self._ended[..., None])
                )
                outputs = rollout.stack(x, memory if rollout.stack.memory else x[..., :0], noise)
                error = action_error(outputs.action, label, target, self._std, spec.clip, is_huber=spec.loss == "huber") / len(
                    parts
                )
                detached = detached + error.detach()
                total = total + error
                if self._targets:
                    total = total + decoder_error(outputs.decoded, targets, self._scales, self._weights) / len(parts)
                memory = forgotten(outputs.memory, ended[..., 0]) if rollout.stack.memory else memory
            if spec.gates is not None and log_alpha is not None:
                total = total + spec.gates.weight * penalty(log_alpha, spec.gates.taxels)
            rollout.stack.descend(total)
        return detached, memory.detach()

    def _look(self) -> None:
        def look(rollout: Rollout) -> None:
            for x in rollout.x:
                rollout.stack.observe(x)

        self._beside([partial(look, rollout) for rollout in self.rollouts])

    # The rest

    def _start_rollout(self) -> None:
        self._step = 0
        for each in self.rollouts:
            each.begun.copy_(each.memory)

    def _keep(self, moment: Moment) -> None:
        info = moment.step.info
        self._ended[self._step].copy_(info.ended)
        if not self.is_warming_up:
            self._scores += torch.where(info.ended, torch.stack([torch.ones_like(info.score), info.score]).double(), 0.0)
        self._step += 1

    def _update(self) -> None:
        self._losses.zero_()
        if self._teacher_actions is not None and self._std is not None:
            self._teacher_actions.update(self._labels.flatten(0, 1))
            self._std.copy_(self._teacher_actions.std).clamp_(min=LEAST_STD)
        if self._spec.aggregate > 1:
            self._gathered.append([value.clone() for value in self._of_rollout()])
        for i in range(self._spec.epochs):
            if i and self._gathered:
                index = self._chance.randrange(len(self._gathered))
                copy_each(self._of_rollout(), self._gathered[index])
                if self._spec.clip is not None and index < len(self._gathered) - 1:
                    self._answered()
            self._learned()
        if self._gathered:
            copy_each(self._of_rollout(), self._gathered[-1])
        self._looked()

    def _numbers(self) -> dict[str, Tensor]:
        ended, score = self._scores.view(2, len(self.keys), -1).sum(dim=2)
        self._scores.zero_()
        updates = self._spec.epochs * self._spec.steps // self._spec.gradient_length
        numbers = {"Loss/learning_rate": torch.tensor(self._rate, dtype=torch.float64, device=score.device)}
        for key, mean, loss in zip(self.keys, score / ended, (self._losses / updates).double(), strict=True):
            numbers |= {f"Score/{key.name}": mean, f"Loss/{key.name}": loss}
        for rollout in self.rollouts:
            if (log_alpha := rollout.stack.log_alpha) is not None:
                num_open = (openings(log_alpha) > 0.0).sum(dim=1).double()
                numbers |= {f"Gates/{key.name}": num for key, num in zip(rollout.keys, num_open, strict=True)}
        return numbers

    def _allocate(self) -> None:
        env, spec, device = self.env, self._spec, self.env.device
        num, actions, steps = env.num_envs, env.num_actions, spec.steps
        seen = dict.fromkeys((*self._teacher.groups, *(name for names in self.groups.values() for name in names)))
        self._seen = {name: torch.zeros((num, env.groups[name]), device=device) for name in seen}
        self._inputs = [torch.zeros_like(rollout.x[0]) for rollout in self.rollouts]
        self._action, self._asked, self._label = (torch.zeros((num, actions), device=device) for _ in range(3))
        self._labels = torch.zeros((steps, num, actions), device=device)
        self._ended = torch.zeros((steps, num), dtype=torch.bool, device=device)
        self._privileged = torch.zeros((steps, num, len(self._targets)), device=device)
        heads = spec.decoders.values()
        self._scales, self._weights = (
            torch.tensor([getattr(head, name) for head in heads], device=device) for name in ("scale", "weight")
        )
        self._teacher_actions = Normalisation(actions).to(device) if spec.normalise else None
        self._std = self._teacher.std if spec.loss == "inverse_variance" else None
        if spec.normalise:
            self._std = torch.ones(actions, device=device)
        self._losses = torch.zeros(len(self.keys), device=device)
        self._scores = torch.zeros((2, num), dtype=torch.float64, device=device)
        has_tf32 = spec.precision == "tf32"
        self._beside = SideBySide(1 + len(self.rollouts), device)
        self._chosen = Captured(self._choose, device, has_tf32)
        self._answered = Captured(self._answer, device, has_tf32)
        self._learned = Captured(self._epoch, device, has_tf32)
        self._looked = Captured(self._look, device)
        self._gathered: deque[list[Tensor]] = deque(maxlen=spec.aggregate)
        self._chance = random.Random(0)
        self._rate = spec.learning_rate

    def _of_rollout(self) -> list[Tensor]:
        buffers = [value for each in self.rollouts for value in (each.x, each.before, each.begun)]
        return [*buffers, self._labels, self._privileged, self._ended]


class ActingStudents(Actor):
    """All students, each in its block."""

    def __init__(self, distiller: Distiller):
        self._rollouts = distiller.rollouts
        self._memory = [torch.zeros_like(rollout.memory) for rollout in self._rollouts]

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actions of each student for its environments' observations."""
        actions = []
        with torch.no_grad():
            for i, rollout in enumerate(self._rollouts):
                outputs = rollout.stack(rollout.inputs(obs), self._memory[i])
                self._memory[i] = outputs.memory
                actions.append(outputs.action.flatten(0, 1))
        return torch.cat(actions)

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        self._memory = [
            forgotten(memory, stack.split(ended)) for memory, stack in zip(self._memory, self._rollouts, strict=True)
        ]
