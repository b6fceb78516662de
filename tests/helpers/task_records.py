"""What happened in environments, step by step, as the `reference` of a task takes it."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from task_references import TERMS
from torch import Tensor

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.task import Now

Record = dict[str, np.ndarray]
NAMES = ("joint_pos", "joint_vel", "torque", "action", "link_force", "distance", "linvel", "angvel")
"""What references of shared terms read."""


class Recorder:
    """Notes each instant that a task is told of, one record per environment and episode.

    Attributes:
        episodes: Of each environment, its episodes so far: records of instants, of terms, and of what ended.
    """

    def __init__(self, env: TouchEnv, more: Callable[[Now], Record] = lambda now: {}):
        """Begin with a new episode in every environment.

        Args:
            env: The environments.
            more: Returns copies of what else is noted of each instant, (env, …) by name.
        """
        self.env, self._more = env, more
        self._instants: list[list[Record]] = []
        env.reset()
        self.episodes: list[list[tuple[list[Record], list[Record]]]] = [[] for _ in range(env.num_envs)]
        self._begin(range(env.num_envs))

    def step(self, action: Tensor) -> None:
        """Make a step and note it."""
        task, seen = self.env.task, []
        whole = task.advance
        task.advance = lambda now: (whole(now), seen.append(instant(now) | self._more(now)))[0]  # type: ignore[method-assign]
        try:
            made = self.env.step(action)
        finally:
            task.advance = whole  # type: ignore[method-assign]
        rates = {name: term.double().numpy() / self.env.control_step for name, term in made.info.terms.items()}
        for env in range(self.env.num_envs):
            instants, rows = self.episodes[env][-1]
            instants.append({name: value[env] for name, value in seen[0].items()})
            own = {"is_over": made.terminated[env].numpy(), "score": made.info.score[env].numpy()}
            rows.append({name: rate[env] for name, rate in rates.items()} | own)
        self._begin(torch.nonzero(made.info.ended).flatten().tolist())

    def _begin(self, envs: Sequence[int]) -> None:
        now = instant(self.env.now) | self._more(self.env.now)
        for env in envs:
            self.episodes[env].append(([{name: value[env] for name, value in now.items()}], []))

    def records(self):
        """Yield of each episode its instants and its terms, scores and ends: arrays (step, …)."""
        actuators = self.env.task.setup.actuators
        for episodes in self.episodes:
            for instants, rows in episodes:
                if rows:
                    limits = {"low": actuators.low, "high": actuators.high, "max_torque": actuators.limit}
                    yield _stacked(instants) | limits, _stacked(rows)


def instant(now: Now) -> Record:
    """Return an instant of all environments in float64."""
    own = now.object
    found = {
        "pos": own.pos,
        "quat": own.quat,
        "linvel": own.linvel,
        "angvel": own.angvel,
        "friction": now.friction,
        "mass": now.mass,
        "last_action": now.past_actions[:, 0],
    }
    names = ("joint_pos", "joint_vel", "target", "torque", "action", "link_force", "normal_force", "distance")
    found |= {name: getattr(now, name) for name in names}
    return {name: value.detach().double().cpu().numpy().copy() for name, value in found.items()}


def _stacked(rows: Sequence[Record]) -> Record:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def reference_rates(task, reference, spec, record: Record, dt: float) -> Record:
    """Return all terms of a task's reward [1/s], `is_over` and `score` at each step of one environment, in float64."""
    weights, limits = spec.rewards, {name: record[name] for name in ("low", "high", "max_torque") if name in record}
    instants = {name: record[name] for name in NAMES if name in record}
    shared = {name: term.term.for_spec(spec, term.parameters) for name, term in task.terms.items() if term.term is not None}
    rows = []
    for t, own in enumerate(reference(spec, record, dt), start=1):
        row = {name: value[t] for name, value in instants.items()} | {"last_action": record["action"][t - 1]} | limits
        rates = own | {name: TERMS[type(term)](term, row) for name, term in shared.items()}
        rows.append(own | {name: getattr(weights, name) * rates[name] for name in task.terms})
    return _stacked(rows)


def assert_reference(recorder: Recorder, reference, tolerance: float = 1e-6) -> set[str]:
    """Compare rewards, ends and scores of all episodes with a task's reference; return the terms that ever differed from 0."""
    seen: set[str] = set()
    for record, rows in recorder.records():
        env = recorder.env
        expected = reference_rates(env.task, reference, env.spec, record, env.control_step)
        assert expected.keys() == rows.keys()
        for name, value in expected.items():
            scale = max(1.0, float(np.abs(value).max()))
            np.testing.assert_allclose(rows[name], value, rtol=0, atol=tolerance * scale, err_msg=name)
            seen |= {name} if np.abs(value).max() > 1e-6 else set()
    return seen
