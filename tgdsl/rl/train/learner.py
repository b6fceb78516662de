"""Environments and the algorithm that learns in them, iteration by iteration: rollout, and update.

rsl_rl's `OnPolicyRunner` does this too, but waits for the device at every control step (its logger looks which episodes have
ended, its check for NaN at all observations), and saves by iterations. This loop is short, and waits once per iteration.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict
from torch import Tensor

from tgdsl.rl.adapters.rsl_rl import TouchVecEnv
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.onnx_policy import write_onnx_policy
from tgdsl.rl.playing.policy import card_texts, write_policy
from tgdsl.rl.playing.rollout import Moment
from tgdsl.rl.train.config import config
from tgdsl.rl.train.iteration import Iteration, Learning
from tgdsl.rl.train.ppo import LOSSES, CapturedPPO
from tgdsl.rl.train.ranks import Ranks
from tgdsl.tensors.env_ids import may_be_nonempty


class Learner(Learning):
    """Learns a policy by PPO, `algorithm`."""

    rates = "train.learning_rate or train.desired_kl"

    def __init__(self, env: TouchEnv, loaded: LoadedTask, seed: int, ranks: Ranks | None = None):
        """Make the networks; torch's own random generators are seeded."""
        train = self._train = loaded.spec.train
        super().__init__(env, ranks or Ranks(), train.steps, train.desynchronise)
        self._score: float | None = None  # of the episodes that have ended last
        settings = config(loaded, env.groups, self.ranks.rsl_rl)
        self.groups = settings["obs_groups"]
        self._names = list(dict.fromkeys(name for names in self.groups.values() for name in names))
        torch.manual_seed(seed)
        vec_env = TouchVecEnv(env)
        kind: Any = resolve_callable(settings["algorithm"]["class_name"])
        with contextlib.redirect_stdout(io.StringIO()):  # the networks, printed
            self.algorithm: CapturedPPO = kind.construct_algorithm(
                self._seen(dict(vec_env.get_observations())), vec_env, settings, str(env.device)
            )
        if self.ranks.size > 1:
            self.algorithm.broadcast_parameters()
        torch.manual_seed(seed * self.ranks.size + self.ranks.rank)

    def __call__(self, obs: Mapping[str, Tensor]) -> Tensor:
        return self.algorithm.act(self._seen(obs))

    def iterate(self, share: float = 0.0) -> Iteration:
        """Make a rollout, and learn from it; `share` changes nothing: the rate adapts to the policy, or stays."""
        self.env.curricula.advance(self.iteration, self._score)
        result = super().iterate(share)
        self._score = result.metrics.get("Episode/score", self._score)
        return result

    def state_dict(self) -> dict[str, Any]:
        algorithm = self.algorithm
        steps = algorithm.rnd.update_counter if algorithm.rnd else 0
        return {"algorithm": algorithm.save(), "rnd_steps": steps, "score": self._score}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what was saved: see `Learning`. RND that was off until then begins again."""
        self._score = state.get("score")
        saved, has_rnd = dict(state["algorithm"]), "rnd_state_dict" in state["algorithm"]
        self.algorithm.load(saved, dict.fromkeys(("actor", "critic", "optimizer", "iteration"), True) | {"rnd": has_rnd}, True)
        if self.algorithm.rnd and has_rnd:
            self.algorithm.rnd.update_counter = state["rnd_steps"]

    @property
    def std(self) -> list[float] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        std = dict(self.algorithm.actor.named_parameters()).get("distribution.std_param")
        return None if std is None else std.tolist()

    def write_policy(self, card: Mapping[str, Any], file: Path) -> None:
        """Write the policy without exploration, as TorchScript and ONNX, and its card beside it as JSON, for people."""
        policy: Any = self.algorithm.get_policy()
        texts = card_texts(self.env.touch, card)
        write_policy(policy.as_jit(), texts, file)
        write_onnx_policy(policy.as_onnx(verbose=False), texts, file.with_suffix(".onnx"))

    def change_rates(self, before: Mapping[str, Any]) -> None:
        """Take over the document's learning rates, once a state was loaded; one that adapts only if the document had another.

        `before` is the document's `train` with which the state was saved, as plain values.
        """
        train = self._train
        if not train.adaptive or before.get("learning_rate", train.learning_rate) != train.learning_rate:
            self.algorithm.learning_rate = train.learning_rate
        if self.algorithm.rnd and train.rnd != "off":
            for group in self.algorithm.rnd.optimizer.param_groups:
                group["lr"] = train.rnd.learning_rate

    def _start_rollout(self) -> None:
        self.algorithm.train_mode()

    def _keep(self, moment: Moment) -> None:
        step, extras = moment.step, dict[str, Any](time_outs=moment.step.truncated)
        if may_be_nonempty(step.truncated):
            extras["final_obs"] = self._seen(step.info.final_obs)
        self.algorithm.process_env_step(self._seen(step.obs), step.reward, step.info.ended, extras)

    def _update(self) -> None:
        self.algorithm.compute_returns(self._seen(self.env.observe()))
        self.algorithm.update()

    def _numbers(self) -> dict[str, Tensor]:
        algorithm = self.algorithm
        losses = {f"Loss/{name}": loss for name, loss in zip(LOSSES, algorithm.losses, strict=True)}
        std, reward = algorithm.actor.output_std.mean(), algorithm.storage.rewards.mean()
        return losses | {"Loss/learning_rate": algorithm.rate, "Policy/mean_std": std, "Train/reward_per_step": reward}

    def _seen(self, obs: Mapping[str, Tensor]) -> TensorDict:
        return TensorDict({name: obs[name] for name in self._names}, [self.env.num_envs])
