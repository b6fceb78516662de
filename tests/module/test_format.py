"""The promise of a release: files that 0.2.0 wrote load in later versions and read the same.

`python tests/module/test_format.py` writes such a file with the installed version. It is part of a release; files of earlier
releases stay unchanged.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.module.state import SceneState

KEPT = Path(__file__).parent / "kept"
RELEASES = sorted(file.stem for file in KEPT.glob("*.safetensors"))
RTOL = 1e-4
"""Relative to each channel's largest magnitude; readings are float32, and torch's sums differ between machines."""
SCENE = """
<mujoco>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos=".002 .001 .0295"><freejoint/><geom type="box" size=".02 .02 .02" mass=".2"/></body>
  </worldbody>
</mujoco>
"""
SENSOR = {"links": "pad", "feels": ["cube"]}
DOCUMENT = {
    "tgdsl": 1,
    "robot": {
        "model": "scene.xml",
        "layout": {
            "resolutions": {
                "low": {"pad": {"method": "grid", "rows": 4, "columns": 5, "direction": [0, 0, -1], "radius": "4 mm"}}
            }
        },
    },
    "objects": {"cube": {"body": "cube", "material": "aluminium", "temperature": "45 degC"}},
    "sensors": {
        "depth": {"kind": "contact_depth", **SENSOR},
        "bit": {"kind": "contact", **SENSOR},
        "touch": {"kind": "kinematic_taxel", **SENSOR, "noise": {"read_delay": "4 ms"}},
        "force": {"kind": "force_taxel", **SENSOR},
        "solver": {"kind": "link_contact", **SENSOR},
        "near": {"kind": "proximity", **SENSOR, "backend": "points", "points": 8},
        "distance": {"kind": "surface_distance", **SENSOR, "max_range": "20 mm"},
        "skin": {"kind": "elastomer", **SENSOR, "like": "soft_gel", "standoff": "1 mm"},
        "heat": {"kind": "temperature_grid", **SENSOR, "spacing": "15 mm", "material": "abs", "outputs": "surface"},
    },
    "observations": {"policy": [{"type": "force_torque", "of": "touch"}, {"type": "agg_force", "of": "depth"}]},
}


@pytest.mark.parametrize("release", RELEASES)
def test_a_file_of_a_release_loads_and_reads_the_same(release):
    touch = tgdsl.load(KEPT / f"{release}.safetensors")
    arrays = np.load(KEPT / f"{release}.npz")
    states = {name.partition(":")[2]: arrays[name] for name in arrays if name.startswith("state:")}
    for step in range(3):
        state = SceneState(dt=0.002, **{name: torch.from_numpy(values[step]) for name, values in states.items()})
        readings = touch(state)
        results = readings | {f"observed {name}": values for name, values in touch.observe(readings).items()}
        assert set(results) == {name.partition(":")[2] for name in arrays if name.startswith("result:")}
        for name, values in results.items():
            expected = arrays[f"result:{name}"][step]
            np.testing.assert_allclose(
                values.float(), expected, rtol=0.0, atol=RTOL * max(np.abs(expected).max(), 0.01), err_msg=name
            )


def write(folder: Path, release: str) -> None:
    """Write an artefact with all kinds of touch sensors, three states of its scene, and their readings."""
    (folder / "scene.xml").write_text(SCENE)
    touch = tgdsl.compile(DOCUMENT | {"robot": DOCUMENT["robot"] | {"model": str(folder / "scene.xml")}})
    tgdsl.save(touch, KEPT / f"{release}.safetensors")
    sim, arrays = tgdsl.simulate(touch, num_envs=2), {}
    for _ in range(3):
        sim.step()
        state = sim.state()
        readings = touch(state)
        results = readings | {f"observed {name}": values for name, values in touch.observe(readings).items()}
        for name in touch.inputs.fields:
            if isinstance(value := getattr(state, name), torch.Tensor):
                arrays.setdefault(f"state:{name}", []).append(value.numpy().copy())
        for name, values in results.items():
            arrays.setdefault(f"result:{name}", []).append(values.float().numpy().copy())
    np.savez_compressed(KEPT / f"{release}.npz", **{name: np.stack(values) for name, values in arrays.items()})


if __name__ == "__main__":
    import tempfile

    with tempfile.TemporaryDirectory() as place:
        write(Path(place), tgdsl.__version__)
