"""Minutes of reading an emulated XHand1 at the highest rate that its line allows: what was lost, how even the readings came.

python benchmarks/hand_soak.py --seconds 600

The emulated line takes as long as 3 Mbaud do: 297 bytes out and 2217 back are 8.38 ms, 119.3 readings a second at the most.
Every state that the hand sends has a number in it, so that a reading that is lost, repeated or stale shows. Waits are patient,
so that only the line can lose something, not a machine that is busy with other things: what is late shows in the percentiles.
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
"""Time that an exchange's bytes are on the line [s]."""
PATIENT = SerialTiming(reply_timeout_s=20.0, silence_s=10.0)


class NumberedStates(Body):
    """A body that writes into the thumb's first taxels how many states the hand has sent."""

    def __init__(self) -> None:
        self.num = 0

    def felt(self, time_s: float) -> tuple[Float[np.ndarray, " joint"], TipForces]:
        """Number one more."""
        taxel = np.zeros((5, 120, 3))
        taxel[0, :4, 2] = list(self.num.to_bytes(4, "little"))
        self.num += 1
        return np.zeros(12), TipForces(np.zeros((5, 3)), taxel)


def number_of(reading: Reading) -> int:
    """Return the number that `NumberedStates` wrote."""
    return int.from_bytes(reading.state.taxel_force[0, :4, 2].astype(np.uint8).tobytes(), "little")


@dataclass(frozen=True)
class Soak:
    """What happened.

    Attributes:
        seconds: From the first reading to the last [s].
        numbers: Number of each reading that was fetched.
        received_at: When each came [s].
        age: How old each could be when it was fetched [s].
        counters: What happened on the line.
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
        """Exchanges that brought no reading; the one that is under way at the end is not counted."""
        return max(self.counters.num_requests - self.counters.num_replies - 1, 0)

    @property
    def num_superseded(self) -> int:
        """Readings that were here, but were replaced by a newer one before they were fetched."""
        return int(self.numbers[-1] - self.numbers[0]) + 1 - len(self.numbers)

    def text(self) -> str:
        """Return the account."""
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
    """Read for so long [s]; each reading must be whole, new and in order.

    Raises:
        HandError: If a reading does not come within 30 s.
    """
    numbers, received_at, ages = [], [], []
    with (
        Emulator(EmulatedHand(body=NumberedStates())) as emulator,
        XHand1.open(emulator.device, timing=PATIENT, max_age_s=30.0) as hand,
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
    """Soak, and print the account; the exit code is 1 if anything was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="for how long [s]")
    found = soak(parser.parse_args().seconds)
    print(found.text())
    raise SystemExit(int(bool(found.num_lost or found.num_lost_bytes)))


if __name__ == "__main__":
    main()
