"""Compare ways to apply the elastomer's fixed operator: error and time on flat pads, and a planar convolution on fingertips.

    python benchmarks/elastomer.py forms [--device cuda] [--num-envs 4096] [--out docs]
    python benchmarks/elastomer.py curved
    python benchmarks/elastomer.py cycle [--out docs/images]

`forms` presses random spheres into square pads of n × n markers (the paper's Gaussian, with shear), for every form that the
operator of such a pad supports. The error of a float32 form is against the dense matrix in float64 (which the tests compare
with the definition; forms with a clamped boundary: their own), relative to the largest displacement in the batch. Times are
medians of compiled calls, on a GPU of replayed CUDA graphs.

`curved` compares the dense operator on fingertips of the XHand1 and the Sharpa Wave with the operator of a planar FFT: a
regular grid in the mean plane of the same taxels. Errors are of displacements in the links' frames, relative to the largest.

`cycle` presses a ball of 20 mm radius 1 mm deep into 121 × 121 taxels and moves it back and forth. It compares the friction
force on the anchors with the closed forms of a Winkler foundation and of an elastic half-space (Cattaneo, Mindlin).
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from gpu import captured
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
"""Width of the pad beyond the outermost markers [m]."""
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
    """Return the inputs of each operator for spheres that press into a pad and drag it: float64 planes (…, env, taxel)."""
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
    """Return the displacement planes (3, env, taxel) on a flat pad with normals along z and strengths of 1."""
    x, y, z = operators.apply([link["spread"]], [inputs["spread"]])
    (bulge,) = operators.apply([link["bulge"]], [inputs["bulge"]])
    (drag,) = operators.apply([link["drag"]], [inputs["drag"]])
    return torch.stack([x + drag[0], y + drag[1], z + bulge])


@dataclass(frozen=True)
class Forms:
    """Error and time of every form."""

    device: str = "cpu"
    num_envs: int = 1024
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
        calls, errors, sizes = {}, {}, {}
        for form, fields in FORMS.items():
            arrays = folded(taxels, surface, fields)
            dense = folded(taxels, surface, {**fields, "operator": "dense", "tolerance": None} if "svd" in form else fields)
            truth = displacement(tensors(dense, self.device, torch.float64), exact)
            link = tensors(arrays, self.device, torch.float32)
            result = displacement(link, inputs)
            errors[form] = float((result.double() - truth).abs().max() / truth.abs().max())
            sizes[form] = sum(value.size for operator in arrays.values() for value in vars(operator).values())
            torch.compiler.reset()
            compiled = torch.compile(displacement, fullgraph=True, dynamic=False) if form != "fft" else displacement
            with torch.no_grad():
                calls[form] = captured(lambda c=link, f=compiled: f(c, inputs), torch.device(self.device))
        times = median_ms(calls, self.repeats, self.device)
        rows = []
        for form in FORMS:
            cost = 1e3 * times[form] if self.device == "cuda" else times[form] / times["dense"]
            print(f"| {num} × {num} | {form} | {sizes[form]} | {errors[form]:.1e} | {cost:.3g} |", flush=True)
            rows.append((num, form, errors[form], cost))
        return rows


def tensors(link: dict[str, Operator[np.ndarray]], device: str, dtype: torch.dtype) -> Operators:
    """Return operators with tensors on a device; floats have the dtype."""

    def tensor(value: np.ndarray) -> Tensor:
        result = torch.from_numpy(np.ascontiguousarray(value)).to(device)
        return result.to(dtype) if result.is_floating_point() else result

    return {
        name: operators.operator_of({key: tensor(value) for key, value in vars(operator).items()})
        for name, operator in link.items()
    }


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
        """Print a row per fingertip: its curvature, the error of the dense operator, and largest and RMS planar errors."""
        from tgdsl.compiler.pipeline import placed

        print("| hand | fingertip | taxels | normals differ by | dense | planar, largest | planar, RMS |")
        print("|---|---|---|---|---|---|---|")
        for hand in ("xhand1", "sharpa"):
            for resolution, layout in placed(
                {"tgdsl": 1, "robot": {"model": hand}}, resolutions=self.resolutions
            ).layouts.items():
                links = [i for i, link in enumerate(layout.links) if link.name in layout.groups["tips"]]
                for i in links[:2]:
                    on_link = layout.link_id == i
                    taxels = LinkTaxels(
                        layout.pos[on_link],
                        layout.normal[on_link],
                        layout.area[on_link],
                        layout.cell[on_link],
                        layout.radius[on_link] > 0,
                    )
                    if (taxels.cell < 0).any():
                        continue
                    angle = np.degrees(np.arccos(np.clip(taxels.normal @ taxels.normal.mean(axis=0), -1, 1)))
                    exact, flat = responses_of(taxels), responses_of(flattened(taxels))
                    h = bumps(taxels)
                    expected, planar = (np.einsum("kji,ei->ekj", matrix, h) for matrix in (exact, flat))
                    error, scale = np.linalg.norm(planar - expected, axis=1), np.linalg.norm(expected, axis=1).max()
                    dense = np.linalg.norm(in_float32(taxels, h) - expected, axis=1).max() / scale
                    name = f"{hand}, {resolution} | {layout.links[i].name} | {on_link.sum()} | {angle.max():.0f}°"
                    errors = f"{100 * error.max() / scale:.0f} % | {100 * np.sqrt((error**2).mean()) / scale:.1f} %"
                    print(f"| {name} | {dense:.0e} | {errors} |")


def responses_of(taxels: LinkTaxels) -> np.ndarray:
    """Return the in-plane dilation per depth, (3, target, source)."""
    return operators.responses(spec_of(), taxels, None)["spread"](np.arange(len(taxels.pos)))[:, 0]


def in_float32(taxels: LinkTaxels, h: np.ndarray) -> np.ndarray:
    """Return the displacements by a module's dense operator for depths (press, taxel), in float32."""
    response = operators.responses(spec_of(), taxels, None)["spread"]
    spread = operators.fold(response, operators.PLANES["spread"], taxels, OperatorForm("dense", None))
    link = tensors({"spread": spread}, "cpu", torch.float32)
    return torch.stack(operators.apply([link["spread"]], [torch.from_numpy(h).float()]), dim=1).double().numpy()


def flattened(taxels: LinkTaxels) -> LinkTaxels:
    """Return the taxels as a regular grid in their mean plane, with one normal, as a planar FFT assumes."""
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
    """Return depths (press, taxel) under balls of 5 mm that press 1 mm deep at random taxels [m]."""
    centres = np.random.default_rng(0).integers(len(taxels.pos), size=num)
    distance = np.linalg.norm(taxels.pos[None] - taxels.pos[centres][:, None], axis=2)
    return np.maximum(0.0, 1e-3 - distance**2 / (2 * 5e-3))


@dataclass(frozen=True)
class Cycle:
    """The stick-slip loop of the anchors."""

    out: Path | None = None
    """Folder for the plot."""

    def run(self) -> None:
        """Move a ball in a pad and compare the friction force with closed forms."""
        radius, depth, slip = 0.02, 1e-3, 0.4
        line = np.linspace(-7e-3, 7e-3, 121)
        x, y = (part.reshape(-1) for part in np.meshgrid(line, line))
        pos, normal = np.stack([x, y, 0 * x], axis=1), np.broadcast_to([0.0, 0.0, 1.0], (x.size, 3))
        h = depth - (x * x + y * y) / (2 * radius)
        stick_slip, state = StickSlip(0.0, 0.0, 1e-2, slip), {name: np.zeros(x.size) for name in PLANES}
        path = np.concatenate([np.linspace(0, 0.8, 33), np.linspace(0.8, -0.8, 65)[1:], np.linspace(-0.8, 0.8, 65)[1:]])
        series = []
        for s in path * slip * depth:
            offset = np.broadcast_to([-s, 0.0, 0.0], (x.size, 1, 3))
            touch = ReferencePenetration(
                np.maximum(h, 0), 0 * pos, 0 * pos, 0 * pos, -h[:, None], 0 * pos[:, None],
                np.broadcast_to(np.eye(3), (x.size, 1, 3, 3)), offset,
            )  # fmt: skip
            stretch, state = advance_reference(touch, pos, normal, stick_slip, state)
            series.append(stretch[:, 0].sum() / (slip * np.maximum(h, 0).sum()))
        force = np.array(series)
        closed = {name: loop(path, power) for name, power in {"Winkler": 2.0, "Mindlin": 1.5}.items()}
        print("| s/s* | anchors Q/μP | Winkler 1 − (1 − s/s*)² | Cattaneo–Mindlin 1 − (1 − s/s*)^1.5 |\n|---|---|---|---|")
        for i in (*range(0, 33, 8), 64, 96, 128, 160):
            print(f"| {path[i]:.2f} | {force[i]:.3f} | {closed['Winkler'][i]:.3f} | {closed['Mindlin'][i]:.3f} |")
        errors = {name: np.abs(force - values).max() for name, values in closed.items()}
        print(f"\nlargest difference: Winkler {errors['Winkler']:.4f}, Cattaneo–Mindlin {errors['Mindlin']:.4f}")
        if self.out is not None:
            plot_cycle(path, force, closed, self.out / "elastomer-cycle.png")


def loop(path: np.ndarray, power: float) -> np.ndarray:
    """Return Q/μP of a loading to 0.8 s*, back to −0.8 s* and forth: 1 − (1 − s)^n, then by Masing's rule."""

    def first(s: np.ndarray | float) -> Any:
        return 1 - (1 - np.asarray(s)) ** power

    back, forth = first(0.8) - 2 * first((0.8 - path) / 2), -first(0.8) + 2 * first((0.8 + path) / 2)
    return np.concatenate([first(path[:33]), back[33:97], forth[97:]])


def plot_cycle(path: np.ndarray, force: np.ndarray, closed: dict[str, np.ndarray], file: Path) -> None:
    """Draw the loops."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.2, 4.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(path, closed["Mindlin"], color="#b5542c", label="elastic half-space (Cattaneo, Mindlin)")
    axes.plot(path, closed["Winkler"], color="#3b6fb6", label="Winkler foundation")
    axes.plot(path[::4], force[::4], "o", markersize=3.5, color="#2b2f36", label="anchors on 121 × 121 taxels")
    axes.set(xlabel="displacement s/s*", ylabel="friction force Q/μP")
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(file, dpi=110)


Command = Annotated[Forms, tyro.conf.subcommand("forms")] | Annotated[Curved, tyro.conf.subcommand("curved")]
Command = Command | Annotated[Cycle, tyro.conf.subcommand("cycle")]

if __name__ == "__main__":
    start = time.perf_counter()
    tyro.cli(Command).run()  # type: ignore[arg-type]
    print(f"\n{time.perf_counter() - start:.0f} s")
