"""An XHand1 on the live page: its joints, and the forces that it reports on its fingertips. No command is sent.

Shapes: `joint` and `finger` as in `protocol`.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Num

from tgdsl.module.outputs import Output
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Emulator
from tgdsl.runtime.xhand1.log.log import Fault, HandLog
from tgdsl.runtime.xhand1.motion import JointControls
from tgdsl.runtime.xhand1.observe import finger_of
from tgdsl.runtime.xhand1.wire.errors import HandClosedError, HandError
from tgdsl.runtime.xhand1.wire.ports import the_hand
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, HandState
from tgdsl.scene.scene import scene_model
from tgdsl.tuning.compile import compile
from tgdsl.view.hand_table import StreamStats
from tgdsl.view.stages import Poses, RecordedStage, Stage, kinematic_poses

Array = np.ndarray
LIVE_STEP = 0.02  # time between readings of a live hand that are shown [s]
_DOCUMENT = {
    "tgdsl": 1,
    "robot": {"model": "xhand1"},
    "resolution": "low",
    "objects": {"palm": {"body": "right_hand_link"}},
    "sensors": {"tips": {"kind": "link_contact", "links": "tips", "feels": ["palm"], "outputs": ["force"]}},
}
"""Fingertips with one force each. The hand reports the forces: nothing is simulated, so `feels` has no effect."""


class HandStage(Stage):
    """A hand at one instant, drawn as the right hand: which bytes say left or right is unverified."""

    def __init__(self, calibration: Calibration | None):
        """Show a hand by what its counts mean; default: they stay counts."""
        self.touch, self.num_envs = compile(_DOCUMENT), 1
        self.calibration = calibration or Calibration.none()
        self.model = scene_model(self.touch.plan.scene)
        (output,) = self.touch.outputs
        self._output = dataclasses.replace(output, units=(self.calibration.units,) * 3)
        self._fingers = [i for body in output.bodies if (i := finger_of(body)) is not None]
        self._qpos_id = JointControls.of_model(self.model).qpos_id
        self._data = mujoco.MjData(self.model)

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The forces on the fingertips, in the calibration's unit."""
        return (self._output,)

    def body_poses(self, env: int) -> Poses:
        return kinematic_poses(self.model, self._data)

    def _take(self, position: Float[Array, " joint"], counts: Num[Array, "finger 3"]) -> None:
        """Take joint angles [rad] and the fingertips' counts along the sensors' axes."""
        self._data.qpos[self._qpos_id] = position
        force = self.calibration.apply(counts)[self._fingers]
        self.readings = {"tips": torch.from_numpy(force).float().unsqueeze(0)}


class LiveHandStage(HandStage):
    """A hand that is connected, or an emulated one; `opened` is closed with the stage."""

    control_step = LIVE_STEP

    def __init__(self, hand: XHand1, calibration: Calibration | None = None):
        super().__init__(calibration)
        self._hand, self.opened = hand, ExitStack()
        self._stats, reading = StreamStats(), hand.read()
        self._stats.add(reading)
        self._start, self.time = reading.received_at, 0.0
        self._state: HandState = reading.state
        self._take(reading.state.position, reading.state.total_force)

    def advance(self) -> None:
        """Take the hand's next reading; where none comes, the last stays and the page says why."""
        try:
            reading = self._hand.read()
        except HandClosedError:
            raise
        except HandError as error:
            self._stats.add(Fault.of(error, time.monotonic()))
            return
        self._stats.add(reading)
        self.time, self._state = reading.received_at - self._start, reading.state
        self._take(self._state.position, self._state.total_force)

    def restart(self) -> None:
        """Count time from now on; the hand does not move."""
        self._start, self.time = self._start + self.time, 0.0

    def notes(self, env: int) -> Mapping[str, float | str]:
        """Return why no reading comes, how many failed, how many joints report errors, and the fingertips' temperatures."""
        fault, state = self._stats.fault, self._state
        trouble = {} if fault is None else {"NO NEW READING": f"{fault.kind}: {fault.message}"}
        temperatures = {f"{name} [°C]": float(value) for name, value in zip(FINGERS, state.total_temperature, strict=True)}
        errors = float(state.joint_error.any(axis=-1).sum())
        return {**trouble, "failures": float(self._stats.num_faults), "joints with errors": errors, **temperatures}

    def close(self) -> None:
        self.opened.close()


class HandLogStage(HandStage, RecordedStage):
    """A log of `tgdsl hand record`, reading by reading."""

    def __init__(self, log: HandLog, calibration: Calibration | None = None):
        """Show a log; default calibration: the log's."""
        super().__init__(calibration or log.calibration)
        self._log, self.num_steps = log, log.num_readings
        self._position, self._counts = log.column("position"), log.column("total_force")
        self._faults = {int(i) - 1: fault for i, fault in zip(log.fault_reading, log.faults, strict=True)}
        self.control_step = log.seconds / max(1, log.num_readings - 1) or LIVE_STEP
        self.seek(0)

    def seek(self, step: int) -> None:
        self.step_index = i = int(np.clip(step, 0, self._log.num_readings - 1))
        self.time = float(self._log.received_at[i] - self._log.received_at[0])
        self._take(self._position[i], self._counts[i])

    def notes(self, env: int) -> Mapping[str, float | str]:
        """Return the failure that came before the next reading, if one did."""
        fault = self._faults.get(self.step_index)
        return {} if fault is None else {"then no reading": f"{fault.kind}: {fault.message}"}


def live_hand(source: Path, calibration: Calibration | None) -> LiveHandStage:
    """Return the stage of `emulator`, `xhand1` or `xhand1:PORT`; raise `HandError` if no hand answers, or several do."""
    name, _, port = str(source).partition(":")
    with ExitStack() as opened:
        device = opened.enter_context(Emulator()).device if name == "emulator" else port or None
        address = the_hand(device)
        hand = opened.enter_context(XHand1.open(address.device, address.addresses))
        stage = LiveHandStage(hand, calibration)
        stage.opened = opened.pop_all()
    return stage
