"""Read an emulated XHand1 for minutes at the highest rate of its line: count lost readings, and measure periods and ages.

python benchmarks/hand_soak.py --seconds 600

The emulated line runs at 3 Mbaud: 297 bytes out and 2217 back take 8.38 ms, so it carries at most 119.3 readings a second. Each
state of the hand contains a number, which reveals lost, repeated and stale readings. Timeouts are long, so that only the line
can lose readings, not a busy machine: delays show in the percentiles.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from tgdsl.runtime.xhand1.driver import Reading, XHand1
from tgdsl.runtime.xhand1.emulator.emulator import Body, EmulatedHand, Emulator, TipForces
from tgdsl.runtime.xhand1.wire.client import BAUD, SerialCounters, SerialTiming
from tgdsl.runtime.xhand1.wire.protocol import COMMAND_SIZE, OVERHEAD, STATE_SIZE

WIRE_S = 10 * (COMMAND_SIZE + STATE_SIZE + 2 * OVERHEAD) / BAUD
"""Time of an exchange's bytes on the line [s]."""
LONG_TIMEOUTS = SerialTiming(reply_timeout_s=20.0, silence_s=10.0)


class NumberedStates(Body):
    """A body that writes the number of sent states into the thumb's first taxels."""

    def __init__(self) -> None:
        self.num = 0

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Return forces that encode the next number."""
        taxel = np.zeros((5, 120, 3))
        taxel[0, :4, 2] = list(self.num.to_bytes(4, "little"))
        self.num += 1
        return np.zeros(12), TipForces(np.zeros((5, 3)), taxel)


def number_of(reading: Reading) -> int:
    """Return the number that `NumberedStates` wrote."""
    return int.from_bytes(reading.state.taxel_force[0, :4, 2].astype(np.uint8).tobytes(), "little")


@dataclass(frozen=True)
class Soak:
    """Results of a run.

    Attributes:
        seconds: Time from the first reading to the last [s].
        numbers: Number in each fetched reading.
        received_at: Time at which each arrived [s].
        age: Upper bound of each one's age when it was fetched [s].
        counters: Counters of the line.
        num_lost_bytes: Bytes that the emulator could not deliver.
    """

    seconds: float
    numbers: np.ndarray
    received_at: np.ndarray
    age: np.ndarray
    counters: SerialCounters
    num_lost_bytes: int

    @property
    def num_lost(self) -> int:
        """Exchanges without a reading, except the one in progress at the end."""
        return max(self.counters.num_requests - self.counters.num_replies - 1, 0)

    @property
    def num_superseded(self) -> int:
        """Readings that a newer one replaced before they were fetched."""
        return int(self.numbers[-1] - self.numbers[0]) + 1 - len(self.numbers)

    def text(self) -> str:
        """Return the report."""
        period = 1e3 * np.diff(self.received_at) / np.maximum(np.diff(self.numbers), 1)
        rate = (self.numbers[-1] - self.numbers[0]) / self.seconds
        counters = self.counters
        bad = counters.num_timeouts + counters.num_damaged + counters.num_foreign + counters.num_unexpected
        return "\n".join(
            [
                f"{self.seconds:.1f} s, {len(self.numbers)} readings fetched, {self.num_superseded} superseded by newer ones",
                f"lost: {self.num_lost} exchanges, {self.num_lost_bytes} bytes; timeouts, damaged, foreign, unexpected: {bad}",
                f"rate: {rate:.1f} Hz, {100 * rate * WIRE_S:.1f} % of the {1 / WIRE_S:.1f} Hz that the wire allows",
                f"period [ms]: {_percentiles(period)}; the wire alone: {1e3 * WIRE_S:.2f}",
                f"age when fetched [ms]: {_percentiles(1e3 * self.age)}",
            ]
        )


def soak(seconds: float) -> Soak:
    """Read for some time [s]; each reading must be complete, new and in order.

    Raises:
        HandError: If a reading does not come within 30 s.
    """
    numbers, received_at, ages = [], [], []
    with (
        Emulator(EmulatedHand(body=NumberedStates())) as emulator,
        XHand1.open(emulator.device, timing=LONG_TIMEOUTS, max_age_s=30.0) as hand,
    ):
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            reading = hand.read(timeout_s=30.0)
            numbers.append(number_of(reading))
            received_at.append(reading.received_at)
            ages.append(reading.age_s())
        counters, num_lost_bytes = hand.counters, emulator.num_lost_bytes
    assert np.all(np.diff(numbers) >= 1), "a reading came twice, or out of order"
    times = np.array(received_at)
    return Soak(times[-1] - times[0], np.array(numbers), times, np.array(ages), counters, num_lost_bytes)


def _percentiles(values: np.ndarray) -> str:
    p50, p90, p99, p999, worst = np.percentile(values, [50, 90, 99, 99.9, 100])
    return f"50 % {p50:.2f}, 90 % {p90:.2f}, 99 % {p99:.2f}, 99.9 % {p999:.2f}, worst {worst:.2f}"


def main() -> None:
    """Print the report; the exit code is 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="duration [s]")
    result = soak(parser.parse_args().seconds)
    print(result.text())
    raise SystemExit(int(bool(result.num_lost or result.num_lost_bytes)))


if __name__ == "__main__":
    main()
