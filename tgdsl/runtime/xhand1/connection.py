"""Connections to an XHand1, to an emulated one, and to the log of one."""

from __future__ import annotations

import warnings

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.module.module import TactileModule
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.source import Control
from tgdsl.runtime.xhand1.motion import JointControls, MotionLimits, check_ranges
from tgdsl.runtime.xhand1.observe import HandObserver
from tgdsl.runtime.xhand1.source import HandSource, is_chosen
from tgdsl.scene.scene import scene_model
from tgdsl.tensors.env_ids import EnvIds


class HandConnection(Connection):
    """A connection to an XHand1, or to the log of one."""

    def __init__(self, source: HandSource, observer: HandObserver, targets: JointTargets | None = None):
        super().__init__(source)
        self._hand, self._observer, self._targets = source, observer, targets

    @property
    def is_over(self) -> bool:
        """Whether a log is at its end."""
        return self._hand.is_over

    @property
    def age_s(self) -> float | None:
        """How old what the hand said is at most, now [s]."""
        return self._hand.age_s

    def read(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Observe what the hand said at the end of the last step."""
        return self._observer.observe(self._hand.sample())

    def send(self, control: Control) -> None:
        """Send the joints where the controls say, and take note of the controls once the step is made."""
        self._hand.step(None if self._targets is None else self._targets.of(control))
        self._observer.note(control)

    def restart(self, env_ids: EnvIds | None) -> None:
        """Reset the hand, and forget its past."""
        self._hand.reset(env_ids)
        self._observer.reset()

    def concerns(self, env_ids: EnvIds) -> bool:
        """Return whether the one environment is among these."""
        return is_chosen(env_ids)

    def resume(self) -> None:
        """Allow a hand that was made passive by an error to move again."""
        self._hand.resume()


class JointTargets:
    """From a model's controls to joint angles; without leave to move, to none, which is said once."""

    def __init__(self, touch: TactileModule, motion: MotionLimits | None, name: str):
        self._name = name
        self._joints: JointControls | None = None
        self._is_told = False
        if motion is not None:
            model = scene_model(touch.plan.scene)
            self._joints = JointControls.of_model(model)
            check_ranges(model, motion)

    def of(self, control: Control) -> Float[np.ndarray, " joint"] | None:
        """Return the joint angles to go to [rad].

        Raises:
            MotionError: If there are not as many controls as joints.
        """
        if control is None:
            return None
        if self._joints is None:
            if not self._is_told:
                self._is_told = True
                what = f"{self._name} was connected for reading alone: its controls go nowhere"
                warnings.warn(f"{what}; to move it, connect with motion=MotionLimits(...)", stacklevel=4)
            return None
        return self._joints.targets(control.detach().cpu().numpy() if isinstance(control, Tensor) else np.asarray(control))
