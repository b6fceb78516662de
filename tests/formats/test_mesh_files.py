"""Mesh files that MuJoCo does not read: placed, scaled, named once and embedded in artefacts."""

import json
import sys
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from robot_files import MESH_TOLERANCE, model_of, nearest, trimesh_of, wedge
from scipy.spatial.transform import Rotation

import tgdsl
from tgdsl.errors import RobotError
from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.scene.scene import scene_model

INERTIAL = "<inertial><mass value='.1'/><inertia ixx='1e-5' iyy='1e-5' izz='1e-5' ixy='0' ixz='0' iyz='0'/></inertial>"
READ_BY_TRIMESH = "meshes read by trimesh, without textures"


def small() -> trimesh.Trimesh:
    return wedge().apply_scale(1e-3)


def two_nodes() -> tuple[trimesh.Scene, np.ndarray]:
    """Return a scene of one mesh at two nested nodes, and its vertices."""
    first, second = np.eye(4), np.eye(4)
    first[:3, :3], first[:3, 3] = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix(), [0.01, 0.02, 0.03]
    second[:3, 3] = [0.0, 0.0, 0.05]
    scene = trimesh.Scene()
    scene.add_geometry(small(), node_name="upper", geom_name="part", transform=first)
    scene.graph.update(frame_to="lower", frame_from="upper", geometry="part", matrix=second)
    points = np.concatenate([small().vertices, small().vertices + second[:3, 3]])
    return scene, points @ first[:3, :3].T + first[:3, 3]


def written(scene: trimesh.Scene, folder: Path, name: str) -> None:
    if name.endswith(".gltf"):  # its buffers are separate files
        for file, content in scene.export(file_type="gltf").items():
            (folder / (name if file == "model.gltf" else file)).write_bytes(content)
    elif name.endswith(".glb"):
        scene.export(folder / name)
    else:
        scene.to_mesh().export(folder / name)


def urdf_of(folder: Path, *meshes: str) -> Path:
    links = "".join(
        f"<link name='link{i}'>{INERTIAL}<collision><origin xyz='.1 0 0' rpy='0 0 1.5'/><geometry>{mesh}</geometry></collision></link>"
        for i, mesh in enumerate(meshes)
    )
    joints = "".join(
        f"<joint name='j{i}' type='continuous'><origin xyz='0 0 {i}'/><parent link='link0'/><child link='link{i}'/></joint>"
        for i in range(1, len(meshes))
    )
    path = folder / "my hand.urdf"
    path.write_text(f"<robot name='hand'>{links}{joints}</robot>")
    return path


def loaded(path: Path) -> tuple[Model, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return load_model(path), [str(w.message) for w in caught]


@pytest.mark.parametrize("ending", ["glb", "gltf", "GLB", "ply", "off"])
@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (2.0, -1.0, 0.5)])
def test_urdf_meshes_are_placed_and_scaled(tmp_path, ending, scale):
    scene, points = two_nodes()
    written(scene, tmp_path, f"a part.{ending.lower()}")
    (tmp_path / f"a part.{ending.lower()}").rename(tmp_path / f"a part.{ending}")
    path = urdf_of(
        tmp_path, f"<mesh filename='a part.{ending}' scale='{' '.join(map(str, scale))}'/>", "<sphere radius='.01'/>"
    )
    model, messages = loaded(path)
    rotation = Rotation.from_euler("z", 1.5).as_matrix()
    assert nearest(trimesh_of(model, "link0").vertices, (points * scale) @ rotation.T + [0.1, 0, 0]) < MESH_TOLERANCE
    axes = " and with Y not turned up to Z" if ending.lower() in ("glb", "gltf") else ""
    assert messages == [f"{path}: {READ_BY_TRIMESH}{axes}: a part.{ending}"]


def test_seams_of_normals_do_not_open_a_mesh(tmp_path):
    """GlTF stores a vertex once per normal; the solid merges them."""
    mesh = small()
    seams = trimesh.Trimesh(
        mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
    )
    trimesh.Scene(seams).export(tmp_path / "a.glb")
    model, _ = loaded(urdf_of(tmp_path, "<mesh filename='a.glb'/>"))
    result = trimesh_of(model, "link0")
    assert result.is_watertight and len(result.vertices) == len(mesh.vertices)
    assert result.volume == pytest.approx(mesh.volume, rel=1e-5)


def test_files_with_one_stem_stay_separate_and_are_named_once(tmp_path):
    small().export(tmp_path / "part.stl")
    trimesh.Scene(trimesh.creation.box([0.02, 0.04, 0.06])).export(tmp_path / "part.glb")
    meshes = [f"<mesh filename='part.{ending}'/>" for ending in ("stl", "glb", "glb")]
    model, messages = loaded(urdf_of(tmp_path, *meshes))
    assert len(messages) == 1 and messages[0].endswith(": part.glb")
    assert trimesh_of(model, "link0").volume == pytest.approx(small().volume, rel=1e-4)
    for link in ("link1", "link2"):
        assert trimesh_of(model, link).volume == pytest.approx(0.02 * 0.04 * 0.06, rel=1e-5)


@pytest.mark.parametrize("ending", ["glb", "stl", "obj"])
def test_a_flat_visual_is_read(tmp_path, ending):
    plate = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]], [[0, 1, 2], [1, 3, 2]])
    trimesh.Scene(plate).export(tmp_path / f"logo.{ending}")
    path = tmp_path / "hand.urdf"
    path.write_text(
        f"<robot name='hand'><link name='a'>{INERTIAL}<visual><geometry><mesh filename='logo.{ending}'/></geometry></visual></link></robot>"
    )
    model, _ = loaded(path)
    assert trimesh_of(model, "a").area == pytest.approx(0.01)


def test_an_artefact_embeds_meshes(tmp_path, monkeypatch):
    two_nodes()[0].export(tmp_path / "a.glb")
    urdf_of(tmp_path, "<mesh filename='a.glb'/>")
    document = {
        "tgdsl": 1,
        "robot": {
            "model": "my hand.urdf",
            "layout": {"resolutions": {"low": {"link0": {"method": "poisson", "count": 20, "radius": "4 mm"}}}},
        },
        "resolution": "low",
        "objects": {"ball": {"geom": {"type": "sphere", "size": [0.01]}}},
        "sensors": {"touch": {"kind": "contact_depth", "links": "link0", "feels": ["ball"]}},
    }
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match="read by trimesh"):
        touch = tgdsl.compile(document)
    tgdsl.save(touch, "touch.safetensors")
    (tmp_path / "a.glb").unlink()
    sim = tgdsl.simulate(tgdsl.load("touch.safetensors"), 1)
    sim.step()
    assert sim.model.nmesh == 1


def _draco(folder: Path) -> None:
    scene = two_nodes()[0].export(file_type="gltf")
    tree = json.loads(scene["model.gltf"]) | {"extensionsRequired": ["KHR_materials_unlit", "KHR_draco_mesh_compression"]}
    (folder / "a.gltf").write_text(json.dumps(tree))


@pytest.mark.parametrize(
    ("name", "write", "what"),
    [
        ("a.glb", lambda folder: (folder / "a.glb").write_bytes(b"glTF, but no more"), "not glTF 2.0"),
        ("a.gltf", _draco, "this mesh is stored by KHR_draco_mesh_compression, which cannot be read"),
        (
            "a.gltf",
            lambda folder: written(two_nodes()[0], folder, "a.gltf") or (folder / "gltf_buffer_0.bin").unlink(),
            "trimesh cannot read",
        ),
        ("a.off", lambda folder: (folder / "a.off").write_text("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n"), "this mesh"),
        ("a.step", lambda folder: (folder / "a.step").write_text(""), 'mesh "a.step": expected one of .stl, .obj, .msh, .glb'),
    ],
)
def test_unreadable_meshes_are_named(tmp_path, name, write, what):
    write(tmp_path)
    path = urdf_of(tmp_path, f"<mesh filename='{name}'/>")
    with pytest.raises(RobotError, match=r"my hand\.urdf|a\.") as caught:
        load_model(path)
    assert what in str(caught.value) and name in str(caught.value)


def test_collada_without_its_package_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "collada", None)
    (tmp_path / "a.dae").write_text("<COLLADA/>")
    with pytest.raises(
        RobotError, match=r"a\.dae: this mesh needs another package: .*collada.*; or convert it to \.stl or \.obj"
    ):
        load_model(urdf_of(tmp_path, "<mesh filename='a.dae'/>"))


def test_mjcf_with_such_meshes_is_refused_with_advice(tmp_path):
    trimesh.Scene(small()).export(tmp_path / "a.glb")
    with pytest.raises(RobotError) as caught:
        model_of(tmp_path, "<geom type='mesh' mesh='a'/>", "<mesh file='a.glb'/>")
    advice = "convert them, such as by trimesh.load_scene(FILE).to_mesh().export(OTHER)"
    assert str(caught.value) == f"{tmp_path / 'robot.xml'}: MJCF's meshes are files of .stl, .obj, .msh, found a.glb; {advice}"


def two_boxes(mark: str) -> str:
    """Return an OBJ file of two 1 cm boxes side by side, each a separate object or group."""
    text, first = "# by hand\n", 1
    for i in range(2):
        box = trimesh.creation.box((0.01, 0.01, 0.01))
        box.apply_translation((0.03 * i, 0, 0))
        text += f"{mark} box {i}\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices)
        text += "".join(f"f {' '.join(str(corner + first) for corner in face)}\n" for face in box.faces)
        first += len(box.vertices)
    return text


@pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning")  # taxels between the boxes lie in their convex hull
@pytest.mark.parametrize("mark", ["o", "g"])
def test_all_objects_of_an_obj_file_are_read(tmp_path, mark):
    """MuJoCo alone reads the first: half of the faces."""
    (tmp_path / "two.obj").write_text(two_boxes(mark))
    scene = f"""<mujoco><asset><mesh file="{tmp_path / "two.obj"}"/></asset><worldbody>
      <body name="hand"><geom type="mesh" mesh="two"/></body></worldbody></mujoco>"""
    assert mujoco.MjModel.from_xml_string(scene).mesh_facenum.tolist() == [12]
    (tmp_path / "scene.xml").write_text(scene)
    with pytest.warns(UserWarning, match=r"reads the first object of an OBJ file alone; .* read whole: two\.obj \(2\)"):
        model = load_model(tmp_path / "scene.xml")
    assert model.compiled.mesh_facenum.tolist() == [24]
    surface = model.surface(model.rigid_geoms([model.compiled.body("hand").id]))
    assert trimesh.Trimesh(surface.vertices, surface.faces).area == pytest.approx(2 * 6 * 0.01**2)
    with pytest.warns(UserWarning, match="read whole"):
        touch = tgdsl.compile(
            {
                "tgdsl": 1,
                "robot": {
                    "model": str(tmp_path / "scene.xml"),
                    "layout": {"resolutions": {"r": {"hand": {"method": "poisson", "count": 200, "radius": 0.001}}}},
                },
                "objects": {"ball": {"geom": {"type": "sphere", "size": [0.01]}, "pos": [0, 0, 1]}},
                "sensors": {"s": {"kind": "contact_depth", "links": "hand", "feels": ["ball"]}},
            }
        )
    assert abs((touch.plan.layout.pos[:, 0] > 0.015).mean() - 0.5) < 0.1
    assert scene_model(touch.plan.scene).mesh_facenum.tolist() == [24]


def test_a_missing_file_of_mjcf_names_one_in_another_case(tmp_path):
    small().export(tmp_path / "finger.stl")
    body = '<body name="a"><geom type="mesh" mesh="m"/></body>'
    text = f'<mujoco><asset><mesh name="m" file="Finger.STL"/></asset><worldbody>{body}</worldbody></mujoco>'
    (tmp_path / "hand.xml").write_text(text)
    with pytest.raises(RobotError, match=r"hand\.xml: .*'Finger\.STL'; there is finger\.stl$"):
        load_model(tmp_path / "hand.xml").bodies  # noqa: B018
