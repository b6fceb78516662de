"""Scenes of artefacts: they have just the needed sensors and work from any folder."""

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

import tgdsl
from tgdsl.compiler.pipeline import compile_document
from tgdsl.compiler.scene import instrument, scene_file
from tgdsl.errors import ArtifactError, RobotError
from tgdsl.formats.robot import load_model
from tgdsl.module.artifact import save_plan
from tgdsl.plan.inputs import Inputs, contact_sensor_names
from tgdsl.quantities.pairs import Pair
from tgdsl.scene.scene import scene_model

ROBOTS = Path(__file__).parents[2] / "robots"
TWO = """
<mujoco>
  <worldbody>
    <body name="pad"><geom type="box" size=".05 .05 .01"/></body>
    <body name="tip" pos="5 0 1"><freejoint/><geom size=".01"/></body>
    <body name="cube" pos="0 0 .029"><freejoint/><geom type="box" size=".02 .02 .02" mass=".25"/></body>
  </worldbody>
  <sensor><framepos name="mine" objtype="body" objname="cube"/></sensor>
</mujoco>
"""
NOTHING = Inputs(("body_pos", "body_quat"), (), (), {}, 0)


def inputs(*fields: str, links: tuple[str, ...] = ("pad", "tip"), slots: int = 0) -> Inputs:
    pairs = tuple(Pair(link, "thing") for link in links)
    return Inputs(("body_pos", "body_quat", "contact_found", *fields), (*links, "cube"), pairs, {"thing": "cube"}, slots)


def sensors_of(model: mujoco.MjModel) -> dict[str, tuple[str, str, int]]:
    """Return body 1, body 2 and dimension of each contact sensor."""
    sensors = {}
    for i in range(model.nsensor):
        if model.sensor_type[i] == mujoco.mjtSensor.mjSENS_CONTACT:
            assert model.sensor_objtype[i] == model.sensor_reftype[i] == mujoco.mjtObj.mjOBJ_BODY
            bodies = (model.body(model.sensor_objid[i]).name, model.body(model.sensor_refid[i]).name)
            sensors[model.sensor(i).name] = (*bodies, int(model.sensor_dim[i]))
    return sensors


CASES = {
    "found": (inputs(), {f"tgdsl/contact/{link}/thing": ("cube", link, 1) for link in ("pad", "tip")}),
    "slots": (
        inputs("contact_force", links=("tip",), slots=3),
        {"tgdsl/contact/tip/thing": ("cube", "tip", 3 * 16)},
    ),
    "net": (
        inputs("contact_netforce", links=("pad",)),
        {"tgdsl/contact/pad/thing": ("cube", "pad", 1), "tgdsl/netforce/pad/thing": ("cube", "pad", 4)},
    ),
    "none": (NOTHING, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_instrument_adds_just_the_needed_sensors_once(case):
    needed, expected = CASES[case]
    spec = mujoco.MjSpec.from_string(TWO)
    assert instrument(spec, needed) is spec
    model = spec.compile()
    assert sensors_of(model) == expected
    assert model.nsensor == len(expected) + 1
    assert model.sensor("mine").adr[0] == 0  # existing sensors keep their addresses
    repeated = instrument(spec, needed).compile()
    assert sensors_of(repeated) == expected
    assert repeated.nsensor == model.nsensor


@pytest.mark.parametrize("case", CASES)
def test_the_kept_scene_has_the_same_sensors(tmp_path, case):
    needed, expected = CASES[case]
    (tmp_path / "scene.xml").write_text(TWO)
    kept_scene = scene_model(scene_file(load_model(tmp_path / "scene.xml"), needed))
    assert sensors_of(kept_scene) == expected
    by_hand = instrument(mujoco.MjSpec.from_string(TWO), needed).compile()
    for name in ("sensor_type", "sensor_objid", "sensor_refid", "sensor_intprm", "sensor_dim", "sensor_adr"):
        np.testing.assert_array_equal(getattr(kept_scene, name), getattr(by_hand, name), err_msg=name)


def test_forces_act_on_the_link_and_normals_point_out_of_the_object():
    model = instrument(
        mujoco.MjSpec.from_string(TWO), inputs("contact_force", "contact_netforce", links=("pad",), slots=1)
    ).compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1000)
    net = data.sensor(contact_sensor_names(Pair("pad", "thing"))[1]).data
    slot = data.sensor(contact_sensor_names(Pair("pad", "thing"))[0]).data
    assert net[0] == 4
    assert net[3] == pytest.approx(-0.25 * 9.81, rel=1e-6)
    np.testing.assert_allclose(slot[10:13], [0, 0, -1], atol=1e-6)
    assert slot[1] > 0  # along the normal: it pushes


@pytest.mark.parametrize(("body", "gone"), [("pad", "pad"), ("cube", "cube")])
def test_instrument_refuses_a_model_without_a_body(body, gone):
    spec = mujoco.MjSpec.from_string(
        TWO.replace(f'<body name="{body}"', '<body name="other"').replace(f'objname="{body}"', 'objname="tip"')
    )
    with pytest.raises(RobotError) as caught:
        tgdsl.instrument(spec, inputs())
    assert str(caught.value) == f'this model has no body "{gone}", which the module wants contacts of'


# scenes of many files


def brick(path: Path, *size: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box(size).apply_translation([0.01, 0.02, 0.03]).export(path)


def picture(path: Path, colour: int) -> None:
    from matplotlib.image import imsave

    path.parent.mkdir(parents=True, exist_ok=True)
    imsave(path, np.full((8, 8, 3), colour, dtype=np.uint8))


def written(folder: Path, **files: str) -> Path:
    """Write files (`hand__hand` is hand/hand.xml) and return the one that is the scene."""
    for name, text in files.items():
        path = folder / (name.replace("__", "/") + ".xml")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"<mujoco>{text}</mujoco>")
    return folder / "scene.xml"


def body(name: str, mesh: str, rest: str = "") -> str:
    return f"<body name='{name}'><freejoint/><geom name='{name}' type='mesh' mesh='{mesh}' {rest}/></body>"


PLAIN = "<worldbody><body name='{}'><freejoint/><geom size='.1'/></body></worldbody>"


def included(folder: Path) -> Path:
    brick(folder / "parts" / "a.stl", 0.02, 0.03, 0.04)
    return written(
        folder,
        scene="<include file='hand/hand.xml'/>" + PLAIN.format("item"),
        hand__hand="<compiler meshdir='parts'/><asset><mesh file='a.stl'/></asset><worldbody>"
        + body("pad", "a")
        + "</worldbody>",
    )


def included_under_the_main_files_meshdir(folder: Path) -> Path:
    brick(folder / "parts" / "a.stl", 0.02, 0.03, 0.04)
    return written(
        folder,
        scene="<compiler meshdir='parts'/><include file='hand.xml'/>",
        hand="<asset><mesh file='a.stl'/></asset><worldbody>" + body("pad", "a") + "</worldbody>",
    )


def main_under_the_included_files_meshdir(folder: Path) -> Path:
    brick(folder / "parts" / "a.stl", 0.02, 0.03, 0.04)
    return written(
        folder,
        scene="<include file='settings.xml'/><asset><mesh file='a.stl'/></asset><worldbody>"
        + body("pad", "a")
        + "</worldbody>",
        settings="<compiler assetdir='parts' angle='radian'/>",
    )


def files_of_one_name_next_to_both(folder: Path) -> Path:
    """MuJoCo takes the files next to the main one."""
    brick(folder / "a.stl", 0.02, 0.03, 0.04)
    brick(folder / "hand" / "a.stl", 0.05, 0.06, 0.07)
    inner = "<asset><mesh file='a.stl'/></asset><worldbody>" + body("{}", "a") + "</worldbody>"
    return written(
        folder,
        scene="<include file='hand/hand.xml'/>",
        hand__hand="<include file='inner.xml'/>",
        inner=inner.replace("{}", "pad"),
        hand__inner=inner.replace("{}", "other"),
    )


def attached(folder: Path) -> Path:
    brick(folder / "hand" / "parts" / "a.stl", 0.02, 0.03, 0.04)
    brick(folder / "props" / "a.stl", 0.05, 0.06, 0.07)
    return written(
        folder,
        scene="<compiler meshdir='props'/><asset><model name='h' file='hand/hand.xml'/><mesh name='prop' file='a.stl'/></asset><worldbody>"
        "<frame pos='0 0 1'><attach model='h' body='pad' prefix=''/></frame>" + body("item", "prop") + "</worldbody>",
        hand__hand="<compiler meshdir='parts'/><asset><mesh file='a.stl'/></asset><worldbody>"
        "<body name='pad'><geom type='mesh' mesh='a'/></body></worldbody>",
    )


def one_name_in_two_folders(folder: Path) -> Path:
    brick(folder / "left" / "tip.stl", 0.02, 0.03, 0.04)
    brick(folder / "right" / "tip.stl", 0.05, 0.06, 0.07)
    assets = "<mesh name='l' file='left/tip.stl'/><mesh name='r' file='right/tip.stl' scale='1 2 1'/>"
    return written(folder, scene=f"<asset>{assets}</asset><worldbody>{body('pad', 'l')}{body('item', 'r')}</worldbody>")


def textured(folder: Path) -> Path:
    picture(folder / "images" / "wood.png", 80)
    picture(folder / "hill.png", 200)
    brick(folder / "meshes" / "a.obj", 0.02, 0.03, 0.04)
    assets = (
        "<texture name='wood' type='2d' file='wood.png'/><material name='m' texture='wood'/><mesh file='a.obj'/>"
        "<hfield name='hill' file='../hill.png' size='1 1 .1 .1'/>"
    )
    world = body("pad", "a", "material='m'") + "<geom type='hfield' hfield='hill'/>"
    return written(
        folder, scene=f"<compiler meshdir='meshes' texturedir='images'/><asset>{assets}</asset><worldbody>{world}</worldbody>"
    )


def cube_textured(folder: Path) -> Path:
    for colour, side in enumerate(("right", "left", "up", "down", "front", "back")):
        picture(folder / f"{side}.png", 30 * colour)
    files = " ".join(f"file{side}='{side}.png'" for side in ("right", "left", "up", "down", "front", "back"))
    asset = f"<texture name='t' type='cube' {files}/><material name='m' texture='t'/>"
    return written(folder, scene=f"<asset>{asset}</asset>" + PLAIN.format("pad"))


SCENES = {
    f.__name__: f
    for f in (
        included,
        included_under_the_main_files_meshdir,
        main_under_the_included_files_meshdir,
        files_of_one_name_next_to_both,
        attached,
        one_name_in_two_folders,
        textured,
        cube_textured,
    )
}
"""Each makes a scene of several files in a folder and returns its main file."""


def same(found: mujoco.MjModel, expected: mujoco.MjModel) -> None:
    for name in ("nbody", "ngeom", "nmesh", "ntex", "nmeshvert", "ntexdata", "nhfielddata"):
        assert getattr(found, name) == getattr(expected, name), name
    assert [found.mesh(i).name for i in range(found.nmesh)] == [expected.mesh(i).name for i in range(expected.nmesh)]
    for name in (
        "mesh_vert",
        "mesh_face",
        "mesh_pos",
        "geom_pos",
        "geom_quat",
        "geom_size",
        "body_mass",
        "tex_data",
        "hfield_data",
    ):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.mark.parametrize("make", SCENES)
def test_kept_scenes_load_from_any_folder(tmp_path, monkeypatch, make):
    main = SCENES[make](tmp_path / "project")
    model = load_model(main)
    kept_scene = scene_file(model, NOTHING)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    same(scene_model(kept_scene), model.compiled)
    for path in (tmp_path / "project").rglob("*.xml"):
        path.unlink()
    same(scene_model(kept_scene), model.compiled)  # the text is in the artefact; only assets are read again


@pytest.mark.parametrize("make", SCENES)
def test_scenes_do_not_depend_on_where_they_are_compiled(tmp_path, monkeypatch, make):
    main = SCENES[make](tmp_path / "project")
    first = scene_file(load_model(main), NOTHING)
    monkeypatch.chdir(main.parent)
    second = scene_file(load_model(Path("scene.xml")), NOTHING)
    assert first == second


def test_kept_scenes_contain_no_folder(tmp_path):
    """In another folder, the scene has the same text and parts; only paths of assets differ."""
    kept_scenes = [scene_file(load_model(attached(tmp_path / name)), NOTHING) for name in ("one", "two")]
    assert kept_scenes[0].mjcf == kept_scenes[1].mjcf
    assert kept_scenes[0].parts == kept_scenes[1].parts
    assert [asset.key for asset in kept_scenes[0].assets] == [asset.key for asset in kept_scenes[1].assets]
    assert [asset.sha256 for asset in kept_scenes[0].assets] == [asset.sha256 for asset in kept_scenes[1].assets]
    assert str(tmp_path) not in kept_scenes[0].mjcf + "".join(kept_scenes[0].parts.values())


def test_changed_or_missing_assets_are_refused(tmp_path):
    main = one_name_in_two_folders(tmp_path)
    kept_scene = scene_file(load_model(main), NOTHING)
    brick(tmp_path / "right" / "tip.stl", 0.05, 0.06, 0.08)
    with pytest.raises(ArtifactError) as caught:
        scene_model(kept_scene)
    assert (
        str(caught.value) == f"asset {tmp_path.resolve()}/right/tip.stl has changed since the scene was compiled; compile again"
    )
    (tmp_path / "right" / "tip.stl").unlink()
    with pytest.raises(ArtifactError) as caught:
        scene_model(kept_scene)
    assert str(caught.value) == (
        f"asset {tmp_path.resolve()}/right/tip.stl of the scene cannot be read: No such file or directory; compile again"
    )


DOCUMENT = """
tgdsl: 1
robot:
  model: scene.xml
  layout: {resolutions: {only: {pad: {method: grid, rows: 2, columns: 2, direction: [0, 0, -1], radius: 4 mm}}}}
objects: {item: {body: item}}
sensors: {touch: {kind: contact_depth, links: pad, feels: [item]}}
"""


def test_an_artefact_does_not_depend_on_the_current_folder(tmp_path, monkeypatch):
    project = tmp_path / "project"
    included(project)
    (project / "hand.yaml").write_text(DOCUMENT)
    monkeypatch.chdir(tmp_path)
    save_plan(compile_document("project/hand.yaml").plan, "one.safetensors")
    monkeypatch.chdir(project)
    save_plan(compile_document("hand.yaml").plan, "two.safetensors")
    (project / "deep").mkdir()
    monkeypatch.chdir(project / "deep")
    save_plan(compile_document("../hand.yaml").plan, "three.safetensors")
    contents = [
        path.read_bytes()
        for path in (tmp_path / "one.safetensors", project / "two.safetensors", project / "deep" / "three.safetensors")
    ]
    assert contents[0] == contents[1] == contents[2]
    monkeypatch.chdir("/")
    assert tgdsl.simulate(tgdsl.load(tmp_path / "one.safetensors"), 1).model.nmesh == 1


def test_urdf_scenes(tmp_path, monkeypatch):
    for side, size in (("left", 0.02), ("right", 0.04)):
        brick(tmp_path / "hand" / side / "tip.stl", size, size, size)
    links = "".join(
        f"<link name='{name}'><collision><geometry><mesh filename='{side}/tip.stl' scale='1 2 1'/></geometry></collision></link>"
        for name, side in (("pad", "left"), ("tip", "right"))
    )
    joint = "<joint name='j' type='fixed'><parent link='pad'/><child link='tip'/></joint>"
    (tmp_path / "hand" / "hand.urdf").write_text(f"<robot name='r'>{links}{joint}</robot>")
    model = load_model(tmp_path / "hand" / "hand.urdf")
    kept_scene = scene_file(model, NOTHING)
    monkeypatch.chdir("/")
    loaded = scene_model(kept_scene)
    assert loaded.nmesh == 2
    for name in ("mesh_vert", "geom_pos", "geom_size"):
        np.testing.assert_allclose(getattr(loaded, name), getattr(model.compiled, name), atol=1e-6)
    assert str(tmp_path) not in kept_scene.mjcf


def test_the_palm_scene_is_found_by_name_in_another_checkout(tmp_path, monkeypatch):
    plan = compile_document(ROBOTS.parent / "examples" / "xhand1_palm.yaml").plan
    assert plan.scene.assets
    assert all(asset.path.startswith("robots:xhand1/") for asset in plan.scene.assets)
    shutil.copytree(ROBOTS, tmp_path / "robots")
    monkeypatch.setattr("tgdsl.scene.scene.robots_folder", lambda: tmp_path / "robots")
    monkeypatch.chdir(tmp_path)
    model = scene_model(plan.scene)
    assert {model.body(i).name for i in range(model.nbody)} >= {"cube", "right_hand_link"}
    assert len(sensors_of(model)) == len(plan.inputs.pairs)
