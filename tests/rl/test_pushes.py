"""Pushes: a free ball gains F Δt / m, intervals and forces stay in range, and only chosen environments restart."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.rl.draws import Draws
from tgdsl.rl.events import Events, event_terms
from tgdsl.rl.spec import PushSpec, RandomSpec
from tgdsl.runtime.batch.simulation import BatchSimulation

BALL = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0" integrator="implicitfast"/>
  <worldbody>
    <body name="pad" pos="5 0 0"><geom size=".01"/></body>
    <body name="ball"><freejoint/><geom size=".02" mass=".4"/></body>
  </worldbody>
</mujoco>
"""
STEP = 0.025
PAPER = PushSpec(x=(-1, 1), y=(-1, 1), z=(-5, 0))


class Pushes(Events):
    """The events of `randomise: {push: …}` on a simulation's ball, or on bare arrays."""

    def __init__(self, spec, arrays, draws):
        applied = arrays["xfrc_applied"]
        setup = SimpleNamespace(
            model=mujoco.MjModel.from_xml_string(BALL), object="ball", num_envs=len(applied), device=applied.device,
            dtype=applied.dtype, control_step=STEP, draws=draws,
        )  # fmt: skip
        super().__init__(event_terms(RandomSpec(push=spec), {}), SimpleNamespace(arrays=arrays), setup, None)
        self.force = applied[:, 2, :3]

    def begin(self, chosen, episode):
        self.reset(torch.tensor(chosen), torch.tensor(episode), is_placed=True)


def started_pushes(spec=PAPER, num_envs=1, seed=0, first_env=0, episode=1):
    applied = torch.zeros(num_envs, 3, 6, dtype=torch.float64)
    pushes = Pushes(spec, {"xfrc_applied": applied}, Draws(seed, num_envs, first_env=first_env))
    pushes.begin([True] * num_envs, [episode] * num_envs)
    return pushes, applied


@pytest.mark.parametrize(("simulator", "duration", "steps"), [(BatchSimulation, 0.025, 1), (warp, 0.06, 3)])
def test_a_free_ball_gains_force_times_time_over_mass(tmp_path, simulator, duration, steps):
    (tmp_path / "ball.xml").write_text(BALL)
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1]}], "radius": 0.005}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "ball.xml"), "layout": {"resolutions": {"only": {"pad": points}}}},
        "objects": {"ball": {"body": "ball"}},
        "sensors": {"touch": {"kind": "contact_depth", "links": "pad", "feels": ["ball"], "gate": "geometric"}},
    }
    sim = simulator(tgdsl.compile(document), 2, substeps=5)
    spec = PushSpec(x=(0.2, 0.2), y=(-0.3, 0.3), interval=(0.1, 0.1), duration=duration)
    pushes = Pushes(spec, sim._arrays, Draws(0, 2))
    pushes.begin([True, True], [1, 1])
    gained, forces = np.zeros((2, 3)), set()
    for _ in range(2 * (4 + steps)):
        pushes.advance()
        gained += pushes.force.numpy() * STEP / 0.4
        forces |= {round(float(f), 6) for f in pushes.force[:, 1]}
        sim.step()
    assert len(forces - {0.0}) == 4  # two pushes of two environments
    np.testing.assert_allclose(gained[:, 0], 2 * steps * 0.2 * STEP / 0.4, rtol=1e-6)
    np.testing.assert_allclose(sim.qvel[:, :3], gained, rtol=1e-5, atol=1e-7)


def test_intervals_and_forces_are_uniform_in_their_ranges():
    num, pushes, applied = 1000, *started_pushes(num_envs=1000)
    waits, forces, steps_since = [], [], np.zeros(num)
    for _ in range(500):
        pushes.advance()
        is_pushed = pushes.force.any(dim=1).numpy()
        assert not applied[:, :2].any() and not applied[:, 2, 3:].any()
        steps_since += 1
        waits += steps_since[is_pushed].tolist()
        forces += pushes.force[torch.from_numpy(is_pushed)].tolist()
        steps_since[is_pushed] = -1  # the push itself takes a step
    first = np.array(waits[:num])
    assert first.min() == 80 and first.max() == 160
    assert abs(first.mean() - 120) < 5 * np.sqrt((81**2 - 1) / 12 / num)
    all_forces = np.array(forces)
    for axis, (low, high) in enumerate((PAPER.x, PAPER.y, PAPER.z)):
        assert low <= all_forces[:, axis].min() and all_forces[:, axis].max() <= high
        assert abs(all_forces[:, axis].mean() - (low + high) / 2) < 5 * (high - low) / np.sqrt(12 * len(all_forces))
    assert np.abs(np.corrcoef(all_forces.T) - np.eye(3)).max() < 5 / np.sqrt(len(all_forces))


def test_pushes_of_64_environments_equal_those_of_twice_32():
    whole, halves = started_pushes(num_envs=64)[0], [started_pushes(num_envs=32, first_env=first)[0] for first in (0, 32)]
    for _ in range(400):
        for pushes in (whole, *halves):
            pushes.advance()
        assert torch.equal(whole.force, torch.cat([half.force for half in halves]))


def test_only_the_chosen_environments_restart():
    pushes, _ = started_pushes(PushSpec(x=(1, 1), interval=(0.05, 0.05), duration=10.0), num_envs=3)
    for _ in range(2):
        pushes.advance()
    assert pushes.force[:, 0].tolist() == [1, 1, 1]
    pushes.begin([False, True, False], [1, 2, 1])
    assert pushes.force[:, 0].tolist() == [1, 0, 1]
    pushes.advance()
    pushes.advance()
    assert pushes.force[:, 0].tolist() == [1, 1, 1]


def test_an_interval_below_the_control_step_is_refused():
    with pytest.raises(SimulationError, match=r'the event "push" comes every 0.01 s, more often than control steps of 0.025 s'):
        started_pushes(PushSpec(x=(1.0, 1.0), interval=(0.01, 1.0)))
