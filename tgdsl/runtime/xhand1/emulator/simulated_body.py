"""The body of an emulated hand, simulated: joints and fingertips in the scene of a module, in MuJoCo.

Joints go where the set-points say, with the gains and forces of the robot file: a drive's own gain and current only say whether
it is driven at all. A drive that becomes passive holds where it is, as geared ones do.

Shapes: `joint` and `finger` as in `payloads`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.controls import JointControls
from tgdsl.runtime.xhand1.emulator.body import TipForces, is_driven
from tgdsl.runtime.xhand1.emulator.simulated_tips import SimulatedTips
from tgdsl.runtime.xhand1.motion import joint_ids
from tgdsl.runtime.xhand1.reader import Reading
from tgdsl.runtime.xhand1.wire.payloads import FINGERS, FORCE_MAX, FORCE_MIN, NUM_JOINTS, NUM_TAXELS, PASSIVE, JointCommand

_POLL_S = 0.001
_LATE_S = 0.2
"""Physics that is later than this is not made up for [s]."""


class SimulatedBody:
    """A hand in a simulation of one environment. It moves when `step` is called; `run` calls it in real time.

    Its taxels feel nothing, for where a real hand's are is not known.

    Attributes:
        num_late_s: Time that physics could not keep up with [s].
        clipped: Fingertips that felt more than their bytes can hold.
        failure: What ended `run`; None if nothing did.
    """

    def __init__(self, scene: SteppedScene, tips: SimulatedTips, calibration: Calibration):
        """Take a scene.

        Args:
            scene: The scene, which watches the hand's joints; nobody else may step it.
            tips: What the fingertips feel.
            calibration: How forces become counts.

        Raises:
            MotionError: If the scene's actuators are not those of a hand.
        """
        self.num_late_s = 0.0
        self.clipped: set[str] = set()
        self.failure: Exception | None = None
        self._scene, self._tips, self._calibration = scene, tips, calibration
        self._controls = JointControls.of_model(scene.sim.model)
        self._names = [scene.sim.model.joint(int(i)).name for i in joint_ids(scene.sim.model)]
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self._joints: Sequence[JointCommand] = PASSIVE
        self._time = 0.0
        self._feel()

    @property
    def time(self) -> float:
        """Time of the simulation, since its start or reset [s]."""
        return self._time

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Take set-points; a drive that is no longer driven holds where it is."""
        with self._lock:
            setpoints = self._scene.sim.qpos[0].double().cpu().numpy()[self._controls.qpos_id]
            told = [i for i, joint in enumerate(joints) if is_driven(joint) or is_driven(self._joints[i])]
            for i in told:
                if is_driven(joints[i]):
                    setpoints[i] = joints[i].position
            self._scene.put(self._controls.actuator_id[told], setpoints[told])
            self._joints = tuple(joints)

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return angles and counts after the last step."""
        with self._lock:
            return self._position.copy(), TipForces(self._counts, np.zeros((len(FINGERS), NUM_TAXELS, 3)))

    def is_told(self, target: Float[np.ndarray, " joint"]) -> bool:
        """Return whether all joints were last told to go just there, as far as the wire's floats can say it."""
        with self._lock:
            told = [joint.position for joint in self._joints if is_driven(joint)]
        return len(told) == NUM_JOINTS and np.array_equal(np.array(told, np.float32), target.astype(np.float32))

    def step(self) -> None:
        """Make one control step.

        Raises:
            SimulationError: If it diverges.
        """
        with self._lock:
            self._scene.step()
            self._time += self._scene.control_step
            self._feel()

    def reset(self) -> None:
        """Restart the scene."""
        with self._lock:
            self._scene.reset()
            self._time = 0.0
            self._feel()

    def run(self) -> None:
        """Step in real time from now on, in a thread of its own, until `close`."""
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
                    self.num_late_s += late
                    due += late
        except Exception as error:  # told by whoever steps the source
            self.failure = error

    def _feel(self) -> None:
        """Take angles and counts of one instant."""
        self._position = self._scene.positions(self._names)
        force = self._tips.forces(self._scene.readings)
        self._counts = self._calibration.counts_of(force)
        rounded = np.round(self._counts)
        outside = np.asarray(np.any((rounded < FORCE_MIN) | (rounded > FORCE_MAX), axis=1))
        self.clipped |= {name for name, is_outside in zip(FINGERS, outside, strict=True) if is_outside}


class Lockstep:
    """A step timer that lets a simulated body make its control step when the set-points have arrived: the same at every run."""

    num_late_steps = 0

    def __init__(self, body: SimulatedBody):
        """Time the steps of a source whose hand has this body."""
        self._body = body

    def wait(self, target: Float[np.ndarray, " joint"] | None, command: Callable[[], None]) -> float:
        """Repeat the command until the body has been told all of it, then make one step."""
        while target is not None and not self._body.is_told(target):
            command()
            time.sleep(_POLL_S)
        self._body.step()
        return time.monotonic()

    def time_of(self, reading: Reading) -> float:
        """Return the time of the simulation."""
        return self._body.time

    def restart(self) -> None:
        """Do nothing: steps are not counted."""
