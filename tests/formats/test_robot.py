"""Robot files: surfaces against closed forms, meshes in their original pose, and error messages."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from robot_files import MESH_TOLERANCE, model_of, nearest, trimesh_of, wedge
from scipy.spatial.transform import Rotation

from tgdsl.errors import RobotError
from tgdsl.formats import robot
from tgdsl.formats.mjcf import xml_files
from tgdsl.formats.model import Model
from tgdsl.formats.robot import export_model, load_model
from tgdsl.surfaces.geom import Geom

ROBOTS = Path(__file__).parents[2] / "robots"
TESSELLATION = 0.01
"""Round shapes are inscribed polyhedra: 96 sections lack 0.14 %, a sphere of 2,562 vertices 0.3 %, 64 × 64 0.5 %."""
MOUNT = "pos='.01 -.02 .03' quat='.9 .1 -.3 .2'"
MOUNT_POS = np.array([0.01, -0.02, 0.03])
MOUNT_ROTATION = Rotation.from_quat([0.9, 0.1, -0.3, 0.2], scalar_first=True).as_matrix()
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


@pytest.mark.parametrize(("mount", "scale"), [("", 1.0), (MOUNT, 1.0), ("", 0.02)], ids=["at_origin", "mounted", "tiny"])
@pytest.mark.parametrize("shape", PRIMITIVES)
def test_surfaces_of_primitives(tmp_path, shape, mount, scale):
    size, volume, area, half = PRIMITIVES[shape]
    volume, area, half = scale**3 * volume, area and scale**2 * area, scale * np.array(half)
    text = " ".join(str(scale * length) for length in size)
    mesh = trimesh_of(model_of(tmp_path, f"<geom type='{shape}' size='{text}' {mount}/>"))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert volume * (1 - TESSELLATION) <= mesh.volume <= volume * (1 + 1e-9)  # inscribed, with outward faces
    if area is not None:
        assert area * (1 - TESSELLATION) <= mesh.area <= area * (1 + 1e-9)
    pos, rotation = (MOUNT_POS, MOUNT_ROTATION) if mount else (np.zeros(3), np.eye(3))
    local = (mesh.vertices - pos) @ rotation
    np.testing.assert_allclose(local.max(axis=0), half, rtol=2e-3)
    np.testing.assert_allclose(local.min(axis=0), -half, rtol=2e-3)
    np.testing.assert_allclose(mesh.center_mass, pos, atol=1e-6)


def test_ellipsoid_vertices_are_on_it(tmp_path):
    mesh = trimesh_of(model_of(tmp_path, "<geom type='ellipsoid' size='.02 .01 .03'/>"))
    np.testing.assert_allclose(((mesh.vertices / [0.02, 0.01, 0.03]) ** 2).sum(axis=1), 1, rtol=1e-9)


def test_fromto_of_capsules_is_applied(tmp_path):
    mesh = trimesh_of(model_of(tmp_path, "<geom type='capsule' size='.01' fromto='.01 0 0 .05 0 0'/>"))
    np.testing.assert_allclose(mesh.bounds, [[0, -0.01, -0.01], [0.06, 0.01, 0.01]], atol=3e-5)


@pytest.mark.parametrize("scale", ["", "scale='1e-3 1e-3 1e-3'", "scale='2e-3 -1e-3 1e-3'"], ids=["metres", "mm", "mirrored"])
def test_meshes_keep_their_original_pose(tmp_path, scale):
    solid = wedge()
    if not scale:
        solid.apply_scale(1e-3)
    solid.export(tmp_path / "wedge.stl")
    factor = {"": [1, 1, 1], "scale='1e-3 1e-3 1e-3'": [1e-3] * 3}.get(scale, [2e-3, -1e-3, 1e-3])
    model = model_of(tmp_path, f"<geom type='mesh' mesh='wedge' {MOUNT}/>", f"<mesh file='wedge.stl' {scale}/>")
    assert np.abs(model.compiled.mesh_pos).max() > 1e-3  # MuJoCo has moved it
    result, expected = trimesh_of(model), (solid.vertices * factor) @ MOUNT_ROTATION.T + MOUNT_POS
    assert nearest(result.vertices, expected) < MESH_TOLERANCE
    np.testing.assert_allclose(result.volume, solid.volume * abs(np.prod(factor)), rtol=1e-5)


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
    assert [geom.names for geom in model.touchable("pad")] == [("wedge",)]  # the sphere is visual


def test_all_geoms_of_a_body_without_colliders_are_touchable(tmp_path):
    visual = "contype='0' conaffinity='0'"
    model = model_of(tmp_path, f"<geom name='a' size='.01' {visual}/><geom name='b' size='.01' {visual}/>")
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
def test_errors_of_mujoco_name_file_and_element(tmp_path, text, parts):
    (tmp_path / "bad.xml").write_text(text)
    with pytest.raises(RobotError) as caught:
        load_model(tmp_path / "bad.xml")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'bad.xml'}: ")
    assert "\n" not in message
    assert all(part in message for part in parts)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "hand.yaml").write_text("tgdsl: 1\n")
    with pytest.raises(RobotError, match=r"hand\.yaml: this is no robot or scene file, expected MJCF, URDF or USD$"):
        load_model(tmp_path / "hand.yaml")


def test_included_and_attached_files_are_listed(tmp_path):
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


def test_geoms_are_described_by_name_mesh_or_shape():
    shape = {"id": 3, "body": "b", "shape": "box", "size": np.ones(3), "pos": np.zeros(3), "rotation": np.eye(3)}
    assert Geom(name="", mesh="", is_colliding=True, **shape).shown == "unnamed box geom 3"
    assert Geom(name="", mesh="m", is_colliding=True, **shape).shown == 'geom "m"'
    assert Geom(name="n", mesh="m", is_colliding=True, **shape).names == ("n", "m")


def test_surfaces_of_the_xhand1_are_closed_and_match_its_files():
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


def test_formats_are_entries_of_tables(tmp_path, monkeypatch):
    """The reader is chosen by suffix, in any case, or by root element; the writer by the output's suffix."""
    model, written = model_of(tmp_path, "<geom size='.1'/>"), {}

    def read(path: Path) -> Model:
        if not path.is_file():
            raise FileNotFoundError(2, "gone")
        return model

    monkeypatch.setitem(robot.READERS, ".toy", read)
    monkeypatch.setitem(robot.ROOTS, "toy", read)
    monkeypatch.setitem(robot.WRITERS, ".toy", lambda model, out: written.update({out: model}))
    (tmp_path / "a.TOY").touch()
    (tmp_path / "b.xml").write_text("<toy/>")
    assert load_model(tmp_path / "a.TOY") is load_model(tmp_path / "b.xml") is model
    with pytest.raises(RobotError) as caught:
        load_model(tmp_path / "c.toy")
    assert str(caught.value) == f"{tmp_path / 'c.toy'}: [Errno 2] gone"
    export_model(tmp_path / "a.TOY", tmp_path / "d.toy")
    assert written == {tmp_path / "d.toy": model}


def test_an_included_part_is_no_model(tmp_path):
    part = tmp_path / "hand_assets.xml"
    part.write_text("<mujocoinclude><worldbody/></mujocoinclude>")
    with pytest.raises(RobotError) as caught:
        load_model(part)
    assert str(caught.value) == f"{part}: a part that models <include>, and no model; name the file that includes it"
