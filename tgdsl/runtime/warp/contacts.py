"""Contacts between links and objects, read from MuJoCo Warp's own contacts and constraint forces by one kernel.

They are what the contact sensors of `tgdsl.instrument` hand out, without what these cost in MuJoCo Warp: memory for 64 contacts
per environment and sensor, each contact matched with each sensor, a sort.

Shapes: `env` environments, `pair` and `slot` as the module's `inputs` list them, `sensor` sensors of a model.
"""

from __future__ import annotations

import functools
import math
from importlib.metadata import version
from operator import attrgetter
from typing import Any, no_type_check

import mujoco
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import SimulationError
from tgdsl.module.state import shape_of
from tgdsl.plan.inputs import Inputs, contact_sensor_names
from tgdsl.quantities.contacts import SLOT_FIELDS
from tgdsl.runtime.by_name import pair_rows
from tgdsl.runtime.simulators.model_ids import model_geoms
from tgdsl.runtime.warp.stream import libraries

TRIED = ("3.11.0", "3.17.0")  # versions of MuJoCo Warp that have these parts as they are used here


def contact_force_function(mjw: Any) -> Any:
    """Return the Warp function of a contact's force and torque in its frame, for use inside a kernel.

    The public `mujoco_warp.contact_force` is a kernel's launch over a list of contacts: a kernel can call a function, but no
    kernel, and to launch both would need the list, and memory for its answers, on the device.
    """
    return _part(mjw, "support.contact_force_fn")


def constraint_contact_bit(mjw: Any) -> int:
    """Return the bit of `Contact.type` for contacts with constraints; contacts for sensors alone lack it.

    `Contact.type` is public, the enumeration of its values is not.
    """
    return int(_part(mjw, "types.ContactType.CONSTRAINT"))


def _part(mjw: Any, path: str) -> Any:
    try:
        return attrgetter(path)(mjw._src)
    except AttributeError as error:
        tried = ", ".join(TRIED)
        problem = f"MuJoCo Warp {version('mujoco-warp')} has no `{path}`, which contacts are read with"
        raise SimulationError(f"{problem}; tried was {tried}") from error


# pyright: reportInvalidTypeForm=false


_VECTORS = ("contact_pos", "contact_normal", "contact_force", "contact_torque", "contact_netforce")
"""Fields of vectors, in the order of the kernel's arguments."""


class PairContacts:
    """Contacts of the pairs that a module needs, on the device, with the fields that it needs.

    Pairs of the same link whose objects have the same geoms share one search. Contacts fill slots in arbitrary order; if there
    are more than slots, an arbitrary subset stays, but the net force includes all. Contacts that a `gap` adds beyond the margin
    carry no force and do not count.
    """

    # live tensors (env, row, …) of the fields of a state, float32; a row is a link and an object's geoms. Where slots are
    # wanted, `contact_found` is among them.
    arrays: dict[str, Float[Tensor, "env ..."]]

    def __init__(self, inputs: Inputs, model: mujoco.MjModel, num_envs: int, device: torch.device):
        wp, mjw = libraries()
        self._fields = [name for name in ("contact_found", *_VECTORS) if name in inputs.fields]
        rows = pair_rows(inputs, model_geoms(model))
        self._row_of_pair: Int[Tensor, " pair"] | None = None
        if rows.num_rows < len(inputs.pairs):
            self._row_of_pair = torch.from_numpy(rows.row_of_pair).to(device)
        names = list(self._fields)
        if any(name in names for name in SLOT_FIELDS) and "contact_found" not in names:
            names.append("contact_found")  # it says which slot is free
        shapes = {name: (num_envs, rows.num_rows, *shape_of(name, inputs)[1:]) for name in names}
        # One piece of memory, which one call clears.
        self._memory = torch.zeros(sum(math.prod(shape) for shape in shapes.values()), dtype=torch.float32, device=device)
        pieces = self._memory.split([math.prod(shape) for shape in shapes.values()])
        self.arrays = {name: part.view(shape) for (name, shape), part in zip(shapes.items(), pieces, strict=True)}
        self._launch, self._kernel = wp.launch, _kernel(wp, mjw)
        self._outputs: list[Any] = [
            *(
                wp.array(table, dtype=int, device=wp.device_from_torch(device))
                for table in (rows.link_of_geom, rows.row_of_geoms)
            ),
            inputs.slots,
            wp.from_torch(self.arrays["contact_found"]) if "contact_found" in names else None,
            *(wp.from_torch(self.arrays[name], dtype=wp.vec3) if name in names else None for name in _VECTORS),
        ]

    def update(self, warp_model: Any, warp_data: Any) -> None:
        """Read MuJoCo Warp's contacts, of the instant that `forward` or `step` has left there: for a `GraphedCall`."""
        if not self.arrays:
            return
        self._memory.zero_()
        pool = warp_data.contact
        inputs = [warp_model.opt.cone, warp_data.nacon, pool.worldid, pool.geom, pool.type, pool.pos]
        inputs += [pool.dist, pool.includemargin, pool.frame, pool.friction, pool.dim, pool.efc_address]
        inputs += [getattr(pool, "adhesion", None)]  # MuJoCo Warp 3.11 has none
        inputs += [warp_data.efc.force, warp_data.njmax]
        self._launch(self._kernel, dim=warp_data.naconmax, inputs=inputs, outputs=self._outputs)

    def read(self) -> dict[str, Float[Tensor, "env pair ..."]]:
        """Return the requested fields as new tensors."""
        rows = self._row_of_pair
        return {name: self.arrays[name].clone() if rows is None else self.arrays[name][:, rows] for name in self._fields}


def foreign_sensors(model: mujoco.MjModel, inputs: Inputs) -> Int[np.ndarray, " sensor"]:
    """Return the indices of a model's sensors, without the sensors of a module's contacts."""
    parts = [(pair, i) for pair in inputs.pairs for i in range(len(inputs.touching(pair)))]
    ours = {name for pair, i in parts for name in contact_sensor_names(pair, i)}
    is_contact = model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT
    is_ours = [bool(is_contact[i]) and model.sensor(i).name in ours for i in range(model.nsensor)]
    return np.flatnonzero(~np.array(is_ours, dtype=bool))


@functools.cache
@no_type_check
def _kernel(wp: Any, mjw: Any) -> Any:
    """Return the kernel: one thread per contact. Outputs that are None are skipped."""
    # The normal points from the first geom's body to the second's. MuJoCo's sensor keeps it if the first one is the object.
    # Else it negates the normal and the tangent, but not their cross product, and negates force and torque along the latter
    # in this frame: in the world both change sign, as the normal does.
    wrench_of = contact_force_function(mjw)
    has_adhesion = "contact_adhesion_in" in wrench_of.input_types
    constraint = wp.constant(constraint_contact_bit(mjw))

    # fmt: off
    @wp.kernel(enable_backward=False)
    def gather(
        cone: int, nacon: wp.array[int], world: wp.array[int], geom: wp.array[wp.vec2i],
        kind: wp.array[int], pos: wp.array[wp.vec3], dist: wp.array[float], margin: wp.array[float], frame: wp.array[wp.mat33],
        friction: Any, dim: wp.array[int], efc_address: wp.array2d[int], adhesion: wp.array[float],
        efc_force: wp.array2d[float], njmax: int,
        link_of: wp.array[int], row_of: wp.array3d[int], num_slots: int, found: wp.array2d[float], place: wp.array3d[wp.vec3],
        normal: wp.array3d[wp.vec3], force: wp.array3d[wp.vec3], torque: wp.array3d[wp.vec3], netforce: wp.array2d[wp.vec3],
    ):
        # fmt: on
        contact = wp.tid()
        if contact >= nacon[0]:
            return
        geoms = geom[contact]
        if (kind[contact] & constraint) == 0 or geoms[0] < 0 or geoms[1] < 0:  # a flex has no geom
            return
        if dist[contact] >= margin[contact] and efc_address[contact, 0] < 0:  # a gap alone brings no force
            return
        env = world[contact]
        for turned in range(2):  # a geom may be the object's of one pair and the link's of another
            for layer in range(row_of.shape[0]):  # and it may be of several objects
                row = row_of[layer, geoms[turned], link_of[geoms[1 - turned]]]
                if row >= 0:
                    sign = 1.0 - 2.0 * float(turned)
                    slot = num_slots
                    if found:
                        slot = int(wp.atomic_add(found, env, row, 1.0))
                    is_kept = slot < num_slots
                    if netforce or (is_kept and (force or torque)):
                        if wp.static(has_adhesion):
                            wrench = wrench_of(
                                cone, frame, friction, dim, efc_address, adhesion, efc_force, njmax, nacon, env, contact, True
                            )
                        else:
                            wrench = wrench_of(
                                cone, frame, friction, dim, efc_address, efc_force, njmax, nacon, env, contact, True
                            )
                        if netforce:
                            wp.atomic_add(netforce, env, row, sign * wp.spatial_top(wrench))
                        if force and is_kept:
                            force[env, row, slot] = sign * wp.spatial_top(wrench)
                        if torque and is_kept:
                            torque[env, row, slot] = sign * wp.spatial_bottom(wrench)
                    if place and is_kept:
                        place[env, row, slot] = pos[contact]
                    if normal and is_kept:
                        normal[env, row, slot] = sign * frame[contact][0]

    return gather
