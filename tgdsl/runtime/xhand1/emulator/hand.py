"""A hand in numbers: it takes frames and gives frames. `emulated_body` says how its joints move and what its fingertips feel.

Shapes: `joint`, `finger` and `taxel` as in `payloads`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.xhand1.emulator.body import Body, FirstOrderBody, ForceField, no_forces
from tgdsl.runtime.xhand1.emulator.body import TipForces as TipForces
from tgdsl.runtime.xhand1.wire.errors import ProtocolError
from tgdsl.runtime.xhand1.wire.payloads import (
    FINGERS,
    FORCE_MAX,
    FORCE_MIN,
    NUM_JOINTS,
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


class EmulatedHand:
    """The hand behind the line.

    Attributes:
        address: Its address.
        commands: What its joints were last told.
        num_states: How many states it has sent.
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
        self.num_states = 0
        self.address = hand_address(hand_id)
        self._body: Body = FirstOrderBody(forces, time_constant_s) if body is None else body
        own: dict[int, bytes] = {Register.HAND_ID: bytes([hand_id]), Register.NAME: b"emulated"}
        self._registers = own if registers is None else dict(registers)
        self._position = np.zeros(NUM_JOINTS)

    @property
    def position(self) -> Float[np.ndarray, " joint"]:
        """Joint angles that it last sent [rad]."""
        return self._position.copy()

    @property
    def is_passive(self) -> bool:
        """Whether no joint was last told to hold or to move."""
        return all(joint.mode == Mode.PASSIVE and not joint.kp and not joint.current_limit for joint in self.commands)

    def answer(self, frame: Frame, now: float) -> Frame | None:
        """Return what the hand replies to a frame at a time [s]; None if it is for another."""
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
            self._position, forces = self._body.felt(now)
            self.commands = commands
            return frame.command, encode_state(self._state(forces))
        if frame.command == Command.VERSION:
            return frame.command, VERSION
        number = int.from_bytes(frame.payload, "little")
        if frame.command == Command.READ_REGISTER and number in self._registers:
            return frame.command, self._registers[number]
        return Command.ERROR, bytes([frame.command])

    def _state(self, forces: TipForces) -> HandState:
        self.num_states += 1
        lag = np.array([joint.position for joint in self.commands]) - self._position
        gain = np.array([joint.kp for joint in self.commands])
        limit = np.array([joint.current_limit for joint in self.commands])
        raw_position = self._position * _COUNTS_PER_TURN / (2 * math.pi)
        return HandState(
            joint_id=np.arange(NUM_JOINTS, dtype=np.uint8),
            sensor_id=np.zeros(NUM_JOINTS, dtype=np.uint8),
            position=self._position.astype(np.float32),
            current=np.minimum(abs(lag * gain), limit).astype(np.uint16),
            raw_position=(np.round(raw_position).astype(np.int64) % 0x10000).astype(np.uint16),
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
