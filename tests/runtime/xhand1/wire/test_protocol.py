"""The XHand1's protocol: published vectors, field by field oracles, and round trips."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from xhand1_streams import bitwise_crc16

from tgdsl.runtime.xhand1.wire import protocol
from tgdsl.runtime.xhand1.wire.errors import ProtocolError
from tgdsl.runtime.xhand1.wire.protocol import Frame, FrameParser, JointCommand, Mode

BYTE = st.integers(0, 255)
WORD = st.integers(0, 0xFFFF)
SHORT = st.integers(-0x8000, 0x7FFF)


def test_the_checksum_matches_the_published_vector():
    assert protocol.crc16(b"123456789") == 0x31C3


@given(st.binary(max_size=300))
def test_the_checksum_is_the_polynomial_division(data):
    assert protocol.crc16(data) == bitwise_crc16(data)


def test_a_version_request_matches_the_published_bytes():
    frame = Frame(protocol.HOST_ADDRESS, protocol.hand_address(0), protocol.Command.VERSION)
    assert protocol.encode_frame(frame) == bytes.fromhex("55 aa fe 80 13 00 00 ef c3")
    assert FrameParser().feed(bytes.fromhex("55aafe80130000efc3")) == [frame]


def test_sizes_match_the_published_ones():
    passive = protocol.encode_command(protocol.PASSIVE)
    assert len(passive) == protocol.COMMAND_SIZE == 288
    assert protocol.STATE_SIZE == 2208
    assert len(protocol.encode_frame(Frame(0xFE, 0x80, 2, passive))) == 297
    assert len(protocol.encode_frame(Frame(0x80, 0xFE, 2, bytes(2208)))) == 2217


def test_the_passive_command_matches_byte_by_byte():
    assert protocol.encode_command(protocol.PASSIVE) == b"".join(struct.pack("<H", i) + bytes(22) for i in range(12))


def test_a_command_matches_byte_by_byte():
    joints = [JointCommand(0.5 * i, 100 + i, -i, 2 * i, 300 + i, Mode.POSITION) for i in range(12)]
    payload = protocol.encode_command(joints)
    for i in range(12):
        start = 24 * i
        assert int.from_bytes(payload[start : start + 2], "little") == i
        assert [int.from_bytes(payload[start + k : start + k + 2], "little", signed=True) for k in (2, 4, 6)] == [
            100 + i,
            -i,
            2 * i,
        ]
        assert np.frombuffer(payload[start + 8 : start + 12], "<f4")[0] == np.float32(0.5 * i)
        assert [int.from_bytes(payload[start + k : start + k + 2], "little") for k in (12, 14, 16, 18, 20, 22)] == [
            300 + i,
            3,
            0,
            0,
            0,
            0,
        ]


def test_a_state_matches_byte_by_byte():
    payload = bytearray(2208)
    payload[24 * 7 : 24 * 8] = struct.pack("<BBf9H", 7, 3, 1.25, 40, 5000, 0x1220, 1, 2, 3, 4, 5, 6)
    tip = 288 + 384 * 2
    payload[tip : tip + 3] = bytes([0xFF, 0x80, 0xC8])
    payload[tip + 3 + 3 * 119 : tip + 363] = bytes([5, 0xFE, 255])
    payload[tip + 363 : tip + 384] = bytes(range(30, 51))
    state = protocol.decode_state(bytes(payload))
    assert (state.joint_id[7], state.sensor_id[7], state.position[7]) == (7, 3, 1.25)
    assert (state.current[7], state.raw_position[7], state.joint_temperature[7]) == (40, 5000, 0x1220)
    assert state.joint_error[7].tolist() == [1, 2, 3]
    assert state.reserved[7].tolist() == [4, 5, 6]
    assert state.total_force[2].tolist() == [-1, -128, 200]
    assert state.taxel_force[2, 119].tolist() == [5, -2, 255]
    assert state.taxel_temperature[2].tolist() == list(range(30, 50))
    assert state.total_temperature.tolist() == [0, 0, 50, 0, 0]
    assert not state.taxel_force[2, :119].any()
    assert state.is_total_saturated.tolist() == [[False] * 3] * 2 + [[False, True, False]] + [[False] * 3] * 2
    assert state.is_taxel_saturated.sum() == 1
    assert state.is_taxel_saturated[2, 119, 2]


def test_a_state_cannot_be_written_to():
    state = protocol.decode_state(bytes(2208))
    for name in ("position", "total_force", "taxel_force", "joint_error"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(state, name)[...] = 0


@pytest.mark.parametrize(
    ("counts", "is_end"),
    [((127, 0, 0), 0), ((-127, 0, 0), 0), ((0, -128, 0), 1), ((0, 0, 255), 2), ((126, -126, 254), None), ((0, 0, 0), None)],
)
def test_saturation(counts, is_end):
    assert protocol.saturated(np.array(counts)).tolist() == [i == is_end for i in range(3)]


@given(st.binary(min_size=2208, max_size=2208))
@settings(max_examples=200, deadline=None)
def test_any_state_round_trips_byte_for_byte(payload):
    assert protocol.encode_state(protocol.decode_state(payload)) == payload


JOINT = st.builds(JointCommand, st.floats(width=32, allow_nan=False, allow_infinity=False), SHORT, SHORT, SHORT, WORD, WORD)


@given(st.lists(JOINT, min_size=12, max_size=12))
@settings(max_examples=100, deadline=None)
def test_any_command_round_trips(joints):
    assert protocol.decode_command(protocol.encode_command(joints)) == tuple(joints)


@given(BYTE, BYTE, BYTE.filter(lambda c: c not in protocol.FIRMWARE_COMMANDS), st.binary(max_size=400))
@settings(max_examples=200, deadline=None)
def test_any_frame_round_trips(source, destination, command, payload):
    frame = Frame(source, destination, command, payload)
    assert FrameParser().feed(protocol.encode_frame(frame)) == [frame]


@pytest.mark.parametrize("command", sorted(protocol.FIRMWARE_COMMANDS))
def test_firmware_commands_are_refused(command):
    with pytest.raises(ProtocolError, match="writes firmware; it is never sent"):
        protocol.encode_frame(Frame(0xFE, 0x80, command))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: protocol.hand_address(128), "hand id 128: expected 0 to 127"),
        (lambda: protocol.encode_command([]), "0 joint commands, expected 12"),
        (lambda: protocol.encode_command([JointCommand(float("nan"))] * 12), "joint 0: position is nan, expected a finite"),
        (lambda: protocol.encode_command([JointCommand(kp=40000)] * 12), "joint 0: .* does not fit the protocol's fields"),
        (lambda: protocol.encode_command([JointCommand(1e300)] * 12), "joint 0: .* does not fit the protocol's fields"),
        (lambda: protocol.decode_command(bytes(288)), "joint command 1 is of joint 0"),
        (lambda: protocol.decode_command(bytes(287)), "a command of 287 bytes, expected 288"),
        (lambda: protocol.decode_state(bytes(2207)), "a state of 2207 bytes, expected 2208"),
    ],
)
def test_values_outside_the_protocol_are_refused(wrong, message):
    with pytest.raises(ProtocolError, match=message):
        wrong()


def test_a_force_beyond_its_byte_is_refused():
    state = protocol.decode_state(bytes(2208))
    beyond = np.zeros((5, 120, 3), dtype=np.int16)
    beyond[0, 0, 0] = 128
    fields = {name: getattr(state, name) for name in state.__dataclass_fields__} | {"taxel_force": beyond}
    with pytest.raises(ProtocolError, match="taxel forces from 0 to 128: expected x, y in"):
        protocol.encode_state(protocol.HandState(**fields))
