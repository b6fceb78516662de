"""Readings of a hand that never was, with every field full of random values, and logs of them."""

from dataclasses import fields
from pathlib import Path

import numpy as np

from tgdsl.runtime.xhand1.driver import Reading
from tgdsl.runtime.xhand1.log.log import Fault, LogWriter
from tgdsl.runtime.xhand1.wire.protocol import FORCE_MAX, FORCE_MIN, HandState


def random_state(rng: np.random.Generator) -> HandState:
    def words(*shape: int) -> np.ndarray:
        return rng.integers(0, 1 << 16, shape).astype(np.uint16)

    def octets(*shape: int) -> np.ndarray:
        return rng.integers(0, 256, shape).astype(np.uint8)

    return HandState(
        joint_id=np.arange(12, dtype=np.uint8),
        sensor_id=octets(12),
        position=rng.normal(size=12).astype(np.float32),
        current=words(12),
        raw_position=words(12),
        joint_temperature=words(12),
        joint_error=words(12, 3),
        reserved=words(12, 3),
        total_force=rng.integers(FORCE_MIN, FORCE_MAX + 1, (5, 3)).astype(np.int16),
        taxel_force=rng.integers(FORCE_MIN, FORCE_MAX + 1, (5, 120, 3)).astype(np.int16),
        taxel_temperature=octets(5, 20),
        total_temperature=octets(5),
    )


def random_readings(times: np.ndarray, seed: int = 0) -> list[Reading]:
    """Return readings that arrive at some times, each asked for 8 ms before."""
    rng = np.random.default_rng(seed)
    return [Reading(10 + 2 * i, float(t) - 0.008, float(t), random_state(rng)) for i, t in enumerate(times)]


def write_log(path: Path, readings: list[Reading], faults: tuple[Fault, ...] = (), **about) -> Path:
    """Write readings and failures in the order of their times."""
    events = sorted([*readings, *faults], key=lambda event: event.time if isinstance(event, Fault) else event.received_at)
    with LogWriter(path, **about) as log:
        for event in events:
            log.add(event)
    return path


def assert_same_reading(found: Reading, expected: Reading) -> None:
    """Assert that two readings are the same bit for bit."""
    for name in ("sequence", "requested_at", "received_at"):
        assert getattr(found, name) == getattr(expected, name)
        assert type(getattr(found, name)) is type(getattr(expected, name))
    for field in fields(HandState):
        a, b = getattr(found.state, field.name), getattr(expected.state, field.name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), field.name
