"""Children welded to a link, without taxels, are part of the link: their contacts count as the link's."""

import mujoco
import numpy as np
import pytest
import torch
from pressed_pads import LOAD, MODELS, PAD, RESTING, G, compiled, of_kinds, pressed, simulated
from warp_cases import CONTACTS, MOVING_FORCE, assert_agree, warp
from welded_links import (
    FIXED,
    FLAP,
    FORCE,
    GATED,
    HINGED,
    ITEM,
    ITEMS,
    NAMES,
    ON_SKIN,
    POINTS,
    SKIN,
    UNNAMED,
    gripped,
    hand,
    parts,
    solved,
)

import tgdsl
from tgdsl.errors import RobotError, SimulationError, SpecError
from tgdsl.plan.inputs import ContactPart
from tgdsl.runtime.batch.simulation import BatchSimulation

# What a link is


@pytest.mark.slow
@pytest.mark.parametrize(
    ("which", "name"),
    [("mujoco", 'name="skin"'), ("mujoco", ""), ("warp", "")],
    ids=["mujoco-named", "mujoco-unnamed", "warp-unnamed"],
)
def test_an_object_on_a_welded_child_presses_the_link(tmp_path, which, name):
    """A box of 0.3 kg on a pad's skin: every kind that reads forces reads its weight, every gate is open."""
    touch = compiled(tmp_path, ON_SKIN, ITEMS, of_kinds(["item"]) | GATED, pad=SKIN.format(name=name))
    assert touch.inputs.link_parts == {"pad": (ContactPart("subtree", "pad"),)}
    assert "contacts with pad are those on subtree pad" in touch.explain()
    sim = simulated(touch, which, substeps=250)
    sim.step()
    readings = touch(sim.state())
    for kind in of_kinds([]):
        assert -float(readings[kind][0, :, 2].sum()) == pytest.approx(LOAD, rel=RESTING)
    for kind in GATED:
        assert readings[kind].any(), kind


@pytest.mark.parametrize("names", [NAMES, UNNAMED], ids=["named", "unnamed"])
def test_a_link_has_the_contacts_of_its_whole_rigid_body(tmp_path, names):
    """MuJoCo's forces on core, skin and nail, and their moments about the finger's origin, in its frame."""
    touch = gripped(tmp_path, hand(**names))
    assert touch.inputs.link_parts == {"finger": (ContactPart("subtree", "finger"),)}
    sim = tgdsl.simulate(touch, 1)
    origin, rotation, contacts = solved(sim, ("core", "skin", "nail"))
    skin_forces = [force for _, force, _ in solved(sim, ("skin", "nail"))[2]]
    assert len(contacts) > len(skin_forces) > 1 and np.linalg.norm(sum(skin_forces)) > 0.1
    state = sim.state()
    force = rotation.T @ sum(force for _, force, _ in contacts)
    moment = rotation.T @ sum(np.cross(pos - origin, force) + torque for pos, force, torque in contacts)
    assert state.contact_found == len(contacts)
    readings = touch(state)
    np.testing.assert_allclose(readings["link"][0, 0], force, rtol=0, atol=1e-9)
    total = readings["shared"][0].sum(dim=0) + readings["shared/missed"][0, 0]
    np.testing.assert_allclose(total, force, rtol=0, atol=1e-9)
    arms = np.array([point["pos"] for point in POINTS])
    moment_of_taxels = np.cross(arms, readings["shared"][0].numpy()).sum(axis=0)
    assert readings["shared/missed"].norm() < 1e-12, "else its moment is not known"
    np.testing.assert_allclose(moment_of_taxels + readings["shared/residual"][0, 0].numpy(), moment, rtol=0, atol=1e-9)


def test_readings_equal_those_with_all_geoms_in_one_body(tmp_path):
    """The skin's geoms as a child body, or in a frame of the finger's body: every kind reads the same numbers.

    The hand is fixed to the world: MuJoCo uses the inverse weight of each moving body, which would change the forces.
    """
    welded = gripped(tmp_path, hand(**FIXED))
    merged = gripped(tmp_path, hand(welded="frame", **FIXED))
    assert merged.inputs.link_parts == {}
    welded_sim, merged_sim = tgdsl.simulate(welded, 1), tgdsl.simulate(merged, 1)
    readings, merged_readings = welded(welded_sim.state()), merged(merged_sim.state())
    assert (
        readings.keys() == merged_readings.keys() and welded_sim.state().contact_found == merged_sim.state().contact_found > 4
    )
    for name in readings:
        torch.testing.assert_close(readings[name], merged_readings[name], rtol=0, atol=1e-12, msg=name)


def test_a_jointed_child_is_no_part_of_the_link(tmp_path):
    """Next to a jointed child, the parts are named one by one; the tip's contacts stay the tip's."""
    touch = gripped(tmp_path, hand(more=HINGED), sensors={"s": {"links": "finger", **FORCE}})
    assert touch.inputs.link_parts == {"finger": parts("finger", "skin", "nail")}
    sim = tgdsl.simulate(touch, 1)
    _, rotation, contacts = solved(sim, ("core", "skin", "nail"))
    assert np.linalg.norm(sum(force for _, force, _ in solved(sim, ("tip",))[2])) > 0.1
    force = rotation.T @ sum(force for _, force, _ in contacts)
    np.testing.assert_allclose(touch(sim.state())["s"][0, 0], force, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_a_child_with_taxels_is_a_separate_link(tmp_path, which):
    """Bodies welded to the child are the child's parts; each sensor reads the force on its own link."""
    sensors = {name: {"links": name, **FORCE} for name in ("finger", "skin")}
    touch = gripped(tmp_path, hand(), sensors=sensors, layout=["finger", "skin"])
    assert touch.inputs.link_parts == {"skin": parts("skin", kind="subtree")}
    sim = simulated(touch, which)
    readings = touch(sim.state())
    forces = [sum(force for _, force, _ in solved(sim, geoms)[2]) for geoms in (("core",), ("skin", "nail"))]
    for name, force in zip(sensors, forces, strict=True):
        assert np.linalg.norm(force) > 0.1
        norm = float(readings[name].norm())
        assert norm == pytest.approx(np.linalg.norm(force), rel=1e-9 if which == "mujoco" else 1e-3)


def test_a_parents_sensor_does_not_read_a_child_with_taxels(tmp_path):
    """With or without a sensor on the child: a reading does not depend on the rest of the document."""
    sensors = {name: {"links": name, **of_kinds(["item"])["balanced"]} for name in ("finger", "skin")}
    alone = gripped(tmp_path, hand(), sensors={"finger": sensors["finger"]}, layout=["finger", "skin"])
    both = gripped(tmp_path, hand(), sensors=sensors, layout=["finger", "skin"])
    assert alone.inputs.link_parts == {} and "link skin: no sensor is on it" in alone.explain()
    readings = both(tgdsl.simulate(both, 1).state())
    assert torch.equal(alone(tgdsl.simulate(alone, 1).state())["finger"], readings["finger"])
    assert readings["finger"].any() and readings["skin"].any()


def test_a_child_that_is_an_object_is_that_object(tmp_path):
    touch = gripped(tmp_path, hand(), {**ITEMS, "skin": {"body": "skin"}}, {"s": {"links": "finger", **FORCE}})
    assert touch.inputs.link_parts == {}
    sim = tgdsl.simulate(touch, 1)
    _, rotation, contacts = solved(sim, ("core",))
    force = rotation.T @ sum(force for _, force, _ in contacts)
    np.testing.assert_allclose(touch(sim.state())["s"][0, 0], force, rtol=0, atol=1e-9)


def test_a_visual_child_is_no_part_of_the_link(tmp_path):
    """Its geoms do not collide, so they have no contacts."""
    text = SKIN.format(name="").replace('name="skin"', 'contype="0" conaffinity="0"')
    touch = compiled(tmp_path, ON_SKIN, ITEMS, of_kinds(["item"]), pad=text)
    assert touch.inputs.link_parts == {}


def test_a_link_may_collide_through_its_children_only(tmp_path):
    """The body's geoms do not collide: a contact on the skin opens the gate, and the depth is the link's."""
    text = SKIN.format(name='name="skin"').replace('name="pad" type', 'name="pad" contype="0" conaffinity="0" type')
    touch = compiled(tmp_path, ON_SKIN, ITEMS, GATED, pad=text)
    bare = compiled(tmp_path, ON_SKIN, ITEMS, GATED)
    assert touch.inputs.pairs == bare.inputs.pairs and len(touch.inputs.pairs) == 1
    state = tgdsl.simulate(touch, 1).state()
    assert state.contact_found == 4
    readings, expected = touch(state), bare(state)
    for name in GATED:
        assert torch.equal(readings[name], expected[name]) and readings[name].any()


def test_unnamed_parts_next_to_a_hinge_must_be_named(tmp_path):
    """Next to a hinge, MuJoCo's sensors must name the skin's body or geoms; unnamed, its contacts would go unread."""
    sensors = {"s": {"links": "finger", **FORCE}}
    touch = gripped(tmp_path, hand(more=HINGED, **UNNAMED), sensors=sensors)
    assert touch.inputs.link_parts == {"finger": (*parts("finger"), *parts("skin", "nail", kind="geom"))}
    sim = tgdsl.simulate(touch, 1)
    _, rotation, contacts = solved(sim, ("core", "skin", "nail"))
    force = rotation.T @ sum(force for _, force, _ in contacts)
    np.testing.assert_allclose(touch(sim.state())["s"][0, 0], force, rtol=0, atol=1e-9)
    bare = hand(more=HINGED, **UNNAMED).replace('name="nail" type', "type")
    with pytest.raises(
        SpecError, match=r'sensors\.s\.links: body "finger" and bodies welded to it: unnamed sphere geom'
    ) as error:
        gripped(tmp_path, bare, sensors=sensors)
    assert "name it, or its body, in the scene" in str(error.value)
    gripped(tmp_path, bare, sensors={"s": {"kind": "contact_depth", "links": "finger", "feels": ["item"], "gate": "geometric"}})


# Parts of links and of objects


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_parts_of_link_and_object_share_the_slots(tmp_path, which):
    """Three parts of the link, two of the object: each contact counts once, and their total force is exact."""
    text = hand(more=HINGED).replace("</body>\n</worldbody>", f"{FLAP}</body>\n</worldbody>")
    for slots, warned in ((16, ()), (5, ("item",))):
        touch = gripped(
            tmp_path, text, sensors={"s": {"links": "finger", "kind": "force_taxel", "feels": ["item"], "slots": slots}}
        )
        assert touch.inputs.contacts_of == {"item": parts("item", "handle")}
        (pair,) = touch.inputs.pairs
        assert len(touch.inputs.touching(pair)) == 6
        sim = simulated(touch, which)
        _, _, contacts = solved(sim, ("core", "skin", "nail"))
        state = sim.state()
        assert state.contact_found == len(contacts) and 5 < len(contacts) < 16
        total, tolerance = sum(force for _, force, _ in contacts), 1e-9 if which == "mujoco" else 2e-3
        np.testing.assert_allclose(state.contact_netforce[0, 0], total, rtol=0, atol=tolerance)
        shown_pos = state.contact_pos[0, 0, : min(slots, len(contacts))].double()
        distances = torch.cdist(shown_pos, torch.tensor(np.stack([pos for pos, _, _ in contacts])))
        assert distances.amin(dim=1).max() < 1e-6 and len(set(distances.argmin(dim=1).tolist())) == len(shown_pos)
        if warned:
            with pytest.warns(UserWarning, match="contacts of finger – item are more than `slots: 5`"):
                readings = touch(state)
        else:
            readings = touch(state)
        taxel_force = readings["s"][0].sum(dim=0) + readings["s/missed"][0, 0]
        np.testing.assert_allclose(taxel_force.norm(), np.linalg.norm(total), rtol=0, atol=tolerance)


@pytest.mark.parametrize("which", MODELS)
def test_two_fingers_that_touch_read_opposite_forces(tmp_path, which):
    """Each finger, with its welded tip, is a link and the other's object; the forces are MuJoCo's."""
    finger = """<body name="{0}" pos="{1} 0 0">{2}<geom name="{0}" type="box" size=".01 .01 .01" mass=".1"/>
      <body name="{0}_tip" pos="0 0 .02" euler="0 0 {3}"><geom name="{0}_tip" type="box" size=".0{4} .01 .01" mass=".1"/></body></body>"""
    slide = '<joint type="slide" axis="1 0 0"/>'
    text = finger.format("index", 0, "", 0, "102") + finger.format("thumb", 0.019, slide, 90, "1")
    (tmp_path / "hand.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    both = {"index": "thumb", "thumb": "index"}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "hand.xml"), "layout": {"resolutions": {"r": dict.fromkeys(both, points)}}},
        "objects": {name: {"body": name} for name in both},
        "sensors": {link: {**FORCE, "links": link, "feels": [other]} for link, other in both.items()},
    }
    touch = tgdsl.compile(document, dtype=torch.float64)
    assert touch.inputs.link_parts == {name: parts(name, kind="subtree") for name in both} == touch.inputs.contacts_of
    sim = simulated(touch, which)
    data = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, data)
    pairs = {tuple(sorted(sim.model.geom(g).name for g in contact.geom)) for contact in data.contact}
    assert ("index_tip", "thumb_tip") in pairs
    # The thumb slides along x, and only the index acts on it there: the force is mass times acceleration.
    force = {"thumb": 0.2 * data.qacc[0], "index": -0.2 * data.qacc[0]}
    readings = touch(sim.state())
    for name in both:
        assert abs(force[name]) > 0.5
        assert float(readings[name][0, 0, 0]) == pytest.approx(force[name], rel=1e-9 if which == "mujoco" else 1e-3)


# Gaps, stages, variants and users' models


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_the_gap_of_a_welded_geom_is_no_contact(tmp_path, which):
    """2 mm above a skin with a gap of 5 mm, MuJoCo reports contacts without force: gates stay shut."""
    text = SKIN.format(name='name="skin"').replace('name="skin" type', 'name="skin" gap=".005" type')
    touch = compiled(tmp_path, ITEM.format(z=".032"), ITEMS, of_kinds(["item"]) | GATED, pad=text)
    sim = simulated(touch, which, substeps=250)
    assert not sim.state().contact_found.any() and not any(reading.any() for reading in touch(sim.state()).values())
    sim.step()
    state = sim.state()
    assert state.contact_found == 4 and -float(state.contact_netforce[0, 0, 2]) == pytest.approx(LOAD, rel=RESTING)


def test_fixed_joints_of_a_stage_weld_a_link(tmp_path):
    """The same pad in USD, with the skin as a rigid body on a fixed joint: the box presses with its weight."""
    touch = compiled(tmp_path, ON_SKIN, ITEMS, of_kinds(["item"]), pad=SKIN.format(name='name="skin"'), as_usd=True)
    assert touch.inputs.link_parts == {"pad": parts("pad", kind="subtree")}
    assert pressed(touch, "mujoco") == {name: pytest.approx(LOAD, rel=RESTING) for name in of_kinds([])}


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_variants_press_a_welded_child(tmp_path, which):
    """Boxes of 0.1 and 0.2 kg: each environment reads its own."""
    variants = [{"type": "box", "size": [0.02, 0.02, 0.02], "density": density} for density in (1562.5, 3125)]
    objects = {"item": {"body": "item", "variants": variants}}
    touch = compiled(tmp_path, ON_SKIN, objects, of_kinds(["item"]), pad=SKIN.format(name='name="skin"'))
    sim = simulated(touch, which, num_envs=2, substeps=250)
    sim.step()
    for kind, reading in touch(sim.state()).items():
        if "/" not in kind:
            np.testing.assert_allclose(-reading[:, :, 2].sum(dim=1), [0.1 * G, 0.2 * G], rtol=1e-3)


def test_instrument_adds_the_sensors_of_parts_to_a_users_model(tmp_path):
    """Instrumented for a loaded plan, it reads what the artefact's scene reads; an error names a missing body."""
    text = hand(more=HINGED)
    tgdsl.save(gripped(tmp_path, text), tmp_path / "module.safetensors")
    touch = tgdsl.load(tmp_path / "module.safetensors", dtype=torch.float64)
    assert touch.inputs.parts_of_link("finger") == parts("finger", "skin", "nail")
    assert "contacts with finger are those on body finger, body skin, body nail" in touch.explain()
    model = tgdsl.instrument(mujoco.MjSpec.from_string(text), touch.inputs).compile()
    sim = BatchSimulation(touch, 1, model=model)
    readings = touch(sim.state())
    sim.close()
    sim = tgdsl.simulate(touch, 1)
    for name, reading in touch(sim.state()).items():
        assert torch.equal(reading, readings[name]), name
    assert readings["link"].any()
    sim.close()
    spec = mujoco.MjSpec.from_string(text)
    spec.body("nail").name = "claw"
    with pytest.raises(RobotError, match='this model has no body "nail", which the module wants contacts of'):
        tgdsl.instrument(spec, touch.inputs)
    with pytest.raises(SimulationError, match='the scene has no body "nail"'):
        warp(touch, 1, model=spec.compile())


@pytest.mark.parametrize("more", ["", HINGED], ids=["one", "three"])
def test_warp_agrees_with_mujocos_sensors(tmp_path, more):
    """A link of one part and of three: every contact field and every reading, to the accuracy of float32."""
    touch = gripped(tmp_path, hand(more=more))
    cpu = tgdsl.simulate(touch, 1)
    expected = cpu.state()
    readings = touch(expected)
    cpu.close()
    sim = simulated(touch, "warp")
    assert_agree(sim.state(), expected, CONTACTS, MOVING_FORCE)
    warp_readings = touch(sim.state())
    for name, reading in readings.items():
        scale = max(float(reading.abs().max()), 0.01)  # of missed forces only rounding remains
        torch.testing.assert_close(warp_readings[name].double(), reading, rtol=0, atol=2e-3 * scale, msg=name)


def test_a_scene_may_weld_a_body_to_a_link(tmp_path):
    """A sleeve that is missing from the robot's file is part of the link that it is welded to."""
    (tmp_path / "robot.xml").write_text(f"<mujoco><worldbody>{PAD}</worldbody></mujoco>")
    pad = SKIN.format(name='name="sleeve"')
    (tmp_path / "scene.xml").write_text(f"<mujoco><worldbody>{pad}{ON_SKIN}</worldbody></mujoco>")
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "robot.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
        "scene": {"model": str(tmp_path / "scene.xml")},
        "objects": ITEMS,
        "sensors": {"s": {"links": "pad", **FORCE}},
    }
    touch = tgdsl.compile(document, dtype=torch.float64)
    assert touch.inputs.link_parts == {"pad": parts("pad", kind="subtree")} and "left out" not in touch.explain()
    assert float(touch(tgdsl.simulate(touch, 1).state())["s"][0, 0, 2]) < -0.1
