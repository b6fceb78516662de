"""Where in a model stands what a module wants: bodies, contact sensors, keyframes."""

from __future__ import annotations

import mujoco

from tgdsl.errors import SimulationError, did_you_mean
from tgdsl.plan import Pair, contact_sensor_names


def body_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a body.

    Raises:
        SimulationError: If there is none of that name.
    """
    try:
        return int(model.body(name).id)
    except KeyError as error:
        known = [model.body(i).name for i in range(model.nbody)]
        raise SimulationError(f'the scene has no body "{name}"; {did_you_mean(name, known, "bodies")}') from error


def keyframe_id(model: mujoco.MjModel, name: str) -> int:
    """Return the index of a keyframe.

    Raises:
        SimulationError: If there is none of that name.
    """
    try:
        return int(model.key(name).id)
    except KeyError as error:
        known = [model.key(i).name for i in range(model.nkey)]
        raise SimulationError(f'the scene has no keyframe "{name}"; {did_you_mean(name, known, "keyframes")}') from error


def contact_sensor(model: mujoco.MjModel, pair: Pair, which: int) -> range:
    """Return where a pair's contact sensor (0: slots, 1: net force) stands in `sensordata`.

    Raises:
        SimulationError: If the model lacks it.
    """
    name = contact_sensor_names(pair)[which]
    try:
        sensor = model.sensor(name)
    except KeyError as error:
        what = f'the scene has no contact sensor "{name}", which the module wants'
        raise SimulationError(f"{what}; add them with tgdsl.instrument(spec, touch.inputs) before compiling") from error
    return range(int(sensor.adr[0]), int(sensor.adr[0] + sensor.dim[0]))
