"""Environments for learning with touch: a task, its module and a simulation in one step.

A control step has this order: the action sets targets; pushes begin or end; physics steps, each with the drives; readings of
one instant; terminations; rewards. Then environments whose episodes ended start again: random values are drawn, bodies are
placed, and these environments alone are read again; delay, noise and history of the others do not advance. On a GPU the whole
step is one CUDA graph, and the host never waits.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from os import PathLike
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.console.progress import Progress, silent
from tgdsl.console.tables import listing, shapes
from tgdsl.errors import LowerError, SimulationError, listed
from tgdsl.rl import groups
from tgdsl.rl.actuation import Actuation
from tgdsl.rl.description import Description, describe
from tgdsl.rl.draws import Draws
from tgdsl.rl.events import Curricula, Events, event_terms
from tgdsl.rl.grasps.sampling import with_grasps
from tgdsl.rl.load import LoadedTask, load_task
from tgdsl.rl.sensors import PolicyTouch, SubstepTouch, TaskSensors, compile_sensors
from tgdsl.rl.start import make_setup, make_simulation, moved_joints
from tgdsl.rl.task import Now, Start, checked
from tgdsl.rl.terms import ObservationTerm, RewardTerm, TerminationTerm
from tgdsl.tensors.env_ids import may_be_nonempty
from tgdsl.tensors.fused import FusedCall
from tgdsl.tensors.on_host import one_thread
from tgdsl.tensors.torch_internals import below_autograd

SINGLE_THREAD_MAX_TAXELS = 2**16
"""On a CPU one thread reads up to so many taxels of all environments: each of two would get fewer than 2¹⁵ numbers."""
FAR_BEYOND = 10.0  # actions of that size are a mistake, such as angles in degrees
NUM_PAST_ACTIONS = 3  # that reward terms may read
PREPARING_STEPS = 3  # the third step is captured on a GPU, and the second one compiled


Observations = dict[str, Float[Tensor, "env feature"]]


class StepInfo(NamedTuple):
    """Further results of a step. Where an episode has ended, values are of that episode, not of the next one."""

    ended: Bool[Tensor, " env"]  #: episodes that have ended, terminated or truncated
    final_obs: Observations  #: observations before the reset: they differ from `Step.obs` where an episode has ended
    terms: dict[str, Float[Tensor, " env"]]  #: terms of the reward of this step by name, weights and Δt included
    score: Float[Tensor, " env"]  #: score of the episode, in `task.score_unit`
    episode_return: Float[Tensor, " env"]  #: sum of its rewards
    episode_steps: Int[Tensor, " env"]  #: its control steps
    episode_terms: dict[str, Float[Tensor, " env"]]  #: sums of its terms by name
    #: environments that have diverged, or whose actions were not finite: their episodes end, with a reward of 0
    faults: Bool[Tensor, " env"]

    def __repr__(self) -> str:
        return "StepInfo\n" + listing((name, shapes(value)) for name, value in self._asdict().items())

    def is_whole(self, max_steps: int) -> Bool[Tensor, " env"]:
        """Return which episodes have reached the largest number of control steps, without a fault."""
        return (self.episode_steps >= max_steps) & ~self.faults


class Step(NamedTuple):
    """Result of a control step."""

    obs: Observations  #: observations by group; of episodes that have ended, the first of the next one
    reward: Float[Tensor, " env"]  #: sum of the terms
    terminated: Bool[Tensor, " env"]  #: episodes that ended in failure or success
    truncated: Bool[Tensor, " env"]  #: episodes that ended at their maximum duration
    info: StepInfo  #: further results

    def __repr__(self) -> str:
        return "Step\n" + listing((name, shapes(value)) for name, value in self._asdict().items())


class TouchEnv:
    """Batched environments of one task: actions (env, joint) in, observations, rewards (env,) and ends (env,) out.

    Groups of observations: `proprio` (positions [rad], velocities [rad/s] and last action of the joints that the policy moves),
    `tactile_sensors` (none with `touch: none`), `priv_proprio` (`proprio` and the force on each link [N]), and the task's own.

    A learner calls `curricula.advance` to change parameters of terms during training.

    Attributes:
        groups: Size of each group of observations.
        touch_sources: Sources of the groups of touch.
        joint_names: Joints that the policy moves, in the order of actions.
        control_step: Duration of a control step [s].
        max_steps: Largest number of control steps of an episode.
        steps: Control steps of each environment's current episode: a live tensor, which may be written.
        resets: Number of resets of each environment, which selects its random numbers: a live tensor too.
    """

    _instant: Now | None
    steps: Int[Tensor, " env"]
    resets: Int[Tensor, " env"]

    @torch.inference_mode(False)  # memory is written outside of inference mode too
    def __init__(
        self,
        task: str | PathLike[str] | Mapping[str, Any] | LoadedTask,
        num_envs: int,
        *,
        device: str | torch.device = "cpu",
        seed: int = 0,
        overrides: Mapping[str, Any] | None = None,
        simulator: str | None = None,
        threads: int = 0,
        compiled: bool | None = None,
        first_env: int = 0,
        touches: Sequence[PolicyTouch] | None = None,
        sensors: TaskSensors | None = None,
        progress: Progress | None = None,
    ):
        """Make the environments and begin an episode in each.

        Args:
            task: The task's document: a YAML file, or a mapping with its content.
            num_envs: Number of environments.
            device: "cpu" (MuJoCo on its threads) or "cuda", "cuda:1" (MuJoCo Warp).
            seed: Seed of all random numbers.
            overrides: Values of the document to replace, by dotted path, such as `{"rewards.spin": 3}`.
            simulator: "mujoco", "warp" or the name of an installed plug-in; default: by the device. MuJoCo Warp on a CPU is
                slow, and meant for tests.
            threads: CPU threads of physics; 0: one per CPU.
            compiled: Whether torch compiles the module and the rest of a step, except physics; default: on a GPU.
            first_env: Index of the first environment across all processes, for random numbers and variants.
            touches: Touch of several policies, each an observation group `PolicyTouch.group`. They replace the document's
                `touch`, `placement` and `noise`, and the group `tactile_sensors`.
            sensors: The result of `compile_sensors`, to use instead of the document's sensors; its module is not copied.
            progress: Function that takes a line of text about each long job.

        Raises:
            SpecError: For all mistakes in the document, with their positions.
            SimulationError: If the scene cannot be simulated with the document's settings.
        """
        device = str(device)
        loaded = self.loaded = task if isinstance(task, LoadedTask) else load_task(task, overrides)
        self.spec, sensors = loaded.spec, sensors or compile_sensors(loaded, device, progress, touches=touches)
        self.touch, self.touch_sources, self._sensors = sensors.touch, sensors.groups, sensors
        is_cuda = self.touch.device.type == "cuda"
        is_compiled = is_cuda if compiled is None else compiled
        self.touch.memory.keeps_last = True  # of environments that do not begin again while others do
        if is_compiled:
            self.touch.compile(dynamic=not is_cuda)  # a GPU reads all environments each time, a CPU any number of them
        self.joint_names = moved_joints(loaded, sensors)
        self.sim = make_simulation(loaded, sensors, self.joint_names, num_envs, device, simulator, threads, first_env)
        self.num_envs, self.num_actions, self.device = num_envs, len(self.joint_names), self.touch.device
        draws = Draws(seed, num_envs, self.sim.qpos.device, first_env, is_compiled=is_compiled)
        setup = make_setup(loaded, sensors, self.sim, self.joint_names, draws, first_env)
        setup = with_grasps(setup, loaded, self.sim, self.touch.plan.scene, progress)
        self.curricula = Curricula(loaded, self.sim.qpos)
        try:
            self.task = loaded.task(self.curricula.spec, setup)
        except LowerError as error:
            raise loaded.error((error.field,), error.what, error.hint) from error
        self._draws, self._first_env = draws, first_env
        random, arrays = self.spec.randomise, self.sim.arrays
        self.actuation = Actuation(setup.actuators, arrays, self.spec.action, random.drive, draws, self.sim.substeps)
        self.sim.drive = None if self.actuation.is_ideal else FusedCall(self.actuation.drive, is_compiled)
        self._events = Events(event_terms(random, self.curricula.terms), self.sim, setup, self.actuation)
        self.control_step = setup.control_step
        self.max_steps = max(1, round(self.spec.episode / setup.control_step))
        self.resets = torch.zeros(num_envs, dtype=torch.int64, device=self.sim.qpos.device)
        self.steps, self._return = torch.zeros_like(self.resets), torch.zeros_like(self.resets, dtype=torch.float32)
        self._sums = self._return[None][:0]  # of each term of the reward over the present episode, (term, env)
        self._action = torch.zeros((num_envs, self.num_actions), dtype=torch.float32, device=self.device)
        self._used = torch.zeros_like(self.actuation.target)
        self._past = torch.zeros_like(self._used)[:, None].repeat(1, NUM_PAST_ACTIONS, 1)
        is_measured = self.spec.joint_vel == "measured"
        self._speeds = groups.MeasuredVelocity(self.actuation.target, setup.control_step) if is_measured else None
        self._restarted = FusedCall(self._restart, is_compiled)
        is_stacked = self.spec.temporal == "stack" and sensors.groups
        self._substeps = SubstepTouch(sensors, self.sim) if is_stacked else None
        self._commanded = FusedCall(self._command, is_compiled)
        self._judged = FusedCall(self._judge, is_compiled)
        self._observed = FusedCall(self._observe, is_compiled)
        self._call = self.sim.repeated(self._advance)
        is_plain = not (is_compiled or is_cuda)
        is_small = is_plain and num_envs * self.touch.plan.layout.num_taxels <= SINGLE_THREAD_MAX_TAXELS
        self._dispatch = below_autograd if is_plain else nullcontext
        self._step_by, self._logic_by = (
            one_thread if is_alone else nullcontext for is_alone in (is_small, is_plain and not is_small)
        )
        self._has_stepped, tell = True, progress or silent
        if is_cuda or is_compiled:
            tell(f"compiling kernels of {'physics and touch' if is_cuda else 'touch'}, which are cached for the next run")
        obs = self.reset(seed)
        self._terms = tuple(self._rates(self.now, torch.zeros_like(self.sim.faults)))
        self._sums = self._return.new_zeros((len(self._terms), num_envs))
        self.groups = {name: value.shape[1] for name, value in obs.items()}
        groups_of_class = type(self.task).own_groups
        if groups_of_class is not None and (other := set(groups_of_class) ^ set(self.task.observe(self.now))):
            raise SimulationError(f"{type(self.task).__name__}: `own_groups` and `observe` differ in {listed(sorted(other))}")
        if is_cuda or is_compiled:  # compile kernels and, on a GPU, capture the step
            for _ in range(PREPARING_STEPS):
                self.step(torch.zeros_like(self._action))
            self.reset(seed)
        self._has_stepped = False

    @property
    def now(self) -> Now:
        """State at the last observations; its tensors are valid until the next step.

        Raises:
            SimulationError: If a state was loaded: there is none until the next step.
        """
        if self._instant is None:
            raise SimulationError("a state was loaded: its readings are available after the next step")
        return self._instant

    def reset(self, seed: int | None = None) -> Observations:
        """Begin a new episode in all environments.

        Args:
            seed: Seed of all random numbers, as for new environments; default: continue with the current numbers.
        """
        everyone = torch.ones(self.num_envs, dtype=torch.bool, device=self.sim.qpos.device)
        with torch.inference_mode(False), torch.no_grad():  # memory is written outside of inference mode too
            if seed is not None:
                self._draws.reseed(seed)
                self.resets.zero_()
            self._begin(everyone)
            if seed is not None:
                self.touch.seed(seed, self._first_env)
            self._instant = self._begin_instant(everyone, self.sim.read())
            self._obs = self._observe(self._instant)
            return dict(self._obs)

    def step(self, action: Float[Tensor, "env joint"] | Float[np.ndarray, "env joint"]) -> Step:
        """Make one control step in all environments; where an episode ends, the next one begins.

        Args:
            action: The policy's action, from −1 to 1. Other values are clipped; in the first step a warning names values far
                outside. An action that is not finite ends the episode, and marks the environment in `info.faults`. NumPy arrays
                are accepted.

        Raises:
            SimulationError: If the action has another shape or an integer dtype, or a pool of MuJoCo Warp overflowed.
        """
        try:
            action = torch.as_tensor(action)
        except (TypeError, ValueError, RuntimeError) as error:
            expected = f"a tensor {tuple(self._action.shape)} of numbers from -1 to 1"
            raise SimulationError(f"action is of {type(action).__name__}, expected {expected}") from error
        if not action.is_floating_point():
            raise SimulationError(f"action is of {action.dtype}, expected numbers from -1 to 1")
        if tuple(action.shape) != tuple(self._action.shape):
            raise SimulationError(f"action has shape {tuple(action.shape)}, expected {tuple(self._action.shape)}")
        if not self._has_stepped:  # once: the host waits for a GPU to see it
            self._has_stepped = True
            env, joint = divmod(int(action.abs().nan_to_num(posinf=0.0).argmax()), self.num_actions)
            if abs(value := float(action[env, joint])) > FAR_BEYOND:
                problem = f"action of {self.joint_names[joint]} is {value:g} in environment {env}, and clipped to [-1, 1]"
                warnings.warn(f"{problem}; later steps are not looked at", stacklevel=2)
        with torch.inference_mode(False), torch.no_grad(), self._dispatch(), self._step_by():  # memory is written outside too
            self._action.copy_(action)
            step, self._instant = self._call()
            step = _copied(step) if self.device.type == "cuda" else step
        self._obs = step.obs
        return step._replace(obs=dict(step.obs))

    def observe(self) -> Observations:
        """Return the last observations, by group."""
        return dict(self._obs)

    def describe(self) -> Description:
        """Return a description of each feature of each group of observations; it prints as a table."""
        return describe(self.loaded, self._sensors, self.task, self.curricula.terms, self.groups)

    def follow(self, control: Float[Tensor, "env nu"]) -> Step:
        """Make one control step towards external set-points, such as a hand's serial line reports, without a policy.

        Actions count as zeros. Ended episodes do not restart: call `reset`.

        Args:
            control: Set-points of all actuators: positions of their joints [rad; slides: m].
        """
        with torch.inference_mode(False), torch.no_grad(), self._dispatch():
            self.actuation.follow(control)
            self._events.advance()
            now = self._instant = self._advance_task(self._step_physics(self.sim.ctrl))
            step = self._judged(now, self.sim.faults)
        self._obs = step.obs
        return step

    def images(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return the policy's touch as one image per link, and masks of taxels: see `TactileModule.images`.

        Raises:
            SimulationError: If the policy has no touch, there are several policies, or no step followed `load_state_dict`.
        """
        if self._sensors.policy_sensor is None:
            raise SimulationError("the policy feels nothing: touch is none; or there are several policies")
        return self.touch.images(self._sensors.policy_sensor, self.now.readings)

    def state_dict(self) -> dict[str, dict[str, Tensor]]:
        """Return copies of the environments' whole state, without the policy.

        Another `TouchEnv` with the same document and number of environments continues from it, on a CPU bit for bit.
        """
        memory = self._memory() | {"touch": self.touch.state_dict(), "obs": self._obs}
        return _copied(memory) | {"sim": self.sim.state_dict(), "seed": {"seed": torch.tensor(self._draws.seed)}}

    def load_state_dict(self, state: Mapping[str, Mapping[str, Tensor]]) -> Observations:
        """Restore a state from environments with the same document and number; return its observations.

        Raises:
            SimulationError: If the state is from other environments; nothing is changed then.
        """
        expected = self._memory() | {"touch": self.touch.state_dict(), "obs": self._obs, "seed": {"seed": torch.tensor(0)}}
        _refuse_other(expected, {part: saved for part, saved in state.items() if part != "sim"})
        self.sim.load_state_dict(state.get("sim", {}))  # refuses another one's before it changes
        with torch.no_grad():
            for part, memory in self._memory().items():
                for name, value in memory.items():
                    value.copy_(state[part][name])
        self.touch.load_state_dict(dict(state["touch"]))
        self._draws.reseed(int(state["seed"]["seed"]))
        self._obs = {name: value.to(self.device, copy=True) for name, value in state["obs"].items()}
        self._instant = None
        return dict(self._obs)

    def close(self) -> None:
        """Release simulator and module; the environments cannot be used afterwards."""
        self.sim.close()

    def _memory(self) -> dict[str, dict[str, Tensor]]:
        """Return the memory outside simulation and module: live tensors by part and name."""
        setup, sums = self.task.setup, zip(self._terms, self._sums, strict=True)
        episodes = {"number": self.resets, "steps": self.steps, "total": self._return}
        episodes |= {"friction": setup.friction, "mass": setup.mass} | {f"sums/{name}": value for name, value in sums}
        memory = {"episodes": episodes, "actuation": self.actuation.memory(), "task": self.task.memory}
        memory["actions"] = {"used": self._used, "past": self._past}
        memory["speeds"] = self._speeds.memory if self._speeds else {}
        memory |= {"curricula": self.curricula.values, "events": self._events.memory}
        return {part: tensors for part, tensors in memory.items() if tensors or part == "task"}

    def _begin(self, chosen: Bool[Tensor, " env"]) -> None:
        self.resets += chosen
        self._events.reset(chosen, self.resets, is_placed=False)
        start = self.task.reset(chosen, self.resets)
        if not isinstance(start, Start):
            raise SimulationError(f"{type(self.task).__name__}: `reset` is a {type(start).__name__}, expected a Start")
        self.sim.reset(chosen, contacts=start.contacts, **start.values)
        self._restarted(chosen, "ctrl" in start.values)
        self._events.reset(chosen, self.resets, is_placed=True)
        self._used.masked_fill_(chosen[:, None], 0.0)
        self._past.masked_fill_(chosen[:, None, None], 0.0)

    def _restart(self, chosen: Bool[Tensor, " env"], at_controls: bool) -> None:
        self.actuation.reset(chosen, self.resets, at_controls)
        for counted in (self.steps, self._return, self._sums):
            counted.masked_fill_(chosen, 0)

    def _advance(self) -> tuple[Step, Now]:
        """Make one control step with the action that was copied, and return the instant at its end."""
        sim = self.sim
        with self._logic_by():
            self._past.copy_(torch.cat([self._used[:, None], self._past[:, :-1]], dim=1))
            control = self._commanded(self._action, sim.ctrl)
            self._events.advance()
        readings = self._step_physics(control)
        with self._logic_by():
            now = self._advance_task(readings)
            step = self._judged(now, sim.faults)
            if may_be_nonempty(step.info.ended):
                self._begin(step.info.ended)
                now = self._begin_instant(step.info.ended, sim.read(step.info.ended))
                step = step._replace(obs=self._observed(now))
            return step, now

    def _step_physics(self, control: Float[Tensor, "env nu"]) -> dict[str, Tensor]:
        if self._substeps is not None:
            return self._substeps.step(control)
        self.sim.step(control)
        return self.sim.read()

    def _advance_task(self, readings: dict[str, Tensor]) -> Now:
        """Update the task; return the instant at the end of a control step."""
        now = self._now(readings)
        if self._speeds:
            self._speeds.update(now.joint_pos)
        self.task.advance_healthy(now, self.sim.faults)
        return replace(now, score=self.task.score())

    def _begin_instant(self, chosen: Bool[Tensor, " env"], readings: dict[str, Tensor]) -> Now:
        now = self._now(readings)
        if self._speeds:
            self._speeds.begin(chosen, now.joint_pos)
        if self._substeps is not None:
            self._substeps.begin(chosen, readings)
        return now

    def _command(self, action: Float[Tensor, "env joint"], ctrl: Float[Tensor, "env nu"]) -> Float[Tensor, "env nu"]:
        """Set targets from an action; return the simulation's controls, NaN where an action is not finite."""
        action = action.to(self._used)
        is_bad = ~action.isfinite().all(dim=1)
        self.actuation.command(action)
        self._used.copy_(torch.where(is_bad[:, None], 0.0, action).clamp(-1.0, 1.0))
        return torch.where(is_bad[:, None], torch.nan, ctrl)

    def _judge(self, now: Now, faults: Bool[Tensor, " env"]) -> Step:
        """Return ends, rewards and observations of a control step before any reset, and accumulate rewards."""
        task, num = type(self.task).__name__, self.num_envs
        terminated = checked(f"{task}: `is_over`", self.task.is_over(now), num, dtype=torch.bool) | faults
        rates = self._rates(now, terminated)
        for name, term in self.curricula.terms.items():
            if isinstance(term, TerminationTerm):
                terminated = terminated | checked(
                    f'the term "{name}"', term.is_over(now, self.task.setup), num, dtype=torch.bool
                )
        earned = torch.where(faults, 0.0, torch.stack(list(rates.values())) * self.control_step).float()
        reward, terms = earned.sum(dim=0), dict(zip(rates, earned, strict=True))
        self._sums += earned
        self._return += reward
        self.steps += 1
        truncated = (self.steps >= self.max_steps) & ~terminated
        obs = self._observe(now)
        if may_be_nonempty(faults):
            obs = {name: torch.where(faults[:, None], 0.0, value) for name, value in obs.items()}
        sums = dict(zip(rates, self._sums.clone(), strict=True))
        score = checked(f"{task}: `score`", self.task.score(), num).float().clone()
        ended = terminated | truncated
        info = StepInfo(ended, obs, terms, score, self._return.clone(), self.steps.clone(), sums, faults.clone())
        return Step(obs, reward, terminated, truncated, info)

    def _rates(self, now: Now, terminated: Bool[Tensor, " env"]) -> dict[str, Float[Tensor, " env"]]:
        """Return the terms of the reward as rates, including the document's terms [1/s]."""
        task = type(self.task).__name__
        rates = {
            name: checked(f'{task}: the term "{name}" of `reward`', value, self.num_envs)
            for name, value in self.task.reward(now, terminated).items()
        }
        if not rates:
            raise SimulationError(f"{task}: `reward` has no terms, expected one at least")
        for name, term in self.curricula.terms.items():
            if isinstance(term, RewardTerm):
                if name in rates:
                    problem = f"the task's `reward` has a term \"{name}\" already: give the document's another name"
                    raise SimulationError(problem)
                rates[name] = checked(f'the term "{name}"', term.weight * term.rate(now, self.task.setup), self.num_envs)
        return rates

    def _now(self, readings: dict[str, Tensor]) -> Now:
        watched, none, num = self.sim.watched(), self._used[:, :0], self.num_actions
        distance = self._sensors.distance
        force, normal_force = self._sensors.forces(readings, self._used)
        return Now(
            watched=watched,
            object=watched.body(self._sensors.object),
            joint_pos=watched.joint_pos[:, :num],
            joint_vel=watched.joint_vel[:, :num],
            target=self.actuation.target,
            torque=watched.joint_effort[:, :num] if self.actuation.is_ideal else self.actuation.torque,
            action=self._used,
            past_actions=self._past,
            link_force=force,
            normal_force=normal_force,
            distance=readings[distance].amin(dim=2).to(none) if distance else none,
            friction=self.task.setup.friction,
            mass=self.task.setup.mass,
            readings=readings,
            time=self.sim.time,
            score=self.task.score(),
        )

    def _observe(self, now: Now) -> Observations:
        touch = self._sensors.observe(now.readings) if self._substeps is None else self._substeps.observe()
        measured = replace(now, joint_vel=self._speeds.value) if self._speeds else now
        count = (self.resets << 32) | self.steps
        proprio = groups.noisy_proprio(measured, self.spec.proprio, self._draws, count)
        result = {"proprio": proprio} | touch | {"priv_proprio": groups.priv_proprio(now)}
        task = type(self.task).__name__
        for name, term in self.curricula.terms.items():
            if isinstance(term, ObservationTerm):
                result[name] = checked(f'the term "{name}"', term.observe(now, self.task.setup), self.num_envs, 2)
        for name, value in self.task.observe(now).items():
            if name in result:
                raise SimulationError(f'{task}: `observe` has a group "{name}", as all tasks do; call it otherwise')
            result[name] = checked(f'{task}: the group "{name}" of `observe`', value, self.num_envs, 2)
        return {name: value.to(self.device, torch.float32) for name, value in result.items()}


def _refuse_other(current: Mapping[str, Mapping[str, Tensor]], other: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Raise `SimulationError` if parts, names or shapes differ from the saved state."""
    expected, saved = (
        {f"{part} {name}": value.shape for part, tensors in state.items() for name, value in tensors.items()}
        for state in (current, other)
    )
    if wrong := [name for name in {**expected, **saved} if expected.get(name) != saved.get(name)]:
        problem = f"{listed(wrong)} missing, not known or of another shape"
        raise SimulationError(f"the state that was saved is of other environments: {problem}")


def _copied(value: Any) -> Any:
    """Return copies of all tensors in dictionaries and named tuples: a graph overwrites its outputs at the next replay."""
    if isinstance(value, Tensor):
        return value.clone()
    if isinstance(value, Mapping):
        return {name: _copied(part) for name, part in value.items()}
    return type(value)(*(_copied(part) for part in value))
