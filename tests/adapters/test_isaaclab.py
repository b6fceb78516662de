"""Touch by Isaac Lab's contract for sensors, on Newton; a stand-in replaces Isaac Lab.

The stand-in has the parts that the adapter uses: `SensorBase` (timestamps and flags per environment, lazy data), `configclass`
and the accessors of `NewtonManager`.
"""

import re
import sys
from dataclasses import dataclass
from functools import partial
from types import ModuleType

import pytest
import torch
import warp as wp
from newton_host import Host
from scene_of_adapters import DEPTH, LOAD, document

from tgdsl.adapters.newton import SensorTactile

configclass = partial(dataclass, kw_only=True)


@configclass
class BaseCfg:
    class_type: type
    prim_path: str
    update_period: float = 0.0


class Base:
    """Evaluate readings on access, in environments whose period has passed or that were reset."""

    def __init__(self, cfg):
        self.cfg, self.is_initialized = cfg, False

    def _initialize_impl(self):
        self._num_envs, self._sim_physics_dt = Manager.get_model().world_count, 0.002
        self._is_outdated = wp.ones(self._num_envs, dtype=wp.bool)
        self._timestamp, self._last = torch.zeros(self._num_envs), torch.zeros(self._num_envs)
        self._data_dirty = self.is_initialized = True

    def reset(self, env_ids=None, env_mask=None):
        rows = slice(None) if env_ids is None and env_mask is None else env_ids
        rows = rows if env_mask is None else wp.to_torch(env_mask)
        wp.to_torch(self._is_outdated)[rows] = True
        self._timestamp[rows] = self._last[rows] = 0.0
        self._data_dirty = True

    def update(self, dt, force_recompute=False):
        self._timestamp += dt
        wp.to_torch(self._is_outdated).logical_or_(self._timestamp - self._last + 1e-6 >= self.cfg.update_period)
        self._data_dirty = True

    def _update_outdated_buffers(self):
        if self._data_dirty:
            self._update_buffers_impl(self._is_outdated)
            due = wp.to_torch(self._is_outdated)
            self._last[due] = self._timestamp[due]
            due.zero_()
            self._data_dirty = False


class Manager:
    """Accessors to the model that a host steps."""

    host: Host
    asked: list[str]

    @classmethod
    def get_model(cls):
        return cls.host.model

    @classmethod
    def get_state_0(cls):
        return cls.host.state

    @classmethod
    def get_contacts(cls):
        cls.host.contacts.force = cls.host.observables.contact_f if cls.asked else None
        return cls.host.contacts

    @classmethod
    def add_contact_sensor(cls, body_names_expr):
        cls.asked.append(body_names_expr)


@pytest.fixture
def isaaclab(monkeypatch):
    members = {
        "isaaclab": {},
        "isaaclab.sensors": {"SensorBase": Base, "SensorBaseCfg": BaseCfg},
        "isaaclab.utils": {"configclass": configclass},
        "isaaclab_newton": {},
        "isaaclab_newton.physics": {"NewtonManager": Manager},
    }
    for name, attributes in members.items():
        module = ModuleType(name)
        vars(module).update(attributes)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.delitem(sys.modules, "tgdsl.adapters.isaaclab", raising=False)
    import tgdsl.adapters.isaaclab as adapter

    Manager.host, Manager.asked = Host(), []
    yield adapter
    sys.modules.pop("tgdsl.adapters.isaaclab")


def make(adapter, doc, **settings):
    cfg = adapter.TactileSensorCfg(prim_path="/World/envs/env_.*/Robot/.*", document=doc, **settings)
    sensor = cfg.class_type(cfg)
    sensor._initialize_impl()
    return sensor


def steps(sensor, num, dt=0.002) -> None:
    for _ in range(num):
        Manager.host.step()
        sensor.update(dt)


def test_readings_match_newtons_sensor(isaaclab, tmp_path):
    doc = document(tmp_path, load=LOAD)
    sensor = make(isaaclab, doc)
    assert Manager.asked == ["/World/envs/env_.*/Robot/.*"]
    Manager.host.push()
    steps(sensor, 6)
    expected = Manager.host.read(SensorTactile(Manager.host.model, doc))
    assert expected["load"].any()
    for name, value in expected.items():
        assert torch.equal(sensor.data[name], value)
    assert torch.equal(sensor.observation(), sensor.tactile.touch.observe(expected)["policy"])


def test_sensors_advance_by_the_time_since_their_last_read(isaaclab, tmp_path):
    sensor = make(isaaclab, document(tmp_path, delayed=DEPTH | {"noise": {"read_delay": 0.004}}))
    calls, read = [], sensor.tactile.touch.forward
    sensor.tactile.touch.forward = lambda state, mask: calls.append((state.dt, mask)) or read(state, mask)
    steps(sensor, 1)
    _ = sensor.data, sensor.data
    steps(sensor, 3)
    _ = sensor.data
    assert calls == [(pytest.approx(0.002), None), (pytest.approx(0.006), None)]


def test_only_a_reset_environment_is_read_again(isaaclab, tmp_path):
    sensor = make(isaaclab, document(tmp_path, stacked=DEPTH | {"history": 3}, load=LOAD))
    Manager.host.push()
    for _ in range(4):
        steps(sensor, 1)
        previous = {name: value.clone() for name, value in sensor.data.items()}
    for reset in ({"env_ids": [1]}, {"env_mask": wp.array([False, True], dtype=wp.bool)}):
        sensor.reset(**reset)
        current = {name: value.clone() for name, value in sensor.data.items()}
        assert torch.equal(current["stacked"][0], previous["stacked"][0])
        assert not current["stacked"][1].any() and not current["load"][1].any() and current["load"][0].any()
    steps(sensor, 1)
    assert sensor.data["load"][1].any()


def test_contacts_return_after_a_reset_with_an_update_period(isaaclab, tmp_path):
    sensor = make(isaaclab, document(tmp_path, load=LOAD), update_period=0.004)
    Manager.host.push()
    steps(sensor, 6)
    assert sensor.data["load"][1].any()
    sensor.reset(env_ids=[1])
    assert not sensor.data["load"][1].any()
    steps(sensor, 2)
    assert sensor.data["load"][1].any()


def test_readings_stay_within_their_update_period(isaaclab, tmp_path):
    sensor = make(isaaclab, document(tmp_path), update_period=0.004)
    Manager.host.push()
    _ = sensor.data
    values = []
    for _ in range(4):
        steps(sensor, 1)
        values.append(sensor.data["skin"].clone())
    assert torch.equal(values[1], values[2]) and not torch.equal(values[0], values[1])
    assert not torch.equal(values[2], values[3])


def test_an_unknown_name_is_refused_when_the_sensor_is_initialized(isaaclab, tmp_path):
    message = 'the scene has no body "hand/worldbody/palm/pda"; did you mean "hand/worldbody/palm/pad"?'
    with pytest.raises(Exception, match=re.escape(message)):
        make(isaaclab, document(tmp_path), names={"pad": "hand/worldbody/palm/pda"})
