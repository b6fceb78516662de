"""A rigid body presses with m g on both simulators, for any objects made of its geoms and any welded bodies."""

import mujoco
import numpy as np
import pytest
import torch
from pressed_pads import LOAD, MODELS, RESTING, G, compiled, of_kinds, pressed, simulated
from warp_cases import warp

import tgdsl
from tgdsl.errors import RobotError, SimulationError, SpecError
from tgdsl.plan.inputs import ContactPart
from tgdsl.runtime.batch.simulation import BatchSimulation

TWO_GEOMS = """
<body name="item" pos="0 0 .03"><freejoint/>
  <geom name="low" type="box" size=".02 .02 .02" mass=".25"/>
  <geom name="high" type="box" pos="0 0 .03" size=".01 .01 .01" mass=".05"/>
</body>"""
SEEN = """
<body name="item" pos="0 0 .03"><freejoint/>
  <geom name="hull" type="box" size=".02 .02 .02" mass=".3"/>
  <geom name="front" type="box" pos=".01 0 0" size=".01 .02 .02" mass="0" contype="0" conaffinity="0"/>
  <geom name="back" type="box" pos="-.01 0 0" size=".01 .02 .02" mass="0" contype="0" conaffinity="0"/>
</body>"""
MUG = """
<body name="mug" pos="0 0 .0{z}"><freejoint/>
  <geom name="cup" type="box" size=".01 .01 .01" mass=".1"/>
  <body {name} pos="0 0 -.02" quat=".7071067811865476 0 0 .7071067811865476">
    <geom name="handle" type="box" pos=".01 0 0" size=".01 .01 .01" mass=".2"/>
  </body>
</body>"""


GAPPED = '<body name="item" pos="0 0 {z}"><freejoint/><geom name="item" type="box" size=".02 .02 .02" mass=".3" {more}/></body>'


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_geoms_of_one_body_press_once(tmp_path, which):
    """Two objects of one body: together they read its weight, the lower one alone too, the upper one nothing."""
    objects = {name: {"body": "item", "surface": name} for name in ("low", "high")}
    sensors = {
        f"{kind}_{i}": sensor
        for i, feels in enumerate((["low", "high"], ["high", "low"], ["low"], ["high"]))
        for kind, sensor in of_kinds(feels).items()
    }
    loads = pressed(compiled(tmp_path, TWO_GEOMS, objects, sensors), which)
    for kind in ("link", "shared", "balanced"):
        for i in range(3):
            assert loads[f"{kind}_{i}"] == pytest.approx(LOAD, rel=RESTING)
        assert loads[f"{kind}_3"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_visual_surfaces_share_the_bodys_force(tmp_path, which):
    """A sensor that feels one of them, or both, reads the weight."""
    objects = {name: {"body": "item", "surface": name} for name in ("front", "back")} | {"whole": {"body": "item"}}
    groups = (["front", "back"], ["front"], ["back"], ["back", "whole", "front"])
    sensors = {f"{kind}_{i}": sensor for i, feels in enumerate(groups) for kind, sensor in of_kinds(feels).items()}
    touch = compiled(tmp_path, SEEN, objects, sensors)
    assert touch.inputs.contacts_of == {}
    for name, load in pressed(touch, which).items():
        assert load == pytest.approx(LOAD, rel=RESTING), name


@pytest.mark.slow
def test_warp_counts_a_contact_for_its_part_and_for_the_whole_body(tmp_path):
    """Objects are two parts and the whole: a contact is in the rows of its part and of the whole, in no other."""
    objects = {name: {"body": "item", "surface": name} for name in ("low", "high")} | {"whole": {"body": "item"}}
    sensors = {name: {"kind": "link_contact", "feels": [name], "outputs": ["force"]} for name in objects}
    touch = compiled(tmp_path, TWO_GEOMS, objects, sensors)
    assert touch.inputs.contacts_of == {name: (ContactPart("geom", name),) for name in ("low", "high")}
    loads = pressed(touch, "warp")
    assert loads == {"low": pytest.approx(LOAD, rel=RESTING), "high": 0, "whole": loads["low"]}


def test_instrument_adds_the_sensors_of_object_parts_to_a_users_model(tmp_path):
    """Instrumented for a loaded plan, it reads what the artefact's scene reads; an error names a missing geom."""
    objects = {name: {"body": "item", "surface": name} for name in ("low", "high")}
    sensors = {name: {"kind": "force_taxel", "feels": [name]} for name in objects}
    tgdsl.save(compiled(tmp_path, TWO_GEOMS, objects, sensors), tmp_path / "module.safetensors")
    touch = tgdsl.load(tmp_path / "module.safetensors", dtype=torch.float64)
    assert touch.inputs.parts_of("low") == (ContactPart("geom", "low"),)
    assert "contacts with low are those on geom low" in touch.explain()
    spec = mujoco.MjSpec.from_file(str(tmp_path / "scene.xml"))
    sim = BatchSimulation(touch, 1, substeps=250, model=tgdsl.instrument(spec, touch.inputs).compile())
    sim.step()
    readings = touch(sim.state())
    assert -float(readings["low"][0, :, 2].sum()) == pytest.approx(LOAD, rel=RESTING) and not readings["high"].any()
    spec = mujoco.MjSpec.from_file(str(tmp_path / "scene.xml"))
    spec.geom("high").name = "top"
    with pytest.raises(RobotError, match='this model has no geom "high", which the module wants contacts of'):
        tgdsl.instrument(spec, touch.inputs)
    with pytest.raises(SimulationError, match='the scene has no geom "high"'):
        warp(touch, 1, model=spec.compile())


def test_overlapping_surfaces_in_one_sensor_are_refused(tmp_path):
    """Two surfaces share a geom, whose force would count twice; in separate sensors they are fine."""
    body = TWO_GEOMS.replace("</body>", '<geom name="mid" type="box" size=".02 .02 .021" mass="0"/></body>')
    objects = {"one": {"body": "item", "surface": "[lm]*"}, "two": {"body": "item", "surface": "[mh]*"}}
    message = 'sensors.link.feels[1]: "two" and "one" share some of their geoms'
    with pytest.raises(SpecError, match=r"sensors\.link\.feels\[1\]") as error:
        compiled(tmp_path, body, objects, of_kinds(["one", "two"]))
    assert message in str(error.value)
    compiled(tmp_path, body, objects, {**of_kinds(["one"]), "other": of_kinds(["two"])["link"]})
    compiled(tmp_path, body, objects, {"depth": {"kind": "contact_depth", "feels": ["one", "two"]}})  # reads no force


def test_an_object_listed_twice_is_refused(tmp_path):
    with pytest.raises(SpecError, match=r'sensors\.link\.feels\[1\]: object "item" is listed twice; name it once'):
        compiled(tmp_path, TWO_GEOMS, {"item": {"body": "item"}}, {"link": of_kinds(["item", "item"])["link"]})


def test_a_colliding_geom_needs_a_name(tmp_path):
    """A mesh names its geom for the document, not for MuJoCo's sensors; no name is needed if nothing else collides."""
    asset = '<asset><mesh name="block" vertex="-1 -1 -1 1 -1 -1 -1 1 -1 -1 -1 1 1 1 1" scale=".02 .02 .02"/></asset>'
    body = TWO_GEOMS.replace('name="low" type="box" size=".02 .02 .02"', 'type="mesh" mesh="block"')
    objects = {"item": {"body": "item", "surface": "block"}}
    with pytest.raises(SpecError, match=r'objects\.item\.surface: geom "block" has no name') as error:
        compiled(tmp_path, body, objects, of_kinds(["item"]), extra=asset)
    assert "name it, or its body, in the scene" in str(error.value)
    alone = body.replace('name="high"', 'contype="0" conaffinity="0" name="high"')
    assert compiled(tmp_path, alone, objects, of_kinds(["item"]), extra=asset).inputs.contacts_of == {}
    sensor = {"kind": "surface_distance", "feels": ["item"], "max_range": 0.01}
    compiled(tmp_path, body, objects, {"above": sensor}, extra=asset)


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
@pytest.mark.parametrize("slots", [False, True], ids=["bit", "slots"])
def test_a_gap_is_no_contact(tmp_path, which, slots):
    """2 mm above the pad, within a gap of 5 mm, MuJoCo reports contacts without force: gates stay shut. At rest they open."""
    sensors = {"depth": {"kind": "kinematic_taxel", "outputs": ["force"], "feels": ["item"]}}
    sensors |= of_kinds(["item"]) if slots else {}
    touch = compiled(tmp_path, GAPPED.format(z=".032", more='gap=".005"'), {"item": {"body": "item"}}, sensors)
    sim = simulated(touch, which)
    state = sim.state()
    assert not state.contact_found.any()
    if slots:
        assert not state.contact_normal.any() and not state.contact_pos.any()
    assert not any(reading.any() for reading in touch(state).values())
    for _ in range(250):
        sim.step()
    state = sim.state()
    assert state.contact_found == 4
    if slots:
        assert -float(state.contact_force[0, 0, :, 2].sum()) == pytest.approx(LOAD, rel=RESTING)


@pytest.mark.parametrize("which", MODELS)
def test_the_gap_of_a_pair_of_geoms_is_no_contact(tmp_path, which):
    """MuJoCo allows a gap for one pair of geoms: 2 mm above the pad nothing is in contact."""
    extra = '<contact><pair geom1="pad" geom2="item" gap=".005"/></contact>'
    sensors = {"depth": {"kind": "contact_depth", "feels": ["item"]}}
    touch = compiled(tmp_path, GAPPED.format(z=".032", more=""), {"item": {"body": "item"}}, sensors, extra=extra)
    sim = simulated(touch, which)
    data = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, data)
    assert data.ncon == 4 and all(contact.exclude for contact in data.contact)
    assert not sim.state().contact_found.any()


@pytest.mark.parametrize("which", MODELS)
def test_a_margin_is_a_contact(tmp_path, which):
    """Within the margin the solver pushes: 1 mm above the pad, with a margin of 3 mm and a gap of 5, there is a force."""
    body = GAPPED.format(z=".031", more='gap=".005" margin=".003"')
    touch = compiled(tmp_path, body, {"item": {"body": "item"}}, of_kinds(["item"]))
    state = simulated(touch, which).state()
    assert state.contact_found == 4 and state.contact_netforce[0, 0, 2] < -0.1


def test_contacts_of_different_margins_are_distinguished(tmp_path):
    """A ball within its margin, further away than a box within its gap: MuJoCo's `exclude` is the oracle."""
    more = '<geom name="ball" pos=".03 0 .002" size=".01" mass="0" margin=".015"/>'
    body = GAPPED.format(z=".0312", more='gap=".005"').replace("</body>", f"{more}</body>")
    touch = compiled(tmp_path, body, {"item": {"body": "item"}}, of_kinds(["item"]))
    sim = tgdsl.simulate(touch, 1)
    data = mujoco.MjData(sim.model)
    mujoco.mj_forward(sim.model, data)
    active = [contact for contact in data.contact if contact.exclude == 0]
    assert len(data.contact) == 5 and len(active) == 1 and active[0].dist > max(c.dist for c in data.contact if c.exclude)
    state = sim.state()
    assert state.contact_found == 1 and state.contact_normal[0, 0].any(dim=-1).sum() == 1
    np.testing.assert_allclose(state.contact_pos[0, 0, 0], active[0].pos, atol=1e-12)
    assert warp(touch.float(), 1).state().contact_found == 1


def test_a_contact_sensor_without_distances_is_refused(tmp_path):
    touch = compiled(tmp_path, GAPPED.format(z=".032", more='gap=".005"'), {"item": {"body": "item"}}, of_kinds(["item"]))
    text = touch.plan.scene.mjcf.replace("torque dist pos", "torque pos")
    with pytest.raises(SimulationError, match='the contact sensor "tgdsl/contact/pad/item" does not show dist; add them with'):
        BatchSimulation(touch, 1, model=mujoco.MjModel.from_xml_string(text))


# Welded bodies


@pytest.mark.slow
@pytest.mark.parametrize(
    ("which", "name"),
    [("mujoco", 'name="handle"'), ("mujoco", ""), ("warp", "")],
    ids=["mujoco-named", "mujoco-unnamed", "warp-unnamed"],
)
def test_a_body_welded_to_an_object_is_part_of_it(tmp_path, which, name):
    """A mug stands on its handle, a child without a joint: depth, distance, contacts and force belong to the handle."""
    sensors = {
        **of_kinds(["mug"]),
        "depth": {"kind": "contact_depth", "feels": ["mug"]},
        "above": {"kind": "surface_distance", "feels": ["mug"], "max_range": 0.05},
    }
    touch = compiled(tmp_path, MUG.format(z=40, name=name), {"mug": {"body": "mug"}}, sensors)
    assert touch.inputs.contacts_of == {"mug": (ContactPart("subtree", "mug"),)}
    sim = simulated(touch, which, substeps=250)
    # The handle, turned by 90° about z: a cube of 2 cm whose middle is 1 cm along y.
    probes = torch.tensor(touch.taxels["depth"]["pos"].tolist(), dtype=torch.float64)
    away = (probes - torch.tensor([0, 0.01, 0.02])).abs() - 0.01
    outside, inside = away.clamp(min=0).norm(dim=1), away.amax(dim=1).clamp(max=0)
    near = touch(sim.state())["above"][0, :, 0].double()
    torch.testing.assert_close(near, outside + inside, atol=1e-7, rtol=0)
    sim.step()
    readings = touch(sim.state())
    for kind in of_kinds([]):
        assert -float(readings[kind][0, :, 2].sum()) == pytest.approx(LOAD, rel=RESTING)
    assert ((readings["depth"][0, :, 0] > 0) == (outside + inside < 0.004)).all()


def test_fixed_joints_of_a_stage_weld_an_object(tmp_path):
    """The same mug in USD, with the handle as a rigid body on a fixed joint: it presses with its weight."""
    text = MUG.format(z=40, name='name="handle"')
    touch = compiled(tmp_path, text, {"mug": {"body": "mug"}}, of_kinds(["mug"]), as_usd=True)
    assert touch.inputs.contacts_of == {"mug": (ContactPart("subtree", "mug"),)}
    assert pressed(touch, "mujoco") == {name: pytest.approx(LOAD, rel=RESTING) for name in of_kinds([])}


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_a_welded_body_may_be_an_object_itself(tmp_path, which):
    objects = {"mug": {"body": "mug"}, "handle": {"body": "handle"}}
    sensors = {f"{kind}_{name}": sensor for name in objects for kind, sensor in of_kinds([name]).items()}
    sensors |= {f"{kind}_both": sensor for kind, sensor in of_kinds(["mug", "handle"]).items()}
    touch = compiled(tmp_path, MUG.format(z=40, name='name="handle"'), objects, sensors)
    loads = pressed(touch, which)
    for kind in of_kinds([]):
        assert loads[f"{kind}_mug"] == 0
        assert loads[f"{kind}_handle"] == loads[f"{kind}_both"] == pytest.approx(LOAD, rel=RESTING)


def test_a_surface_may_name_a_geom_of_a_welded_body(tmp_path):
    """`surface: handle` names a geom of the child; the object ends at a hinge."""
    flap = '<body name="flap" pos="0 0 .02"><joint axis="0 1 0"/><geom name="flap" size=".005" mass=".01"/></body>'
    text = MUG.format(z=40, name='name="handle"')
    objects = {"mug": {"body": "mug"}, "grip": {"body": "mug", "surface": "handle"}}
    touch = compiled(tmp_path, text[: text.rindex("</body>")] + flap + "</body>", objects, of_kinds(["mug", "grip"]))
    parts = {"mug": (ContactPart("body", "mug"), ContactPart("body", "handle")), "grip": (ContactPart("body", "handle"),)}
    assert touch.inputs.contacts_of == parts
    assert pressed(touch, "mujoco") == {name: pytest.approx(0.31 * G, rel=1e-3) for name in of_kinds([])}


def test_contacts_of_two_parts_share_the_slots(tmp_path):
    """A body and its welded child have four contacts each: MuJoCo's, part after part, in eight or five slots."""
    text = '<body name="item" pos="0 0 .0199"><freejoint/><geom type="box" size=".01 .01 .01" mass=".1"/>{}</body>'
    child = '<body name="{}" pos="{}">{}<geom type="box" size=".01 .01 .01" mass=".1"/></body>'
    parts = child.format("welded", ".03 0 0", "") + child.format("hinged", "0 .03 0", '<joint axis="0 0 1"/>')
    for slots, num in ((8, 8), (5, 5)):
        sensors = {"shared": {"kind": "force_taxel", "slots": slots, "feels": ["item"]}}
        touch = compiled(tmp_path, text.format(parts), {"item": {"body": "item"}}, sensors)
        assert len(touch.inputs.parts_of("item")) == 2
        sim = tgdsl.simulate(touch, 1)
        data = mujoco.MjData(sim.model)
        mujoco.mj_forward(sim.model, data)
        names = [{sim.model.body(sim.model.geom_bodyid[g]).name for g in contact.geom} for contact in data.contact]
        order = [i for part in ("item", "welded") for i, bodies in enumerate(names) if bodies == {part, "pad"}]
        expected = [data.contact[i].pos for i in order]
        assert len(expected) == 8
        state = sim.state()
        assert state.contact_found == 8
        np.testing.assert_allclose(state.contact_pos[0, 0], expected[:num], atol=1e-12)
        wrench, load = np.zeros(6), 0.0
        for i, bodies in enumerate(names):
            mujoco.mj_contactForce(sim.model, data, i, wrench)
            load += wrench[0] if "hinged" not in bodies else 0.0  # along the normal, which is vertical
        assert float(state.contact_netforce[0, 0, 2]) == pytest.approx(-load, rel=1e-12)


def test_a_link_welded_to_an_object_cannot_feel_it(tmp_path):
    """The pad is part of the table's rigid body, and its probes lie inside it."""
    (tmp_path / "scene.xml").write_text(
        '<mujoco><worldbody><body name="table"><geom type="box" size=".1 .1 .1"/>'
        '<body name="pad"><geom type="box" size=".01 .01 .01"/></body></body></worldbody></mujoco>'
    )
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
        "objects": {"table": {"body": "table"}},
        "sensors": {"s": {"kind": "contact_depth", "links": "pad", "feels": ["table"], "gate": "geometric"}},
    }
    with pytest.raises(SpecError, match='"table" and the links of this sensor are one rigid body; put a joint between them'):
        tgdsl.compile(document)


@pytest.mark.slow
@pytest.mark.parametrize("which", MODELS)
def test_variants_replace_welded_geoms_too(tmp_path, which):
    """Each variant of the mug rests with its own weight; the handle is gone, and the clip, another object, stays."""
    clip = '<body name="clip" pos="0 0 .03"><geom name="clip" type="box" size=".002 .002 .002" mass=".05"/></body>'
    text = MUG.format(z=20, name='name="handle"').replace("</body>\n</body>", f"</body>\n{clip}</body>")
    variants = [{"type": "box", "size": [0.02, 0.02, 0.01], "density": d} for d in (3125, 6250)]  # 0.1 and 0.2 kg
    objects = {"mug": {"body": "mug", "variants": variants}, "clip": {"body": "clip"}}
    touch = compiled(tmp_path, text, objects, of_kinds(["mug", "clip"]))
    sim = simulated(touch, which, num_envs=2, substeps=250)
    names = [sim.model.geom(i).name for i in range(sim.model.ngeom)]
    assert "handle" not in names and "clip" in names
    sim.step()
    for kind, reading in touch(sim.state()).items():
        if "/" not in kind:
            np.testing.assert_allclose(-reading[:, :, 2].sum(dim=1), [0.15 * G, 0.25 * G], rtol=1e-3)
