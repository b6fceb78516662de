"""An emulated hand: it takes frames and gives frames; its body says how joints move and what fingertips feel.

Shapes: `joint`, `finger` and `taxel` as in `payloads`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.xhand1.wire.errors import ProtocolError
from tgdsl.runtime.xhand1.wire.payloads import (
    FINGERS,
    FORCE_MAX,
    FORCE_MIN,
    NUM_JOINTS,
    NUM_TAXELS,
    PASSIVE,
    HandState,
    JointCommand,
    Mode,
    decode_command,
    encode_state,
)
from tgdsl.runtime.xhand1.wire.protocol import Command, Frame, Register, hand_address

VERSION = b"tgdsl emulator"
_ROOM_TEMPERATURE = 25
_COUNTS_PER_TURN = 4096


@dataclass(frozen=True, eq=False)
class TipForces:
    """What the fingertips feel [counts]; rounded and cut to a byte, as a sensor would.

    Attributes:
        total: Force of each fingertip.
        taxel: Force of each taxel.
    """

    total: Float[np.ndarray, "finger 3"]
    taxel: Float[np.ndarray, "finger taxel 3"]


ForceField = Callable[[float, Float[np.ndarray, " joint"]], TipForces]
"""Takes the time [s] and the joint angles [rad]; is called once per state that the hand sends."""


def no_forces(time_s: float, position: Float[np.ndarray, " joint"]) -> TipForces:
    """Return fingertips that feel nothing."""
    return TipForces(np.zeros((len(FINGERS), 3)), np.zeros((len(FINGERS), NUM_TAXELS, 3)))


@runtime_checkable
class Body(Protocol):
    """Joints and fingertips."""

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Take the joints' commands at a time [s]."""
        ...

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return the joint angles [rad] and the fingertips' forces at that time [s]; called once per state."""
        ...


class FirstOrderBody:
    """Joints that follow first-order, with one time constant, while they are driven; else they stay.

    Attributes:
        position: Joint angles [rad].
    """

    def __init__(self, forces: ForceField, time_constant_s: float):
        self.position = np.zeros(NUM_JOINTS)
        self._forces = forces
        self._time_constant_s = time_constant_s
        self._joints: Sequence[JointCommand] = PASSIVE
        self._moved_at: float | None = None

    def command(self, time_s: float, joints: Sequence[JointCommand]) -> None:
        """Move by the last command until now, then take this one."""
        elapsed = 0.0 if self._moved_at is None else time_s - self._moved_at
        self._moved_at = time_s
        share = 1.0 - math.exp(-elapsed / self._time_constant_s)
        for i, joint in enumerate(self._joints):
            if is_driven(joint):
                self.position[i] += share * (joint.position - self.position[i])
        self._joints = joints

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return angles and forces."""
        return self.position.copy(), self._forces(time_s, self.position.copy())


def is_driven(joint: JointCommand) -> bool:
    """Return whether a drive goes to its set-point: with the mode for it, a gain and a current."""
    return joint.mode == Mode.POSITION and joint.kp > 0 and joint.current_limit > 0


class EmulatedHand:
    """The hand behind the line.

    Attributes:
        address: Its address.
        commands: The last commands of its joints.
        position: Joint angles that it last sent [rad].
    """

    def __init__(
        self,
        hand_id: int = 0,
        forces: ForceField = no_forces,
        *,
        time_constant_s: float = 0.05,
        registers: Mapping[int, bytes] | None = None,
        body: Body | None = None,
    ):
        """Switch it on.

        Args:
            hand_id: Its id.
            forces: What its fingertips feel.
            time_constant_s: Time in which a joint goes 63 % of the way to its set-point [s].
            registers: Their contents by number; default: its id and a name.
            body: Its joints and fingertips; default: joints that start at zero and follow with `time_constant_s`, and
                fingertips that feel `forces`.
        """
        self.commands: tuple[JointCommand, ...] = PASSIVE
        self.address = hand_address(hand_id)
        self.position: Float[np.ndarray, " joint"] = np.zeros(NUM_JOINTS)
        self._body: Body = FirstOrderBody(forces, time_constant_s) if body is None else body
        default: dict[int, bytes] = {Register.HAND_ID: bytes([hand_id]), Register.NAME: b"emulated"}
        self._registers = default if registers is None else dict(registers)

    @property
    def is_passive(self) -> bool:
        """Whether the last commands hold or move no joint."""
        return all(joint.mode == Mode.PASSIVE and not joint.kp and not joint.current_limit for joint in self.commands)

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Return the hand's reply to a frame at a time [s]; None if it is for another."""
        if frame.destination != self.address:
            return None
        try:
            command, payload = self._answer(frame, now)
        except ProtocolError:
            command, payload = Command.ERROR, bytes([frame.command])
        return Frame(self.address, frame.source, command, payload)

    def _answer(self, frame: Frame, now: float) -> tuple[int, bytes]:
        if frame.command == Command.EXCHANGE:
            commands = decode_command(frame.payload)
            self._body.command(now, commands)
            self.position, forces = self._body.felt(now)
            self.commands = commands
            return frame.command, encode_state(self._state(forces))
        if frame.command == Command.VERSION:
            return frame.command, VERSION
        number = int.from_bytes(frame.payload, "little")
        if frame.command == Command.READ_REGISTER and number in self._registers:
            return frame.command, self._registers[number]
        return Command.ERROR, bytes([frame.command])

    def _state(self, forces: TipForces) -> HandState:
        setpoint, gain, limit = np.array([(joint.position, joint.kp, joint.current_limit) for joint in self.commands]).T
        raw_position = np.round(self.position * _COUNTS_PER_TURN / (2 * math.pi)).astype(np.int64) % 0x10000
        return HandState(
            joint_id=np.arange(NUM_JOINTS, dtype=np.uint8),
            sensor_id=np.zeros(NUM_JOINTS, dtype=np.uint8),
            position=self.position.astype(np.float32),
            current=np.minimum(abs((setpoint - self.position) * gain), limit).astype(np.uint16),
            raw_position=raw_position.astype(np.uint16),
            joint_temperature=np.full(NUM_JOINTS, _ROOM_TEMPERATURE, dtype=np.uint16),
            joint_error=np.zeros((NUM_JOINTS, 3), dtype=np.uint16),
            reserved=np.zeros((NUM_JOINTS, 3), dtype=np.uint16),
            total_force=_counts(forces.total),
            taxel_force=_counts(forces.taxel),
            taxel_temperature=np.full((len(FINGERS), 20), _ROOM_TEMPERATURE, dtype=np.uint8),
            total_temperature=np.full(len(FINGERS), _ROOM_TEMPERATURE, dtype=np.uint8),
        )


def _counts(force: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
    return np.clip(np.round(force), FORCE_MIN, FORCE_MAX).astype(np.int16)
