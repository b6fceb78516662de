"""Environments and the algorithm that learns in them, iteration by iteration: rollout, and update.

rsl_rl's `OnPolicyRunner` does this too, but waits for the device at every control step (its logger looks which episodes have
ended, its check for NaN at all observations), and saves by iterations. This loop is short, and waits once per iteration.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from tgdsl.rl.adapters.rsl_rl import TouchVecEnv
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.train.config import config
from tgdsl.rl.train.iteration import Clock, EpisodeTally, Iteration
from tgdsl.rl.train.ppo import LOSSES, CapturedPPO
from tgdsl.rl.train.ranks import Ranks
from tgdsl.tensors.env_ids import may_be_nonempty


class Learner:
    """Learns a policy.

    Attributes:
        env: The environments.
        algorithm: PPO.
        groups: Groups of observations of actor, critic and random network distillation.
        iteration: Number of iterations so far.
        samples: How many control steps these took, over all processes and environments.
    """

    rates = "train.learning_rate or train.desired_kl"
    """What of the document makes smaller steps."""

    def __init__(self, env: TouchEnv, loaded: LoadedTask, seed: int, ranks: Ranks | None = None):
        """Make the networks; torch's own random generators are seeded.

        Args:
            env: The environments of this process.
            loaded: Their task's document.
            seed: What the networks' first weights and the actions follow from.
            ranks: The processes.

        Raises:
            SpecError: If a group of observations that is named is not there.
        """
        self.env, self.ranks = env, ranks or Ranks()
        self.iteration = self.samples = 0
        self._score: float | None = None  # of the episodes that have ended last
        self._train, self._tally, self._is_begun = loaded.spec.train, EpisodeTally(), False
        settings = config(loaded, env.groups, self.ranks.rsl_rl)
        self.groups: dict[str, list[str]] = settings["obs_groups"]
        self._names = list(dict.fromkeys(name for names in self.groups.values() for name in names))
        torch.manual_seed(seed)
        self.algorithm = self._algorithm(settings)
        if self.ranks.size > 1:
            self.algorithm.broadcast_parameters()
        torch.manual_seed(seed * self.ranks.size + self.ranks.rank)
        self._clock = Clock(env.device)

    def iterate(self, share: float = 0.0) -> Iteration:
        """Make a rollout, and learn from it; `share` changes nothing: the rate adapts to the policy, or stays."""
        self.env.curricula.advance(self.iteration, self._score)
        self.roll()
        self.learn()
        numbers = self._told()
        self._score = numbers.told.get("Episode/score", self._score)
        return numbers

    @property
    def episode_names(self) -> list[str]:
        """Numbers of the episodes that ended, from iterations in which any did."""
        return self._tally.names

    def roll(self) -> None:
        """Make a rollout; the host does not wait for a GPU, but for captures at the first calls."""
        obs, algorithm = self._begin(), self.algorithm
        self._clock.start()
        for _ in range(self._train.steps):
            step = self.env.step(algorithm.act(obs))
            obs = self._seen(step.obs)
            extras: dict[str, Any] = {"time_outs": step.truncated}
            if may_be_nonempty(step.truncated):
                extras["final_obs"] = self._seen(step.info.final_obs)
            algorithm.process_env_step(obs, step.reward, step.info.ended, extras)
            self._tally.add(step)
        self._obs = obs
        self._clock.split()

    def learn(self) -> None:
        """Learn from the rollout; the same."""
        self.algorithm.compute_returns(self._obs)
        self.algorithm.update()
        self.iteration += 1
        self.samples += self._train.steps * self.env.num_envs * self.ranks.size

    def _told(self) -> Iteration:
        """Return what the last iteration was: the host waits for the device here, and only here."""
        algorithm, sums = self.algorithm, self._tally.taken()
        std, reward = algorithm.actor.output_std.mean(), algorithm.storage.rewards.mean()
        statistics = torch.stack([*algorithm.losses, algorithm.rate, std, reward]).double()
        numbers = torch.cat([sums, statistics.to(sums.device)]).tolist()
        rollout, update = self._clock.stop()
        names = [*(f"Loss/{name}" for name in LOSSES), "Loss/learning_rate", "Policy/mean_std", "Train/reward_per_step"]
        also = dict(zip(names, numbers[len(sums) :], strict=True))
        return Iteration(round(numbers[0]), self._tally.means(numbers[: len(sums)]) | also, rollout, update)

    def state_dict(self) -> dict[str, Any]:
        """Return what is learned, and what learning goes on from, as plain values and tensors."""
        algorithm = self.algorithm
        steps = algorithm.rnd.update_counter if algorithm.rnd else 0
        return {"algorithm": algorithm.save(), "rnd_steps": steps, "score": self._score}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what was saved; it may hold more than `state_dict` returned. RND that was off until then begins again.

        Raises:
            RuntimeError: If networks are of other sizes; also ValueError and KeyError.
        """
        self._score = state.get("score")
        saved, has_rnd = dict(state["algorithm"]), "rnd_state_dict" in state["algorithm"]
        self.algorithm.load(saved, dict.fromkeys(("actor", "critic", "optimizer", "iteration"), True) | {"rnd": has_rnd}, True)
        if self.algorithm.rnd and has_rnd:
            self.algorithm.rnd.update_counter = state["rnd_steps"]

    def change_rates(self, before: Mapping[str, Any]) -> None:
        """Take over the document's learning rates, once a state was loaded; one that adapts only if the document had another.

        Args:
            before: The document's `train` with which the state was saved, as plain values.
        """
        train_spec = self._train
        if not train_spec.adaptive or before.get("learning_rate", train_spec.learning_rate) != train_spec.learning_rate:
            self.algorithm.learning_rate = train_spec.learning_rate
        if self.algorithm.rnd and train_spec.rnd != "off":
            for group in self.algorithm.rnd.optimizer.param_groups:
                group["lr"] = train_spec.rnd.learning_rate

    def go_on(self, steps: torch.Tensor) -> None:
        """Begin episodes that count as having lasted so many control steps, in place of any at random."""
        self._obs = self._seen(self.env.reset())
        self.env.steps.copy_(steps)
        self._is_begun = True

    def _begin(self) -> TensorDict:
        """Return the observations to act on; at the first call, begin to learn."""
        if not self._is_begun:
            self._is_begun = True
            self._obs = self._seen(self.env.reset())
            if self._train.desynchronise:
                self.env.steps.copy_(torch.randint_like(self.env.steps, self.env.max_steps))
        self.algorithm.train_mode()
        return self._obs

    def _seen(self, obs: dict[str, torch.Tensor]) -> TensorDict:
        """Return the groups that somebody looks at."""
        return TensorDict({name: obs[name] for name in self._names}, [self.env.num_envs])

    def _algorithm(self, wanted: dict[str, Any]) -> CapturedPPO:
        env = TouchVecEnv(self.env)
        kind: Any = resolve_callable(wanted["algorithm"]["class_name"])
        with contextlib.redirect_stdout(io.StringIO()):  # the networks, printed
            algorithm = kind.construct_algorithm(self._seen(dict(env.get_observations())), env, wanted, str(self.env.device))
        return algorithm
