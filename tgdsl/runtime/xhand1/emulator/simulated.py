"""An emulated hand whose body is the scene of a module, in MuJoCo.

Joints go where the set-points say, with the gains and forces of the robot file: a drive's own gain and current only say whether
it is driven at all. A drive that becomes passive holds where it is, as geared ones do. Taxels feel nothing, for where a real
hand's are is not known.

Shapes: `joint` and `finger` as in `protocol`.
"""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Mapping, Sequence
from contextlib import ExitStack

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import ObservationError, SimulationError
from tgdsl.module.memory import last_step
from tgdsl.module.module import TactileModule
from tgdsl.observations.observations import HAND_ONLY, AggForceObservation
from tgdsl.plan.sensors import PlannedObservation
from tgdsl.runtime.simulators.state_values import Control
from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Body, EmulatedHand, Emulator, TipForces, is_driven
from tgdsl.runtime.xhand1.motion import JointControls, MotionLimits, joint_ids
from tgdsl.runtime.xhand1.observe import HandTerm
from tgdsl.runtime.xhand1.source import XHand1Source
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.errors import WatchdogError
from tgdsl.runtime.xhand1.wire.protocol import FINGERS, FORCE_MAX, FORCE_MIN, NUM_JOINTS, PASSIVE, JointCommand

PATIENT = SerialTiming(reply_timeout_s=5.0, silence_s=2.0)
"""For an emulator on a busy machine, where bytes are late but not lost: pseudo-terminals then take up to half a second."""
_POLL_S = 0.001
_LATE_S = 0.2  # physics that is later than this is not made up for [s]


class SimulatedTips:
    """Forces on the fingertips: the aggregate forces that a module observes in its own scene."""

    def __init__(self, touch: TactileModule, terms: Sequence[HandTerm]):
        """Find the observation of each fingertip's force; an error names observations that the emulator cannot give."""
        self._touch = touch
        self._places: dict[int, tuple[HandTerm, int]] = {}  # by finger: an observation of its force, and which of its links
        for term in terms:
            if term.planned.type in HAND_ONLY:
                raise ObservationError(f"{term.label}: the emulator cannot give it: where the hand's taxels are is not known")
            for link, finger in enumerate(term.fingers if term.planned.type == "agg_force" else ()):
                first, at = self._places.setdefault(finger, (term, link))
                if self._operator(first, at) != self._operator(term, link):
                    problem = f"{first.label} and {term.label} differ, but the hand has one force on its {FINGERS[finger]}"
                    raise ObservationError(f"{problem}; give them the same `scale` and sensor")
        for term in terms:
            missing = [FINGERS[finger] for finger in term.fingers if finger not in self._places]
            if missing:
                problem = f"{term.label}: the emulator's {', '.join(missing)} would feel nothing"
                raise ObservationError(f"{problem}; give an observation agg_force that says what force its fingertips feel")

    def forces(self, readings: Mapping[str, Tensor]) -> Float[np.ndarray, "finger 3"]:
        """Return the force on each fingertip, along its link's axes [unit of `agg_force`]; 0 where none is observed."""
        result = np.zeros((len(FINGERS), 3))
        features: dict[PlannedObservation, Tensor] = {}
        for finger, (term, link) in self._places.items():
            planned = term.planned
            if planned not in features:
                constants = self._touch.constants.tree["observations"][planned.key]
                reading = last_step(readings[str(planned.reading)])
                features[planned] = AggForceObservation.observe(reading, planned.channels, constants)[0]
            by_axis = features[planned].reshape(3, len(term.fingers))[:, link].double().cpu().numpy()
            result[finger] = by_axis[np.argsort(term.axes)]
        return result

    def _operator(self, term: HandTerm, link: int) -> tuple[str | None, bytes]:
        """Return the reading and the matrix that give the force on a link, to compare."""
        planned = term.planned
        matrix = self._touch.plan.arrays[f"observations/{planned.group}/{planned.index}/operator"]
        columns = matrix.reshape(len(matrix), 3, len(term.fingers))[:, np.argsort(term.axes), link]
        return planned.reading, np.ascontiguousarray(columns).tobytes()


class SimulatedBody(Body):
    """A hand in a simulation of one environment. It moves when `step` is called; `run` calls it in real time."""

    def __init__(self, scene: SteppedScene, tips: SimulatedTips, calibration: Calibration):
        self.time = 0.0  # of the simulation, since its start or reset [s]
        self.clipped: set[str] = set()  # fingertips that felt more than their bytes can hold
        self.failure: Exception | None = None  # the error that ended `run`
        self._scene, self._tips, self._calibration = scene, tips, calibration
        self._controls = JointControls.of_model(scene.sim.model)
        self._names = [scene.sim.model.joint(int(i)).name for i in joint_ids(scene.sim.model)]
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._joints: Sequence[JointCommand] = PASSIVE
        self._feel()

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Take set-points; a drive that is no longer driven holds where it is."""
        with self._lock:
            setpoints = self._scene.sim.qpos[0].double().cpu().numpy()[self._controls.qpos_id]
            changed = [i for i, joint in enumerate(joints) if is_driven(joint) or is_driven(self._joints[i])]
            for i in changed:
                if is_driven(joints[i]):
                    setpoints[i] = joints[i].position
            self._scene.put(self._controls.actuator_id[changed], setpoints[changed])
            self._joints = tuple(joints)

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        with self._lock:
            return self._position.copy(), TipForces.zero()._replace(total=self._counts)

    def goes_to(self, target: Float[np.ndarray, " joint"]) -> bool:
        """Return whether the last command sends all joints just there, as far as the wire's floats can say it."""
        with self._lock:
            setpoints = [joint.position for joint in self._joints if is_driven(joint)]
        return len(setpoints) == NUM_JOINTS and np.array_equal(np.array(setpoints, np.float32), target.astype(np.float32))

    def step(self) -> None:
        """Make one control step."""
        with self._lock:
            self._scene.step()
            self.time += self._scene.control_step
            self._feel()

    def reset(self) -> None:
        """Restart the scene."""
        with self._lock:
            self._scene.reset()
            self.time = 0.0
            self._feel()

    def run(self) -> None:
        """Step in real time in a new thread, until `close`."""
        self._thread = threading.Thread(target=self._run, name="xhand1-physics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and the simulation."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        self._scene.close()

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stopping.wait(max(due - time.monotonic(), 0.0)):
                self.step()
                due += self._scene.control_step
                late = time.monotonic() - due
                if late > _LATE_S:
                    due += late
        except Exception as error:  # raised by whoever steps the source
            self.failure = error

    def _feel(self) -> None:
        """Take angles and counts of one instant."""
        self._position = self._scene.positions(self._names)
        self._counts = self._calibration.counts_of(self._tips.forces(self._scene.readings))
        rounded = np.round(self._counts)
        outside = np.asarray(np.any((rounded < FORCE_MIN) | (rounded > FORCE_MAX), axis=1))
        self.clipped |= {name for name, is_outside in zip(FINGERS, outside, strict=True) if is_outside}


class EmulatedSource(XHand1Source):
    """A hand whose body is simulated, behind a pseudo-terminal and read as a real hand is."""

    def __init__(
        self,
        body: SimulatedBody,
        *,
        control_step: float,
        calibration: Calibration,
        motion: MotionLimits | None,
        timing: SerialTiming | None,
        lockstep: bool,
    ):
        """Plug the hand in and open it; in lockstep the simulation makes a control step when stepped, else it runs in time."""
        self.body, self._is_lockstep, self._has_warned = body, lockstep, False
        with ExitStack() as opened:
            opened.callback(body.close)
            self.emulator = opened.enter_context(Emulator(EmulatedHand(body=body)))
            hand = opened.enter_context(XHand1.open(self.emulator.device, motion=motion, timing=timing or PATIENT))
            if not lockstep:
                body.run()
            super().__init__(hand, control_step=control_step, calibration=calibration)
            self._opened = opened.pop_all()

    @property
    def age_s(self) -> float | None:
        """How old the sample is at most, now [s]; None in lockstep, where the scene waits."""
        return None if self._is_lockstep else super().age_s

    def step(self, control: Control = None) -> None:
        """Step as a hand does; raise the error that ended the simulation or the emulator, if one did."""
        try:
            super().step(control)
        finally:
            self._check_threads()
        if self.body.clipped and not self._has_warned:
            self._has_warned = True
            who = ", ".join(sorted(self.body.clipped))
            problem = f"the emulated {who} felt more than counts of -128…127 along x and y and 0…255 along z can say"
            warnings.warn(f"{problem}; see the calibration's scale and rotation", stacklevel=2)

    def close(self) -> None:
        self._opened.close()

    def _restart(self) -> None:
        """Make the hand passive, then restart the scene."""
        try:
            super()._restart()
            self._read(time.monotonic())  # the hand has answered a passive command
            self.body.reset()
            self._velocity.reset()
            self._sample = self._read(time.monotonic())
        finally:
            self._check_threads()

    def _command(self) -> None:
        try:
            super()._command()
        except WatchdogError:
            if not self._is_lockstep:
                raise
            self.hand.resume()  # nothing runs in real time, so a caller who took long is not late
            super()._command()

    def _wait(self) -> float:
        """In lockstep, repeat the command until all of it has arrived, then step the scene: the same at every run."""
        if not self._is_lockstep:
            return super()._wait()
        while self._target is not None and not self.body.goes_to(self._target):
            self._command()
            time.sleep(_POLL_S)
        self.body.step()
        return time.monotonic()

    def _time_of(self, reading: Reading) -> float:
        return self.body.time if self._is_lockstep else super()._time_of(reading)

    def _check_threads(self) -> None:
        if self.body.failure is not None:
            raise SimulationError(f"the emulated hand's simulation ended: {self.body.failure}") from self.body.failure
        self.emulator.check()
