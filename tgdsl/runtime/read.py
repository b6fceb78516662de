"""States of scenes that others step with MuJoCo or MuJoCo Warp."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import torch

from tgdsl.errors import SimulationError
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState
from tgdsl.plan.inputs import Inputs
from tgdsl.runtime.by_name import Geoms, contacts_by_pair
from tgdsl.runtime.simulators.fields import StateReader
from tgdsl.runtime.simulators.model_ids import model_geoms
from tgdsl.runtime.warp.contacts import PairContacts
from tgdsl.runtime.warp.stream import GraphedCall, WarpStream, libraries, view

_CPU = torch.device("cpu")
_CONTACT_ARRAYS = ("geom", "pos", "dist", "includemargin", "efc_address")


def read_mujoco(
    touch: TactileModule, model: mujoco.MjModel, data: mujoco.MjData | Sequence[mujoco.MjData], *, inputs: Inputs | None = None
) -> SceneState:
    """Return the state of a scene that `mujoco.mj_step` steps: tensors (env, …), float64, on the module's device.

    Set the controls and call `mj_forward` first: `mj_step` leaves poses, velocities and contacts one step behind joints, and
    contact forces depend on the controls. Fields that MuJoCo does not know, such as `dt` and `variant`, are None.

    Args:
        touch: The module that will read the state.
        model: The scene. It needs no contact sensors.
        data: Its data, or the data of several environments.
        inputs: `touch.inputs.renamed(…)` if names differ. By default "palm" also matches one name such as "robot/palm".

    Raises:
        SimulationError: If the scene lacks a body, a joint or an actuator, or several names match one; if `data` was never
            evaluated.
    """
    named = inputs or touch.inputs
    reader, geoms = _reader(touch, named, (model,), lambda: (StateReader(named, model, _CPU), model_geoms(model)))
    envs: list[mujoco.MjData] = list(data) if isinstance(data, Sequence) else [data]
    if any(not env.xquat[0].any() for env in envs):  # the world's orientation, which MuJoCo sets at the first evaluation
        raise SimulationError("the poses of this MjData are not computed yet; call mujoco.mj_forward(model, data) first")
    arrays = {name: torch.from_numpy(np.stack([getattr(env, name) for env in envs])) for name in reader.arrays}
    fields: dict[str, Any] = reader.read(arrays) | _contacts(named, model, geoms, envs)
    time = torch.tensor([env.time for env in envs], dtype=torch.float64)
    return SceneState(**fields, time=time).to(touch.device)


def _contacts(inputs: Inputs, model: mujoco.MjModel, geoms: Geoms, envs: Sequence[mujoco.MjData]) -> dict[str, torch.Tensor]:
    """Return the contacts of some environments by pair; those beyond the margin, which a `gap` adds, are none."""
    every = [env.contact for env in envs]
    frames = np.concatenate([contact.frame for contact in every]).reshape(-1, 3, 3)
    wrenches = np.zeros((len(frames), 6))
    places = [(env, i) for env in envs for i in range(env.ncon)]
    for (env, i), wrench in zip(places, wrenches, strict=True):
        mujoco.mj_contactForce(model, env, i, wrench)
    in_world = np.einsum("nvi,nij->nvj", wrenches.reshape(-1, 2, 3), frames)
    column = {name: np.concatenate([getattr(contact, name) for contact in every]) for name in _CONTACT_ARRAYS}
    is_contact = (column["dist"] < column["includemargin"]) | (column["efc_address"] >= 0)
    tensor = torch.from_numpy
    return contacts_by_pair(
        inputs,
        geoms,
        tensor(column["geom"]),
        pos=tensor(column["pos"]),
        normal=tensor(frames[:, 0]),
        force=tensor(in_world[:, 0]),
        torque=tensor(in_world[:, 1]),
        env=torch.repeat_interleave(torch.tensor([env.ncon for env in envs])),
        num_envs=len(envs),
        is_contact=tensor(is_contact),
    )


def read_warp(
    touch: TactileModule, mj_model: mujoco.MjModel, model: Any, data: Any, *, inputs: Inputs | None = None
) -> SceneState:
    """Return the state of a scene that MuJoCo Warp steps: tensors (env, …), float32, on the device of `data`.

    Reads MuJoCo Warp's arrays in place, ordered by torch's and Warp's current streams. From the second call on it can be
    captured in a `torch.cuda.graph`. It needs no contact sensors. Call `mujoco_warp.forward` first, as for `read_mujoco`.

    Args:
        touch: The module that will read the state, on the device of `data`.
        mj_model: The scene.
        model: MuJoCo Warp's model of it.
        data: MuJoCo Warp's data; its arrays must stay the same ones.
        inputs: As for `read_mujoco`.

    Raises:
        SimulationError: If the scene lacks a body, a joint or an actuator, or several names match one; if the module is on
            another device; if this version of MuJoCo Warp has other contact arrays.
    """
    named = inputs or touch.inputs
    return _reader(touch, named, (mj_model, model, data), lambda: _warp_reader(touch, named, mj_model, model, data))()


def _warp_reader(
    touch: TactileModule, inputs: Inputs, mj_model: mujoco.MjModel, model: Any, data: Any
) -> Callable[[], SceneState]:
    wp, _ = libraries()
    device = torch.device(wp.device_to_torch(data.qpos.device))
    if touch.device != device:
        raise SimulationError(f"the module is on {touch.device}, physics on {device}; touch.to({str(device)!r}) moves it there")
    stream = WarpStream(str(device), graph=False)
    with stream.scope():
        reader = StateReader(inputs, mj_model, device)
        arrays = {name: view(wp, getattr(data, name), device) for name in ("time", *reader.arrays)}
        contacts = PairContacts(inputs, mj_model, data.nworld, device)

    def state() -> SceneState:
        contacts.update(model, data)
        fields: dict[str, Any] = reader.read(arrays) | contacts.read()
        return SceneState(**fields, time=arrays["time"].clone())

    return GraphedCall(stream, state)


_HELD: weakref.WeakKeyDictionary[TactileModule, tuple[Inputs, tuple[Any, ...], Any]] = weakref.WeakKeyDictionary()
"""The last reader of each module, and its inputs and scene: names are looked up when it is first used with a scene."""


def _reader(touch: TactileModule, inputs: Inputs, scene: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    held = _HELD.get(touch)
    if held is None or held[0] != inputs or [*map(id, held[1])] != [*map(id, scene)]:
        held = _HELD[touch] = inputs, scene, make()
    return held[2]
