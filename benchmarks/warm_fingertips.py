"""Which fingertips could tell a ball of 45 °C from one of 22 °C within 20 s: the paper's table, by formula and by physics.

    python benchmarks/warm_fingertips.py --out docs/measured/warm_fingertips.json --plot docs/images/warm_fingertips.png

A fingertip of the XHand1, 2 × 2 × 2 cells, begins at 22 °C and is pressed on the ball for 20 s. Of each conductivity,
emissivity and heat made in it: when the warmest cell first reads 42.2 °C (the paper's latch), by `model: paper` and by physics,
on balls of several materials, and with no ball at all, as its own heat may do. ρ and c are those of the material that the
conductivity is named after, see `FINGERTIPS`. The paper says neither what its ball is made of nor a coefficient of convection:
there is none.
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
from tgdsl.errors import TgdslError
from tgdsl.fields.materials import MATERIALS
from tgdsl.files.write import check_writable
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

LINK = "right_hand_mid_link2"
FINGERTIPS = {1.0: "glass", 10.0: "stainless_steel", 100.0: "aluminium", 150.0: "aluminium"}
"""Conductivities of the paper's table [W/(m·K)], and what else the fingertip is like."""
EMISSIVITIES, FLUXES = (0.5, 0.85), (500.0, 5000.0)


class Column(NamedTuple):
    """What a fingertip is pressed on, and by whose physics.

    Attributes:
        model: "paper" or "physical".
        ball: Material of the ball; "none" if there is none.
        patch: What its area is called.
        area: Area of the patch [m²]; None: that of the force.
        solid: Share of the fingertip's box that is solid, the rest being hollow.
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
"""The paper's πδ is a number for an area."""
LATCH, SECONDS = 42.2, 20.0


@dataclass(frozen=True)
class Run:
    """One fingertip on one ball: when it latched [s], None if never; readings every second [°C], None if no numbers."""

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


def pressed(module: TactileModule, force: float, dt: float) -> SceneState:
    """Return the fingertip on the ball, at the middle of its pad, the face towards −x."""
    inputs, box = module.inputs, module.plan.quantities["patches"].uses[0].boxes[0].copy()
    zeros = torch.zeros(1, len(inputs.pairs), inputs.slots, 3, dtype=torch.float64)
    values: dict[str, Any] = {
        name: zeros.clone() for name in ("contact_pos", "contact_force", "contact_torque", "contact_normal")
    }
    middle = torch.as_tensor(box).mean(dim=0)
    middle[0] = box[0, 0]
    values["contact_pos"][:, 0, 0], values["contact_normal"][:, 0, 0, 0] = middle, 1.0
    values["contact_force"][:, 0, 0, 0] = force
    pose = torch.zeros(1, len(inputs.bodies), 3, dtype=torch.float64)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, len(inputs.bodies), 4)
    net = values["contact_force"].sum(dim=2)
    found = torch.ones(1, len(inputs.pairs))
    return SceneState(body_pos=pose, body_quat=quat, contact_netforce=net, contact_found=found, dt=dt, **values)


def name_of(column: Column) -> str:
    """Return what a column is called."""
    ball = "no ball" if column.ball == "none" else column.ball
    return ", ".join(part for part in (column.model, ball, column.patch) if part)


def run(column: Column, k: float, emissivity: float, flux: float, force: float, dt: float) -> Run:
    """Press a fingertip on a ball for 20 s."""
    module = module_of(column, k, emissivity, flux)
    state, latched, curve = pressed(module, 0.0 if column.ball == "none" else force, dt), None, []
    reading = 22.0
    for step in range(round(SECONDS / dt) + 1):
        reading = float(module(state)["heat"][0, 0, 0])
        if latched is None and reading >= LATCH:
            latched = step * dt
        if step % round(1.0 / dt) == 0:
            curve.append(_number(reading))
    return Run(name_of(column), k, emissivity, flux, latched, _number(reading), curve)


def _number(reading: float) -> float | None:
    return round(reading, 3) if math.isfinite(reading) else None


def table(runs: list[Run]) -> str:
    """Return the table in Markdown: when each latched, and what it read at the end."""
    names = [name_of(column) for column in COLUMNS]
    lines = ["| k [W/(m·K)] | ε | q [W/m²] | " + " | ".join(names) + " |", "|" + "---|" * (3 + len(names))]
    for k, e, q in itertools.product(FINGERTIPS, EMISSIVITIES, FLUXES):
        cells = []
        for name in names:
            own = next(r for r in runs if (r.column, r.conductivity, r.emissivity, r.flux) == (name, k, e, q))
            end = "diverges" if own.last is None or abs(own.last) >= 1e4 else f"{own.last:.1f} °C"
            cells.append(end if own.latched is None else f"**{own.latched:.2f} s** ({end})")
        lines.append(f"| {k:g} | {e:g} | {q:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot(runs: list[Run], file: Path) -> None:
    """Draw the physics: readings over time, on balls and on none."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = [name_of(column) for column in COLUMNS if column.model == "physical"]
    figure, axes = pyplot.subplots(1, len(columns), figsize=(17, 3.6), sharey=True, layout="constrained")
    for ax, name in zip(axes, columns, strict=True):
        for colour, k in zip(("tab:gray", "tab:blue", "tab:orange", "tab:red"), FINGERTIPS, strict=True):
            for style, q in zip((":", "-"), FLUXES, strict=True):
                own = next(r for r in runs if (r.column, r.conductivity, r.emissivity, r.flux) == (name, k, 0.5, q))
                curve = [math.nan if reading is None else reading for reading in own.curve]
                ax.plot(range(len(curve)), curve, style, color=colour, label=f"k = {k:g}, q = {q:g}")
        ax.axhline(LATCH, color="black", lw=0.8)
        ax.set(title=name.removeprefix("physical, "), xlabel="time [s]")
    axes[0].set(ylabel="warmest cell [°C]")
    axes[-1].legend(fontsize="x-small")
    figure.savefig(file, dpi=130)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--force", type=float, default=5.0, help="normal force [N]")
    parser.add_argument("--dt", type=float, default=0.025, help="time between readings [s]")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--plot", type=Path)
    given = parser.parse_args()
    if given.dt <= 0 or abs(round(1.0 / given.dt) * given.dt - 1.0) > 1e-9:
        parser.error(f"--dt {given.dt}: expected a whole number of readings per second")
    try:
        for file in filter(None, (given.out, given.plot)):
            check_writable(file)
    except TgdslError as error:
        parser.error(str(error))
    cases = itertools.product(COLUMNS, FINGERTIPS, EMISSIVITIES, FLUXES)
    runs = [run(*case, given.force, given.dt) for case in cases]
    print(table(runs))
    if given.out:
        given.out.write_text(json.dumps([asdict(own) for own in runs], allow_nan=False) + "\n")
    if given.plot:
        plot(runs, given.plot)


if __name__ == "__main__":
    main()
