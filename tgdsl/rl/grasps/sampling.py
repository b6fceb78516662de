"""Sampling of grasps: a hand closes on an object at random, and stable grasps are stored.

One trial, in simulation, without randomised mass, friction or drives:

1. Joints start near the task's keyframe, by `spread` or a quarter of their range; the object is turned and moved at random and
   fixed there.
2. For `close` the policy's joints move to near the controls of the keyframe `closed`, each in a random time. A target never
   leads its joint by more than the trial's `squeeze`, so a finger in contact presses with that times its servo's gain. The
   other joints have the keyframe's controls.
3. The object is released. After `settle` all velocities are set to zero: this is the grasp.
4. For `hold` the object is pushed in four random directions, one after the other.

A grasp is stored if the object is near its fixed pose at the end of both 3. and 4., and links press on it from opposite sides.
Random numbers are counter-based: trials are the same on every computer of one kind, with any number of threads.

Shapes: `env` environments, trials side by side, `joint` joints that the policy moves, `link` links, `nq` and `nu` as in
MuJoCo's model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.errors import SimulationError
from tgdsl.files.cache import cached
from tgdsl.plan.scene import SceneFile
from tgdsl.rl import rotations
from tgdsl.rl.draws import Draws
from tgdsl.rl.grasps.grasps import Grasps, GraspSpec, GraspTable, cache_key, grasp_spec, read_grasps, settings_of
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.sensors import TaskSensors, compile_sensors
from tgdsl.rl.start import make_simulation, moved_actuators, moved_joints
from tgdsl.rl.task import Setup
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.simulators.model_ids import keyframe_id
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.scene.scene import scene_digest

SIDE_BY_SIDE = 256  # most parallel trials; for few grasps twice their number
PUSHES = 4  # pushes of each trial
SHARE = 0.25  # upper bound of `spread` as a share of a joint's range, so that few grasps begin at a joint's limit
LEAST_SHARE, ENOUGH = 0.01, 1000  # least share of a variant's trials that must hold, from this number of trials on
Count = Callable[[int, int], None]  # called with the number of grasps so far and the number requested


def sample(loaded: LoadedTask, count: Count, progress: Progress | None = None) -> Grasps:
    """Sample a task's grasps, on the CPU."""
    spec, sensors = grasp_spec(loaded.spec), compile_sensors(loaded, "cpu", progress, only=("link_contact",))
    assert spec is not None
    trials = _Trials(loaded, sensors, spec)
    num = trials.num_variants
    requested = torch.tensor([spec.num // num + (v < spec.num % num) for v in range(num)])
    accepted, rounds, trials_of = torch.zeros_like(requested), [], torch.bincount(trials.variant)
    while not rounds or bool((accepted < requested).any()):
        rounds.append(trials.run(len(rounds)))
        accepted += torch.bincount(rounds[-1][0], minlength=num)
        for v, tried in enumerate((len(rounds) * trials_of).tolist()):
            if accepted[v] < min(int(requested[v]), LEAST_SHARE * tried) and tried >= ENOUGH:
                problem = (
                    f"only {int(accepted[v])} of {tried} grasps of variant {v} of {loaded.spec.object} hold: {trials.failures}"
                )
                raise loaded.error(("grasps",), problem, "start the hand nearer to the object, or ask for less")
        count(int(torch.minimum(accepted, requested).sum()), spec.num)
    trials.sim.close()
    variant, qpos, ctrl = (torch.cat(parts) for parts in zip(*rounds, strict=True))
    ids = torch.cat([torch.nonzero(variant == v).flatten()[: int(requested[v])] for v in range(num)])
    return Grasps(
        qpos=qpos[ids].numpy(),
        ctrl=ctrl[ids].numpy(),
        variant=variant[ids].numpy(),
        scene=scene_digest(sensors.touch.plan.scene),
        object=loaded.spec.object,
        settings=settings_of(loaded.spec, trials.joints),
    )


class _Trials:
    """Trials side by side, one per environment."""

    def __init__(self, loaded: LoadedTask, sensors: TaskSensors, spec: GraspSpec):
        inputs, task = sensors.touch.inputs, loaded.spec
        self.spec, self.joints = spec, moved_joints(loaded, sensors)
        self.num_variants = sensors.num_variants(task.object)
        num_envs = max(self.num_variants, min(SIDE_BY_SIDE, 2 * spec.num))
        sim = make_simulation(loaded, sensors, self.joints, num_envs, "cpu", "mujoco")
        assert isinstance(sim, BatchSimulation)
        self.sim, model = sim, sim.model
        self.variant: Int[Tensor, " env"] = torch.arange(num_envs) % self.num_variants
        actuators = moved_actuators(loaded, model, self.joints)
        try:
            closed = keyframe_id(model, spec.closed)
        except SimulationError as error:
            raise loaded.error(("grasps", "closed"), str(error)) from error
        self._actuator, self._joint = torch.from_numpy(actuators.actuator), torch.from_numpy(actuators.qpos)
        self._low, self._high = torch.from_numpy(actuators.low), torch.from_numpy(actuators.high)
        self._spread = (SHARE * (self._high - self._low)).clamp(max=spec.spread)
        self._closed = torch.from_numpy(model.key_ctrl[closed])[self._actuator]
        self._open, self._ctrl = sim.qpos[0].clone(), sim.ctrl[0].clone()
        self._body = sensors.object
        self._place = _Place(loaded, spec, model, sensors.object)
        self._pairs = [i for i, pair in enumerate(inputs.pairs) if pair.object == task.object]
        self._draws = Draws(spec.seed, num_envs)
        self._failed = dict.fromkeys(("diverged", "tilted", "moved away", "held by too few links or from one side"), 0)

    @property
    def failures(self) -> str:
        return ", ".join(f"{num} {reason}" for reason, num in self._failed.items())

    def run(self, round_: int) -> tuple[Int[Tensor, " grasp"], Float[Tensor, "grasp nq"], Float[Tensor, "grasp nu"]]:
        """Run a round of trials; return variant, positions and controls of the grasps that hold."""
        sim, spec = self.sim, self.spec
        count = torch.full((sim.num_envs,), round_)
        qpos = self._start(count)
        sim.reset(contacts="none", qpos=qpos, ctrl=self._ctrl)
        begin_pos, begin_quat = self._object()
        self._close(count, qpos)
        self._steps(spec.settle)
        sim.set_state(qvel=torch.zeros_like(sim.qvel))
        grasp, ctrl = sim.qpos.clone(), sim.ctrl.clone()
        presses, near = self._presses(), [self._strayed(begin_pos, begin_quat)]
        self._push(count)
        near.append(self._strayed(begin_pos, begin_quat))
        tilted, moved = (near[0][i] | near[1][i] for i in (0, 1))
        reasons = (sim.faults, tilted, moved, ~presses)
        holds = torch.ones_like(presses)
        for reason, failed in zip(self._failed, reasons, strict=True):
            self._failed[reason] += int((holds & failed).sum())
            holds &= ~failed
        return self.variant[holds], grasp[holds], ctrl[holds]

    def _start(self, count: Int[Tensor, " env"]) -> Float[Tensor, "env nq"]:
        spread = self._spread * self._draws.uniform("start", count, len(self.joints), -1.0, 1.0).double()
        qpos = self._open.repeat(len(count), 1)
        qpos[:, self._joint] = torch.minimum(torch.maximum(qpos[:, self._joint] + spread, self._low), self._high)
        self._place.put(qpos, self._draws, count)
        return qpos

    def _close(self, count: Int[Tensor, " env"], start: Float[Tensor, "env nq"]) -> None:
        sim, spec, draws, num = self.sim, self.spec, self._draws, len(self.joints)
        begin = start[:, self._joint]
        end = self._closed + self._spread * draws.uniform("end", count, num, -1.0, 1.0).double()
        end = torch.minimum(torch.maximum(end, self._low), self._high)
        duration = spec.close * draws.uniform("duration", count, num, 0.4, 0.9).double()
        lead = draws.uniform("squeeze", count, 1, *spec.squeeze).double()
        sim.drive = lambda: self._place.keep(sim, start)
        steps = max(1, round(spec.close / sim.control_step))
        for i in range(steps):
            share = ((i + 1) * sim.control_step / duration).clamp(max=1.0)
            now, target = sim.qpos[:, self._joint], begin + share * (end - begin)
            target = torch.minimum(torch.maximum(target, now - lead), now + lead)
            sim.ctrl[:, self._actuator] = torch.minimum(torch.maximum(target, self._low), self._high)
            sim.step()
        sim.drive = None

    def _steps(self, duration: float) -> None:
        for _ in range(max(1, round(duration / self.sim.control_step))):
            self.sim.step()

    def _push(self, count: Int[Tensor, " env"]) -> None:
        """Push the objects, with a pause after each push."""
        sim, body = self.sim, int(self.sim.model.body(self._body).id)
        applied = sim.arrays["xfrc_applied"]
        for i in range(PUSHES):
            direction = self._draws.normal(f"push {i}", count, 3).double()
            applied[:, body, :3] = self.spec.push * direction / direction.norm(dim=1, keepdim=True)
            self._steps(0.5 * self.spec.hold / PUSHES)
            applied[:, body] = 0.0
            self._steps(0.5 * self.spec.hold / PUSHES)

    def _object(self) -> tuple[Float[Tensor, "env 3"], Float[Tensor, "env 4"]]:
        result = self.sim.watched().body(self._body)
        return result.pos.clone(), result.quat.clone()

    def _strayed(
        self, begin_pos: Float[Tensor, "env 3"], begin_quat: Float[Tensor, "env 4"]
    ) -> tuple[Bool[Tensor, " env"], Bool[Tensor, " env"]]:
        """Return which objects are tilted, and which have moved away."""
        pos, quat = self._object()
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(pos)
        tilt = rotations.swing(rotations.product(quat, rotations.inverse(begin_quat)), up)
        return ~(tilt <= self.spec.max_tilt), ~((pos - begin_pos).norm(dim=1) <= self.spec.max_shift)

    def _presses(self) -> Bool[Tensor, " env"]:
        """Return which objects enough links press on, from opposite sides."""
        force = self.sim.state().contact_netforce
        assert force is not None
        force = force[:, self._pairs]
        size = force.norm(dim=2)
        counts = size > self.spec.min_force
        unit = torch.where(counts[..., None], force / size.clamp(min=1e-12)[..., None], 0.0)
        cosines = unit @ unit.transpose(1, 2)
        is_pair = counts[:, :, None] & counts[:, None, :]
        opposite = (is_pair & (cosines <= np.cos(self.spec.opposite))).flatten(1).any(dim=1)
        return (counts.sum(dim=1) >= self.spec.min_links) & opposite


class _Place:
    """The object's fixed pose while the hand closes."""

    def __init__(self, loaded: LoadedTask, spec: GraspSpec, model: mujoco.MjModel, body: str):
        """Look up its joints; raise `SpecError` if it has none, or none for `yaw` or `offset`."""
        mj_body = model.body(body)
        self._yaw, self._offset = spec.yaw, spec.offset
        joints = range(int(mj_body.jntadr[0]), int(mj_body.jntadr[0]) + int(mj_body.jntnum[0]))
        free, ball = (
            [j for j in joints if int(model.jnt_type[j]) == int(kind)]
            for kind in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL)
        )
        if not mj_body.jntnum[0]:
            raise loaded.error(("object",), f'the object\'s body "{body}" has no joint, and cannot be grasped')
        if not (free or ball) and any(spec.yaw):
            raise loaded.error(("grasps", "yaw"), f'the object\'s body "{body}" has neither a free nor a ball joint')
        if not free and any(spec.offset):
            raise loaded.error(("grasps", "offset"), f'the object\'s body "{body}" has no free joint')
        first, dof = int(model.jnt_qposadr[joints[0]]), int(mj_body.dofadr[0])
        last = int(model.jnt_qposadr[joints[-1]]) + (7 if free else 4 if ball and ball[0] == joints[-1] else 1)
        self._qpos, self._qvel = slice(first, last), slice(dof, dof + int(mj_body.dofnum[0]))
        self._pos = slice(first, first + 3) if free else None
        self._quat = slice(last - 4, last) if free or ball else None

    def put(self, qpos: Float[Tensor, "env nq"], draws: Draws, count: Int[Tensor, " env"]) -> None:
        """Turn and move objects at random, in place."""
        if self._quat is not None:
            yaw = draws.uniform("yaw", count, 1, *self._yaw)[:, 0].double()
            up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(len(qpos), 3)
            qpos[:, self._quat] = rotations.product(rotations.about(up, yaw), qpos[:, self._quat])
        if self._pos is not None:
            qpos[:, self._pos] += draws.uniform("offset", count, 3, *self._offset).double()

    def keep(self, sim: BatchSimulation, start: Float[Tensor, "env nq"]) -> None:
        sim.qpos[:, self._qpos] = start[:, self._qpos]
        sim.qvel[:, self._qvel] = 0.0


def with_grasps(setup: Setup, loaded: LoadedTask, sim: Simulation, scene: SceneFile, progress: Progress | None) -> Setup:
    """Return a setup with the grasps of its document, if it has any; reset the simulation afterwards."""
    spec, tell = grasp_spec(loaded.spec), progress or silent
    if spec is None:
        return setup
    try:
        if spec.file is not None:
            grasps = read_grasps(loaded.folder / spec.file, scene_digest(scene), loaded.spec.object)
        else:
            joints = setup.actuators.names
            grasps = cached_grasps(loaded, scene, joints, lambda num, of: tell(f"sampling grasps: {num} of {of}"), progress)
        return replace(setup, grasps=GraspTable(grasps, sim, setup.object, setup.variant, setup.draws))
    except SimulationError as error:
        raise loaded.error(("grasps",) if spec.file is None else ("grasps", "file"), str(error)) from error


def cached_grasps(
    loaded: LoadedTask, scene: SceneFile, joints: tuple[str, ...], count: Count, progress: Progress | None = None
) -> Grasps:
    """Return the task's grasps from the user's cache, under a hash of scene and settings; sample them if missing."""
    key = cache_key(scene_digest(scene), settings_of(loaded.spec, joints))
    return cached(key, lambda: sample(loaded, count, progress), Grasps.packed, Grasps.unpacked)
