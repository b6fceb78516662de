"""What the fingertips of an emulated hand feel: the aggregate forces that a module observes in its own scene.

Shapes: `finger` as in `payloads`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import ObservationError
from tgdsl.module.memory.history import last_step
from tgdsl.module.module import TactileModule
from tgdsl.observations import observations
from tgdsl.observations.observations import HAND_ONLY
from tgdsl.plan.plan import Plan
from tgdsl.plan.sensors import PlannedObservation
from tgdsl.runtime.xhand1.fingertips import HandTerm
from tgdsl.runtime.xhand1.wire.payloads import FINGERS


@dataclass(frozen=True)
class _Place:
    """Where a finger's force stands among the features of an observation."""

    term: HandTerm
    link: int

    def force(self, features: Float[Tensor, " feature"]) -> Float[np.ndarray, " axis"]:
        by_axis = features.reshape(3, len(self.term.fingers))[:, self.link].double().cpu().numpy()
        return by_axis[np.argsort(self.term.axes)]

    def operator(self, plan: Plan) -> tuple[str | None, bytes]:
        """Return the reading and the matrix that the force is made with, to compare."""
        planned = self.term.planned
        matrix = plan.arrays[f"observations/{planned.group}/{planned.index}/operator"]
        columns = matrix.reshape(len(matrix), 3, len(self.term.fingers))[:, np.argsort(self.term.axes), self.link]
        return planned.reading, np.ascontiguousarray(columns).tobytes()


class SimulatedTips:
    """Forces on the fingertips, from a module's readings."""

    def __init__(self, touch: TactileModule, terms: Sequence[HandTerm]):
        """Find the observation that says what each fingertip feels.

        Args:
            touch: The module.
            terms: Its observations, as a hand gives them.

        Raises:
            ObservationError: If the emulator cannot give some, as the scene does not say what the fingertips feel.
        """
        self._touch = touch
        self._places: dict[int, _Place] = {}
        for term in terms:
            if term.planned.type in HAND_ONLY:
                raise ObservationError(f"{term.label}: the emulator cannot give it: where the hand's taxels are is not known")
            if term.planned.type == "agg_force":
                for link, finger in enumerate(term.fingers):
                    self._take(finger, _Place(term, link))
        for term in terms:
            missing = [FINGERS[finger] for finger in term.fingers if finger not in self._places]
            if missing:
                what = f"{term.label}: the emulator's {', '.join(missing)} would feel nothing"
                raise ObservationError(f"{what}; give an observation agg_force that says what force its fingertips feel")

    def forces(self, readings: Mapping[str, Tensor]) -> Float[np.ndarray, "finger 3"]:
        """Return the force on each fingertip, along its link's axes [unit of `agg_force`]; 0 where none is observed."""
        result = np.zeros((len(FINGERS), 3))
        features: dict[PlannedObservation, Tensor] = {}
        for finger, place in self._places.items():
            planned = place.term.planned
            if planned not in features:
                constants = self._touch.constants.tree["observations"][planned.key]
                reading = last_step(readings[str(planned.reading)])
                features[planned] = observations.observe(planned.type, reading, planned.channels, constants)[0]
            result[finger] = place.force(features[planned])
        return result

    def _take(self, finger: int, place: _Place) -> None:
        known = self._places.setdefault(finger, place)
        if known.operator(self._touch.plan) != place.operator(self._touch.plan):
            what = f"{known.term.label} and {place.term.label} differ, but the hand has one force on its {FINGERS[finger]}"
            raise ObservationError(f"{what}; give them the same `scale` and sensor")
