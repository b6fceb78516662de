"""A record of what happened in environments, as one `.npz` file.

Shapes: `step` control steps, `env` environments, `joint` joints that the policy moves, `feature` numbers of a group, `episode`
episodes that have ended, `nq` as in MuJoCo's model.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.files.write import atomic_open
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.play import Played, poses_of
from tgdsl.runtime.simulators.machine import refuse_beyond_memory


class Record:
    """Keeps steps and writes them.

    The file holds, of each control step, its start's `time` (step,) [s], the observations `obs:<group>` (step, env, feature)
    that the action was chosen from, `qpos` (step, env, nq), where there are mocap bodies `mocap_pos` (step, env, body, 3) and
    `mocap_quat` (step, env, body, 4), the `action` (step, env, joint); and what came of it: `reward`, `term:<name>` (weight and
    Δt included), `score`, `terminated`, `truncated`, `fault`, (step, env) each. See `Played`. Of each episode that has ended it
    holds `ended:step`, `ended:env`, `ended:return`, `ended:steps`, `ended:score` (episode,) and its last observations
    `ended:obs:<group>` (episode, feature). `joints` and `score_unit` say what joints and scores are.
    """

    def __init__(self, env: TouchEnv, num_steps: int):
        """Begin.

        Raises:
            SimulationError: If this computer has too little memory for so many steps.
        """
        self._env, self._num_steps = env, num_steps
        self._poses = tuple(poses_of(env))
        poses = sum(value.element_size() * value[0].numel() for value in poses_of(env).values())
        numbers = 4 * (sum(env.groups.values()) + env.num_actions) + poses
        refuse_beyond_memory(f"records of {env.num_envs} environments at {num_steps} steps", numbers * env.num_envs * num_steps)
        self._steps: dict[str, np.ndarray] = {}
        self._ended: dict[str, list[np.ndarray]] = {}

    def poses(self, env: int) -> dict[str, Float[np.ndarray, "step ..."]]:
        """Return where everything was before each step in one environment, by MuJoCo's names, as `Played.poses`."""
        return {name: self._steps[name][:, env] for name in self._poses}

    def add(self, played: Played) -> None:
        """Keep one step."""
        for name, value in self._row(played).items():
            column = self._steps.setdefault(name, np.empty((self._num_steps, *value.shape), value.dtype))
            column[played.index] = value
        info = played.step.info
        rows = np.flatnonzero(info.ended.cpu().numpy())
        own = {"return": info.episode_return, "steps": info.episode_steps, "score": info.score}
        own |= {f"obs:{group}": value for group, value in info.final_obs.items()}
        ended = {name: _numpy(value)[rows] for name, value in own.items()}
        for name, values in {"step": np.full(len(rows), played.index), "env": rows, **ended}.items():
            self._ended.setdefault(f"ended:{name}", []).append(values)

    def write(self, path: Path) -> None:
        """Write the file; it appears whole or not at all."""
        named = {"joints": np.array(self._env.joint_names), "score_unit": np.array(self._env.task.score_unit)}
        ended = {name: np.concatenate(values) for name, values in self._ended.items()}
        with atomic_open(path) as file:
            np.savez_compressed(file, **self._steps, **ended, **named)  # type: ignore[arg-type]

    def _row(self, played: Played) -> dict[str, np.ndarray]:
        step, info = played.step, played.step.info
        return {
            "time": np.array(played.index * self._env.control_step),
            **{f"obs:{group}": _numpy(value) for group, value in played.obs.items()},
            **{name: _numpy(value) for name, value in played.poses.items()},
            "action": _numpy(played.action),
            "reward": _numpy(step.reward),
            **{f"term:{name}": _numpy(value) for name, value in info.terms.items()},
            "score": _numpy(info.score),
            "terminated": _numpy(step.terminated),
            "truncated": _numpy(step.truncated),
            "fault": _numpy(info.faults),
        }


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().numpy()
