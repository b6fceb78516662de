"""A saved scene equals the loaded one in every field of MuJoCo's model; a field that differs is named."""

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.introspect import structs

from tgdsl.compiler.pipeline import compile_document
from tgdsl.compiler.scene import NewBody, OwnObjects, instrument, scene_file, with_bodies
from tgdsl.errors import RobotError
from tgdsl.formats.robot import load_model
from tgdsl.module.artifact import load_plan, save_plan
from tgdsl.plan.inputs import Inputs
from tgdsl.quantities.pairs import Pair
from tgdsl.scene.compare import differing_fields
from tgdsl.scene.scene import compiled, scene_model

NOTHING = Inputs((), (), (), {}, 0)
PRESSED = Inputs(("contact_found", "contact_force"), (), (Pair("r_pad", "item"), Pair("b", "item")), {"item": "item"}, 2)
HAND = """
<mujoco><default><default class='h'><geom solimp='.8 .9 .01' friction='.3'/></default></default>
<worldbody><body name='pad' pos='0 0 .123456789012345'><joint name='pj' axis='0 1 0'/><geom class='h' size='.03'/><site name='ps' pos='.01 0 0'/></body></worldbody>
<actuator><motor name='pm' joint='pj' gear='3'/></actuator></mujoco>
"""
RICH = """
<mujoco model="rich">
<option timestep="0.003" integrator="implicitfast" cone="elliptic" impratio="7" o_margin="0.001"><flag override="enable" energy="enable"/></option>
<size nuserdata="3" memory="3M"/>
<statistic meansize=".05" extent="2"/>
<visual><global fovy="33"/><map znear=".002"/><rgba haze=".1 .2 .3 1"/><headlight ambient=".3 .3 .3"/></visual>
<default><geom solimp=".91 .96 .002" solref=".004 1.1"/><default class="a"><joint damping=".3" frictionloss=".01"/></default></default>
<custom><numeric name="n" data="1 2 3.3"/><text name="t" data="hello"/><tuple name="tu"><element objtype="body" objname="a"/></tuple></custom>
<asset><texture name="grid" type="2d" builtin="checker" mark="random" random=".05" width="64" height="64" rgb1=".1 .2 .3" rgb2=".2 .3 .4"/>
<texture type="skybox" builtin="gradient" width="32" height="32" rgb1="1 1 1" rgb2="0 0 1" mark="random"/>
<material name="m" texture="grid" reflectance=".3" texrepeat="3 2"/>
<mesh name="tet" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/>
<hfield name="hf" nrow="3" ncol="3" size="1 1 .1 .1" elevation="0 1 2 3 4 5 6 7 8"/>
<model name="hm" file="hand.xml"/></asset>
<worldbody>
<light pos="0 0 3" dir="0 .1 -1"/><camera name="c" pos="1 1 1" fovy="40" mode="targetbody" target="a"/>
<geom type="plane" size="1 1 .1" material="m"/><geom type="hfield" hfield="hf" pos="5 5 0"/>
<frame euler="10 20 30"><attach model="hm" body="pad" prefix="r_"/></frame>
<body name="a" pos="0 0 1" childclass="a" gravcomp=".5"><joint name="ja" type="hinge" axis="0 .3 1" range="-40 50" stiffness="2" springref="3" ref="5"/>
<geom name="ga" type="cylinder" size=".02 .1" margin=".001" gap=".0005" user="1 2"/><site name="sa" pos=".01 .02 .03" size=".004" euler="10 0 0"/>
  <body name="b" pos="0 .2 0"><joint name="jb" type="slide" axis="1 0 0" armature=".01"/><geom name="gb" type="mesh" mesh="tet" mass=".1"/><site name="sb"/></body></body>
<body name="item" pos="1 0 1"><freejoint/><geom name="item" type="box" size=".02 .03 .04"/></body>
<body name="mo" mocap="true" pos="2 2 2"/>
<replicate count="3" offset=".1 0 0"><body pos="3 0 1"><joint type="ball"/><geom size=".02"/></body></replicate>
<flexcomp name="fl" type="grid" dim="2" count="4 4 1" spacing=".05 .05 .05" radius=".002" mass=".1" pos="-2 0 1"><edge equality="true" damping=".1"/><contact solimp=".8 .9 .01"/></flexcomp>
</worldbody>
<contact><pair geom1="ga" geom2="item" friction=".5 .5 .1 .1 .1"/><exclude body1="a" body2="b"/></contact>
<tendon><spatial name="sp" limited="true" range="0 1" width=".003" stiffness="3"><site site="sa"/><geom geom="ga"/><site site="sb"/></spatial><fixed name="fi"><joint joint="ja" coef=".5"/><joint joint="jb" coef="-.7"/></fixed></tendon>
<equality><joint joint1="ja" joint2="jb" polycoef=".1 .2 0 0 0" solref=".03 1"/><weld body1="mo" body2="item" active="false"/></equality>
<actuator><position name="p" joint="ja" kp="3" kv=".1" forcerange="-2 2" gear="1.5"/><general name="g" tendon="fi" dyntype="filter" dynprm=".1" gainprm="2" actlimited="true" actrange="-1 1"/><velocity joint="jb" kv="2" ctrlrange="-1 1"/></actuator>
<sensor><jointpos joint="ja" noise=".1" cutoff="3"/><touch site="sa"/><accelerometer site="sb"/></sensor>
<keyframe><key name="k" time="1.5" ctrl=".1 .2 .3 .4"/></keyframe>
</mujoco>
"""
"""An example of nearly every MJCF element."""


@pytest.fixture
def rich(tmp_path):
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "scene.xml").write_text(RICH)
    return load_model(tmp_path / "scene.xml")


def fields_of(struct: str, prefix: str = "") -> list[str]:
    """Return MuJoCo's list of a structure's fields, with dots for nested structures."""
    names = []
    for field in structs.STRUCTS[struct].fields:
        name = {"global": "global_"}.get(field.name, field.name)
        kind = getattr(field.type, "name", "")
        if not prefix and name == "buffer":
            continue  # the memory of all arrays
        if kind in structs.STRUCTS:
            names += fields_of(kind, f"{prefix}{name}.")
        elif not hasattr(field.type, "fields"):
            names.append(prefix + name)
        else:  # mjVisual's parts are unnamed
            names += [f"{prefix}{name}.{part.name}" for part in field.type.fields]
    return names


FIELDS = fields_of("mjModel")
PATH_FIELDS = {"paths", "npaths", "mesh_pathadr", "hfield_pathadr", "skin_pathadr", "tex_pathadr", "nbuffer"}
"""Paths of files, and the size of the memory for them."""
SHARED = {name: ["flg_gravcomp", "ngravcomp"] for name in ("flg_gravcomp", "ngravcomp")}
"""Fields with two names."""


def owner_of(model: mujoco.MjModel, name: str):
    *parents, last = name.split(".")
    for parent in parents:
        model = getattr(model, parent)
    return model, last


def with_changed_field(model: mujoco.MjModel, name: str) -> mujoco.MjModel | None:
    """Return a copy in which the last number of a field is the next representable one, or None if it cannot change."""
    other = copy.copy(model)
    owner, last = owner_of(other, name)
    value = getattr(owner, last)
    if isinstance(value, np.ndarray):
        if not value.size:
            return None
        array = value.reshape(-1)
        assert np.shares_memory(array, value)
        if array.dtype.kind == "f":
            array[-1] = np.nextafter(array[-1], np.array(9, array.dtype))
        else:
            array[-1] = not array[-1] if array.dtype == bool else int(array[-1]) ^ 1
        return other
    if isinstance(value, bytes):
        return None
    is_bool, is_real = isinstance(value, bool), isinstance(value, float)
    try:
        setattr(owner, last, not value if is_bool else float(np.nextafter(np.float32(value), 9)) if is_real else value + 1)
    except AttributeError:
        return None  # a count, which MuJoCo makes read-only
    return other


def test_every_changed_field_of_mujocos_model_is_named(rich):
    model = rich.compiled
    tried = []
    for name in FIELDS:
        other = with_changed_field(model, name)
        if other is None:
            continue
        tried.append(name)
        assert differing_fields(model, other) == ([] if name in PATH_FIELDS else SHARED.get(name, [name]))
    assert {"opt.timestep", "opt.cone", "stat.extent", "vis.map.znear", "geom_solimp", "actuator_gear", "site_pos"} <= {*tried}
    assert {name.split("_")[0] for name in tried} >= {"tendon", "eq", "sensor", "mat", "tex", "light", "cam", "hfield", "flex"}
    assert len(tried) > 450, "nearly all of them"


def test_all_fields_of_mujocos_model_are_compared(rich):
    """Read-only counts and names are compared between different models."""
    empty = mujoco.MjModel.from_xml_string("<mujoco model='none'><option timestep='.1'/></mujoco>")
    differing = {*differing_fields(rich.compiled, empty)}
    equal = {name for name in FIELDS if np.array_equal(*(getattr(*owner_of(m, name)) for m in (rich.compiled, empty)))}
    assert {*FIELDS} - differing == equal | {name for name in FIELDS if name in PATH_FIELDS}
    assert differing >= {"names", "nbody", "ngeom", "text_data", "signature"}


@pytest.mark.parametrize("wanted", [NOTHING, PRESSED], ids=["no sensors", "sensors"])
@pytest.mark.parametrize("has_objects", [False, True], ids=["as it is", "with objects"])
def test_a_rich_scene_is_saved_exactly(rich, wanted, has_objects):
    ball = NewBody("ball", (0.1, 0.2, 1 / 3), (1.0, 2.0, 3.0, 4.0), True)
    bodies = (ball, NewBody("block", (0.3, 0.0, 1.0), (0.6, 0.8, 0.0, 0.0), False))
    objects = OwnObjects(bodies=bodies if has_objects else ())
    scene = with_bodies(rich, objects.bodies)
    expected = instrument(scene.spec.copy(), wanted).compile()
    assert differing_fields(expected, scene_model(scene_file(scene, wanted, objects))) == []
    same = [name for name in FIELDS if not name.startswith(("sensor", "name", "nname", "nsensor", "signature"))]
    assert not {*differing_fields(scene.compiled, expected)} & {*same}, "sensors alone were added"


CASES = {
    "opt.timestep": ('timestep="0.003"', 'timestep="0.0030000001"'),
    "opt.cone": ('cone="elliptic"', 'cone="pyramidal"'),
    "geom_solimp": ('solimp=".91 .96 .002"', 'solimp=".91 .96 .0020001"'),
    "actuator_gear": ('gear="1.5"', 'gear="1.6"'),
    "site_pos": ('pos=".01 .02 .03"', 'pos=".01 .02 .030000001"'),
    "sensor_noise": ('noise=".1"', 'noise=".2"'),
    "vis.rgba.haze": ('haze=".1 ', 'haze=".2 '),
    "eq_solref": ('solref=".03 1"', 'solref=".03 2"'),
    "names": ('camera name="c"', 'camera name="d"'),
    "nkey": ("</keyframe>", "<key/></keyframe>"),
}


@pytest.mark.parametrize("field", CASES)
def test_a_scene_that_would_be_saved_differently_is_refused_with_the_field(rich, monkeypatch, field):
    old, new = CASES[field]

    def compiled_differently(scene, assets):
        assert scene.mjcf.count(old) == 1
        object.__setattr__(scene, "mjcf", scene.mjcf.replace(old, new))
        return compiled(scene, assets)

    monkeypatch.setattr("tgdsl.compiler.scene.compiled", compiled_differently)
    with pytest.raises(RobotError, match=r"cannot be saved faithfully: in MuJoCo's model .*\b" + field + r"\b.* would differ"):
        scene_file(rich, NOTHING)


URDF = """
<robot name="r">
  <link name="pad"><inertial><mass value=".123456789"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz=".0123456789 .1 .2" rpy=".123456789 .2 .3"/><geometry><box size=".0123456789 .02 .03"/></geometry></collision></link>
  <link name="tip"><inertial><mass value=".2"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz=".1 0 0"/><geometry><sphere radius=".0123456789"/></geometry></collision></link>
  <joint name="j" type="revolute"><origin xyz=".0123456789 .1 .2" rpy=".123456789 .2 .3"/><parent link="pad"/><child link="tip"/>
    <axis xyz=".1 .2 .3"/><limit lower="-1" upper="1.23456789" effort="1.23456789" velocity="1"/></joint>
</robot>
"""


def test_urdf_is_saved_to_the_digits_that_mujoco_writes(tmp_path):
    (tmp_path / "hand.urdf").write_text(URDF)
    loaded = load_model(tmp_path / "hand.urdf")
    saved = scene_model(scene_file(loaded, NOTHING))
    assert {"geom_pos", "jnt_range"} <= {*differing_fields(loaded.compiled, saved)}, "six digits of nine"
    assert differing_fields(loaded.compiled, saved, is_rounded=True) == []
    for name in ("opt.timestep", "geom_solimp", "jnt_range", "dof_damping", "geom_contype"):
        owner, last = owner_of(other := copy.copy(saved), name)
        setattr(owner, last, getattr(owner, last) * 1.001 + 1)
        assert differing_fields(loaded.compiled, other, is_rounded=True) == [name]


DOCUMENT = """
tgdsl: 1
robot:
  model: scene.xml
  layout: {resolutions: {only: {r_pad: {method: poisson, count: 5, radius: 4 mm}}}}
objects: {item: {body: item}}
sensors: {touch: {kind: contact_depth, links: r_pad, feels: [item]}, load: {kind: force_taxel, links: r_pad, feels: [item]}}
"""


def test_a_saved_and_loaded_scene_has_its_sensors(rich, tmp_path):
    (tmp_path / "hand.yaml").write_text(DOCUMENT)
    plan = compile_document(tmp_path / "hand.yaml").plan
    save_plan(plan, tmp_path / "hand.safetensors")
    for file in ("scene.xml", "hand.xml", "hand.yaml"):
        Path(tmp_path / file).unlink()
    loaded = scene_model(load_plan(tmp_path / "hand.safetensors").scene)
    assert differing_fields(instrument(rich.spec.copy(), plan.inputs).compile(), loaded) == []
    assert loaded.nsensor > rich.compiled.nsensor
