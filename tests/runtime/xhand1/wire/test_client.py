"""One request and its reply, on a line where the test sets every byte and clock tick."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tgdsl.runtime.xhand1.wire import protocol
from tgdsl.runtime.xhand1.wire.client import POLL_S, Addresses, SerialClient, SerialTiming
from tgdsl.runtime.xhand1.wire.errors import HandRefusedError, HandTimeoutError
from tgdsl.runtime.xhand1.wire.protocol import Command, Frame, encode_frame

REQUEST = protocol.encode_command(protocol.PASSIVE)
MS = 1e-3
VERSION_REQUEST = bytes.fromhex("55aafe80130000efc3")
VERSION_REPLY = encode_frame(Frame(0x80, 0xFE, 0x13, b"1.0"))


def reply(tag: int, source: int = 0x80, destination: int = 0xFE, command: int = 2, size: int = 2208) -> bytes:
    return encode_frame(Frame(source, destination, command, bytes([tag]) * size))


class ScriptedLine:
    """A port with its own clock; the n-th list of (delay [s], bytes) answers the n-th exchange.

    The hand answers in order: a reply with its version comes after all pending replies.
    """

    def __init__(self, *answers: list[tuple[float, bytes]], tells_version: bool):
        self.now = 100.0
        self.answers = list(answers)
        self.tells_version = tells_version
        self.coming: list[tuple[float, bytes]] = []
        self.written: list[tuple[float, bytes]] = []
        self.num_versions = 0

    def clock(self) -> float:
        return self.now

    def write(self, data: bytes) -> None:
        last = max([self.now, *(at for at, _ in self.coming)])
        if data == VERSION_REQUEST:
            self.num_versions += 1
            self.coming += [(last + 0.2 * MS, VERSION_REPLY)] if self.tells_version else []
            return
        self.written.append((self.now, data))
        answer = self.answers.pop(0) if self.answers else []
        self.coming = sorted(self.coming + [(self.now + after, part) for after, part in answer], key=lambda part: part[0])

    def read(self) -> bytes:
        if not self.pending():
            next_at = self.coming[0][0] if self.coming else self.now + 1
            self.now = min(next_at, self.now + POLL_S)
        count = len([1 for at, _ in self.coming if at <= self.now])
        here, self.coming = self.coming[:count], self.coming[count:]
        return b"".join(part for _, part in here)

    def pending(self) -> int:
        return sum(len(part) for at, part in self.coming if at <= self.now)

    def close(self) -> None:
        pass


def in_chunks(raw: bytes, end: float) -> list[tuple[float, bytes]]:
    """Return a frame in chunks of 62 bytes at the line's rate, complete at `end`."""
    starts = range(0, len(raw), 62)
    return [(end - 10 * (len(raw) - min(at + 62, len(raw))) / 3e6, raw[at : at + 62]) for at in starts]


def connected(
    *answers: list[tuple[float, bytes]], addresses: Addresses | None = None, tells_version: bool = False, **timing
) -> tuple[SerialClient, ScriptedLine]:
    line = ScriptedLine(*answers, tells_version=tells_version)
    return SerialClient(line, addresses or Addresses(), SerialTiming(**timing), clock=line.clock), line


def ask(client: SerialClient) -> int:
    """Exchange and return the tag of the reply."""
    return client.exchange(Command.EXCHANGE, REQUEST, protocol.STATE_SIZE).payload[0]


def test_a_reply_has_the_times_of_its_request_and_arrival():
    client, line = connected([(9 * MS, reply(1))])
    exchange = client.exchange(Command.EXCHANGE, REQUEST, protocol.STATE_SIZE)
    assert exchange.payload == bytes([1]) * 2208
    assert exchange.requested_at == line.written[0][0]
    assert exchange.received_at == pytest.approx(exchange.requested_at + 9 * MS, abs=1e-9)
    assert line.written[0][1] == encode_frame(Frame(0xFE, 0x80, 2, REQUEST))


def test_a_clean_line_costs_one_poll_beyond_the_reply():
    client, line = connected(*[[(9 * MS, reply(i))] for i in range(5)])
    assert [ask(client) for _ in range(5)] == list(range(5))
    periods = [b - a for (a, _), (b, _) in zip(line.written, line.written[1:], strict=False)]
    assert periods == pytest.approx([9 * MS + POLL_S] * 4, abs=1e-9)


def test_a_reply_at_the_lines_rate_is_received():
    client, _ = connected(in_chunks(reply(1), 8.5 * MS))
    assert ask(client) == 1


def test_no_reply_is_a_timeout_and_the_next_request_works():
    client, line = connected([], [(9 * MS, reply(2))])
    with pytest.raises(HandTimeoutError, match=r"no reply to command 0x02 \(exchange\) within 30 ms"):
        ask(client)
    assert line.now - line.written[0][0] == pytest.approx(30 * MS, abs=POLL_S)
    assert ask(client) == 2


def test_a_damaged_reply_has_its_own_error_and_settles_quickly():
    raw = bytearray(reply(1))
    raw[700] ^= 1
    client, line = connected([(9 * MS, bytes(raw))], [(9 * MS, reply(2))])
    with pytest.raises(HandTimeoutError, match=r"the reply to command 0x02 \(exchange\) came damaged: 2217 bytes"):
        ask(client)
    assert ask(client) == 2
    assert line.written[1][0] - line.written[0][0] == pytest.approx((9 + 18) * MS, abs=2 * POLL_S)


def test_an_incomplete_reply_at_the_timeout_is_late_and_not_damaged():
    client, _ = connected([(29.9 * MS, reply(1)[:1000]), (30.5 * MS, reply(1)[1000:])], [(9 * MS, reply(2))])
    with pytest.raises(HandTimeoutError, match=r"\(exchange\) was not complete within 30 ms: 1000 bytes had come"):
        ask(client)
    assert ask(client) == 2


def test_a_reply_cut_short_is_damaged():
    client, _ = connected([(9 * MS, reply(1)[:-1])], [(9 * MS, reply(2))])
    with pytest.raises(HandTimeoutError):
        ask(client)
    assert ask(client) == 2


def test_garbage_around_a_reply_costs_nothing():
    client, _ = connected([(1 * MS, b"\x55\xaa\x00"), (9 * MS, b"\xff" * 50 + reply(1) + b"\x01")])
    assert ask(client) == 1
    assert client.counters.num_discarded_bytes == 54


def test_a_reply_after_a_header_with_a_wrong_length_is_found():
    client, _ = connected([(9 * MS, b"\x55\xaa\x80\xfe\x02\x00\x20" + reply(1))])
    assert ask(client) == 1


def test_a_repeated_reply_is_never_taken_for_the_next():
    client, _ = connected([(9 * MS, reply(1)), (9 * MS + POLL_S / 2, reply(1))], [(9 * MS, reply(2))])
    assert [ask(client), ask(client)] == [1, 2]
    assert client.counters.num_unexpected == 1


@pytest.mark.parametrize("late_by", [31, 35, 40, 47, 48, 49, 52, 55, 56, 58, 60, 65])
def test_a_late_reply_is_never_taken_for_the_next(late_by):
    """The hand answers in order: the next reply follows once the late one is off the wire."""
    timeout, settle, request, wire = 30, 18, 0.99, 7.39
    begins = late_by - wire
    next_request = timeout + settle if begins >= timeout + settle else late_by + settle
    following = max(late_by - next_request, request) + wire
    client, line = connected(in_chunks(reply(1), late_by * MS), in_chunks(reply(2), following * MS))
    with pytest.raises(HandTimeoutError):
        ask(client)
    assert ask(client) == 2
    assert not line.pending()


@pytest.mark.parametrize("late_by", [31, 40, 47, 48, 49, 56, 60, 65, 80, 120, 250, 1000])
@pytest.mark.parametrize("next_late_by", [9, 25, 100])
def test_with_version_replies_no_late_reply_is_taken_for_another(late_by, next_late_by):
    client, line = connected(
        in_chunks(reply(1), late_by * MS),
        in_chunks(reply(2), next_late_by * MS),
        in_chunks(reply(3), 9 * MS),
        tells_version=True,
    )
    tags = []
    for _ in range(40):
        try:
            exchange = client.exchange(Command.EXCHANGE, REQUEST, protocol.STATE_SIZE)
        except HandTimeoutError:
            continue
        sent_at = line.written[exchange.payload[0] - 1][0]
        assert exchange.requested_at == sent_at
        tags.append(exchange.payload[0])
        if tags[-1] == 3:
            break
    assert tags == ([2, 3] if next_late_by < 30 else [3])


def test_an_old_reply_from_a_stalled_adapter_is_dropped():
    client, line = connected([(200 * MS, reply(1))], [(9 * MS, reply(2))], tells_version=True)
    for _ in range(10):
        try:
            assert ask(client) == 2
            break
        except HandTimeoutError:
            assert line.now - 100 < 0.3


def test_the_version_is_requested_only_after_a_failure():
    client, line = connected(*[[(9 * MS, reply(i))] for i in range(3)], [], [(9 * MS, reply(4))], tells_version=True)
    assert [ask(client) for _ in range(3)] == [0, 1, 2]
    assert line.num_versions == 1
    with pytest.raises(HandTimeoutError):
        ask(client)
    failed_at = line.now
    assert ask(client) == 4
    assert line.num_versions == 2
    assert line.written[-1][0] - failed_at == pytest.approx(0.2 * MS + POLL_S, abs=POLL_S)


def test_a_hand_without_version_replies_is_asked_three_times_at_most():
    client, line = connected([(9 * MS, reply(1))], [], [(9 * MS, reply(3))])
    assert ask(client) == 1
    with pytest.raises(HandTimeoutError):
        ask(client)
    assert ask(client) == 3
    assert line.num_versions == 3


def test_a_damaged_reply_after_a_valid_one_discards_both():
    client, _ = connected([(9 * MS, reply(1)), (9 * MS + POLL_S / 2, reply(2)[:2000])], [(9 * MS, reply(3))])
    with pytest.raises(HandTimeoutError, match="2000 bytes are in no sound frame"):
        ask(client)
    assert ask(client) == 3


def test_a_glitch_after_a_reply_is_ignored():
    client, _ = connected([(9 * MS, reply(1)), (9 * MS + POLL_S / 2, b"\x00\xff")])
    assert ask(client) == 1


BYTES = st.one_of(
    st.binary(max_size=40),
    st.sampled_from(
        [reply(1), reply(2), reply(1)[:900], reply(3, size=5), reply(7, source=0x81), reply(9, command=0), VERSION_REPLY]
    ),
    st.just(b"\x55\xaa\x80\xfe\x02\x00\x20"),
)
TRAFFIC = st.lists(st.tuples(st.floats(0, 0.1), BYTES), max_size=6)


@given(st.lists(TRAFFIC, max_size=4), st.booleans())
@settings(max_examples=300, deadline=None)
def test_any_traffic_ends_in_time_with_a_reply_or_a_named_error(traffic, tells_version):
    client, line = connected(*traffic, tells_version=tells_version)
    for _ in range(4):
        start = line.now
        try:
            exchange = client.exchange(Command.EXCHANGE, REQUEST, protocol.STATE_SIZE)
        except (HandTimeoutError, HandRefusedError):
            pass
        else:
            assert exchange.payload in (bytes([1]) * 2208, bytes([2]) * 2208)
            assert line.written[-1][0] == exchange.requested_at < exchange.received_at <= line.now
        assert line.now - start < 4 * (48 + 48) * MS


def test_a_reply_sooner_than_the_wire_allows_belongs_to_an_earlier_request():
    client, _ = connected([(7.5 * MS, reply(1)), (16 * MS, reply(2))])
    assert ask(client) == 2


def test_an_error_says_that_a_reply_came_too_early():
    client, _ = connected([(3 * MS, reply(1))])
    with pytest.raises(HandTimeoutError, match="sooner than 3000000 baud allow"):
        ask(client)
    client, _ = connected([(3 * MS, reply(1))], checks_wire_time=False)
    assert ask(client) == 1


def test_replies_of_another_hand_are_ignored():
    client, _ = connected([(9 * MS, reply(7, source=0x81)), (16 * MS, reply(1))], [(9 * MS, reply(7, source=0x81))])
    assert ask(client) == 1
    with pytest.raises(HandTimeoutError, match=r"a reply came from 0x81 to 0xfe, expected from 0x80 to 0xfe"):
        ask(client)
    assert client.counters.num_foreign == 2


def test_the_addresses_of_replies_can_be_set():
    client, _ = connected([(9 * MS, reply(1, 0xFE, 0x00))], addresses=Addresses(0, reply_source=0xFE, reply_destination=0))
    assert ask(client) == 1


def test_echoed_requests_are_ignored():
    client, _ = connected([(1 * MS, encode_frame(Frame(0xFE, 0x80, 2, REQUEST))), (9 * MS, reply(1))])
    assert ask(client) == 1
    assert client.counters.num_foreign == 0


def test_an_error_reply_is_a_refusal():
    client, _ = connected([(9 * MS, encode_frame(Frame(0x80, 0xFE, 0, b"\x07")))])
    with pytest.raises(HandRefusedError, match=r"the hand refused command 0x02 \(exchange\); its error reply holds 07"):
        ask(client)


def test_a_reply_of_another_size_or_command_is_an_error():
    client, _ = connected([(9 * MS, reply(1, size=100))], [(9 * MS, reply(1, command=3))])
    with pytest.raises(HandTimeoutError, match=r"the reply to command 0x02 \(exchange\) has 100 bytes, expected 2208"):
        ask(client)
    with pytest.raises(HandTimeoutError, match="no reply"):
        ask(client)


def test_a_line_that_never_falls_silent_gets_no_request():
    client, line = connected([(i * 0.4 * MS, b"\x00") for i in range(1000)])
    with pytest.raises(HandTimeoutError, match="came damaged"):
        ask(client)
    with pytest.raises(HandTimeoutError, match="the line does not fall silent"):
        ask(client)
    assert len(line.written) == 1


def test_a_reply_on_a_line_that_does_not_fall_silent_is_refused():
    client, _ = connected([(9 * MS, reply(1))] + [((9 + i * 0.4) * MS, b"\x00") for i in range(1000)])
    with pytest.raises(HandTimeoutError, match="the line does not fall silent"):
        ask(client)


def test_bytes_before_the_first_request_are_discarded():
    client, line = connected([(9 * MS, reply(2))])
    line.coming = [(line.now + 5 * MS, reply(1))]
    assert ask(client) == 2
    assert client.counters.num_discarded_bytes == 2217
