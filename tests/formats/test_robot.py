"""Robot files: surfaces against closed forms, meshes at their original place, `can_meet` against MuJoCo itself."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats.mjcf import xml_files
from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.surfaces.geom import Geom

ROBOTS = Path(__file__).parents[2] / "robots"
TESSELLATION = 0.01
"""Round shapes are inscribed polyhedra: 96 sections lack 0.14 %, an icosphere of 2,562 vertices 0.3 %, 64 × 64 0.5 %."""
MESH_TOLERANCE = 1e-6
"""MuJoCo keeps vertices in float32, relative to the centre of the mesh: 1e-8 m for a hand; 1e-6 m is the contract."""
MOUNT = "pos='.01 -.02 .03' quat='.9 .1 -.3 .2'"
MOUNT_POS = np.array([0.01, -0.02, 0.03])
MOUNT_ROTATION = Rotation.from_quat([0.9, 0.1, -0.3, 0.2], scalar_first=True).as_matrix()


def model_of(folder: Path, body: str, asset: str = "", rest: str = "", name: str = "robot.xml") -> Model:
    """Load MJCF with one body, `pad`."""
    text = f"<mujoco><asset>{asset}</asset><worldbody><body name='pad'>{body}</body>{rest}</worldbody></mujoco>"
    (folder / name).write_text(text)
    return load_model(folder / name)


def trimesh_of(model: Model, body: str = "pad") -> trimesh.Trimesh:
    surface = model.surface(model.touchable(body))
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


def wedge() -> trimesh.Trimesh:
    """An asymmetric solid, far from its own origin: its centre of mass and its principal axes are nowhere special."""
    points = np.array([[3.0, 1, 2], [7, 1, 2], [3, 4, 2.5], [3.5, 1, 9], [6, 3, 5]])
    return trimesh.convex.convex_hull(points)


def nearest(points: np.ndarray, others: np.ndarray) -> float:
    """Return the largest distance from a point to its nearest other, both ways."""
    gaps = np.linalg.norm(points[:, None] - others[None], axis=2)
    return max(gaps.min(axis=0).max(), gaps.min(axis=1).max())


PRIMITIVES = {
    "box": ((0.01, 0.02, 0.03), 8 * 6e-6, 8 * (2e-4 + 3e-4 + 6e-4), (0.01, 0.02, 0.03)),
    "sphere": ((0.02,), 4 / 3 * np.pi * 8e-6, 4 * np.pi * 4e-4, (0.02, 0.02, 0.02)),
    "ellipsoid": ((0.02, 0.01, 0.03), 4 / 3 * np.pi * 6e-6, None, (0.02, 0.01, 0.03)),
    "cylinder": ((0.02, 0.03), np.pi * 4e-4 * 0.06, 2 * np.pi * (4e-4 + 0.02 * 0.06), (0.02, 0.02, 0.03)),
    "capsule": (
        (0.02, 0.03),
        np.pi * 4e-4 * 0.06 + 4 / 3 * np.pi * 8e-6,
        2 * np.pi * 0.02 * 0.06 + 4 * np.pi * 4e-4,
        (0.02, 0.02, 0.05),
    ),
}
"""Size, volume [m³], area [m²] (none: no elementary formula) and half extents [m] of each."""


@pytest.mark.parametrize("mount", ["", MOUNT], ids=["at_origin", "mounted"])
@pytest.mark.parametrize("shape", PRIMITIVES)
def test_surfaces_of_primitives(tmp_path, shape, mount):
    size, volume, area, half = PRIMITIVES[shape]
    text = " ".join(map(str, size))
    mesh = trimesh_of(model_of(tmp_path, f"<geom type='{shape}' size='{text}' {mount}/>"))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert volume * (1 - TESSELLATION) <= mesh.volume <= volume * (1 + 1e-9)  # inscribed, and faces look outwards
    if area is not None:
        assert area * (1 - TESSELLATION) <= mesh.area <= area * (1 + 1e-9)
    pos, rotation = (MOUNT_POS, MOUNT_ROTATION) if mount else (np.zeros(3), np.eye(3))
    local = (mesh.vertices - pos) @ rotation
    np.testing.assert_allclose(local.max(axis=0), half, rtol=2e-3)
    np.testing.assert_allclose(local.min(axis=0), -np.array(half), rtol=2e-3)
    np.testing.assert_allclose(mesh.center_mass, pos, atol=1e-6)


def test_ellipsoid_vertices_are_on_it(tmp_path):
    mesh = trimesh_of(model_of(tmp_path, "<geom type='ellipsoid' size='.02 .01 .03'/>"))
    np.testing.assert_allclose(((mesh.vertices / [0.02, 0.01, 0.03]) ** 2).sum(axis=1), 1, rtol=1e-9)


def test_fromto_and_compiler_angles_are_mujocos(tmp_path):
    mesh = trimesh_of(model_of(tmp_path, "<geom type='capsule' size='.01' fromto='.01 0 0 .05 0 0'/>"))
    np.testing.assert_allclose(mesh.bounds, [[0, -0.01, -0.01], [0.06, 0.01, 0.01]], atol=3e-5)


@pytest.mark.parametrize("scale", ["", "scale='1e-3 1e-3 1e-3'", "scale='2e-3 -1e-3 1e-3'"], ids=["metres", "mm", "mirrored"])
def test_meshes_come_back_at_their_place(tmp_path, scale):
    solid = wedge()
    if not scale:
        solid.apply_scale(1e-3)
    solid.export(tmp_path / "wedge.stl")
    factor = {"": [1, 1, 1], "scale='1e-3 1e-3 1e-3'": [1e-3] * 3}.get(scale, [2e-3, -1e-3, 1e-3])
    model = model_of(tmp_path, f"<geom type='mesh' mesh='wedge' {MOUNT}/>", f"<mesh file='wedge.stl' {scale}/>")
    assert np.abs(model.compiled.mesh_pos).max() > 1e-3  # MuJoCo has moved it, or this would test nothing
    found, expected = trimesh_of(model), (solid.vertices * factor) @ MOUNT_ROTATION.T + MOUNT_POS
    assert nearest(found.vertices, expected) < MESH_TOLERANCE
    np.testing.assert_allclose(found.volume, solid.volume * abs(np.prod(factor)), rtol=1e-5)


def test_two_meshes_and_a_primitive_on_one_body(tmp_path):
    wedge().apply_scale(1e-3).export(tmp_path / "wedge.stl")
    trimesh.creation.box((0.01, 0.02, 0.03)).apply_translation([0.05, 0, 0]).export(tmp_path / "brick.obj")
    geoms = "<geom type='mesh' mesh='wedge'/><geom name='extra' type='mesh' mesh='brick' pos='0 .1 0'/><geom size='.01'/>"
    model = model_of(tmp_path, geoms, "<mesh file='wedge.stl'/><mesh file='brick.obj'/>")
    surface = model.surface(model.touchable("pad"))
    assert surface.geoms == (("wedge",), ("extra", "brick"), ())
    for index, (low, high) in enumerate(
        [((0.003, 0.001, 0.002), (0.007, 0.004, 0.009)), ((0.045, 0.09, -0.015), (0.055, 0.11, 0.015))]
    ):
        corners = surface.corners[surface.face_geom == index].reshape(-1, 3)
        np.testing.assert_allclose([corners.min(axis=0), corners.max(axis=0)], [low, high], atol=MESH_TOLERANCE)


def test_names_of_bodies_and_geoms(tmp_path):
    wedge().apply_scale(1e-3).export(tmp_path / "wedge.stl")
    body = "<geom type='mesh' mesh='wedge'/><geom name='tip' type='sphere' size='.01' contype='0' conaffinity='0'/><body><geom size='.1'/></body>"
    model = model_of(tmp_path, body, "<mesh file='wedge.stl'/>", "<geom name='floor' type='plane' size='1 1 1'/>")
    assert model.bodies == ("world", "pad")
    assert [(geom.body, geom.shape, geom.names) for geom in model.geoms] == [
        ("world", "plane", ("floor",)),
        ("pad", "mesh", ("wedge",)),
        ("pad", "sphere", ("tip",)),
    ]
    assert [geom.shown for geom in model.geoms[1:]] == ['geom "wedge"', 'geom "tip"']
    assert [geom.names for geom in model.touchable("pad")] == [("wedge",)]  # the sphere is only seen


def test_a_body_that_collides_nowhere_is_touchable_all_over(tmp_path):
    seen = "contype='0' conaffinity='0'"
    model = model_of(tmp_path, f"<geom name='a' size='.01' {seen}/><geom name='b' size='.01' {seen}/>")
    assert [geom.name for geom in model.touchable("pad")] == ["a", "b"]
    assert model.touchable("world") == ()


@pytest.mark.parametrize(
    ("geom", "shown"),
    [("<geom name='g' type='plane' size='1 1 1'/>", 'geom "g"'), ("<geom type='hfield' hfield='h'/>", "unnamed hfield geom 0")],
)
def test_unbounded_surfaces_are_refused(tmp_path, geom, shown):
    model = model_of(tmp_path, geom, "<hfield name='h' nrow='3' ncol='3' size='1 1 .1 .1'/>")
    with pytest.raises(RobotError) as caught:
        model.surface(model.touchable("pad"))
    assert str(caught.value) == f"{tmp_path / 'robot.xml'}: {shown} of body pad has no bounded surface to put taxels on"


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("<mujoco><worldbody><geom size='.1'></worldbody></mujoco>", ("XML",)),
        ("<mujoco><worldbody><gem size='.1'/></worldbody></mujoco>", ("unrecognized", "gem", "line 1")),
        ("<mujoco><worldbody><geom size='.1' colour='1'/></worldbody></mujoco>", ("colour", "geom", "line 1")),
        ("<mujoco><worldbody><geom type='mesh' mesh='no'/></worldbody></mujoco>", ("no",)),
        ("<mujoco><asset><mesh file='gone.stl'/></asset></mujoco>", ("gone.stl",)),
        ("<mujoco><worldbody><body name='a'><freejoint/></body></worldbody></mujoco>", ("mass", "a")),
    ],
    ids=["broken", "element", "attribute", "reference", "file", "compile"],
)
def test_what_mujoco_refuses_is_told_with_file_and_element(tmp_path, text, parts):
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(RobotError) as caught:
        load_model(tmp_path / "bad.xml")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'bad.xml'}: ")
    assert "\n" not in message
    assert all(part in message for part in parts)


def test_files_that_a_model_is_made_of(tmp_path):
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / "hand.xml").write_text(
        "<mujoco><worldbody><body name='hand'><geom size='.1'/></body></worldbody></mujoco>"
    )
    (tmp_path / "floor.xml").write_text("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>")
    (tmp_path / "main.xml").write_text(
        "<mujoco><include file='floor.xml'/><asset><model name='h' file='hand/hand.xml'/></asset>"
        "<worldbody><attach model='h' body='hand' prefix='x_'/></worldbody></mujoco>"
    )
    assert load_model(tmp_path / "main.xml").bodies == ("world", "x_hand")
    assert sorted(path.name for path in xml_files(tmp_path / "main.xml")) == ["floor.xml", "hand.xml", "main.xml"]


# URDF

BALL = "<inertial><mass value='.1'/><inertia ixx='1e-5' iyy='1e-5' izz='1e-5' ixy='0' ixz='0' iyz='0'/></inertial>"


def urdf_of(folder: Path, links: str, name: str = "hand.urdf") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"<robot name='hand'>{links}</robot>")
    return path


def link_of(name: str, geometry: str, inertial: str = BALL, origin: str = "") -> str:
    return f"<link name='{name}'>{inertial}<collision>{origin}<geometry>{geometry}</geometry></collision></link>"


def joint_of(name: str, parent: str, child: str, kind: str = "fixed") -> str:
    limit = "<limit lower='-1' upper='1' effort='1' velocity='1'/><axis xyz='0 0 1'/>" if kind != "fixed" else ""
    return f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{limit}</joint>"


@pytest.mark.parametrize(
    "reference", ["wedge.stl", "./meshes/../wedge.stl", "package://hand_pkg/urdf/wedge.stl", "file://wedge.stl"]
)
def test_urdf_meshes_come_back_at_their_place(tmp_path, reference):
    folder = tmp_path / "hand_pkg" / "urdf"
    origin = "<origin xyz='.01 -.02 .03' rpy='.3 -.4 .5'/>"
    mesh = f"<mesh filename='{reference}' scale='.001 .001 .001'/>"
    path = urdf_of(
        folder, link_of("palm", mesh, origin=origin) + link_of("tip", "<sphere radius='.01'/>") + joint_of("j", "palm", "tip")
    )
    (folder / "meshes").mkdir()
    wedge().export(folder / "wedge.stl")
    model = load_model(path)
    assert model.is_urdf
    rotation = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    expected = (wedge().vertices * 1e-3) @ rotation.T + [0.01, -0.02, 0.03]
    assert nearest(trimesh_of(model, "palm").vertices, expected) < MESH_TOLERANCE
    assert model.bodies == ("world", "palm", "tip")  # a fixed link keeps its body
    assert [geom.mesh for geom in model.geoms] == ["wedge", ""]


def test_urdf_primitives_and_joints(tmp_path):
    links = link_of("base", "<box size='.02 .04 .06'/>") + link_of("a", "<cylinder radius='.01' length='.04'/>")
    path = urdf_of(tmp_path, links + joint_of("j", "base", "a", "revolute"), "hand.xml")  # told by its root, not its name
    model = load_model(path)
    assert model.is_urdf
    assert [geom.shape for geom in model.geoms] == ["box", "cylinder"]
    np.testing.assert_allclose(trimesh_of(model, "base").extents, [0.02, 0.04, 0.06])
    np.testing.assert_allclose(trimesh_of(model, "a").extents, [0.02, 0.02, 0.04], rtol=2e-3)
    assert model.compiled.njnt == 1


def test_urdf_inertias_are_mended_with_one_warning(tmp_path):
    def inertial(*moments: float) -> str:
        attributes = " ".join(f"i{axes}='{m}'" for axes, m in zip(("xx", "yy", "zz", "xy", "xz", "yz"), moments, strict=True))
        return f"<inertial><mass value='.1'/><inertia {attributes}/></inertial>"

    inertias = {
        "base": inertial(1e-5, 1e-5, 1e-5, 0, 0, 0),
        "flat": inertial(1e-5, 1e-5, 2e-5, 0, 0, 0),  # a disc: at the edge of what is possible
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


def test_sound_urdf_gives_no_warning(tmp_path):
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
    ],
)
def test_urdf_errors(tmp_path, text, message):
    path = urdf_of(tmp_path, text)
    with pytest.raises(RobotError) as caught:
        load_model(path)
    assert str(caught.value) == f"{path}: {message.format(folder=tmp_path.resolve())}"


def test_a_number_that_is_none_in_a_urdf(tmp_path):
    bad = BALL.replace("ixx='1e-5'", "ixx='abc'")
    path = urdf_of(tmp_path, link_of("a", "<sphere radius='.01'/>", bad))
    with pytest.raises(RobotError, match=r"hand\.urdf: .*'ixx'.*inertia.*line 1"):
        load_model(path)


def test_urdf_meshes_of_one_name_in_two_folders(tmp_path):
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


# can_meet

FREE = "<freejoint/>"
HINGE = "<joint axis='0 0 1'/>"


def two_bodies(a: str = "", b: str = "", geom_a: str = "", geom_b: str = "", rest: str = "", nested: bool = False) -> str:
    """Return a scene in which the balls of bodies `a` and `b` overlap."""
    inner = f"<body name='b' {b.split('|')[0]}>{b.split('|')[-1]}<geom name='gb' size='.1' {geom_b}/></body>"
    outer = f"<body name='a'>{a}<geom name='ga' size='.1' pos='.05 0 0' {geom_a}/>"
    bodies = f"{outer}{inner}</body>" if nested else f"{outer}</body>{inner}"
    return f"<mujoco><worldbody>{bodies}</worldbody>{rest}</mujoco>"


EXCLUDE = "<contact><exclude body1='b' body2='a'/></contact>"
PAIR = "<contact><pair geom1='ga' geom2='gb'/></contact>"
NO_MASK = "contype='0' conaffinity='0'"
TOUCHING_VISUAL = "<geom name='visual' size='.1' contype='0' conaffinity='0' mass='0'/>"
CASES = {
    "free_bodies": (two_bodies(FREE, f"|{FREE}"), True),
    "one_is_static": (two_bodies("", f"|{FREE}"), True),
    "both_static": (two_bodies(), False),
    "contype_alone": (two_bodies(FREE, f"|{FREE}", "contype='2' conaffinity='0'", "contype='0' conaffinity='2'"), True),
    "conaffinity_alone": (two_bodies(FREE, f"|{FREE}", "contype='0' conaffinity='4'", "contype='4' conaffinity='0'"), True),
    "other_bits": (two_bodies(FREE, f"|{FREE}", "contype='2' conaffinity='2'", "contype='1' conaffinity='1'"), False),
    "contypes_only": (two_bodies(FREE, f"|{FREE}", "contype='1' conaffinity='0'", "contype='1' conaffinity='0'"), False),
    "excluded": (two_bodies(FREE, f"|{FREE}", rest=EXCLUDE), False),
    "parent_and_child": (two_bodies(FREE, f"|{HINGE}", nested=True), False),
    "parent_filter_off": (
        two_bodies(FREE, f"|{HINGE}", nested=True, rest="<option><flag filterparent='disable'/></option>"),
        True,
    ),
    "static_parent_and_child": (two_bodies("", f"|{HINGE}", nested=True), True),
    "welded_child": (two_bodies(FREE, "", nested=True), False),
    "welded_child_filter_off": (
        two_bodies(FREE, "", nested=True, rest="<option><flag filterparent='disable'/></option>"),
        False,
    ),
    "grandchild_through_weld": (
        f"<mujoco><worldbody><body name='a'>{FREE}<geom name='ga' size='.1'/><body name='mid'><geom size='.01' pos='1 0 0'/>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></body></worldbody></mujoco>",
        False,
    ),
    "grandchild": (
        f"<mujoco><worldbody><body name='a'>{FREE}<geom name='ga' size='.1'/><body name='mid'>{HINGE}<geom size='.01' pos='1 0 0'/>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></body></worldbody></mujoco>",
        True,
    ),
    "siblings": (
        f"<mujoco><worldbody><body name='p'>{FREE}<geom size='.01' pos='1 0 0'/><body name='a'>{HINGE}<geom name='ga' size='.1'/></body>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></worldbody></mujoco>",
        True,
    ),
    "explicit_pair_of_masked_geoms": (two_bodies(FREE, f"|{FREE}", NO_MASK, NO_MASK, PAIR), True),
    "explicit_pair_of_excluded": (
        two_bodies(FREE, f"|{FREE}", rest="<contact><exclude body1='b' body2='a'/><pair geom1='ga' geom2='gb'/></contact>"),
        True,
    ),
    "explicit_pair_of_parent_and_child": (two_bodies(FREE, f"|{HINGE}", nested=True, rest=PAIR), True),
    "explicit_pair_of_a_masked_geom_beside_a_colliding_one": (
        two_bodies(
            f"{FREE}<geom name='far' size='.01' pos='3 0 0' contype='8' conaffinity='8'/>", f"|{FREE}", NO_MASK, NO_MASK, PAIR
        ),
        True,
    ),
    "one_of_two_geoms_collides": (two_bodies(FREE + TOUCHING_VISUAL, f"|{FREE}"), True),
    "contacts_disabled": (two_bodies(FREE, f"|{FREE}", rest="<option><flag contact='disable'/></option>"), False),
    "mocap_and_free": (two_bodies(FREE, "mocap='true'|"), True),
    "mocap_and_static": (two_bodies("", "mocap='true'|"), False),
    "mocap_and_its_child": (two_bodies("", f"|{HINGE}", nested=True).replace("'a'", "'a' mocap='true'"), False),
    "two_mocaps": (two_bodies("", "mocap='true'|").replace("'a'", "'a' mocap='true'"), False),
    "planes_of_the_world": (
        f"<mujoco><worldbody><body name='a'><geom name='ga' type='plane' size='1 1 1'/></body>"
        f"<body name='b'>{FREE}<geom name='gb' size='.1'/></body></worldbody></mujoco>",
        True,
    ),
    "with_the_world": (
        f"<mujoco><worldbody><geom name='ga' type='plane' size='1 1 1'/><body name='b'>{HINGE}<geom name='gb' size='.1'/></body>"
        "</worldbody></mujoco>",
        True,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_can_meet_is_what_mujoco_does(tmp_path, case):
    text, expected = CASES[case]
    (tmp_path / "scene.xml").write_text(text)
    model = load_model(tmp_path / "scene.xml")
    first, second = ("a" if "a" in model.bodies else "world"), "b"
    data = mujoco.MjData(model.compiled)
    mujoco.mj_forward(model.compiled, data)
    wanted = {model.compiled.body(first).id, model.compiled.body(second).id}
    bodies = [{int(b) for b in model.compiled.geom_bodyid[[c.geom1, c.geom2]]} for c in data.contact]
    assert (wanted in bodies) is expected  # MuJoCo, which is the oracle, agrees with the table
    assert model.can_meet(first, second) is expected
    assert model.can_meet(second, first) is expected


def test_a_geom_is_told_by_what_it_is():
    shape = {"id": 3, "body": "b", "shape": "box", "size": np.ones(3), "pos": np.zeros(3), "rotation": np.eye(3)}
    assert Geom(name="", mesh="", is_colliding=True, **shape).shown == "unnamed box geom 3"
    assert Geom(name="", mesh="m", is_colliding=True, **shape).shown == 'geom "m"'
    assert Geom(name="n", mesh="m", is_colliding=True, **shape).names == ("n", "m")


@pytest.mark.slow
def test_every_link_of_the_xhand1_has_a_closed_surface_that_matches_its_files():
    model = load_model(ROBOTS / "xhand1" / "xhand1_right.xml")
    carriers = [body for body in model.bodies if body != "world" and model.touchable(body)]
    assert carriers
    for body in carriers:
        for geom in model.touchable(body):
            surface = model.surface((geom,))
            mesh = trimesh.Trimesh(surface.vertices, surface.faces)
            assert mesh.is_volume, (body, geom.shown)
            if geom.mesh:
                original = trimesh.load_mesh(ROBOTS / "xhand1" / "assets" / f"{geom.mesh}.stl")
                np.testing.assert_allclose(mesh.volume, original.volume, rtol=1e-4, err_msg=geom.shown)
                np.testing.assert_allclose(mesh.area, original.area, rtol=1e-4, err_msg=geom.shown)
