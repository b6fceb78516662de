"""The emulated XHand1 as a source: "emulator"."""

from __future__ import annotations

from pathlib import Path

from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.connect import simulate_at
from tgdsl.runtime.connection import Connection
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.runtime.source_kind import SourceKind
from tgdsl.runtime.stepped_scene import SteppedScene, refuse_other_steps
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.connect import HandConnection, JointTargets, given_calibration, refuse_unfit_steps
from tgdsl.runtime.xhand1.emulator.simulated_body import SimulatedBody
from tgdsl.runtime.xhand1.emulator.simulated_tips import SimulatedTips
from tgdsl.runtime.xhand1.emulator.source import EmulatedSource
from tgdsl.runtime.xhand1.motion import MotionLimits, joint_ids
from tgdsl.runtime.xhand1.observe import HandObserver
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.scene.scene import scene_model


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
    scene: SteppedScene | None = None,
) -> Connection:
    known = given_calibration(calibration) or Calibration.none()
    observer = HandObserver(touch, known, control_step)
    tips = SimulatedTips(touch, observer.terms)
    if scene is None:
        scene = SteppedScene(touch, simulate_at(touch, 1, control_step, keyframe, Watch(joints=hand_joints(touch))))
    refuse_other_steps(scene, control_step)
    if not lockstep:
        refuse_unfit_steps(control_step, motion, timing)
    targets = JointTargets(touch, motion, "the emulated hand")
    body = SimulatedBody(scene, tips, known)
    stepped = EmulatedSource(
        body, control_step=control_step, calibration=known, motion=motion, timing=timing, lockstep=lockstep
    )
    return HandConnection(stepped, observer, targets)


def hand_joints(touch: TactileModule) -> tuple[str, ...]:
    """Return the hand's joints by their names in the module's scene, in the order of their ids: a scene has to watch them.

    Raises:
        MotionError: If the scene lacks one.
    """
    model = scene_model(touch.plan.scene)
    return tuple(model.joint(int(i)).name for i in joint_ids(model))


EMULATOR = SourceKind("emulator", '"emulator"', _open, recognise=lambda source: source == "emulator")
"""The module's own scene behind the serial protocol of an XHand1."""
