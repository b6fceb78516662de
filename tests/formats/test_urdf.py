"""URDF: meshes found and placed, inertias repaired, and error messages."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from robot_files import MESH_TOLERANCE, nearest, trimesh_of, wedge
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.robot import load_model

BALL = "<inertial><mass value='.1'/><inertia ixx='1e-5' iyy='1e-5' izz='1e-5' ixy='0' ixz='0' iyz='0'/></inertial>"


def urdf_of(folder: Path, links: str, name: str = "hand.urdf") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"<robot name='hand'>{links}</robot>")
    return path


def link_of(name: str, geometry: str, inertial: str = BALL, origin: str = "") -> str:
    return f"<link name='{name}'>{inertial}<collision>{origin}<geometry>{geometry}</geometry></collision></link>"


def joint_of(name: str, parent: str, child: str, kind: str = "fixed") -> str:
    limit = (
        "<origin xyz='.1 0 0'/><limit lower='-1' upper='1' effort='1' velocity='1'/><axis xyz='0 0 1'/>"
        if kind != "fixed"
        else ""
    )
    return f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{limit}</joint>"


@pytest.mark.parametrize(
    "reference",
    [
        "wedge.stl",
        "./meshes/../wedge.stl",
        "package://hand_pkg/urdf/wedge.stl",
        "package://hand_description/urdf/wedge.stl",
        "model://hand_pkg/urdf/wedge.stl",
        "file://wedge.stl",
    ],
)
def test_urdf_meshes_keep_their_pose(tmp_path, reference):
    folder = tmp_path / "hand_pkg" / "urdf"
    origin = "<origin xyz='.01 -.02 .03' rpy='.3 -.4 .5'/>"
    mesh = f"<mesh filename='{reference}' scale='.001 .001 .001'/>"
    path = urdf_of(
        folder, link_of("palm", mesh, origin=origin) + link_of("tip", "<sphere radius='.01'/>") + joint_of("j", "palm", "tip")
    )
    (folder / "meshes").mkdir()
    (folder.parent / "package.xml").write_text("<package format='3'><name>hand_description</name></package>")
    wedge().export(folder / "wedge.stl")
    model = load_model(path)
    assert model.is_rounded
    rotation = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    expected = (wedge().vertices * 1e-3) @ rotation.T + [0.01, -0.02, 0.03]
    assert nearest(trimesh_of(model, "palm").vertices, expected) < MESH_TOLERANCE
    assert model.bodies == ("world", "palm", "tip")  # a fixed link keeps its body
    assert [geom.mesh for geom in model.geoms] == ["wedge", ""]


@pytest.mark.parametrize("reference", ["wedge.STL", "package://hand/wedge.STL"])
def test_a_missing_mesh_names_a_file_in_another_case(tmp_path, reference):
    path = urdf_of(tmp_path / "hand", link_of("palm", f"<mesh filename='{reference}'/>"))
    wedge().export(tmp_path / "hand" / "wedge.stl")
    with pytest.raises(RobotError, match=r"; there is wedge\.stl$"):
        load_model(path)


def test_urdf_primitives_and_joints(tmp_path):
    links = link_of("base", "<box size='.02 .04 .06'/>") + link_of("a", "<cylinder radius='.01' length='.04'/>")
    path = urdf_of(tmp_path, links + joint_of("j", "base", "a", "revolute"), "hand.xml")  # recognised by its root element
    model = load_model(path)
    assert model.is_rounded
    assert [geom.shape for geom in model.geoms] == ["box", "cylinder"]
    np.testing.assert_allclose(trimesh_of(model, "base").extents, [0.02, 0.04, 0.06])
    np.testing.assert_allclose(trimesh_of(model, "a").extents, [0.02, 0.02, 0.04], rtol=2e-3)
    assert model.compiled.njnt == 1


def test_a_fixed_base_does_not_collide_with_its_first_links(tmp_path):
    """The thumb reaches into the palm; the index, one joint further, collides with the palm."""
    ball = "<sphere radius='.06'/>"
    links = (
        link_of("palm", ball) + link_of("mount", "<sphere radius='.001'/>") + link_of("thumb", ball) + link_of("index", ball)
    )
    joints = (
        joint_of("m", "palm", "mount")
        + joint_of("t", "mount", "thumb", "revolute")
        + joint_of("i", "thumb", "index", "revolute")
    )
    path = urdf_of(tmp_path, links + joints.replace(".1 0 0", ".11 0 0"))
    with pytest.warns(UserWarning, match="overlap where a joint connects them do not collide: palm and thumb$"):
        model = load_model(path)
    data = mujoco.MjData(model.compiled)
    mujoco.mj_forward(model.compiled, data)
    assert data.ncon == 0
    data.joint("t").qpos = 0.9 * np.pi  # the index comes onto the palm
    mujoco.mj_forward(model.compiled, data)
    assert {"palm", "index"} in [
        {model.compiled.body(model.compiled.geom_bodyid[g]).name for g in c.geom} for c in data.contact
    ]
    assert mujoco.MjModel.from_xml_string(model.mjcf).nexclude == 1


def test_impossible_inertias_are_repaired_with_one_warning(tmp_path):
    def inertial(*moments: float) -> str:
        attributes = " ".join(f"i{axes}='{m}'" for axes, m in zip(("xx", "yy", "zz", "xy", "xz", "yz"), moments, strict=True))
        return f"<inertial><mass value='.1'/><inertia {attributes}/></inertial>"

    inertias = {
        "base": inertial(1e-5, 1e-5, 1e-5, 0, 0, 0),
        "flat": inertial(1e-5, 1e-5, 2e-5, 0, 0, 0),  # a disc: the limit of possible inertias
        "zero": inertial(0, 0, 0, 0, 0, 0),
        "long": inertial(1e-6, 1e-6, 1e-5, 0, 0, 0),  # breaks the triangle inequality
        "skew": inertial(1e-5, 1e-5, 1e-5, 2e-5, 0, 0),  # not positive definite
    }
    links = "".join(link_of(name, "<sphere radius='.01'/>", inertia) for name, inertia in inertias.items())
    names = list(inertias)
    path = urdf_of(tmp_path, links + "".join(joint_of(f"j{n}", names[0], n, "revolute") for n in names[1:]))
    with pytest.warns(UserWarning, match="mended") as caught:
        model = load_model(path)
    assert [str(w.message) for w in caught] == [f"{path}: inertias that no body can have were mended: zero, long, skew"]
    moments = {name: model.compiled.body(name).inertia for name in names}
    np.testing.assert_allclose(moments["base"], 1e-5)
    np.testing.assert_allclose(moments["flat"], [2e-5, 1e-5, 1e-5])
    np.testing.assert_allclose(moments["zero"], 1e-9)
    np.testing.assert_allclose(moments["long"], 4e-6)
    np.testing.assert_allclose(moments["skew"], 1e-5)


def test_urdf_links_without_mass_or_moments_can_move(tmp_path):
    links = link_of("base", "<sphere radius='.01'/>") + "<link name='knuckle'/>"
    links += link_of("tip", "<sphere radius='.01'/>", "<inertial><mass value='.1'/></inertial>")
    links += link_of(
        "pad", "<sphere radius='.01'/>", "<inertial><mass value='0'/><inertia ixx='0' iyy='0' izz='0'/></inertial>"
    )
    joints = (("base", "knuckle"), ("knuckle", "tip"), ("tip", "pad"))
    path = urdf_of(tmp_path, links + "".join(joint_of(f"{one}_{two}", one, two, "revolute") for one, two in joints))
    with pytest.warns(UserWarning, match="mended: knuckle, tip, pad$"):
        model = load_model(path).compiled
    np.testing.assert_allclose(model.body_mass[1:], [0.1, 1e-6, 0.1, 1e-6])
    np.testing.assert_allclose(model.body_inertia[2:], 1e-9)


@pytest.mark.parametrize("turn", range(8))
def test_urdf_inertias_at_the_limit_survive_writing(tmp_path, turn):
    """A plate's largest moment is the sum of the others; rounded to six digits it may exceed it."""
    rotation = Rotation.from_euler("xyz", [0.3 * turn, 0.5, 0.7]).as_matrix()
    plate = rotation @ np.diag([1.06853e-5 + 1e-12 * turn, 4.10897e-5, 5.17750e-5 + 1e-12 * turn]) @ rotation.T
    names = {"xx": (0, 0), "yy": (1, 1), "zz": (2, 2), "xy": (0, 1), "xz": (0, 2), "yz": (1, 2)}
    moments = " ".join(f"i{axes}='{float(plate[place])!r}'" for axes, place in names.items())
    inertial = f"<inertial><mass value='.1'/><inertia {moments}/></inertial>"
    links = link_of("base", "<sphere radius='.01'/>") + link_of("plate", "<sphere radius='.01'/>", inertial)
    model = load_model(urdf_of(tmp_path, links + joint_of("j", "base", "plate", "revolute")))
    reloaded = mujoco.MjModel.from_xml_string(model.mjcf)
    np.testing.assert_allclose(reloaded.body_inertia, model.compiled.body_inertia, rtol=2e-5)


def test_urdf_geoms_with_one_name_are_numbered(tmp_path, capfd):
    def geom(tag: str, name: str) -> str:
        return f"<{tag}{name and f' name={name!r}'}><geometry><sphere radius='.01'/></geometry></{tag}>"

    one = geom("collision", "pad") + geom("collision", "pad") + geom("collision", "") + geom("visual", "pad_2")
    two = geom("visual", "shell") + geom("collision", "") + geom("collision", "pad")
    links = f"<link name='a'>{BALL}{one}</link><link name='b'>{BALL}{two}</link>"
    model = load_model(urdf_of(tmp_path, links + joint_of("j", "a", "b", "revolute")))
    names = {body: sorted(geom.name for geom in model.geoms if geom.body == body) for body in ("a", "b")}
    assert names == {"a": ["", "pad", "pad_2", "pad_3"], "b": ["", "pad_4", "shell"]}
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("declared", ["", " xmlns:drake='http://drake.mit.edu'"])
def test_urdf_tags_of_other_programs_are_ignored(tmp_path, declared):
    foreign = "<drake:collision_filter_group name='g'><drake:member link='base'/></drake:collision_filter_group>"
    path = tmp_path / "hand.urdf"
    body = link_of("base", "<sphere radius='.01'/>").replace("</link>", "<drake:diaphragm/></link>")
    path.write_text(f"<?xml version='1.0' encoding='utf-8'?>\n<!-- a:b --><robot name='hand'{declared}>{foreign}{body}</robot>")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = load_model(path)
    assert model.bodies == ("world", "base") and not caught


def test_valid_urdf_gives_no_warning(tmp_path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_model(urdf_of(tmp_path, link_of("base", "<sphere radius='.01'/>")))
    assert [str(w.message) for w in caught] == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (link_of("a", "<mesh filename='gone.stl'/>"), 'mesh "gone.stl": there is no file {folder}/gone.stl'),
        (
            link_of("a", "<mesh filename='package://pkg/m/gone.stl'/>"),
            'mesh "package://pkg/m/gone.stl": no folder above the file holds "pkg/m/gone.stl"',
        ),
        ("<link>", "not XML: mismatched tag: line 1, column 27"),
        ("<a:b><link></a:b>", "not XML: unbound prefix: line 1, column 19"),
    ],
)
def test_urdf_errors(tmp_path, text, message):
    path = urdf_of(tmp_path, text)
    with pytest.raises(RobotError) as caught:
        load_model(path)
    assert str(caught.value) == f"{path}: {message.format(folder=tmp_path.resolve())}"


@pytest.mark.parametrize("declared", ["", " xmlns:xacro='http://www.ros.org/wiki/xacro'"])
def test_xacro_is_refused(tmp_path, declared):
    """Its links are in included files; without them the world would be empty."""
    path = tmp_path / "hand.urdf.xacro"
    path.write_text(f"<robot name='hand'{declared}><xacro:include filename='fingers.xacro'/></robot>")
    with pytest.raises(RobotError, match=r"this is xacro, make URDF from it: xacro hand\.urdf\.xacro > hand\.urdf"):
        load_model(path)


def test_a_mesh_in_another_case_is_named(tmp_path):
    wedge().export(tmp_path / "Wedge.STL")
    with pytest.raises(RobotError, match=r'mesh "wedge\.stl": there is no file .*; there is Wedge\.STL'):
        load_model(urdf_of(tmp_path, link_of("a", "<mesh filename='wedge.stl'/>")))


def test_an_invalid_number_in_a_urdf_is_located(tmp_path):
    bad = BALL.replace("ixx='1e-5'", "ixx='abc'")
    path = urdf_of(tmp_path, link_of("a", "<sphere radius='.01'/>", bad))
    with pytest.raises(RobotError, match=r"hand\.urdf: .*'ixx'.*inertia.*line 1"):
        load_model(path)


def test_urdf_meshes_with_one_name_in_two_folders_stay_separate(tmp_path):
    for folder, size in (("left", 0.02), ("right", 0.04)):
        (tmp_path / folder).mkdir()
        trimesh.creation.box((size, size, size)).export(tmp_path / folder / "tip.stl")
    links = link_of("a", "<mesh filename='left/tip.stl'/>") + link_of("b", "<mesh filename='right/tip.stl'/>")
    links += link_of("c", "<mesh filename='right/tip.stl' scale='2 2 2'/>")
    model = load_model(urdf_of(tmp_path, links + joint_of("j", "a", "b") + joint_of("k", "a", "c")))
    assert [geom.mesh for geom in model.geoms] == ["tip", "tip_2", "tip_21"]
    np.testing.assert_allclose(trimesh_of(model, "c").extents, 0.08, rtol=1e-5)
    np.testing.assert_allclose(trimesh_of(model, "a").extents, 0.02, rtol=1e-5)
    np.testing.assert_allclose(trimesh_of(model, "b").extents, 0.04, rtol=1e-5)
