"""One way to step and observe, whatever is behind it: a simulation, a real hand, an emulated one, or a recorded log.

Shapes: `env` environments, `feature` numbers of an observation.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import HandError, ObservationError, SimulationError, TgdslError, listed
from tgdsl.module.module import TactileModule
from tgdsl.observations.observations import HAND_ONLY, hand_only_error
from tgdsl.runtime.batch.simulation import BatchSimulation, simulate
from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.controls import JointControls, check_ranges
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.simulated_body import SimulatedBody
from tgdsl.runtime.xhand1.emulator.simulated_tips import SimulatedTips
from tgdsl.runtime.xhand1.emulator.source import EmulatedSource
from tgdsl.runtime.xhand1.fingertips import warn_of_noise
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.observe import HandObserver
from tgdsl.runtime.xhand1.source import HandSample, XHand1Source, is_chosen
from tgdsl.runtime.xhand1.wire.link import LinkTiming
from tgdsl.runtime.xhand1.wire.replies import Addresses
from tgdsl.runtime.xhand1.wire.serial_port import list_ports
from tgdsl.scene.scene import scene_model
from tgdsl.tensors.env_ids import EnvIds

CONTROL_STEP = 0.02
Control = Tensor | np.ndarray | None
_SOURCES = 'expected "simulation", "emulator", "xhand1", "xhand1:PORT" or the path of a log, "….npz"'
_USB_PORTS = ("/dev/ttyUSB", "/dev/ttyACM", "/dev/cu.usb", "COM")


@runtime_checkable
class Steps(Protocol):
    """What a connection needs of a source."""

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        ...

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        ...

    def step(self, control: Control = None) -> None:
        """Advance by one control step."""
        ...

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start anew."""
        ...


@runtime_checkable
class HandSteps(Steps, Protocol):
    """A source that is a hand, or the log of one."""

    def sample(self) -> HandSample:
        """Return what the hand said at the end of the last step."""
        ...

    def close(self) -> None:
        """Let go of it."""
        ...


class Connection:
    """A source, as a policy sees it. Use it as a context manager, or call `close`.

    Attributes:
        source: What is behind it: a `BatchSimulation`, an `XHand1Source`, an `EmulatedSource` or a `ReplaySource`.
    """

    def __init__(
        self,
        source: Steps,
        observe: Callable[[], dict[str, Float[Tensor, "env feature"]]],
        *,
        control: Callable[[Control], Control] = lambda control: control,
        note: Callable[[Control], None] = lambda control: None,
        forget: Callable[[], None] = lambda: None,
        close: Callable[[], None] = lambda: None,
    ):
        """Connect; use `connect`.

        Args:
            source: The source.
            observe: Returns the observation groups of this instant.
            control: From controls in the order of the model's actuators to those of the source.
            note: Takes note of the controls of a step that was made.
            forget: Forgets past observations; called with a reset.
            close: Lets go of the source.
        """
        self.source = source
        self._observe, self._control, self._note, self._forget, self._close = observe, control, note, forget, close
        self._groups: dict[str, Tensor] | None = None
        self._is_read = True

    @property
    def num_envs(self) -> int:
        """Number of environments; of a hand or a log, 1."""
        return self.source.num_envs

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        return self.source.control_step

    @property
    def is_over(self) -> bool:
        """Whether a log is at its end; other sources never are."""
        return bool(getattr(self.source, "is_over", False))

    def step(self, control: Control = None) -> None:
        """Advance by one control step.

        Args:
            control: In the order of the model's actuators, (actuator,) or (env, actuator); of a hand, joint angles to go to
                [rad]; default: as they were. A log ignores them, and a hand without leave to move too: a warning says so once.

        Raises:
            SimulationError: If a simulation cannot make the step.
            HandError: If a hand may not go there, or gives no new reading. It is then passive until `resume`.
        """
        self._groups, self._is_read = None, False
        self.source.step(self._control(control))
        self._note(control)
        self._is_read = True

    def observe(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the module's observation groups, in its dtype and on its device; the same until the next step or reset.

        The sensors are read at the first call after a step or a reset: `rate` and `history` count these.

        Raises:
            ObservationError: If the last step or reset failed: what was observed before is not handed out as if it were new.
        """
        if not self._is_read:
            raise ObservationError("the last step or reset failed, so there is nothing new to observe; step or reset again")
        if self._groups is None:
            self._groups = self._observe()
        return dict(self._groups)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start some environments anew (default: all): a simulation from its keyframe, a hand where it is, passive.

        Raises:
            HandError: If a hand gives no new reading.
        """
        if env_ids is not None and not isinstance(self.source, BatchSimulation) and not is_chosen(env_ids):
            return
        self._groups, self._is_read = None, False
        self.source.reset(env_ids)
        self._forget()
        self._is_read = True

    def resume(self) -> None:
        """Allow a hand that was made passive by an error to move again; for other sources, nothing."""
        if isinstance(self.source, XHand1Source):
            self.source.hand.resume()

    def close(self) -> None:
        """Let go of the source; a hand becomes passive.

        Raises:
            HandError: If a hand was moving and did not confirm that it is passive.
        """
        self._close()

    def __enter__(self) -> Connection:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def connect(
    touch: TactileModule,
    source: str | Path = "simulation",
    *,
    num_envs: int = 1,
    control_step: float = CONTROL_STEP,
    keyframe: str | None = None,
    calibration: Calibration | str | Path | None = None,
    motion: MotionLimits | None = None,
    addresses: Addresses | None = None,
    timing: LinkTiming | None = None,
    lockstep: bool = False,
) -> Connection:
    """Connect a module to what it shall feel.

    Args:
        touch: The module; while an emulator is connected, it is the emulator's.
        source: `simulation`: its own scene, in MuJoCo. `emulator`: the same behind the serial protocol of an XHand1.
            `xhand1`: the hand on the only USB serial port; `xhand1:/dev/ttyUSB0`: on this one. A path that ends in `.npz`: a
            recorded log.
        num_envs: Number of environments; more than 1 only for a simulation.
        control_step: Duration of one control step [s]; in a scene, a whole number of physics steps.
        keyframe: Keyframe that a scene starts from; default: the model's own initial state.
        calibration: What a hand's counts mean, or the file that says it; default: of a log its own, else they stay counts.
        motion: Leave for a hand to move, and how far; default: it is only read. A simulation needs none.
        addresses: Which hand on the line; default: the one with id 0.
        timing: Times of the line. Where replies may take long, a step waits for a reading as long as two of them.
        lockstep: Nothing runs in real time: the emulator's scene moves when stepped, a log is read as fast as possible. A
            simulation is always so, a real hand never.

    Raises:
        ObservationError: If the source cannot give what the module observes. No hand was touched then.
        SpecError: If the calibration file has mistakes.
        SimulationError: If the scene cannot be stepped like this.
        HandError: If the hand does not answer, or may not move like this.
        TgdslError: If there is no such source.
    """
    name = str(source)
    if name == "simulation":
        return _simulation(touch, num_envs, control_step, keyframe)
    if num_envs != 1:
        raise TgdslError(f'num_envs is {num_envs}, but "{name}" is one environment')
    known = load_calibration(Path(calibration)) if isinstance(calibration, (str, Path)) else calibration
    if name == "emulator":
        return _emulator(touch, control_step, keyframe, known or Calibration.none(), motion, timing, lockstep)
    if name.endswith(".npz"):
        return _replay(touch, Path(name), control_step, known, lockstep)
    if name != "xhand1" and not name.startswith("xhand1:"):
        raise TgdslError(f'unknown source "{name}"; {_SOURCES}')
    if lockstep:
        raise HandError("a real hand moves in its own time: lockstep is for emulators and logs")
    port = name.removeprefix("xhand1").removeprefix(":")
    return _hand(touch, port, control_step, known or Calibration.none(), motion, addresses, timing)


def _simulation(touch: TactileModule, num_envs: int, control_step: float, keyframe: str | None) -> Connection:
    for term in touch.plan.observations:
        if term.type in HAND_ONLY:
            raise hand_only_error(term.group, term.index, term.type)
    sim = _scene(touch, num_envs, control_step, keyframe)
    return Connection(sim, lambda: touch.observe(touch(sim.state())), close=sim.close)


def _scene(touch: TactileModule, num_envs: int, control_step: float, keyframe: str | None) -> BatchSimulation:
    sim = simulate(touch, num_envs, keyframe=keyframe, threads=0 if num_envs > 1 else 1)
    timestep = float(sim.model.opt.timestep)
    sim.substeps = round(control_step / timestep)
    if sim.substeps < 1 or abs(sim.control_step - control_step) > 1e-6 * timestep:
        what = f"a control step of {control_step:g} s"
        raise SimulationError(f"{what}, expected a whole number of the scene's physics steps of {timestep:g} s")
    return sim


def _emulator(
    touch: TactileModule,
    control_step: float,
    keyframe: str | None,
    calibration: Calibration,
    motion: MotionLimits | None,
    timing: LinkTiming | None,
    lockstep: bool,
) -> Connection:
    observer = HandObserver(touch, calibration, control_step)
    tips = SimulatedTips(touch, observer.terms)
    sim = _scene(touch, 1, control_step, keyframe)
    control = _Controls(touch, motion, "the emulated hand")
    body = SimulatedBody(touch, sim, tips, calibration)
    source = EmulatedSource(
        body, control_step=control_step, calibration=calibration, motion=motion, timing=timing, lockstep=lockstep
    )
    return _hand_connection(source, observer, control)


def _hand(
    touch: TactileModule,
    port: str,
    control_step: float,
    calibration: Calibration,
    motion: MotionLimits | None,
    addresses: Addresses | None,
    timing: LinkTiming | None,
) -> Connection:
    observer = HandObserver(touch, calibration, control_step)
    control = _Controls(touch, motion, "the hand")
    warn_of_noise(touch.plan)
    with ExitStack() as opened:
        hand = opened.enter_context(XHand1.open(port or _only_port(), addresses, motion=motion, timing=timing))
        source = XHand1Source(hand, control_step=control_step, calibration=calibration)
        opened.pop_all()
    return _hand_connection(source, observer, control)


def _replay(
    touch: TactileModule, path: Path, control_step: float, calibration: Calibration | None, lockstep: bool
) -> Connection:
    from tgdsl.runtime.xhand1.log.replay import ReplaySource

    speed = float("inf") if lockstep else 1.0
    source = ReplaySource(path, control_step=control_step, speed=speed, calibration=calibration)
    with ExitStack() as opened:
        opened.callback(source.close)
        observer = HandObserver(touch, source.calibration, control_step, is_log=True)
        warn_of_noise(touch.plan)
        opened.pop_all()
    return _hand_connection(source, observer, lambda control: None)


def _hand_connection(source: HandSteps, observer: HandObserver, control: Callable[[Control], Control]) -> Connection:
    return Connection(
        source,
        lambda: observer.observe(source.sample()),
        control=control,
        note=observer.note,
        forget=observer.reset,
        close=source.close,
    )


class _Controls:
    """From a model's controls to the hand's joints; without leave to move, to nowhere, which is said once."""

    def __init__(self, touch: TactileModule, motion: MotionLimits | None, name: str):
        """Look whether the scene's actuators are the hand's, and the limits within the robot file's.

        Raises:
            MotionError: If they are not.
        """
        self._name = name
        self._joints: JointControls | None = None
        self._is_told = False
        if motion is not None:
            model = scene_model(touch.plan.scene)
            self._joints = JointControls.of_model(model)
            check_ranges(model, motion)

    def __call__(self, control: Control) -> Control:
        if control is None:
            return None
        if self._joints is None:
            if not self._is_told:
                self._is_told = True
                what = f"{self._name} was connected for reading alone: its controls go nowhere"
                warnings.warn(f"{what}; to move it, connect with motion=MotionLimits(...)", stacklevel=4)
            return None
        return self._joints.targets(control.detach().cpu().numpy() if isinstance(control, Tensor) else np.asarray(control))


def _only_port() -> str:
    """Return the only USB serial port.

    Raises:
        HandError: If there are none or several.
    """
    ports = [port.device for port in list_ports() if port.device.startswith(_USB_PORTS)]
    if len(ports) != 1:
        found = listed(ports) or "none"
        raise HandError(f'expected one USB serial port, found {found}; name the hand\'s: source="xhand1:/dev/ttyUSB0"')
    return ports[0]
