"""Gaits: shares and percentiles of made-up instants, against values worked out by hand."""

import json
from dataclasses import asdict
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch

from tgdsl.rl.playing.gait import LEAST, NUM_BINS, WIDTH, GaitMeter, percentile

HAND = """<mujoco><worldbody>
  <body name="palm"><geom size=".01" mass="1"/>
    <body name="tip"><joint name="bend" axis="0 1 0"/><geom size=".01" mass="1"/></body></body>
</worldbody></mujoco>"""


def meter_of(num, blocks=1, limit=(2.0, np.inf), rated=(4.0, np.inf), links=("palm", "tip")):
    actuators = SimpleNamespace(names=("bend", "turn"), limit=np.array(limit), top_speed=np.array(rated))
    setup = SimpleNamespace(model=mujoco.MjModel.from_xml_string(HAND), links=links, actuators=actuators)
    env = SimpleNamespace(num_envs=num, task=SimpleNamespace(setup=setup), sim=SimpleNamespace(qpos=torch.zeros(num, 1)))
    return GaitMeter(env, blocks)


def instant(tip, torque=0.0, palm=0.2, depth=0.0, spin=1.0, joint_vel=0.0, probes=2):
    """Return an instant; each argument is one number per environment."""
    tip = torch.as_tensor(tip, dtype=torch.float64)
    num, zero = len(tip), torch.zeros(len(tip), dtype=torch.float64)
    full = lambda value: zero + torch.as_tensor(value, dtype=torch.float64)  # noqa: E731
    force = torch.zeros((num, 2, 3), dtype=torch.float64)
    force[:, 0, 2], force[:, 1, 0] = full(palm), tip
    return SimpleNamespace(
        link_force=force,
        torque=torch.stack([full(torque), zero + 100.0], dim=1),
        distance=torch.stack([0.01 + zero, -full(depth)], dim=1)[:, :probes],
        object=SimpleNamespace(linvel=torch.stack([zero, 0.5 * full(spin), zero], 1), angvel=torch.stack([zero, zero, full(spin)], 1)),
        joint_vel=torch.stack([full(joint_vel), zero], dim=1),
        joint_pos=torch.zeros((num, 2), dtype=torch.float64),
    )  # fmt: skip


def add(meter, now, progress, counts=None, strength=0.98):
    num = len(now.joint_pos)
    counts = torch.ones(num, dtype=torch.bool) if counts is None else torch.tensor(counts)
    progress = None if progress is None else torch.tensor(progress, dtype=torch.float64)
    meter.add_instant(now, progress, torch.full((num, 2), strength), counts)


def test_shares_match_hand_worked_instants():
    """Progress is 0.3 held and 0.3 coasting, −0.5 does not count: one half; torque is at its limit in 2 of 4 instants."""
    meter = meter_of(2)
    add(meter, instant([1.0, 0.0], torque=[1.97, -2.0]), [0.3, 0.1])
    add(meter, instant([0.005, 3.0], torque=[1.9, 0.0]), [0.2, -0.5])
    add(meter, instant([0.0, 0.0], torque=[2.0, 2.0], spin=99.0), [9.0, 9.0], counts=[False, False])  # not counted
    gait = meter.gaits()[0]
    assert gait.coasting == pytest.approx(0.3 / 0.6) and gait.untouched == 0.5
    assert gait.saturation == gait.any_saturation == 0.5 and gait.saturations == {"bend": 0.5}  # the other joint has no limit
    assert (gait.max_spin, gait.max_speed) == (1.0, 0.5)
    assert list(gait.link_forces) == ["palm", "tip"] and gait.rated_speeds == {"bend": 4.0}
    json.dumps(asdict(gait), allow_nan=False)


def test_a_weaker_drive_reaches_its_limit_earlier():
    meter = meter_of(1)
    add(meter, instant([1.0], torque=[1.5]), [0.1])
    add(meter, instant([1.0], torque=[1.5]), [0.1], strength=0.7)
    assert meter.gaits()[0].saturation == 0.5


def test_percentiles_cover_all_values():
    """Of 1 to 400 N the 396th, within a bin; depths without contact do not count."""
    num = 400
    values = np.arange(1.0, num + 1)
    meter = meter_of(num)
    depth = np.where(values > 200, 1e-5 * values, -1e-3)
    add(meter, instant(values, palm=0.0, depth=depth, spin=0.1 * values, joint_vel=-0.01 * values), values.tolist())
    gait = meter.gaits()[0]
    assert gait.force == gait.link_forces["tip"] == pytest.approx(396, rel=0.006) and list(gait.link_forces) == ["tip"]
    assert gait.penetration == pytest.approx(398e-5, rel=0.006)
    assert gait.spin == pytest.approx(39.6, rel=0.006) and gait.speed == pytest.approx(19.8, rel=0.006)
    assert gait.joint_speed == pytest.approx(3.96 / 4.0, rel=0.006) and gait.joint_speeds["turn"] == 0.0
    assert gait.coasting == 0.0 and "force on links, 99 % below                     396 N" in str(gait)


def test_blocks_are_measured_separately():
    meter = meter_of(4, blocks=2)
    add(meter, instant([0.0, 1.0, 2.0, 2.0], spin=[1.0, 2.0, 3.0, 4.0]), [0.1, 0.3, 0.1, 0.1])
    one, two = meter.gaits()
    assert (one.coasting, two.coasting) == (pytest.approx(0.25), 0.0)
    assert (one.max_spin, two.max_spin) == (2.0, 4.0)
    assert (one.force, two.force) == (pytest.approx(1.0, rel=0.006), pytest.approx(2.0, rel=0.006))


def test_quantities_that_a_task_lacks_are_none():
    meter = meter_of(1, limit=(np.inf, np.inf), rated=(np.inf, np.inf), links=())
    now = instant([0.0], probes=0)
    now.link_force = now.link_force[:, :0]
    add(meter, now, None)
    gait = meter.gaits()[0]
    for name in ("coasting", "untouched", "saturation", "any_saturation", "penetration", "force", "joint_speed"):
        assert getattr(gait, name) is None, name
    assert "–" in str(gait)
    assert meter_of(1).gaits()[0].untouched is None  # without an instant


def test_percentile_of_a_histogram():
    counts = torch.zeros(NUM_BINS, dtype=torch.int64)
    assert percentile(counts) is None
    counts[700], counts[900] = 99, 1
    assert percentile(counts) == pytest.approx(LEAST * np.exp(700.5 * WIDTH))
    counts[900] = 2
    assert percentile(counts) == pytest.approx(LEAST * np.exp(900.5 * WIDTH))
