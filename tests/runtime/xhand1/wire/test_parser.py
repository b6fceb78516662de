"""The parser against a reference on whole streams: random, damaged, cut and merged ones."""

from itertools import pairwise
from random import Random

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from xhand1_streams import frame_bytes, frames_of

from tgdsl.runtime.xhand1.wire.protocol import MAX_PAYLOAD, OVERHEAD, FrameParser

BYTE = st.integers(0, 255)
BOUND = MAX_PAYLOAD + OVERHEAD + 4096
FRAMES = st.builds(frame_bytes, BYTE, BYTE, BYTE, st.binary(max_size=40))
BIG = frame_bytes(0x80, 0xFE, 2, bytes(range(256)) * 8 + bytes(160))
NESTED = st.builds(frame_bytes, BYTE, BYTE, BYTE, FRAMES)
LIARS = st.builds(
    lambda head, length: b"\x55\xaa" + head + length.to_bytes(2, "little"), st.binary(max_size=3), st.integers(0, 9000)
)
GARBAGE = st.one_of(st.binary(max_size=30), st.sampled_from([b"\x55", b"\xaa", b"\x55\xaa", b"\x55\x55\xaa"]), LIARS)


@st.composite
def damaged(draw):
    """A frame with bytes changed, removed or inserted."""
    raw = bytearray(draw(st.one_of(FRAMES, NESTED)))
    for _ in range(draw(st.integers(1, 3))):
        index = draw(st.integers(0, max(len(raw) - 1, 0)))
        raw[index : index + draw(st.integers(0, 4))] = draw(st.binary(max_size=4))
    return bytes(raw)


SMALL_PIECES = st.one_of(FRAMES, FRAMES, NESTED, GARBAGE, damaged())
PIECES = st.one_of(SMALL_PIECES, SMALL_PIECES, SMALL_PIECES, SMALL_PIECES, SMALL_PIECES, st.just(BIG))
STREAMS = st.lists(PIECES, max_size=8).map(b"".join)
CUTS = st.lists(st.integers(0, 3000), max_size=8)


def parsed(stream: bytes, cuts: list[int]) -> list[tuple[int, int, int, bytes]]:
    """Parse a stream in pieces; the buffer must stay within bounds, and every byte must be accounted for."""
    parser, frames = FrameParser(), []
    offsets = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    for start, end in pairwise(offsets):
        frames += parser.feed(stream[start:end])
        assert parser.num_buffered <= BOUND
    frames += parser.flush()
    assert parser.num_buffered == 0
    assert parser.num_discarded + sum(9 + len(frame.payload) for frame in frames) == len(stream)
    return [(frame.source, frame.destination, frame.command, frame.payload) for frame in frames]


def assert_agrees(stream: bytes, cuts: list[int]) -> None:
    assert parsed(stream, cuts) == frames_of(stream)


@given(STREAMS, CUTS)
@settings(max_examples=500, deadline=None)
def test_cuts_do_not_change_the_frames_of_a_stream(stream, cuts):
    assert_agrees(stream, cuts)


@given(st.lists(SMALL_PIECES, min_size=1, max_size=8), st.integers(0, 2**32))
@settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))
def test_merged_mutated_and_cut_streams_agree_with_the_reference(pieces, seed):
    """Twenty streams from each list of pieces."""
    random = Random(seed)
    for _ in range(20):
        stream = bytearray(b"".join(random.choices(pieces, k=random.randint(0, 5))))
        for _ in range(random.randint(0, 3)):
            index = random.randint(0, len(stream))
            stream[index : index + random.randint(0, 4)] = random.randbytes(random.randint(0, 4))
        assert_agrees(bytes(stream), random.choices(range(300), k=random.randint(0, 5)))


@given(st.lists(FRAMES, max_size=20), CUTS)
@settings(max_examples=200, deadline=None)
def test_a_clean_stream_loses_no_frame(frames, cuts):
    assert [frame_bytes(*fields) for fields in parsed(b"".join(frames), cuts)] == frames


@given(st.lists(st.tuples(st.binary(max_size=50).map(lambda raw: raw.replace(b"\x55", b"\x54")), FRAMES), max_size=10), CUTS)
@settings(max_examples=200, deadline=None)
def test_garbage_without_a_header_costs_no_frame(pairs, cuts):
    stream = b"".join(garbage + frame for garbage, frame in pairs)
    assert [frame_bytes(*fields) for fields in parsed(stream, cuts)] == [frame for _, frame in pairs]


def test_bytes_after_the_last_frame_are_counted():
    parser = FrameParser()
    parser.feed(b"\x01\x02" + BIG + b"\x55\x03\x04\x55")
    assert (parser.num_discarded, parser.num_trailing) == (5, 3)
    parser.flush()
    assert (parser.num_discarded, parser.num_trailing) == (6, 4)
    parser.feed(BIG)
    assert (parser.num_discarded, parser.num_trailing) == (6, 0)


def test_a_stream_parses_byte_by_byte():
    assert_agrees(BIG + b"\x55" + BIG, list(range(2 * len(BIG) + 1)))


def test_frames_are_returned_as_soon_as_they_are_complete():
    parser = FrameParser()
    for byte in BIG[:-1]:
        assert parser.feed(bytes([byte])) == []
    assert len(parser.feed(BIG[-1:])) == 1
    assert parser.num_buffered == 0


def test_flush_finds_a_frame_after_a_header_with_a_wrong_length():
    parser = FrameParser()
    assert parser.feed(b"\x55\xaa\x80\xfe\x02\x00\x20" + BIG) == []
    assert [len(frame.payload) for frame in parser.flush()] == [2208]


def test_a_frame_within_another_is_payload():
    inner = frame_bytes(0x80, 0xFE, 2, b"inner")
    outer = frame_bytes(0x80, 0xFE, 0x15, b"<" + inner + b">")
    assert parsed(outer, [10, 12]) == [(0x80, 0xFE, 0x15, b"<" + inner + b">")]


def test_headers_without_frames_keep_memory_and_work_bounded():
    """Each header announces the longest frame: every candidate costs one checksum of 8 KiB."""
    parser = FrameParser()
    assert parser.feed(b"\x55\xaa\x00\x00\x00\x20\x20" * 20_000) == []
    assert parser.num_buffered <= BOUND
    assert parser.flush() == []
    assert parser.num_discarded == 140_000
