"""Environments and the algorithm that learns in them, iteration by iteration: rollout, and update.

rsl_rl's `OnPolicyRunner` does this too, but waits for the device at every control step (its logger looks which episodes have
ended, its check for NaN at all observations), and saves by iterations. This loop waits once per iteration.

Shapes: `env` environments.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from jaxtyping import Int
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict
from torch import Tensor

from tgdsl.errors import SpecError, listed
from tgdsl.rl.adapters.rsl_rl import TouchVecEnv
from tgdsl.rl.env import Step, TouchEnv
from tgdsl.rl.load import LoadedTask, train_groups, wrong_groups
from tgdsl.rl.playing.policy import PolicyError, PolicyFile, card_texts, policy_for, write_onnx_policy, write_policy
from tgdsl.rl.playing.rollout import Actor, Moment, rollout
from tgdsl.rl.sensors import GROUP
from tgdsl.rl.train.model import UNTIL, EncodedModel, Exported, actor_weights
from tgdsl.rl.train.ppo import LOSSES, CapturedPPO
from tgdsl.rl.train.ranks import Ranks, add_up
from tgdsl.tensors.env_ids import may_be_nonempty

EPISODE_NAMES = ("Episode/return", "Episode/steps", "Episode/score", "Episode/dropped", "Episode/fault")
"""Numbers of a finished episode, before its terms: return, steps, score, whether it ended for good, and by a fault."""
ORIGIN_KEYS = ("task", "overrides", "seed", "processes", "device", "module", "taxels", "sensors", "scene", "versions", "spec")
"""Entries of a run's origin that a policy's card has."""


class EpisodeTally:
    """Sums over finished episodes; `names` are set at the first control step."""

    def __init__(self):
        self.names: list[str] = []
        self._sums: Tensor | None = None

    def add(self, step: Step) -> None:
        """Add a control step, without waiting for the device."""
        info = step.info
        numbers = [info.episode_return, info.episode_steps, info.score, step.terminated, info.faults]
        values = torch.stack([info.ended.double(), *(each.double() for each in (*numbers, *info.episode_terms.values()))])
        sums = torch.where(info.ended, values, 0.0).sum(dim=1)
        if self._sums is None:
            self.names = [*EPISODE_NAMES, *(f"Reward/{name}" for name in info.episode_terms)]
            self._sums = torch.zeros_like(sums)
        self._sums += sums

    def pop(self) -> Tensor:
        """Return the sums over all processes, the number of episodes first, and restart; the host does not wait."""
        assert self._sums is not None
        sums = self._sums.clone()
        add_up(sums)
        self._sums.zero_()
        return sums

    def means(self, sums: list[float]) -> dict[str, float]:
        """Return means over episodes by name, from the sums of `pop`; none if no episode has ended."""
        count = sums[0]
        return {name: total / count for name, total in zip(self.names, sums[1:], strict=True)} if count else {}


@dataclass(frozen=True)
class Iteration:
    """An iteration, over all processes."""

    episodes: int  # how many episodes ended
    metrics: dict[str, float]
    """Means over these episodes, and the learner's numbers, by the names that TensorBoard groups: `Episode/score`."""
    rollout: float  # duration of the rollout [s]
    update: float  # duration of the update [s]


class Learning(Actor):
    """Environments and a learner in them, iteration by iteration: a rollout in which it acts, and an update.

    On a GPU the host waits once per iteration, except for captures in the first ones. `groups` are the groups of observations
    of each network, `samples` the control steps so far, over all processes and environments.
    """

    rates: ClassVar[str]  # keys of the document that make smaller steps
    groups: dict[str, list[str]]
    std: list[float] | None = None  # standard deviation of its actions
    on_step: Callable[[Moment], None] | None = None  # called after each control step

    def __init__(self, env: TouchEnv, ranks: Ranks, steps: int, desynchronise: bool = True):
        self.env, self.ranks, self.iteration, self.samples = env, ranks, 0, 0
        self._num_steps, self._desynchronise, self._has_begun = steps, desynchronise, False
        self._tally = EpisodeTally()

    @property
    def episode_names(self) -> list[str]:
        """Numbers of the episodes that ended, from iterations in which any did."""
        return self._tally.names

    def iterate(self, share: float = 0.0) -> Iteration:
        """Make a rollout, and learn from it; `share` is the finished share of the run, 0 to 1."""
        self.set_rate(share)
        self.roll()
        start, middle = self._roll_start, self._mark()
        self.learn()
        sums, numbers = self._tally.pop(), self._numbers()
        values = torch.cat([sums, torch.stack(list(numbers.values())).double().to(sums.device)]).tolist()  # here the host waits
        end = self._mark()
        if self.env.device.type == "cuda":
            end.synchronize()
            durations = 1e-3 * start.elapsed_time(middle), 1e-3 * middle.elapsed_time(end)
        else:
            durations = middle - start, end - middle
        pairs = zip(numbers, values[len(sums) :], strict=True)
        metrics = {name: value for name, value in pairs if not (name.startswith("Score/") and math.isnan(value))}
        return Iteration(round(values[0]), self._tally.means(values[: len(sums)]) | metrics, *durations)

    def set_rate(self, share: float) -> None:
        """Set the learning rate for the finished share of the run; by default it is constant."""

    def roll(self) -> None:
        """Make a rollout."""
        if not self._has_begun:
            self.go_on(torch.randint_like(self.env.steps, self.env.max_steps) if self._desynchronise else None)
        self._start_rollout()
        self._roll_start = self._mark()
        for moment in rollout(self, self.env, self._num_steps):
            self._keep(moment)
            self._tally.add(moment.step)
            if self.on_step is not None:
                self.on_step(moment)

    def learn(self) -> None:
        """Learn from the rollout."""
        self._update()
        self.iteration += 1
        self.samples += self._num_steps * self.env.num_envs * self.ranks.size

    def go_on(self, steps: Int[Tensor, " env"] | None = None) -> None:
        """Begin episodes, at given numbers of control steps; default: 0."""
        self.env.reset()
        if steps is not None:
            self.env.steps.copy_(steps)
        self.go_on_here()

    def go_on_here(self) -> None:
        """Continue from the environments' present state, with an empty memory of their episodes."""
        self._has_begun = True
        self.begin(torch.ones(self.env.num_envs, dtype=torch.bool, device=self.env.device))

    def card(
        self, origin: Mapping[str, Any], seconds: float, command: str, groups: Mapping[str, int] | None = None
    ) -> dict[str, Any]:
        """Return the card of a policy, as plain values."""
        return {
            "groups": dict(groups or {name: self.env.groups[name] for name in self.groups["actor"]}),
            "joints": list(self.env.joint_names),
            "iterations": self.iteration,
            "samples": self.samples,
            "minutes": round(seconds / 60.0, 2),
            "command": command,
            "score": None,
            **{name: origin[name] for name in ORIGIN_KEYS},
            "std": self.std,
        }

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the learned state, and all that resuming needs."""

    @abstractmethod
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a saved state; it may hold more than `state_dict` returned."""

    def _mark(self) -> Any:
        """Return the time; on a GPU as an event, without synchronising."""
        if self.env.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event

    def _start_rollout(self) -> None:
        """Prepare for a rollout."""

    @abstractmethod
    def _keep(self, moment: Moment) -> None:
        """Store a control step of the rollout."""

    @abstractmethod
    def _update(self) -> None:
        """Learn from the rollout."""

    @abstractmethod
    def _numbers(self) -> dict[str, Tensor]:
        """Return the learner's numbers of the iteration, on the device; a score without episodes is NaN."""


PROPRIO, STATE, PROPS = "proprio", "priv_obj_state", "priv_obj_props"
"""Groups of the hand's joints; of the object's motion; of its properties."""
MOST_STD = 1e6  # bound above of the actions' standard deviation: rsl_rl's
CRITIC_FIRST = 25  # iterations in which only the critic learns, after a start from a policy
STD = "distribution.std_param"  # name of the actions' deviations among an actor's weights
SAME_ACTIONS = 1e-3  # largest difference between the actions of a policy and of the network that took over its weights

PPO_OPTIONS = {
    "num_learning_epochs": "epochs",
    "num_mini_batches": "mini_batches",
    "clip_param": "clip",
    "gamma": "discount",
    "lam": "gae",
    "value_loss_coef": "value",
    "entropy_coef": "entropy",
    "learning_rate": "learning_rate",
    "max_grad_norm": "max_grad_norm",
    "use_clipped_value_loss": "clip_values",
    "desired_kl": "desired_kl",
    "precision": "precision",
}
"""Numbers of `train` by rsl_rl's names."""


def observed(loaded: LoadedTask, groups: Mapping[str, int]) -> dict[str, list[str]]:
    """Return the groups of observations of actor, critic and, if there is one, random network distillation."""
    train = loaded.spec.train
    empty = [name for name, size in groups.items() if size == 0]
    if problems := wrong_groups(loaded.source, train_groups(loaded.spec), groups, empty):
        raise SpecError(problems)
    privileged = [name for name in groups if name not in (PROPRIO, GROUP)]
    actor = list(train.actor or [name for name in privileged if name != PROPS])
    result = {"actor": actor, "critic": list(train.critic or privileged)}
    if train.rnd != "off":
        result["rnd_state"] = list(train.rnd.groups or ([STATE] if STATE in groups else actor))
    return result


def config(loaded: LoadedTask, groups: Mapping[str, int], multi_gpu: Mapping[str, int] | None = None) -> dict[str, Any]:
    """Return rsl_rl's configuration, for `PPO.construct_algorithm` or an `OnPolicyRunner`."""
    train, networks = loaded.spec.train, loaded.spec.train.networks
    encoders = {GROUP: networks.touch_encoder, "*": networks.encoder}
    normalisation = {"eps": networks.eps, "clip": networks.clip}
    model = normalisation | {
        "class_name": "tgdsl.rl.train.model:EncodedModel",
        "hidden_dims": list(networks.hidden),
        "activation": "elu",
        "obs_normalization": True,
        "encoders": {name: {"hidden": list(spec.hidden), "size": spec.size} for name, spec in encoders.items()},
    }
    gaussian = {"class_name": "tgdsl.rl.train.model:Gaussian", "init_std": networks.initial_std}
    algorithm = {name: getattr(train, key) for name, key in PPO_OPTIONS.items()}
    algorithm |= {"class_name": "tgdsl.rl.train.ppo:CapturedPPO", "schedule": "adaptive" if train.adaptive else "fixed"}
    rnd = None
    if train.rnd != "off":
        rnd = normalisation | {
            "weight": train.rnd.weight,
            "num_outputs": train.rnd.outputs,
            "predictor_hidden_dims": list(train.rnd.predictor),
            "target_hidden_dims": list(train.rnd.target),
            "state_normalization": True,
            "reward_normalization": True,
            "learning_rate": train.rnd.learning_rate,
        }
    return {
        "num_steps_per_env": train.steps,
        "save_interval": 1000,
        "obs_groups": observed(loaded, groups),
        "actor": model | {"distribution_cfg": gaussian | {"std_range": (networks.min_std, MOST_STD)}},
        "critic": dict(model),
        "algorithm": algorithm | {"rnd_cfg": rnd},
        "multi_gpu": None if multi_gpu is None else dict(multi_gpu),
    }


class Learner(Learning):
    """Learns a policy by PPO, `algorithm`."""

    rates = "train.learning_rate or train.desired_kl"

    def __init__(self, env: TouchEnv, loaded: LoadedTask, seed: int, ranks: Ranks | None = None):
        """Make the networks; torch's own random generators are seeded."""
        train = self._train = loaded.spec.train
        super().__init__(env, ranks or Ranks(), train.steps, train.desynchronise)
        self._score: float | None = None  # of the episodes that have ended last
        self._critic_until = 0  # iteration until which only the critic learns
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
        """Make a rollout, and learn from it; `share` has no effect: the rate adapts to the policy, or is constant."""
        self.env.curricula.advance(self.iteration, self._score)
        actor = self.algorithm.actor.parameters() if self.iteration < self._critic_until else ()
        kept = [(part, part.detach().clone()) for part in actor]
        result = super().iterate(share)
        with torch.no_grad():
            for part, before in kept:
                part.copy_(before)
        self._score = result.metrics.get("Episode/score", self._score)
        return result

    def state_dict(self) -> dict[str, Any]:
        algorithm = self.algorithm
        steps = algorithm.rnd.update_counter if algorithm.rnd else 0
        numbers = {"rnd_steps": steps, "score": self._score, "critic_until": self._critic_until}
        return {"algorithm": algorithm.save()} | numbers

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a saved state: see `Learning`. RND that was off until then starts from scratch."""
        self._score, self._critic_until = state.get("score"), state.get("critic_until", 0)
        saved, has_rnd = dict(state["algorithm"]), "rnd_state_dict" in state["algorithm"]
        self.algorithm.load(saved, dict.fromkeys(("actor", "critic", "optimizer", "iteration"), True) | {"rnd": has_rnd}, True)
        if self.algorithm.rnd and has_rnd:
            self.algorithm.rnd.update_counter = state["rnd_steps"]

    @property
    def std(self) -> list[float] | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        std = dict(self.algorithm.actor.named_parameters()).get(STD)
        return None if std is None else std.tolist()

    def start_from(self, saved: PolicyFile) -> None:
        """Take over a policy's weights and deviations; only the critic learns in the first `CRITIC_FIRST` iterations.

        Raises:
            PolicyError: If it does not fit the environments, or its network has other groups, sizes or layers.
        """
        policy, actor = policy_for(self.env, saved), cast(EncodedModel, self.algorithm.actor)
        if list(policy.groups) != self.groups["actor"]:
            hint = f"try --set train.actor={json.dumps(list(policy.groups))}"
            raise PolicyError(f"{saved.file}: learned from {listed(policy.groups)}, not {listed(self.groups['actor'])}; {hint}")
        weights = {name: value for name, value in actor.state_dict().items() if name.startswith("distribution.")}
        weights |= actor_weights(saved.module(self.env.device), (saved.card or {}).get("samples", UNTIL))
        if policy.std is not None and STD in weights:
            weights[STD] = policy.std
        try:
            actor.load_state_dict(weights)
        except RuntimeError as error:
            problem = str(error).splitlines()[1].strip()
            raise PolicyError(f"{saved.file}: its network is not that of train.networks: {problem}") from error
        obs = self.env.observe()
        x = torch.cat([obs[name] for name in policy.groups], dim=1).float()
        with torch.no_grad():
            apart = float((Exported(actor)(x.to(self.env.device)) - policy(obs)).abs().max())
        if not apart <= SAME_ACTIONS:
            hint = "a student normalises by train.networks.eps=1e-5 and train.networks.clip=10"
            raise PolicyError(f"{saved.file}: with its weights, train.networks acts otherwise, by up to {apart:.2g}; {hint}")
        self._critic_until = self.iteration + CRITIC_FIRST

    def write_policy(self, card: Mapping[str, Any], file: Path) -> None:
        """Write the policy without exploration, as TorchScript and ONNX, and its card as a readable JSON file."""
        policy: Any = self.algorithm.get_policy()
        texts = card_texts(self.env.touch, card)
        write_policy(policy.as_jit(), texts, file)
        write_onnx_policy(policy.as_onnx(verbose=False), texts, file.with_suffix(".onnx"))

    def change_rates(self, before: Mapping[str, Any]) -> None:
        """Set the document's learning rates after a state was loaded; an adaptive one only if the document changed it.

        `before` is the saved document's `train`, as plain values.
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
