"""A record of what a policy did, as one `.npz` file.

Shapes: `step` control steps, `env` environments, `joint` joints that the policy moves, `feature` numbers of a group, `episode`
episodes that have ended, `nq` as in MuJoCo's model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

from tgdsl.console.tables import text_table
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.rl.env import StepInfo, TouchEnv
from tgdsl.rl.playing.rollout import Moment
from tgdsl.runtime.simulators.machine import refuse_beyond_memory

Column = Shaped[np.ndarray, "row ..."]


class Record:
    """Columns that grow by rows, written with the names of the joints that the policy moves."""

    def __init__(self, joints: Sequence[str]):
        self.joints = tuple(joints)
        self._columns: dict[str, list[Column]] = {}

    def __getitem__(self, name: str) -> Column:
        return np.concatenate(self._columns[name])

    def __len__(self) -> int:
        return len(next(iter(self._columns.values()), ()))

    def add_rows(self, columns: Mapping[str, Column]) -> None:
        """Append rows to columns, by name."""
        for name, rows in columns.items():
            self._columns.setdefault(name, []).append(rows)

    def write(self, path: Path, **words: str) -> None:
        """Write the file atomically."""
        columns = {name: self[name] for name in self._columns} | {"joints": np.array(self.joints)}
        with atomic_open(with_folder(path)) as file:
            np.savez_compressed(file, **columns, **{name: np.array(word) for name, word in words.items()})  # type: ignore[arg-type]


class PlayRecord(Record):
    """A record of environments.

    The file holds, of each control step, its start's `time` (step,) [s], the observations `obs:<group>` (step, env, feature)
    that the action was chosen from, `qpos` (step, env, nq) at the start of the step, where there are mocap bodies `mocap_pos`
    (step, env, body, 3) and `mocap_quat` (step, env, body, 4), the `action` (step, env, joint); and its results: `reward`,
    `term:<name>` (weight and Δt included), `score`, `terminated`, `truncated`, `fault`, (step, env) each. Observations are of
    one physics step before the start, except the first of an episode. Of each ended episode it holds `ended:step`, `ended:env`,
    `ended:return`, `ended:steps`, `ended:score` (episode,) and its last observations `ended:obs:<group>` (episode, feature).
    `joints` has the names of the joints, `score_unit` the unit of scores.
    """

    def __init__(self, env: TouchEnv, num_steps: int):
        """Begin with environments that have just been reset."""
        super().__init__(env.joint_names)
        self._env = env
        names = ("qpos", "mocap_pos", "mocap_quat") if env.sim.model.nmocap else ("qpos",)
        self._live = {name: env.sim.arrays[name] for name in names}
        poses = sum(value.element_size() * value[0].numel() for value in self._live.values())
        numbers = 4 * (sum(env.groups.values()) + env.num_actions) + poses
        refuse_beyond_memory(f"records of {env.num_envs} environments at {num_steps} steps", numbers * env.num_envs * num_steps)
        self._poses = self._copied_poses()

    def poses(self, env: int) -> dict[str, Float[np.ndarray, "step ..."]]:
        """Return the poses before each step in one environment, by MuJoCo's names."""
        return {name: self[name][:, env] for name in self._live}

    def add(self, moment: Moment) -> None:
        """Add a control step, before the next one."""
        step, info = moment.step, moment.step.info
        values = {f"obs:{group}": value for group, value in moment.obs.items()} | {"action": moment.action}
        values |= {"reward": step.reward, **{f"term:{name}": value for name, value in info.terms.items()}}
        values |= {"score": info.score, "terminated": step.terminated, "truncated": step.truncated, "fault": info.faults}
        rows = {name: _numpy(value) for name, value in values.items()} | self._poses
        self.add_rows({"time": np.array([moment.index * self._env.control_step])})
        self.add_rows({name: value[None] for name, value in rows.items()})
        self._poses = self._copied_poses()
        ended = np.flatnonzero(_numpy(info.ended))
        of_episode = {"return": info.episode_return, "steps": info.episode_steps, "score": info.score}
        of_episode |= {f"obs:{group}": value for group, value in info.final_obs.items()}
        self.add_rows({"ended:step": np.full(len(ended), moment.index), "ended:env": ended})
        self.add_rows({f"ended:{name}": _numpy(value)[ended] for name, value in of_episode.items()})

    def write(self, path: Path, **words: str) -> None:
        """Write the file: see `Record.write`."""
        super().write(path, score_unit=self._env.task.score_unit, **words)

    def _copied_poses(self) -> dict[str, np.ndarray]:
        return {name: _numpy(value) for name, value in self._live.items()}


def _numpy(tensor: Tensor) -> np.ndarray:
    return np.array(tensor.detach().cpu().numpy())  # a copy: an environment's own tensors change


class Tally:
    """A table of means over environments: of the present episodes so far, and of ended episodes."""

    def __init__(self, env: TouchEnv):
        self._env = env
        self.num_ended = self.num_faults = 0
        self._now: dict[str, float] = {}
        self._sums: dict[str, float] = {}

    def add(self, info: StepInfo) -> None:
        """Add one step."""
        values = {f"score [{self._env.task.score_unit}]": info.score, "return": info.episode_return}
        values |= {f"  {name}": total for name, total in info.episode_terms.items()}
        self.num_ended += int(info.ended.sum())
        self.num_faults += int(info.faults.sum())
        self._now = {name: float(value.double().mean()) for name, value in values.items()}
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value[info.ended].double().sum())

    def lines(self, time: float) -> list[str]:
        """Return the table at a time of the simulation [s]."""
        faults = f", {self.num_faults} by a fault" if self.num_faults else ""
        first = f"t = {time:.2f} s, {self._env.num_envs} environments, {self.num_ended} episodes ended{faults}"
        count = self.num_ended
        rows = [(name, f"{now:.3g}", f"{self._sums[name] / count:.3g}" if count else "–") for name, now in self._now.items()]
        return [first, *text_table(("mean over environments", "so far", "ended"), rows).splitlines()]
