"""The state of a scene: what a module reads of simulators and hardware.

Shapes: `env` environments, `body` bodies of a module's `inputs.bodies`, `pair` pairs of its `inputs.pairs`, `slot` contacts per
pair, `object` objects of its `inputs.objects`, `heated` objects of its `inputs.heated`, `joint` joints of its `inputs.joints`,
`actuator` actuators of its `inputs.actuators`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import StateError, listed
from tgdsl.plan.inputs import Inputs

SHAPES: dict[str, tuple[str | int, ...]] = {
    "body_pos": ("body", 3),
    "body_quat": ("body", 4),
    "body_linvel": ("body", 3),
    "body_angvel": ("body", 3),
    "contact_found": ("pair",),
    "contact_pos": ("pair", "slot", 3),
    "contact_force": ("pair", "slot", 3),
    "contact_torque": ("pair", "slot", 3),
    "contact_normal": ("pair", "slot", 3),
    "contact_netforce": ("pair", 3),
    "variant": ("object",),
    "object_size": ("object", 3),
    "object_temperature": ("heated",),
    "object_material": ("heated",),
    "joint_pos": ("joint",),
    "joint_vel": ("joint",),
    "joint_effort": ("joint",),
    "last_action": ("actuator",),
}
"""Shape of each tensor of a `SceneState`, after the leading `env`."""
CHOICES = ("variant", "object_material")  # fields that say which of several things an object is: integers


@dataclass
class SceneState:
    """What a simulator (or hardware) says of all environments at one instant. Only what `inputs.fields` names is read.

    All is in world axes. Float tensors may be float64 whatever the module's dtype: relative poses are formed in the state's
    dtype and then cast, so that far from the origin nothing is lost.

    A number that is none is not taken for zero: whatever depends on it, in its environment, is read as not-a-number, what
    `contact_found` gates included. Poses that are none are warned of once on the CPU. A GPU would have to be waited for, so
    there `readings[name].isnan()` tells. A slot is unused where force, torque and normal are all zero; where it is then does
    not matter. A contact whose normal is zero acts where it is, and what needs its normal is read as not-a-number.

    Attributes:
        body_pos: Position of each body's frame [m].
        body_quat: Orientation of each body, w, x, y, z.
        body_linvel: Velocity of the body frame's origin, not of the centre of mass [m/s].
        body_angvel: Angular velocity of the body [rad/s].
        contact_found: Whether each (link, object) pair is in contact: boolean, or a number that is then positive, as that
            of contacts is. An object's contacts are those on the geoms of `inputs.parts_of`, a link's
            those on the geoms of `inputs.parts_of_link`.
        contact_pos: Contact points [m].
        contact_force: Force on the link at each point [N].
        contact_torque: Torque on the link at each point [N·m].
        contact_normal: Unit normal out of the object at each point.
        contact_netforce: The pair's whole force on the link [N]. What the slots lack of it acts at the centre of those.
        variant: Which of its variants each object has, from 0; 0 for one that has none.
        object_size: Size of each object as MuJoCo defines it [m], such as half-lengths; read of those with `size: per_env`.
        object_temperature: Temperature at which each object that holds heat begins an episode [°C]; read of those with
            `temperature: {per_env: …}`.
        object_material: Which of its materials each of these is of, from 0; 0 for one that has just one.
        joint_pos: Position of each joint, of the same instant as the bodies' poses [rad; slides: m].
        joint_vel: Velocity of each joint, of that instant [rad/s; slides: m/s].
        joint_effort: What the actuators exert on each joint at that instant [N·m; slides: N].
        last_action: Control of each actuator that acted at that instant, in its own unit; before any, that of the start.
        dt: Time since the last state [s].
        time: When the instant is in each environment, by MuJoCo's clock [s]; our simulators say it, no module reads it.
        substeps: The states after each physics step since the last call but for the last one, which this state is; only if
            `inputs.substeps` is more than 1. Right after a reset they are all as this state.
    """

    body_pos: Float[Tensor, "env body 3"] | None = None
    body_quat: Float[Tensor, "env body 4"] | None = None
    body_linvel: Float[Tensor, "env body 3"] | None = None
    body_angvel: Float[Tensor, "env body 3"] | None = None
    contact_found: Tensor | None = None
    contact_pos: Float[Tensor, "env pair slot 3"] | None = None
    contact_force: Float[Tensor, "env pair slot 3"] | None = None
    contact_torque: Float[Tensor, "env pair slot 3"] | None = None
    contact_normal: Float[Tensor, "env pair slot 3"] | None = None
    contact_netforce: Float[Tensor, "env pair 3"] | None = None
    variant: Int[Tensor, "env object"] | None = None
    object_size: Float[Tensor, "env object 3"] | None = None
    object_temperature: Float[Tensor, "env heated"] | None = None
    object_material: Int[Tensor, "env heated"] | None = None
    joint_pos: Float[Tensor, "env joint"] | None = None
    joint_vel: Float[Tensor, "env joint"] | None = None
    joint_effort: Float[Tensor, "env joint"] | None = None
    last_action: Float[Tensor, "env actuator"] | None = None
    dt: float | None = None
    time: Float[Tensor, " env"] | None = None
    substeps: tuple[SceneState, ...] = ()

    def to(self, *args: Any, **kwargs: Any) -> SceneState:
        """Return the state with `torch.Tensor.to` applied to every tensor; a dtype applies to what is not an integer."""
        values: dict[str, Any] = {field.name: getattr(self, field.name) for field in fields(self)}
        moved: dict[str, Any] = {n: v.to(*args, **kwargs) if isinstance(v, Tensor) else v for n, v in values.items()}
        for name in CHOICES:
            if moved[name] is not None:
                moved[name] = moved[name].to(values[name].dtype)
        moved["substeps"] = tuple(part.to(*args, **kwargs) for part in self.substeps)
        return SceneState(**moved)

    def checked(self, inputs: Inputs, device: torch.device, with_dt: bool = True) -> dict[str, Tensor]:
        """Return the tensors that a module on a device reads; `with_dt`: whether a time must be there, if it is read.

        Raises:
            StateError: If a field that is read is missing, or is not of the right shape, dtype or device.
        """
        tensors: dict[str, Tensor] = {}
        for name in inputs.fields:
            value = getattr(self, name)
            if value is None and (name != "dt" or with_dt):
                raise StateError(f"SceneState.{name} is missing; this module wants {', '.join(inputs.fields)}")
            if name != "dt":
                tensors[name] = _checked(name, value, inputs, device)
        num_envs = tensors["body_pos"].shape[0]
        for name, value in tensors.items():
            if value.shape[0] != num_envs:
                raise StateError(f"SceneState.{name} holds {value.shape[0]} environments, body_pos {num_envs}")
        if device.type == "cpu":  # a look at a GPU's numbers would wait for it; there the kernel asserts
            _check_choices("variant", tensors, inputs.objects, inputs.num_variants)
            _check_choices("object_material", tensors, inputs.heated, inputs.num_materials)
        return tensors


def _check_choices(field: str, tensors: Mapping[str, Tensor], names: Sequence[str], counts: Sequence[int]) -> None:
    for i, (name, num) in enumerate(zip(names, counts, strict=True) if field in tensors else ()):
        column = tensors[field][:, i]
        if ((column < 0) | (column >= num)).any():
            invalid = min(int(v) for v in column.tolist() if not 0 <= v < num)
            raise StateError(f"SceneState.{field} of object {name} is {invalid}, expected 0 to {num - 1}")


def shape_of(name: str, inputs: Inputs) -> tuple[int, ...]:
    """Return the shape that a field has for a module, after the leading `env`."""
    return tuple([inputs.sizes[part] if isinstance(part, str) else part for part in SHAPES[name]])


def _checked(name: str, value: Any, inputs: Inputs, device: torch.device) -> Tensor:
    want = shape_of(name, inputs)
    if not isinstance(value, Tensor):
        raise StateError(f"SceneState.{name} is a {type(value).__name__}, expected a torch tensor")
    if value.ndim != len(want) + 1 or tuple(value.shape[1:]) != want:
        expected = ", ".join(map(str, want))
        names = "".join(f"; {axis}: {listed(axis_names)}" for axis, axis_names in inputs.names.items() if axis in SHAPES[name])
        raise StateError(f"SceneState.{name} has shape {tuple(value.shape)}, expected (env, {expected}){names}")
    if value.device != device:
        raise StateError(f"SceneState.{name} is on {value.device}, the module on {device}")
    dtypes = (torch.int64, torch.int32) if name in CHOICES else (torch.float32, torch.float64)
    if name != "contact_found" and value.dtype not in dtypes:
        raise StateError(f"SceneState.{name} is {value.dtype}, expected {' or '.join(map(str, dtypes))}")
    return value


def example_state(inputs: Inputs, num_envs: int, seed: int, dtype: torch.dtype, spread: float) -> SceneState:
    """Return a random state of all wanted fields, with bodies close enough to touch: see `TactileModule.example_state`.

    Contacts lie around their links, with unit normals and forces inside a friction cone of 0.5; every third slot is unused, and
    the net force is the slots' sum.
    """
    generator = torch.Generator().manual_seed(seed)
    values: dict[str, Any] = {}
    for name in (name for name in inputs.fields if name in SHAPES):
        value = torch.randn((num_envs, *shape_of(name, inputs)), generator=generator, dtype=dtype)
        if name == "body_pos":
            value = spread * value
        elif name == "body_quat":
            value = value / value.norm(dim=-1, keepdim=True)
        elif name == "contact_found":
            value = value > -1.0
        elif name in CHOICES:
            counts = inputs.num_variants if name == "variant" else inputs.num_materials
            value = torch.arange(num_envs)[:, None] % torch.tensor(counts)
        elif name == "object_size":
            value = 0.015 + 0.01 * value.clamp(-1, 1)
        elif name == "object_temperature":
            value = 30.0 + 15.0 * value.clamp(-1, 1)
        values[name] = value
    if "contact_force" in values:
        values |= _contacts(values, inputs, spread)
    if "dt" in inputs.fields:
        values["dt"] = inputs.dt or 0.01
    if inputs.substeps > 1:
        one = replace(inputs, substeps=1, fields=tuple(name for name in inputs.fields if name != "dt"))
        seeds = torch.randint(2**62, (inputs.substeps - 1,), generator=generator).tolist()
        values["substeps"] = tuple(example_state(one, num_envs, substep_seed, dtype, spread) for substep_seed in seeds)
    return SceneState(**values)


def _contacts(values: Mapping[str, Tensor], inputs: Inputs, spread: float) -> dict[str, Tensor]:
    """Turn random numbers into contacts that a solver could have found."""
    is_used = (torch.arange(inputs.slots) % 3 != 2)[:, None]
    links = values["body_pos"][:, [inputs.bodies.index(pair.link) for pair in inputs.pairs], None]
    normal = values["contact_normal"] / values["contact_normal"].norm(dim=-1, keepdim=True)
    along = (values["contact_force"] * normal).sum(dim=-1, keepdim=True)
    tangential = values["contact_force"] - along * normal
    result = {
        "contact_pos": links + spread * values["contact_pos"],
        "contact_force": along.abs() * (normal + 0.5 * tangential / (tangential.norm(dim=-1, keepdim=True) + 1.0)),
        "contact_torque": 1e-3 * along * normal,
        "contact_normal": normal,
    }
    result = {name: torch.where(is_used, value, 0.0) for name, value in result.items()}
    return {**result, "contact_netforce": result["contact_force"].sum(dim=2)}
