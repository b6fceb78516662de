"""Left hands made by `robots/mirror.py`: what MuJoCo and the compiler make of both hands is mirrored."""

import importlib
import struct
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from tgdsl.compiler.resolve import resolve
from tgdsl.files.find import layout_file, robot_names
from tgdsl.formats.robot import load_model
from tgdsl.placement.sample.sample import sample
from tgdsl.schema.load import load

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "robots"))  # as the script has it
mirror, mirror_mjcf, reflection = map(importlib.import_module, ("mirror", "mirror_mjcf", "reflection"))

ROBOTS = ROOT / "robots"
HANDS = {
    "xhand1": {
        "low": {"hand": 90, "tips": 45, "fingers": 78, "palm": 12},
        "med": {"hand": 199, "tips": 100, "fingers": 164, "palm": 35},
        "high": {"hand": 667, "tips": 224, "fingers": 448, "palm": 219},
    },
    "sharpa": {
        "low": {"hand": 98, "tips": 45, "fingers": 89, "palm": 9},
        "med": {"hand": 206, "tips": 70, "fingers": 190, "palm": 16},
        "high": {"hand": 781, "tips": 245, "fingers": 660, "palm": 121},
    },
}
"""Chung et al., Tactile Genesis, appendix: active probes of each hand per resolution and group."""
EXACT = 1e-9
"""Only rounding differs; mesh files are float32, which the reflection keeps."""
FLOAT32 = 2e-8
"""MuJoCo keeps mesh vertices as float32 in the mesh's own inertia frame, which is another one on each hand [m]."""


# ---- small models, every axis

MODEL = """<!-- The right arm. -->
<mujoco model="arm_right">
  <compiler angle="degree" eulerseq="XzY" autolimits="true"/>
  <statistic center="0.1 0.2 0.3"/>
  <visual><headlight ambient="0.1 0.1 0.1"/></visual>
  <default>
    <joint axis="0.3 -0.5 0.8" damping="0.1"/>
    <default class="right_rail">
      <joint type="slide" range="-0.1 0.2"/>
    </default>
    <default class="sideways">
      <joint axis="0.1 1 0.4"/>
      <geom pos="0.01 0.02 0.03" size="0.02 0.03 0.04"/>
      <site euler="10 20 30"/>
    </default>
  </default>
  <asset>
    <mesh name="wedge_right" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3  0.1 0.1 0.1" refpos="0.01 0.02 0.03" refquat="0.9 0.1 0.2 0.3"/>
    <mesh name="tetra" vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3" face="0 2 1  0 1 3  0 3 2  1 2 3"/>
    <material name="steel" rgba="1 1 1 1"/>
  </asset>
  <worldbody>
    <body name="right_base" pos="0.1 -0.2 0.3" quat="0.7 0.1 -0.4 0.2">
      <!-- Right of everything. -->
      <inertial pos="0.01 0.02 -0.03" mass="1" fullinertia="0.03 0.04 0.05 0.002 -0.003 0.004"/>
      <joint name="Right-turn" range="-30 60"/>
      <geom name="right_rod" type="capsule" size="0.01" fromto="0.1 0.2 0.3 -0.1 0.15 0.4" material="steel"/>
      <camera name="RIGHT" pos="0.1 0.2 0.3" quat="0.5 0.1 0.7 -0.2"/>
      <camera name="plain" pos="0.3 0.2 0.1"/>
      <frame pos="0.02 0.03 -0.05" axisangle="1 2 3 40">
        <body name="slider_right" pos="0 0.1 0.2" euler="20 -30 50" childclass="right_rail">
          <inertial pos="0.02 0.01 0.03" quat="0.6 0.2 0.4 0.1" mass="0.5" diaginertia="0.01 0.02 0.025"/>
          <joint name="slide"/>
          <geom class="sideways" type="box" axisangle="0.3 0.1 0.9 70"/>
          <geom type="mesh" mesh="wedge_right" pos="0.1 0.1 0.2" xyaxes="1 0.2 0.1 -0.2 1 0.3"/>
          <camera name="look" xyaxes="1 0.5 0.3 -0.5 1 0.1"/>
          <body name="hinged" pos="0.05 0.06 0.07" xyaxes="0.2 1 0.1 -1 0.2 0.4">
            <inertial pos="0.03 0.01 0.02" euler="10 20 30" mass="0.3" diaginertia="0.01 0.02 0.025"/>
            <joint name="own_axis" class="sideways" type="hinge" pos="0.01 0.02 0.03"/>
            <joint name="given" class="sideways" type="slide" axis="0.2 0.9 0.1"/>
            <geom type="mesh" mesh="tetra" zaxis="0.3 0.2 0.7"/>
            <geom type="ellipsoid" size="0.01 0.02 0.03" fromto="0 0 0 0.1 0.2 -0.1"/>
            <site name="right_tip" class="sideways" pos="0.1 0 0.02"/>
            <body name="last" pos="0.1 0.1 0" zaxis="0.4 -0.2 0.3">
              <inertial pos="0 0 0.1" axisangle="0 1 2 33" mass="0.2" diaginertia="0.01 0.02 0.025"/>
              <joint name="lateral" class="sideways"/>
              <geom type="cylinder" size="0.01 0.05" euler="15 25 35"/>
              <site name="end" zaxis="0 0.5 1" pos="0 0.1 0"/>
            </body>
          </body>
        </body>
      </frame>
    </body>
  </worldbody>
  <contact><exclude body1="right_base" body2="hinged"/></contact>
  <equality>
    <connect body1="last" body2="right_base" anchor="0.1 0.2 0.3" active="false"/>
    <weld body1="hinged" body2="right_base" anchor="0.1 0.2 0.3" relpose="0.1 0.2 0.3 0.5 0.1 0.2 0.3" active="false"/>
    <joint joint1="slide" joint2="given" polycoef="0 1 0 0 0" active="false"/>
  </equality>
  <tendon>
    <spatial name="cord"><site site="right_tip"/><site site="end"/></spatial>
    <fixed name="sum"><joint joint="slide" coef="2"/></fixed>
  </tendon>
  <!-- The right drive. -->
  <actuator><position name="right" joint="Right-turn" kp="3" ctrlrange="-1 1"/></actuator>
  <sensor><force site="right_tip"/><jointpos joint="Right-turn"/></sensor>
  <keyframe><key name="bent" qpos="0.5 0.1 0.2 0.05 0.3" ctrl="0.4"/></keyframe>
</mujoco>
"""


def both(folder, text, axis):
    """Return the compiled model of a text and that of its mirror image."""
    folder.mkdir(exist_ok=True)
    (folder / "arm_right.xml").write_text(text)
    outputs = mirror_mjcf.ModelMirror(folder / "arm_right.xml", reflection.Mirror(axis)).run()
    for path, content in outputs.items():
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
    return [mujoco.MjModel.from_xml_path(str(folder / f"arm_{side}.xml")) for side in ("right", "left")]


def posed(models, rng):
    """Return the data of both models at the same random joint values and velocities."""
    right, left = models
    low, high = np.where(right.jnt_limited[:, None] != 0, right.jnt_range, [-1, 1]).T
    found = [mujoco.MjData(model) for model in models]
    found[0].qpos[:] = found[1].qpos[:] = rng.uniform(low, high)
    found[0].qvel[:] = found[1].qvel[:] = rng.normal(size=right.nv)
    for model, data in zip(models, found, strict=True):
        mujoco.mj_forward(model, data)
    assert left.nq == right.nq == right.njnt
    return found


def check_frames(names, here, there, axis, local=None):
    """Check positions M p and rotations M R M of bodies, geoms, sites; the local reflection of cameras is diag(−1, 1, 1)."""
    flip = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    local = flip if local is None else local
    for prefix in names:
        pos, mat = f"{prefix}pos", f"{prefix}mat"
        np.testing.assert_allclose(getattr(there, pos), getattr(here, pos) @ flip, atol=EXACT, err_msg=pos)
        wanted = flip @ getattr(here, mat).reshape(-1, 3, 3) @ local
        np.testing.assert_allclose(getattr(there, mat).reshape(-1, 3, 3), wanted, atol=EXACT, err_msg=mat)


def world_inertia(model, data):
    turn = data.ximat.reshape(-1, 3, 3)
    return turn * model.body_inertia[:, None, :] @ turn.transpose(0, 2, 1)


def check_dynamics(models, found, axis):
    """Check centres of mass and inertia tensors in the world, and the mass matrix in joint coordinates."""
    flip = np.diag([-1.0 if i == axis else 1.0 for i in range(3)])
    here, there = found
    np.testing.assert_allclose(models[1].body_mass, models[0].body_mass, atol=0)
    np.testing.assert_allclose(there.xipos, here.xipos @ flip, atol=EXACT)
    inertias = [world_inertia(model, data) for model, data in zip(models, found, strict=True)]
    np.testing.assert_allclose(inertias[1], flip @ inertias[0] @ flip, atol=EXACT)
    full = [np.zeros((model.nv, model.nv)) for model in models]
    for model, data, matrix in zip(models, found, full, strict=True):
        mujoco.mj_fullM(model, matrix, data.qM) if hasattr(data, "qM") else mujoco.mj_fullM(model, data, matrix)
    np.testing.assert_allclose(full[1], full[0], atol=EXACT)


def vertices(model, data, geom):
    mesh = model.geom_dataid[geom]
    first, num = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return model.mesh_vert[first : first + num] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def check_meshes(models, found, axis):
    """Check that the vertices of mesh geoms in the world are mirror images, and faces counter-clockwise from outside."""
    signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
    for geom in np.flatnonzero(models[0].geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        here, there = (vertices(model, data, geom) for model, data in zip(models, found, strict=True))
        assert len(here) == len(there)
        distance, nearest = KDTree(here * signs).query(there)
        assert distance.max() < FLOAT32
        assert len(set(nearest)) == len(here)
        for model in models:
            mesh = model.geom_dataid[geom]
            first, num = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            own = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
            assert trimesh.Trimesh(own, model.mesh_face[first : first + num], process=False).volume > 0


@pytest.mark.parametrize("axis", range(3))
def test_a_model_with_every_kind_of_frame(tmp_path, axis):
    models = both(tmp_path, MODEL, axis)
    rng = np.random.default_rng(axis)
    for _ in range(20):
        found = posed(models, rng)
        check_frames(("x", "site_x"), *found, axis)
        check_frames(("cam_x",), *found, axis, np.diag([-1.0, 1, 1]))
        is_mesh = models[0].geom_type == mujoco.mjtGeom.mjGEOM_MESH
        signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
        turns = [data.geom_xmat.reshape(-1, 3, 3)[~is_mesh] for data in found]
        np.testing.assert_allclose(turns[1], signs[:, None] * turns[0] * signs, atol=EXACT)
        positions = [data.geom_xpos[~is_mesh] for data in found]
        np.testing.assert_allclose(positions[1], positions[0] * signs, atol=EXACT)
        check_dynamics(models, found, axis)
        check_meshes(models, found, axis)
        np.testing.assert_allclose(found[1].ten_length, found[0].ten_length, atol=EXACT)
    right, left = models
    for name in ("jnt_range", "jnt_type", "actuator_gainprm", "actuator_ctrlrange", "key_qpos", "key_ctrl"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)
    np.testing.assert_allclose(left.geom_size, right.geom_size, rtol=EXACT)
    np.testing.assert_allclose(left.stat.center, right.stat.center * signs)
    axial = -signs
    np.testing.assert_allclose(left.eq_data[:1, :6], right.eq_data[:1, :6] * np.tile(signs, 2), atol=EXACT)
    np.testing.assert_allclose(left.eq_data[1, :10], right.eq_data[1, :10] * [*signs, *signs, 1, *axial], atol=EXACT)


def test_names_change_sides_and_classes_do_not(tmp_path):
    _, left = both(tmp_path, MODEL, 1)
    text = (tmp_path / "arm_left.xml").read_text()
    assert {"left_base", "slider_left"} <= {left.body(i).name for i in range(left.nbody)}
    assert {left.camera(i).name for i in range(left.ncam)} == {"LEFT", "plain", "look"}
    assert left.joint(0).name == "Left-turn" and left.actuator(0).name == "left"
    assert 'model="arm_left"' in text and 'class="right_rail"' in text and 'mesh="wedge_left"' in text
    assert "The left drive." in text and "of everything" not in text and "The right arm" not in text
    assert text.startswith("<!-- Generated by robots/mirror.py from arm_right.xml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('fullinertia="', 'twist="1" fullinertia="', '25: the attribute "twist" of <inertial> is not known'),
        ("<contact>", "<contact><hull/>", "<hull> is not known to robots/mirror.py: it may hold geometry"),
        (
            '<position name="right" joint="Right-turn"',
            '<position name="right" site="end"',
            'the attribute "site" of <position>',
        ),
        ('<force site="right_tip"/>', '<rangefinder site="end"/>', "<rangefinder> is not known"),
        ('type="box"', 'type="plane"', "a geom of type plane cannot be mirrored"),
        ('name="slide"/>', 'name="slide" type="ball"/>', "a ball joint is not supported"),
        ('<mesh name="tetra" ', '<mesh name="tetra" scale="1 -1 1" ', "a mesh with a negative scale is mirrored already"),
        ('zaxis="0.4 -0.2 0.3"', 'zaxis="0.4 -0.2"', '"zaxis" has 2 numbers, expected 3'),
        (
            'vertex="0 0 0  0.1 0 0  0 0.2 0  0 0 0.3" face="0 2 1  0 1 3  0 3 2  1 2 3"',
            'file="no.stl"',
            "no.stl: No such file",
        ),
        ("</mujoco>", "", "no element found"),
    ],
)
def test_what_is_not_known_is_refused_by_name(tmp_path, old, new, message):
    assert MODEL.count(old) >= 1
    (tmp_path / "arm_right.xml").write_text(MODEL.replace(old, new, 1))
    with pytest.raises(reflection.MirrorError, match=r"arm_right\.xml") as caught:
        mirror_mjcf.ModelMirror(tmp_path / "arm_right.xml", reflection.Mirror()).run()
    assert message in str(caught.value)


def stl(corners):
    """Return a binary STL file of some triangles, without normals."""
    records = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(triangle), 0) for triangle in corners)
    return bytes(80) + struct.pack("<I", len(corners)) + records


PEAK = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [0, 0, 1], [0, 0, -1]]) / 10
DOUBLE = PEAK[[[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]]


def test_a_symmetric_mesh_is_shared_and_another_is_written(tmp_path):
    (tmp_path / "right_even.stl").write_bytes(stl(DOUBLE))
    (tmp_path / "odd.stl").write_bytes(stl(DOUBLE + [0, 0.01, 0]))
    text = """<mujoco><asset><mesh file="right_even.stl"/><mesh file="odd.stl"/></asset>
      <worldbody><body name="right"><geom type="mesh" mesh="right_even"/><geom type="mesh" mesh="odd"/></body></worldbody></mujoco>"""
    models = both(tmp_path, text, 1)
    assert sorted(path.name for path in tmp_path.glob("**/*.stl")) == ["odd.stl", "odd.stl", "right_even.stl"]
    assert [models[1].mesh(i).name for i in range(2)] == ["left_even", "odd"]
    found = posed(models, np.random.default_rng(0))
    check_meshes(models, found, 1)
    written = trimesh.load_mesh(tmp_path / "left" / "odd.stl")
    assert written.volume == pytest.approx(trimesh.load_mesh(tmp_path / "odd.stl").volume) and written.volume > 0


def test_the_other_diagonal_is_another_surface():
    bent = np.array([[0, 0, 0], [1, 0, 0.1], [1, 1, 0], [0, 1, 0.1]])
    one, other = stl(bent[[[0, 1, 2], [0, 2, 3]]]), stl(bent[[[0, 1, 3], [1, 2, 3]]])
    assert reflection.same_triangles(one, one)
    assert reflection.same_triangles(one, stl(bent[[[2, 3, 0], [1, 2, 0]]]))
    assert not reflection.same_triangles(one, stl(bent[[[0, 2, 1], [0, 2, 3]]]))
    assert not reflection.same_triangles(one, other)


@pytest.mark.parametrize(
    ("number", "wanted"),
    [("1", "-1"), ("-2e-8", "2e-8"), ("+.5", "-.5"), ("0", "0"), ("-0.0", "0.0"), ("4 mm", "-4 mm"), ("0e5", "0e5")],
)
def test_flipped_numbers_keep_their_digits(number, wanted):
    assert reflection.flipped(number) == wanted


# ---- small layouts

HAND = """<mujoco><worldbody><body name="right_pad">
<geom name="right_skin" type="box" size="0.02 0.03 0.01" pos="0.001 0.002 0.003"/><geom name="knob" type="box" size="0.005 0.005 0.01"
pos="0.012 0.018 0.006" euler="0 0 20"/></body></worldbody></mujoco>"""
LAYOUT = """# About the right hand.
tgdsl: 1
groups:
  all: ["right_*"]  # both right
  some: {include: [all], exclude: [Right_thumb]}
resolutions:
  grid: {right_pad: {method: grid, rows: 5, columns: 4, direction: [0.1, 0.2, -1], radius: 1 mm,
    region: [{facing: [0.1, 0.2, 1], within: 60 deg}, {box: {min: [-15 mm, -0.025, 0], max: [1, 0.03, 1]}}]}}
  first:
    right_pad:
      method: grid
      direction: [0, 0, -1]
      rows: 3
      columns: 4
      count: 11
      radius: 0.001
      region: {geoms: right_skin}
  second: {right_pad: {method: grid, rows: 4, columns: 3, count: 10, radius: 1 mm, direction: [0, 0, -1], columns_along: [0.1, 1, 0.2]}}
  third: {right_pad: {method: grid, rows: 4, columns: 4, radius: 1 mm, direction: [0, 0, -1],
    region: {sphere: {center: [0, 0.001, 0.01], radius: 15 mm}}}}
  reversed: {right_pad: {method: grid, rows: 3, columns: 4, rows_reversed: true, columns_along: null, radius: 1 mm, direction: [0, 0, -1]}}
  ties: {right_pad: {method: grid, rows: 4, columns: 4, count: 11, radius: 1 mm, direction: [0, 0, -1],
    region: {sphere: {center: [0, 0.001, 0.01], radius: 15 mm}}}}  # eight of the twelve cells in the sphere are as far out
  points: {right_pad: {method: points, radius: 1 mm, points: [{pos: [0.1, 0.2, 0.3], normal: [0, 1, 1]}, {pos: [1, -2, 3], normal: [1, 0, 0]}]}}
  file: {right_pad: {method: points, points: probes.csv}}
"""


def mirrored_layout(folder, axis, layout=LAYOUT, hand=HAND):
    (folder / "hand_right.xml").write_text(hand)
    (folder / "layout.yaml").write_text(layout)
    (folder / "probes.csv").write_text(
        "x, y, z, nx, ny, nz, radius\n0.1, 0.2, 0.3, 0, 1, 1, 1e-3\n\n-0.1,-0.2,-0.3,0,0,-1,2e-3\n"
    )
    chosen = reflection.Mirror(axis)
    outputs, notes = mirror.mirrored_files(folder / "hand_right.xml", folder / "layout.yaml", chosen)
    for path, content in outputs.items():
        path.write_bytes(content)
    return notes


def taxels(folder, side, layout, resolution):
    spec = mirror.LayoutMirror.of(folder / layout, reflection.Mirror()).spec
    robot = load_model(folder / f"hand_{side}.xml")
    body = f"{side}_pad"
    return sample(robot.surface(robot.touchable(body)), spec.resolutions[resolution][body], folder)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("resolution", ["grid", "first", "second", "third", "reversed", "ties", "points", "file"])
def test_a_layout_with_every_kind_of_region(tmp_path, axis, resolution):
    notes = mirrored_layout(tmp_path, axis)
    here, there = taxels(tmp_path, "right", "layout.yaml", resolution), taxels(tmp_path, "left", "layout_left.yaml", resolution)
    is_noted = any(note.startswith(f"{resolution}, right_pad: tangents") for note in notes)
    check_taxels(here, there, axis, has_tangents=not is_noted)
    assert not is_noted or resolution in ("points", "file")
    assert len(here.pos) >= 2


def check_taxels(here, there, axis, has_tangents=True):
    """Check that taxel i is the mirror image of taxel i."""
    signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
    assert len(there.pos) == len(here.pos)
    for name in ("pos", "normal", "tangent") if has_tangents else ("pos", "normal"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name) * signs, rtol=0, atol=EXACT, err_msg=name)
    np.testing.assert_allclose(there.area, here.area, rtol=EXACT)
    np.testing.assert_array_equal(there.radius, here.radius)
    np.testing.assert_array_equal(there.cell, here.cell)


def test_the_text_of_a_layout_stays(tmp_path):
    mirrored_layout(tmp_path, 1)
    text = (tmp_path / "layout_left.yaml").read_text()
    assert text.startswith("# Generated by robots/mirror.py from layout.yaml: the right hand mirrored along y.")
    assert '  all: ["left_*"]  # both right\n  some: {include: [all], exclude: [Left_thumb]}' in text
    assert "{box: {min: [-15 mm, -0.03, 0], max: [1, 0.025, 1]}}]}}" in text
    assert "{facing: [0.1, -0.2, 1], within: 60 deg}" in text
    assert "{sphere: {center: [0, -0.001, 0.01], radius: 15 mm}}" in text
    assert "region: {geoms: left_skin}" in text
    assert "points: probes_left.csv" in text
    assert "radius: 1 mm,\n    rows_reversed: true, columns_along: [0, -1, 0], region: [{facing" in text
    assert "      radius: 0.001\n      rows_reversed: true\n      columns_along: [0, -1, 0]\n      region: " in text
    assert "columns: 4, rows_reversed: false, columns_along: [0, -1, 0], radius: 1 mm, direction: [0, 0, -1]}" in text
    assert "rows_reversed: true, direction: [0, 0, -1], columns_along: [0.1, -1, 0.2]}" in text
    assert (tmp_path / "probes_left.csv").read_text().splitlines()[1] == "0.1,-0.2,0.3,0,-1,1,1e-3"


def test_mirrored_twice_a_layout_places_the_same_taxels(tmp_path):
    mirrored_layout(tmp_path, 1)
    there = mirror.LayoutMirror.of(tmp_path / "layout_left.yaml", reflection.Mirror(1, "left", "right"))
    outputs = there.run()
    (tmp_path / "back.yaml").write_bytes(outputs[tmp_path / "layout_right.yaml"])
    for resolution in there.spec.resolutions:
        if resolution != "file":
            one, other = (taxels(tmp_path, "right", layout, resolution) for layout in ("layout.yaml", "back.yaml"))
            for name in ("pos", "normal", "tangent", "area", "cell"):
                np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=0, atol=EXACT, err_msg=name)


def test_what_cannot_be_the_same_is_noted(tmp_path):
    layout = """tgdsl: 1
resolutions:
  a: {right_pad: {method: poisson, count: 5, radius: 1 mm}}
  b: {right_pad: {method: points, points: probes.csv}}
"""
    assert mirrored_layout(tmp_path, 1, layout) == [
        "a, right_pad: poisson samples of the same surface, not the mirror images",
        "b, right_pad: tangents follow the link's axes, 1 of 2 are the opposite of the mirror images",
    ]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("groups:", "extra: 1\ngroups:", '"extra" is not known to robots/mirror.py'),
        ("seed: 3", "twist: 3", '"twist" is not known to robots/mirror.py: it may hold geometry'),
        ("groups: {}", "groups: {}\nresolutions: 3", "line 2: expected a mapping"),
    ],
)
def test_what_is_not_known_in_a_layout_is_refused_by_name(tmp_path, old, new, message):
    text = "groups: {}\nresolutions: {a: {right_pad: {method: poisson, count: 5, seed: 3, radius: 1 mm}}}\n"
    (tmp_path / "layout.yaml").write_text(text)
    found = mirror.LayoutMirror.of(tmp_path / "layout.yaml", reflection.Mirror())
    found.text = text.replace(old, new)  # as if the grammar had what the script does not know
    with pytest.raises(reflection.MirrorError) as caught:
        found.run()
    assert message in str(caught.value)


def test_an_alias_that_would_be_mirrored_in_two_ways_is_refused(tmp_path):
    (tmp_path / "layout.yaml").write_text("""resolutions:
  a: {right_pad: {method: grid, rows: 2, columns: 2, radius: 1 mm, direction: [0, 0, -1],
    region: {box: {min: [-1, &low -0.02, 0], max: [1, 0.01, 1]}}}}
  b: {right_pad: {method: grid, rows: 2, columns: 2, radius: 1 mm, direction: [0, 0, -1],
    region: {box: {min: [-1, *low, 0], max: [1, 0.03, 1]}}}}
""")
    with pytest.raises(reflection.MirrorError, match="what an alias stands for would have to be mirrored in two ways"):
        mirror.LayoutMirror.of(tmp_path / "layout.yaml", reflection.Mirror()).run()


# ---- the real hands


@pytest.fixture(scope="module", params=HANDS)
def robot(request):
    return request.param


@pytest.fixture(scope="module")
def hands(robot):
    return [mujoco.MjModel.from_xml_path(str(ROBOTS / robot / f"{robot}_{side}.xml")) for side in ("right", "left")]


@pytest.mark.slow
def test_the_files_are_what_the_script_writes(robot):
    folder = ROBOTS / robot
    outputs, notes = mirror.mirrored_files(folder / f"{robot}_right.xml", folder / "layout.yaml", reflection.Mirror())
    assert notes == []
    for path, content in outputs.items():
        assert path.read_bytes() == content, path.name
    written = {path for path in outputs if path.suffix == ".stl"}
    assert written == set((folder / "assets" / "left").glob("*.stl"))
    for path in written:
        mesh = trimesh.load(path, force="mesh")
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, path.name


@pytest.mark.slow
def test_the_left_hand_is_the_mirror_image(hands):
    rng = np.random.default_rng(0)
    for i in range(50):
        found = posed(hands, rng)
        check_frames(("x", "site_x"), *found, 1)
        check_dynamics(hands, found, 1)
        np.testing.assert_allclose(found[1].qfrc_bias, found[0].qfrc_bias, atol=EXACT)  # gravity lies in the plane
        if i % 10 == 0:
            check_meshes(hands, found, 1)


@pytest.mark.slow
def test_joints_and_drives_are_the_same(hands):
    right, left = hands
    assert [left.joint(i).name for i in range(left.njnt)] == [
        right.joint(i).name.replace("right", "left") for i in range(right.njnt)
    ]
    for name in ("jnt_range", "dof_damping", "dof_armature", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)
    np.testing.assert_array_equal(left.actuator_forcerange, right.actuator_forcerange)
    assert left.nexclude == right.nexclude


CLOSING = {
    "xhand1": [
        (tip, [f"hand_{tip.removesuffix('_rota')}_joint{i}" for i in (1, 2)], f"hand_{tip}_tip")
        for tip in ("index_rota", "mid", "ring", "pinky")
    ],
    "sharpa": [
        (finger, [f"{finger}_{joint}" for joint in ("MCP_FE", "PIP")], f"{finger}_fingertip")
        for finger in ("index", "middle", "ring", "pinky")
    ],
}
"""The joints that close each finger of a hand, and the site at its tip."""


@pytest.mark.slow
def test_positive_values_close_the_fingers(robot, hands):
    for model, side in zip(hands, ("right", "left"), strict=True):
        for finger, joints, tip in CLOSING[robot]:
            data = mujoco.MjData(model)
            reach = []
            for value in (0.0, 0.3):
                for joint in joints:
                    data.joint(f"{side}_{joint}").qpos[0] = value
                mujoco.mj_forward(model, data)
                reach.append(data.site(f"{side}_{tip}").xpos[0])  # the palm's normal is x
            assert reach[1] > reach[0] + 0.015, f"{side} {finger}"


@pytest.mark.slow
@pytest.mark.parametrize("resolution", ["low", "med", "high"])
def test_taxels_of_the_left_hand(robot, resolution):
    layouts = {}
    for side in ("right", "left"):
        document = {
            "tgdsl": 1,
            "robot": {"model": f"{robot}_{side}"},
            "objects": {"base": {"body": {"xhand1": f"{side}_hand_link", "sharpa": f"{side}_hand_C_MC"}[robot]}},
            "resolution": resolution,
            "sensors": {"touch": {"kind": "surface_distance", "links": "hand", "feels": ["base"]}},
        }
        layouts[side] = resolve(load(document)).layout
    here, there = layouts["right"], layouts["left"]
    per_link = {link.name: int((there.link_id == i).sum()) for i, link in enumerate(there.links)}
    counts = {name: sum(per_link[link] for link in links) for name, links in there.groups.items()}
    assert counts == HANDS[robot][resolution]
    assert [link.name for link in there.links] == [link.name.replace("right", "left") for link in here.links]
    np.testing.assert_array_equal(there.link_id, here.link_id)
    check_taxels(here, there, 1)


def test_a_side_may_have_its_own_layout(tmp_path):
    folder = tmp_path / "hand"
    folder.mkdir()
    assert layout_file(folder / "hand_left.xml") is None
    (folder / "layout.yaml").touch()
    assert layout_file(folder / "hand_left.xml") == folder / "layout.yaml"
    (folder / "layout_left.yaml").touch()
    assert layout_file(folder / "hand_left.xml") == folder / "layout_left.yaml"
    assert layout_file(folder / "hand_right.xml") == folder / "layout.yaml"
    assert layout_file(robot_names()["xhand1_left"]).name == "layout_left.yaml"
    assert layout_file(robot_names()["xhand1"]).name == "layout.yaml"
