"""Fit sensors to recordings of real ones and to a finite-element model: the tables and plots of docs/background/reality.md.

    python benchmarks/reality.py gelsight DATA_FOLDER [--out docs/images]
    python benchmarks/reality.py eflesh DATA_FOLDER
    python benchmarks/reality.py dome DATA_FOLDER

The data are not part of tgdsl. DATA_FOLDER must have `gelsight/subpixel.npz` (FOTS; positions of markers detected again in its
images), `eflesh/normal` (eFlesh) and `gel_dome_fem.npz` (Taxim). Each row is a call of `tgdsl.calibrate` with a document and
recordings that this script writes to a temporary folder.
"""

from __future__ import annotations

import json
import lzma
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import tgdsl
from tgdsl.calibration.fit import Comparison, Fit
from tgdsl.calibration.problem import ReadingMap

PX = 18.8e3
"""Pixels per metre of the GelSight's images, from the marker pitch."""
CENTRE = np.array([137.0, 126.0])
"""Centre of the contact [px]."""
BALL = 3e-3
"""Radius of the pressing ball [m]."""
LAYER = {"kernel": "bonded_layer", "youngs_modulus": 1e5, "normal_stiffness": 1e7, "thickness": 7e-3, "poissons_ratio": 0.38}
LAYER |= {"marker_depth": 3e-4}
HALF_SPACE = {"kernel": "half_space", "youngs_modulus": 1e5, "normal_stiffness": 1e7, "poissons_ratio": 0.45}
GAUSSIAN = {"kernel": "gaussian", "dilation_falloff": 8e4, "shear_falloff": 8e4}
PRESSED = {**LAYER, "thickness": 6.85e-3, "poissons_ratio": 0.374, "marker_depth": 3.4e-4}
"""The layer fitted to the press alone."""
OF_LAYER = ["skin.thickness=2 mm:20 mm", "skin.poissons_ratio", "skin.marker_depth=0 mm:2 mm"]
OF_HALF_SPACE = ["skin.poissons_ratio", "skin.marker_depth=0 mm:2 mm"]
FRICTION = "skin.friction=0.02:3"
DOME_RADIUS = 28.41e-3
"""Radius of the sphere on which the dome's nodes lie, within 1 µm [m]."""
DOME_BALL = 1e-3
"""Radius of the ball that replaces the load on a node [m]."""
DRAG_STARTS = ((0.0, 0.0), (1.5e-4, 5e-5), (1.5e-4, 9e-5))
"""Starts of the search for the dragged ball's position, from the loaded node [m]: there are several minima."""
DOME_NEAR = 1.5e-3
"""Distance from the loaded node within which all nodes are used [m]."""
DOME_SHARE = 0.03
"""Sampled share of the other nodes, whose weights make up for it."""


def write_document(
    folder: Path, name: str, sensor: dict[str, Any], resolutions: dict[str, Any], pad: float, ball: float
) -> Path:
    """Write a ball over a box whose upper face is the plane z = 0, and a document with one sensor on the box.

    Args:
        folder: Folder of the files.
        name: Name of the sensor and the document.
        sensor: Fields of the sensor.
        resolutions: The box's taxels by resolution; the sensor uses the first.
        pad: Half the box's width [m].
        ball: Radius of the ball [m].

    Returns:
        The document.
    """
    (folder / "scene.xml").write_text(
        f'<mujoco><worldbody><body name="pad"><geom type="box" size="{pad} {pad} .01" pos="0 0 -.01"/></body>'
        f'<body name="ball" pos="0 0 .1"><freejoint/><geom type="sphere" size="{ball}"/></body></worldbody></mujoco>'
    )
    content = {
        "tgdsl": 1,
        "robot": {"model": "scene.xml", "layout": {"resolutions": resolutions}},
        "resolution": next(iter(resolutions)),
        "objects": {"ball": {"body": "ball"}},
        "sensors": {name: {"links": "pad", "feels": ["ball"], "gate": "geometric", **sensor}},
    }
    file = folder / f"{name}.yaml"
    file.write_text(json.dumps(content))  # which is YAML too
    return file


def skin_document(
    folder: Path, places: np.ndarray, normals: np.ndarray, skin: dict[str, Any], ball: float, half: float, pitch: float
) -> Path:
    """Write an elastomer with taxels on a square, and markers at places [m] with normals; return the document."""
    num = round(2 * half / pitch)
    square = {"box": {"min": [-half, -half, -1e-3], "max": [half, half, 1e-3]}}
    grid = {"method": "grid", "rows": num, "columns": num, "direction": [0, 0, -1], "radius": 1e-3, "region": square}
    dots = [{"pos": p.tolist(), "normal": n.tolist(), "radius": 1e-3} for p, n in zip(places, normals, strict=True)]
    resolutions = {"taxels": {"pad": grid}, "dots": {"pad": {"method": "points", "points": dots}}}
    return write_document(folder, "skin", {"kind": "elastomer", "markers": "dots", **skin}, resolutions, 0.03, ball)


def probe_document(folder: Path, law: dict[str, Any]) -> Path:
    """Write a probe under a ball, whose force is the load; return the document."""
    probe = {"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.014}
    sensor = {"kind": "kinematic_taxel", "outputs": ["force"], "normal_stiffness": 1e4, "depth_exponent": 1.5}
    sensor |= {"normal_damping": 0, "shear_damping": 0, **law}
    return write_document(folder, "load", sensor, {"r": {"pad": {"method": "points", "points": [probe]}}}, 0.02, 0.02)


def poses(*positions: tuple[float, float, float]) -> dict[str, Any]:
    """Return poses of pad and ball at each step, with the ball's positions [m]."""
    pos, quat = np.zeros((len(positions), 2, 3)), np.zeros((len(positions), 2, 4))
    pos[:, 1], quat[..., 0] = positions, 1.0
    return {"time": np.arange(len(positions)), "body_pos": pos, "body_quat": quat, "bodies": ["pad", "ball"]}


def target(time_s: list[float], value: np.ndarray, is_used: np.ndarray, floor: float) -> dict[str, Any]:
    """Return a target of in-plane displacements [m] of the used markers."""
    return {
        "target:skin": value[None], "clock:skin": time_s, "unit:skin": "m", "weight:skin": is_used[None, :, None].astype(float),
        "channels:skin": ["displacement_x", "displacement_y"], "floor:skin": floor,
    }  # fmt: skip


def gelsight_recordings(data: Path, folder: Path) -> np.ndarray:
    """Write press.npz, drag.npz and raw.npz; return the unloaded positions of the markers [m]."""
    markers = np.load(data / "gelsight" / "subpixel.npz")
    press, drag = markers["press"] / PX, markers["drag"] / PX
    deep, wide = BALL - 1e-3, np.array([4e-4, 4e-4, 4e-4])
    still = np.zeros((1, 2, 3))
    still[0, 1] = wide
    size = np.sqrt((press[markers["press_kept"]] ** 2).mean())
    once = {**poses((0, 0, deep)), "width:body_pos": still}
    np.savez(folder / "press.npz", **once, **target([0], press, markers["press_kept"], 0.105 * size))
    moved = np.zeros((2, 2, 3))
    moved[0, 1], moved[1, 1] = wide, [1e-3, 1e-3, 4e-4]
    turned = np.zeros((2, 2, 4))
    turned[1, 1, 3] = 0.05  # half the angle about the normal by which the drag turned the ball [rad]
    both = poses((0, 0, deep), (0, 3e-4, deep))
    motion = {"zero:skin": 0.0, "width:body_pos": moved, "width:body_quat": turned}
    size = np.sqrt((drag[markers["drag_kept"]] ** 2).mean())
    np.savez(folder / "drag.npz", **both, **target([1], drag, markers["drag_kept"], 0.01 * size), **motion)
    raw = [np.loadtxt(data / "gelsight" / f"{i}.csv", delimiter=",", skiprows=1)[:, 2:4] / PX for i in (0, 1)]
    raw_drag, every = raw[1] - raw[0], np.ones(len(drag))
    size = np.sqrt((raw_drag**2).mean())
    np.savez(folder / "raw.npz", **both, **target([1], raw_drag, every, 0.113 * size), **motion)
    return np.column_stack([(markers["unloaded"] - CENTRE) / PX, np.zeros(len(press))])


def fit_case(
    label: str, sheet: Path, recordings: Any, parameters: list[str], out: Path | None, prefix: str = "", **options: Any
) -> Fit:
    """Fit, print the fit and its duration, and draw it if `out` is a folder."""
    start = time.perf_counter()
    result = tgdsl.calibrate(sheet, recordings, parameters, intervals="none", **options)
    print(f"{label}: {time.perf_counter() - start:.0f} s\n\n{result}\n", flush=True)
    if out is not None:
        result.plot(out / f"reality-{prefix}{label.replace(', ', '-').replace(' ', '-')}.png")
    return result


def gelsight(data: Path, out: Path | None, only: str, starts: int) -> None:
    """Print the table of the GelSight's press and drag."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = gelsight_recordings(data, folder)
        press, drag, raw = (folder / f"{which}.npz" for which in ("press", "drag", "raw"))
        cases: list[tuple[str, dict[str, Any], list[Path], list[str], ReadingMap]] = [
            ("gaussian, press, offset", GAUSSIAN, [press], ["skin.dilation_falloff=1e2:1e7"], "offset"),
            ("half_space, press, offset", HALF_SPACE, [press], OF_HALF_SPACE, "offset"),
            ("layer, press, offset", LAYER, [press], OF_LAYER, "offset"),
            ("gaussian, press, affine", GAUSSIAN, [press], ["skin.dilation_falloff=1e2:1e7"], "affine"),
            ("layer, press, affine", LAYER, [press], OF_LAYER, "affine"),
            ("gaussian, drag, offset", {**GAUSSIAN, "dilation_strength": 0}, [drag], ["skin.shear_falloff=1e4:1e6"], "offset"),
            ("half_space, drag, offset", {**HALF_SPACE, "friction": 0.3}, [drag], [*OF_HALF_SPACE, FRICTION], "offset"),
            ("layer, drag, offset", {**LAYER, "friction": 0.3}, [drag], [*OF_LAYER, FRICTION], "offset"),
            ("press's layer, drag, offset", {**PRESSED, "friction": 0.15}, [drag], [FRICTION], "offset"),
            ("half_space, raw drag, offset", {**HALF_SPACE, "friction": 0.3}, [raw], [*OF_HALF_SPACE, FRICTION], "offset"),
            ("layer, both, offset", {**PRESSED, "friction": 0.15}, [press, drag], [*OF_LAYER, FRICTION], "offset"),
        ]  # fmt: skip
        normals, fits = np.tile([0.0, 0.0, 1.0], (len(places), 1)), dict[str, Fit]()
        for label, skin, recordings, fit, reading in (case for case in cases if only in case[0]):
            sheet = skin_document(folder, places, normals, skin, BALL, 4e-3, 0.4e-3)
            options = {"reading": reading, "gain": True, "hold_out": "taxel", "starts": starts}
            fits[label] = fit_case(label, sheet, recordings, fit, out, **options)
        print(Comparison(fits))


def dome_recordings(data: Path, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Write press.npz and drag.npz; return positions [m] and normals of the used nodes: all near the load, some beyond."""
    nodes = np.load(data / "gel_dome_fem.npz")
    out = np.array([1.0, -1.0, -1.0])  # from the file's axes, z into the gel, to z out of it
    pos = nodes["dz_pos"].astype(np.float64)
    top = np.array([*(0.5 * (pos.max(axis=0) + pos.min(axis=0))[:2]), pos[:, 2].min()])
    pos, press, drag = (pos - top) * out, nodes["dz_disp"] * out, nodes["dxdz_disp"] * out
    normal = pos + np.array([0.0, 0.0, DOME_RADIUS])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    loaded = pos[np.linalg.norm(press, axis=1).argmax()]
    is_near = np.linalg.norm(pos - loaded, axis=1) < DOME_NEAR
    used = is_near | (np.random.default_rng(0).random(len(pos)) < DOME_SHARE)
    weight = np.where(is_near[used], 1.0, (~is_near).sum() / (used & ~is_near).sum())
    # First the ball presses, so that the gel sticks to it. Then it moves to the fitted position, along the gel too.
    down, width = [loaded[0], loaded[1], DOME_BALL - 2.5e-4], np.array([1e-4, 1e-4, 3e-5])
    moved = np.zeros((2, 2, 3))
    moved[0, 1], moved[1, 1] = width * [1, 1, 0], width
    cases = {"press": (press, (0.0, 0.0)), **{f"drag{i}": (drag, start) for i, start in enumerate(DRAG_STARTS)}}
    for name, (value, (x, y)) in cases.items():
        first = (down[0] + x / 2, down[1] + y / 2, down[2])
        states = poses(first, (down[0] + x, down[1] + y, DOME_BALL - 5e-5))
        read = {
            "target:skin": np.stack([np.zeros((used.sum(), 3)), value[used]]), "clock:skin": [0, 1], "unit:skin": "m",
            "weight:skin": np.stack([0.0 * weight, weight])[:, :, None], "width:body_pos": moved,
        }  # fmt: skip
        np.savez(folder / f"{name}.npz", **states, **read)
    return pos[used], normal[used]


def dome(data: Path, out: Path | None, only: str, starts: int) -> None:
    """Print the table of the finite-element dome: the material fitted to the press predicts the drag."""
    with tempfile.TemporaryDirectory() as name:
        folder, fits = Path(name), dict[str, Fit]()
        places, normals = dome_recordings(data, folder)
        poisson, depth = "skin.poissons_ratio", "skin.marker_depth=0 mm:0.3 mm"
        elastic = {"youngs_modulus": 1e6, "normal_stiffness": 1e10, "poissons_ratio": 0.45, "marker_depth": 5e-5}
        spread = {**GAUSSIAN, "dilation_falloff": 4e6, "shear_falloff": 4e6, "shear_strength": 1e5}
        of_spread = ["skin.dilation_falloff=1e5:1e8", "skin.shear_falloff=1e5:1e8", "skin.shear_strength=1:1e8"]
        layer, thickness = {**elastic, "kernel": "bonded_layer", "thickness": 5.5e-3}, "skin.thickness=2 mm:12 mm"
        cases = {
            "gaussian": (spread, of_spread),
            "half_space": ({**elastic, "kernel": "half_space"}, [poisson, depth]),
            "layer": (layer, [poisson, depth, thickness]),
        }
        for kernel, (skin, material) in cases.items():
            if only not in kernel:
                continue
            sheet = skin_document(folder, places, normals, {**skin, "enter": 0}, DOME_BALL, 4.5e-4, 9e-5)
            options = {"prefix": "dome-", "gain": True, "starts": starts}
            press = fit_case(f"{kernel}, press", sheet, folder / "press.npz", material, out, hold_out="blocks", **options)
            fitted = press.document(folder / "fitted.yaml")
            files = [folder / f"drag{i}.npz" for i in range(len(DRAG_STARTS))]
            drags = [fit_case(f"{kernel}, {file.stem}", fitted, file, [], out, **options) for file in files]
            fits[f"{kernel}, press"] = press
            fits[f"{kernel}, drag by the press's material"] = min(drags, key=lambda fit: fit.errors[0].error)
        print(Comparison(fits))


def eflesh_recording(data: Path, run: str, contact: float, every: int, cycles: slice = slice(None)) -> dict[str, Any]:
    """Return the recording of a run: its load [N] by the robot's height.

    Args:
        data: The data folder.
        run: `normal` or `shear`.
        contact: Approximate depth of the first contact below the robot's highest pose [m].
        every: Step between the used samples.
        cycles: The used cycles of the ten.
    """
    with lzma.open(data / "eflesh" / run / "states.csv.xz") as file:
        states = np.genfromtxt(file, delimiter=",")
    time_s, height, load = states[:, 0] - states[0, 0], 1e-3 * states[:, 3], states[:, 4]
    cycle = np.arange(len(time_s)) * 10 // len(time_s)
    valid = np.flatnonzero((load >= 0) & np.isin(cycle, np.arange(10)[cycles]))[::every]
    ball = 0.034 + height - (height.max() - contact)  # it touches the probe at 0.034 m
    return {
        **poses(*[(0.0, 0.0, z) for z in ball]), "time": time_s, "target:load": -9.81e-3 * load[valid, None, None],
        "clock:load": time_s[valid], "clock_width:load": 0.5, "unit:load": "N", "channels:load": ["force_z"],
        "width:body_pos": np.array([[0, 0, 0], [0, 0, 2e-3]]),
    }  # fmt: skip


def eflesh(data: Path, out: Path | None, only: str, starts: int) -> None:
    """Print the table of the eFlesh under a probe: the load by the robot's pose."""
    stiffness, exponent = "load.normal_stiffness=1e1:1e8", "load.depth_exponent=0.05:4"
    lattice = {"densification": 0.03, "depth_exponent": 0.3, "normal_stiffness": 30}
    loop, of_loop = {"force": 1.5, "width": 2e-3}, ["load.loop.force=0.1:10", "load.loop.width=0.1 mm:10 mm"]
    closing = "load.densification=21 mm:500 mm"
    normal, shear = eflesh_recording(data, "normal", 0.75e-3, 2), eflesh_recording(data, "shear", 4e-3, 12)
    parts = [eflesh_recording(data, "normal", 0.75e-3, 4, part) for part in (slice(0, 1), slice(1, 5), slice(5, 10))]
    cases = {
        "normal, power law": ({}, [normal], [stiffness, exponent], False),
        "normal, power law, damping": ({}, [normal], [stiffness, exponent, "load.normal_damping=0:1e6"], False),
        "normal, power law, gain of first press, presses 2 to 5, rest": ({}, parts, [exponent], True),
        "shear, power law": ({}, [shear], [stiffness, exponent], False),
        "shear, loop": ({"loop": loop}, [shear], [stiffness, exponent, *of_loop], False),
        "shear, loop, densification": ({"loop": loop, **lattice}, [shear], [stiffness, exponent, *of_loop, closing], False),
    }
    with tempfile.TemporaryDirectory() as name:
        fits: dict[str, Fit] = {}
        for label, (law, recordings, fit, gain) in cases.items():
            if only not in label:
                continue
            sheet = probe_document(Path(name), law)
            options = {"prefix": "eflesh-", "gain": gain, "hold_out": "time", "folds": 10, "starts": starts}
            fits[label] = fit_case(label, sheet, recordings, fit, out, **options)
        print(Comparison(fits))


def main(
    which: Annotated[Literal["gelsight", "eflesh", "dome"], tyro.conf.arg(help="The data.")],
    data: Path,
    out: Path | None = None,
    only: Annotated[str, tyro.conf.arg(help="Part of the names of the rows to fit; default: all.")] = "",
    starts: int = 1,
) -> None:
    """Fit sensors to recordings and print the errors."""
    {"gelsight": gelsight, "eflesh": eflesh, "dome": dome}[which](data, out, only, starts)


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.PositionalRequiredArgs,))
