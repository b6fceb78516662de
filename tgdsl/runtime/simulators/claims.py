"""What no simulation can do, and which simulation reads a module that has state: one at a time."""

from __future__ import annotations

import gc
import weakref

import mujoco

from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.runtime.source import Source
from tgdsl.scene.options import Options

_READERS: weakref.WeakKeyDictionary[TactileModule, weakref.ref[Source]] = weakref.WeakKeyDictionary()
"""Which simulation reads a module that has state."""


def _reader(touch: TactileModule) -> Source | None:
    result = _READERS.get(touch)
    return None if result is None else result()


def refuse_unfit(
    touch: TactileModule, num_envs: int, substeps: int, model: mujoco.MjModel | None, options: Options | None = None
) -> None:
    """Refuse what no simulation can do.

    Raises:
        SimulationError: If there is nothing to step, a model of one's own is given for objects that differ, or options beside
            it, or the module's state is another simulation's or of other environments.
    """
    if num_envs < 1 or substeps < 1:
        raise SimulationError(f"num_envs is {num_envs} and substeps {substeps}, expected at least 1 of each")
    if model is not None and touch.inputs.objects:
        what = f"object {touch.inputs.objects[0]} differs between environments, which one model cannot"
        raise SimulationError(f"{what}; leave `model` out")
    if model is not None and options:
        raise SimulationError("`options` are for the artefact's scene; a model of your own has them in its `opt`")
    if not touch.has_state:
        return
    if _reader(touch) is not None:
        gc.collect()  # a simulation that nobody holds may still hold itself
    other = _reader(touch)
    if other is not None:
        raise SimulationError(
            f"this module is read by a simulation of {other.num_envs} environments, whose state it holds; `close` that one, or "
            "give this one a module of its own: tgdsl.compile(...) again, or copy.deepcopy(touch)"
        )
    if touch.num_envs not in (None, num_envs):
        what = f"this module holds the state of {touch.num_envs} environments, and num_envs is {num_envs}"
        raise SimulationError(f"{what}; touch.free() frees it")


def claim(touch: TactileModule, sim: Source) -> None:
    """Note that a simulation reads a module."""
    if touch.has_state:
        _READERS[touch] = weakref.ref(sim)


def release(touch: TactileModule, sim: Source) -> None:
    """Note that a simulation no longer reads a module."""
    if _reader(touch) is sim:
        del _READERS[touch]


def refuse_two_instants(model: mujoco.MjModel, sleep: str) -> None:
    """Refuse a model whose state would not be of one instant.

    Args:
        model: The scene.
        sleep: What to say if its bodies may sleep.

    Raises:
        SimulationError: If the integrator is RK4, or sleeping is enabled.
    """
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        raise SimulationError("with the integrator RK4 MuJoCo's poses and contacts are of two instants; choose another one")
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        raise SimulationError(sleep)
