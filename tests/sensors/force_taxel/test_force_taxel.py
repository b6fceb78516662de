"""Force taxels against their reference, and handmade contacts: no force is lost, invented, or applied where none can be."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from oracles.forces import made_up
from oracles.setups.scenes import FOOTPRINT, TAXELS, pad, settled

import tgdsl
from tgdsl.console.progress import silent
from tgdsl.errors import LowerError
from tgdsl.layout.layout import Layout, Link
from tgdsl.sensors.force_taxel.kind import FORCE_TAXEL, ForceTaxelSpec, lower, reference_reports
from tgdsl.testing import KindConformance
from tgdsl.testing.reference import assert_agrees

G = 9.81
ROUNDING = 1e-12
"""Sums of float64 forces of about 1 N."""


class TestForceTaxel(KindConformance):
    kind = FORCE_TAXEL
    float64_tolerance = 1e-11  # a step towards the moment solves a system of condition up to 1e3, and there are four

    def test_missed_force_and_residual_match_the_reference(self, scene):
        module, reference = self.build(self.document(scene), torch.float64)
        for state in self.states(module):
            readings = module(state)
            for env in range(self.num_envs):
                gathered = reference.gathered(state, env, np.zeros(3))
                _, missed, residual = reference_reports(reference.spec, reference.layout, gathered)
                np.testing.assert_allclose(readings["s/missed"][env], missed, atol=1e-11)
                np.testing.assert_allclose(readings["s/residual"][env], residual, atol=1e-12)
            assert readings["s/missed"].abs().max() > 0.1
            assert readings["s/residual"].abs().max() > 1e-4

    @pytest.mark.filterwarnings("ignore:contacts of")
    def test_force_beyond_the_slots_is_shared_out_as_in_the_reference(self, scene):
        """The net force includes contacts that are not shown: the definition adds it up one contact at a time."""
        module, reference = self.build(self.document(scene), torch.float64)
        for state in self.states(module):
            lacking = torch.randn(state.contact_netforce.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
            state = dataclasses.replace(state, contact_netforce=state.contact_netforce + lacking)
            assert_agrees(module(state)["s"], reference, state, self.float64_tolerance)


class TestForceTaxelWithPressure(KindConformance):
    kind = FORCE_TAXEL
    parameters = {"outputs": ["pressure", "force"], "footprint": 0.02, "moment_iterations": 2, "slots": 2}
    test_compiled_equals_eager = None  # part of another compiled graph
    float64_tolerance = 1e-11


# Contacts made by hand


@pytest.mark.filterwarnings("ignore:contacts of pad – cube are more than `slots")
def test_no_force_is_lost(tmp_path):
    """Random contacts on, next to and far from the pad, more than slots, in float32: Σ f + missed = net up to rounding."""
    rng = np.random.default_rng(0)
    touch = pad(tmp_path, dtype=torch.float32, slots=3)
    for _ in range(20):
        pos, force = rng.normal(size=(3, 3)) * [0.03, 0.03, 0.005] + [0, 0, 0.01], rng.normal(size=(3, 3))
        net = force.sum(axis=0) + rng.normal(size=3)
        readings = touch(made_up(touch, pos, force, net=net))
        total = readings["s"][0].double().sum(dim=0) + readings["s/missed"][0, 0].double()
        np.testing.assert_allclose(total, net, atol=1e-6 * max(1.0, np.abs(force).sum()))


def test_a_contact_far_from_all_taxels_is_missed(tmp_path):
    touch = pad(tmp_path)
    readings = touch(made_up(touch, [[0.0, 0.055, 0.01]], [[0.3, 0.1, -2.0]]))
    assert not readings["s"].any()
    np.testing.assert_array_equal(readings["s/missed"][0, 0], [0.3, 0.1, -2.0])
    np.testing.assert_array_equal(readings["s/residual"][0, 0], [0, 0, 0])


@pytest.mark.filterwarnings("ignore:contacts of pad – cube are more than `slots")
def test_contacts_beyond_the_slots_act_where_the_others_do(tmp_path):
    """A cube rests on four points; with one slot the taxels around that point carry the whole force."""
    touch = pad(tmp_path, slots=1)
    state = settled(touch)
    assert state.contact_found[0, 0] == 4
    assert abs(state.contact_force[0, 0, 0, 2]) < 0.5 * 0.25 * G
    readings = touch(state)
    np.testing.assert_allclose(readings["s"][0].sum(dim=0), state.contact_netforce[0, 0], atol=ROUNDING)
    np.testing.assert_allclose(readings["s/missed"][0, 0], 0, atol=ROUNDING)
    away = np.array(TAXELS) - state.contact_pos[0, 0, 0].numpy()
    assert not readings["s"][0][np.linalg.norm(away, axis=1) > FOOTPRINT].any()


def test_a_contact_that_slides_off_hands_its_force_over(tmp_path):
    """From the pad's middle to beyond its reach: force and missed force sum to the contact's, without a jump."""
    touch = pad(tmp_path)
    force = np.array([0.4, 0.0, -1.0])
    captured = []
    for y in np.linspace(0.0, 0.045, 76):
        readings = touch(made_up(touch, [[0.002, y, 0.01]], [force]))
        total = readings["s"][0].sum(dim=0).numpy()
        np.testing.assert_allclose(total + readings["s/missed"][0, 0].numpy(), force, atol=1e-15)
        captured.append(total[2])
    captured = -np.array(captured)
    assert captured[0] == pytest.approx(1, abs=1e-12)
    assert captured[-1] == 0
    # The smooth step over the squared distance: slope at most 3/2 · 2 y/(r_f² 3/4) = 4/r_f, in steps of 0.6 mm.
    assert np.abs(np.diff(captured)).max() <= 24e-4 / FOOTPRINT
    assert ((captured > 0.01) & (captured < 0.99)).sum() > 5


def test_a_contact_that_turns_around_an_edge_hands_its_force_over(tmp_path):
    """A ball rolls over the pad's edge at the outermost taxels: once the normal has turned by a right angle, all force is missed."""
    touch = pad(tmp_path)
    forces = []
    for angle in np.linspace(0, np.pi / 2, 76):
        normal = np.array([-np.sin(angle), 0, -np.cos(angle)])
        readings = touch(made_up(touch, [[0.025, 0.005, 0.01]], [normal], normal=normal))
        forces.append(readings["s"][0].numpy())
        total = forces[-1].sum(axis=0)
        np.testing.assert_allclose(total + readings["s/missed"][0, 0].numpy(), normal, atol=1e-15)
        assert (forces[-1] @ normal >= 0).all()
    # The smooth step's slope is at most 3/2 · 2/0.75, the force direction's is 1.
    assert np.abs(np.diff(forces, axis=0)).max() <= 5 * np.pi / 2 / 75


HANDS = {"xhand1": "*_link2", "sharpa": "*_elastomer"}


@pytest.mark.parametrize(("hand", "side"), [("xhand1", "right"), ("sharpa", "left")])
def test_force_on_the_nail_is_missed(hand, side):
    """Force on the back of a fingertip is missed, though within the footprint of the pad's taxels; force on the pad is not.

    The back is the farthest triangle of the link's mesh behind the taxel in the middle of the pad.
    """
    folder = Path(__file__).parents[3] / "robots" / hand
    model = folder / f"{hand}_{side}.xml"
    tips = {"include": [HANDS[hand]], "exclude": ["*back*"]}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(model), "layout": str(folder / ("layout.yaml" if side == "right" else "layout_left.yaml"))},
            "resolution": "low",
            "objects": {"ball": {"geom": {"type": "sphere", "size": [0.005]}}},
            "sensors": {"s": {"kind": "force_taxel", "links": tips, "feels": ["ball"], "footprint": 0.03}},
        },
        dtype=torch.float64,
    )
    taxels, compiled = touch.taxels["s"], mujoco.MjModel.from_xml_path(str(model))
    bodies = touch.outputs[0].bodies
    assert len(bodies) == 5
    for row, body in enumerate(bodies):
        body_taxels = taxels[taxels["body"] == body]
        middle = body_taxels[np.linalg.norm(body_taxels["pos"] - body_taxels["pos"].mean(axis=0), axis=1).argmin()]
        back, outward = exit_point(compiled, body, middle["pos"], middle["normal"])
        assert 0.008 < np.linalg.norm(back - middle["pos"]) < 0.025
        for pos, normal, missed in ((middle["pos"], middle["normal"], 0.0), (back, outward, 1.0)):
            state = touch.example_state(1)
            fields = [getattr(state, f"contact_{name}") for name in ("pos", "force", "torque", "normal", "netforce")]
            for field in (state.body_pos, *fields):
                field[:] = 0
            state.body_quat[:] = torch.tensor([1.0, 0, 0, 0])
            pair = [pair.link for pair in touch.inputs.pairs].index(body)
            fields[0][0, pair, 0] = torch.tensor(pos)
            fields[1][0, pair, 0] = fields[3][0, pair, 0] = fields[4][0, pair] = -torch.tensor(normal)
            readings = touch(state)
            np.testing.assert_allclose(readings["s/missed"][0, row], -missed * normal, atol=ROUNDING)
            np.testing.assert_allclose(readings["s"][0].sum(dim=0), (missed - 1) * normal, atol=ROUNDING)


def exit_point(model, body, start, normal):
    """Return where a line from a place into a body leaves its meshes, and the outward normal there."""
    corners = []
    for geom in np.flatnonzero(model.geom_bodyid == model.body(body).id):
        mesh, rotation = model.geom_dataid[geom], np.zeros(9)
        first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]] @ rotation.reshape(3, 3).T + model.geom_pos[geom]
        corners.append(vertices[model.mesh_face[face : face + model.mesh_facenum[mesh]]])
    a, b, c = np.concatenate(corners).transpose(1, 0, 2)
    out = np.cross(b - a, c - a)
    across = out @ -normal
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.sum(out * (a - start), axis=1) / across
        at = start - along[:, None] * normal
        inside = [np.sum(np.cross(q - p, at - p) * out, axis=1) >= 0 for p, q in ((a, b), (b, c), (c, a))]
    hit = np.flatnonzero(np.all(inside, axis=0) & (across > 0))
    last = hit[along[hit].argmax()]
    return at[last], out[last] / np.linalg.norm(out[last])


def test_no_taxel_force_leaves_the_contacts_cone(tmp_path):
    """For contacts of one normal with forces in a friction cone, each taxel's force is in the cone, whatever the moment."""
    rng = np.random.default_rng(2)
    touch, friction = pad(tmp_path, moment_iterations=8), 0.6
    num_sheared = 0
    for _ in range(20):
        pos = np.column_stack([rng.uniform(-0.03, 0.03, (5, 2)), rng.uniform(0.008, 0.012, 5)])
        load, angle, part = rng.uniform(0.1, 2, 5), rng.uniform(0, 2 * np.pi, 5), rng.uniform(0, 1, 5)
        shear = friction * load * part * np.array([np.cos(angle), np.sin(angle)])
        readings = touch(made_up(touch, pos, np.column_stack([*shear, -load]), 1e-3 * rng.normal(size=(5, 3))))
        x, y, z = readings["s"][0].numpy().T
        assert (z <= 0).all()
        assert (np.hypot(x, y) <= -friction * z + 1e-14).all()
        num_sheared += int((np.hypot(x, y) > 1e-3).sum())
    assert num_sheared > 120


def test_splitting_a_contact_changes_nothing(tmp_path):
    touch = pad(tmp_path)
    pos, force = [[0.004, 0.003, 0.01], [-0.012, 0.008, 0.01]], [[0.2, -0.1, -1.0], [0.0, 0.3, -0.7]]
    whole = touch(made_up(touch, pos, force))
    split = touch(made_up(touch, [pos[0], *pos], [0.35 * np.array(force[0]), 0.65 * np.array(force[0]), force[1]]))
    for name, reading in whole.items():
        torch.testing.assert_close(split[name], reading, rtol=0, atol=ROUNDING)


def test_the_order_of_contacts_does_not_matter(tmp_path):
    touch, rng = pad(tmp_path), np.random.default_rng(4)
    pos = np.column_stack([rng.uniform(-0.03, 0.03, (6, 2)), np.full(6, 0.01)])
    force, order = rng.normal(size=(6, 3)), rng.permutation(6)
    expected = touch(made_up(touch, pos, force))
    readings = touch(made_up(touch, pos[order], force[order]))
    for name, reading in expected.items():
        torch.testing.assert_close(readings[name], reading, rtol=0, atol=ROUNDING)


def test_the_bodies_of_a_sensor_are_separate(tmp_path):
    """Each body's contacts go to its own taxels, however near the other body's are."""
    text = (
        "<mujoco><worldbody><body name='a'><geom size='.02'/></body><body name='b'><geom size='.02'/></body>"
        "<body name='cube'><freejoint/><geom size='.02'/></body></worldbody></mujoco>"
    )
    (tmp_path / "scene.xml").write_text(text)
    points = [{"pos": [x, 0, 0.02], "normal": [0, 0, 1], "radius": 0.004} for x in (0.0, 0.005)]
    layout = {"a": {"method": "points", "points": points}, "b": {"method": "points", "points": points[:1]}}
    touch = tgdsl.compile(
        {
            "tgdsl": 1,
            "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": layout}}},
            "objects": {"cube": {"body": "cube"}},
            "sensors": {"s": {"kind": "force_taxel", "links": ["a", "b"], "feels": ["cube"]}},
        },
        dtype=torch.float64,
    )
    state = touch.example_state(1)
    state.body_pos[:], state.body_quat[:] = 0, torch.tensor([1.0, 0, 0, 0])
    for field in (state.contact_pos, state.contact_force, state.contact_torque, state.contact_netforce):
        field[:] = 0
    b = [pair.link for pair in touch.inputs.pairs].index("b")
    state.contact_pos[0, b, 0] = torch.tensor([0.001, 0, 0.02])
    state.contact_normal[0, b, 0] = torch.tensor([0, 0, -1.0])
    state.contact_force[0, b, 0] = state.contact_netforce[0, b] = torch.tensor([0, 0, -1.0])
    readings = touch(state)
    np.testing.assert_array_equal(readings["s"][0], [[0, 0, 0], [0, 0, 0], [0, 0, -1]])
    np.testing.assert_allclose(readings["s/residual"][0], [[0, 0, 0], [0, 0.001, 0]], atol=1e-18)
    assert not readings["s/missed"].any()


def test_pressure_is_the_inward_force_over_the_area(tmp_path):
    """π R² for a taxel without a given area; pulling forces have no pressure."""
    touch = pad(tmp_path, outputs=["pressure", "force"])
    for sign in (1, -1):
        reading = touch(made_up(touch, [[0.003, 0.002, 0.01]], [[0.1, 0.2, -sign * 1.5]]))["s"][0].numpy()
        expected = np.maximum(0, -reading[:, 2]) / (np.pi * 0.004**2)
        np.testing.assert_allclose(reading[:, 3], expected, rtol=1e-12)
        assert reading[:, 3].any() == (sign > 0)
    assert touch.outputs[0].channels == ("force_x", "force_y", "force_z", "pressure")
    assert touch.outputs[0].units == ("N", "N", "N", "Pa")


class NoSurfaces:
    """Fails if a surface is requested."""

    progress = staticmethod(silent)

    def __call__(self, link, region):
        pytest.fail(f"the surface of {link} was asked for")

    def taxels(self, resolution, layout):
        raise AssertionError

    def of_object(self, name):
        pytest.fail(f"the surface of {name} was asked for")


def test_a_taxel_without_area_has_no_pressure():
    one = np.array([[0.0, 0.0, 1.0]])
    layout = Layout(
        (Link("pad", "pad"),),
        {},
        np.zeros(1, dtype=np.int64),
        one,
        one,
        one,
        np.ones(1),
        np.zeros(1),
        -np.ones((1, 2), dtype=np.int64),
    )
    spec = ForceTaxelSpec(kind="force_taxel", links={"include": ("pad",)}, feels=("cube",), outputs=("pressure",))
    with pytest.raises(LowerError, match=r"^a taxel of no area has no pressure; leave pressure out, or give its area$"):
        lower(spec, layout, NoSurfaces())
    lowered = lower(spec, dataclasses.replace(layout, area=np.ones(1)), NoSurfaces())
    assert max(request.num_slots for request in lowered.requests) == 8


THREADS = Path("/proc/self/task")
READ_IN_ONE_ENVIRONMENT = """
import os, pathlib, time, torch, tgdsl

def of_others():
    threads = [each for each in pathlib.Path("/proc/self/task").iterdir() if int(each.name) != os.getpid()]
    return sum(int((each / "schedstat").read_text().split()[0]) for each in threads)

torch.set_num_threads(2)
touch = tgdsl.compile({document!r})
assert len(touch.taxels["s"]) == 2256
state = touch.example_state(1)
with torch.no_grad():
    touch(state)
    time.sleep(0.5)
    times = [of_others()]
    for _ in range(3):
        touch(state)
    time.sleep(0.5)  # how long a thread ran is noted when it stops
    times.append(of_others())
    torch.exp(torch.ones(1, 8, 2256))
    time.sleep(0.5)
    times.append(of_others())
print(times[1] - times[0], times[2] - times[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not (THREADS.parent / "schedstat").exists(), reason="how long each thread ran is not known here")
def test_one_thread_reads_one_environment(tmp_path):
    """Torch hands some operations on a few thousand numbers to a second thread and waits for it, possibly for long.

    The test measures how long other threads ran, not how long anything took.
    """
    (tmp_path / "scene.xml").write_text(
        "<mujoco><worldbody><body name='pad'><geom type='box' size='.05 .05 .01'/></body>"
        "<body name='cube' pos='0 0 .03'><freejoint/><geom type='box' size='.02 .02 .02'/></body></worldbody></mujoco>"
    )
    grid = {"method": "grid", "rows": 47, "columns": 48, "direction": [0, 0, -1], "radius": 0.004}
    document = {
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": grid}}}},
        "objects": {"cube": {"body": "cube"}},
        "sensors": {"s": {"kind": "force_taxel", "links": "pad", "feels": ["cube"]}},
    }
    script = READ_IN_ONE_ENVIRONMENT.format(document=document)
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    reads, exponential = map(int, run.stdout.split())
    assert exponential > 0  # there is a second thread
    assert reads == 0
