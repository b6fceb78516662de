"""Kinematic loops on MuJoCo Warp: constraints use velocities of the previous evaluation, which must belong to the same environment."""

import warnings

import pytest
import torch
from warp_cases import warp

import tgdsl
from tgdsl.runtime.batch.simulation import BatchSimulation

SCENE = """
<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body name="a"><joint type="hinge" axis="0 1 0" damping=".01"/><geom type="box" pos=".05 0 0" size=".05 .01 .01" mass=".1"/>
    <body name="b" pos=".1 0 0"><joint type="hinge" axis="0 1 0" damping=".01"/><joint name="side" axis="0 0 1" damping=".01"/>
      <geom contype="0" conaffinity="0" type="box" pos=".05 0 0" size=".05 .01 .01" mass=".1"/></body></body>
  <body name="c" pos=".2 0 .1"><joint axis="0 1 0" damping=".01"/><joint axis="0 0 1" damping=".01"/>
    <geom contype="0" conaffinity="0" type="box" pos="0 0 -.05" size=".01 .01 .05" mass=".1"/></body>
  <body name="ball" pos=".05 0 .0199"><freejoint/><geom type="sphere" size=".01" mass=".05"/></body>
</worldbody>
<equality><connect body1="b" body2="c" anchor=".1 0 0"/></equality>
<actuator><motor joint="side"/></actuator></mujoco>
"""
"""Two connected chains, and a ball that touches one of them."""
BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])


@pytest.fixture
def touch(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log into the current folder
    (tmp_path / "scene.xml").write_text(SCENE)
    probe = {"method": "points", "points": [{"pos": [0.05, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    return tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"a": probe}}}},
            "objects": {"ball": {"body": "ball"}},
            "sensors": {"solver": {"kind": "link_contact", "links": "a", "feels": ["ball"]}},
        }
    )


@BOTH
def test_reset_leaves_the_other_environments_alone(touch, simulator):
    """Bit-identical, also over later steps."""
    sim, twin = simulator(touch, 2, substeps=2), simulator(touch, 2, substeps=2)
    for i in range(6):
        control = torch.tensor([[0.05], [0.02 + 0.01 * i]], dtype=torch.float64)
        for each in (sim, twin):
            each.step(control)
            each.state()
        sim.reset([0])
        sim.state()
        assert torch.equal(sim.qpos[1], twin.qpos[1]) and torch.equal(sim.qvel[1], twin.qvel[1]), i


@BOTH
def test_an_episode_does_not_depend_on_the_previous_one(touch, simulator):
    sim, fresh = simulator(touch, 2, substeps=2), simulator(touch, 2, substeps=2)
    speed = torch.linspace(-0.5, 0.5, sim.model.nv, dtype=torch.float64)
    for _ in range(4):
        sim.step(torch.full((1,), 0.1, dtype=torch.float64))
    for each in (sim, fresh):
        each.reset(qvel=speed, ctrl=torch.zeros(1, dtype=torch.float64), qacc_warmstart=torch.zeros(sim.model.nv))
    first, expected = sim.state(), fresh.state()
    assert torch.equal(first.contact_netforce, expected.contact_netforce)
    for _ in range(3):
        sim.step()
        fresh.step()
    assert torch.equal(sim.qpos, fresh.qpos)


@BOTH
def test_a_diverged_environment_recovers(touch, simulator):
    """Not-a-number of one episode reaches no array that the next one reads."""
    sim = simulator(touch, 2, substeps=2, on_fault="reset")
    sim.qvel[1, 0] = torch.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for i in range(4):
            sim.step()
            if i == 0:
                assert torch.isfinite(touch(sim.state())["solver"]).all()
    assert sim.fault_counts.tolist() == [0, 1]
    assert torch.isfinite(sim.qpos).all()
