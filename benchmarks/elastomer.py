"""Elastomer: error and time of the ways to apply its fixed operator, and what a planar convolution does to a curved fingertip.

    python benchmarks/elastomer.py forms [--device cuda] [--num-envs 4096] [--out docs]
    python benchmarks/elastomer.py curved
    python benchmarks/elastomer.py cycle [--out docs/images]

`forms` presses random spheres into square pads of n × n markers (the paper's Gaussian, with shear), in every form that such a
pad can have: dense, fft, truncated svd, and dense with a clamped boundary. The error is that of the float32 form against the
dense matrix in float64 (which the tests compare with the definition), over the largest displacement in the batch; of the
clamped one, against its own float64. Times are medians of compiled calls, on a GPU of replayed CUDA graphs.

`curved` compares the dense operator on the XHand1's and the Sharpa's fingertips with the operator of a regular grid in the mean
plane of the same taxels, the one that a planar FFT computes: displacements in the links' frames, over the largest one.

`cycle` presses a ball of 20 mm radius 1 mm deep into 121 × 121 taxels, moves it to and fro, and prints the friction force that
the anchors carry beside the closed forms of a Winkler foundation and of an elastic half-space (Cattaneo, Mindlin).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from module import median_ms
from torch import Tensor

from tgdsl.quantities.contact_depth import ReferencePenetration
from tgdsl.sensors.elastomer import operators
from tgdsl.sensors.elastomer.anchors import PLANES, StickSlip, advance_reference
from tgdsl.sensors.elastomer.operators import LinkTaxels, Operator, OperatorForm
from tgdsl.sensors.elastomer.spec import ElastomerSpec
from tgdsl.surfaces.surface import Surface

PITCH = 1.5e-3
"""Spacing of the markers of the square pads [m]."""
EDGE = 1.5e-3
"""How far the pad goes on beyond the outermost markers [m]."""
FORMS: dict[str, dict[str, Any]] = {
    "dense": {"operator": "dense"},
    "fft": {"operator": "fft"},
    "svd, 1e-3": {"operator": "svd", "tolerance": 1e-3},
    "svd, 1e-2": {"operator": "svd", "tolerance": 1e-2},
    "dense, clamped": {"operator": "dense", "thickness": 2e-3, "boundary": {}},
    "svd, 1e-2, clamped": {"operator": "svd", "tolerance": 1e-2, "thickness": 2e-3, "boundary": {}},
}


def spec_of(**fields: Any) -> ElastomerSpec:
    """Return a spec of the Gaussian kernel with the paper's numbers."""
    return ElastomerSpec.model_validate({"kind": "elastomer", "links": "pad", "feels": ["ball"], **fields})


def square(num: int) -> tuple[LinkTaxels, Surface]:
    """Return a pad of num × num markers, and its surface: two triangles."""
    line = (np.arange(num) - (num - 1) / 2) * PITCH
    cell = np.stack(np.divmod(np.arange(num * num), num), axis=1)
    pos = np.stack([line[cell[:, 1]], line[cell[:, 0]], np.zeros(num * num)], axis=1)
    half = line[-1] + EDGE
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
    surface = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, dtype=np.int64), (("pad",),))
    normal = np.broadcast_to([0.0, 0.0, 1.0], pos.shape).copy()
    return LinkTaxels(pos, normal, np.full(len(pos), PITCH**2), cell, np.ones(len(pos), dtype=bool)), surface


def presses(taxels: LinkTaxels, num_envs: int, seed: int = 0) -> dict[str, Tensor]:
    """Return what goes into each operator when spheres press into a pad and drag it: float64 planes (…, env, taxel)."""
    rng = np.random.default_rng(seed)
    extent = np.abs(taxels.pos[:, :2]).max()
    centre = rng.uniform(-extent, extent, (num_envs, 1, 2))
    radius, depth = rng.uniform(4e-3, 12e-3, (num_envs, 1)), rng.uniform(1e-4, 1e-3, (num_envs, 1))
    square = ((taxels.pos[:, :2] - centre) ** 2).sum(axis=2)
    h = np.maximum(0.0, depth - square / (2 * radius))
    slip = rng.normal(scale=1e-4, size=(3, num_envs, 1)) * np.array([1.0, 1.0, 0.0])[:, None, None]
    return {name: torch.from_numpy(value) for name, value in {"spread": h, "bulge": h**1.2, "drag": slip * h}.items()}


Operators = dict[str, Operator[Tensor]]


def folded(taxels: LinkTaxels, surface: Surface, fields: dict[str, Any]) -> dict[str, Operator[np.ndarray]]:
    """Return the folded operators of one form."""
    spec = spec_of(**fields)
    pad = surface if spec.boundary is not None else None
    form = OperatorForm(spec.operator, spec.tolerance)
    return {
        name: operators.fold(response, operators.PLANES[name], taxels, form, is_alike=pad is None or name != "spread")
        for name, response in operators.responses(spec, taxels, pad).items()
    }


def displacement(link: Operators, inputs: dict[str, Tensor]) -> Tensor:
    """Return the displacement planes (3, env, taxel) on a flat pad that looks along z, strengths 1."""
    x, y, z = operators.apply([link["spread"]], [inputs["spread"]])
    (bulge,) = operators.apply([link["bulge"]], [inputs["bulge"]])
    (drag,) = operators.apply([link["drag"]], [inputs["drag"]])
    return torch.stack([x + drag[0], y + drag[1], z + bulge])


@dataclass(frozen=True)
class Forms:
    """Error and time of every form."""

    device: str = "cpu"
    """Where."""
    num_envs: int = 1024
    """Environments."""
    sizes: tuple[int, ...] = (10, 20, 32)
    """Markers along each side."""
    repeats: int = 20
    """Timed calls of each form."""
    out: Path | None = None
    """Folder for the plot."""

    def run(self) -> None:
        """Measure and print one row per pad and form."""
        where = torch.cuda.get_device_name() if self.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
        print(f"torch {torch.__version__}, {where}, {self.num_envs} environments, float32, medians of {self.repeats}\n")
        unit = "µs" if self.device == "cuda" else "time / dense"
        print(f"| markers | form | numbers | error, of the largest displacement | {unit} |\n|{'---|' * 5}")
        rows = [row for num in self.sizes for row in self._pad(num)]
        if self.out is not None:
            plot(rows, self.device, unit, self.out / f"elastomer-{self.device}.png")

    def _pad(self, num: int) -> list[tuple[int, str, float, float]]:
        taxels, surface = square(num)
        exact = {name: value.to(self.device) for name, value in presses(taxels, self.num_envs).items()}
        inputs = {name: value.float() for name, value in exact.items()}
        calls, errors, bytes_of = {}, {}, {}
        for form, fields in FORMS.items():
            arrays = folded(taxels, surface, fields)
            dense = folded(taxels, surface, {**fields, "operator": "dense", "tolerance": None} if "svd" in form else fields)
            truth = displacement(on(dense, self.device, torch.float64), exact)
            link = on(arrays, self.device, torch.float32)
            result = displacement(link, inputs)
            errors[form] = float((result.double() - truth).abs().max() / truth.abs().max())
            bytes_of[form] = sum(value.size for operator in arrays.values() for value in vars(operator).values())
            torch.compiler.reset()
            compiled = torch.compile(displacement, fullgraph=True, dynamic=False) if form != "fft" else displacement
            calls[form] = captured(lambda c=link, f=compiled: f(c, inputs), self.device)
        times = median_ms(calls, self.repeats, self.device)
        rows = []
        for form in FORMS:
            cost = 1e3 * times[form] if self.device == "cuda" else times[form] / times["dense"]
            print(f"| {num} × {num} | {form} | {bytes_of[form]} | {errors[form]:.1e} | {cost:.3g} |", flush=True)
            rows.append((num, form, errors[form], cost))
        return rows


def on(link: dict[str, Operator[np.ndarray]], device: str, dtype: torch.dtype) -> Operators:
    """Return operators of tensors; floats in `dtype`."""

    def tensor(value: np.ndarray) -> Tensor:
        result = torch.from_numpy(np.ascontiguousarray(value)).to(device)
        return result.to(dtype) if result.is_floating_point() else result

    return {
        name: operators.operator_of({key: tensor(value) for key, value in vars(operator).items()})
        for name, operator in link.items()
    }


def captured(call: Callable[[], Any], device: str) -> Callable[[], Any]:
    """Return a call that replays a CUDA graph of another; on a CPU the call itself."""
    if device != "cuda":
        return call
    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream), torch.no_grad():
        for _ in range(3):
            call()
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.no_grad(), torch.cuda.graph(graph):
        call()

    def replay(_inputs: Callable[[], Any] = call) -> None:  # the graph reads their memory, so they must live as long
        graph.replay()

    return replay


def plot(rows: list[tuple[int, str, float, float]], device: str, unit: str, path: Path) -> None:
    """Draw error against time, one panel per pad."""
    from matplotlib.figure import Figure

    sizes = list(dict.fromkeys(row[0] for row in rows))
    figure = Figure(figsize=(4.2 * len(sizes), 3.8), layout="constrained")
    for axes, num in zip(figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0], sizes, strict=True):
        for form, colour in zip(FORMS, ("#1b7f4d", "#3b6fb6", "#b5542c", "#e0a03a", "#7a4fa3", "#c2315b"), strict=True):
            _, _, error, cost = next(row for row in rows if row[:2] == (num, form))
            axes.scatter(cost, error, s=60, color=colour, label=form)
        axes.set(title=f"{num} × {num} markers", xscale="log", yscale="log", xlabel=unit)
        axes.grid(alpha=0.25)
    figure.axes[0].set_ylabel("largest error / largest displacement")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)


@dataclass(frozen=True)
class Curved:
    """The planar convolution's error on fingertips."""

    resolutions: tuple[str, ...] = ("med", "high")
    """Resolutions of the hands' layouts."""

    def run(self) -> None:
        """Print one row per fingertip: how curved it is, and the largest and RMS error, of the dense operator and planar."""
        from tgdsl.compiler.pipeline import placed

        print("| hand | fingertip | taxels | normals differ by | dense | planar, largest | planar, RMS |")
        print("|---|---|---|---|---|---|---|")
        for hand in ("xhand1", "sharpa"):
            for resolution, layout in placed(
                {"tgdsl": 1, "robot": {"model": hand}}, resolutions=self.resolutions
            ).layouts.items():
                links = [i for i, link in enumerate(layout.links) if link.name in layout.groups["tips"]]
                for i in links[:2]:
                    own = layout.link_id == i
                    taxels = LinkTaxels(
                        layout.pos[own], layout.normal[own], layout.area[own], layout.cell[own], layout.radius[own] > 0
                    )
                    if (taxels.cell < 0).any():
                        continue
                    angle = np.degrees(np.arccos(np.clip(taxels.normal @ taxels.normal.mean(axis=0), -1, 1)))
                    exact, flat = responses_of(taxels), responses_of(flattened(taxels))
                    h = bumps(taxels)
                    true, seen = (np.einsum("kji,ei->ekj", matrix, h) for matrix in (exact, flat))
                    error, scale = np.linalg.norm(seen - true, axis=1), np.linalg.norm(true, axis=1).max()
                    dense = np.linalg.norm(in_float32(taxels, h) - true, axis=1).max() / scale
                    name = f"{hand}, {resolution} | {layout.links[i].name} | {own.sum()} | {angle.max():.0f}°"
                    planar = f"{100 * error.max() / scale:.0f} % | {100 * np.sqrt((error**2).mean()) / scale:.1f} %"
                    print(f"| {name} | {dense:.0e} | {planar} |")


def responses_of(taxels: LinkTaxels) -> np.ndarray:
    """Return the in-plane dilation per depth, (3, target, source)."""
    return operators.responses(spec_of(), taxels, None)["spread"](np.arange(len(taxels.pos)))[:, 0]


def in_float32(taxels: LinkTaxels, h: np.ndarray) -> np.ndarray:
    """Return what a module's dense operator makes of depths (press, taxel), in float32."""
    response = operators.responses(spec_of(), taxels, None)["spread"]
    spread = operators.fold(response, operators.PLANES["spread"], taxels, OperatorForm("dense", None))
    link = on({"spread": spread}, "cpu", torch.float32)
    return torch.stack(operators.apply([link["spread"]], [torch.from_numpy(h).float()]), dim=1).double().numpy()


def flattened(taxels: LinkTaxels) -> LinkTaxels:
    """Return the taxels as a regular grid in their mean plane, with one normal: what a planar FFT takes them for."""
    normal = taxels.normal.mean(axis=0)
    normal /= np.linalg.norm(normal)
    design = np.column_stack([taxels.cell, np.ones(len(taxels.cell))])
    step = np.linalg.lstsq(design, taxels.pos, rcond=None)[0]
    down = step[0] - (step[0] @ normal) * normal
    along = step[1] - (step[1] @ normal) * normal
    along -= (along @ down) / (down @ down) * down
    pos = design @ np.stack([down, along, taxels.pos.mean(axis=0) - taxels.cell.mean(axis=0) @ np.stack([down, along])])
    return LinkTaxels(pos, np.broadcast_to(normal, pos.shape).copy(), taxels.area, taxels.cell, taxels.is_active)


def bumps(taxels: LinkTaxels, num: int = 200) -> np.ndarray:
    """Return depths (press, taxel) under balls of 5 mm that press 1 mm deep over random taxels [m]."""
    chosen = np.random.default_rng(0).integers(len(taxels.pos), size=num)
    apart = np.linalg.norm(taxels.pos[None] - taxels.pos[chosen][:, None], axis=2)
    return np.maximum(0.0, 1e-3 - apart**2 / (2 * 5e-3))


@dataclass(frozen=True)
class Cycle:
    """The stick-slip loop of the anchors."""

    out: Path | None = None
    """Folder for the plot."""

    def run(self) -> None:
        """Move a ball in a pad and compare."""
        radius, depth, slip = 0.02, 1e-3, 0.4
        line = np.linspace(-7e-3, 7e-3, 121)
        x, y = (part.reshape(-1) for part in np.meshgrid(line, line))
        pos, normal = np.stack([x, y, 0 * x], axis=1), np.broadcast_to([0.0, 0.0, 1.0], (x.size, 3))
        h = depth - (x * x + y * y) / (2 * radius)
        stick_slip, state = StickSlip(0.0, 0.0, 1e-2, slip), {name: np.zeros(x.size) for name in PLANES}
        way = np.concatenate([np.linspace(0, 0.8, 33), np.linspace(0.8, -0.8, 65)[1:], np.linspace(-0.8, 0.8, 65)[1:]])
        found = []
        for s in way * slip * depth:
            moved = np.broadcast_to([-s, 0.0, 0.0], (x.size, 1, 3))
            touch = ReferencePenetration(
                np.maximum(h, 0), 0 * pos, 0 * pos, 0 * pos, -h[:, None], 0 * pos[:, None],
                np.broadcast_to(np.eye(3), (x.size, 1, 3, 3)), moved,
            )  # fmt: skip
            carried, state = advance_reference(touch, pos, normal, stick_slip, state)
            found.append(carried[:, 0].sum() / (slip * np.maximum(h, 0).sum()))
        closed = {name: loop(way, power) for name, power in {"Winkler": 2.0, "Mindlin": 1.5}.items()}
        print("| s/s* | anchors Q/μP | Winkler 1 − (1 − s/s*)² | Cattaneo–Mindlin 1 − (1 − s/s*)^1.5 |\n|---|---|---|---|")
        for i in (*range(0, 33, 8), 64, 96, 128, 160):
            print(f"| {way[i]:.2f} | {found[i]:.3f} | {closed['Winkler'][i]:.3f} | {closed['Mindlin'][i]:.3f} |")
        apart = {name: np.abs(np.array(found) - values).max() for name, values in closed.items()}
        print(f"\nlargest difference: Winkler {apart['Winkler']:.4f}, Cattaneo–Mindlin {apart['Mindlin']:.4f}")
        if self.out is not None:
            plot_cycle(way, np.array(found), closed, self.out / "elastomer-cycle.png")


def loop(way: np.ndarray, power: float) -> np.ndarray:
    """Return Q/μP of a loading to 0.8 s*, back to −0.8 s* and forth: 1 − (1 − s)^n, then by Masing's rule."""

    def first(s: np.ndarray | float) -> Any:
        return 1 - (1 - np.asarray(s)) ** power

    back, forth = first(0.8) - 2 * first((0.8 - way) / 2), -first(0.8) + 2 * first((0.8 + way) / 2)
    return np.concatenate([first(way[:33]), back[33:97], forth[97:]])


def plot_cycle(way: np.ndarray, found: np.ndarray, closed: dict[str, np.ndarray], path: Path) -> None:
    """Draw the loops."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(way, closed["Mindlin"], color="#b5542c", label="elastic half-space (Cattaneo, Mindlin)")
    axes.plot(way, closed["Winkler"], color="#3b6fb6", label="Winkler foundation")
    axes.plot(way[::4], found[::4], "o", markersize=3.5, color="#2b2f36", label="anchors on 121 × 121 taxels")
    axes.set(xlabel="displacement s/s*", ylabel="friction force Q/μP")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


Command = Annotated[Forms, tyro.conf.subcommand("forms")] | Annotated[Curved, tyro.conf.subcommand("curved")]
Command = Command | Annotated[Cycle, tyro.conf.subcommand("cycle")]

if __name__ == "__main__":
    start = time.perf_counter()
    tyro.cli(Command).run()  # type: ignore[arg-type]
    print(f"\n{time.perf_counter() - start:.0f} s")
