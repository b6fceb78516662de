"""One way to step and observe, whatever is behind it: a simulation, a real hand, an emulated one, or a recorded log.

Installed packages bring further kinds of sources by an entry point, in their pyproject.toml:

    [project.entry-points."tgdsl.sources"]
    my_hand = "my_package.my_hand:MY_HAND"
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Literal, Unpack, overload

import torch

from tgdsl.errors import HandError, SimulationError, TgdslError, did_you_mean, listed
from tgdsl.files.plugins import Registry
from tgdsl.module.module import TactileModule
from tgdsl.module.taxels import Taxels, check_taxels
from tgdsl.observations.observations import HAND_ONLY, hand_only_error
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connection import Connection, SimulationConnection, SimulatorKind, SourceKind, keyword_options
from tgdsl.runtime.simulators.machine import checked_device
from tgdsl.runtime.simulators.simulation import SimOptions, Simulation
from tgdsl.runtime.simulators.watch import Watch
from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.runtime.warp.simulation import WarpSimulation
from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
from tgdsl.runtime.xhand1.driver import XHand1
from tgdsl.runtime.xhand1.emulator.simulated import EmulatedSource, SimulatedBody, SimulatedTips
from tgdsl.runtime.xhand1.log.replay import ReplaySource
from tgdsl.runtime.xhand1.motion import MotionLimits, joint_ids
from tgdsl.runtime.xhand1.observe import HandConnection, HandObserver, moved_joints, warn_of_noise
from tgdsl.runtime.xhand1.source import XHand1Source, refuse_beyond_watchdog
from tgdsl.runtime.xhand1.wire.client import Addresses, SerialTiming, list_ports
from tgdsl.scene.scene import scene_model

CONTROL_STEP = 0.02
MUJOCO = "mujoco"  # what users call the kind "simulation" where they name a simulator
_USB_PORTS = ("/dev/ttyUSB", "/dev/ttyACM", "/dev/cu.usb")
_Calibration = Calibration | str | Path | None
_Scene = SteppedScene | None


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
    timing: SerialTiming | None = None,
    lockstep: bool = False,
    taxels: Taxels | None = None,
    scene: SteppedScene | None = None,
    **options: Any,
) -> Connection:
    """Connect a module to a simulation, an emulated or real hand, or a log.

    Args:
        touch: The module; while an emulator is connected, only the emulator calls it.
        source: `simulation`: the module's scene in MuJoCo. `emulator`: the same scene behind the serial protocol of an XHand1.
            `xhand1`: the hand on the only USB serial port; `xhand1:/dev/ttyUSB0`: on this port. A path with the ending `.npz`:
            a recorded log. `warp`: the scene in MuJoCo Warp on a GPU; `warp:cuda:1`: on this GPU. Installed packages may add
            sources, see `known_sources`.
        num_envs: Number of environments; more than 1 only for a simulation.
        control_step: Duration of one control step [s]; in a scene, a whole number of physics steps.
        keyframe: Keyframe at which a scene starts; default: the model's initial state.
        calibration: Calibration of a hand's counts, or its file; default: the log's, otherwise forces stay in counts.
        motion: Limits of a real hand's motion, which permit it to move; default: the hand is only read.
        addresses: The hand on the serial line; default: id 0.
        timing: Timing of the serial line. A step waits for a reading as long as two replies may take.
        lockstep: Do not run in real time: the emulator's scene advances by steps, and a log is read as fast as possible. A
            simulation always does this, a real hand never.
        taxels: The expected taxels, such as a policy's: another module, its tables, an artefact, a rollout or an id, see
            `tgdsl.check_taxels`.
        scene: A scene, such as a task's, that a simulation or an emulator steps instead of the module's. It is closed with the
            connection, and ignores `keyframe`.
        **options: Options of this source, such as `nconmax` and `njmax` of `warp`. A source ignores arguments above that do not
            concern it, so that one script serves all sources.

    Raises:
        TaxelError: If the module has other taxels than expected, or in another order. Nothing was opened then.
        ObservationError: If the source cannot provide the module's observations. The hand was not opened then.
        SpecError: If the calibration file has mistakes.
        SimulationError: If the scene cannot be stepped with these arguments.
        HandError: If the hand does not answer, or its motion is not permitted.
        TgdslError: If the source or one of the options does not exist.
    """
    name = str(source)
    kind = kind_of(name)
    if taxels is not None:
        check_taxels(touch, taxels)
    if num_envs != 1 and "num_envs" not in kind.options:
        raise TgdslError(f'num_envs is {num_envs}, but "{name}" is one environment')
    shared: dict[str, Any] = {"num_envs": num_envs, "control_step": control_step, "keyframe": keyframe, "motion": motion}
    shared |= {"calibration": calibration, "addresses": addresses, "timing": timing, "lockstep": lockstep, "scene": scene}
    for option in options:
        if option not in kind.options:
            raise TgdslError(f'"{name}" has no option "{option}"; {did_you_mean(option, kind.options, "options")}')
    open_source = partial(_open_simulator, kind) if isinstance(kind, SimulatorKind) and kind.open is None else kind.open
    return open_source(touch, name, **{option: shared[option] for option in kind.options if option in shared}, **options)


@overload
def simulate(
    touch: TactileModule, num_envs: int, *, device: Literal["cpu"] = "cpu", **options: Unpack[SimOptions]
) -> BatchSimulation: ...
@overload
def simulate(
    touch: TactileModule, num_envs: int, *, device: str | torch.device, **options: Unpack[SimOptions]
) -> BatchSimulation | WarpSimulation: ...
def simulate(
    touch: TactileModule, num_envs: int, *, device: str | torch.device = "cpu", **options: Unpack[SimOptions]
) -> BatchSimulation | WarpSimulation:
    """Simulate the scene that a module was compiled for.

    Args:
        touch: The module.
        num_envs: Number of environments.
        device: Device of the physics: "cpu" is MuJoCo's Batch, "cuda" or "cuda:1" MuJoCo Warp. States are on the module's
            device; if both are on one GPU, nothing is copied.
        **options: `substeps`, `threads`, `keyframe`, `options`, `watch`, `per_env`, `on_fault`, `nconmax`, `njmax`, `model`,
            `prepare`, `graph`: see `SimOptions`. With `substeps=1`, the default, `state` belongs to the instant before the
            step: see `Simulation`.

    Raises:
        ArtifactError: If an asset of the scene is missing or has changed.
        SimulationError: If the device is not supported, an argument is for another device, or the scene lacks bodies or
            joints of the module.
    """
    if not isinstance(touch, TactileModule):
        example = f"tgdsl.compile({touch!r})" if isinstance(touch, (str, PathLike)) else "tgdsl.compile(document)"
        raise SimulationError(f"found a {type(touch).__name__}, expected a module: {example}")
    if misspelt := [name for name in options if name not in SimOptions.__annotations__]:
        hint = did_you_mean(misspelt[0], SimOptions.__annotations__, "options")
        raise SimulationError(f'simulate has no option "{misspelt[0]}"; {hint}')
    device = str(device)
    kind = simulator_for(device)
    kind_options = keyword_options(kind.simulate)
    if unknown := [name for name, value in options.items() if name not in kind_options and value]:
        problem = f'"{kind.name}", which simulates on "{device}", has no option {listed(unknown)}'
        raise SimulationError(f"{problem}; it knows {listed(kind_options)}")
    return kind.simulate(touch, num_envs, **{n: v for n, v in {**options, "device": device}.items() if n in kind_options})


def simulator_for(device: str, name: str | None = None) -> SimulatorKind:
    """Return a simulator: by its name, or the default of a device.

    Args:
        device: Where physics runs.
        name: "mujoco", "warp" or one that a package brings: see `known_sources`.

    Raises:
        SimulationError: If there is no such device or simulator, or MuJoCo is asked for on a GPU.
    """
    simulators = [kind for kind in known_sources() if isinstance(kind, SimulatorKind)]
    type_ = device.partition(":")[0]
    if name is not None:
        by_name = {MUJOCO if kind.name == "simulation" else kind.name: kind for kind in simulators}
        if name not in by_name:
            raise SimulationError(f'simulator is "{name}"; {did_you_mean(name, by_name, "simulators")}')
        if name == MUJOCO and type_ != "cpu":
            raise SimulationError(f'MuJoCo steps on the CPU, and the device is "{device}"; leave `simulator` out')
        return by_name[name]
    results = [kind for kind in simulators if type_ in kind.devices]
    if not results:
        checked_device(device, sorted({type_ for kind in simulators for type_ in kind.devices}, reverse=True))
    return results[0]


def _open_simulator(
    kind: SimulatorKind,
    touch: TactileModule,
    source: str,
    *,
    num_envs: int,
    control_step: float,
    scene: _Scene = None,
    **options: Any,
) -> Connection:
    for term in touch.plan.observations:
        if term.type in HAND_ONLY:
            raise hand_only_error(term.group, term.index, term.type)
    if scene is not None:
        return SimulationConnection(touch, _stepping(scene, control_step))
    options |= {"device": source.partition(":")[2] or kind.devices[0], "substeps": 1}
    names = keyword_options(kind.simulate)
    sim = kind.simulate(touch, num_envs, **{name: value for name, value in options.items() if name in names})
    return SimulationConnection(touch, _with_step(sim, control_step))


def _open_emulator(
    touch: TactileModule,
    source: str,
    *,
    control_step: float,
    keyframe: str | None,
    calibration: _Calibration,
    motion: MotionLimits | None,
    timing: SerialTiming | None,
    lockstep: bool,
    scene: _Scene = None,
) -> Connection:
    known_calibration = _read(calibration) or Calibration.none()
    observer = HandObserver(touch, known_calibration, control_step)
    tips = SimulatedTips(touch, observer.terms)
    if scene is None:
        model = scene_model(touch.plan.scene)
        watch = Watch(joints=tuple(model.joint(int(i)).name for i in joint_ids(model)))
        sim = BatchSimulation(touch, 1, keyframe=keyframe, threads=1, watch=watch)
        scene = SteppedScene(touch, _with_step(sim, control_step))
    _stepping(scene, control_step)
    if not lockstep:
        _refuse_unfit_steps(control_step, motion, timing)
    actuators = moved_joints(touch, motion)
    body = SimulatedBody(scene, tips, known_calibration)
    hand = EmulatedSource(
        body, control_step=control_step, calibration=known_calibration, motion=motion, timing=timing, lockstep=lockstep
    )
    return HandConnection(hand, observer, actuators, "the emulated hand")


def _open_hand(
    touch: TactileModule,
    source: str,
    *,
    control_step: float,
    calibration: _Calibration,
    motion: MotionLimits | None,
    addresses: Addresses | None,
    timing: SerialTiming | None,
    lockstep: bool,
) -> Connection:
    known_calibration = _read(calibration) or Calibration.none()
    if lockstep:
        raise HandError("a real hand moves in its own time: lockstep is for emulators and logs")
    observer = HandObserver(touch, known_calibration, control_step)
    actuators = moved_joints(touch, motion)
    _refuse_unfit_steps(control_step, motion, timing)
    warn_of_noise(touch.plan)
    with ExitStack() as opened:
        port = source.partition(":")[2] or _only_port()
        hand = opened.enter_context(XHand1.open(port, addresses, motion=motion, timing=timing))
        stepped = XHand1Source(hand, control_step=control_step, calibration=known_calibration)
        opened.pop_all()
    return HandConnection(stepped, observer, actuators, "the hand")


def _open_log(
    touch: TactileModule, source: str, *, control_step: float, calibration: _Calibration, lockstep: bool
) -> Connection:
    speed = math.inf if lockstep else 1.0
    replay = ReplaySource(Path(source), control_step=control_step, speed=speed, calibration=_read(calibration))
    observer = HandObserver(touch, replay.calibration, control_step, is_log=True)
    warn_of_noise(touch.plan)
    return HandConnection(replay, observer, None)


SOURCES: tuple[SourceKind, ...] = (
    SimulatorKind(
        "simulation",
        '"simulation"',
        recognise=lambda source: source == "simulation",
        devices=("cpu",),
        simulate=BatchSimulation,
    ),
    SourceKind("emulator", '"emulator"', _open_emulator, recognise=lambda source: source == "emulator"),
    SourceKind("xhand1", '"xhand1", "xhand1:PORT"', _open_hand),
    SimulatorKind("warp", '"warp", "warp:DEVICE"', devices=("cuda",), simulate=WarpSimulation),
    SourceKind("log", 'the path of a log, "….npz"', _open_log, recognise=lambda source: source.endswith(".npz")),
)
"""The kinds of tgdsl."""


def _wrong(kind: object) -> str:
    return "" if isinstance(kind, SourceKind) else f"found {type(kind).__name__}, expected a {SourceKind.__name__}"


known_sources = Registry("tgdsl.sources", "source", "kinds of sources", SOURCES, _wrong).known
"""Returns all kinds of sources: see `tgdsl.files.plugins.Registry.known`."""


def kind_of(source: str) -> SourceKind:
    """Return the kind of the source that a user named.

    Raises:
        TgdslError: If no kind recognises it.
    """
    kinds = known_sources()
    for kind in kinds:
        if kind.recognises(source):
            return kind
    *most, last = (kind.expected for kind in kinds)
    raise TgdslError(f'unknown source "{source}"; expected {", ".join(most)} or {last}')


def _with_step(sim: Simulation, control_step: float) -> Simulation:
    timestep = float(sim.model.opt.timestep)
    sim.substeps = round(control_step / timestep)
    if sim.substeps < 1 or abs(sim.control_step - control_step) > 1e-6 * timestep:
        problem = f"a control step of {control_step:g} s"
        raise SimulationError(f"{problem}, expected a whole number of the scene's physics steps of {timestep:g} s")
    return sim


def _stepping(scene: SteppedScene, control_step: float) -> SteppedScene:
    if abs(scene.control_step - control_step) > 1e-9:
        raise SimulationError(f"control steps of {control_step:g} s, and the scene's are {scene.control_step:g} s")
    return scene


def _refuse_unfit_steps(control_step: float, motion: MotionLimits | None, timing: SerialTiming | None) -> None:
    """Raise an error for control steps that are shorter than an exchange on the line, or longer than the watchdog waits."""
    shortest = (timing or SerialTiming()).exchange_s
    if 0 < control_step < shortest:
        problem = f"control steps of {1e3 * control_step:g} ms ({1 / control_step:.0f} per second)"
        raise HandError(f"{problem}, and an exchange takes {1e3 * shortest:.2f} ms: at most {1 / shortest:.0f} per second")
    refuse_beyond_watchdog(control_step, None if motion is None else motion.watchdog_s)


def _read(calibration: _Calibration) -> Calibration | None:
    return load_calibration(Path(calibration)) if isinstance(calibration, (str, Path)) else calibration


def _only_port() -> str:
    ports = [port.device for port in list_ports() if port.device.startswith(_USB_PORTS)]
    if len(ports) != 1:
        port_names = listed(ports) or "none"
        raise HandError(f'expected one USB serial port, found {port_names}; name the hand\'s: source="xhand1:/dev/ttyUSB0"')
    return ports[0]
