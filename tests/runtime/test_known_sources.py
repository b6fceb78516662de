"""Sources of installed packages, including simulators; MuJoCo Warp as a source; unknown options."""

import re
import warnings

import numpy as np
import pytest
import torch
from installed_packages import installing
from warp_cases import SCENE, module

import tgdsl
from tgdsl.errors import ObservationError, SimulationError, TgdslError
from tgdsl.runtime.connect import SOURCES, known_sources
from tgdsl.runtime.connection import Source
from tgdsl.runtime.simulators.simulation import Simulation

MODULE = '''
import torch

from tgdsl.runtime.batch.simulation import BatchSimulation
from tgdsl.runtime.connection import Connection, SimulationConnection, SimulatorKind, SourceKind


class Fingertip:
    """A sensor that counts its steps."""

    num_envs = 1

    def __init__(self, port, control_step, gain):
        self.port, self.control_step, self.gain = port, control_step, gain
        self.steps, self.is_open = 0, True

    def step(self, control=None):
        self.steps += 1

    def reset(self, env_ids=None):
        self.steps = 0

    def close(self):
        self.is_open = False


class FingertipConnection(Connection):
    def read(self):
        return {"policy": torch.full((1, 1), self.source.gain * self.source.steps)}


def open_fingertip(touch, source, *, control_step, gain=2.0):
    return FingertipConnection(Fingertip(source.partition(":")[2], control_step, gain))


def simulate(touch, num_envs, *, substeps, layers=3):
    return BatchSimulation(touch, num_envs, substeps=substeps)


def open_simulator(touch, source, *, num_envs, layers=3):
    return SimulationConnection(touch, BatchSimulation(touch, num_envs))


FINGERTIP = SourceKind("fingertip", '"fingertip:PORT"', open_fingertip)
RAW = SourceKind("raw", 'a folder, "…/raw"', open_fingertip, recognise=lambda source: source.endswith("/raw"))
OTHER = SourceKind("fingertip", '"fingertip"', open_fingertip)
SIMULATION = SourceKind("simulation", '"simulation"', open_fingertip)
SIMULATOR = SimulatorKind("mine", '"mine"', open_simulator, devices=("xpu",), simulate=simulate)
PLAIN = SimulatorKind("plain", '"plain"', devices=("xpu",), simulate=simulate)
NO_KIND = {"name": "fingertip"}
'''
OWN = [kind.name for kind in SOURCES]


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package with sources, as pip would, for one test."""
    with installing(tmp_path, monkeypatch, "tgdsl.sources", MODULE) as install:
        yield install


def observed(folder):
    """Return a module that observes its only sensor, the depth of taxels in contact at the start."""
    pressed = SCENE.replace('pos="0 0 .0299"', 'pos="0 0 .028"').replace('qpos="0 0 .0299', 'qpos="0 0 .028')
    return module(folder, pressed, kind="contact_depth", observations={"policy": [{"type": "depth", "of": "touch"}]})


# installed packages


def test_an_installed_source_is_connected_to_by_its_name(install, tmp_path):
    install("handy", "1.2", fingertip="handy:FINGERTIP", raw="handy:RAW")
    touch = module(tmp_path)
    assert [kind.name for kind in known_sources()] == [*OWN, "fingertip", "raw"]
    with tgdsl.connect(touch, "fingertip:can0", control_step=0.01, gain=3.0) as env:
        source = env.source
        assert isinstance(source, Source) and not isinstance(source, Simulation)
        assert (env.num_envs, env.control_step, env.is_over, source.port) == (1, 0.01, False, "can0")
        env.step()
        env.step(np.zeros(2))
        assert env.observe()["policy"].tolist() == [[6.0]]
        env.reset()
        env.resume()
        assert env.observe()["policy"].tolist() == [[0.0]]
        assert source.is_open
    assert not source.is_open
    with tgdsl.connect(touch, "measured/raw") as env:
        assert env.source.gain == 2.0


def test_inapplicable_options_are_dropped_and_unknown_ones_refused(install, tmp_path):
    install("handy", "1.2", fingertip="handy:FINGERTIP")
    touch = module(tmp_path)
    with tgdsl.connect(touch, "fingertip", keyframe="home", lockstep=True) as env:
        assert env.source.control_step == 0.02
    for wrong, hint in (("gian", 'did you mean "gain"?'), ("nconmax", "known options: control_step, gain")):
        with pytest.raises(TgdslError, match=re.escape(f'"fingertip" has no option "{wrong}"; {hint}')):
            tgdsl.connect(touch, "fingertip", **{wrong: 1})
    with pytest.raises(TgdslError, match='num_envs is 2, but "fingertip:x" is one environment'):
        tgdsl.connect(touch, "fingertip:x", num_envs=2)


@pytest.mark.parametrize("source", ["simulation", "emulator", "xhand1:/dev/no-such-port", "press.npz", "warp:cpu"])
def test_an_unknown_option_of_a_builtin_source_lists_the_known_ones(tmp_path, source):
    with pytest.raises(TgdslError, match=f'^"{source}" has no option "zzz"; known options: .*control_step'):
        tgdsl.connect(module(tmp_path), source, zzz=1)


def test_an_unknown_source_lists_builtin_and_installed_ones(install, tmp_path):
    install("handy", "1.2", fingertip="handy:FINGERTIP")
    with pytest.raises(TgdslError) as caught:
        tgdsl.connect(module(tmp_path), "gazebo")
    builtin = '"simulation", "emulator", "xhand1", "xhand1:PORT", "warp", "warp:DEVICE", the path of a log, "….npz"'
    assert str(caught.value) == f'unknown source "gazebo"; expected {builtin} or "fingertip:PORT"'


def test_an_installed_simulator_is_used_for_its_device(install, tmp_path):
    install("handy", "1.2", mine="handy:SIMULATOR")
    touch = module(tmp_path)
    sim = tgdsl.simulate(touch, 3, device="xpu:1", substeps=4)
    assert isinstance(sim, Simulation) and (sim.num_envs, sim.substeps) == (3, 4)
    with pytest.raises(SimulationError, match='"mine", which simulates on "xpu", has no option nconmax; it knows substeps'):
        tgdsl.simulate(touch, 3, device="xpu", nconmax=3)
    with pytest.raises(SimulationError, match='physics on "meta" is not supported, expected "xpu" or "cuda" or "cpu"'):
        tgdsl.simulate(touch, 3, device="meta")


def test_a_simulator_without_open_connects_through_simulate(install, tmp_path):
    install("handy", "1.2", plain="handy:PLAIN")
    touch = module(tmp_path)
    with tgdsl.connect(touch, "plain", num_envs=2, layers=4) as env:
        assert (env.num_envs, env.source.substeps) == (2, round(0.02 / env.source.model.opt.timestep))
        assert env.observe().keys() == touch.observe(touch(touch.example_state(2))).keys()
    with pytest.raises(TgdslError, match='"plain" has no option "gain"; known options: control_step, layers, num_envs, scene'):
        tgdsl.connect(touch, "plain", gain=1)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ("FINGERTIP", 'two kinds of sources are called "fingertip": one of grippy 0.3, one of handy 1.2; rename or remove one'),
        ("SIMULATION", 'two kinds of sources are called "simulation": one of tgdsl, one of handy 1.2; rename or remove one'),
    ],
)
def test_two_sources_of_one_name_are_refused(install, point, message):
    install("grippy", "0.3", fingertip="grippy:OTHER")
    install("handy", "1.2", fingertip=f"handy:{point}")
    with pytest.raises(TgdslError, match=f"^{message}$"):
        known_sources()


BROKEN = {
    "missing": ("gone_module:KIND", "ModuleNotFoundError: No module named 'gone_module'"),
    "attribute": ("handy:GONE", "AttributeError: module 'handy' has no attribute 'GONE'"),
    "no kind": ("handy:NO_KIND", "found dict, expected a SourceKind"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_source_is_left_out_with_a_warning_that_names_its_package(install, case):
    value, why = BROKEN[case]
    install("handy", "1.2", broken=value, fingertip="handy:FINGERTIP")
    with pytest.warns(UserWarning, match="is left out") as caught:
        kinds = known_sources()
    assert [str(warning.message) for warning in caught] == [f'the source "broken" of handy 1.2 ({value}) is left out: {why}']
    assert [kind.name for kind in kinds] == [*OWN, "fingertip"], "the others are there"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert known_sources() == kinds, "once"


# MuJoCo Warp


def test_warp_connects_like_any_other_source(tmp_path):
    touch, twin = (observed(tmp_path) for _ in range(2))
    control = np.array([0.3, -0.2])
    with tgdsl.connect(touch, "warp:cpu", num_envs=2, control_step=0.006, keyframe="home", nconmax=24) as env:
        sim = tgdsl.WarpSimulation(twin, 2, device="cpu", substeps=3, keyframe="home", nconmax=24)
        assert isinstance(env.source, tgdsl.WarpSimulation)
        assert (env.num_envs, env.control_step) == (2, pytest.approx(0.006))
        for _ in range(3):
            env.step(control)
            sim.step(control)
            observed_policy, expected = env.observe()["policy"], twin.observe(twin(sim.state()))["policy"]
            assert torch.equal(observed_policy, expected)
        assert observed_policy.any()
        env.reset([1])
        sim.reset([1])
        assert torch.equal(env.observe()["policy"], twin.observe(twin(sim.state()))["policy"])


def test_warp_without_a_device_uses_cuda(tmp_path, monkeypatch):
    arguments = {}

    def record_device(self, touch, num_envs, *, device=None, **keys):
        arguments["device"] = device
        raise SimulationError("no GPU here")

    monkeypatch.setattr(tgdsl.WarpSimulation, "__init__", record_device)
    for source, device in (("warp", "cuda"), ("warp:cuda:1", "cuda:1")):
        with pytest.raises(SimulationError, match="no GPU here"):
            tgdsl.connect(module(tmp_path), source)
        assert arguments["device"] == device


def test_warp_refuses_terms_of_a_real_hand(tmp_path):
    touch = module(tmp_path, observations={"policy": [{"type": "taxel_counts"}]})
    with pytest.raises(ObservationError, match="which only a real XHand1 has, and no simulation"):
        tgdsl.connect(touch, "warp:cpu")
