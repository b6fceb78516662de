"""Models mirrored by `robots/mirror.py`: MuJoCo makes mirror images of them."""

import struct

import mujoco
import numpy as np
import pytest
import trimesh
from mirrored_hands import EXACT, both, check_dynamics, check_frames, check_meshes, mirror_mjcf, posed, reflection

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


@pytest.mark.parametrize("axis", range(3))
def test_models_with_every_kind_of_frame_are_mirrored(tmp_path, axis):
    models = both(tmp_path, MODEL, axis)
    rng = np.random.default_rng(axis)
    for _ in range(20):
        states = posed(models, rng)
        check_frames(("x", "site_x"), *states, axis)
        check_frames(("cam_x",), *states, axis, np.diag([-1.0, 1, 1]))
        is_mesh = models[0].geom_type == mujoco.mjtGeom.mjGEOM_MESH
        signs = np.array([-1.0 if i == axis else 1.0 for i in range(3)])
        turns = [data.geom_xmat.reshape(-1, 3, 3)[~is_mesh] for data in states]
        np.testing.assert_allclose(turns[1], signs[:, None] * turns[0] * signs, atol=EXACT)
        positions = [data.geom_xpos[~is_mesh] for data in states]
        np.testing.assert_allclose(positions[1], positions[0] * signs, atol=EXACT)
        check_dynamics(models, states, axis)
        check_meshes(models, states, axis)
        np.testing.assert_allclose(states[1].ten_length, states[0].ten_length, atol=EXACT)
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
def test_unknown_elements_are_refused_by_name(tmp_path, old, new, message):
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


def test_a_symmetric_mesh_is_shared_and_others_are_mirrored(tmp_path):
    (tmp_path / "right_even.stl").write_bytes(stl(DOUBLE))
    (tmp_path / "odd.stl").write_bytes(stl(DOUBLE + [0, 0.01, 0]))
    text = """<mujoco><asset><mesh file="right_even.stl"/><mesh file="odd.stl"/></asset>
      <worldbody><body name="right"><geom type="mesh" mesh="right_even"/><geom type="mesh" mesh="odd"/></body></worldbody></mujoco>"""
    models = both(tmp_path, text, 1)
    assert sorted(path.name for path in tmp_path.glob("**/*.stl")) == ["odd.stl", "odd.stl", "right_even.stl"]
    assert [models[1].mesh(i).name for i in range(2)] == ["left_even", "odd"]
    states = posed(models, np.random.default_rng(0))
    check_meshes(models, states, 1)
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
