"""Actuators of every kind, tendons, springs and keyframes keep model and motion through USD."""

import mujoco
import numpy as np
import pytest
from usd_exports import twins_of

HAND = """
<mujoco model="every kind">
  <compiler angle="radian" autolimits="true"/>
  <option timestep=".003" integrator="implicitfast" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <site name="pole" pos="0 0 .6"/>
    <body name="palm" pos="0 0 .3" gravcomp="1">
      <joint name="lift" type="slide" axis="0 0 1" stiffness="20" springref=".05" damping="3" range="-.2 .2" actuatorfrcrange="-50 50"/>
      <geom name="palm" type="box" size=".08 .05 .02" mass=".4"/>
      <site name="above" pos="0 0 .1"/>
      <site name="crank" pos=".05 0 .1"/>
      <body name="left finger" pos="-.06 0 -.02">
        <joint name="left:bend" axis="0 1 0" range="-.8 .8" ref=".1" damping=".05" frictionloss=".01" armature=".001"/>
        <geom name="left" type="capsule" size=".012 .04" pos="0 0 -.05" friction=".9 .01 .001" condim="4" mass=".05"/>
        <site name="pad" pos=".01 0 -.08"/>
      </body>
      <body name="right-finger" pos=".06 0 -.02">
        <joint name="right bend" axis="0 1 0" range="-.8 .8" damping=".05" margin=".01" actuatorgravcomp="true"/>
        <geom name="right" type="capsule" size=".012 .04" pos="0 0 -.05" condim="4" mass=".05"/>
        <geom name="knuckle" type="cylinder" size=".01 .02" euler="1.57 0 0" contype="0" conaffinity="0"/>
        <site name="hook" pos=".01 0 -.08"/>
      </body>
      <body name="thumb" pos="0 .06 0"><joint name="socket" type="ball" range="0 .9" damping=".05"/><geom name="nub" size=".02" mass=".03"/></body>
    </body>
    <body name="cube" pos="0 0 .19"><freejoint name="cube"/><geom name="cube" type="box" size=".045 .02 .02" mass=".1"/></body>
    <body name="target" pos="0 .5 .5" mocap="true"><geom size=".01" mass=".1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <tendon>
    <fixed name="grip" range="-1 1" limited="true" stiffness=".1" springlength="0 .1" damping=".01" frictionloss=".002" armature="1e-4">
      <joint joint="left:bend" coef="1"/><joint joint="right bend" coef="-1"/></fixed>
    <spatial name="wire" width=".002" rgba="1 0 0 1" margin=".01" actuatorfrcrange="-9 9"><site site="pole"/><site site="above"/>
      <geom geom="knuckle" sidesite="above"/><site site="hook"/><pulley divisor="2"/><site site="pad"/><site site="hook"/></spatial>
  </tendon>
  <actuator>
    <motor name="push" joint="lift" gear="3" ctrlrange="-1 1" group="2"/>
    <position name="bend" joint="left:bend" kp="2" kv=".1" ctrlrange="-.5 .5" forcerange="-1 1"/>
    <velocity name="spin" joint="left:bend" kv=".02"/>
    <general name="odd" joint="right bend" gainprm="1.5" biastype="affine" biasprm=".01 -1 -.05" forcerange="-1 2"/>
    <intvelocity name="step" joint="right bend" kp=".3" actrange="-.4 .4"/>
    <damper name="brake" joint="lift" kv="2" ctrlrange="0 1"/>
    <cylinder name="piston" joint="lift" timeconst=".05" area=".5"/>
    <muscle name="flexor" tendon="wire" ctrlrange="0 1" lengthrange=".1 1" force="2"/>
    <position name="pull" tendon="grip" kp=".5"/>
    <motor name="jet" site="pad" refsite="above" gear="0 0 .3 0 0 0"/>
    <motor name="rod" cranksite="crank" slidersite="above" cranklength=".3" gear=".1"/>
    <motor name="roll" joint="socket" gear=".02 .01 0"/>
    <motor name="twist" jointinparent="socket" gear="0 .02 .01"/>
    <adhesion name="stick" body="right-finger" ctrlrange="0 1" gain=".3"/>
    <general joint="lift" dyntype="filterexact" dynprm=".02" gainprm="5" biastype="affine" biasprm="0 -5 -1" actearly="true"/>
    <motor name="late" joint="lift" delay=".006" nsample="3"/>
    <motor name="heavy" joint="right bend" armature=".0005"/>
  </actuator>
  <keyframe><key name="up" time="1" qpos=".1 .2 -.1 1 0 0 0 0 0 .3 1 0 0 0" ctrl=".1 .2 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/></keyframe>
</mujoco>
"""
SAME = ("dof_damping", "dof_armature", "dof_frictionloss", "jnt_range", "jnt_limited", "jnt_stiffness", "jnt_actfrcrange")
SAME += ("jnt_actfrclimited", "jnt_actgravcomp", "body_gravcomp", "jnt_margin", "qpos_spring")
TENDON = ("range", "limited", "stiffness", "damping", "frictionloss", "armature", "lengthspring", "margin", "width", "rgba")
TENDON += ("actfrcrange", "actfrclimited", "num", "solref_lim", "solimp_lim", "length0")
ACTUATOR = ("trntype", "dyntype", "gaintype", "biastype", "dynprm", "gainprm", "biasprm", "gear", "ctrllimited", "ctrlrange")
ACTUATOR += ("forcelimited", "forcerange", "actlimited", "actrange", "actearly", "lengthrange", "cranklength", "group", "delay")
ACTUATOR += ("history", "armature", "actnum")
EXACT = 1e-12
"""Relative: 15 digits, and angles convert to degrees and back."""
FULL_SCALE = 1e-6
"""Largest difference over a run, relative to the largest value: contacts amplify rounding of 1e-16."""
STEPS = 500


@pytest.fixture(scope="module")
def twins(tmp_path_factory):
    return twins_of(tmp_path_factory.mktemp("twins"), HAND)


def names(model, kind, count):
    return [getattr(model, kind)(i).name for i in range(count)]


@pytest.mark.parametrize(
    ("kind", "count"), [("body", "nbody"), ("joint", "njnt"), ("actuator", "nu"), ("tendon", "ntendon"), ("site", "nsite")]
)
def test_names_and_their_order(twins, kind, count):
    first, second = (names(model, kind, getattr(model, count)) for model in twins)
    assert [name or "actuator" for name in first] == second


@pytest.mark.parametrize("array", SAME)
def test_joints_and_bodies(twins, array):
    first, second = (getattr(model, array) for model in twins)
    np.testing.assert_allclose(second, first, rtol=EXACT, atol=EXACT)


@pytest.mark.parametrize("array", ACTUATOR)
def test_actuators(twins, array):
    first, second = (getattr(model, f"actuator_{array}") for model in twins)
    np.testing.assert_allclose(second, first, rtol=1e-9 if array == "lengthrange" else EXACT, atol=EXACT)


@pytest.mark.parametrize("array", TENDON)
def test_tendons(twins, array):
    first, second = (getattr(model, f"tendon_{array}") for model in twins)
    np.testing.assert_allclose(second, first, rtol=EXACT, atol=1e-9)


def test_options_and_keyframes(twins):
    first, second = twins
    assert second.opt.timestep == first.opt.timestep == 0.003
    first_key, second_key = first.key("up"), second.key("up")
    for vector in ("qpos", "qvel", "ctrl", "time"):
        np.testing.assert_array_equal(getattr(first_key, vector), getattr(second_key, vector))


def test_the_same_forces_at_any_state(twins):
    """MuJoCo's forces of all actuators, springs and tendons."""
    generator = np.random.default_rng(0)
    states = [mujoco.MjData(model) for model in twins]
    for _ in range(20):
        turn, velocity = generator.uniform(-0.3, 0.3, 3), generator.normal(size=twins[0].nv) / 5
        control, activation = generator.uniform(-1, 1, twins[0].nu), generator.uniform(0, 0.5, twins[0].na)
        for model, state in zip(twins, states, strict=True):
            state.qpos[:3], state.qvel[:], state.ctrl[:], state.act[:] = turn, velocity, control, activation
            mujoco.mj_forward(model, state)
        for field in ("actuator_force", "qfrc_actuator", "qfrc_passive", "ten_length", "actuator_length", "qacc"):
            first, second = (getattr(state, field) for state in states)
            np.testing.assert_allclose(second, first, rtol=1e-6, atol=1e-7 * max(1.0, np.abs(first).max()), err_msg=field)


def test_the_same_squeeze(twins):
    """The fingers close on the cube: compare positions, actuator forces and contact forces over 500 steps."""
    runs = []
    for model in twins:
        state = mujoco.MjData(model)
        state.qpos[:3] = [0.0, 0.1, 0.0]
        state.qpos[-7:-4] = [0, 0, 0.19]
        rows = []
        for step in range(STEPS):
            state.ctrl[:] = 0.3 * np.sin(np.arange(model.nu) + step * 0.01)
            mujoco.mj_step(model, state)
            force = np.zeros((state.ncon, 6))
            for i in range(state.ncon):
                mujoco.mj_contactForce(model, state, i, force[i])
            rows.append([*state.qpos, *state.actuator_force, force[:, 0].sum()])
        runs.append(np.array(rows))
    assert (runs[0][:, -1] > 0).mean() > 0.2
    scale = np.abs(runs[0]).max(axis=0)
    assert (np.abs(runs[0] - runs[1]).max(axis=0) <= FULL_SCALE * np.maximum(scale, 1e-3)).all()
