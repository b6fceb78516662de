"""Sensors fitted to recordings of real ones, and to a finite-element model: the tables and plots of docs/reality.md.

    python benchmarks/reality.py gelsight DATA_FOLDER [--out docs/images]
    python benchmarks/reality.py eflesh DATA_FOLDER

The data are not part of tgdsl. `gelsight/subpixel.npz` (FOTS, places of markers found again from its images), `eflesh/normal`
(eFlesh) and `gel_dome_fem.npz` (Taxim) are expected in DATA_FOLDER. Each row is one call of `tgdsl.calibrate` with the document
and the recordings that this script writes into a temporary folder.
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
from tgdsl.calibration.fit import Fit
from tgdsl.calibration.problem import ReadingMap
from tgdsl.console.tables import text_table

PX = 18.8e3
"""Pixels per metre of the GelSight's images, from the marker pitch."""
CENTRE = np.array([137.0, 126.0])
"""Middle of its contact [px]."""
BALL = 3e-3
"""Radius of the ball that presses it [m]."""
LAYER = {"kernel": "bonded_layer", "youngs_modulus": 1e5, "normal_stiffness": 1e7, "thickness": 7e-3, "poissons_ratio": 0.38}
LAYER |= {"marker_depth": 3e-4}
HALF_SPACE = {"kernel": "half_space", "youngs_modulus": 1e5, "normal_stiffness": 1e7, "poissons_ratio": 0.45}
GAUSSIAN = {"kernel": "gaussian", "dilation_falloff": 8e4, "shear_falloff": 8e4}
PRESSED = {**LAYER, "thickness": 6.85e-3, "poissons_ratio": 0.374, "marker_depth": 3.4e-4}
"""The layer as fitted to the press alone."""
OF_LAYER = ["skin.thickness=2 mm:20 mm", "skin.poissons_ratio", "skin.marker_depth=0 mm:2 mm"]
OF_HALF_SPACE = ["skin.poissons_ratio", "skin.marker_depth=0 mm:2 mm"]
FRICTION = "skin.friction=0.02:3"


def document(folder: Path, places: np.ndarray, skin: dict[str, Any], ball: float, half: float, pitch: float) -> Path:
    """Write a pad under a ball, taxels on a square in its middle, and markers at some places [m]; return the document."""
    (folder / "scene.xml").write_text(
        f'<mujoco><worldbody><body name="pad"><geom type="box" size=".03 .03 .01" pos="0 0 -.01"/></body>'
        f'<body name="ball" pos="0 0 .1"><freejoint/><geom type="sphere" size="{ball}"/></body></worldbody></mujoco>'
    )
    num, normal = round(2 * half / pitch), [0, 0, 1]
    square = {"box": {"min": [-half, -half, -1e-3], "max": [half, half, 1e-3]}}
    grid = {"method": "grid", "rows": num, "columns": num, "direction": [0, 0, -1], "radius": 1e-3, "region": square}
    dots = [{"pos": [float(x), float(y), 0.0], "normal": normal, "radius": 1e-3} for x, y in places]
    layout = {"resolutions": {"taxels": {"pad": grid}, "dots": {"pad": {"method": "points", "points": dots}}}}
    sensor = {"kind": "elastomer", "links": "pad", "feels": ["ball"], "gate": "geometric", "markers": "dots", **skin}
    content = {
        "tgdsl": 1,
        "robot": {"model": "scene.xml", "layout": layout},
        "resolution": "taxels",
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"skin": sensor},
    }
    (folder / "skin.yaml").write_text(json.dumps(content))  # which is YAML too
    return folder / "skin.yaml"


def poses(*places: tuple[float, float, float]) -> dict[str, Any]:
    """Return poses of pad and ball at each step, the ball's as given [m]."""
    pos, quat = np.zeros((len(places), 2, 3)), np.zeros((len(places), 2, 4))
    pos[:, 1], quat[..., 0] = places, 1.0
    return {"time": np.arange(len(places)), "body_pos": pos, "body_quat": quat, "bodies": ["pad", "ball"]}


def width(value: np.ndarray) -> dict[str, Any]:
    """Return standard deviations of the poses' offsets [m]."""
    return {"width:body_pos": value}


def target(time_s: list[float], value: np.ndarray, kept: np.ndarray, floor: float) -> dict[str, Any]:
    """Return a target of in-plane displacements [m] of the markers that were kept."""
    return {
        "target:skin": value[None], "clock:skin": time_s, "unit:skin": "m", "weight:skin": kept[None, :, None].astype(float),
        "channels:skin": ["displacement_x", "displacement_y"], "floor:skin": floor,
    }  # fmt: skip


def gelsight_recordings(data: Path, folder: Path) -> np.ndarray:
    """Write press.npz, drag.npz and raw.npz; return the unloaded places of the markers [m]."""
    found = np.load(data / "gelsight" / "subpixel.npz")
    press, drag = found["press"] / PX, found["drag"] / PX
    deep, wide = BALL - 1e-3, np.array([4e-4, 4e-4, 4e-4])
    still = np.zeros((1, 2, 3))
    still[0, 1] = wide
    size = np.sqrt((press[found["press_kept"]] ** 2).mean())
    np.savez(
        folder / "press.npz", **poses((0, 0, deep)), **target([0], press, found["press_kept"], 0.105 * size), **width(still)
    )
    moved = np.zeros((2, 2, 3))
    moved[0, 1], moved[1, 1] = wide, [1e-3, 1e-3, 4e-4]
    both, motion = poses((0, 0, deep), (0, 3e-4, deep)), {"zero:skin": 0.0, "width:body_pos": moved}
    size = np.sqrt((drag[found["drag_kept"]] ** 2).mean())
    np.savez(folder / "drag.npz", **both, **target([1], drag, found["drag_kept"], 0.01 * size), **motion)
    raw = [np.loadtxt(data / "gelsight" / f"{i}.csv", delimiter=",", skiprows=1)[:, 2:4] / PX for i in (0, 1)]
    raw_drag, every = raw[1] - raw[0], np.ones(len(drag))
    size = np.sqrt((raw_drag**2).mean())
    np.savez(folder / "raw.npz", **both, **target([1], raw_drag, every, 0.113 * size), **motion)
    return (found["unloaded"] - CENTRE) / PX


def show(rows: list[tuple[str, Fit, float]]) -> None:
    """Print a line for each target of each fit."""
    lines = []
    for name, fit, seconds in rows:
        for error in fit.errors:
            held = "" if error.held_out is None else f"{error.held_out:.3f}"
            floor = "" if error.floor is None else f"{error.floor:.3f}"
            values = ", ".join(f"{f.path.split('.')[1]} {f.value:.4g}" for f in fit.parameters.values())
            lines.append(
                (name, error.recording, f"{error.error:.3f}", held, floor, f"{error.alone:.3f}", values, f"{seconds:.0f}")
            )
    print(text_table(("model", "recording", "error", "held out", "floor", "without", "parameters", "s"), lines))


def gelsight(data: Path, out: Path | None, only: str) -> None:
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
            ("press's layer, drag, offset", {**PRESSED, "friction": 0.3}, [drag], [FRICTION], "offset"),
            ("half_space, raw drag, offset", {**HALF_SPACE, "friction": 0.3}, [raw], [*OF_HALF_SPACE, FRICTION], "offset"),
            ("layer, both, offset", {**LAYER, "friction": 0.3}, [press, drag], [*OF_LAYER, FRICTION], "offset"),
        ]  # fmt: skip
        rows = []
        for label, skin, recordings, fit, reading in cases:
            if only not in label:
                continue
            sheet = document(folder, places, skin, BALL, 4e-3, 0.4e-3)
            start = time.perf_counter()
            result = tgdsl.calibrate(
                sheet,
                recordings,
                fit,
                reading=reading,
                gain=True,
                hold_out="taxel",
                intervals="none",
                starts=4,
            )
            rows.append((label, result, time.perf_counter() - start))
            show(rows[-1:])
            print("\n".join(result.warnings), flush=True)
            print({key: float(f"{value:.3g}") for key, value in result.nuisances.items()}, flush=True)
            if out is not None:
                result.plot(out / f"reality-{label.replace(', ', '-').replace(' ', '-')}.png")
        show(rows)


def eflesh(data: Path, out: Path | None, only: str) -> None:
    """Print the table of the eFlesh under a probe: its load by the robot's pose."""
    with lzma.open(data / "eflesh" / "normal" / "states.csv.xz") as file:
        states = np.genfromtxt(file, delimiter=",")
    time_s, height, load = states[:, 0] - states[0, 0], 1e-3 * states[:, 3], states[:, 4]
    is_valid = load >= 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sheet = probe_document(folder)
        # The ball touches the probe at 0.034 m; the robot at some height below its highest, which is fitted.
        ball = 0.034 + height - (height.max() - CONTACT)
        keep = np.arange(0, len(time_s), 2)
        np.savez(
            folder / "normal.npz",
            **{**poses(*[(0.0, 0.0, z) for z in ball]), "time": time_s},
            **{"target:load": -9.81e-3 * load[keep, None, None], "weight:load": is_valid[keep, None, None].astype(float)},
            **{"clock:load": time_s[keep], "clock_width:load": 0.5, "unit:load": "N", "channels:load": ["force_z"]},
            **width(np.array([[0, 0, 0], [0, 0, 2e-3]])),
        )
        rows = []
        law = ["load.normal_stiffness=1e2:1e8", "load.depth_exponent=0.5:4"]
        cases = {"power law": law, "power law, damping": [*law, "load.normal_damping=0:1e6"]}
        for label, fit in cases.items():
            if only not in label:
                continue
            start = time.perf_counter()
            result = tgdsl.calibrate(sheet, folder / "normal.npz", fit, hold_out="time", intervals="none", starts=4)
            rows.append((label, result, time.perf_counter() - start))
            print(result, flush=True)
            if out is not None:
                result.plot(out / f"reality-eflesh-{label.replace(', ', '-').replace(' ', '-')}.png")
        show(rows)


CONTACT = 0.75e-3
"""Height of the eFlesh's first contact below the robot's highest pose, roughly [m]."""


def probe_document(folder: Path) -> Path:
    """Write one probe under a ball, whose force is the load; return the document."""
    (folder / "scene.xml").write_text(
        '<mujoco><worldbody><body name="pad"><geom type="box" size=".02 .02 .01" pos="0 0 -.01"/></body>'
        '<body name="ball" pos="0 0 .05"><freejoint/><geom type="sphere" size=".02"/></body></worldbody></mujoco>'
    )
    probe = {"pos": [0, 0, 0], "normal": [0, 0, 1], "radius": 0.014}
    layout = {"resolutions": {"r": {"pad": {"method": "points", "points": [probe]}}}}
    sensor = {"kind": "kinematic_taxel", "links": "pad", "feels": ["ball"], "gate": "geometric", "outputs": ["force"]}
    sensor |= {"normal_stiffness": 1e4, "depth_exponent": 1.5, "normal_damping": 0, "shear_damping": 0}
    content = {
        "tgdsl": 1,
        "robot": {"model": "scene.xml", "layout": layout},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"load": sensor},
    }
    (folder / "load.yaml").write_text(json.dumps(content))
    return folder / "load.yaml"


def main(
    which: Annotated[Literal["gelsight", "eflesh"], tyro.conf.arg(help="The data.")],
    data: Path,
    out: Path | None = None,
    only: str = "",
) -> None:
    """Fit sensors to recordings and print the errors."""
    {"gelsight": gelsight, "eflesh": eflesh}[which](data, out, only)


if __name__ == "__main__":
    tyro.cli(main, config=(tyro.conf.PositionalRequiredArgs,))
