"""Taxels of modules against those of tables, artefacts, rollouts and states: equal ones pass, others are refused with the difference."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

import tgdsl
from tgdsl.errors import TaxelError, TgdslError
from tgdsl.formats.robot import export_model, load_model
from tgdsl.module.artifact import load_plan
from tgdsl.placement.propose.propose import propose
from tgdsl.placement.propose.text import layout_text
from tgdsl.runtime.rollout import Recorder, held_controls, rollout

ROBOT = """
<mujoco>
  <worldbody>
    <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
    <body name="cube" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
  </worldbody>
</mujoco>
"""
POINTS = [{"pos": [x, 0.01, 0.01], "normal": [0, 0, 1]} for x in (0.0, 0.01, -0.02)]
OTHER_ORDER = (
    ': sensor "touch": 2 of 3 rows are other taxels than expected, the same ones in another order; '
    'the first is row 1: link "pad" at [10, 10, 10] mm here, link "pad" at [-20, 10, 10] mm expected'
)


def compiled(folder, points=POINTS, noise="clean") -> tgdsl.TactileModule:
    (folder / "robot.xml").write_text(ROBOT)
    layout = {"resolutions": {"low": {"pad": {"method": "points", "points": points, "radius": 0.002}}}}
    touch = {"kind": "kinematic_taxel", "links": "pad", "feels": ["cube"], "outputs": ["force"], "noise": noise}
    return tgdsl.compile({
        "tgdsl": 1,
        "robot": {"model": str(folder / "robot.xml"), "layout": layout},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"touch": touch},
        "observations": {"policy": [{"type": "force", "of": "touch"}]},
    })  # fmt: skip


def rounded_points(points=POINTS):
    """Return the same points 1e-8 m away, as after a conversion to float32."""
    return [{**point, "pos": [x + 1e-8 for x in point["pos"]]} for point in points]


@pytest.fixture
def three(tmp_path):
    """Return a module, the same one within rounding, and one with two rows swapped."""
    return compiled(tmp_path), compiled(tmp_path, rounded_points()), compiled(tmp_path, [POINTS[i] for i in (0, 2, 1)])


def test_taxels_are_checked_against_modules_and_tables(three):
    touch, same, other = three
    tgdsl.check_taxels(touch, same)
    tgdsl.check_taxels(touch, same.taxels)
    for expected in (other, other.taxels):
        with pytest.raises(TaxelError) as caught:
            tgdsl.check_taxels(touch, expected, "the policy's sensor")
        assert str(caught.value) == "the policy's sensor" + OTHER_ORDER
    with pytest.raises(TaxelError, match=r'^this module: there is no sensor "tuch", whose taxels'):
        tgdsl.check_taxels(touch, {"tuch": touch.taxels["touch"]})


def test_torch_accepts_columns_of_the_table(tmp_path):
    normals = compiled(tmp_path).taxels["touch"]["normal"]
    assert torch.equal(torch.tensor(normals), torch.tensor([[0.0, 0.0, 1.0]] * 3, dtype=torch.float64))


def test_ids_distinguish_taxels_but_ignore_rounding(three):
    touch, same, other = three
    tgdsl.check_taxels(touch, touch.taxels_id)
    tgdsl.check_taxels(touch, same.taxels_id)
    with pytest.raises(TaxelError, match=f"{touch.taxels_id}, {other.taxels_id} is expected: 3 taxels of 1 links"):
        tgdsl.check_taxels(touch, other.taxels_id)
    assert f"taxels_id {touch.taxels_id}\n" in touch.explain()


@pytest.mark.parametrize("expected", ["half a name", "no.txt", {"touch": {"pos": np.zeros((3, 3))}}, "missing.npz"])
def test_invalid_tables_are_refused(three, expected):
    with pytest.raises(TgdslError, match="expected"):
        tgdsl.check_taxels(three[0], expected)


def test_taxels_are_checked_against_artefacts(three, tmp_path):
    touch = three[0]
    for name, module in zip(("touch", "same", "other"), three, strict=True):
        tgdsl.save(module, tmp_path / f"{name}.safetensors")
    path = tmp_path / "touch.safetensors"
    assert tgdsl.load(path, taxels=touch.taxels_id).taxels_id == touch.taxels_id
    assert load_plan(path).taxels_id == touch.taxels_id
    with safe_open(str(path), framework="numpy") as file:
        assert json.loads(file.metadata()["tgdsl"])["taxels_id"] == touch.taxels_id
    tgdsl.load(path, taxels=tmp_path / "same.safetensors")
    with pytest.raises(TaxelError) as caught:
        tgdsl.load(path, taxels=str(tmp_path / "other.safetensors"))
    assert str(caught.value) == str(path) + OTHER_ORDER


def test_a_plan_with_an_older_id_is_read(three):
    plan = three[0].plan
    text = plan.to_json().replace(plan.taxels_id, "0" * 32)
    assert type(plan).from_json(text, plan.arrays).taxels_id == plan.taxels_id


def test_taxels_are_checked_against_rollouts(three, tmp_path):
    touch, same, other = three
    for name, module in (("same", same), ("other", other)):
        sim = tgdsl.simulate(module, 1)
        controls = held_controls(sim.model, 2 * sim.control_step, sim.control_step)
        recorder = Recorder(module, len(controls), 1)
        for step in rollout(module, sim, controls):
            recorder.add(step)
        recorder.write(tmp_path / f"{name}.npz", controls, Path("scene.yaml"), ["a", "b"])
    tgdsl.check_taxels(touch, tmp_path / "same.npz")
    with pytest.raises(TaxelError) as caught:
        tgdsl.check_taxels(touch, tmp_path / "other.npz")
    assert str(caught.value) == "this module" + OTHER_ORDER


@pytest.mark.parametrize("noise", ["clean", "noisy"])
def test_taxels_are_checked_when_a_state_is_loaded(tmp_path, noise):
    """With and without state, in a policy that contains the module, and with `weights_only`, torch's default."""

    class Policy(nn.Module):
        def __init__(self, touch: tgdsl.TactileModule):
            super().__init__()
            self.touch, self.layer = touch, nn.Linear(9, 2)

    policy, same, other = (Policy(compiled(tmp_path, points, noise)) for points in (POINTS, rounded_points(), POINTS[::-1]))
    state = policy.touch.example_state(2)
    policy.touch(state)
    torch.save(policy.state_dict(), tmp_path / "policy.pt")
    saved = torch.load(tmp_path / "policy.pt", weights_only=True)
    assert set(saved) - set(policy.state_dict()) == set()
    same.load_state_dict(saved)
    assert same.touch.num_envs == policy.touch.num_envs
    with pytest.raises(TaxelError, match=r'^the state dict is of another module: sensor "touch": 2 of 3 rows'):
        other.load_state_dict(saved)
    assert other.touch.num_envs is None
    with pytest.raises(TaxelError, match="the state dict is of another module"):
        other.touch.load_state_dict(policy.touch.state_dict())
    other.load_state_dict(dict(saved))  # a plain dictionary has no taxels


def test_taxels_are_checked_when_connecting(three, monkeypatch):
    touch, same, other = three
    with tgdsl.connect(touch, "simulation", taxels=same, control_step=0.004) as source:
        source.step()
        assert source.observe()["policy"].shape == (1, 9)
    with pytest.raises(TaxelError) as caught:
        tgdsl.connect(touch, "xhand1:/dev/nowhere", taxels=other.taxels)  # the port is not opened
    assert str(caught.value) == "this module" + OTHER_ORDER


HAND = """<mujoco><worldbody><body name="palm" euler="11 23 37"><geom type="box" size=".04 .03 .01"/>
  <body name="a" pos=".03 .01 .01" euler="3 5 190"><joint name="a" axis="0 1 0" range="0 60"/><geom type="capsule" fromto="0 0 .01 .002 .001 .05" size=".007"/></body>
  <body name="b" pos="-.03 .01 .01" euler="3 5 7"><joint name="b" axis="0 1 0" range="0 60"/><geom type="box" size=".007 .009 .03" pos=".001 0 .03" euler="1 2 3"/></body>
</body></worldbody></mujoco>"""
URDF = """<robot name="hand"><link name="palm"><collision><geometry><box size=".08 .06 .02"/></geometry></collision></link>
  <link name="a"><collision><origin xyz=".001 0 .03" rpy=".1 .2 .3"/><geometry><box size=".014 .018 .06"/></geometry></collision></link>
  <link name="b"><collision><origin xyz=".001 0 .03"/><geometry><cylinder radius=".008" length=".05"/></geometry></collision></link>
  <joint name="a" type="revolute"><parent link="palm"/><child link="a"/><origin xyz=".03 .01 .02" rpy=".1 .2 3.2"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="b" type="revolute"><parent link="palm"/><child link="b"/><origin xyz="-.03 .01 .02" rpy=".1 .2 .3"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint></robot>"""


@pytest.mark.parametrize(("name", "text"), [("hand.xml", HAND), ("hand.urdf", URDF)])
def test_an_exported_robot_has_the_same_taxels(tmp_path, name, text):
    """USD stores frames and vertices in float32; the proposed layout samples the surfaces of both."""
    (tmp_path / name).write_text(text)
    export_model(tmp_path / name, tmp_path / "twin.usda")
    robot = load_model(tmp_path / name)
    (tmp_path / "layout.yaml").write_text(layout_text(propose(robot, 4e4), name))
    modules = [
        tgdsl.compile(
            {
                "tgdsl": 1,
                "robot": {"model": str(tmp_path / model), "layout": str(tmp_path / "layout.yaml")},
                "objects": {"ball": {"geom": {"type": "sphere", "size": [0.02]}, "pos": [0, 0, 0.3]}},
                "sensors": {"touch": {"kind": "contact_depth", "links": "hand", "feels": ["ball"]}},
                "resolution": "high",
            }
        )
        for model in (name, "twin.usda")
    ]
    tgdsl.check_taxels(modules[0], modules[1])
    tgdsl.check_taxels(modules[0], modules[1].taxels_id)


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_rollout_cannot_run_code(three, tmp_path):
    tables = {"touch:pos": np.array([Marker(tmp_path / "ran")], dtype=object), "touch:link": np.array(["pad"])}
    np.savez(tmp_path / "evil.npz", **tables, allow_pickle=True)
    with pytest.raises(TgdslError, match=r"evil\.npz: expected the \.npz file of a rollout"):
        tgdsl.check_taxels(three[0], tmp_path / "evil.npz")
    assert not (tmp_path / "ran").exists()
