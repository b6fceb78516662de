"""Fields of a state from arrays of any engine: contacts against a loop over them, velocities against MuJoCo's."""

import re
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from warp_cases import module

import tgdsl
from tgdsl.errors import SimulationError
from tgdsl.plan.inputs import ContactPart, Inputs
from tgdsl.quantities.pairs import Pair

FIELDS = ("contact_found", "contact_pos", "contact_normal", "contact_force", "contact_torque", "contact_netforce")
INPUTS = Inputs(
    fields=FIELDS,
    bodies=("palm", "tip", "box"),
    # A link that is also an object, an object with two names, one with a child body, and one that is a single geom.
    pairs=(Pair("palm", "box"), Pair("palm", "same"), Pair("tip", "box"), Pair("tip", "palm"), Pair("palm", "knob")),
    bodies_of={"box": "box", "same": "box", "palm": "palm", "knob": "box"},
    slots=2,
    contacts_of={
        "box": (ContactPart("subtree", "box"),),
        "same": (ContactPart("subtree", "box"),),
        "knob": (ContactPart("geom", "knob"),),
    },
)
GEOMS = tgdsl.Geoms(
    bodies=("world", "a/palm", "a/palm/tip", "a/box", "a/box/lid"),
    names=("floor", "g1", "g2", "a/knob", "g4"),
    parents=(("a/palm", "world"), ("a/palm/tip", "a/palm"), ("a/box", "world"), ("a/box/lid", "a/box")),
)
OBJECTS = {"box": {3, 4}, "same": {3, 4}, "palm": {1}, "knob": {3}}
LINKS = {"palm": {1}, "tip": {2}}


def random_contacts(num, num_envs, seed=0) -> dict[str, Any]:
    rng = torch.Generator().manual_seed(seed)
    vectors = {name: torch.randn(num, 3, generator=rng, dtype=torch.float64) for name in ("pos", "normal", "force", "torque")}
    vectors["force"][::5] = 0.0  # no contacts
    pairs = torch.randint(-1, 5, (num, 2), generator=rng)
    return {"pairs": pairs, **vectors, "env": torch.randint(num_envs, (num,), generator=rng)}


def by_loop(contacts, num_envs, force_on) -> dict[str, np.ndarray]:
    """Return the fields by their definitions, contact by contact."""
    fields = {name: np.zeros((num_envs, 5, 2, 3)) for name in FIELDS}
    fields |= {"contact_found": np.zeros((num_envs, 5)), "contact_netforce": np.zeros((num_envs, 5, 3))}
    values = {name: value.numpy() for name, value in contacts.items()}
    for i, (first, second) in enumerate(values["pairs"]):
        if not values["force"][i].any():
            continue
        for p, pair in enumerate(INPUTS.pairs):
            for target, link, sign in ((first, second, 1.0), (second, first, -1.0)):
                if target not in OBJECTS[pair.object] or link not in LINKS[pair.link]:
                    continue
                env = values["env"][i]
                force_sign = sign if force_on == 2 else -sign
                slot = int(fields["contact_found"][env, p])
                fields["contact_found"][env, p] += 1
                fields["contact_netforce"][env, p] += force_sign * values["force"][i]
                if slot < 2:
                    fields["contact_pos"][env, p, slot] = values["pos"][i]
                    fields["contact_normal"][env, p, slot] = sign * values["normal"][i]
                    fields["contact_force"][env, p, slot] = force_sign * values["force"][i]
                    fields["contact_torque"][env, p, slot] = force_sign * values["torque"][i]
    return fields


@pytest.mark.parametrize("force_on", [1, 2])
def test_contacts_by_pair_agrees_with_a_loop(force_on):
    contacts = random_contacts(200, 3)
    fields = tgdsl.contacts_by_pair(INPUTS, GEOMS, **contacts, num_envs=3, force_on=force_on)
    expected = by_loop(contacts, 3, force_on)
    assert (expected["contact_found"] > 2).any() and set(fields) == set(FIELDS)
    for name, value in expected.items():
        np.testing.assert_allclose(fields[name], value, atol=1e-12, err_msg=name)


def test_no_contacts_leave_all_slots_empty():
    fields = tgdsl.contacts_by_pair(INPUTS, GEOMS, **random_contacts(0, 2), num_envs=2)
    assert fields["contact_pos"].shape == (2, 5, 2, 3)
    assert not any(value.any() for value in fields.values())


def test_is_contact_selects_rows():
    contacts = random_contacts(50, 1)
    is_contact = torch.arange(50) % 3 == 0
    chosen_contacts = {name: value[is_contact] for name, value in contacts.items()}
    all_rows = torch.ones(len(chosen_contacts["pos"]), dtype=torch.bool)
    fields = tgdsl.contacts_by_pair(INPUTS, GEOMS, **contacts, is_contact=is_contact)
    expected = tgdsl.contacts_by_pair(INPUTS, GEOMS, **chosen_contacts, is_contact=all_rows)
    assert all(torch.equal(fields[name], expected[name]) for name in FIELDS)


def test_missing_or_ambiguous_geoms_are_refused():
    contacts = random_contacts(1, 1)
    for geoms, message in (
        (
            GEOMS._replace(bodies=("world", "a/plam", "a/tip", "a/box", "a/box/lid"), parents=GEOMS.parents[2:]),
            'no body "palm"',
        ),
        (GEOMS._replace(names=("floor", "g1", "g2", "b/knob", "c/knob")), '"knob" may be any of the geoms b/knob, c/knob'),
        (GEOMS._replace(parents=()), 'the contacts of "box" include bodies below it: Geoms needs `parents`'),
    ):
        with pytest.raises(SimulationError, match=re.escape(message)):
            tgdsl.contacts_by_pair(INPUTS, geoms, **contacts)


def test_velocities_of_centres_of_mass_are_moved_to_the_origin(tmp_path):
    touch = module(tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] += np.random.default_rng(0).normal(size=model.nq, scale=0.2)
    data.qvel[:] = np.random.default_rng(1).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    twists = np.zeros((model.nbody, 6))
    for i in range(model.nbody):  # at the centre of mass
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, i, twists[i], 0)
    fields = tgdsl.bodies_by_name(
        touch.inputs,
        [f"env/{model.body(i).name}" for i in range(1, model.nbody)],
        *(torch.tensor(values[None, 1:]) for values in (data.xpos, data.xquat[:, [1, 2, 3, 0]], twists[:, 3:], twists[:, :3])),
        quat_order="xyzw",
        linvel_at=torch.tensor(model.body_ipos[1:]),
    )
    expected = tgdsl.read_mujoco(touch, model, data)
    assert {"body_linvel", "body_angvel"} <= fields.keys()
    for name, value in fields.items():
        np.testing.assert_allclose(value, getattr(expected, name), atol=1e-12, err_msg=name)


def test_an_unlisted_world_body_is_at_rest():
    inputs = Inputs(("body_pos", "body_quat", "body_linvel", "body_angvel"), ("box", "world"), (), {}, 0)
    ones = torch.ones(2, 1, 3)
    fields = tgdsl.bodies_by_name(inputs, ["box"], ones, torch.tensor([0.0, 1.0, 0.0, 0.0]).expand(2, 1, 4), ones, ones)
    assert fields["body_quat"][:, 1].tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2
    assert not any(fields[name][:, 1].any() for name in ("body_pos", "body_linvel", "body_angvel"))
    assert fields["body_pos"][:, 0].tolist() == [[1.0] * 3] * 2


def test_bodies_of_one_name_are_refused():
    inputs, poses = Inputs(("body_pos",), ("box",), (), {}, 0), torch.zeros(1, 2, 4)
    with pytest.raises(SimulationError, match=re.escape('the scene has 2 bodies "a/box"; give each a unique name')):
        tgdsl.bodies_by_name(inputs, ["a/box", "a/box"], poses[..., :3], poses)
    with pytest.raises(SimulationError, match="this module reads body_linvel, expected all arguments"):
        tgdsl.bodies_by_name(Inputs(("body_linvel",), ("box",), (), {}, 0), ["box"], poses[:, :1, :3], poses[:, :1])
    with pytest.raises(SimulationError, match="linvel_at is given without angvel"):
        tgdsl.bodies_by_name(inputs, ["box"], *[poses[:, :1, :3], poses[:, :1], poses[:, :1, :3]], linvel_at=poses[:, :1, :3])
