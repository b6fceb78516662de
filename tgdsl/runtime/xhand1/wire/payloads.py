"""What the XHand1's frames carry: the exchange's command and state, and register numbers.

The exchange (command 0x02) is the only request whose reply is known. It carries a set-point for every joint, so to read is also
to command: `PASSIVE` is the command that asks nothing. Sources and *unverified* parts: see `protocol`.

Shapes: `joint` the 12 joints by their id, `finger` thumb, index, middle, ring, pinky; `taxel` the 120 of a fingertip.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from tgdsl.runtime.xhand1.wire.errors import ProtocolError

NUM_JOINTS = 12
NUM_TAXELS = 120
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
JOINTS = (
    "thumb_bend_joint",
    "thumb_rota_joint1",
    "thumb_rota_joint2",
    "index_bend_joint",
    "index_joint1",
    "index_joint2",
    "mid_joint1",
    "mid_joint2",
    "ring_joint1",
    "ring_joint2",
    "pinky_joint1",
    "pinky_joint2",
)
"""The joints' names by id, without the `right_hand_` or `left_hand_` that they have in robot files."""


class Mode(IntEnum):
    """What a joint's drive does."""

    PASSIVE = 0
    POSITION = 3
    FORCE = 5


@dataclass(frozen=True)
class JointCommand:
    """What one joint's drive shall do."""

    position: float = 0.0  # set-point [rad]
    kp: int = 0  # proportional gain [hand's unit]
    ki: int = 0  # integral gain [hand's unit]
    kd: int = 0  # derivative gain [hand's unit]
    current_limit: int = 0  # largest motor current [mA]
    mode: int = Mode.PASSIVE  # what the drive does


_JOINT_COMMAND = struct.Struct("<Hhhhf6H")
COMMAND_SIZE = NUM_JOINTS * _JOINT_COMMAND.size
PASSIVE = (JointCommand(),) * NUM_JOINTS  # mode 0, no gain, no current: the request that reads, and asks no joint to move


def encode_command(joints: Sequence[JointCommand]) -> bytes:
    """Return the exchange's request, 288 bytes, of one command per joint in the order of their ids.

    Raises:
        ProtocolError: If there are not 12, or a value is not finite or does not fit its field.
    """
    if len(joints) != NUM_JOINTS:
        raise ProtocolError(f"{len(joints)} joint commands, expected {NUM_JOINTS}")
    parts = []
    for i, joint in enumerate(joints):
        if not math.isfinite(joint.position):
            raise ProtocolError(f"joint {i}: position is {joint.position}, expected a finite angle in rad")
        gains = (joint.kp, joint.ki, joint.kd)
        try:
            parts.append(_JOINT_COMMAND.pack(i, *gains, joint.position, joint.current_limit, joint.mode, 0, 0, 0, 0))
        except (struct.error, OverflowError) as error:
            raise ProtocolError(f"joint {i}: {joint} does not fit the protocol's fields: {error}") from error
    return b"".join(parts)


def decode_command(payload: bytes) -> tuple[JointCommand, ...]:
    """Return the joint commands of an exchange's request."""
    _expect_size("a command", payload, COMMAND_SIZE)
    joints = []
    for i, (id_, kp, ki, kd, position, current_limit, mode, *_) in enumerate(_JOINT_COMMAND.iter_unpack(payload)):
        if id_ != i:
            raise ProtocolError(f"joint command {i} is of joint {id_}")
        joints.append(JointCommand(position, kp, ki, kd, current_limit, mode))
    return tuple(joints)


_JOINT = np.dtype(
    [
        ("id", "u1"),
        ("sensor_id", "u1"),
        ("position", "<f4"),
        ("current", "<u2"),
        ("raw_position", "<u2"),
        ("temperature", "<u2"),
        ("error", "<u2", (3,)),
        ("reserved", "<u2", (3,)),
    ]
)
_FORCE = np.dtype([("x", "i1"), ("y", "i1"), ("z", "u1")])
_TIP = np.dtype(
    [("total", _FORCE), ("taxel", _FORCE, (NUM_TAXELS,)), ("temperature", "u1", (20,)), ("total_temperature", "u1")]
)
_STATE = np.dtype([("joint", _JOINT, (NUM_JOINTS,)), ("tip", _TIP, (len(FINGERS),))])
STATE_SIZE = _STATE.itemsize
_PLACES = {
    "joint_id": ("joint", "id"),
    "sensor_id": ("joint", "sensor_id"),
    "position": ("joint", "position"),
    "current": ("joint", "current"),
    "raw_position": ("joint", "raw_position"),
    "joint_temperature": ("joint", "temperature"),
    "joint_error": ("joint", "error"),
    "reserved": ("joint", "reserved"),
    "total_force": ("tip", "total"),
    "taxel_force": ("tip", "taxel"),
    "taxel_temperature": ("tip", "temperature"),
    "total_temperature": ("tip", "total_temperature"),
}
"""Part and field of a state in which each attribute of a `HandState` stands."""
_FORCES = ("total_force", "taxel_force")

FORCE_MIN = np.array([-128, -128, 0])
FORCE_MAX = np.array([127, 127, 255])  # what a force component can hold [counts]


@dataclass(frozen=True, eq=False)
class HandState:
    """The reply to an exchange: what the hand says of itself. Forces are in counts, whose unit is not published."""

    joint_id: UInt8[np.ndarray, " joint"]  # id that each joint gives itself
    sensor_id: UInt8[np.ndarray, " joint"]  # meaning not published
    position: Float[np.ndarray, " joint"]  # joint angles [rad]
    current: UInt16[np.ndarray, " joint"]  # motor current [mA]
    raw_position: UInt16[np.ndarray, " joint"]  # encoder counts
    joint_temperature: UInt16[np.ndarray, " joint"]  # its low byte is in °C; the high byte's meaning is not published
    # error codes of the communication board, the joint board and the fingertip board; 0 is none
    joint_error: UInt16[np.ndarray, "joint 3"]
    reserved: UInt16[np.ndarray, "joint 3"]  # three words without published meaning
    total_force: Int[np.ndarray, "finger 3"]  # fingertip force as the hand itself sums it up [counts]
    taxel_force: Int[np.ndarray, "finger taxel 3"]  # force of each taxel [counts]
    taxel_temperature: UInt8[np.ndarray, "finger 20"]  # 20 thermometers of each fingertip [°C]
    total_temperature: UInt8[np.ndarray, " finger"]  # the fingertip's own temperature [°C]

    @property
    def is_total_saturated(self) -> Bool[np.ndarray, "finger 3"]:
        """Whether a component of the fingertip's force is at the end of its range, so that it may stand for more."""
        return saturated(self.total_force)

    @property
    def is_taxel_saturated(self) -> Bool[np.ndarray, "finger taxel 3"]:
        """Whether a component of a taxel's force is at the end of its range."""
        return saturated(self.taxel_force)


def saturated(force: Int[np.ndarray, "*batch 3"]) -> Bool[np.ndarray, "*batch 3"]:
    """Return which components are at the end of their range: 127 or more either way for x and y, 255 for z."""
    return np.greater_equal(abs(force), FORCE_MAX)


def decode_state(payload: bytes) -> HandState:
    """Return the state that an exchange's reply of 2208 bytes holds, value for value."""
    _expect_size("a state", payload, STATE_SIZE)
    record = np.frombuffer(payload, dtype=_STATE)[0]
    values = {name: record[part][field] for name, (part, field) in _PLACES.items()}
    return HandState(**values | {name: _components(values[name]) for name in _FORCES})


def encode_state(state: HandState) -> bytes:
    """Return a state's 2208 bytes."""
    record = np.zeros((), dtype=_STATE)
    for name, (part, field) in _PLACES.items():
        value = getattr(state, name)
        if name not in _FORCES:
            record[part][field] = value
            continue
        if ((value < FORCE_MIN) | (value > FORCE_MAX)).any():
            raise ProtocolError(f"{field} forces from {value.min()} to {value.max()}: expected x, y in -128…127, z in 0…255")
        for i, axis in enumerate("xyz"):
            record[part][field][axis] = value[..., i]
    return record.tobytes()


def encode_register_request(number: int) -> bytes:
    """Return the payload that asks for a register: its number as u16 (*unverified*)."""
    if not 0 <= number <= 0xFFFF:
        raise ProtocolError(f"register {number}: expected 0 to 65535")
    return struct.pack("<H", number)


def _components(force: np.ndarray) -> Int[np.ndarray, "*batch 3"]:
    components = np.stack([force[axis].astype(np.int16) for axis in "xyz"], axis=-1)
    components.setflags(write=False)
    return components


def _expect_size(what: str, payload: bytes, size: int) -> None:
    if len(payload) != size:
        raise ProtocolError(f"{what} of {len(payload)} bytes, expected {size}")
