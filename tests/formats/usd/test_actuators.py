"""Actuators as prims: transmissions, activations, and drives of the same joints."""

import numpy as np
import pytest
from mujoco import mjtDyn, mjtTrn
from pxr import UsdPhysics
from schema_stages import author, relate, schema_stage
from stages import compiled, error_of, warned


def actuate(stage, kind="mjc", **values):
    """Return the MjcActuator of the stage with attributes `mjc:<name>`; relationships are lists of paths."""
    prim = stage.GetPrimAtPath("/motor")
    for name, value in values.items():
        is_path = isinstance(value, list) and isinstance(value[0], str)
        (relate if is_path else author)(prim, f"{kind}:{name.replace('_', ':')}", value)
    return prim


@pytest.mark.parametrize(
    ("values", "kind", "name"),
    [
        ({"target": ["/turn"]}, mjtTrn.mjTRN_JOINT, "turn"),
        ({"target": ["/socket"], "jointInParent": True}, mjtTrn.mjTRN_JOINTINPARENT, "socket"),
        ({"target": ["/link/site"], "refSite": ["/cart/hook"]}, mjtTrn.mjTRN_SITE, "site"),
        ({"target": ["/link/site"], "sliderSite": ["/cart/hook"], "crankLength": 0.4}, mjtTrn.mjTRN_SLIDERCRANK, "site"),
        ({"target": ["/tendon"]}, mjtTrn.mjTRN_TENDON, "tendon"),
        ({"target": ["/link"], "ctrlRange_max": 1.0}, mjtTrn.mjTRN_BODY, "link"),
    ],
    ids=lambda value: str(value) if isinstance(value, str) else None,
)
def test_transmissions(tmp_path, values, kind, name):
    stage = schema_stage(tmp_path)
    actuate(stage, **values)
    model = compiled(stage)
    assert model.actuator("motor").trntype[0] == kind
    read = {mjtTrn.mjTRN_JOINT: model.joint, mjtTrn.mjTRN_JOINTINPARENT: model.joint, mjtTrn.mjTRN_TENDON: model.tendon}
    read |= {mjtTrn.mjTRN_BODY: model.body}
    assert model.actuator("motor").trnid[0] == read.get(kind, model.site)(name).id
    if "sliderSite" in values:
        assert model.actuator("motor").cranklength[0] == 0.4
    if len(values) > 1 and kind in (mjtTrn.mjTRN_SITE, mjtTrn.mjTRN_SLIDERCRANK):
        assert model.actuator("motor").trnid[1] == model.site("hook").id


def test_activations(tmp_path):
    stage = schema_stage(tmp_path)
    actuate(stage, dynType="integrator", actRange_min=-0.5, actRange_max=0.5, dynPrm=[1.0])
    model = compiled(stage)
    assert model.actuator("motor").dyntype[0] == mjtDyn.mjDYN_INTEGRATOR
    assert model.actuator("motor").actlimited[0] == 1
    np.testing.assert_array_equal(model.actuator("motor").actrange, [-0.5, 0.5])
    actuate(stage, actLimited="false", dynType="user", actDim=3)
    model = compiled(stage)
    assert (model.actuator("motor").actlimited[0], model.na) == (0, 3)


def test_muscles(tmp_path):
    parameters = [0.75, 1.05, 200.0, 200.0, 0.5, 1.6, 1.5, 1.3, 1.2]
    stage = schema_stage(tmp_path)
    actuate(stage, dynType="muscle", gainType="muscle", biasType="muscle", gainPrm=parameters, biasPrm=parameters)
    actuate(stage, dynPrm=[0.01, 0.04], lengthRange_min=-1.0, lengthRange_max=1.0)
    model = compiled(stage)
    np.testing.assert_allclose(model.actuator("motor").gainprm[:9], parameters)
    np.testing.assert_allclose(model.actuator("motor").lengthrange, [-1, 1])


@pytest.mark.parametrize("inherited", [1.0, 0.5])
def test_inherited_ranges_are_the_joints(tmp_path, inherited):
    stage = schema_stage(tmp_path)
    actuate(stage, gainPrm=[3.0], biasPrm=[0.0, -3.0, 0.0], biasType="affine", inheritRange=inherited)
    model = compiled(stage)
    low, high = np.radians([-60.0, 90.0])
    middle, half = (low + high) / 2, (high - low) / 2 * inherited
    np.testing.assert_allclose(model.actuator("motor").ctrlrange, [middle - half, middle + half], rtol=1e-6)


def test_actuators_without_a_target_are_dropped_with_a_warning(tmp_path):
    stage = schema_stage(tmp_path)
    actuate(stage, target=["/nowhere"])
    model, messages = warned(stage)
    assert messages == ["actuators were dropped whose target is no joint, site, tendon or body of the model: /motor"]
    assert [model.actuator(i).name for i in range(model.nu)] == ["servo"]


@pytest.mark.parametrize(("path", "name"), [("/motor", "mjc:target"), ("/servo", "newton:targets")])
def test_an_actuator_acts_on_its_first_target_alone(tmp_path, path, name):
    stage = schema_stage(tmp_path)
    relate(stage.GetPrimAtPath(path), name, ["/turn" if path == "/motor" else "/rail", "/socket"])
    model, messages = warned(stage)
    assert messages == [f"targets of actuators after the first one were dropped: {path}"]
    assert [model.joint(int(i)).name for i in model.actuator_trnid[:, 0]] == ["turn", "rail"]


def test_actuators_with_one_name_get_their_paths(tmp_path):
    stage = schema_stage(tmp_path)
    for path in ("/left/grip", "/right/grip"):
        relate(stage.DefinePrim(path, "MjcActuator"), "mjc:target", ["/turn"])
    model = compiled(stage)
    assert [model.actuator(i).name for i in range(model.nu)] == ["motor", "left_grip", "right_grip", "servo"]


@pytest.mark.parametrize("stiffness", [3.0, 5.0])
def test_drives_yield_to_actuators(tmp_path, stiffness):
    """USD gives drives per degree; only contradicting ones are reported."""
    stage = schema_stage(tmp_path)
    actuate(stage, gainPrm=[3.0], biasPrm=[0.0, -3.0, -0.2], biasType="affine")
    drive = UsdPhysics.DriveAPI.Apply(stage.GetPrimAtPath("/turn"), "angular")
    drive.CreateStiffnessAttr(np.radians(stiffness))
    drive.CreateDampingAttr(np.radians(0.2))
    if stiffness == 3.0:
        model, messages = compiled(stage), []
    else:
        model, messages = warned(stage)
    assert messages == (
        [] if stiffness == 3.0 else ["drives were dropped, which contradict the actuator prims of their joints: /turn"]
    )
    assert model.nu == 2
    assert model.actuator("motor").gainprm[0] == 3.0


def test_mujocos_actuator_overrides_newtons(tmp_path):
    stage = schema_stage(tmp_path)
    relate(stage.GetPrimAtPath("/servo"), "newton:targets", ["/turn"])
    model, messages = warned(stage)
    assert messages == ["NewtonActuators were dropped whose joint has an MjcActuator: /servo"]
    assert model.nu == 1


def test_a_controller_without_gains_is_dropped_with_a_warning(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/servo"), "newton:kp", 0.0)
    _, messages = warned(stage)
    assert messages == ["NewtonActuators were dropped that are no PD control with gains: /servo"]


def test_incomplete_tendon_paths_are_refused(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/tendon"), "mjc:path:coef", [1.0])
    assert error_of(stage) == "/tendon: mjc:path:coef has 1 numbers; the path has 2 joints"
    author(stage.GetPrimAtPath("/tendon"), "mjc:path:indices", (0, 2))
    assert error_of(stage) == "/tendon: mjc:path:indices is [0, 2]; mjc:path has 2 targets"


@pytest.mark.parametrize(("name", "indices"), [("path:segments", (0, 1, 0)), ("sideSites:indices", (-1, 0, -1))])
def test_a_tendon_that_names_more_divisors_or_side_sites_than_it_has_is_refused(tmp_path, name, indices):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/cable"), f"mjc:{name}", indices)
    message = "/cable: mjc:path:divisors or mjc:sideSites has fewer entries than the path names"
    assert error_of(stage) == message


def test_a_spatial_tendon_over_a_pulley_and_around_a_ball(tmp_path):
    """Expected wraps: site, ball with its side site, site, pulley, site, site."""
    stage = schema_stage(tmp_path)
    cable = stage.GetPrimAtPath("/cable")
    author(cable, "mjc:path:indices", (0, 1, 2, 0, 2))
    author(cable, "mjc:path:segments", (0, 0, 0, 1, 1))
    author(cable, "mjc:path:divisors", [1.0, 2.0])
    relate(cable, "mjc:sideSites", ["/link/site"])
    author(cable, "mjc:sideSites:indices", (-1, 0, -1, -1, -1))
    model = compiled(stage)
    start = model.tendon_adr[model.tendon("cable").id]
    site, hook, ball = model.site("site").id, model.site("hook").id, model.geom("ball").id
    assert model.wrap_objid[start : start + 6].tolist() == [site, ball, hook, -1, site, hook]
    assert model.wrap_prm[start : start + 6].tolist() == [0, site, 0, 2, 0, 0]


def test_a_tendon_with_an_invalid_side_site_is_dropped_with_a_warning(tmp_path):
    """Without its side site it could take the other side."""
    stage = schema_stage(tmp_path)
    relate(stage.GetPrimAtPath("/cable"), "mjc:sideSites", ["/link/seen"])
    author(stage.GetPrimAtPath("/cable"), "mjc:sideSites:indices", (-1, 0, -1))
    model, messages = warned(stage)
    assert messages == ["tendons were dropped whose path names no joint, site or geom of the model: /cable"]
    assert [model.tendon(i).name for i in range(model.ntendon)] == ["tendon"]


def test_a_tendon_over_nothing_is_dropped_with_its_actuator(tmp_path):
    stage = schema_stage(tmp_path)
    relate(stage.GetPrimAtPath("/tendon"), "mjc:path", ["/turn", "/weld"])
    actuate(stage, target=["/tendon"])
    model, messages = warned(stage)
    assert messages == [
        "tendons were dropped whose path names no joint, site or geom of the model: /tendon",
        "actuators were dropped whose target is no joint, site, tendon or body of the model: /motor",
    ]
    assert model.ntendon == 1


def test_keyframes_of_another_size_are_dropped_with_a_warning(tmp_path):
    stage = schema_stage(tmp_path)
    author(stage.GetPrimAtPath("/key"), "mjc:qpos", [0.0, 0.0])
    model, messages = warned(stage)
    assert messages == ["keyframes were dropped whose qpos is not of the model's size: /key"]
    assert model.nkey == 0
