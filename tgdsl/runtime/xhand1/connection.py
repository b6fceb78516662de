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

    def __init__(self, source: HandSource, observer: HandObserver, actuators: JointControls | None, name: str = ""):
        """Connect a hand.

        Args:
            source: The hand.
            observer: Observes it for the module.
            actuators: The actuators whose controls are its joint angles; None: controls go nowhere.
            name: Its name in a warning, given once, that controls go nowhere; empty: no warning.
        """
        super().__init__(source)
        self._hand, self._observer, self._actuators, self._name = source, observer, actuators, name

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
        """Send the joints where the controls say, and take note of the controls once the step is made.

        Raises:
            MotionError: If there are not as many controls as joints.
        """
        target = None
        if control is not None and self._actuators is not None:
            values = control.detach().cpu().numpy() if isinstance(control, Tensor) else np.asarray(control)
            target = self._actuators.targets(values)
        elif control is not None and self._name:
            problem = f"{self._name} was connected for reading alone: its controls go nowhere"
            warnings.warn(f"{problem}; to move it, connect with motion=MotionLimits(...)", stacklevel=3)
            self._name = ""
        self._hand.step(target)
        self._observer.note(control)

    def restart(self, env_ids: EnvIds | None) -> None:
        """Reset the hand, and forget its past."""
        self._hand.reset(env_ids)
        self._observer.reset()

    def concerns(self, env_ids: EnvIds) -> bool:
        """Return whether the one environment is among these."""
        return is_chosen(env_ids)

    def resume(self) -> None:
        """Let a hand move again after an error made it passive."""
        self._hand.resume()


def moved_joints(touch: TactileModule, motion: MotionLimits | None) -> JointControls | None:
    """Return the actuators of a hand's joints, if it may move.

    Raises:
        MotionError: If the scene's actuators are not the hand's, or the limits are beyond the robot file's.
    """
    if motion is None:
        return None
    model = scene_model(touch.plan.scene)
    result = JointControls.of_model(model)
    check_ranges(model, motion)
    return result
