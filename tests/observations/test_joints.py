"""Joint positions, velocities, efforts and the last action: names, order, and the path from state to policy."""

import json

import numpy as np
import pytest
import torch
from joint_scenes import ACTUATED, ACTUATORS, ALL, joint_document, joint_module

import tgdsl
from tgdsl.errors import SpecError, StateError
from tgdsl.plan.plan import FORMAT


def rows_of(touch, names, kind="joints"):
    return [getattr(touch.inputs, kind).index(name) for name in names]


def test_default_is_the_actuated_joints_in_actuator_order(tmp_path):
    touch = joint_module(tmp_path, {"policy": ALL})
    assert (touch.inputs.joints, touch.inputs.actuators) == (ACTUATED, ACTUATORS)
    assert touch.inputs.fields[-4:] == ("joint_pos", "joint_vel", "joint_effort", "last_action")
    state = touch.example_state(3)
    readings = touch(state)
    expected = torch.cat([state.joint_pos, state.joint_vel, state.joint_effort, state.last_action], dim=1)
    assert (touch.observe(readings)["policy"] == expected).all()
    terms = {output.name: output for output in touch.outputs[1:]}
    assert {name: output.shape for name, output in terms.items()} == dict.fromkeys(terms, (3, 1))
    assert [(o.rows, o.channels, o.units) for o in terms.values()] == [
        ("joint", ("position",), ("rad or m",)),
        ("joint", ("velocity",), ("rad/s or m/s",)),
        ("joint", ("effort",), ("N·m or N",)),
        ("actuator", ("control",), ("control",)),
    ]


@pytest.mark.parametrize(
    ("type_", "joints", "expected"),
    [
        ("joint_pos", ["lift", "bend"], ["lift", "bend"]),
        ("joint_vel", ["*"], ["bend", "curl", "lift", "passive"]),
        ("joint_effort", ["passive", "*l*"], ["passive", "curl", "lift"]),
        ("last_action", ["lift"], ["raise"]),
        ("last_action", ["curl"], ["pull"]),
        ("last_action", ["lift", "bend"], ["raise", "pull", "twist"]),
        ("last_action", ["*"], ["pull", "raise", "twist"]),
    ],
)
def test_joints_by_name_and_wildcard(tmp_path, type_, joints, expected):
    """With a second group of all joints: the state has one order, each term its own."""
    terms = {"policy": [{"type": type_, "joints": joints}], "all": [{"type": type_, "joints": ["*"]}]}
    touch = joint_module(tmp_path, terms)
    kind = "actuators" if type_ == "last_action" else "joints"
    state = touch.example_state(2)
    features = touch.observe(touch(state))["policy"]
    assert (features == getattr(state, type_)[:, rows_of(touch, expected, kind)]).all()
    alone = joint_module(tmp_path, {"policy": terms["policy"]})
    assert set(getattr(alone.inputs, kind)) == set(expected)
    assert alone.observe(alone(alone.example_state(1)))["policy"].shape == (1, len(expected))


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ({"type": "joint_pos", "joints": ["lift", "bent"]}, 'observations.policy[0].joints[1]: no joint of the robot matches "bent"; did you mean "bend"?'),
        ({"type": "joint_pos", "joints": ["spin"]}, 'no joint of the robot matches "spin"'),
        ({"type": "joint_vel", "joints": ["neck"]}, '"neck" is a ball or free joint; it has no single position; expected hinges and slides'),
        ({"type": "last_action", "joints": ["passive"]}, "no actuator acts on passive; so there is no last action of it"),
        ({"type": "joint_pos", "joints": []}, "observations.policy[0].joints"),
    ],
)  # fmt: skip
def test_mistakes_name_their_place(tmp_path, term, message):
    with pytest.raises(SpecError) as caught:
        tgdsl.compile(joint_document(tmp_path, {"policy": [term]}))
    assert message in str(caught.value)


def test_a_robot_without_actuators_has_no_actuated_joints(tmp_path):
    document = joint_document(tmp_path, {"policy": [{"type": "joint_pos"}]})
    for name in ("robot.xml", "scene.xml"):
        text = (tmp_path / name).read_text()
        (tmp_path / name).write_text(text[: text.index("<actuator>")] + "</mujoco>")
    with pytest.raises(SpecError, match=r'policy\[0\]: the robot has no actuated joints, .*; name them: joints: \["\*"\]'):
        tgdsl.compile(document)
    document["observations"]["policy"] = [{"type": "joint_pos", "joints": ["*"]}]
    assert tgdsl.compile(document).inputs.joints == ("lift", "bend", "curl", "passive")


def test_an_actuator_without_a_name_is_a_mistake(tmp_path):
    document = joint_document(tmp_path, {"policy": [{"type": "last_action"}]})
    for name in ("robot.xml", "scene.xml"):
        (tmp_path / name).write_text((tmp_path / name).read_text().replace('<motor name="pull"', "<motor"))
    with pytest.raises(SpecError, match=r"policy\[0\]: an actuator of the robot that this is of has no name; name it"):
        tgdsl.compile(document)


@pytest.mark.parametrize("name", ["joint_pos", "joint_vel", "joint_effort", "last_action"])
def test_sensors_may_not_take_the_names_of_joint_readings(tmp_path, name):
    sensor = {"kind": "contact_depth", "links": "*", "feels": ["item"]}
    with pytest.raises(SpecError, match=rf'sensors.{name}: "{name}" is the name of a reading that no sensor makes; give the'):
        tgdsl.compile(joint_document(tmp_path, {}, **{name: sensor}))


def test_joint_inputs_are_required_only_on_request(tmp_path):
    touch = joint_module(tmp_path, {"policy": [{"type": "reading", "of": "dist"}]})
    assert not {"joint_pos", "joint_vel", "joint_effort", "last_action"} & {
        *touch.inputs.fields,
        *touch(touch.example_state(1)),
    }
    assert (touch.inputs.joints, touch.inputs.actuators) == ((), ())
    one = joint_module(tmp_path, {"policy": [{"type": "joint_vel"}]})
    assert {*one.inputs.fields} == {*touch.inputs.fields, "joint_vel"}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_readings_have_the_modules_dtype_and_do_not_alias_the_state(tmp_path, dtype):
    touch = joint_module(tmp_path, {"policy": ALL}, dtype)
    state = touch.example_state(2).to(torch.float32 if dtype == torch.float32 else torch.float64)
    readings = touch(state)
    copies = {name: readings[name].clone() for name in ("joint_pos", "last_action")}
    for name, value in copies.items():
        assert value.dtype == dtype
        assert (value[:, :, 0] == getattr(state, name).to(dtype)).all()
        getattr(state, name).add_(1.0)
        assert (readings[name] == value).all()


def test_a_state_without_joints_is_an_error(tmp_path):
    touch = joint_module(tmp_path, {"policy": [{"type": "joint_pos"}]})
    state = touch.example_state(2)
    state.joint_pos = state.joint_pos[:, :2]
    with pytest.raises(StateError, match=r"SceneState.joint_pos has shape \(2, 2\), expected \(env, 3\)"):
        touch(state)
    state.joint_pos = None
    with pytest.raises(StateError, match="SceneState lacks joint_pos, which this module reads"):
        touch(state)


def test_saving_loading_and_explaining(tmp_path):
    touch = joint_module(tmp_path, {"policy": [*ALL, {"type": "joint_pos", "joints": ["lift"]}]})
    tgdsl.save(touch, tmp_path / "a.safetensors")
    again = tgdsl.load(tmp_path / "a.safetensors", dtype=torch.float64)
    tgdsl.save(again, tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    state = touch.example_state(2)
    assert (again.observe(again(state))["policy"] == touch.observe(touch(state))["policy"]).all()
    assert again.observations == touch.observations
    plain = json.loads(touch.plan.to_json())
    assert plain["format"] == FORMAT
    assert list(plain) == sorted(plain)
    assert plain["inputs"]["joints"] == list(ACTUATED)
    text = touch.explain()
    assert f"  joints  {', '.join(ACTUATED)}\n  actuators  {', '.join(ACTUATORS)}\n" in text
    assert "policy: joint_pos (3), joint_vel (3), joint_effort (3), last_action (3), joint_pos (1)" in text


@pytest.mark.slow
def test_compiled_equals_eager(tmp_path):
    touch = joint_module(tmp_path, {"policy": ALL}, torch.float32)
    state = touch.example_state(3)
    eager = touch.observe(touch(state))["policy"]
    touch.compile(backend="eager")
    assert (touch.observe(touch(state))["policy"] == eager).all()
    np.testing.assert_array_equal(eager.numpy()[:, :3], state.joint_pos.numpy().astype(np.float32))
