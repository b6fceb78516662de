"""Text STL files, which MuJoCo does not read, give the binary file's surface in MJCF, URDF and artefacts."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

import tgdsl
from tgdsl.errors import RobotError
from tgdsl.formats.robot import load_model
from tgdsl.scene.scene import readable

BODY = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="block" file="block.stl"/></asset>
  <worldbody><body name="hand"><geom type="mesh" mesh="block"/></body>
  <body name="ball" pos="0 0 .04"><freejoint/><geom size=".02"/></body></worldbody></mujoco>"""
URDF = """<robot name="r"><link name="base"><collision><origin xyz="0 0 .2"/><geometry><sphere radius=".02"/></geometry></collision></link><link name="hand">
  <inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><mesh filename="meshes/block.stl"/></geometry></collision></link>
  <joint name="j" type="continuous"><parent link="base"/><child link="hand"/></joint></robot>"""
BLOCK, BALL = trimesh.creation.box((0.1, 0.06, 0.04)), trimesh.creation.icosphere(1)


def written(folder: Path, name: str, text: str, is_text: bool) -> Path:
    folder.mkdir()
    (folder / "meshes").mkdir()
    mesh = folder / "meshes" / "block.stl"
    if is_text:
        mesh.write_text(trimesh.exchange.stl.export_stl_ascii(BLOCK))
    else:
        mesh.write_bytes(trimesh.exchange.stl.export_stl(BLOCK))
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(("name", "text"), [("r.xml", BODY), ("r.urdf", URDF)], ids=["mjcf", "urdf"])
def test_a_text_file_gives_the_same_surface(tmp_path, name, text):
    models = [load_model(written(tmp_path / str(is_text), name, text, is_text)).compiled for is_text in (True, False)]
    np.testing.assert_array_equal(models[0].mesh_vert, models[1].mesh_vert)
    np.testing.assert_array_equal(models[0].mesh_face, models[1].mesh_face)


def test_files_with_one_name_stay_separate(tmp_path):
    for folder, content in (
        ("a", trimesh.exchange.stl.export_stl_ascii(BLOCK)),
        ("b", trimesh.exchange.stl.export_stl_ascii(BALL)),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "part.stl").write_text(content)
    (tmp_path / "r.xml").write_text(
        """<mujoco><asset><mesh file="a/part.stl"/><mesh name="ball" file="b/part.stl"/></asset>
        <worldbody><geom type="mesh" mesh="part"/><geom type="mesh" mesh="ball"/></worldbody></mujoco>"""
    )
    model = load_model(tmp_path / "r.xml")
    assert model.compiled.mesh_vertnum.tolist() == [len(BLOCK.vertices), len(BALL.vertices)]
    assert sorted(model.rewritten.values()) == [tmp_path / "a" / "part.stl", tmp_path / "b" / "part.stl"]


@pytest.mark.parametrize(("name", "text", "feels"), [("r.xml", BODY, "ball"), ("r.urdf", URDF, "base")], ids=["mjcf", "urdf"])
def test_an_artefact_reads_its_text_file(tmp_path, name, text, feels):
    model = written(tmp_path / "robot", name, text, True)
    top = {"method": "grid", "rows": 2, "columns": 2, "direction": [0, 0, -1], "radius": "4 mm"}
    (tmp_path / "layout.yaml").write_text(f"tgdsl: 1\ngroups: {{}}\nresolutions: {{low: {{hand: {top}}}}}")
    document = {
        "tgdsl": 1,
        "robot": {"model": str(model), "layout": str(tmp_path / "layout.yaml")},
        "objects": {"thing": {"body": feels}},
        "resolution": "low",
        "sensors": {"depth": {"kind": "contact_depth", "links": "hand", "feels": ["thing"], "gate": "geometric"}},
    }
    tgdsl.save(tgdsl.compile(document), tmp_path / "touch.safetensors")
    touch = tgdsl.load(tmp_path / "touch.safetensors")
    assert touch(tgdsl.simulate(touch, 1).state())["depth"].shape == (1, 4, 1)


def test_other_files_are_left_alone():
    binary = trimesh.exchange.stl.export_stl(BLOCK)
    misleading = b"solid facet" + binary[11:]
    for name, content in (
        ("a.stl", binary),
        ("a.stl", misleading),
        ("a.obj", b"solid facet"),
        ("a.stl", b"solid facet vertex 1 2 x"),
    ):
        assert readable(name, content) is content


def test_a_broken_text_file_is_named(tmp_path):
    file = written(tmp_path / "r", "r.xml", BODY, True)
    mesh = file.parent / "meshes" / "block.stl"
    mesh.write_text(mesh.read_text().replace("vertex", "vertex x", 1))
    with pytest.raises(RobotError, match=r"block\.stl"):
        load_model(file)
