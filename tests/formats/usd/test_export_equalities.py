"""Equality constraints keep their values and motion through USD."""

import mujoco
import numpy as np
import pytest
from pxr import Usd, UsdPhysics
from usd_exports import twins_of, world_of

from tgdsl.formats.robot import export_model, load_model
from tgdsl.formats.usd.equalities import shifted

HAND = """
<mujoco model="closed">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <site name="hook" pos="0 0 .5"/>
    <body name="palm" pos="0 0 .4">
      <joint name="lift" type="slide" axis="0 0 1" damping="2" ref=".03"/><geom size=".03" mass=".3"/>
      <site name="wrist site" pos=".01 .02 .03" quat=".5 .5 .1 .7"/>
      <body name="a" pos=".05 0 0" quat=".9 .1 0 .2">
        <joint name="a" axis="0 1 0" ref=".2" damping=".01"/><geom type="capsule" size=".008 .03" pos="0 0 -.03" mass=".04"/>
        <site name="sa" pos="0 0 -.06"/>
        <body name="a2" pos="0 0 -.06">
          <joint name="a2" axis="0 1 0" damping=".01" ref="-.1"/><geom type="capsule" size=".008 .03" pos="0 0 -.03" mass=".04"/>
        </body>
      </body>
      <body name="b" pos="-.05 0 0">
        <joint name="b" axis="0 1 0" damping=".01"/><geom type="capsule" size=".008 .03" pos="0 0 -.03" mass=".04"/>
        <body name="b2" pos="0 0 -.06" quat=".8 .1 .3 0">
          <joint name="b2" axis="0 1 0" damping=".01"/><geom type="capsule" size=".008 .03" pos="0 0 -.03" mass=".04"/>
          <site name="sb" pos="0 .01 -.06" quat=".1 .9 .2 .1"/>
        </body>
      </body>
      <body name="c" pos="0 .05 0"><joint name="c" type="slide" axis="1 0 0" damping="1"/><geom size=".01" mass=".05"/></body>
    </body>
    <body name="cube" pos=".2 .1 .3" quat=".3 .4 .5 .6"><freejoint/><geom type="box" size=".02 .02 .02" mass=".1"/></body>
    <body name="ball" pos=".2 -.2 .3"><freejoint/><geom size=".02" mass=".1"/></body>
    <body name="mark" mocap="true" pos=".2 .1 .35"><geom size=".01" contype="0" conaffinity="0"/></body>
  </worldbody>
  <tendon>
    <fixed name="t1"><joint joint="a" coef="1"/><joint joint="b" coef=".5"/></fixed>
    <fixed name="t2"><joint joint="a2" coef="1"/></fixed>
  </tendon>
  <equality>
    <weld name="lift" body1="cube" body2="mark" solref=".05 1.2" torquescale=".3"/>
    <joint name="a2" joint1="a2" joint2="a" polycoef=".05 .7 .2 -.1 .05" solimp=".8 .9 .002 .4 3"/>
    <tendon name="t 1" tendon1="t1" tendon2="t2" polycoef="0 .9 0 0 0" solref="-90 -3"/>
    <connect name="pin" body1="b2" body2="ball" anchor=".01 .02 -.03" active="false"/>
    <joint joint1="b" polycoef=".1 0 0 0 0"/>
    <joint name="second" joint1="a2" joint2="b" polycoef="0 1.1 .1 0 0" active="false"/>
    <joint name="mixed" joint1="c" joint2="b2" polycoef="0 .02 0 0 0"/>
    <connect site1="sb" site2="hook" active="false"/>
    <weld name="sites" site1="sa" site2="wrist site" active="false"/>
    <connect body1="ball" anchor="0 0 .1"/>
    <weld body1="world" body2="ball" anchor=".01 0 .02" relpose=".2 -.2 .3 .9 .1 .2 .3" active="false"/>
    <tendon name="hold" tendon1="t2" active="false"/>
    <weld body1="a" body2="cube" active="false"/>
  </equality>
</mujoco>
"""
"""Every kind: between bodies, sites, the world and a mocap body; on joints with `ref`, two on one; named or not."""
EXACT = 1e-12
"""Absolute: 15 digits of values of the order of 1."""
STEPS, APART = 500, 1e-6
ANGLES = slice(6, 10)
"""The quaternion of a weld, whose sign is arbitrary. The last number, 11, says whether MuJoCo chose the pose."""


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    return twins_of(tmp_path_factory.mktemp("equalities"), HAND)


def test_the_same_constraints(twins):
    one, two = twins
    assert one.neq == two.neq == 13 and one.nsite == two.nsite
    for array in ("type", "obj1id", "obj2id", "objtype", "active0", "solref", "solimp"):
        np.testing.assert_array_equal(getattr(two, f"eq_{array}"), getattr(one, f"eq_{array}"), err_msg=array)
    first, second = one.eq_data.copy(), two.eq_data.copy()
    second[:, ANGLES] *= np.where((first[:, ANGLES] * second[:, ANGLES]).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    np.testing.assert_allclose(second[:, :11], first[:, :11], rtol=0, atol=EXACT)
    names = [one.equality(i).name for i in range(one.neq)]
    assert [two.equality(i).name for i, name in enumerate(names) if name] == [name for name in names if name]


def test_a_coupling_that_is_off_stays_off(tmp_path):
    first, second = twins_of(tmp_path, HAND.replace('joint2="a" polycoef', 'joint2="a" active="false" polycoef'))
    assert first.equality("a2").active0 == second.equality("a2").active0 == 0
    assert (
        not Usd.Stage.Open(str(next(tmp_path.glob("*.usda"))))
        .GetPrimAtPath("/closed/joints/a2")
        .GetAttribute("newton:mimicEnabled")
        .Get()
    )


@pytest.mark.parametrize("chosen", ["as written", "all others"])
def test_the_same_motion(twins, chosen):
    """Positions of all bodies over 500 steps, as written and with inverted active flags."""
    states = [mujoco.MjData(model) for model in twins]
    for model, state in zip(twins, states, strict=True):
        state.qvel[:] = np.random.default_rng(0).normal(size=model.nv) * 0.05
        if chosen == "all others":
            state.eq_active[:] = 1 - model.eq_active0
    moved = 0.0
    for _ in range(STEPS):
        for model, state in zip(twins, states, strict=True):
            mujoco.mj_step(model, state)
        assert np.abs(states[0].xpos - states[1].xpos).max() < APART
        moved = max(moved, np.abs(states[0].qpos - twins[0].qpos0).max())
    assert moved > 0.05


def test_other_programs_find_standard_joints_and_couplings(tmp_path):
    """A spherical joint outside the articulation with frames at MuJoCo's anchors; a coupling in degrees."""
    (tmp_path / "hand.xml").write_text(HAND)
    export_model(tmp_path / "hand.xml", tmp_path / "hand.usda")
    stage = Usd.Stage.Open(str(tmp_path / "hand.usda"))
    pin = UsdPhysics.SphericalJoint(stage.GetPrimAtPath("/closed/joints/pin"))
    assert pin.GetExcludeFromArticulationAttr().Get() and not pin.GetJointEnabledAttr().Get()
    np.testing.assert_allclose(pin.GetLocalPos0Attr().Get(), [0.01, 0.02, -0.03], atol=1e-8)
    model = load_model(tmp_path / "hand.xml").compiled
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    ends = [
        state.body(name).xmat.reshape(3, 3) @ np.array(attribute.Get()) + state.body(name).xpos
        for name, attribute in (("b2", pin.GetLocalPos0Attr()), ("ball", pin.GetLocalPos1Attr()))
    ]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-7)
    follower = stage.GetPrimAtPath("/closed/joints/a2")
    assert "NewtonMimicAPI" in follower.GetPrimTypeInfo().GetAppliedAPISchemas()
    assert [str(path) for path in follower.GetRelationship("newton:mimicJoint").GetTargets()] == ["/closed/joints/a"]
    values = [follower.GetAttribute(f"newton:mimicCoef{i}").Get() for i in (0, 1)]
    values += [follower.GetAttribute(f"mjc:coef{i}").Get() for i in (2, 3, 4)]
    leader = 0.37
    moved = leader - 0.2
    expected = -0.1 + 0.05 + 0.7 * moved + 0.2 * moved**2 - 0.1 * moved**3 + 0.05 * moved**4
    position = np.radians(values[0]) + sum(value * leader ** (i + 1) for i, value in enumerate(values[1:]))
    assert position == pytest.approx(expected, abs=1e-8)


def test_polynomials_of_displacements_convert_to_positions():
    coefficients = np.array([0.3, -1.2, 0.5, 0.7, -0.4])
    converted = shifted(coefficients, 0.6, -0.25)
    for leader in (-1.0, 0.0, 0.4):
        x = leader + 0.25
        expected = 0.6 + 0.3 - 1.2 * x + 0.5 * x**2 + 0.7 * x**3 - 0.4 * x**4
        assert converted @ leader ** np.arange(5) == pytest.approx(expected, abs=1e-14)


def test_an_edit_of_the_stage_counts(tmp_path):
    """USD's attributes decide a connect's anchor and whether it is active."""
    (tmp_path / "hand.xml").write_text(HAND)
    export_model(tmp_path / "hand.xml", tmp_path / "hand.usda")
    stage = Usd.Stage.Open(str(tmp_path / "hand.usda"))
    pin = UsdPhysics.Joint(stage.GetPrimAtPath("/closed/joints/pin"))
    pin.GetLocalPos0Attr().Set((0.04, 0, 0))
    pin.GetJointEnabledAttr().Set(True)
    stage.Save()
    model = load_model(tmp_path / "hand.usda").compiled
    assert model.equality("pin").active0
    np.testing.assert_allclose(model.equality("pin").data[:3], [0.04, 0, 0], atol=1e-8)


FLEX = (
    "<body name='a'><joint/><geom size='.1'/></body><body name='b' pos='1 0 0'><joint/><geom size='.1'/></body></worldbody>"
    "<deformable><flex name='rope' dim='1' body='a b' vertex='0 0 0 0 0 0' element='0 1' radius='.01'/></deformable>"
    "<equality><flex name='taut' flex='rope'/></equality><worldbody>"
)


def test_constraints_of_flexes_are_named(tmp_path):
    (tmp_path / "robot.xml").write_text(world_of(FLEX))
    with pytest.warns(UserWarning, match="left out") as caught:
        export_model(tmp_path / "robot.xml", tmp_path / "robot.usda")
    assert [str(warning.message) for warning in caught] == [
        f"{tmp_path / 'robot.xml'}: {subject} left out"
        for subject in ('equality constraint "taut" is of a flex, which USD does not have:', "USD holds no flexes: 1")
    ]
