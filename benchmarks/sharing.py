"""Measure a query that two sensors share: the cost of two kinds on the same probes in one module, and in separate modules.

    python benchmarks/sharing.py [--device cuda] [--num-envs 512] [--repeats 20] [--compiled]

The XHand1 at medium resolution (199 taxels) has a mesh ball on its palm, as a baked grid. `kinematic_taxel` is gated by
contact, `contact_depth` by distance. Times are medians of alternating calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import trimesh
import tyro
from module import median_ms

import tgdsl
from tgdsl.module.module import TactileModule

ROOT = Path(__file__).parent.parent
SENSORS = {
    "force": {"kind": "kinematic_taxel", "links": "hand", "feels": ["cube"], "outputs": ["force"]},
    "depth": {"kind": "contact_depth", "links": "hand", "feels": ["cube"], "gate": "geometric"},
}


@dataclass(frozen=True)
class Options:
    """Command-line options."""

    device: str = "cpu"
    num_envs: int = 512
    repeats: int = 20
    """Timed calls of each module."""
    compiled: bool = False
    """Whether to compile the modules."""


def module(folder: Path, sensors: tuple[str, ...], device: str) -> TactileModule:
    """Return a module with the named sensors."""
    mesh = folder / "ball.stl"
    trimesh.creation.icosphere(subdivisions=4, radius=0.02).export(mesh)
    document = {
        "tgdsl": 1,
        "robot": {"model": "xhand1"},
        "scene": {"model": str(ROOT / "examples" / "palm_cube.xml")},
        "objects": {"cube": {"body": "cube", "variants": [{"mesh": str(mesh)}]}},
        "resolution": "med",
        "sensors": {name: SENSORS[name] for name in sensors},
    }
    return tgdsl.compile(document, device=device)


def main(options: Options) -> None:
    """Time all three modules."""
    where = torch.cuda.get_device_name() if options.device == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    print(f"torch {torch.__version__}, {where}, {options.num_envs} environments, medians of {options.repeats}")
    with TemporaryDirectory() as folder:
        names = {"force": ("force",), "depth": ("depth",), "both": ("force", "depth")}
        modules = {name: module(Path(folder), sensors, options.device) for name, sensors in names.items()}
    assert len(modules["both"].plan.quantities["contact_depth"].queries) == 1
    operations = {name: touch.operations_per_env() for name, touch in modules.items()}
    state = modules["both"].example_state(options.num_envs, dtype=torch.float32, spread=0.01)
    if options.compiled:
        for touch in modules.values():
            touch.compile()
    calls = {name: lambda touch=touch: touch(state) for name, touch in modules.items()}
    times = median_ms(calls, options.repeats, options.device)
    for name in names:
        print(f"  {name:<8}{operations[name]:>10} operations per environment{times[name]:>10.3f} ms")
    print(f"  both / dearer of the two {times['both'] / max(times['force'], times['depth']):.2f}")
    print(f"  both / sum of the two    {times['both'] / (times['force'] + times['depth']):.2f}")


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
