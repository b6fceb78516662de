"""A source as a policy sees it: stepped, observed and reset, whatever is behind it; and the kinds of sources that register.

Shapes: `env` environments, `feature` numbers of an observation.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import ObservationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.closable import Closable
from tgdsl.runtime.simulators.simulation import Simulation
from tgdsl.runtime.simulators.state_values import Control
from tgdsl.runtime.stepped_scene import SteppedScene
from tgdsl.tensors.env_ids import EnvIds


@runtime_checkable
class Source(Protocol):
    """Environments that are stepped: what a connection needs of a simulator, a hand or a recording."""

    @property
    def num_envs(self) -> int: ...

    @property
    def control_step(self) -> float:
        """Duration of one control step [s]."""
        ...

    def step(self, control: Control = None) -> None:
        """Advance all environments by one control step."""
        ...

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Begin a new episode in some environments (default: all)."""
        ...

    def close(self) -> None:
        """Release the simulator, the device or the file."""
        ...


class Connection(Closable, ABC):
    """A source, as a policy sees it. Use it as a context manager, or call `close`.

    A kind of source supplies `read`, and where it differs `send` and `restart`.

    Attributes:
        source: The source: a `BatchSimulation`, an `XHand1Source`, an `EmulatedSource`, a `ReplaySource` or another.
    """

    def __init__(self, source: Source):
        self.source = source
        self._groups: dict[str, Tensor] | None = None
        self._is_read = True

    @abstractmethod
    def read(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Read the sensors: the module's observation groups at this instant. `observe` calls it once per step or reset."""

    def send(self, control: Control) -> None:
        """Advance the source by one control step, with controls in the order of the model's actuators."""
        self.source.step(control)

    def restart(self, env_ids: EnvIds | None) -> None:
        """Reset the source, and forget past observations."""
        self.source.reset(env_ids)

    @property
    def num_envs(self) -> int:
        return self.source.num_envs

    @property
    def control_step(self) -> float:
        return self.source.control_step

    @property
    def is_over(self) -> bool:
        """Whether a log is at its end; other sources never are."""
        return False

    @property
    def age_s(self) -> float | None:
        """How old what `observe` returns is at most, now [s]; None where nothing runs in real time."""
        return None

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
        self.send(control)
        self._is_read = True

    def observe(self) -> dict[str, Float[Tensor, "env feature"]]:
        """Return the module's observation groups, in its dtype and on its device; the same until the next step or reset.

        The sensors are read at the first call after a step or a reset: `rate` and `history` count these.

        Raises:
            ObservationError: If the last step or reset failed, so that there is nothing new.
        """
        if not self._is_read:
            raise ObservationError("the last step or reset failed, so there is nothing new to observe; step or reset again")
        if self._groups is None:
            self._groups = self.read()
        return dict(self._groups)

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Restart some environments (default: all): a simulation from its keyframe, a hand where it is, passive."""
        self._groups, self._is_read = None, False
        self.restart(env_ids)
        self._is_read = True

    def resume(self) -> None:
        """Allow a hand that an error made passive to move again; other sources do nothing."""
        return

    def close(self) -> None:
        """Release the source; a hand becomes passive.

        Raises:
            HandError: If a hand was moving and did not confirm that it is passive.
        """
        self.source.close()


class SimulationConnection(Connection):
    """A connection to a simulator of the module's scene, or to a scene that reads the module's sensors itself."""

    def __init__(self, touch: TactileModule, source: Simulation | SteppedScene):
        super().__init__(source)
        self._touch, self._scene = touch, source

    def read(self) -> dict[str, Float[Tensor, "env feature"]]:
        scene = self._scene
        return self._touch.observe(scene.readings if isinstance(scene, SteppedScene) else self._touch(scene.state()))


@dataclass(frozen=True)
class SourceKind:
    """A kind of source that `tgdsl.connect` can open."""

    name: str  #: its name, by which it is also recognised: alone, or with an address, "name:ADDRESS"
    expected: str  #: how users name a source of this kind, as errors list it: '"name" or "name:ADDRESS"'
    #: opens a source: `open(touch, source, *, option, …)`, given the module and the source as the user named it. The options
    #: that it knows are its keyword-only parameters: options of `connect`, and more.
    open: Callable[..., Connection]
    #: whether a source that a user named is of this kind; default: if its name is the kind's
    recognise: Callable[[str], bool] | None = None

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options that it knows."""
        return keyword_options(self.open)

    def recognises(self, source: str) -> bool:
        return source.partition(":")[0] == self.name if self.recognise is None else self.recognise(source)


@dataclass(frozen=True, kw_only=True)
class SimulatorKind(SourceKind):
    """A kind of source that `tgdsl.simulate` can make too."""

    #: default: the simulation that `simulate` makes, of the module's or a task's scene
    open: Any = field(default=None, kw_only=False)
    devices: tuple[str, ...]  #: types of torch devices that it is the default simulator of: "cpu", "cuda"
    simulate: Callable[..., Any]  #: makes a simulation: `simulate(touch, num_envs, *, device, option, …)`

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the options that it knows."""
        if self.open is not None:
            return keyword_options(self.open)
        fixed = ("device", "substeps", "model")  # by the source, by `control_step` and by the module
        return ("num_envs", "control_step", "scene", *(name for name in keyword_options(self.simulate) if name not in fixed))


def keyword_options(call: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of a function's keyword-only parameters; of a `Simulation` that takes any, its `OPTIONS` too."""
    parameters = inspect.signature(call).parameters.values()
    names = tuple(p.name for p in parameters if p.kind is p.KEYWORD_ONLY)
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters)
    return (*getattr(call, "OPTIONS", ()), *names) if takes_any else names
