"""What is welded to a link from below, and carries no taxels, is part of the link: contacts on it are the link's."""

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
def test_what_rests_on_a_welded_child_presses_the_link(tmp_path, which, name):
    """A box of 0.3 kg on the skin of a pad: every kind that reads forces reads its weight, every gate is open."""
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
def test_contacts_are_those_of_the_whole_rigid_body(tmp_path, names):
    """In the finger's frame, about its origin: MuJoCo's forces on core, skin and nail, and their moments."""
    touch = gripped(tmp_path, hand(**names))
    assert touch.inputs.link_parts == {"finger": (ContactPart("subtree", "finger"),)}
    sim = tgdsl.simulate(touch, 1)
    origin, rotation, contacts = solved(sim, ("core", "skin", "nail"))
    of_skin = [force for _, force, _ in solved(sim, ("skin", "nail"))[2]]
    assert len(contacts) > len(of_skin) > 1 and np.linalg.norm(sum(of_skin)) > 0.1
    state = sim.state()
    force = rotation.T @ sum(force for _, force, _ in contacts)
    moment = rotation.T @ sum(np.cross(pos - origin, force) + torque for pos, force, torque in contacts)
    assert state.contact_found == len(contacts)
    readings = touch(state)
    np.testing.assert_allclose(readings["link"][0, 0], force, rtol=0, atol=1e-9)
    whole = readings["shared"][0].sum(dim=0) + readings["shared/missed"][0, 0]
    np.testing.assert_allclose(whole, force, rtol=0, atol=1e-9)
    arms = np.array([point["pos"] for point in POINTS])
    given = np.cross(arms, readings["shared"][0].numpy()).sum(axis=0)
    assert readings["shared/missed"].norm() < 1e-12, "else its moment is not known"
    np.testing.assert_allclose(given + readings["shared/residual"][0, 0].numpy(), moment, rtol=0, atol=1e-9)


def test_readings_are_those_of_the_same_geoms_in_one_body(tmp_path):
    """The skin's geoms in the finger's own body, in a frame where there was a child: the same numbers, whatever the kind.

    The hand is fixed to the world: of bodies that move MuJoCo takes each one's own inverse weight, so that forces differ.
    """
    welded = gripped(tmp_path, hand(**FIXED))
    merged = gripped(tmp_path, hand(welded="frame", **FIXED))
    assert merged.inputs.link_parts == {}
    apart, one = tgdsl.simulate(welded, 1), tgdsl.simulate(merged, 1)
    own, other = welded(apart.state()), merged(one.state())
    assert own.keys() == other.keys() and apart.state().contact_found == one.state().contact_found > 4
    for name in own:
        torch.testing.assert_close(own[name], other[name], rtol=0, atol=1e-12, msg=name)


def test_a_jointed_child_is_none_of_it(tmp_path):
    """With one, the parts are named one by one; the tip's contacts are the tip's own."""
    touch = gripped(tmp_path, hand(more=HINGED), sensors={"s": {"links": "finger", **FORCE}})
    assert touch.inputs.link_parts == {"finger": parts("finger", "skin", "nail")}
    sim = tgdsl.simulate(touch, 1)
    _, rotation, contacts = solved(sim, ("core", "skin", "nail"))
    assert np.linalg.norm(sum(force for _, force, _ in solved(sim, ("tip",))[2])) > 0.1
    force = rotation.T @ sum(force for _, force, _ in contacts)
    np.testing.assert_allclose(touch(sim.state())["s"][0, 0], force, rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_a_child_with_taxels_is_a_link_of_its_own(tmp_path, which):
    """And what is welded to the child is the child's: each sensor reads its own link's force, wherever the other one is."""
    on = {name: {"links": name, **FORCE} for name in ("finger", "skin")}
    touch = gripped(tmp_path, hand(), sensors=on, layout=["finger", "skin"])
    assert touch.inputs.link_parts == {"skin": parts("skin", kind="subtree")}
    sim = simulated(touch, which)
    readings = touch(sim.state())
    forces = [sum(force for _, force, _ in solved(sim, own)[2]) for own in (("core",), ("skin", "nail"))]
    for name, force in zip(on, forces, strict=True):
        assert np.linalg.norm(force) > 0.1
        found = float(readings[name].norm())
        assert found == pytest.approx(np.linalg.norm(force), rel=1e-9 if which == "mujoco" else 1e-3)


def test_a_sensor_on_the_parent_alone_does_not_read_a_child_with_taxels(tmp_path):
    """Whether another sensor is on the child or not: a reading does not depend on what else the document has."""
    on = {name: {"links": name, **of_kinds(["item"])["balanced"]} for name in ("finger", "skin")}
    alone = gripped(tmp_path, hand(), sensors={"finger": on["finger"]}, layout=["finger", "skin"])
    both = gripped(tmp_path, hand(), sensors=on, layout=["finger", "skin"])
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


def test_a_child_that_is_only_seen_changes_nothing(tmp_path):
    """Geoms that do not collide have no contacts, so the link is its body alone."""
    text = SKIN.format(name="").replace('name="skin"', 'contype="0" conaffinity="0"')
    touch = compiled(tmp_path, ON_SKIN, ITEMS, of_kinds(["item"]), pad=text)
    assert touch.inputs.link_parts == {}


def test_a_link_may_touch_with_its_children_alone(tmp_path):
    """A body whose own geoms do not collide: its gate opens when its skin is touched, its depth is its own."""
    text = SKIN.format(name='name="skin"').replace('name="pad" type', 'name="pad" contype="0" conaffinity="0" type')
    touch = compiled(tmp_path, ON_SKIN, ITEMS, GATED, pad=text)
    bare = compiled(tmp_path, ON_SKIN, ITEMS, GATED)
    assert touch.inputs.pairs == bare.inputs.pairs and len(touch.inputs.pairs) == 1
    state = tgdsl.simulate(touch, 1).state()
    assert state.contact_found == 4
    readings, others = touch(state), bare(state)
    for name in GATED:
        assert torch.equal(readings[name], others[name]) and readings[name].any()


def test_geoms_that_cannot_be_named_are_asked_for_names(tmp_path):
    """Beside a hinge MuJoCo's sensors must name the skin's body, or its geoms; without names its contacts would go unread."""
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
def test_parts_of_both_share_the_slots(tmp_path, which):
    """Three parts of the link, two of the object: all contacts are counted, each once, and their force is exact."""
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
        shown = state.contact_pos[0, 0, : min(slots, len(contacts))].double()
        apart = torch.cdist(shown, torch.tensor(np.stack([pos for pos, _, _ in contacts])))
        assert apart.amin(dim=1).max() < 1e-6 and len(set(apart.argmin(dim=1).tolist())) == len(shown)
        if warned:
            with pytest.warns(UserWarning, match="contacts of finger – item are more than `slots: 5`"):
                readings = touch(state)
        else:
            readings = touch(state)
        whole = readings["s"][0].sum(dim=0) + readings["s/missed"][0, 0]
        np.testing.assert_allclose(whole.norm(), np.linalg.norm(total), rtol=0, atol=tolerance)


@pytest.mark.parametrize("which", MODELS)
def test_two_fingers_that_touch_each_other(tmp_path, which):
    """Each is a link to itself and an object to the other, welded tips and all: forces are opposite, MuJoCo's own."""
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
    # The thumb slides along x and nothing else acts on it there, so what the index exerts is what its inertia takes.
    force = {"thumb": 0.2 * data.qacc[0], "index": -0.2 * data.qacc[0]}
    readings = touch(sim.state())
    for name in both:
        assert abs(force[name]) > 0.5
        assert float(readings[name][0, 0, 0]) == pytest.approx(force[name], rel=1e-9 if which == "mujoco" else 1e-3)


# Seams


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_a_gap_of_a_welded_geom_is_no_contact(tmp_path, which):
    """2 mm above a skin with a gap of 5 mm, MuJoCo reports contacts that carry nothing: gates stay shut."""
    text = SKIN.format(name='name="skin"').replace('name="skin" type', 'name="skin" gap=".005" type')
    touch = compiled(tmp_path, ITEM.format(z=".032"), ITEMS, of_kinds(["item"]) | GATED, pad=text)
    sim = simulated(touch, which, substeps=250)
    assert not sim.state().contact_found.any() and not any(reading.any() for reading in touch(sim.state()).values())
    sim.step()
    state = sim.state()
    assert state.contact_found == 4 and -float(state.contact_netforce[0, 0, 2]) == pytest.approx(LOAD, rel=RESTING)


def test_a_stage_with_fixed_joints_is_welded_as_well(tmp_path):
    """The same pad as USD, where the skin is a rigid body on a fixed joint: the box presses with its weight."""
    touch = compiled(tmp_path, ON_SKIN, ITEMS, of_kinds(["item"]), pad=SKIN.format(name='name="skin"'), as_usd=True)
    assert touch.inputs.link_parts == {"pad": parts("pad", kind="subtree")}
    assert pressed(touch, "mujoco") == {name: pytest.approx(LOAD, rel=RESTING) for name in of_kinds([])}


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_variants_press_a_welded_child(tmp_path, which):
    """Of boxes of 0.1 and 0.2 kg each environment reads its own."""
    variants = [{"type": "box", "size": [0.02, 0.02, 0.02], "density": density} for density in (1562.5, 3125)]
    objects = {"item": {"body": "item", "variants": variants}}
    touch = compiled(tmp_path, ON_SKIN, objects, of_kinds(["item"]), pad=SKIN.format(name='name="skin"'))
    sim = simulated(touch, which, num_envs=2, substeps=250)
    sim.step()
    for kind, reading in touch(sim.state()).items():
        if "/" not in kind:
            np.testing.assert_allclose(-reading[:, :, 2].sum(dim=1), [0.1 * G, 0.2 * G], rtol=1e-3)


def test_a_model_of_ones_own_is_given_the_parts_sensors(tmp_path):
    """Instrumented with what a kept plan wants, it reads what the artefact's scene reads; a body that it lacks is named."""
    text = hand(more=HINGED)
    tgdsl.save(gripped(tmp_path, text), tmp_path / "module.safetensors")
    touch = tgdsl.load(tmp_path / "module.safetensors", dtype=torch.float64)
    assert touch.inputs.parts_of_link("finger") == parts("finger", "skin", "nail")
    assert "contacts with finger are those on body finger, body skin, body nail" in touch.explain()
    own = tgdsl.instrument(mujoco.MjSpec.from_string(text), touch.inputs).compile()
    sim = BatchSimulation(touch, 1, model=own)
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
def test_warp_finds_what_mujocos_sensors_show(tmp_path, more):
    """A link of one part and of three: every contact field, and every reading, as far as float32 goes."""
    touch = gripped(tmp_path, hand(more=more))
    cpu = tgdsl.simulate(touch, 1)
    expected = cpu.state()
    readings = touch(expected)
    cpu.close()
    sim = simulated(touch, "warp")
    assert_agree(sim.state(), expected, CONTACTS, MOVING_FORCE)
    found = touch(sim.state())
    for name, reading in readings.items():
        scale = max(float(reading.abs().max()), 0.01)  # nothing is missed, but for rounding
        torch.testing.assert_close(found[name].double(), reading, rtol=0, atol=2e-3 * scale, msg=name)


def test_a_scene_may_weld_more_to_a_link(tmp_path):
    """A sleeve that the robot's file does not have is part of the link that it is welded to, and not left out."""
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
