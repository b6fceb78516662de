"""An untrusted artefact opens only its own assets."""

import dataclasses
import hashlib
import json
import os
import sys
from pathlib import Path

import pytest
import trimesh
from safetensors.numpy import load, save

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.compiler.scene import scene_file
from tgdsl.errors import ArtifactError, RobotError
from tgdsl.files.find import robots_folder
from tgdsl.formats.robot import load_model
from tgdsl.module.artifact import load_plan, save_plan
from tgdsl.plan.inputs import Inputs
from tgdsl.plan.scene import Asset
from tgdsl.scene.scene import portable, scene_model

SCENE = """<mujoco>
  <asset><mesh name="item" file="item.stl"/></asset>
  <worldbody>
    <body name="pad"><geom type="box" size=".03 .03 .01"/></body>
    <body name="item" pos="0 0 .03"><freejoint/><geom type="mesh" mesh="item"/></body>
  </worldbody>
  <include file="more.xml"/>
</mujoco>"""
DOCUMENT = """
tgdsl: 1
robot: {model: scene.xml, layout: {resolutions: {only: {pad: {method: poisson, count: 5, radius: 4 mm}}}}}
objects: {item: {body: item, variants: [{mesh: item.stl}, {type: box, size: [1 cm, 1 cm, 1 cm]}]}}
sensors: {touch: {kind: contact_depth, links: pad, feels: [item], gate: geometric}}
"""
OPENED: list[str] = []
sys.addaudithook(lambda event, arguments: OPENED.append(str(arguments[0])) if event == "open" else None)


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    folder = tmp_path_factory.mktemp("project").resolve()
    trimesh.creation.box((0.02, 0.03, 0.04)).export(folder / "item.stl")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "more.xml").write_text("<mujoco><worldbody><site name='s'/></worldbody></mujoco>")
    (folder / "hand.yaml").write_text(DOCUMENT)
    save_plan(compile_document(folder / "hand.yaml").plan, folder / "hand.safetensors")
    return folder


def crafted(project: Path, folder: Path, change) -> Path:
    """Write a valid artefact with a changed scene."""
    content = (project / "hand.safetensors").read_bytes()
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    plan = json.loads(header["__metadata__"]["tgdsl"])
    change(plan["scene"])
    (folder / "evil.safetensors").write_bytes(save(load(content), {"tgdsl": json.dumps(plan)}))
    return folder / "evil.safetensors"


def test_an_unchanged_artefact_loads(project, tmp_path):
    path = crafted(project, tmp_path, lambda scene: None)
    assert tgdsl.simulate(tgdsl.load(path), 1).model.nmesh == scene_model(load_plan(path).scene).nmesh == 2


PLACES = {
    "/etc/passwd": "is not a mesh, texture, height field or skin; their endings are .stl, .obj, .msh, .png, .ktx, .skn, .bin",
    "/etc/passwd.": "is not a mesh",
    "/proc/self/environ": "is not a mesh",
    "/dev/stdin": "is not a mesh",
    "/tmp/../etc/a.stl": "leads out of its folder",
    "//server/share/a.stl": "is not a plain path",
    "/tmp/./a.stl": "is not a plain path",
    "a.stl": "is not an absolute path, nor one below robots:",
    "../a.stl": "is not an absolute path, nor one below robots:",
    "~/a.stl": "is not an absolute path, nor one below robots:",
    "": "is not an absolute path, nor one below robots:",
    "robots:": "is not a plain path",
    "robots:../secret.stl": "leads out of its folder",
    "robots:xhand1/../../secret.stl": "leads out of its folder",
    "robots:/etc/a.stl": "is not below robots:",
    "robots:C:/a.stl": "is not below robots:",
    "robots:xhand1/README.md": "is not a mesh",
    "robots:..\\..\\secret.stl": "is not a path with / between its parts",
    "C:\\Windows\\a.stl": "is not a path with / between its parts",
    "\\\\server\\share\\a.stl": "is not a path with / between its parts",
    "/tmp/a.stl\0.png": "is not a path with / between its parts",
}


@pytest.mark.parametrize("place", PLACES, ids=repr)
def test_an_invalid_asset_path_is_refused_before_any_file_is_opened(project, tmp_path, place):
    path = crafted(project, tmp_path, lambda scene: scene["assets"][0].update(path=place))
    OPENED.clear()
    with pytest.raises(ArtifactError) as caught:
        tgdsl.load(path)
    assert str(caught.value).startswith(f'{path}: asset "{place}" {PLACES[place]}')
    assert OPENED == []  # safetensors opens the artefact without Python


def mjcf(old: str, new: str):
    def change(scene) -> None:
        assert scene["mjcf"].count(old) == 1
        scene["mjcf"] = scene["mjcf"].replace(old, new)

    return change


def part(text: str):
    return lambda scene: scene["parts"].update({next(iter(scene["parts"])): text})


CUBE = "<mujoco><asset><texture type='cube' name='t' {}='/x.png'/></asset></mujoco>"
TEXTS = {
    "mesh": (mjcf("</asset>", "<mesh name='m' file='/tmp/a.stl'/></asset>"), 'names the file "/tmp/a.stl"'),
    "relative mesh": (mjcf("</asset>", "<mesh name='m' file='../a.stl'/></asset>"), 'names the file "../a.stl"'),
    "include": (mjcf("<worldbody>", "<include file='/etc/passwd'/><worldbody>"), 'names the file "/etc/passwd"'),
    "attached model": (mjcf("</asset>", "<model name='m' file='/etc/a.xml'/></asset>"), 'names the file "/etc/a.xml"'),
    "flex": (part("<mujoco><worldbody><flexcomp file='/x.obj'/></worldbody></mujoco>"), 'names the file "/x.obj"'),
    "in a part": (part("<mujoco><asset><mesh file='/x.obj'/></asset></mujoco>"), 'names the file "/x.obj"'),
    "urdf": (part("<robot><link><mesh filename='/x.obj'/></link></robot>"), 'names the file "/x.obj"'),
    "folder": (mjcf("<asset>", "<compiler meshdir='/etc'/><asset>"), 'names the folder "/etc"'),
    "entity": (part('<!DOCTYPE a [<!ENTITY x SYSTEM "/etc/passwd">]><mujoco>&x;</mujoco>'), "has a DOCTYPE"),
    "not XML": (part("<mujoco"), "is not XML: unclosed token: line 1, column 0"),
    **{
        f"side {side}": (part(CUBE.format(f"file{side}")), 'names the file "/x.png"')
        for side in ("right", "left", "up", "down", "front", "back")
    },
}


@pytest.mark.parametrize("case", TEXTS)
def test_a_scenes_text_may_name_only_listed_assets(project, tmp_path, case):
    change, problem = TEXTS[case]
    with pytest.raises(ArtifactError) as caught:
        load_plan(crafted(project, tmp_path, change))
    assert f"evil.safetensors: the scene's text {problem}" in str(caught.value)


def test_names_of_assets_and_parts_must_be_hashes(project, tmp_path):
    def rename_asset(scene) -> None:
        scene["assets"][0]["key"] = "../a.stl"

    def rename_part(scene) -> None:
        scene["parts"] = {"/etc/a.xml": "<mujoco/>"}

    def rename_mesh(scene) -> None:
        scene["objects"][0]["variants"][0][0]["mesh"] = "/etc/a.stl"

    for change, problem in (
        (rename_asset, 'the scene has a file by the name "../a.stl", expected a hash'),
        (rename_part, 'the scene has a file by the name "/etc/a.xml", expected a hash with the ending .xml'),
        (rename_mesh, 'object "item" names the file "/etc/a.stl", which is none of the scene\'s assets'),
    ):
        with pytest.raises(ArtifactError, match="evil") as caught:
            load_plan(crafted(project, tmp_path, change))
        assert problem in str(caught.value)


@pytest.mark.parametrize("kind", ["file", "folder", "robots", "chain", "loop"])
def test_a_symbolic_link_to_elsewhere_is_refused_before_it_is_opened(project, tmp_path, monkeypatch, kind):
    """The secret has the content that the artefact expects, so a read would go unnoticed."""
    secret = tmp_path / "secret" / "item.stl"
    secret.parent.mkdir()
    secret.write_bytes((project / "item.stl").read_bytes())
    folder = tmp_path / "place"
    link = folder / "item.stl"
    if kind == "folder":
        folder.symlink_to(secret.parent)
    else:
        folder.mkdir()
        if kind == "chain":
            (folder / "next.stl").symlink_to(secret)
        link.symlink_to({"chain": folder / "next.stl", "loop": link}.get(kind, secret))
    if kind == "robots":
        monkeypatch.setattr("tgdsl.scene.scene.robots_folder", lambda: folder)
    asset_path = "robots:item.stl" if kind == "robots" else str(link)
    path = crafted(project, tmp_path, lambda scene: scene["assets"][0].update(path=asset_path))
    scene = load_plan(path).scene
    OPENED.clear()
    with pytest.raises(ArtifactError) as caught:
        scene_model(scene)
    assert not [name for name in OPENED if name.endswith("item.stl")]
    expected = {
        "robots": 'asset "robots:item.stl" of the scene is no place on this machine; compile again',
        "loop": f"asset {link} of the scene cannot be read: Too many levels of symbolic links; compile again",
    }
    assert str(caught.value) == expected.get(kind, f"asset {link} of the scene is a link to {secret}; compile again")


def test_an_asset_that_is_not_a_file_is_refused_before_it_is_opened(project, tmp_path):
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "folder.stl").mkdir()
    for name in ("pipe.stl", "folder.stl"):
        path = crafted(project, tmp_path, lambda scene, name=name: scene["assets"][0].update(path=str(tmp_path / name)))
        with pytest.raises(ArtifactError) as caught:
            scene_model(load_plan(path).scene)
        assert str(caught.value) == f"asset {tmp_path / name} of the scene is not a file; compile again"


def test_a_windows_path_is_not_resolved_here(project, tmp_path, monkeypatch):
    """The module loads without the file; the scene does not look in the working folder."""
    (tmp_path / "C:").mkdir()
    (tmp_path / "C:" / "item.stl").write_bytes((project / "item.stl").read_bytes())
    monkeypatch.chdir(tmp_path)
    touch = tgdsl.load(crafted(project, tmp_path, lambda scene: scene["assets"][0].update(path="C:/item.stl")))
    with pytest.raises(ArtifactError) as caught:
        tgdsl.simulate(touch, 1)
    assert str(caught.value) == 'asset "C:/item.stl" of the scene is no place on this machine; compile again'


def test_every_asset_path_that_is_written_can_be_read(project):
    """Users' assets have absolute paths; assets of bundled robots are relative to the robots' folder."""
    for path in (project / "item.stl", *sorted(robots_folder().rglob("*.stl"))[::10]):
        content = path.read_bytes()
        asset = Asset(f"{hashlib.sha256(content).hexdigest()[:32]}.stl", portable(path), hashlib.sha256(content).hexdigest())
        scene = dataclasses.replace(load_plan(project / "hand.safetensors").scene, assets=(asset,), objects=())
        scene = dataclasses.replace(
            scene, mjcf=f"<mujoco><asset><mesh file='{asset.key}' name='m'/></asset></mujoco>", parts={}
        )
        assert scene_model(scene).nmesh == 1


def test_a_scene_with_an_unreadable_kind_of_asset_is_not_compiled(tmp_path):
    (tmp_path / "hill.data").write_bytes(bytes(8 + 4 * 4))
    (tmp_path / "scene.xml").write_text(
        "<mujoco><asset><hfield name='h' file='hill.data' size='1 1 1 1'/></asset><worldbody><geom type='hfield' hfield='h'/>"
        "</worldbody></mujoco>"
    )
    (tmp_path / "hill.data").write_bytes((2).to_bytes(4, "little") * 2 + bytes(16))
    with pytest.raises(RobotError, match=r"hill\.data: a mesh, texture, height field or skin has one of the endings \.stl, "):
        scene_file(load_model(tmp_path / "scene.xml"), Inputs((), (), (), {}, 0))
