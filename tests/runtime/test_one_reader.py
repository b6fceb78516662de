"""A module holds the state of one simulation: a second one is refused until the first is closed or released."""

import copy
import gc

import numpy as np
import pytest
import torch
from warp_cases import SCENE, module, warp

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.rollout import rollout

PRESSED = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"')
BIT = {"kind": "contact", "threshold": 1e-3, "release_threshold": 5e-4}
BOTH = pytest.mark.parametrize("simulator", [BatchSimulation, warp], ids=["batch", "warp"])
TAKEN = (
    r"^this module is read by a simulation of 2 environments, whose state it holds; `close` that one, or give this one "
    r"another module: tgdsl\.compile\(\.\.\.\) again, or copy\.deepcopy\(touch\)$"
)


def stateful_module(folder) -> tgdsl.TactileModule:
    return module(folder, PRESSED, links=("table",), **BIT)


@pytest.mark.slow
@BOTH
def test_a_second_simulation_is_refused_and_the_first_goes_on(tmp_path, simulator):
    touch = stateful_module(tmp_path)
    sim = simulator(touch, 2)
    assert touch(sim.state())["touch"].all()
    bits = touch.memory.get_buffer("touch:bit").clone()
    for other in (BatchSimulation, warp):
        for num_envs in (2, 3):
            with pytest.raises(SimulationError, match=TAKEN):
                other(touch, num_envs)
    assert bits.all() and torch.equal(touch.memory.get_buffer("touch:bit"), bits)
    sim.step()
    assert simulator(copy.deepcopy(touch), 2).num_envs == 2  # a copy has its own memory
    assert torch.equal(touch.memory.get_buffer("touch:bit"), bits)


@BOTH
def test_a_closed_simulation_releases_its_module_and_cannot_be_used(tmp_path, simulator):
    touch = stateful_module(tmp_path)
    first = simulator(touch, 2)
    first.close()
    second = simulator(touch, 2)
    first.close()  # closing again does nothing to the second one
    with pytest.raises(SimulationError, match=TAKEN):
        simulator(touch, 2)
    calls = [first.step, first.state, first.reset, first.set_state, first.forward, lambda: next(first.substates())]
    for call in [*calls, first.step_and_read] if simulator is warp else calls:
        with pytest.raises(SimulationError, match=r"^this simulation is closed; make another one$"):
            call()
    assert next(iter(rollout(touch, second, np.zeros((1, 2))))).readings["touch"].all()


@pytest.mark.slow
@BOTH
def test_an_unreferenced_simulation_releases_its_module(tmp_path, simulator):
    touch = stateful_module(tmp_path)
    gc.disable()  # a simulation may be in a reference cycle; the module must collect it on demand
    try:
        for _ in range(3):
            sim = simulator(touch, 2)
            sim.step()
            del sim
    finally:
        gc.enable()


@BOTH
def test_a_module_without_state_serves_any_number_of_simulations(tmp_path, simulator):
    touch = module(tmp_path)
    sims = [simulator(touch, num_envs) for num_envs in (1, 2, 3)]
    assert [len(touch(sim.state())["touch"]) for sim in sims] == [1, 2, 3]


@BOTH
def test_a_module_with_the_state_of_other_environments_is_refused(tmp_path, simulator):
    touch = stateful_module(tmp_path)
    touch(touch.example_state(2))
    message = r"^this module holds the state of 2 environments, and num_envs is 16; touch\.free\(\) frees it$"
    with pytest.raises(SimulationError, match=message):
        simulator(touch, 16)
    sim = simulator(touch, 2)
    sim.close()
    touch.free()
    assert len(touch(simulator(touch, 16).state())["touch"]) == 16


def test_a_simulation_that_failed_to_start_claims_no_module(tmp_path):
    touch = stateful_module(tmp_path)
    with pytest.raises(SimulationError, match=r"no keyframe"):
        BatchSimulation(touch, 2, keyframe="nowhere")
    with pytest.raises(SimulationError, match=r"no keyframe"):
        warp(touch, 2, keyframe="nowhere")
    assert BatchSimulation(touch, 2).num_envs == 2


def test_closed_connections_release_their_module(tmp_path):
    touch = stateful_module(tmp_path)
    for _ in range(2):
        with tgdsl.connect(touch, "simulation", control_step=0.002) as env:
            env.step()
