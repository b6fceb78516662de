"""Objects that a document adds to a scene, and the example scenes."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
import trimesh

import tgdsl
from tgdsl.errors import SpecError
from tgdsl.formats.robot import export_model
from tgdsl.runtime.rollout import scripted_controls
from tgdsl.scene.scene import scene_model

EXAMPLES = Path(__file__).parents[2] / "examples"
SCENE = """<mujoco><worldbody>
  <body name="pad" pos="0 0 .1"><joint name="press" type="slide" axis="0 0 1"/><geom type="box" size=".05 .05 .01"/></body>
</worldbody><actuator><position joint="press" kp="100"/></actuator>
<keyframe><key name="up" qpos=".02" ctrl=".02"/><key name="plain" ctrl="0"/></keyframe></mujoco>"""
BALL = {"type": "sphere", "size": [0.02], "density": 500}


def document(folder, objects, text=SCENE):
    (folder / "scene.xml").write_text(text)
    points = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.004}]}
    return {
        "tgdsl": 1,
        "robot": {"model": str(folder / "scene.xml"), "layout": {"resolutions": {"r": {"pad": points}}}},
        "objects": objects,
        "sensors": {"s": {"kind": "surface_distance", "links": "pad", "feels": list(objects), "max_range": 1.0}},
    }


def test_an_added_object_falls_and_is_felt(tmp_path):
    """A ball above the pad has the distance of its pose and the mass of its density, and lands on the pad."""
    doc = document(tmp_path, {"ball": {"geom": BALL, "pos": [0, 0, 0.2]}})
    touch = tgdsl.compile(doc, dtype=torch.float64)
    assert not touch.inputs.objects
    sim = tgdsl.simulate(touch, 2, substeps=5)
    assert touch(sim.state())["s"][0, 0, 0].item() == pytest.approx(0.2 - 0.11 - 0.02, abs=1e-9)
    assert sim.model.body("ball").mass[0] == pytest.approx(500 * 4 / 3 * np.pi * 0.02**3, rel=1e-9)
    bare_model = mujoco.MjModel.from_xml_string(SCENE)
    assert sim.model.nq == bare_model.nq + 7
    for _ in range(200):
        sim.step()
    assert abs(touch(sim.state())["s"][0, 0, 0].item()) < 5e-4  # on the pad, within MuJoCo's soft contact


@pytest.mark.parametrize(
    ("pad", "given", "bits"),
    [
        ((1, 1), {}, (1, 1)),
        ((2, 2), {}, (3, 3)),
        ((0, 4), {}, (5, 1)),
        ((8, 0), {}, (1, 9)),
        ((2, 2), {"contype": 0, "conaffinity": 2}, (0, 2)),
        ((2, 2), {"conaffinity": 0, "contype": 1}, None),
        ((1, 1), {"contype": 0, "conaffinity": 0}, None),
    ],
)
def test_an_added_object_collides_whatever_bits_others_have(tmp_path, pad, given, bits):
    """It rests on the pad, or falls through if its own bits do not match."""
    text = SCENE.replace("<worldbody>", f'<default><geom contype="{pad[0]}" conaffinity="{pad[1]}"/></default><worldbody>')
    doc = document(tmp_path, {"ball": {"geom": BALL, "pos": [0, 0, 0.14], **given}}, text)
    sim = tgdsl.simulate(tgdsl.compile(doc), 1, substeps=100)
    geom = sim.model.geom(sim.model.body("ball").geomadr[0])
    assert bits is None or (geom.contype[0], geom.conaffinity[0]) == bits
    for _ in range(2):
        sim.step()
    assert (sim.batch.qpos[0, 3] - sim.batch.qpos[0, 0] > 0.12) == (bits is not None)


def test_keyframes_keep_new_objects_where_they_start(tmp_path):
    quat = [0.5, 0.5, 0.5, 0.5]
    doc = document(
        tmp_path, {"ball": {"geom": BALL, "pos": [0.1, 0.2, 0.3], "quat": quat}, "post": {"geom": BALL, "joint": "fixed"}}
    )
    touch = tgdsl.compile(doc)
    sim = tgdsl.simulate(touch, 1, keyframe="up")
    np.testing.assert_allclose(sim.batch.qpos[0], [0.02, 0.1, 0.2, 0.3, *quat])
    assert sim.model.body("post").dofnum[0] == 0
    np.testing.assert_allclose(scene_model(touch.plan.scene).key("plain").qpos, [0, 0.1, 0.2, 0.3, *quat])


def test_a_mesh_and_a_compound(tmp_path):
    trimesh.creation.box((40, 40, 40)).export(tmp_path / "cube.obj")
    objects = {
        "cube": {"geom": {"mesh": str(tmp_path / "cube.obj"), "scale": 0.001}, "pos": [0, 0, 0.2]},
        "dumbbell": {"geom": {"geoms": [{**BALL, "pos": [0, 0, z]} for z in (-0.03, 0.03)]}, "pos": [0, 0, 0.4]},
    }
    touch = tgdsl.compile(document(tmp_path, objects), dtype=torch.float64)
    sim = tgdsl.simulate(touch, 1)
    reading = touch(sim.state())["s"][0, 0].numpy()
    np.testing.assert_allclose(reading, [0.2 - 0.02 - 0.11, 0.4 - 0.03 - 0.02 - 0.11], atol=5e-5)
    assert sim.model.body("cube").mass[0] == pytest.approx(1000 * 0.04**3, rel=1e-5)
    tgdsl.save(touch, tmp_path / "a.safetensors")
    loaded = tgdsl.load(tmp_path / "a.safetensors", dtype=torch.float64)
    np.testing.assert_array_equal(loaded(tgdsl.simulate(loaded, 1).state())["s"][0, 0].numpy(), reading)


def test_one_geom_instead_of_the_scenes(tmp_path):
    text = SCENE.replace(
        "</worldbody>", '<body name="item" pos="0 0 .2"><freejoint/><geom size=".001" friction=".3"/></body></worldbody>'
    )
    text = text.replace('qpos=".02"', 'qpos=".02 0 0 .2 1 0 0 0"')
    touch = tgdsl.compile(document(tmp_path, {"item": {"body": "item", "geom": BALL}}, text), dtype=torch.float64)
    sim = tgdsl.simulate(touch, 1)
    assert touch(sim.state())["s"][0, 0, 0].item() == pytest.approx(0.07, abs=1e-9)
    assert sim.model.geom_friction[-1, 0] == 0.3


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ({}, "expected `body`, the name of a body in the scene, or `geom` or `variants` for an added body"),
        ({"geom": BALL, "variants": [BALL]}, "found `geom` and `variants`, expected one of them"),
        ({"body": "pad", "pos": [0, 0, 1]}, '`pos` is for an added body; the scene sets it for body "pad"'),
        ({"geom": {"type": "plane", "size": [1]}}, "objects.item.geom.type: found \"plane\", expected 'sphere'"),
        ({"geom": {"mesh": "no.stl"}}, 'objects.item.geom: there is no file "no.stl"'),
        ({"geom": BALL, "joint": "hinge"}, "objects.item.joint: found \"hinge\", expected 'free' or 'fixed'"),
        ({"geom": BALL, "quat": [0, 0, 0, 0]}, "is no orientation"),
    ],
)
def test_invalid_objects_are_refused(tmp_path, target, message):
    with pytest.raises(SpecError) as error:
        tgdsl.compile(document(tmp_path, {"item": target}))
    assert message in str(error.value), str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("notes.md", b"# no mesh", "no decoder found for mesh file 'notes.md'"),
        ("short.stl", b"x" * 100, "in STL file 'short.stl'"),
    ],
)
def test_an_invalid_mesh_file_is_reported(tmp_path, name, content, message):
    """The message points to the file's name in the document and quotes it."""
    (tmp_path / name).write_bytes(content)
    path = str(tmp_path / name)
    with pytest.raises(SpecError) as error:
        tgdsl.compile(document(tmp_path, {"item": {"variants": [BALL, {"mesh": path}]}}))
    assert f'objects.item.variants[1]: MuJoCo cannot read mesh file "{path}"' in str(error.value)
    assert message in str(error.value) and len(error.value.problems) == 1


def test_an_added_object_needs_a_new_name(tmp_path):
    with pytest.raises(SpecError, match='the scene has a body "pad" already; `body: pad` gives that one these geoms'):
        tgdsl.compile(document(tmp_path, {"pad": {"geom": BALL}}))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "links", "num_envs"),
    [
        ("in_hand", ["link", "thumb_rota_link2"], 16),
        ("screwdriver", ["index_rota_link2", "mid_link2"], 4),
        ("bin_balls", ["ring_link2"], 1),
    ],
)
def test_examples_are_touched_when_the_hand_closes(name, links, num_envs):
    touch = tgdsl.compile(EXAMPLES / f"{name}.yaml")
    sim = tgdsl.simulate(touch, num_envs, substeps=5, keyframe="rest")
    for control in scripted_controls(sim.model, ("rest", "squeeze"), 1.0, sim.control_step):
        sim.step(control)
    readings = touch(sim.state())
    force = readings["touch"][..., :3].norm(dim=-1)
    assert torch.isfinite(force).all() and (force.sum(dim=1) > 0.1).all(), force.sum(dim=1)
    for link in links:
        assert (force[:, touch.taxels["touch"]["link"] == f"right_hand_{link}"].sum(dim=1) > 0).float().mean() > 0.7, link
    assert set(touch.observe(readings)) == {"policy"}


@pytest.mark.parametrize("format", ["urdf", "usda"])
def test_objects_can_be_added_to_urdf_and_usd(tmp_path, format):
    """The kept scene holds the new body once, at its exact position."""
    (tmp_path / "arm.urdf").write_text(
        '<robot name="arm"><link name="pad"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
        '</inertial><collision><geometry><box size=".1 .1 .02"/></geometry></collision></link></robot>'
    )
    if format == "usda":
        (tmp_path / "arm.xml").write_text(
            '<mujoco><worldbody><body name="pad"><joint axis="0 0 1"/><geom type="box" size=".05 .05 .01"/></body></worldbody></mujoco>'
        )
        export_model(tmp_path / "arm.xml", tmp_path / "arm.usda")
    doc = document(tmp_path, {"ball": {"geom": BALL, "pos": [0, 0, 0.123456789]}})
    doc["robot"]["model"] = str(tmp_path / f"arm.{format}")
    touch = tgdsl.compile(doc, dtype=torch.float64)
    sim = tgdsl.simulate(touch, 1)
    assert sim.batch.qpos[0, -5] == 0.123456789
    assert touch(sim.state())["s"][0, 0, 0].item() == pytest.approx(0.123456789 - 0.01 - 0.02, abs=1e-9)
