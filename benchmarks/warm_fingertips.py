"""Compute which fingertips tell a ball of 45 °C from one of 22 °C within 20 s, by the formula of the paper and by physics.

    python benchmarks/warm_fingertips.py --out docs/measured/warm_fingertips.json --plot docs/images/warm_fingertips.png

A fingertip of the XHand1 with 2 × 2 × 2 cells starts at 22 °C and presses the ball for 20 s. For each conductivity, emissivity
and heating power, the table has the time at which the warmest cell first reads 42.2 °C (the paper's latch), by `model: paper`
and by physics, on balls of several materials, and without a ball, since the heater alone may do it. ρ and c are those of the
material in `FINGERTIPS`. The paper gives neither the ball's material nor a coefficient of convection; there is no convection.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch

import tgdsl
from tgdsl.fields.materials import MATERIALS
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

LINK = "right_hand_mid_link2"
FINGERTIPS = {1.0: "glass", 10.0: "stainless_steel", 100.0: "aluminium", 150.0: "aluminium"}
"""Material with a fingertip's other properties, by the conductivities of the paper's table [W/(m·K)]."""
EMISSIVITIES, FLUXES = (0.5, 0.85), (500.0, 5000.0)


class Column(NamedTuple):
    """A column of the table: model of heat, ball, and fingertip.

    Attributes:
        model: "paper" or "physical".
        ball: Material of the ball; "none" without a ball.
        patch: Name of the contact area.
        area: Contact area [m²]; None: it follows from the force.
        solid: Solid share of the fingertip's box.
    """

    model: str
    ball: str
    patch: str = ""
    area: float | None = None
    solid: float = 1.0


COLUMNS = (
    Column("paper", "rubber", "δ = 1 mm", 3.1416e-3),
    Column("paper", "aluminium", "δ = 1 mm", 3.1416e-3),
    Column("paper", "none"),
    Column("physical", "rubber", "Hertz"),
    Column("physical", "aluminium", "Hertz"),
    Column("physical", "aluminium", "1 cm²", 1e-4),
    Column("physical", "aluminium", "1 cm², thin walls", 1e-4, 0.1),
    Column("physical", "none"),
    Column("physical", "none", "thin walls", solid=0.1),
)
"""The columns. The paper uses πδ, a length, as an area."""
LATCH, SECONDS, FORCE, STEPS_PER_SECOND = 42.2, 20.0, 5.0, 40
"""Reading that latches [°C]; duration [s]; normal force [N]; readings per second."""


@dataclass(frozen=True)
class Run:
    """A fingertip on a ball: time of the latch [s] or None; readings every second [°C], None where they diverge."""

    column: str
    conductivity: float
    emissivity: float
    flux: float
    latched: float | None
    last: float | None
    curve: list[float | None]


def module_of(column: Column, conductivity: float, emissivity: float, flux: float) -> TactileModule:
    """Return the module of a fingertip and a ball."""
    ball, area, density = column.ball, column.area, column.solid * MATERIALS[FINGERTIPS[conductivity]].density
    material = {"like": FINGERTIPS[conductivity], "conductivity": conductivity, "density": density}
    sensor: dict[str, Any] = {
        "kind": "temperature_grid",
        "links": LINK,
        "feels": ["ball"],
        "cells": [2, 2, 2],
        "material": material,
        **({} if area is None else {"contact_area": area}),
        "emissivity": emissivity,
        "source": {"flux": flux, "face": "-z"},
        "outputs": "max",
        "model": column.model,
    }
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": "xhand1"},
            "resolution": "low",
            "objects": {
                "ball": {
                    "geom": {"type": "sphere", "size": [0.04]},
                    "material": "rubber" if ball == "none" else ball,
                    "temperature": 45.0,
                }
            },
            "sensors": {"heat": sensor},
        },
        dtype=torch.float64,
    )


def pressed(module: TactileModule, force: float) -> SceneState:
    """Return the state of a fingertip on the ball, at the centre of its pad, the face towards −x."""
    inputs, box = module.inputs, module.plan.quantities["patches"].uses[0].boxes[0].copy()
    zeros = torch.zeros(1, len(inputs.pairs), inputs.slots, 3, dtype=torch.float64)
    values: dict[str, Any] = {
        name: zeros.clone() for name in ("contact_pos", "contact_force", "contact_torque", "contact_normal")
    }
    centre = torch.as_tensor(box).mean(dim=0)
    centre[0] = box[0, 0]
    values["contact_pos"][:, 0, 0], values["contact_normal"][:, 0, 0, 0] = centre, 1.0
    values["contact_force"][:, 0, 0, 0] = force
    pose = torch.zeros(1, len(inputs.bodies), 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, len(inputs.bodies), 4)
    net = values["contact_force"].sum(dim=2)
    count = torch.ones(1, len(inputs.pairs))
    dt = 1 / STEPS_PER_SECOND
    return SceneState(body_pos=pose, body_quat=quat, contact_netforce=net, contact_found=count, dt=dt, **values)


def name_of(column: Column) -> str:
    """Return the heading of a column."""
    ball = "no ball" if column.ball == "none" else column.ball
    return ", ".join(part for part in (column.model, ball, column.patch) if part)


def run(column: Column, k: float, emissivity: float, flux: float) -> Run:
    """Press a fingertip on a ball for 20 s."""
    module = module_of(column, k, emissivity, flux)
    state, latched, curve = pressed(module, 0.0 if column.ball == "none" else FORCE), None, []
    for step in range(round(SECONDS * STEPS_PER_SECOND) + 1):
        reading = float(module(state)["heat"][0, 0, 0])
        if latched is None and reading >= LATCH:
            latched = step / STEPS_PER_SECOND
        if step % STEPS_PER_SECOND == 0:
            curve.append(_number(reading))
    return Run(name_of(column), k, emissivity, flux, latched, curve[-1], curve)


def _number(reading: float) -> float | None:
    return round(reading, 3) if math.isfinite(reading) else None


def table(runs: list[Run]) -> str:
    """Return the Markdown table: time of the latch, and last reading."""
    names = [name_of(column) for column in COLUMNS]
    lines = ["| k [W/(m·K)] | ε | q [W/m²] | " + " | ".join(names) + " |", "|" + "---|" * (3 + len(names))]
    for k, e, q in itertools.product(FINGERTIPS, EMISSIVITIES, FLUXES):
        cells = []
        for name in names:
            result = next(r for r in runs if (r.column, r.conductivity, r.emissivity, r.flux) == (name, k, e, q))
            end = "diverges" if result.last is None or abs(result.last) >= 1e4 else f"{result.last:.1f} °C"
            cells.append(end if result.latched is None else f"**{result.latched:.2f} s** ({end})")
        lines.append(f"| {k:g} | {e:g} | {q:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(runs: list[Run], file: Path) -> None:
    """Draw the readings by physics over time, with and without a ball."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = [name_of(column) for column in COLUMNS if column.model == "physical"]
    figure, axes = pyplot.subplots(1, len(columns), figsize=(17, 3.6), sharey=True, layout="constrained")
    for ax, name in zip(axes, columns, strict=True):
        for colour, k in zip(("tab:gray", "tab:blue", "tab:orange", "tab:red"), FINGERTIPS, strict=True):
            for style, q in zip((":", "-"), FLUXES, strict=True):
                result = next(r for r in runs if (r.column, r.conductivity, r.emissivity, r.flux) == (name, k, 0.5, q))
                curve = [math.nan if reading is None else reading for reading in result.curve]
                ax.plot(range(len(curve)), curve, style, color=colour, label=f"k = {k:g}, q = {q:g}")
        ax.axhline(LATCH, color="black", lw=0.8)
        ax.set(title=name.removeprefix("physical, "), xlabel="time [s]")
    axes[0].set(ylabel="warmest cell [°C]")
    axes[-1].legend(fontsize="x-small")
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    runs = [run(*case) for case in itertools.product(COLUMNS, FINGERTIPS, EMISSIVITIES, FLUXES)]
    print(table(runs))
    if options.out:
        options.out.write_text(json.dumps([asdict(result) for result in runs], allow_nan=False) + "\n")
    if options.plot:
        plot(runs, options.plot)


if __name__ == "__main__":
    main()
