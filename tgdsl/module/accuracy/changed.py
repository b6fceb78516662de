"""States made of another: the scene moved, some of its environments."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tgdsl.module.state import SHAPES, SceneState
from tgdsl.quantities.contacts import SLOT_FIELDS


def moved(state: SceneState, offset: np.ndarray, turn: Rotation) -> SceneState:
    """Return the whole scene, rotated about the origin and then shifted [m]; float64."""
    rotation = torch.from_numpy(turn.as_matrix())
    values = {name: getattr(state, name) for name in (*SHAPES, "dt")}
    for name in ("body_pos", "body_linvel", "body_angvel", *SLOT_FIELDS, "contact_netforce"):
        if values[name] is not None:
            values[name] = values[name].double() @ rotation.T
    values["body_pos"] = values["body_pos"] + torch.from_numpy(offset)
    if values["contact_pos"] is not None:
        is_used = (values["contact_normal"] != 0).any(dim=-1, keepdim=True)
        values["contact_pos"] = torch.where(is_used, values["contact_pos"] + torch.from_numpy(offset), 0.0)
    quats = Rotation.from_quat(values["body_quat"].reshape(-1, 4).numpy(), scalar_first=True)
    turned = torch.from_numpy((turn * quats).as_quat(scalar_first=True))
    values["body_quat"] = turned.reshape(values["body_quat"].shape)
    return SceneState(**values, substeps=tuple(moved(part, offset, turn) for part in state.substeps))


def only(state: SceneState, envs: Any) -> SceneState:
    """Return some of the environments of a state."""
    values: dict[str, Any] = {name: getattr(state, name) for name in (*SHAPES, "dt")}
    chosen: dict[str, Any] = {name: value[envs] if isinstance(value, Tensor) else value for name, value in values.items()}
    return SceneState(**chosen, substeps=tuple(only(part, envs) for part in state.substeps))
