"""Training of a policy: the parameters of PPO, its networks and random network distillation.

Source of the defaults: Chung et al., *Tactile Genesis*, appendix, "Optimization and Network Hyperparameters"; the tasks' specs
have their departures. Not in the paper, and ours: `eps`, `clip`, encoders in both actor and critic, the RND networks' widths
and weight, `desynchronise`, `precision`, the checkpoints' times.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictBool, StrictInt, Tag, model_validator

from tgdsl.fields.models import TEXT_OR_OTHER, NonNegative, Positive, Quantity, SpecModel

Whole = Annotated[StrictInt, Field(ge=1)]
Widths = Annotated[tuple[Whole, ...], Field(min_length=1)]
Groups = Annotated[tuple[str, ...], Field(min_length=1)]
Share = Annotated[float, Quantity("number", ge=0.0), Field(le=1.0)]
Time = Annotated[float, Quantity("time", gt=0.0)]
Precision = Literal["float32", "tf32", "bfloat16"]
WIDTHS = (512, 256, 128)


class EncoderSpec(SpecModel):
    """The network that embeds one group of observations."""

    hidden: Widths = WIDTHS
    """Widths of its hidden layers."""
    size: Whole = 64
    """Size of the embedding."""


class TouchEncoderSpec(EncoderSpec):
    """The network that embeds touch."""

    hidden: Widths = (64, 64)
    """Widths of its hidden layers."""
    size: Whole = 32
    """Size of the embedding."""


class NetworksSpec(SpecModel):
    """Networks of actor and critic: groups are normalised, each is embedded, and the embeddings are mapped together."""

    encoder: EncoderSpec = EncoderSpec()
    """Encoder of each group except touch."""
    touch_encoder: TouchEncoderSpec = TouchEncoderSpec()
    """Encoder of `tactile_sensors`."""
    hidden: Widths = WIDTHS
    """Widths of the hidden layers that follow the embeddings."""
    initial_std: Positive = 1.0
    """Standard deviation of the actions at the start."""
    min_std: NonNegative = 0.0
    """Least standard deviation of the actions; at most `initial_std`."""
    eps: Positive = 1e-5
    """Offset of the standard deviation that normalises an observation, in the observation's unit."""
    clip: Positive = 10.0
    """Bound of normalised observations."""

    @model_validator(mode="after")
    def _check(self) -> NetworksSpec:
        if self.min_std > self.initial_std:
            raise ValueError(f"min_std {self.min_std:g} is more than initial_std {self.initial_std:g}, expected at most that")
        return self


class RndSpec(SpecModel):
    """Random network distillation: the predictor's error is an intrinsic reward."""

    groups: Groups | None = None
    """Its groups of observations; default: `priv_obj_state` if there is one, else the actor's."""
    weight: NonNegative = 1.0
    """Reward per second for one standard deviation of the prediction's error [1/s]."""
    outputs: Whole = 8
    """Size of the predicted embedding."""
    predictor: Widths = (256, 128)
    """Widths of the predictor's hidden layers."""
    target: Widths = (256, 128)
    """Widths of the target's hidden layers."""
    learning_rate: Positive = 1e-3
    """Learning rate of the predictor."""


Rnd = Annotated[Annotated[Literal["off"], Tag("text")] | Annotated[RndSpec, Tag("other")], TEXT_OR_OTHER]


class TrainSpec(SpecModel):
    """Training of a policy."""

    iterations: Whole = 6000
    """Iterations of the whole run: rollout and update."""
    steps: Whole = 24
    """Control steps of each environment per iteration."""
    actor: Groups | None = None
    """The actor's groups of observations; default, as the paper's teacher: all except `tactile_sensors`, `priv_obj_props` and
    `proprio`, which `priv_proprio` contains."""
    critic: Groups | None = None
    """The critic's groups of observations; default: the default actor's, and `priv_obj_props`."""
    networks: NetworksSpec = NetworksSpec()
    """Networks of actor and critic."""
    rnd: Rnd = RndSpec()
    """Random network distillation, or `off`."""
    learning_rate: Positive = 1e-3
    """Learning rate; if adaptive, the initial one."""
    adaptive: StrictBool = True
    """Whether the learning rate follows the change of the policy: `desired_kl`."""
    desired_kl: Positive = 0.01
    """Target KL divergence between a mini-batch's policy and the rollout's: above twice it the rate falls, below half it
    rises."""
    epochs: Whole = 5
    """Passes of an update through its rollout."""
    mini_batches: Whole = 4
    """Mini-batches of an epoch."""
    discount: Share = 0.998
    """γ."""
    gae: Share = 0.95
    """λ of the generalised advantage estimate."""
    clip: Positive = 0.2
    """Bound of the change of a probability ratio, and of a value with `clip_values`."""
    clip_values: StrictBool = True
    """Whether values are clipped to a change of `clip` in an update, as in the paper and rsl_rl."""
    entropy: NonNegative = 2e-3
    """Weight of the entropy."""
    value: NonNegative = 1.0
    """Weight of the value's error."""
    max_grad_norm: Positive = 1.0
    """Largest norm of the gradients, of actor and critic each."""
    desynchronise: StrictBool = True
    """Whether first episodes end at random times, so that later ones do not end together."""
    precision: Precision = "tf32"
    """Precision of a GPU's matrix products: `float32`, `tf32` (ten bits of mantissa), or `bfloat16` (seven), then also of
    activations; weights, gradients, losses and all else are float32."""
    checkpoint: Time = 10.0
    """Longest time that a killed run loses, if its iterations are no longer [s]."""

    @model_validator(mode="after")
    def _check(self) -> TrainSpec:
        for name in ("actor", "critic"):
            groups = getattr(self, name) or ()
            if len(set(groups)) < len(groups):
                raise ValueError(f"{name} names a group twice")
        return self
