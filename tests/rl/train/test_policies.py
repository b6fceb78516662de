"""Policy files and their cards."""

import json

import numpy as np
import pytest
import torch
from small_runs import small_learner

from tgdsl.rl.playing.policy import PolicyError, policy_for, read_policy
from tgdsl.rl.train.folder import run_origin

pytestmark = [pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"), pytest.mark.usefixtures("no_onnx")]


def test_sensors_that_the_environments_lack_are_not_compared(tmp_path):
    """A hand has the policy's sensors but not those of its task only; at least one must be present."""
    learner, loaded = small_learner(tmp_path, train__actor="[tactile_sensors, proprio]")
    file = tmp_path / "policy.pt"
    card = learner.card(run_origin(loaded, learner.env, 0, {}, 1), 0.0, "tgdsl train task.yaml") | {"taxels": "0"}
    learner.write_policy(card, file)
    extra = {"card.json": "", "taxels.csv": ""}
    module = torch.jit.load(file, _extra_files=extra)
    head, *rows = extra["taxels.csv"].decode().splitlines(keepends=True)
    unknown_rows = [f"nowhere,{row.partition(',')[2]}" for row in rows]
    for text, is_accepted in ((head + "".join(rows + unknown_rows), True), (head + "".join(unknown_rows), False)):
        torch.jit.save(module, file, _extra_files={"card.json": extra["card.json"], "taxels.csv": text})
        if is_accepted:
            policy_for(learner.env, read_policy(file))
        else:
            with pytest.raises(PolicyError, match='other taxels: this module: there is no sensor "nowhere", whose taxels'):
                policy_for(learner.env, read_policy(file))


def test_taxels_may_differ_by_rounding(tmp_path):
    learner, loaded = small_learner(tmp_path, train__actor="[tactile_sensors, proprio]")
    file, touch = tmp_path / "policy.pt", learner.env.touch
    card = learner.card(run_origin(loaded, learner.env, 0, {}, 1), 0.0, "tgdsl train task.yaml") | {"taxels": "0"}
    learner.write_policy(card, file)
    saved = read_policy(file)
    for name, table in touch.taxels.items():
        for column in ("link", "body", "pos", "normal", "tangent", "radius", "area", "row", "column"):
            np.testing.assert_array_equal(saved.taxels[name][column], table[column])
    sensor, taxel = next((name, table[0]) for name, table in touch.taxels.items() if len(table))
    for offset, is_same in ((1e-7, True), (-1e-7, True), (1e-5, False)):
        extra = {"card.json": "", "taxels.csv": ""}
        module = torch.jit.load(file, _extra_files=extra)
        text = extra["taxels.csv"].decode().replace(repr(float(taxel["pos"][0])), repr(float(taxel["pos"][0]) + offset), 1)
        torch.jit.save(module, tmp_path / "other.pt", _extra_files={"card.json": extra["card.json"], "taxels.csv": text})
        other = read_policy(tmp_path / "other.pt")
        if is_same:
            policy_for(learner.env, other)
        else:
            message = f'other.pt: this policy feels with other taxels: this module: sensor "{sensor}": 1 of'
            with pytest.raises(PolicyError, match=message):
                policy_for(learner.env, other)


def test_a_policy_is_checked_against_its_card(tmp_path):
    """It acts as the network without exploration; a policy without touch accepts any taxels.

    Other joints, tasks, actions and control steps than those of its training are refused.
    """
    learner, loaded = small_learner(tmp_path, train__actor="[tactile_sensors, proprio]")
    learner.iterate()
    card = learner.card(run_origin(loaded, learner.env, 0, {"a": 1}, 1), 90.0, "tgdsl train task.yaml")
    file = tmp_path / "a policy.pt"
    learner.write_policy(card, file)
    assert read_policy(file).card == card == json.loads((tmp_path / "a policy.json").read_text())
    assert card["groups"] == {"tactile_sensors": 4, "proprio": 6} and card["minutes"] == 1.5 and card["samples"] == 16
    env = learner.env
    policy, obs = policy_for(env, read_policy(file)), env.reset(3)
    assert policy.groups == ("tactile_sensors", "proprio")
    with torch.no_grad():
        torch.testing.assert_close(policy(obs), learner.algorithm.actor(learner._seen(obs)))
    learner.write_policy(card | {"joints": ["bend", "swing"]}, file)
    with pytest.raises(PolicyError, match="this policy moves bend, swing, not swing, bend"):
        policy_for(env, read_policy(file))
    learned = card["spec"]
    for other, message in (
        ({"task": "screwdriver"}, f'was learned in the task "screwdriver", not "{learned["task"]}"'),
        ({"action": learned["action"] | {"smoothing": 0.5}}, "was learned with other actions: "),
        ({"physics": learned["physics"] | {"timestep": 0.001}}, "was learned with other control steps "),
    ):
        learner.write_policy(card | {"spec": learned | other}, file)
        with pytest.raises(PolicyError, match=message):
            policy_for(env, read_policy(file))
    learner.write_policy(card | {"spec": learned | {"touch": "depth"}}, file)
    with pytest.raises(PolicyError, match=f"this policy feels depth, not {learned['touch']}; try --set touch=depth"):
        policy_for(env, read_policy(file))
    learner.write_policy(card | {"spec": learned | {"action": {"mode": "other"}}}, file)
    with pytest.raises(PolicyError, match=r'was learned with other actions: {"mode": "other"}, here'):
        policy_for(env, read_policy(file))
    learner.write_policy(card, file)
    with pytest.raises(
        PolicyError, match=r"takes tactile_sensors \(4\) \+ proprio \(6\) = 10, not proprio \(6\) \+ tactile_sensors"
    ):
        policy_for(env, read_policy(file), ("proprio", "tactile_sensors"))
    older_action = {
        name: value for name, value in learned["action"].items() if name != "smoothing"
    }  # as an older tgdsl wrote it
    rounded = learned["action"] | {"scale": learned["action"]["scale"] * (1.0 + 1e-15)}  # 0.7 cm is not exactly 7 mm
    for action in (older_action, rounded):
        learner.write_policy(card | {"spec": learned | {"action": action}}, file)
        assert policy_for(env, read_policy(file)).groups == ("tactile_sensors", "proprio")
    pushes = {"push": {**learned["randomise"]["push"], "interval": [2.0 * (1.0 + 1e-15), 4.0]}}
    for difference, expected in (
        ({"episode": learned["episode"] * (1.0 + 1e-15), "randomise": learned["randomise"] | pushes}, []),
        ({"episode": 2.0 * learned["episode"]}, [f"episode: {2.0 * learned['episode']}, now {learned['episode']}"]),
    ):
        learner.write_policy(card | {"spec": learned | difference}, file)
        assert policy_for(env, read_policy(file)).changes == expected
    blind, _ = small_learner(tmp_path)
    blind.write_policy(card | {"taxels": "0", "groups": {name: env.groups[name] for name in blind.groups["actor"]}}, file)
    assert policy_for(env, read_policy(file)).groups == ("priv_proprio", "goal", "priv_obj_state")
    with pytest.raises(PolicyError, match=r"this policy takes .* = 31, not proprio"):
        policy_for(env, read_policy(file), ("proprio",))
