"""A task's environments on the live page: an actor acts, and reward terms are shown with the touch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from tgdsl.rl.env import TouchEnv
from tgdsl.rl.playing.rollout import Actor, Moment, rollout
from tgdsl.view.stages import Observed, SimStage, Slider, Stage

Array = np.ndarray


class _ByHand(Actor):
    """Acts as another actor does, or as a stage's `control` where that is `by_hand`."""

    def __init__(self, actor: Actor, stage: Stage):
        self._actor, self._stage = actor, stage

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        action = self._actor(obs)
        return torch.as_tensor(self._stage.control).to(action).expand_as(action) if self._stage.by_hand else action

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        self._actor.begin(ended)


class TaskStage(SimStage):
    """Environments of a task in which an actor acts, episode after episode; `control` is an action, from -1 to 1."""

    by_hand: bool | None = False

    def __init__(self, env: TouchEnv, actor: Actor, seed: int):
        super().__init__(env.touch, env.sim)
        self.env, self._seed, self.groups = env, seed, tuple(env.groups)
        self._actor, self._features = _ByHand(actor, self), env.describe()
        self.control, self.control_step = np.zeros(env.num_actions), env.control_step
        self.restart()

    def restart(self) -> None:
        """Begin the first episode of all environments again."""
        self.env.reset(self._seed)
        self._actor.begin(torch.ones(self.num_envs, dtype=torch.bool, device=self.env.sim.qpos.device))
        self._moments = rollout(self._actor, self.env)
        self._moment: Moment | None = None
        self.time, self.readings = 0.0, self.env.now.readings

    def advance(self) -> None:
        """Let the actor act once."""
        self._moment = next(self._moments)
        self.time += self.control_step
        self.readings = self.env.now.readings

    @property
    def sliders(self) -> Sequence[Slider]:
        """The actions of the joints that the policy moves."""
        return [Slider(name, -1.0, 1.0) for name in self.env.joint_names]

    def acted(self, env: int) -> Float[Array, " joint"] | None:
        """Return the last action of one environment."""
        return None if self._moment is None else self._moment.action[env].cpu().numpy()

    def observed(self, group: str, env: int) -> Sequence[Observed]:
        """Return what the next action is chosen from in one environment."""
        values = self.env.observe()[group][env].cpu().numpy()
        return [
            Observed(f"{each.name}{f' of {each.link}' if each.link else ''}", each.unit, values[place])
            for place, each in self._features[group]
        ]

    def notes(self, env: int) -> Mapping[str, float]:
        """Return the score, and each reward term of this step [1/s]."""
        if self._moment is None:
            return {}
        info = self._moment.step.info
        terms = {name: float(value[env]) / self.control_step for name, value in info.terms.items()}
        return {f"score [{self.env.task.score_unit}]": float(info.score[env]), **terms}

    def close(self) -> None:
        """Release the simulator."""
        self.env.close()


class LearnerStage(TaskStage):
    """Environments that a learner steps; `keep` takes each control step."""

    def __init__(self, env: TouchEnv):
        SimStage.__init__(self, env.touch, env.sim)
        self.env, self.control_step, self.readings = env, env.control_step, env.now.readings
        self._moment = None

    def keep(self, moment: Moment) -> None:
        """Take a control step that was just made."""
        self._moment, self.readings = moment, self.env.now.readings
        self.time += self.control_step

    def advance(self) -> None:
        """Leave the environments to the learner."""

    def restart(self) -> None:
        """Leave the environments to the learner."""
