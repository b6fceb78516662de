"""Custom attributes keep values that USD cannot express, and yield to edits of the stage."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from pxr import Usd

from tgdsl.formats.robot import export_model, load_model
from tgdsl.formats.usd.attributes import OPTION

MODEL = """
<mujoco model="notes">
  <compiler angle="radian" autolimits="true"/>
  <option {option}><flag {flags}/></option>
  <worldbody>
    <site name="origin" pos="1 2 3"/>
    <geom name="floor" type="plane" size="1 1 1" solref=".01 .9"/>
    <body name="arm" pos="0 0 1">
      <joint name="second" damping=".3" armature=".013" frictionloss=".07" range="-.1 .7" margin=".01"
             solreflimit=".03 1.1" solimplimit=".8 .9 .002 .4 3" solreffriction=".04 1.2" solimpfriction=".7 .8 .003 .3 4"/>
      <geom name="box" type="box" size=".1 .02 .03" mass=".7" condim="4" priority="2" friction=".7 .01 .0003" solmix="3"
            solref=".05 1.3" solimp=".8 .97 .004 .6 1.5" margin=".002" gap=".001" contype="6" conaffinity="3"/>
      <geom name="seen" size=".03" contype="0" conaffinity="4"/>
      <site name="tip" type="box" size=".01 .02 .03" pos=".1 .2 .3" quat=".9 .1 -.3 .2" group="4" rgba=".1 .2 .3 .4"/>
      <body name="hand" pos="0 .3 0">
        <joint name="first" type="slide" damping=".2"/>
        <geom name="ball" size=".03"/>
        <body name="finger" pos="0 .3 0"><joint name="third" type="ball" damping=".1"/><geom name="nail" size=".03"/></body>
      </body>
    </body>
    <body name="cube" pos="1 1 1"><freejoint name="loose"/><geom name="die" type="box" size=".1 .1 .1"/></body>
  </worldbody>
  <actuator>
    <position name="pull" joint="first" kp="30" kv="2" gear="-2" ctrlrange="-1 3" forcerange="-5 5"/>
    <velocity name="spin" joint="second" kv=".7" gear="3" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""
OPTIONS = {"timestep": "0.003", "integrator": "implicitfast", "cone": "elliptic", "impratio": "7", "jacobian": "sparse"}
OPTIONS |= {"solver": "CG", "iterations": "51", "tolerance": "1e-7", "density": "1.2", "viscosity": "1e-5", "wind": "1 2 3"}
OPTIONS |= {"ls_iterations": "20", "ls_tolerance": "0.02", "noslip_iterations": "3", "noslip_tolerance": "1e-5"}
OPTIONS |= {"ccd_iterations": "40", "ccd_tolerance": "1e-5", "sdf_iterations": "11", "sdf_initpoints": "41"}
OPTIONS |= {"magnetic": "0 .1 .2", "o_margin": "0.001", "o_solref": ".03 1.1", "o_solimp": ".8 .9 .002 .4 3"}
OPTIONS |= {"o_friction": ".9 .9 .006 .0002 .0002"}
EXACT = 1e-14
"""Relative: the exporter keeps 15 digits, and angles convert to degrees and back."""


def exported(folder: Path, option: str = "", flags: str = "") -> Path:
    (folder / "notes.xml").write_text(MODEL.format(option=option, flags=flags))
    export_model(folder / "notes.xml", folder / "notes.usda")
    return folder / "notes.usda"


def pair(folder: Path, option: str = "", flags: str = "") -> tuple[mujoco.MjModel, mujoco.MjModel]:
    """Return a model before and after the round trip."""
    stage = exported(folder, option, flags)
    return load_model(folder / "notes.xml").compiled, load_model(stage).compiled


def same(models: tuple[mujoco.MjModel, mujoco.MjModel], *arrays: str) -> None:
    for name in arrays:
        first, second = (getattr(model, name) for model in models)
        np.testing.assert_allclose(second, first, rtol=EXACT, atol=EXACT, err_msg=name)


def test_contacts(tmp_path):
    models = pair(tmp_path)
    same(models, "geom_condim", "geom_priority", "geom_friction", "geom_solmix", "geom_solref", "geom_solimp")
    same(models, "geom_margin", "geom_gap")
    colliding = models[0].geom("seen").id != np.arange(models[0].ngeom)
    for mask in ("geom_contype", "geom_conaffinity"):
        np.testing.assert_array_equal(getattr(models[0], mask)[colliding], getattr(models[1], mask)[colliding])


def test_joints(tmp_path):
    models = pair(tmp_path)
    same(models, "jnt_margin", "jnt_solref", "jnt_solimp", "jnt_range", "dof_solref", "dof_solimp", "dof_damping")
    same(models, "dof_armature", "dof_frictionloss", "body_mass", "body_pos", "jnt_axis")
    assert [models[1].joint(i).name for i in range(models[1].njnt)] == ["second", "first", "third", "loose"]


def test_actuators_have_their_names_gears_and_order(tmp_path):
    models = pair(tmp_path)
    assert [models[1].actuator(i).name for i in range(models[1].nu)] == ["pull", "spin"]
    same(models, "actuator_trnid", "actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange")
    same(models, "actuator_forcerange")


def test_sites(tmp_path):
    models = pair(tmp_path)
    assert [models[1].site(i).name for i in range(models[1].nsite)] == ["origin", "tip"]
    same(models, "site_bodyid", "site_type", "site_size", "site_pos", "site_quat", "site_group", "site_rgba")


def test_options(tmp_path):
    assert OPTIONS.keys() == {name for name, row in OPTION.items() if row.array}
    first, second = pair(tmp_path, " ".join(f'{name}="{value}"' for name, value in OPTIONS.items()))
    for name in OPTIONS:
        np.testing.assert_array_equal(getattr(second.opt, name), getattr(first.opt, name), err_msg=name)


@pytest.mark.parametrize(
    ("key", "bits", "prefix"), [("disable", mujoco.mjtDisableBit, "mjDSBL_"), ("enable", mujoco.mjtEnableBit, "mjENBL_")]
)
def test_flags(tmp_path, key, bits, prefix):
    """All but gravity and collisions with parents, which have USD attributes."""
    names = {name.removeprefix(prefix).lower() for name in bits.__members__ if name.startswith(prefix)}
    names -= {"gravity", "filterparent", "ipc"}
    first, second = pair(tmp_path, flags=" ".join(f'{name}="{key}"' for name in sorted(names)))
    flags_of_models = [getattr(model.opt, f"{key}flags") for model in (first, second)]
    parents = int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT) if key == "disable" else 0
    assert flags_of_models[0].bit_count() == len(names)
    assert flags_of_models[0] | parents == flags_of_models[1] | parents


@pytest.mark.parametrize(
    ("path", "name", "value", "array", "expected"),
    [
        ("/notes/arm", "physics:mass", 0.9, "body_mass", 0.9),
        ("/notes/materials/friction_0_7", "physics:dynamicFriction", 0.4, "geom_friction", 0.4),
        ("/notes/joints/second", "physxJoint:armature", 0.5, "dof_armature", 0.5),
        ("/notes/joints/first", "drive:linear:physics:damping", 0.1, "dof_damping", 0.1),
    ],
    ids=["mass", "friction", "armature", "damping"],
)
def test_edits_of_the_stage_count(tmp_path, path, name, value, array, expected):
    """A custom twin is ignored if USD's value is no longer its rounding; a joint's damping is at most its drive's."""
    file = exported(tmp_path)
    unedited = getattr(load_model(file).compiled, array)
    stage = Usd.Stage.Open(str(file))
    stage.GetPrimAtPath(path).GetAttribute(name).Set(value)
    stage.Save()
    edited = getattr(load_model(file).compiled, array)
    changed = edited[edited != unedited]
    np.testing.assert_allclose(changed, expected, rtol=1e-6)
    assert len(changed) == 1


def test_a_damped_joint_without_a_servo_has_no_actuator(tmp_path):
    (tmp_path / "door.xml").write_text(
        "<mujoco><worldbody><body><joint name='hinge' damping='.3'/><geom size='.1'/></body></worldbody></mujoco>"
    )
    export_model(tmp_path / "door.xml", tmp_path / "door.usda")
    door = load_model(tmp_path / "door.usda").compiled
    assert door.nu == 0
    assert door.joint("hinge").damping[0] == 0.3


def test_meshes_with_one_name_stay_separate(tmp_path):
    """One mesh has the name that another geom would give its mesh."""
    corners = [" ".join(map(str, size * np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1]))) for size in (0.1, 0.2, 0.3)]
    meshes = "".join(f"<mesh name='{name}' vertex='{vertices}'/>" for name, vertices in zip("abc", corners, strict=True))
    (tmp_path / "m.xml").write_text(
        f"<mujoco><asset>{meshes}</asset><worldbody><body><geom name='b' type='mesh' mesh='a'/>"
        "<geom name='c' type='mesh' mesh='b'/><geom name='d' type='mesh' mesh='c'/></body></worldbody></mujoco>"
    )
    export_model(tmp_path / "m.xml", tmp_path / "m.usda")
    stage = Usd.Stage.Open(str(tmp_path / "m.usda"))
    stage.GetPrimAtPath("/MuJoCo_Model/body_1/c").GetAttribute("tgdsl:mesh").Set("a")
    stage.Save()
    model = load_model(tmp_path / "m.usda").compiled
    assert [model.mesh(i).name for i in range(3)] == ["a", "c", "d"]


def test_a_mesh_keeps_its_vertices_its_hull_and_its_name(tmp_path):
    """A regular prism: the choice of corners for a small hull depends on the last bits."""
    angles = 2 * np.pi * np.arange(40) / 40
    ring = np.round(0.01 * np.stack([np.cos(angles), np.sin(angles)], axis=1), 6)
    points = np.concatenate([np.c_[ring, np.full(40, z)] for z in (0.003, 0.041)])
    (tmp_path / "rod.xml").write_text(
        "<mujoco><asset><mesh name='prism' maxhullvert='12' vertex='" + " ".join(map(str, points.ravel())) + "'/></asset>"
        "<worldbody><body><geom name='rod' type='mesh' mesh='prism' pos='.1 .2 .3' quat='.5 .5 -.5 .5'/></body></worldbody></mujoco>"
    )
    export_model(tmp_path / "rod.xml", tmp_path / "rod.usda")
    models = load_model(tmp_path / "rod.xml").compiled, load_model(tmp_path / "rod.usda").compiled
    assert models[1].mesh(0).name == "prism"
    for name in ("mesh_vert", "mesh_face", "mesh_graph"):
        np.testing.assert_array_equal(*(getattr(model, name) for model in models))
    same(models, "geom_pos", "geom_quat")
