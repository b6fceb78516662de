"""Training of students: the parameters of DAgger, of their networks and decoders.

Source of the defaults: Chung et al., *Tactile Genesis*, appendix, "Optimization and Network Hyperparameters" and the table of
auxiliary losses; the tasks' specs have their departures. Not in the paper, and ours: `steps`, `std`, the quantity that `clip`
bounds, errors as means over steps, environments and joints, decoders of the embeddings, and shared weights for the images of
all links.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, StrictBool, StrictInt, model_validator

from tgdsl.fields.models import NonNegative, Positive, SpecModel
from tgdsl.rl.train.spec import WIDTHS, EncoderSpec, Groups, Time, TouchEncoderSpec, Whole, Widths

Loss = Literal["mse", "inverse_variance", "huber"]


class DecoderSpec(SpecModel):
    """A head that predicts a privileged number from the embeddings: an auxiliary loss, without use at deployment."""

    weight: NonNegative = 1.0
    """Weight of its squared error."""
    scale: Positive = 1.0
    """Factor on the number."""
    hidden: Widths = (128, 64)
    """Widths of its hidden layers."""


class ConvolutionSpec(SpecModel):
    """The network that embeds images of taxels, one per link, all by the same weights."""

    channels: Widths = (16, 32)
    """Channels of `cnn`'s layers; `convrnn` has one layer, of the first."""
    kernel: Whole = 3
    """Width of the kernels [taxel], an odd number."""

    @model_validator(mode="after")
    def _check(self) -> ConvolutionSpec:
        if self.kernel % 2 == 0:
            raise ValueError(f"kernel is {self.kernel}, expected an odd number")
        return self


class StudentNetworksSpec(SpecModel):
    """Networks of a student: groups are normalised, each is embedded, and the embeddings are mapped together."""

    kind: Literal["mlp", "lstm"] = "mlp"
    """Kind of the network that embeds each group except touch."""
    encoder: EncoderSpec = EncoderSpec()
    """Its widths; an `lstm` has the last one."""
    touch_kind: Literal["mlp", "lstm", "cnn", "convrnn"] = "mlp"
    """Kind of the network that embeds touch; for types without images `cnn` becomes `mlp`, and `convrnn` becomes `lstm`."""
    touch_encoder: TouchEncoderSpec = TouchEncoderSpec()
    """Its widths, in the same way."""
    convolution: ConvolutionSpec = ConvolutionSpec()
    """The networks of images."""
    hidden: Widths = WIDTHS
    """Widths of the hidden layers that follow the embeddings."""
    eps: Positive = 1e-5
    """Offset of the standard deviation that normalises an observation, in the observation's unit."""
    clip: Positive = 10.0
    """Bound of normalised observations."""


class GatesSpec(SpecModel):
    """Gates on taxels, which close until about a number is left: a student learns which taxels it needs."""

    taxels: Whole
    """Number of gates that may stay open."""
    weight: NonNegative = 1.0
    """Loss of each further gate, times the number of taxels; 1 suits errors of actions of about 1, see `normalise`."""


class DistillSpec(SpecModel):
    """Training of students."""

    iterations: Whole = 6000
    """Iterations of the whole run: rollout and update."""
    steps: Whole = 24
    """Control steps of each environment per iteration: a multiple of `gradient_length`."""
    gradient_length: Whole = 2
    """Control steps of a gradient step, through which recurrent networks are differentiated."""
    warm_start: Annotated[StrictInt, Field(ge=0)] = 0
    """Iterations at the start of the run in which the teacher acts, not the students. They have no scores of students."""
    epochs: Whole = 5
    """Passes of an update through its rollout."""
    aggregate: Whole = 1
    """Number of latest rollouts that updates learn from, as DAgger aggregates its data: the first pass uses the latest one,
    each other pass a random one; 1: the latest alone. A resumed run gathers them from scratch."""
    learning_rate: Positive = 1e-4
    """Learning rate, the largest of its schedule."""
    schedule: Literal["geometric", "one_cycle"] = "geometric"
    """Learning rate by the finished share of iterations or of minutes, whichever is larger, including earlier starts of the
    run. `geometric`: a decay from the start. `one_cycle`: half a cosine up from learning_rate/25 in the first 30 %, then half a
    cosine down."""
    final_learning_rate: Positive | None = None
    """Learning rate at the end; null: that of the start for `geometric`, learning_rate/25e4 for `one_cycle`."""
    max_grad_norm: Positive | None = 2.0
    """Largest norm of each student's gradient; null: no bound."""
    loss: Loss = "mse"
    """Mean of e², e = a_s − a_t; of e²/σ_t², σ_t the standard deviation with which the teacher explores; or of Huber's
    loss, e² up to |e| = 1 and 2|e| − 1 beyond."""
    normalise: StrictBool = False
    """Whether e is divided by the standard deviation of the teacher's actions over all states seen so far, joint by joint."""
    pushes: StrictBool = True
    """Whether objects are pushed in the students' training, as `randomise.push` says."""
    clip: Positive | None = None
    """Bound of a student's change of an action within an update, as PPO bounds values: the larger loss of a_s and
    a_0 + clamp(a_s − a_0, ±clip) counts. a_0 is the student's action in the latest rollout; in earlier rollouts, its action
    with the weights at the start of the pass; null: no bound."""
    std: NonNegative = 0.0
    """Standard deviation of the noise on a student's actions in rollouts."""
    groups: Groups | None = None
    """Groups of observations that students see in addition to touch; default: `proprio`, and `goal` if there is one."""
    networks: StudentNetworksSpec = StudentNetworksSpec()
    """Networks."""
    decoders: dict[str, DecoderSpec] = {}
    """Heads by the privileged number that they predict: see the task."""
    gates: GatesSpec | None = None
    """Gates on the taxels of touch; null: none."""
    precision: Literal["float32", "tf32"] = "tf32"
    """Precision of a GPU's matrix products: `float32` or `tf32`."""
    checkpoint: Time = 10.0
    """Longest time that a killed run loses, if its iterations are no longer [s]."""

    @model_validator(mode="after")
    def _check(self) -> DistillSpec:
        if self.steps % self.gradient_length:
            raise ValueError(f"steps is {self.steps}, expected a multiple of gradient_length, {self.gradient_length}")
        if self.final_learning_rate is not None and self.final_learning_rate > self.learning_rate:
            problem = (
                f"final_learning_rate is {self.final_learning_rate:g}, expected at most learning_rate, {self.learning_rate:g}"
            )
            raise ValueError(problem)
        if self.normalise and self.loss == "inverse_variance":
            problem = "inverse_variance and normalise each divide errors by a deviation, expected one of them"
            raise ValueError(f"{problem}; take loss mse or huber, or normalise: false")
        if len(set(self.groups or ())) < len(self.groups or ()):
            raise ValueError("groups names a group twice")
        return self
