"""Measure the cost of each term of the noise, and plot a press, a hold, a release and a slide with it.

    python benchmarks/noise.py cost [--device cuda] [--num-envs 1024] [--repeats 30] [--eager]
    python benchmarks/noise.py plot [--out docs/images]

`cost` times `kinematic_taxel` (force and torque) with each term alone, with `noisy` and with everything, on the XHand1 (199
taxels) and on a pad of 10 × 20, relative to the same document without a `noise` key. Calls of all modules of a scene alternate,
so that a drift of the machine affects all; on a GPU they are replayed CUDA graphs. "clean, again" is a second module of the
first document: its ratio shows the uncertainty of the others. Bytes are the module's memory after a call, per taxel and
environment.

`plot` moves a cube by a script, without a simulator: onto a pad, held there, off, on again, along it, and off.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from gpu import captured
from module import PAD, median_ms

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.module.state import SceneState

CROSSTALK = {"strength": 0.3, "sigma": 3e-3}
TERMS: dict[str, dict[str, Any]] = {
    "clean, again": {},
    "`noise: clean`": {"noise": "clean"},
    "radius noise": {"noise": {"radius_noise": 3e-4}},
    "gain": {"noise": {"gain": [0.85, 1.15]}},
    "hysteresis": {"noise": {"hysteresis": {"strength": 0.5, "time_constant": 0.05}}},
    "crosstalk": {"noise": {"crosstalk": CROSSTALK}},
    "delay, 1 call": {"noise": {"read_delay": 0.01}},
    "delay, up to 3 calls": {"noise": {"read_delay": 0.01, "jitter": 0.02}},
    "bias": {"noise": {"bias": 0.01}},
    "white noise": {"noise": {"white_noise": 5e-3}},
    "white noise, a range": {"noise": {"white_noise": [2e-3, 8e-3]}},
    "drift": {"noise": {"drift": 1e-4}},
    "quantization": {"noise": {"quantization": 1e-2}},
    "dead taxels": {"noise": {"dead_probability": 0.05, "dead_range": [0.0, 1.0]}},
    "`noise: noisy`": {"noise": "noisy"},
    "everything": {
        "noise": {
            "like": "noisy",
            "crosstalk": CROSSTALK,
            "read_delay": 0.01,
            "jitter": 0.02,
            "bias": [-0.01, 0.01],
            "dead_range": [0.0, 1.0],
        }
    },
    "`rate: 50 Hz`": {"rate": "50 Hz"},
    "`history: 5`": {"history": 5},
}
"""Fields of the sensor in each module; calls are 10 ms apart."""
NUM_TAXELS = {"xhand1": 199, "pad": 200}


@dataclass(frozen=True)
class Cost:
    """Time and bytes of every term."""

    device: str = "cpu"
    num_envs: int = 1024
    repeats: int = 30
    """Timed calls of each module."""
    scenes: tuple[str, ...] = ("xhand1", "pad")
    terms: tuple[str, ...] = field(default_factory=lambda: tuple(TERMS))
    """Rows of the table."""
    eager: bool = False
    """Whether to leave the modules uncompiled."""

    def run(self) -> None:
        """Measure and print the table."""
        machine = torch.cuda.get_device_name() if self.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
        mode = "eager" if self.eager else "compiled"
        print(
            f"torch {torch.__version__}, {machine}, {self.num_envs} environments, float32, {mode}, medians of {self.repeats}\n"
        )
        columns = {scene: self._scene(scene) for scene in self.scenes}
        print(f"| | {' | '.join(f'{scene}: time | bytes' for scene in columns)} |\n|{'---|' * (1 + 2 * len(columns))}")
        for name in ("clean", *self.terms):
            cells = [f"{rows[name][0] / rows['clean'][0]:.2f} | {rows[name][1]:.1f}" for rows in columns.values()]
            print(f"| {name} | {' | '.join(cells)} |")
        for scene, rows in columns.items():
            print(f"\n{scene}: clean takes {1e3 * rows['clean'][0]:.0f} µs", end="")

    def _scene(self, scene: str) -> dict[str, tuple[float, float]]:
        """Return time [ms] and bytes per taxel and environment of each module of a scene."""
        torch.compiler.reset()
        calls, sizes = {}, {}
        with TemporaryDirectory() as folder:
            for name, fields in {"clean": {}, **{name: TERMS[name] for name in self.terms}}.items():
                touch = kinematic(scene, Path(folder), self.device, fields)
                if not self.eager:
                    touch.compile()
                state = touch.example_state(self.num_envs, dtype=torch.float32)
                with torch.no_grad():
                    touch(state)  # compiles, and allocates the module's memory
                    calls[name] = captured(lambda touch=touch, state=state: touch(state), torch.device(self.device))
                size = sum(buffer.numel() * buffer.element_size() for buffer in touch.memory.buffers() if buffer.ndim)
                sizes[name] = size / self.num_envs / NUM_TAXELS[scene]
        times = median_ms(calls, self.repeats, self.device)
        return {name: (times[name], sizes[name]) for name in calls}


def kinematic(scene: str, folder: Path, device: str, fields: dict[str, Any]) -> TactileModule:
    """Return `kinematic_taxel` on the XHand1 or on a pad under a cube, with additional fields of the sensor."""
    if scene == "xhand1":
        sensor = {"kind": "kinematic_taxel", "links": "hand", "feels": ["cube"], **fields}
        example = Path(__file__).parent.parent / "examples" / "xhand1_palm.yaml"
        changes = {"sensors": json.dumps({"touch": sensor}), "observations": "{}"}
        return tgdsl.compile(example, overrides=changes, device=device)
    grid = {"method": "grid", "rows": 10, "columns": 20, "direction": [0, 0, -1], "radius": 0.004}
    document = pad_document(folder, PAD, grid, {"touch": {"kind": "kinematic_taxel", **fields}}, "cube")
    return tgdsl.compile(document, device=device)


def pad_document(folder: Path, scene: str, grid: dict[str, Any], sensors: dict[str, Any], item: str) -> dict[str, Any]:
    """Return a document of sensors on the body `pad` that feel one object; write its scene to a folder."""
    model = folder / "scene.xml"
    model.write_text(scene)
    return {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": {"resolutions": {"r": {"pad": grid}}}},
        "objects": {item: {"body": item}},
        "sensors": {name: {"links": "pad", "feels": [item], **sensor} for name, sensor in sensors.items()},
    }


# The plot ------------------------------------------------------------------------------------------------------------------

STEP = 5e-3
"""Time between two readings of the plot [s]."""
PATH = (
    (0.0, 5.0, 0.0),
    (0.1, 5.0, 0.0),
    (0.3, -0.5, 0.0),
    (0.7, -0.5, 0.0),
    (0.9, 5.0, 0.0),
    (1.1, 5.0, 0.0),
    (1.3, -0.5, 0.0),
    (1.4, -0.5, 0.0),
    (1.9, -0.5, 5.0),
    (2.0, -0.5, 5.0),
    (2.2, 5.0, 5.0),
    (2.4, 5.0, 5.0),
)
"""Time [s], height of the cube's lower face above the pad [mm], and shift along it [mm]; linear in between."""
PHASES = (("press", 0.2), ("hold", 0.5), ("release", 0.8), ("press again", 1.2), ("slide", 1.65), ("release", 2.1))
TAXEL = 27
"""The plotted taxel, near the pad's centre."""
COLOURS = {"clean": "#b9bec7", "measured": "#2a62b0"}
PLOT_PAD = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".016 .016 .005" pos="0 0 -.005"/></body>
  <body name="cube"><freejoint/><geom type="box" size=".012 .012 .012"/></body>
</worldbody></mujoco>
"""
POINT_PAD = """
<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".016 .016 .005" pos="0 0 -.005"/></body>
  <body name="ball"><freejoint/><geom type="sphere" size=".004"/></body>
</worldbody></mujoco>
"""
GRID = {"method": "grid", "rows": 8, "columns": 8, "direction": [0, 0, -1], "radius": 4e-3}
SKIN = {
    "kernel": "bonded_layer",
    "thickness": 2e-3,
    "standoff": 5e-4,
    "youngs_modulus": 2e5,
    "poissons_ratio": 0.45,
    "normal_stiffness": 1e8,
    "friction": 0.4,
}


@dataclass(frozen=True)
class Plot:
    """Plot clean and measured readings of a press, a hold, a release and a slide."""

    out: Path = Path("docs/images")
    """Folder for noise_press.png."""
    seed: int = 0
    """Seed of the noise."""

    def run(self) -> None:
        """Read along the script and draw."""
        sensors: dict[str, dict[str, Any]] = {
            "depth": {"kind": "contact_depth", "gate": "geometric"},
            "contact": {"kind": "contact", "gate": "geometric", "threshold": "0.5 mm"},
            "touch": {"kind": "kinematic_taxel", "gate": "geometric", "outputs": ["force"]},
            "skin": {"kind": "elastomer", "gate": "geometric", **SKIN},
            "near": {"kind": "proximity", "outputs": ["force"], "tolerance": 0.02},
        }
        sensors = {name: {**fields, "noise": "noisy", "readout": "both"} for name, fields in sensors.items()}
        with TemporaryDirectory() as folder:
            touch = tgdsl.compile(pad_document(Path(folder), PLOT_PAD, GRID, sensors, "cube")).seed(self.seed)
            point = point_load(Path(folder))
        time_s, pos, velocity = script()
        series: dict[str, list[np.ndarray]] = {output.name: [] for output in touch.outputs}
        with torch.no_grad():
            for i in range(len(time_s)):
                readings = touch(state_at(touch, "cube", pos[i], velocity[i]))
                for name, values in series.items():
                    values.append(readings[name][0].numpy())
        figure = draw(time_s, {name: np.stack(values) for name, values in series.items()}, point)
        path = self.out / "noise_press.png"
        figure.savefig(path, dpi=110)
        print(path)


def script() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return time [s], and the cube's position (step, 3) [m] and velocity (step, 3) [m/s]."""
    corner, height, along = np.array(PATH).T
    time_s = np.arange(0, corner[-1], STEP)
    pos = 1e-3 * np.stack([np.interp(time_s, corner, along), 0 * time_s, np.interp(time_s, corner, height) + 12], axis=1)
    return time_s, pos, np.gradient(pos, STEP, axis=0)


def state_at(touch: TactileModule, item: str, pos: np.ndarray, velocity: np.ndarray) -> SceneState:
    """Return a state with the pad at rest at the origin, and the item's position [m] and velocity [m/s]."""
    bodies = touch.inputs.bodies
    body_pos, linvel = torch.zeros(2, 1, len(bodies), 3, dtype=torch.float64)
    body_pos[0, bodies.index(item)], linvel[0, bodies.index(item)] = torch.from_numpy(pos), torch.from_numpy(velocity)
    quat = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, len(bodies), 4)
    return SceneState(body_pos=body_pos, body_quat=quat, body_linvel=linvel, body_angvel=torch.zeros_like(body_pos), dt=STEP)


def point_load(folder: Path) -> dict[str, np.ndarray]:
    """Return the force of a ball over the corner taxel, clean and after crosstalk: (row, column) [N]."""
    noise = {"crosstalk": {"strength": 0.5, "sigma": 4e-3}}
    sensor = {"kind": "kinematic_taxel", "gate": "geometric", "outputs": ["force"], "noise": noise, "readout": "both"}
    small = {**GRID, "radius": 1e-3}
    touch = tgdsl.compile(pad_document(folder, POINT_PAD, small, {"s": sensor}, "ball"), dtype=torch.float64)
    readings = touch(state_at(touch, "ball", touch.taxels["s"]["pos"][0] + [0, 0, 4e-3], np.zeros(3)))
    names = {"clean": "s/clean", "measured": "s"}
    return {key: -touch.images(name, readings)[0]["pad"][0, 2].numpy() for key, name in names.items()}


def draw(time_s: np.ndarray, series: dict[str, np.ndarray], point: dict[str, np.ndarray]) -> Any:
    """Return the figure: a panel for each sensor, and one for crosstalk."""
    from matplotlib.figure import Figure

    panels = {
        "contact_depth": ("depth [mm]", "depth", lambda r: 1e3 * r[:, TAXEL, 0]),
        "contact": ("taxels in contact", "contact", lambda r: r[:, :, 0].sum(axis=1)),
        "kinematic_taxel, into the pad": ("force −z [N]", "touch", lambda r: -r[:, TAXEL, 2]),
        "elastomer, along the slide": ("displacement x [mm]", "skin", lambda r: 1e3 * r[:, TAXEL, 0]),
        "proximity, into the pad": ("force −z [N]", "near", lambda r: -r[:, TAXEL, 2]),
    }
    figure = Figure(figsize=(11, 9.2), layout="constrained")
    grid = figure.add_gridspec(3, 4)
    for i, (title, (unit, name, values_of)) in enumerate(panels.items()):
        row, column = divmod(i, 2)
        axes = figure.add_subplot(grid[row, 2 * column : 2 * column + 2])
        axes.plot(time_s, values_of(series[f"{name}/clean"]), color=COLOURS["clean"], linewidth=4, label="clean")
        axes.plot(time_s, values_of(series[name]), color=COLOURS["measured"], linewidth=1.1, label="measured, noise: noisy")
        axes.set_title(title, loc="left", fontsize=12, fontweight="bold")
        axes.set(xlabel="time [s]", ylabel=unit, xlim=(0, time_s[-1]))
        axes.grid(alpha=0.25)
        for phase, at in PHASES:
            axes.text(at, 0.99, phase, ha="center", va="top", fontsize=8.5, color="#666", transform=axes.get_xaxis_transform())
        low, high = axes.get_ylim()
        axes.set_ylim(low, high + 0.1 * (high - low))
    most = point["clean"].max()
    for column, (which, force) in enumerate(point.items()):
        axes = figure.add_subplot(grid[2, 2 + column])
        image = axes.imshow(np.sqrt(force), cmap="Blues", vmin=0.0, vmax=np.sqrt(most))
        name = {"clean": "clean", "measured": "crosstalk"}[which]
        axes.set_title(f"{name}: Σ = {force.sum():.4f} N", loc="left", fontsize=11, fontweight="bold")
        axes.set(xlabel="column", ylabel="row" if column == 0 else "")
    ticks = np.array([0, 0.05, 0.2, 0.5, 1]) * most
    bar = figure.colorbar(image, ax=figure.axes[-2:], shrink=0.7, label="force −z [N]")
    bar.set_ticks(list(np.sqrt(ticks)), labels=[f"{tick:.3f}" for tick in ticks])
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    return figure


Command = Annotated[Cost, tyro.conf.subcommand("cost")] | Annotated[Plot, tyro.conf.subcommand("plot")]

if __name__ == "__main__":
    start = time.perf_counter()
    tyro.cli(Command).run()  # type: ignore[arg-type]
    print(f"\n{time.perf_counter() - start:.0f} s")
