"""Every kind of sensor read from MuJoCo Warp and from MuJoCo's batch, on the same float32 states.

`TOLERANCE` is for what follows from poses and velocities; forces of contacts in motion agree as far as two solvers do.
"""

import numpy as np
import pytest
import torch
from warp_cases import MOVING_FORCE, SCENE, TOLERANCE, WEIGHT, hand_over, warp

import tgdsl
from tgdsl.module.module import TactileModule
from tgdsl.runtime.batch.simulation import BatchSimulation

KINDS = {
    "depth": {"kind": "contact_depth"},
    "contact": {"kind": "contact", "threshold": 3e-3, "release_threshold": 2e-3},
    "touch": {"kind": "kinematic_taxel"},
    "near": {"kind": "proximity", "tolerance": 0.05},
    "force": {"kind": "force_taxel"},
    "solver": {"kind": "link_contact", "outputs": ["contact", "force", "normal_force"]},
    "skin": {"kind": "elastomer", "anchors": "points", "points": 200},
    "distance": {"kind": "surface_distance"},
}
FROM_FORCES = ("force", "force/missed", "force/residual", "solver")
DRAGGED = 5e-5
"""For the elastomer between simulators: the skin moves by about 0.1 mm, and float32 positions 3 cm from the origin are
accurate to 2e-9 m, 2e-5 of that."""
UNSHARED = ("force/missed", "force/residual")
"""Remainders of contact forces: their error is that of the forces."""


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("kinds")
    (folder / "scene.xml").write_text(SCENE)
    grid = {"method": "grid", "rows": 6, "columns": 6, "direction": [0, 0, -1], "radius": 0.0057}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"only": {"table": grid}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {name: {"links": "table", "feels": ["cube"], **sensor} for name, sensor in KINDS.items()},
    }
    return tgdsl.compile(document).plan


def errors(readings, expected) -> dict[str, float]:
    """Return each reading's largest error over the largest magnitude of its channel, remainders' over the forces'.

    The scale of a channel is at least a thousandth of the reading's largest.
    """
    result = {}
    for name, value in expected.items():
        largest = expected["force" if name in UNSHARED else name].abs().max() + 1e-12
        scale = largest if name in UNSHARED else value.abs().amax((0, 1)).clamp(min=1e-3 * float(largest))
        result[name] = float(((readings[name].double() - value.double()).abs() / scale).max())
    return result


@pytest.mark.slow
def test_every_kind_reads_the_same_from_both_simulators(plan):
    """The cube rocks on the table: both simulators, then both modules, get Warp's float32 state."""
    touch, exact = TactileModule(plan), TactileModule(plan, dtype=torch.float64)
    of_batch = TactileModule(plan, dtype=torch.float64)
    sim, cpu = warp(touch, 4), BatchSimulation(of_batch, 4)
    sim.warp_model.opt.tolerance.fill_(sim.model.opt.tolerance)
    sim.arrays["qvel"][:, :6] = torch.from_numpy(
        np.random.default_rng(0).normal(size=(4, 6)) * [0.05, 0.05, 0.02, 0.3, 0.3, 0.5]
    )
    steps = []
    for _ in range(12):
        hand_over(sim, cpu)
        sim.step()
        cpu.step()
        state = sim.state()
        steps.append((touch(state), exact(state), of_batch(cpu.state())))
    readings, expected, batch = (
        {name: torch.cat([step[name] for step in series]) for name in series[0]} for series in zip(*steps, strict=True)
    )
    assert all(expected[name].any() for name in KINDS)
    for name, error in errors(readings, expected).items():
        assert error <= TOLERANCE, f"modules: {name} differs by {error:.1e}"
    for name, error in errors(readings, batch).items():
        tolerance = MOVING_FORCE if name in FROM_FORCES else DRAGGED if name == "skin" else TOLERANCE
        assert error <= tolerance, f"simulators: {name} differs by {error:.1e}"


@pytest.mark.slow
def test_a_cube_at_rest_reads_the_same_after_two_hundred_steps(plan):
    """`force_taxel` carries its weight, readings match the CPU's to 0.1 %, and so does the depth in the table."""
    readings, heights = [], []
    for simulator in (warp, BatchSimulation):
        touch = TactileModule(plan)
        sim = simulator(touch, 2)
        means = []
        heights.append([])
        for i in range(200):
            sim.step()
            if i >= 150:
                state = sim.state()
                step_readings = touch(state)
                heights[-1].append(state.body_pos[:, touch.inputs.bodies.index("cube"), 2].double())
                means.append({name: value.double().abs().mean() for name, value in step_readings.items()})
        readings.append({name: torch.stack([step[name] for step in means]).mean() for name in means[0]})
        total = step_readings["force"][..., :3].double().sum(dim=1)
        expected = torch.tensor([0, 0, -WEIGHT], dtype=torch.float64).expand(2, 3)
        torch.testing.assert_close(total, expected, atol=1e-3, rtol=0)
    for name in KINDS:
        torch.testing.assert_close(readings[0][name], readings[1][name], rtol=1e-3, atol=1e-9, msg=name)
    assert float(torch.stack(heights[0]).mean()) == pytest.approx(float(torch.stack(heights[1]).mean()), abs=1e-7)
