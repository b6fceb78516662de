"""The emulated XHand1 as a source: "emulator"."""

from __future__ import annotations

from pathlib import Path

from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.connect import simulate_at
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.source_kind import SourceKind
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.connect import HandConnection, JointTargets, given_calibration
from tgdsl.runtime.xhand1.emulator.simulated_body import SimulatedBody
from tgdsl.runtime.xhand1.emulator.simulated_tips import SimulatedTips
from tgdsl.runtime.xhand1.emulator.source import EmulatedSource
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.observe import HandObserver
from tgdsl.runtime.xhand1.wire.client import SerialTiming


def _open(
    touch: TactileModule,
    source: str,
    *,
    control_step: float,
    keyframe: str | None,
    calibration: Calibration | str | Path | None,
    motion: MotionLimits | None,
    timing: SerialTiming | None,
    lockstep: bool,
) -> Connection:
    known = given_calibration(calibration) or Calibration.none()
    observer = HandObserver(touch, known, control_step)
    tips = SimulatedTips(touch, observer.terms)
    sim = simulate_at(touch, 1, control_step, keyframe)
    targets = JointTargets(touch, motion, "the emulated hand")
    body = SimulatedBody(touch, sim, tips, known)
    stepped = EmulatedSource(
        body, control_step=control_step, calibration=known, motion=motion, timing=timing, lockstep=lockstep
    )
    return HandConnection(stepped, observer, targets)


EMULATOR = SourceKind("emulator", '"emulator"', _open, recognise=lambda source: source == "emulator")
"""The module's own scene behind the serial protocol of an XHand1."""
