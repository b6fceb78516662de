"""One way to step and observe, whatever is behind it: a simulation, a real hand, an emulated one, or a recorded log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.module.module import TactileModule
from tgdsl.module.taxels.identity import Taxels, check_taxels
from tgdsl.runtime.connection import Connection as Connection
from tgdsl.runtime.known import known_sources
from tgdsl.runtime.source_kind import SourceKind
from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.runtime.xhand1.calibration import Calibration
from tgdsl.runtime.xhand1.motion import MotionLimits
from tgdsl.runtime.xhand1.wire.client import SerialTiming
from tgdsl.runtime.xhand1.wire.replies import Addresses

CONTROL_STEP = 0.02


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
    **own: Any,
) -> Connection:
    """Connect a module to what it shall feel.

    Args:
        touch: The module; while an emulator is connected, it is the emulator's.
        source: `simulation`: its own scene, in MuJoCo. `emulator`: the same behind the serial protocol of an XHand1.
            `xhand1`: the hand on the only USB serial port; `xhand1:/dev/ttyUSB0`: on this one. A path that ends in `.npz`: a
            recorded log. `warp`: its own scene in MuJoCo Warp on a GPU; `warp:cuda:1`: on this one. Installed packages may
            bring others, see `tgdsl.runtime.known`.
        num_envs: Number of environments; more than 1 only for a simulation.
        control_step: Duration of one control step [s]; in a scene, a whole number of physics steps.
        keyframe: Keyframe that a scene starts from; default: the model's own initial state.
        calibration: What a hand's counts mean, or the file that says it; default: of a log its own, else they stay counts.
        motion: Leave for a hand to move, and how far; default: it is only read. A simulation needs none.
        addresses: Which hand on the line; default: the one with id 0.
        timing: Times of the line. Where replies may take long, a step waits for a reading as long as two of them.
        lockstep: Nothing runs in real time: the emulator's scene moves when stepped, a log is read as fast as possible. A
            simulation is always so, a real hand never.
        taxels: The taxels that the module shall have, such as those that a policy learned with: another module, its tables, an
            artefact, a rollout or an id, see `module.taxels.identity.check_taxels`.
        scene: A scene of one's own, such as a task's, that a simulation or an emulator steps in place of the module's; it is
            closed with the connection, and brings its own start in place of the keyframe.
        **own: Options of this kind of source alone, such as the `nconmax` and `njmax` of `warp`. Those above are left out
            where a source has no use for them, so that one script serves all.

    Raises:
        TaxelError: If the module has other taxels than expected, or in another order. Nothing was opened then.
        ObservationError: If the source cannot give what the module observes. No hand was touched then.
        SpecError: If the calibration file has mistakes.
        SimulationError: If the scene cannot be stepped like this.
        HandError: If the hand does not answer, or may not move like this.
        TgdslError: If there is no such source, or it has no such option.
    """
    name = str(source)
    kind = kind_of(name)
    if taxels is not None:
        check_taxels(touch, taxels)
    if num_envs != 1 and "num_envs" not in kind.options:
        raise TgdslError(f'num_envs is {num_envs}, but "{name}" is one environment')
    shared: dict[str, Any] = {"num_envs": num_envs, "control_step": control_step, "keyframe": keyframe, "motion": motion}
    shared |= {"calibration": calibration, "addresses": addresses, "timing": timing, "lockstep": lockstep, "scene": scene}
    for option in own:
        if option not in kind.options:
            raise TgdslError(f'"{name}" has no option "{option}"; {did_you_mean(option, kind.options, "options")}')
    return kind.open(touch, name, **{option: shared[option] for option in kind.options if option in shared}, **own)


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
