from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import kinematic
from oracles.kinematic import ABOVE, BOX, SIX, balanced, read
from oracles.kinematic import POWER as S
from oracles.setups.scenes import in_link, module, pad, state, wrench

import tgdsl
from tgdsl.geometry.planes import vec
from tgdsl.quantities import ContactDepth, Contacts, Gathered
from tgdsl.quantities.contact_depth import Penetration
from tgdsl.quantities.contacts import ContactPoints
from tgdsl.sensors.base import UNTIMED
from tgdsl.sensors.kinematic_taxel import KINEMATIC_TAXEL, LoopState
from tgdsl.testing import KindConformance


class TestKinematicTaxel(KindConformance):
    kind = KINEMATIC_TAXEL
    test_compiled_equals_eager = None  # `TestKinematicTaxelWithAllOptions` includes its graph


class TestKinematicTaxelAsInThePaper(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"model": "paper", "outputs": ["force"]}
    test_compiled_equals_eager = None  # part of another compiled graph


class TestKinematicTaxelWithAllOptions(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"friction_cone": 0.5, "torque_about": "taxel", "balance": "solver", "slots": 2}


class TestKinematicTaxelInTheCone(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"friction_cone": 0.2}
    test_compiled_equals_eager = None  # part of another compiled graph


class TestKinematicTaxelOfALattice(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"densification": 0.02, "loop": {"force": "300 mN", "width": "1 mm"}}
    test_compiled_equals_eager = None  # pointwise


def test_a_loop_adds_a_play_to_the_law(tmp_path):
    """With α = 1: f = (k + Q/r) d − (Q/r) p, where p is the play of width r: p ← max(d − r, min(d + r, p))."""
    k, force, width = 900.0, 0.4, 6e-4
    sensor = {**kinematic.STILL, "normal_stiffness": k, "depth_exponent": 1, "loop": {"force": force, "width": width}}
    touch, play = module(tmp_path, [(0.0, 0.0, 0.0)], BOX, kind="kinematic_taxel", **sensor), 0.0
    for d in 1e-3 * (3 + 2.5 * np.sin(0.3 * np.arange(40)) + 0.4 * np.sin(1.1 * np.arange(40))):
        play = max(d - width, min(d + width, play))
        expected = (k + force / width) * d - force / width * play
        reading = -touch(state(touch, pos=[0, 0, 0.03 - d]))["s"][0, 0, 2].item()
        assert reading == pytest.approx(max(0.0, expected), rel=1e-9, abs=1e-12)
    touch(state(touch, pos=[0, 0, 0.05]))
    again = -touch(state(touch, pos=[0, 0, 0.03 - 1e-4]))["s"][0, 0, 2].item()
    assert again == pytest.approx((k + force / width) * 1e-4, rel=1e-9)  # a lost contact restarts at the origin


@pytest.mark.filterwarnings("ignore:poses of bodies are not finite")
@pytest.mark.parametrize(
    "options",
    [{"loop": {"force": 0.4, "width": "1 mm"}}, {"noise": {"hysteresis": {"strength": 0.5, "time_constant": "50 ms"}}}],
    ids=["loop", "hysteresis"],
)
def test_a_broken_pose_leaves_the_memory_unchanged(tmp_path, options):
    def forces(heights):
        touch = module(tmp_path, [(0.0, 0.0, 0.0)], BOX, kind="kinematic_taxel", **kinematic.STILL, **options)
        dt = 0.01 if "dt" in touch.inputs.fields else None
        return [touch(replace(state(touch, pos=[0, 0, z]), dt=dt))["s"][0, 0, 2].item() for z in heights]

    broken = forces([0.027, 0.0265, np.nan, 0.0268, 0.0272])
    assert np.isnan(broken.pop(2))
    assert broken == forces([0.027, 0.0265, 0.0268, 0.0272])


def test_a_lattice_stiffens_as_its_cells_close():
    """At half the depth of densification the force doubles; beyond it, the force is finite."""
    (force,) = read(sensor={**kinematic.STILL, "densification": 0.008})[2:]
    assert force == pytest.approx(-2 * 500 * S, rel=1e-12)
    (force,) = read(sensor={**kinematic.STILL, "densification": 0.002})[2:]
    assert force == pytest.approx(-100 * 500 * S, rel=1e-9)


def test_the_papers_model_has_the_papers_sign():
    readings = read(sensor={"model": "paper"}, linvel=[0.1, 0, 0], angvel=[0, 0, 3])
    np.testing.assert_allclose(readings[:3], [-0.2, 0, -500 * S], rtol=1e-12)
    np.testing.assert_allclose(readings[5], -2 * 3, rtol=1e-12)
    assert kinematic.dragging().paper_error == pytest.approx(2 * 0.4)


def test_a_moving_frame_feels_only_relative_motion(tmp_path):
    """Link and object turn as one rigid body: no probe has a relative velocity."""
    touch = module(tmp_path, [(0.01, 0.004, 0.0)], BOX, kind="kinematic_taxel")
    spin, drift = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -0.2])
    still, moving = state(touch, **ABOVE), state(touch, **ABOVE)
    assert moving.body_pos is not None and moving.body_linvel is not None and moving.body_angvel is not None
    for i in range(2):
        moving.body_angvel[0, i] = torch.tensor(spin)
        moving.body_linvel[0, i] = torch.tensor(drift + np.cross(spin, moving.body_pos[0, i].numpy()))
    torch.testing.assert_close(touch(moving)["s"], touch(still)["s"], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("outputs", [["force"], ["torque"], ["torque", "force"]])
def test_requested_outputs_come_in_one_order(outputs):
    whole = read(probe=(0.01, 0, 0), linvel=[0.1, 0, 0])
    part = read(probe=(0.01, 0, 0), sensor={"outputs": outputs}, linvel=[0.1, 0, 0])
    expected = {1: {"force": whole[:3], "torque": whole[3:]}.get(outputs[0]), 2: whole}[len(outputs)]
    np.testing.assert_array_equal(part, expected)


def test_unneeded_inputs_are_not_required(tmp_path):
    """Without damping no velocities are read; without torque no spin."""
    still = {"normal_damping": 0, "shear_damping": 0, "spin_damping": 0}
    touch = module(tmp_path, [(0, 0, 0)], BOX, kind="kinematic_taxel", **still)
    assert touch.inputs.fields == ("body_pos", "body_quat")
    force = module(tmp_path, [(0, 0, 0)], BOX, kind="kinematic_taxel", outputs=["force"])
    assert "spin_damping" not in force.plan.sensors[0].constants


# the options


@pytest.mark.parametrize("model", ["tgdsl", "paper"])
def test_friction_ends_at_the_cone(model):
    """Up to μ f_n friction is k_t v, beyond it is μ f_n, in the model's direction; the normal force does not change."""
    comparison = kinematic.cone(model)
    assert model == "paper" or comparison.paper_error > 100


def test_the_cone_uses_the_whole_normal_force():
    """Damping counts: an object that leaves fast enough to pull has no friction."""
    sensor = {"friction_cone": 0.4, "outputs": ["force"]}
    x, _, z = read(sensor=sensor, linvel=[10, 0, -100])
    np.testing.assert_allclose(x, -0.4 * z, rtol=1e-12)
    np.testing.assert_allclose(z, -(500 + 100) * S, rtol=1e-12)
    x, y, z = read(sensor=sensor, linvel=[10, 0, 600])
    assert z > 0
    assert (x, y) == (0, 0)


def test_a_cone_of_zero_has_no_friction():
    np.testing.assert_allclose(
        read(sensor={"friction_cone": 0, "outputs": ["force"]}, linvel=[1, 2, 0]), [0, 0, -500 * S], rtol=1e-12
    )


def test_torque_about_the_taxel_is_only_spin():
    """The lever of the force is omitted: the position of the link's origin does not matter."""
    probe, motion = (0.01, -0.005, 0.0), {"linvel": [0.1, 0.2, 0], "angvel": [0, 0, 3]}
    about_link = read(probe=probe, **motion)
    about_taxel = read(probe=probe, sensor={"torque_about": "taxel"}, **motion)
    np.testing.assert_array_equal(about_taxel[:3], about_link[:3])
    np.testing.assert_allclose(about_taxel[3:], [0, 0, 6], atol=1e-12)
    np.testing.assert_allclose(about_link[3:] - about_taxel[3:], np.cross(probe, about_link[:3]), atol=1e-15)
    still = read(probe=probe, sensor={"torque_about": "taxel", "spin_damping": 0}, **motion)
    np.testing.assert_array_equal(still[3:], [0, 0, 0])


DRAGGED = {**ABOVE, "linvel": [0.1, -0.3, 0.2], "angvel": [0, 0, 2]}


@pytest.mark.parametrize("model", ["tgdsl", "paper"])
def test_balanced_taxels_press_with_the_solvers_force(model):
    """Normal forces sum to Σ f_c · m_c in the law's proportions; friction is the solver's where the law's is larger.

    Flat on the box each of six taxels has a sixth: 0.5 N/6 of friction, and its torque at the taxel's radius of 1 cm.
    """
    readings, plain = balanced(SIX, [[0.3, 0, -1.5], [0, 0.2, -0.5]], [[0, 0, -1]] * 2, DRAGGED, model=model)
    np.testing.assert_allclose(readings[:, 2].sum(), -2.0, rtol=1e-12)
    along = plain[:, :2] / np.linalg.norm(plain[:, :2], axis=1)[:, None]
    np.testing.assert_allclose(readings[:, :2], 0.5 / 6 * along, rtol=1e-12)
    twist = {"tgdsl": 0.01, "paper": -0.01}[model] * 0.5 / 6
    np.testing.assert_allclose(readings[:, 3:], np.cross(SIX, readings[:, :3]) + [0, 0, twist], rtol=1e-12, atol=1e-15)


def test_balanced_friction_below_its_limit_follows_the_law():
    """k_t v and k_ω ω, however the depth is scaled: at 100 N as at 1 N."""
    item = {**ABOVE, "linvel": [1e-3, 0, 0], "angvel": [0, 0, 1e-4]}
    for load in (1.0, 100.0):
        readings, plain = balanced(SIX, [[0.4 * load, 0, -load]], item=item, torque_about="taxel")
        np.testing.assert_allclose(readings[:, 2], -load / 6, rtol=1e-12)
        np.testing.assert_allclose(readings[:, [0, 1, 5]], plain[:, [0, 1, 5]], rtol=1e-12)
        assert (np.abs(readings[:, [0, 5]]) > 1e-4).all()


def test_balancing_adds_no_friction_to_a_frictionless_contact():
    readings, _ = balanced(SIX, [[0, 0, -2.0]], item=DRAGGED, torque_about="taxel")
    np.testing.assert_allclose(readings, [[0, 0, -2.0 / 6, 0, 0, 0]] * 6, rtol=1e-12, atol=1e-15)


def test_a_friction_cone_replaces_the_solvers_limit():
    """μ times the balanced normal force, whether the solver's friction is larger or smaller."""
    for shear in (0.0, 5.0):
        readings, plain = balanced(SIX, [[shear, 0, -2.0]], item=DRAGGED, friction_cone=0.3, torque_about="taxel")
        along = plain[:, :2] / np.linalg.norm(plain[:, :2], axis=1)[:, None]
        np.testing.assert_allclose(readings[:, :2], 0.3 * 2.0 / 6 * along, rtol=1e-12)
        np.testing.assert_allclose(readings[:, 5], 0.01 * 0.3 * 2.0 / 6, rtol=1e-12)


def test_pulling_taxels_leave_the_others_their_share():
    """A box turning about its middle approaches on one side and leaves on the other, fast enough to pull there.

    By the law the two sides cancel except for a remainder; scaling to the solver's force would divide by it.
    """
    two, roll = [(-0.01, 0, 0), (0.01, 0, 0)], {**ABOVE, "angvel": [0, 1e5, 0]}
    readings, plain = balanced(two, [[0, 0, -2.0]], item=roll, outputs=["force"])
    pulls = plain[:, 2] > 0
    assert pulls.sum() == 1
    assert abs(plain[:, 2].sum()) < 1.1 * 2 * 500 * S
    np.testing.assert_allclose(readings[pulls], 0, atol=1e-15)
    np.testing.assert_allclose(readings[~pulls], [[0, 0, -2.0]], rtol=1e-12, atol=1e-15)


def readings_by_hand(tmp_path, depth, load, friction, dtype, **sensor):
    """Return the readings of two taxels at given depths [m], sliding and spinning, under a load with friction [N]."""
    touch = module(tmp_path, [(0, 0, 0), (0.01, 0, 0)], BOX, dtype=dtype, kind="kinematic_taxel", balance="solver", **sensor)
    constants = touch.constants.tree["sensors"]["s"]
    zero, one = torch.zeros_like(depth), torch.ones_like(depth)
    at = torch.zeros(1, 1, 1, dtype=dtype)
    down, away = (at, at, at - 1), (at, at, at)
    contacts = ContactPoints(away, (at + friction, at, at - load), away, down, (at[0], at[0], at[0]))
    velocity, angular = (0.1 * one, -0.2 * one, zero), (zero, zero, 5 * one)
    pos = vec(touch.constants["quantities/contact_depth/queries/0/pos"])
    penetration = Penetration(pos, depth, (zero, zero, -one), velocity, angular, {}, {})
    gathered = Gathered({ContactDepth: penetration, Contacts: contacts})
    return KINEMATIC_TAXEL.forward(gathered, UNTIMED, constants, LoopState())[0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("cone", [{}, {"friction_cone": 0.7}], ids=["solver", "cone"])
def test_readings_stay_bounded_as_depth_vanishes(tmp_path, dtype, cone):
    """Over 12 decades of depth readings stay within the solver's force, and derivatives are finite.

    Down to 1 nm the normal forces sum to the solver's; the load at smaller depths counts as none.
    """
    load, friction = 3.0, 0.5
    limit = 0.7 * load if cone else friction
    for exponent in range(-3, -16, -1):
        depth = torch.tensor([[10.0**exponent, 0.5 * 10.0**exponent]], dtype=dtype, requires_grad=True)
        sizes = torch.tensor([load, friction], dtype=dtype, requires_grad=True)
        readings = readings_by_hand(tmp_path, depth, sizes[0], sizes[1], dtype, torque_about="taxel", **cone)
        normal, shear = -readings["force_z"], torch.hypot(readings["force_x"], readings["force_y"])
        share = torch.tensor([1.0, 0.5**1.2], dtype=dtype) / (1 + 0.5**1.2)
        if exponent >= -9:
            torch.testing.assert_close(normal[0], load * share, rtol=1e-5, atol=0)
        assert (normal >= 0).all()
        assert (normal[0] <= load * share * (1 + 1e-5)).all()
        assert (shear[0] <= limit * share * (1 + 1e-5)).all()
        assert (readings["torque_z"].abs()[0] <= 0.01 * limit * share * (1 + 1e-5)).all()
        total = sum(plane.sum() for plane in readings.values())
        for gradient in torch.autograd.grad(total, [depth, sizes], allow_unused=True):
            assert gradient is None or torch.isfinite(gradient).all()


def test_the_solvers_normal_is_the_contacts():
    tilted = np.array([0.6, 0, -0.8])
    readings, _ = balanced([(0, 0, 0)], [(3 * tilted + [0.08, 0.3, 0.06]).tolist()], [tilted.tolist()])
    np.testing.assert_allclose(readings[0, :3], [0, 0, -3], atol=1e-12)  # along the taxel's normal


@pytest.mark.parametrize("item", [{"pos": [0, 0, 0.2]}, {**ABOVE, "linvel": [0, 0, 600]}], ids=["untouched", "pulling"])
def test_without_a_pressed_taxel_the_solvers_force_is_dropped(item):
    readings, plain = balanced([(0, 0, 0), (0.01, 0, 0)], [[0, 0, -1.0]], item=item)
    assert not readings.any()
    assert plain[:, 2].sum() >= 0


def test_a_balanced_resting_cube_reads_its_weight():
    """MuJoCo's cube on a pad of probes: 2.4525 N when balanced; depth alone gives another number."""
    comparison = kinematic.balanced_weight()
    assert comparison.paper_error > 1


def test_a_balanced_sliding_cube_drags_no_harder_than_the_solver(tmp_path):
    """MuJoCo's cube on a slippery pad at 0.1 m/s: its weight, and friction along its motion of at most μ times that."""
    touch = pad(
        tmp_path, kind="kinematic_taxel", balance="solver", friction=0.3,
        qvel="0.1 0 0 0 0 0", gravity=f"{0.3 * 9.81} 0 -9.81", place="pos='-.008 0 .0299'",
    )  # fmt: skip
    sim = tgdsl.simulate(touch, 1, substeps=100, keyframe="start")
    sim.step()
    state = sim.state()
    assert state.contact_normal is not None and state.contact_force is not None
    force, normal = touch(state)["s"][0].numpy(), in_link(touch, state, state.contact_normal[0, 0].numpy())
    each = in_link(touch, state, state.contact_force[0, 0].numpy())
    along = np.sum(each * normal, axis=1)
    friction = np.linalg.norm(each - along[:, None] * normal, axis=1).sum()
    assert wrench(touch, state)[0][2] < -0.5 * 0.25 * 9.81
    np.testing.assert_allclose(force[:, 2].sum(), -along.sum(), rtol=1e-3)  # it leans by some milliradians, friction with it
    sizes = np.linalg.norm(force[:, :2], axis=1)
    assert 0.05 < sizes.sum() <= friction * (1 + 1e-9)
    assert (force[sizes > 1e-6, 0] > 0).all()


@pytest.mark.parametrize("exponent", [0.7, 1.0, 1.2])
@pytest.mark.parametrize("depth", [0.0, 1e-12, -1e-3, -1.0])
def test_gradients_are_finite_at_first_touch_and_far_away(tmp_path, exponent, depth):
    """For α < 1 the law has a vertical tangent at d = 0: its derivative there counts as 0, so that training continues."""
    touch = module(tmp_path, [(0, 0, 0)], BOX, kind="kinematic_taxel", depth_exponent=exponent)
    scene = state(touch, pos=[0, 0, 0.03 - depth], linvel=[0.1, 0, -0.2])
    names = [name for name in touch.inputs.fields if name.startswith("body_")]
    for name in names:
        getattr(scene, name).requires_grad_()
    constant = touch.constants["sensors/s/depth_exponent"].requires_grad_()
    readings = touch(scene)["s"]
    assert torch.isfinite(readings).all()
    for gradient in torch.autograd.grad(readings.sum(), [*(getattr(scene, name) for name in names), constant]):
        assert torch.isfinite(gradient).all()
