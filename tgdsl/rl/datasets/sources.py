"""Episodes with touch from environments, from emulated and real hands, from recordings of `tgdsl run` and from logs of hands.

Shapes: as in `episode`, `env` environments.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import TgdslError, did_you_mean, listed
from tgdsl.module.module import TactileModule
from tgdsl.module.outputs import Output
from tgdsl.module.taxels.identity import Columns
from tgdsl.rl.datasets.episode import EPS, Episode, LinkTaxels, Source
from tgdsl.rl.deploying.deploy import Deployment
from tgdsl.rl.deploying.hand import EMULATED
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.rollout import Actor, rollout
from tgdsl.rl.sensed import GROUP
from tgdsl.runtime.connect import kind_of
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import MAX_AGE_S
from tgdsl.runtime.xhand1.log.log import open_log
from tgdsl.runtime.xhand1.observe import TIP_BODIES
from tgdsl.runtime.xhand1.wire.payloads import JOINTS
from tgdsl.scene.scene import scene_model

FORCE = ("force_x", "force_y", "force_z")
LOG_FPS = 30.0
"""Frames per second of a hand's log unless others are asked for."""


class _Watching(Actor):
    """An actor; notes joints, touch and set-points before each step."""

    def __init__(self, actor: Actor, env: TouchEnv, output: Output):
        self._actor, self._env, self._output = actor, env, output
        self.row: dict[str, np.ndarray] = {}

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        """Return the actor's actions."""
        env, now, action = self._env, self._env.now, self._actor(obs)
        reading = now.readings[self._output.name]
        values = {"state": now.joint_pos, "touch": reading if reading.ndim == 3 else reading[:, -1], "policy_action": action}
        values["action"] = env.actuation.commanded(action)
        self.row = {name: value.detach().cpu().numpy().copy() for name, value in values.items()}
        return action

    def begin(self, ended: Tensor) -> None:
        """Tell the actor."""
        self._actor.begin(ended)


def of_environments(
    env: TouchEnv, actor: Actor, episodes: int, fps: float | None = None, reading: str | None = None, least: float | None = None
) -> tuple[Source, Iterator[Episode]]:
    """Return episodes of environments that were just made: as many of each environment, its first ones.

    Args:
        env: The environments.
        actor: Who acts.
        episodes: How many.
        fps: Frames per second; default: one per control step.
        reading: The reading that is exported; default: the first force on taxels.
        least: Score with which an episode succeeds, of a task in which less is better the most; default: it succeeds if it
            lasts as long as one may.

    Raises:
        TgdslError: If there is no such reading, or it is of no taxels.
    """
    output = _force_of(env.touch.outputs, reading)
    table = env.touch.taxels[output.sensor]
    rows, links = _links(table)
    columns = [output.channels.index(name) for name in FORCE]
    source = Source(
        env.loaded.source.file,
        env.spec.task.replace("_", " "),
        env.joint_names,
        links,
        FORCE,
        output.units[columns[0]],
        env.control_step,
        _checked_fps(fps, env.control_step),
        has_outcome=True,
        has_policy=True,
    )

    def play() -> Iterator[Episode]:
        quota = [episodes // env.num_envs + (i < episodes % env.num_envs) for i in range(env.num_envs)]
        pending: list[list[dict[str, Any]]] = [[] for _ in quota]
        watching = _Watching(actor, env, output)
        actor.begin(torch.ones(env.num_envs, dtype=torch.bool, device=env.device))
        for moment in rollout(watching, env):
            info, reward = moment.step.info, moment.step.reward.cpu().numpy()
            ended, whole, score = (value.cpu().numpy() for value in (info.ended, info.is_whole(env.max_steps), info.score))
            for i in np.flatnonzero(quota):
                pending[i].append({name: value[i] for name, value in watching.row.items()} | {"reward": reward[i]})
                if not ended[i]:
                    continue
                quota[i] -= 1
                samples = {name: np.stack([row[name] for row in pending[i]]) for name in pending[i][0]}
                pending[i] = []
                touch = samples.pop("touch")[:, :, columns]
                time = np.arange(len(touch)) * env.control_step
                is_good = whole[i] if least is None else (score[i] <= least if env.task.is_less_better else score[i] >= least)
                by_link = {link: touch[:, taxels] for link, taxels in rows.items()}
                yield Episode(time, touch=by_link, score=float(score[i]), is_success=bool(is_good), **samples)
            if not any(quota):
                return

    return source, play()


def of_deployment(
    deployment: Deployment,
    episodes: int,
    unit: str,
    seconds: float | None = None,
    fps: float | None = None,
    least: float | None = None,
) -> tuple[Source, Iterator[Episode]]:
    """Return episodes of a policy on an emulated hand, a real one or a log: the force on each fingertip, as the hand says it.

    Args:
        deployment: The policy on its source.
        episodes: How many.
        unit: Unit of the forces, as the hand's calibration has it.
        seconds: Longest duration of each [s]; default: an episode's, of a log all of it.
        fps: Frames per second; default: one per control step.
        least: As for `of_environments`; without a scene there is no score, and no success.

    Raises:
        TgdslError: If the policy does not feel forces on fingertips, or acts in a simulation.
    """
    prepared, felt = deployment.prepared, deployment.prepared.felt
    if felt is None or felt.type != EMULATED or "proprio" not in prepared.groups:
        problem = f"this policy feels {'nothing' if felt is None else felt.type}"
        raise TgdslError(f"{prepared.saved.file}: {problem}; of a hand, expected one that feels {EMULATED}, and proprio")
    if deployment.has_scene and "motion" not in kind_of(deployment.source).options:
        raise TgdslError(f"--source {deployment.source}: a simulation's forces on taxels come from --source environments")
    num, task = len(prepared.moved.names), prepared.loaded.task
    bodies = {link.name: LinkTaxels(link.body) for link in prepared.sensed.groups[felt.group].layout.links}
    source = Source(
        prepared.loaded.source.file,
        prepared.loaded.spec.task.replace("_", " "),
        prepared.moved.names,
        bodies,
        FORCE,
        unit,
        prepared.control_step,
        _checked_fps(fps, prepared.control_step),
        has_outcome=deployment.has_scene,
        has_policy=True,
    )

    def ended(rows: list[dict[str, np.ndarray]], last: Any) -> Episode:
        samples = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        force, outcome = samples.pop("touch"), dict[str, Any]()
        if deployment.has_scene:
            score = float(last.step.info.score)
            is_good = (
                bool(~last.step.info.ended[0] | last.step.truncated[0])
                if least is None
                else (score <= least if task.is_less_better else score >= least)
            )
            outcome = {"score": score, "is_success": is_good, "reward": samples["reward"]}
        del samples["reward"]
        touch = {link: force[:, None, i] for i, link in enumerate(bodies)}
        return Episode(np.arange(len(force)) * prepared.control_step, touch=touch, **samples, **outcome)

    def act() -> Iterator[Episode]:
        rows: list[dict[str, np.ndarray]] = []
        last = None
        for moment in deployment.steps(episodes, seconds):
            if last is not None and moment.episode != last.episode:
                yield ended(rows, last)
                rows = []
            force = moment.obs[GROUP][0].view(-1, 3, len(bodies))[-1].T  # of stacked samples the newest
            values = {"state": moment.obs["proprio"][0, :num], "touch": force, "policy_action": moment.action[0]}
            values |= {"action": moment.target[0], "reward": moment.step.reward[0]}
            rows.append({name: value.cpu().numpy().copy() for name, value in values.items()})
            last = moment
        if rows:
            yield ended(rows, last)

    return source, act()


def of_run(
    file: Path, touch: TactileModule, fps: float | None = None, reading: str | None = None
) -> tuple[Source, Iterator[Episode]]:
    """Return what `tgdsl run` has recorded, an episode per environment; actions are the controls of the actuators.

    A recording has positions and readings after each step: a frame's action is that of the next one.

    Args:
        file: The recording.
        touch: The module of its document.
        fps: Frames per second; default: one per control step.
        reading: As for `of_environments`.

    Raises:
        TgdslError: If the recording holds no such reading or less than two steps, or is of another scene.
    """
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    recorded = [output for output in touch.outputs if output.name in arrays]
    output = _force_of(recorded, reading)
    columns = [list(arrays[f"{output.name}:channels"]).index(name) for name in FORCE]
    rows, links = _links({name: arrays[f"{output.name}:{name}"] for name in ("link", "body", "pos", "normal")})
    names, addresses = _actuated(touch)
    if len(arrays["time"]) < 2:
        raise TgdslError(f"{file}: {len(arrays['time'])} steps, expected two at least")
    model, sizes = scene_model(touch.plan.scene), (arrays["qpos"].shape[-1], arrays["ctrl"].shape[-1])
    if sizes != (model.nq, model.nu):
        raise TgdslError(
            f"{file}: {sizes[0]} positions and {sizes[1]} controls, its document now has {model.nq} and {model.nu}: "
            "record it again"
        )
    step = float(np.median(np.diff(arrays["time"])))
    source = Source(
        str(file),
        Path(str(arrays["document"])).stem.replace("_", " "),
        names,
        links,
        FORCE,
        str(arrays[f"{output.name}:units"][columns[0]]),
        step,
        _checked_fps(fps, step),
    )

    def read() -> Iterator[Episode]:
        force, qpos, ctrl = arrays[output.name][..., columns], arrays["qpos"], arrays["ctrl"]
        force = force if force.ndim == 4 else force[:, :, -1]  # of stacked samples the newest
        for env in range(qpos.shape[1]):
            action = ctrl if ctrl.ndim == 2 else ctrl[:, env]
            by_link = {link: force[:-1, env, taxels] for link, taxels in rows.items()}
            yield Episode(arrays["time"][:-1], qpos[:-1, env][:, addresses], action[1:], by_link)

    return source, read()


def of_log(
    file: Path, fps: float | None = None, calibration: Calibration | None = None, side: str | None = None
) -> tuple[Source, Iterator[Episode]]:
    """Return what a real hand has said, or an emulated one over its line: the force on each fingertip.

    A log does not hold commands: the action is where the joints are a frame later. Where no reading came for 0.1 s, the next
    episode begins.

    Args:
        file: A log of `tgdsl hand record`.
        fps: Frames per second; default: 30.
        calibration: What counts mean; default: what the log says.
        side: Which hand it is, "right" or "left", by which links and joints are called as in its robot file; default: names
            are without it.

    Raises:
        LogError: If the log cannot be read.
        TgdslError: If frames come faster than readings.
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
    rate = _checked_fps(min(LOG_FPS, 1.0 / step) if fps is None else fps, step)
    joints, links = tuple(f"{prefix}{name}" for name in JOINTS), {body: LinkTaxels(body) for body in bodies}
    source = Source(str(file), file.stem.replace("_", " "), joints, links, FORCE, meaning.units, step, rate)

    def read() -> Iterator[Episode]:
        for part in np.split(np.arange(len(time)), np.flatnonzero(np.diff(time) > MAX_AGE_S) + 1):
            later = np.searchsorted(time[part], time[part] + (1.0 + EPS) / rate, side="right") - 1
            by_link = {body: force[part][:, None, i] for i, body in enumerate(bodies)}
            yield Episode(time[part], position[part], position[part][later], by_link)

    return source, read()


def _checked_fps(fps: float | None, step: float) -> float:
    fps = 1.0 / step if fps is None else fps
    if not 0 < fps * step <= 1.0 + 1e-6:
        raise TgdslError(f"--fps {fps:g}: expected more than 0, and at most the source's rate, {1.0 / step:.4g}")
    return float(round(fps)) if abs(fps - round(fps)) < 1e-6 * fps else fps


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


def _actuated(touch: TactileModule) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the joint of each actuator, and where it stands in `qpos`."""
    model = scene_model(touch.plan.scene)
    ids = model.actuator_trnid[:, 0]
    return tuple(model.joint(int(i)).name for i in ids), model.jnt_qposadr[ids]
