"""Descriptions of observations: with MuJoCo's raw state they suffice to recompute the observation."""

import math
import re

import mujoco
import numpy as np
import pytest
import torch
from pincer_tasks import pincer_env
from tiny_tasks import RADIUS, tiny_env

from tgdsl.rl.sensors import PolicyTouch

PLAIN = {"physics.substeps": 1, "touch": "depth", "proprio.vel_scale": 0.2}
"""With one physics step, readings are those at the start of the control step."""
TASKS = {"in_palm_rotate": (tiny_env, {}), "screwdriver": (pincer_env, {"variants": [0], "action.slide_scale": 1e-4})}
GIVEN = ("qpos", "qvel", "ctrl", "qfrc_applied", "xfrc_applied", "qacc_warmstart")


class Raw:
    """MuJoCo's state of one environment, and quantities that MuJoCo's own functions derive from it."""

    def __init__(self, env, arrays, action, start):
        self.env, self.action, self.start = env, action, start
        self.model = env.sim.env_model(0)
        self.data = mujoco.MjData(self.model)
        for name in GIVEN:
            getattr(self.data, name)[...] = arrays[name].reshape(getattr(self.data, name).shape)
        mujoco.mj_forward(self.model, self.data)

    def rotation(self, body):
        return self.data.body(body).xmat.reshape(3, 3)

    def force_on(self, link, body):
        """Return the body's force on a link, in world axes."""
        total, force = np.zeros(3), np.zeros(6)
        for i, side in self.contacts(link, body):
            mujoco.mj_contactForce(self.model, self.data, i, force)  # from the first geom on the second
            total += side * self.data.contact[i].frame.reshape(3, 3).T @ force[:3]
        return total

    def contacts(self, link, body):
        """Return (contact, sign) of a body with a link: 1 if the link is second, else −1."""
        signed_contacts = []
        for i, contact in enumerate(self.data.contact[: self.data.ncon]):
            bodies = [self.model.body(self.model.geom_bodyid[geom]).name for geom in contact.geom]
            if sorted(bodies) == sorted((link, body)):
                signed_contacts.append((i, 1 if bodies[1] == link else -1))
        return signed_contacts

    def signed_distance(self, point, body):
        """Return the distance to the surface of a body of boxes and spheres."""
        distances = []
        for geom in np.flatnonzero(self.model.geom_bodyid == self.model.body(body).id):
            if not self.model.geom_contype[geom] and not self.model.geom_conaffinity[geom]:
                continue
            x, y, z = self.data.geom_xmat[geom].reshape(3, 3).T @ (point - self.data.geom_xpos[geom])
            size = self.model.geom_size[geom]
            if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                off = np.abs([x, y, z]) - size
            else:
                assert self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
                off = np.array([np.linalg.norm([x, y, z]) - size[0]])
            distances.append(np.linalg.norm(np.maximum(off, 0)) + min(0, off.max()))
        return min(distances)

    def probes(self, features):
        """Yield world position and radius of each probe of the features."""
        for row in self.env.touch.rows[features.sensor][features.rows.start : features.rows.stop]:
            assert row["link"] == features.link
            body = row["body"]
            yield self.data.body(body).xpos + self.rotation(body) @ row["pos"], row["radius"]

    def goal(self):
        """Return the first goal: a quarter turn about the vertical."""
        quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        return quarter @ self.start


def rebuild(raw, features, body):
    """Compute features from their description."""
    name, frame = features.name, features.frame
    if joint := re.fullmatch(r"(position|velocity) of (\w+)", name):
        value = raw.data.joint(joint[2]).qpos if joint[1] == "position" else raw.data.joint(joint[2]).qvel
    elif joint := re.fullmatch(r"last action of (\w+)", name):
        value = [raw.action[raw.env.joint_names.index(joint[1])]]
    elif name == "force_x, force_y, force_z":
        assert frame == "link"
        value = raw.rotation(features.link).T @ raw.force_on(features.link, body)
    elif name.startswith("position_x"):
        value = raw.data.body(features.link).xpos
    elif name.startswith("orientation_xx"):
        value = raw.rotation(features.link).T[:2].ravel()
    elif name.startswith(("velocity_x", "angular_velocity_x")):
        motion = np.zeros(6)
        kind, ident = mujoco.mjtObj.mjOBJ_XBODY, raw.model.body(features.link).id
        mujoco.mj_objectVelocity(raw.model, raw.data, kind, ident, motion, 0)
        value = motion[:3] if name.startswith("angular") else motion[3:]
    elif name == "friction":
        value = [raw.model.geom_friction[raw.model.body(body).geomadr[0], 0]]
    elif name == "mass":
        value = raw.model.body(body).mass
    elif name == "goal_xx, goal_xy, goal_xz, goal_yx, goal_yy, goal_yz":
        value = raw.goal().T[:2].ravel()
    elif name == "angle_to_goal":
        value = [math.acos((np.trace(raw.goal().T @ raw.rotation(features.link)) - 1) / 2)]
    elif name == "distance":
        assert features.note == "at most 1 m"
        value = [min(1.0, raw.signed_distance(place, body)) for place, _ in raw.probes(features)]
    else:
        assert name == "depth" and features.note == "0 while the solver has no contact of link and object"
        is_touched = bool(raw.contacts(features.link, body))
        value = [is_touched * max(0.0, radius - raw.signed_distance(place, body)) for place, radius in raw.probes(features)]
    return features.scale * np.asarray(value)


@pytest.mark.parametrize("name", TASKS)
def test_an_observation_can_be_rebuilt_from_its_description(tmp_path, name):
    make, more = TASKS[name]
    env = make(tmp_path, 1, overrides=PLAIN | more)
    generator, description, body = torch.Generator().manual_seed(0), env.describe(), env.task.setup.object
    data = mujoco.MjData(env.sim.env_model(0))
    data.qpos[:] = env.sim.qpos[0].numpy()
    mujoco.mj_kinematics(env.sim.env_model(0), data)
    start, nonzero_names = data.body(body).xmat.reshape(3, 3).copy(), set()
    for step in range(40):
        action = 0.6 * torch.rand((1, env.num_actions), generator=generator) - 0.3
        if name == "in_palm_rotate":
            env.sim.qpos[0, 3:6] = torch.tensor([0.0255, 0.0, RADIUS])  # 0.5 mm in the right plate
        state_before = {name: env.sim.arrays[name][0].clone().numpy() for name in GIVEN}
        result = env.step(action)
        assert not result.info.ended
        if step < 10 or step % 6:
            continue
        state_after = {name: env.sim.arrays[name][0].numpy() for name in ("ctrl", "qfrc_applied", "xfrc_applied")}
        raw = Raw(env, state_before | state_after, action[0].numpy(), start)
        for group, parts in description.items():
            assert parts[-1][0].stop == env.groups[group]
            for place, features in parts:
                value = result.obs[group][0, place].numpy()
                expected = rebuild(raw, features, body)
                scale = max(1.0, float(np.abs(expected).max()))
                np.testing.assert_allclose(value, expected, rtol=0, atol=1e-6 * scale, err_msg=f"{group}: {features}")
                nonzero_names |= {features.name} if np.abs(value).max() > 0 else set()
    assert {"depth", "distance", "force_x, force_y, force_z"} <= nonzero_names
    env.close()


def test_partial_readings_of_a_sensor_are_described(tmp_path):
    touches = [
        PolicyTouch("agg_force", "left", "clean"),
        PolicyTouch("force", "right", "clean"),
        PolicyTouch("agg_bool", "hand", "clean"),
    ]
    env = tiny_env(tmp_path, 1, touches=[*touches, PolicyTouch("force", "left", "clean")])
    force, taxel_forces, bits = (env.describe()[touch.group] for touch in touches)
    sums = [(f"sum of depth times normal, {axis}", "left", 1e4, 1) for axis in "zyx"]
    assert [(each.name, each.link, each.scale, each.size) for _, each in force] == sums
    names = [(f"force_{axis}", "right", range(2, 4)) for axis in "xyz"]
    assert [(each.name, each.link, each.rows) for _, each in taxel_forces] == names
    assert [(each.link, each.name) for _, each in bits] == [
        (link, "contact of more than 2 taxels") for link in ("left", "right")
    ]
    env.close()


def test_stacked_readings_are_described_separately(tmp_path):
    env = tiny_env(tmp_path, 1, more="touch: depth\nsensors: {depth: {history: 2}}\n")
    parts = env.describe()["tactile_sensors"]
    names = [(f"depth of call {call}", link) for call in (0, 1) for link in ("left", "right")]
    assert [(each.name, each.link) for _, each in parts] == names and parts[-1][0].stop == env.groups["tactile_sensors"]
    env.close()


def test_descriptions_print_units_and_mark_undescribed_groups(tmp_path):
    (tmp_path / "own.py").write_text(
        "from tgdsl.rl.terms import ObservationTerm\nclass Own(ObservationTerm):\n"
        "    def observe(self, now, setup):\n        return now.joint_pos\n"
    )
    env = tiny_env(tmp_path, 1, more='terms: {mine: {term: "own.py:Own"}}\ntemporal: stack\ntouch: depth\n')
    text = repr(env.describe())
    assert re.search(r"mine +0:2 +not described", text)
    assert re.search(r"proprio +2:3 +velocity of left +rad/s", text)
    assert re.search(r"tactile_sensors +0:2 +depth of physics step 0, rows 0:2 of depth +m +– +left +1 ", text)
    assert re.search(r"tactile_sensors +18:20 +depth of physics step 4, rows 2:4 of depth +m +– +right +1 ", text)
    env.close()
