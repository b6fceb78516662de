"""Primitive colliders of the hands stay within 1 mm of touched surfaces and change nothing else."""

import runpy
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
from hand_colliders import ROOT, fit, written

from tgdsl.compiler.pipeline import compile_document
from tgdsl.formats.robot import load_model
from tgdsl.scene.colliders import with_colliders
from tgdsl.schema.load import load_colliders


@dataclass(frozen=True)
class Hand:
    """A hand and expectations of its colliders.

    Attributes:
        name: Its folder.
        num_meshes: Geoms that are meshes.
        example: A document with the hand.
        task: The sensors' document of a task.
        quick: A mesh that is fitted quickly.
        at_worst: Larger deviations of links with a few outliers [m].
    """

    name: str
    num_meshes: int
    example: str
    task: str
    quick: str
    at_worst: dict[str, float] = field(default_factory=dict)

    @property
    def folder(self):
        return ROOT / "robots" / self.name

    @property
    def links(self):
        return runpy.run_path(str(self.folder / "make_colliders.py"))["LINKS"]


HANDS = (
    # Outliers: the rim of the thumb's first link, beyond the taxels; creases in the hollow of the Sharpa Wave's palm.
    Hand("xhand1", 13, "xhand1_palm.yaml", "palm.yaml", "index_bend", {"thumb_link1": 1.8e-3}),
    Hand("sharpa", 30, "tasks/sharpa_palm.yaml", "sharpa_palm.yaml", "thumb_dp", {"palm_base": 1.8e-3}),
)
TOLERANCE = 1e-3
"""How far primitives may be from touched surfaces [m]."""
ELSEWHERE = 10e-3
"""The same on backs and flanks [m]."""


@pytest.fixture(scope="module", params=HANDS, ids=lambda hand: hand.name)
def hand(request):
    return request.param


@pytest.fixture(scope="module")
def robot(hand):
    return load_model(hand.folder / f"{hand.name}_right.xml")


@pytest.fixture(scope="module")
def colliders(hand):
    return load_colliders(hand.folder / "colliders.yaml")


def of_mesh(robot, colliders, mesh):
    """Return the first body with a mesh, and its colliders."""
    body = next(body for body, body_mesh in written.meshes(robot).items() if body_mesh == mesh)
    return body, [collider for collider in colliders if collider.body == body]


def test_primitives_are_within_a_millimetre_of_touched_surfaces(hand, robot, colliders):
    for mesh, link in hand.links.items():
        _, primitives = of_mesh(robot, colliders, mesh)
        surface = written.surface_of(robot, mesh)
        touched, rest = fit.deviations(link, primitives, surface, count=3000, seed=5)
        assert max(touched.gap, touched.excess) <= hand.at_worst.get(mesh, TOLERANCE), mesh
        points = fit.samples(surface, link, 3000, 5)
        far = np.abs(fit.distance(primitives, points.pos).min(axis=0)[points.is_touched]) > TOLERANCE
        assert not link.touched or far.mean() <= (0.01 if mesh in hand.at_worst else 0.0), mesh
        assert touched.mean <= 0.35e-3, mesh
        assert max(rest.gap, rest.excess) <= ELSEWHERE, mesh
        assert any(collider.is_core for collider in primitives), mesh


@pytest.mark.slow
def test_every_taxel_of_the_finest_layout_is_near_a_primitive(hand, colliders):
    """Taxels lie on the mesh, so their distances to the primitives are those of the surface."""
    layout = compile_document(ROOT / "examples" / hand.example, {"resolution": "high"}).plan.layout
    for i, link in enumerate(layout.links):
        primitives = [collider for collider in colliders if collider.body == link.body]
        distances = np.abs(fit.distance(primitives, layout.pos[layout.link_id == i]).min(axis=0))
        assert distances.max() <= 1.1 * TOLERANCE, link


def test_every_link_that_collides_has_colliders(robot, colliders):
    assert {collider.body for collider in colliders} == {geom.body for geom in robot.geoms if geom.is_colliding}


def test_no_mesh_collides_and_masses_stay(hand, robot, colliders):
    model = with_colliders(robot.spec.copy(), colliders).compile()
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    assert is_mesh.sum() == hand.num_meshes and not (model.geom_contype[is_mesh] | model.geom_conaffinity[is_mesh]).any()
    for name in ("body_mass", "body_inertia", "body_ipos", "body_iquat", "jnt_range", "exclude_signature"):
        np.testing.assert_array_equal(getattr(model, name), getattr(robot.compiled, name))
    assert len(model.mesh_graph) == 0  # no unused hull is computed


def test_the_left_hands_are_the_mirror_images(hand, colliders):
    """Mirrored points have the same distances to the left hand's primitives."""
    left, mirror = load_colliders(hand.folder / "colliders_left.yaml"), written.Mirror()
    assert [mirror.renamed(collider.body) for collider in colliders] == [collider.body for collider in left]
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (200, 3))
    np.testing.assert_allclose(fit.distance(left, points * mirror.polar), fit.distance(colliders, points), atol=2e-6)


def test_fitting_a_link_is_repeatable(hand, robot, colliders):
    body, committed = of_mesh(robot, colliders, hand.quick)
    refitted = fit.fitted(hand.links[hand.quick], written.surface_of(robot, hand.quick))
    assert written.text({body: refitted}, hand.name) == written.text({body: committed}, hand.name)


@pytest.mark.slow
def test_taxels_of_a_task_are_the_same_with_either_colliders(hand):
    file = ROOT / "examples" / "tasks" / hand.task
    plans = [compile_document(file, {"robot.collision": word}, sensors=["felt", "load"]).plan for word in ("mesh", "primitive")]
    assert plans[0].taxels_id == plans[1].taxels_id
    assert plans[0].inputs.pairs == plans[1].inputs.pairs and plans[0].inputs.bodies == plans[1].inputs.bodies
    assert plans[0].scene.mjcf == plans[1].scene.mjcf and len(plans[1].scene.colliders) > hand.num_meshes
