"""rsl_rl's PPO without synchronisation in rollout and update, both captured as CUDA graphs on a GPU.

`class_name: tgdsl.rl.train.ppo:CapturedPPO` gives it to rsl_rl. It does what rsl_rl 5.5's own PPO does, with these
departures: the learning rate is a tensor on the device; `torch.autograd.grad` writes gradients into one buffer; updates draw no
actions; several processes normalise advantages by the mean and deviation of all of them. At a time limit the return bootstraps
from the value of the final observations, V(o_T), if they are given; rsl_rl bootstraps from the value before the last step.

Shapes: `env` environments, `joint` joints that the policy moves, `row` rows of a mini-batch.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import Distribution
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor, nn

from tgdsl.errors import TgdslError
from tgdsl.rl.train.graphs import Captured
from tgdsl.rl.train.model import Distillation, Gaussian
from tgdsl.rl.train.ranks import add_up, num_processes
from tgdsl.tensors.torch_internals import copy_each

LEAST_RATE, MOST_RATE, RATE_FACTOR = 1e-5, 1e-2, 1.5  # bounds of the adaptive learning rate, and factor of its steps: rsl_rl's
LOSSES = ("value", "surrogate", "entropy", "rnd")


class CapturedPPO(PPO):
    """rsl_rl's PPO, captured; `losses` are means of the last update by `LOSSES`."""

    def __init__(
        self,
        actor: MLPModel,
        critic: MLPModel,
        storage: RolloutStorage,
        *,
        learning_rate: float = 1e-3,
        device: str = "cpu",
        rnd_cfg: dict[str, Any] | None = None,
        precision: str = "tf32",
        **options: Any,
    ):
        """Make the algorithm; raise `TgdslError` if an option cannot be captured."""
        _refuse(actor, critic, options)
        rows, parts = storage.num_envs * storage.num_transitions_per_env, options.get("num_mini_batches", 1)
        if rows < max(2, parts):
            problem = f"{storage.num_transitions_per_env} steps in {storage.num_envs} environments are {rows} rows of a rollout"
            raise TgdslError(f"{problem}, expected at least {max(2, parts)}: train.mini_batches is {parts}")
        kind = next(actor.parameters()).dtype
        self.rate = torch.zeros((), dtype=torch.float32 if torch.device(device).type == "cuda" else kind, device=device)
        super().__init__(actor, critic, storage, learning_rate=learning_rate, device=device, rnd_cfg=None, **options)
        if rnd_cfg is not None:
            self.rnd = Distillation(storage.num_envs, device=device, **rnd_cfg)
        self._collect_gradients()
        self.losses = torch.zeros(len(LOSSES), dtype=kind, device=device)
        self._kl = self._flat[-1:]
        self._rows = rows // self.num_mini_batches
        self._order = torch.zeros(self._rows * self.num_mini_batches, dtype=torch.int64, device=device)
        self._obs = storage.observations[0].clone()
        is_cuda, tf32 = self._flat.is_cuda, precision != "float32"
        self._autocast = {"device_type": "cuda", "dtype": torch.bfloat16, "enabled": is_cuda and precision == "bfloat16"}
        self._chosen = Captured(self._choose, device, tf32)
        self._valued = Captured(self._final_value, device, tf32)
        is_alone = not self.is_multi_gpu  # else all processes join in it
        self._rnd_graph = Captured(lambda: self.rnd.prediction_error(self._obs), device, tf32, is_captured=is_alone)
        self._returned = Captured(self._returns, device, tf32)
        self._learned = Captured(self._epoch, device, tf32)
        self._parts = [Captured(lambda i=i: self._differentiate(i), device, tf32) for i in range(self.num_mini_batches)]
        self._applied = Captured(self._take_step, device)

    @property
    def learning_rate(self) -> float:
        """The learning rate; to read it waits for the device."""
        return float(self.rate)

    @learning_rate.setter
    def learning_rate(self, rate: float | Tensor) -> None:
        self.rate.fill_(rate)

    def act(self, obs: TensorDict) -> Tensor:
        """Draw actions, (env, joint), and store their transition; they are valid until the next call."""
        self._see(obs)
        transition = self.transition
        transition.actions, transition.values, transition.actions_log_prob, transition.distribution_params = self._chosen()
        self._value, transition.hidden_states = transition.values, (None, None)
        transition.observations = self._obs
        return transition.actions

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]) -> None:
        """Store the results of a control step: see rsl_rl."""
        transition = self.transition
        reward = rewards.clone()
        transition.dones = dones
        if self.rnd is not None or "final_obs" in extras:
            transition.observations = self._obs.clone()
        if "final_obs" in extras:
            self._see(extras["final_obs"])
            self._value = self._valued()
        if "time_outs" in extras:
            reward += self.gamma * self._value[:, 0] * extras["time_outs"]
        if self.rnd is not None:
            self._see(obs)
            self.intrinsic_rewards = self._rnd_graph() * self.rnd.next_weight()
            reward += self.intrinsic_rewards
        transition.rewards = reward
        self.storage.add_transition(transition)
        transition.clear()

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages of the rollout; advantages are normalised over all processes."""
        self._see(obs)
        self._returned()
        with torch.no_grad():
            advantages = self.storage.advantages
            num = advantages.numel() * num_processes()
            mean = advantages.sum()
            add_up(mean)
            advantages -= mean / num
            squares = advantages.square().sum()
            add_up(squares)
            advantages /= (squares / (num - 1)).sqrt() + 1e-8

    def update(self) -> dict[str, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Learn from the rollout; return the means of the losses, on the device."""
        self.losses.zero_()
        self._order.copy_(torch.randperm(len(self._order), device=self.device))
        for _ in range(self.num_learning_epochs):
            if not self.is_multi_gpu:
                self._learned()
                continue
            for part in self._parts:
                part()
                add_up(self._flat)
                self._flat /= self.gpu_world_size
                self._applied()
        self.losses /= self.num_learning_epochs * self.num_mini_batches
        obs = self.storage.observations.flatten(0, 1)
        for part in (self.actor, self.critic, self.rnd):
            if part is not None:
                part.update_normalization(obs)
        self.storage.clear()
        return {name: self.losses[i] for i, name in enumerate(LOSSES) if name != "rnd" or self.rnd is not None}

    def load(self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None, strict: bool) -> bool:
        """Load a saved state: see rsl_rl; graphs are captured again."""
        is_loaded = super().load(loaded_dict, load_cfg, strict)
        optimisers = [self.optimizer, *([self.rnd.optimizer] if self.rnd else [])]
        for group in (group for optimizer in optimisers for group in optimizer.param_groups):
            group |= {"fused": True, "capturable": self._flat.is_cuda}  # it may have been saved on another device
        for group in self.optimizer.param_groups:
            self.rate.fill_(float(group["lr"]))
            group["lr"] = self.rate
        for graph in (value for value in vars(self).values() if isinstance(value, Captured)):
            graph.forget()
        for graph in self._parts:
            graph.forget()
        return is_loaded

    def broadcast_parameters(self) -> None:
        models = [self._raw_actor, self._raw_critic, *([self.rnd.predictor, self.rnd.target] if self.rnd else [])]
        for model in models:
            for tensor in model.state_dict().values():
                torch.distributed.broadcast(tensor, src=0)

    # Captured functions

    def _collect_gradients(self) -> None:
        """Put all gradients, then the policy's divergence, in one buffer, and make optimisers that stay on the device."""
        networks = [*self.actor.parameters(), *self.critic.parameters()]
        self._weights = [parameter for parameter in networks if parameter.requires_grad]
        self._predictor = list(self.rnd.predictor.parameters()) if self.rnd is not None else []
        every = [*self._weights, *self._predictor]
        self._flat = torch.zeros(sum(p.numel() for p in every) + 1, dtype=every[0].dtype, device=self.device)
        parts = self._flat[:-1].split([p.numel() for p in every])
        for parameter, part in zip(every, parts, strict=True):
            parameter.grad = part.view_as(parameter)
        self._gradients = [parameter.grad for parameter in every if parameter.grad is not None]
        is_cuda = self._flat.is_cuda
        kind: Any = type(self.optimizer)
        self.optimizer = kind(networks, lr=self.rate, fused=True, capturable=is_cuda)
        if self.rnd is not None:
            rate = self.rnd.optimizer.param_groups[0]["lr"]
            self.rnd.optimizer = torch.optim.Adam(self._predictor, lr=rate, fused=True, capturable=is_cuda)

    def _see(self, obs: TensorDict) -> None:
        names = list(self._obs.keys())
        copy_each([self._obs[name] for name in names], [obs[name] for name in names])

    def _policy(self, obs: TensorDict) -> Distribution:
        actor = self.actor
        assert actor.distribution is not None
        with torch.autocast(**self._autocast):
            mean = actor.mlp(actor.get_latent(obs))
        actor.distribution.update(mean.to(self._flat.dtype))
        return actor.distribution

    def _judge(self, obs: TensorDict) -> Tensor:
        with torch.autocast(**self._autocast):
            return self.critic(obs).to(self._flat.dtype)

    def _choose(self) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, ...]]:
        with torch.no_grad():
            distribution = self._policy(self._obs)
            actions = distribution.sample()
            params = tuple(each.contiguous() for each in distribution.params)
            return actions, self._judge(self._obs), distribution.log_prob(actions), params

    def _final_value(self) -> Tensor:
        with torch.no_grad():
            return self._judge(self._obs)

    def _returns(self) -> None:
        with torch.no_grad():
            storage, value = self.storage, self._judge(self._obs)
            advantage = torch.zeros_like(value)
            for step in reversed(range(storage.num_transitions_per_env)):
                goes_on = 1.0 - storage.dones[step].float()
                delta = storage.rewards[step] + goes_on * self.gamma * value - storage.values[step]
                advantage = delta + goes_on * self.gamma * self.lam * advantage
                value = storage.values[step]
                storage.returns[step] = advantage + value
            storage.advantages.copy_(storage.returns - storage.values)

    def _epoch(self) -> None:
        for i in range(self.num_mini_batches):
            self._differentiate(i)
            self._take_step()

    def _differentiate(self, i: int) -> None:
        """Compute the gradients of mini-batch i, and the policy's divergence."""
        storage, rows = self.storage, self._order[i * self._rows : (i + 1) * self._rows]
        with torch.no_grad():
            obs = TensorDict({name: each.flatten(0, 1)[rows] for name, each in storage.observations.items()}, [len(rows)])
            actions, values, chance, returns, advantages = (
                each.flatten(0, 1)[rows]
                for each in (storage.actions, storage.values, storage.actions_log_prob, storage.returns, storage.advantages)
            )
            old_params = tuple(each.flatten(0, 1)[rows] for each in storage.distribution_params or ())
        with torch.enable_grad():
            distribution = self._policy(obs)
            ratio = (distribution.log_prob(actions) - chance[:, 0]).exp()
            gain = advantages[:, 0]
            surrogate = torch.max(-gain * ratio, -gain * ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)).mean()
            value = self._judge(obs)
            squares = (value - returns).square()
            if self.use_clipped_value_loss:
                clipped = values + (value - values).clamp(-self.clip_param, self.clip_param)
                squares = torch.max(squares, (clipped - returns).square())
            value = squares.mean()
            entropy = distribution.entropy.mean()
            loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy
            error = self.rnd.compute_loss(obs) if self.rnd is not None else torch.zeros_like(loss)
            gradients = [*torch.autograd.grad(loss, self._weights)]
            gradients += torch.autograd.grad(error, self._predictor) if self._predictor else []
        with torch.no_grad():
            copy_each(self._gradients, gradients)
            params = tuple(each.detach() for each in distribution.params)
            self._kl.copy_(distribution.kl_divergence(old_params, params).mean())
            self.losses += torch.stack([value, surrogate, entropy, error]).detach()

    def _take_step(self) -> None:
        with torch.no_grad():
            if self.schedule == "adaptive" and self.desired_kl is not None:
                kl, rate = self._kl[0], self.rate
                slower = (rate / RATE_FACTOR).clamp(min=LEAST_RATE)
                faster = torch.where(kl > 0.0, (rate * RATE_FACTOR).clamp(max=MOST_RATE), rate)
                new_rate = torch.where(kl < self.desired_kl / 2.0, faster, rate)
                rate.copy_(torch.where(kl > self.desired_kl * 2.0, slower, new_rate))
            nn.utils.clip_grad_norm_(self.actor.parameters(), self.max_grad_norm)
            nn.utils.clip_grad_norm_(self.critic.parameters(), self.max_grad_norm)
            self.optimizer.step()
            if isinstance(self.actor.distribution, Gaussian):
                self.actor.distribution.bound()
            if self.rnd is not None:
                self.rnd.optimizer.step()


def _refuse(actor: MLPModel, critic: MLPModel, options: dict[str, Any]) -> None:
    names = ("symmetry_cfg", "use_mixed_precision", "normalize_advantage_per_mini_batch")
    wrong = [name for name in names if options.get(name)]
    wrong += ["recurrent networks"] if actor.is_recurrent or critic.is_recurrent else []
    wrong += [] if options.get("optimizer", "adam") in ("adam", "adamw") else [f"optimizer {options['optimizer']}"]
    if wrong:
        raise TgdslError(f"CapturedPPO does without {', '.join(wrong)}: take rsl_rl's own PPO")
