"""Episodes with touch from environments, from emulated and real hands, from recordings of `tgdsl run` and from logs of hands.

Shapes: as in `episode`, `env` environments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean, listed
from tgdsl.files.arrays import read_arrays
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.module.taxels import Columns
from tgdsl.rl.datasets.dataset import EPS, FORCE, Episode, Header, LinkTaxels
from tgdsl.rl.deploying.deploy import Deployment
from tgdsl.rl.deploying.hand import EMULATED
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.rollout import Actor, rollout
from tgdsl.rl.sensors import GROUP
from tgdsl.rl.task import Task
from tgdsl.runtime.connect import kind_of
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import MAX_AGE_S
from tgdsl.runtime.xhand1.log.log import open_log
from tgdsl.runtime.xhand1.observe import TIP_BODIES
from tgdsl.runtime.xhand1.wire.protocol import JOINTS
from tgdsl.scene.scene import scene_model

LOG_FPS = 30.0  # frames per second of a hand's log unless others are asked for


class _Sampler(Actor):
    """Acts as another actor does, and samples joints, touch and set-points before each step."""

    def __init__(self, actor: Actor, env: TouchEnv, output: Output):
        self._actor, self._env, self._output = actor, env, output
        self.row: dict[str, np.ndarray] = {}

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actor's actions."""
        env, now, action = self._env, self._env.now, self._actor(obs)
        reading = now.readings[self._output.name]
        touch = reading if reading.ndim == 3 else reading[:, -1]  # of stacked samples the newest
        values = {"state": now.joint_pos, "touch": touch, "policy_action": action, "action": env.actuation.commanded(action)}
        self.row = {name: value.detach().cpu().numpy().copy() for name, value in values.items()}
        return action

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        self._actor.begin(ended)


def of_environments(
    env: TouchEnv, actor: Actor, episodes: int, fps: float | None = None, reading: str | None = None, least: float | None = None
) -> tuple[Header, Iterator[Episode]]:
    """Return the first episodes of fresh environments, as many of each."""
    output = _force_of(env.touch.outputs, reading)
    table = env.touch.taxels[output.sensor]
    rows, links = _links(table)
    columns = [output.channels.index(name) for name in FORCE]
    header = Header(
        env.loaded.source.file,
        env.spec.task.replace("_", " "),
        env.joint_names,
        links,
        output.units[columns[0]],
        env.control_step,
        _frame_rate(fps, env.control_step),
        has_outcome=True,
        has_policy=True,
    )

    def play() -> Iterator[Episode]:
        quota = [episodes // env.num_envs + (i < episodes % env.num_envs) for i in range(env.num_envs)]
        pending: list[list[dict[str, Any]]] = [[] for _ in quota]
        sampler = _Sampler(actor, env, output)
        actor.begin(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        for moment in rollout(sampler, env):
            info, reward = moment.step.info, moment.step.reward.cpu().numpy()
            ended, whole, score = (value.cpu().numpy() for value in (info.ended, info.is_whole(env.max_steps), info.score))
            for i in np.flatnonzero(quota):
                pending[i].append({name: value[i] for name, value in sampler.row.items()} | {"reward": reward[i]})
                if not ended[i]:
                    continue
                quota[i] -= 1
                samples = {name: np.stack([row[name] for row in pending[i]]) for name in pending[i][0]}
                pending[i] = []
                touch = samples.pop("touch")[:, :, columns]
                time = np.arange(len(touch)) * env.control_step
                is_success = _is_success(env.task, score[i], whole[i], least)
                by_link = {link: touch[:, taxels] for link, taxels in rows.items()}
                yield Episode(time, touch=by_link, score=float(score[i]), is_success=is_success, **samples)
            if not any(quota):
                return

    return header, play()


def of_deployment(
    deployment: Deployment,
    episodes: int,
    unit: str,
    seconds: float | None = None,
    fps: float | None = None,
    least: float | None = None,
) -> tuple[Header, Iterator[Episode]]:
    """Return episodes of a policy on an emulated hand, a real one or a log: the force on each fingertip."""
    prepared, touch = deployment.prepared, deployment.prepared.policy_touch
    if touch is None or touch.type != EMULATED or "proprio" not in prepared.groups:
        problem = f"this policy feels {'nothing' if touch is None else touch.type}"
        raise TgdslError(f"{prepared.saved.file}: {problem}; of a hand, expected one that feels {EMULATED}, and proprio")
    if deployment.has_scene and "motion" not in kind_of(deployment.source).options:
        raise TgdslError(f"--source {deployment.source}: a simulation's forces on taxels come from --source environments")
    num = len(prepared.moved.names)
    links = {link.name: LinkTaxels(link.body) for link in prepared.sensors.groups[touch.group].layout.links}
    header = Header(
        prepared.loaded.source.file,
        prepared.loaded.spec.task.replace("_", " "),
        prepared.moved.names,
        links,
        unit,
        prepared.control_step,
        _frame_rate(fps, prepared.control_step),
        has_outcome=deployment.has_scene,
        has_policy=True,
    )

    def episode_of(rows: list[dict[str, np.ndarray]]) -> Episode:
        samples = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        force, reward = samples.pop("touch"), samples.pop("reward")
        score, is_whole = (samples.pop(name)[-1] for name in ("score", "is_whole"))
        outcome: dict[str, Any] = {}
        if deployment.has_scene:
            is_success = _is_success(prepared.loaded.task, score, is_whole, least)
            outcome = {"score": float(score), "is_success": is_success, "reward": reward}
        touch = {link: force[:, None, i] for i, link in enumerate(links)}
        return Episode(np.arange(len(force)) * prepared.control_step, touch=touch, **samples, **outcome)

    def act() -> Iterator[Episode]:
        for _, moments in groupby(deployment.steps(episodes, seconds), lambda moment: moment.episode):
            rows = []
            for moment in moments:
                step, force = moment.step, moment.obs[GROUP][0].view(-1, 3, len(links))[-1].T  # of stacked samples the newest
                values = {"state": moment.obs["proprio"][0, :num], "touch": force, "policy_action": moment.action[0]}
                values |= {"action": moment.target[0], "reward": step.reward[0], "score": step.info.score[0]}
                values |= {"is_whole": ~step.info.ended[0] | step.truncated[0]}
                rows.append({name: value.cpu().numpy().copy() for name, value in values.items()})
            yield episode_of(rows)

    return header, act()


def of_run(
    file: Path, touch: TactileModule, fps: float | None = None, reading: str | None = None
) -> tuple[Header, Iterator[Episode]]:
    """Return episodes of a recording of `tgdsl run`, one per environment; actions are the controls of joints' actuators.

    A recording has positions and readings after each step: a frame's action is the next step's.
    """
    arrays = read_arrays(file, "a recording of tgdsl run")
    recorded = [output for output in touch.outputs if output.name in arrays]
    output = _force_of(recorded, reading)
    columns = [list(arrays[f"{output.name}:channels"]).index(name) for name in FORCE]
    rows, links = _links({name: arrays[f"{output.name}:{name}"] for name in ("link", "body", "pos", "normal")})
    if len(arrays["time"]) < 2:
        raise TgdslError(f"{file}: {len(arrays['time'])} steps, expected two at least")
    model, sizes = scene_model(touch.plan.scene), (arrays["qpos"].shape[-1], arrays["ctrl"].shape[-1])
    if sizes != (model.nq, model.nu):
        problem = f"{sizes[0]} positions and {sizes[1]} controls, its document now has {model.nq} and {model.nu}"
        raise TgdslError(f"{file}: {problem}: record it again")
    actuators = np.flatnonzero(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT)
    joints = model.actuator_trnid[actuators, 0]
    step = float(np.median(np.diff(arrays["time"])))
    header = Header(
        str(file),
        Path(str(arrays["document"])).stem.replace("_", " "),
        tuple(model.joint(int(i)).name for i in joints),
        links,
        str(arrays[f"{output.name}:units"][columns[0]]),
        step,
        _frame_rate(fps, step),
    )

    def read() -> Iterator[Episode]:
        force, qpos, ctrl = arrays[output.name][..., columns], arrays["qpos"], arrays["ctrl"][..., actuators]
        force = force if force.ndim == 4 else force[:, :, -1]  # of stacked samples the newest
        for env in range(qpos.shape[1]):
            action = ctrl if ctrl.ndim == 2 else ctrl[:, env]
            by_link = {link: force[:-1, env, taxels] for link, taxels in rows.items()}
            yield Episode(arrays["time"][:-1], qpos[:-1, env][:, model.jnt_qposadr[joints]], action[1:], by_link)

    return header, read()


def of_log(
    file: Path, fps: float | None = None, calibration: Calibration | None = None, side: str | None = None
) -> tuple[Header, Iterator[Episode]]:
    """Return the episodes of a log of a real hand, or of an emulated one on its line: the force on each fingertip.

    A log does not hold commands: the action is where the joints are a frame later. Where no reading came for 0.1 s, the next
    episode begins.
    """
    log = open_log(file)
    meaning = calibration or log.calibration or Calibration.none()
    prefix = f"{side}_hand_" if side else ""
    bodies = [f"{prefix}{name}" for name in TIP_BODIES]
    if log.num_readings < 2:
        raise TgdslError(f"{file}: one reading, expected two at least")
    time, position = log.received_at, log.column("position").astype(np.float64)
    force = meaning.apply(log.column("total_force"))
    step = float(np.median(np.diff(time)))
    rate = _frame_rate(min(LOG_FPS, 1.0 / step) if fps is None else fps, step)
    joints, links = tuple(f"{prefix}{name}" for name in JOINTS), {body: LinkTaxels(body) for body in bodies}
    header = Header(str(file), file.stem.replace("_", " "), joints, links, meaning.units, step, rate)

    def read() -> Iterator[Episode]:
        for part in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > MAX_AGE_S) + 1):
            later = np.searchsorted(time[part], time[part] + (1.0 + EPS) / rate, side="right") - 1
            by_link = {body: force[part][:, None, i] for i, body in enumerate(bodies)}
            yield Episode(time[part], position[part], position[part][later], by_link)

    return header, read()


def _frame_rate(fps: float | None, step: float) -> float:
    fps = 1.0 / step if fps is None else fps
    if not 0 < fps * step <= 1.0 + 1e-6:
        raise TgdslError(f"--fps {fps:g}: expected more than 0, and at most the source's rate, {1.0 / step:.4g}")
    return float(round(fps)) if abs(fps - round(fps)) < 1e-6 * fps else fps


def _is_success(task: Task[Any] | type[Task[Any]], score: float, is_whole: bool, least: float | None) -> bool:
    if least is None:
        return bool(is_whole)
    return bool(score <= least if task.is_less_better else score >= least)


def _force_of(outputs: Any, name: str | None) -> Output:
    able = {output.name: output for output in outputs if output.rows == "taxel" and set(FORCE) <= set(output.channels)}
    if name is not None and name not in able:
        raise TgdslError(f"--reading {name}: there is no such force on taxels; {did_you_mean(name, able, 'readings')}")
    if not able:
        names = listed([output.name for output in outputs]) or "none"
        problem = f"no reading is a force on taxels, in newtons: there are {names}"
        raise TgdslError(f"{problem}; of a task try --set touch=force, with a sensor of kind kinematic_taxel or force_taxel")
    return able[name] if name else next(iter(able.values()))


def _links(table: Columns | np.ndarray) -> tuple[dict[str, np.ndarray], dict[str, LinkTaxels]]:
    """Return by link the rows of its taxels, and where they are."""
    names = [str(name) for name in table["link"]]
    rows = {link: np.flatnonzero([name == link for name in names]) for link in dict.fromkeys(names)}
    taxels = {
        link: LinkTaxels(str(table["body"][of_link[0]]), *(np.asarray(table[name])[of_link] for name in ("pos", "normal")))
        for link, of_link in rows.items()
    }
    return rows, taxels
