"""What a module's readings are, for users.

Shapes: `row` taxels, bodies, joints or actuators, `channel` numbers per row, `step` stacked calls.
"""

from __future__ import annotations

from dataclasses import dataclass

from tgdsl.console.tables import Outputs
from tgdsl.plan.plan import Plan


@dataclass(frozen=True)
class Output:
    """One reading: its name, its sensor and that one's kind, its shape after `env`, and name and unit of each channel.

    The shape is (row, channel), or (step, row, channel) where calls, or samples of a block, are stacked. Rows are the sensor's
    taxels (`rows` is "taxel"), the bodies that carry it ("body"), or what its kind says: see `TactileModule.rows`. `bodies`
    lists the bodies. A reading that no sensor makes has its own name for sensor and kind; its rows are those of `inputs.joints`
    ("joint") or `inputs.actuators` ("actuator").
    """

    name: str
    sensor: str
    kind: str
    shape: tuple[int, ...]
    rows: str
    bodies: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]


def outputs_of(plan: Plan) -> tuple[Output, ...]:
    """Return name, shape, channels and units of each reading of a plan; a tuple that prints as a table."""
    sensed = tuple(
        Output(
            reading.name,
            sensor.sensor,
            sensor.kind,
            (*([reading.steps] if reading.steps else []), reading.num_rows, len(reading.channels)),
            reading.rows,
            plan.layout_of(sensor).bodies,
            reading.channels,
            reading.units,
        )
        for sensor in plan.sensors
        for reading in sensor.readings
    )
    joints = tuple(
        Output(r.name, r.name, r.name, (r.num_rows, len(r.channels)), r.rows, (), r.channels, r.units)
        for r in plan.proprioception
    )
    return Outputs(sensed + joints)
