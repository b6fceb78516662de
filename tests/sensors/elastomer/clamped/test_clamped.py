"""A clamped pad from document to reading, against two other solutions of the membrane's equation.

The first uses the pad's own mesh: element energies by quadrature, one dense matrix without the rows of the edge, solved
again for each displacement of the edge; readings agree to rounding. The second has no mesh: on a rectangle it sets the
equation at Chebyshev points (Trefethen, *Spectral Methods in MATLAB*, 2000, chapter 7); readings agree within the error
that `boundary.element_size` allows, 1e-3 of the largest displacement of the edge.
"""

import dataclasses

import numpy as np
import pytest
import torch
from numpy.polynomial.legendre import leggauss
from oracles.setups.scenes import state
from scipy.linalg import lu_factor, lu_solve

import tgdsl
from tgdsl.compiler.resolve import resolve
from tgdsl.quantities import ContactDepth
from tgdsl.schema.load import load
from tgdsl.sensors.elastomer import ELASTOMER
from tgdsl.sensors.elastomer.clamped.pad import element_size, unroll
from tgdsl.sensors.elastomer.reference import reference
from tgdsl.testing import SCENE, KindConformance, ReferenceModule, conformance_document

PALM, TIP = (0.03, 0.008, 0.01), (0.006, 0.02, 0.012)
"""Half sizes of two boxes [m]; their upper sides are the pads."""
PADS = SCENE.replace('type="box" size=".03 .02 .01"', 'type="box" size=".03 .008 .01"').replace(
    'type="sphere" size=".012"', 'type="box" size=".006 .02 .012"'
)


def membrane(pad, rate, bulk):
    """Return the dense matrix of ∫ ∇u·∇u + κ² u·u + K (∇·u)² over a pad; u of all nodes, then v."""
    nodes, total = pad.basis.N, np.zeros((2, pad.basis.N, 2, pad.basis.N))
    gauss, weight = leggauss(4)
    s, t = (part.ravel() for part in np.meshgrid((gauss + 1) / 2, (gauss + 1) / 2, indexing="ij"))
    weight = np.outer(weight, weight).ravel() / 4 * (1 - s)  # a square folded to a triangle: exact for quartics
    at = np.stack([1 - s - (1 - s) * t, s, (1 - s) * t])
    one, two = [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]  # corners, then middles of the sides 01, 12 and 02
    phi = np.where(np.arange(6)[:, None] < 3, at[one] * (2 * at[one] - 1), 4 * at[one] * at[two])
    for element, corners in zip(pad.basis.element_dofs.T, pad.basis.mesh.p.T[pad.basis.mesh.t.T], strict=True):
        slope = np.linalg.inv(np.c_[np.ones(3), corners])[1:]  # of the barycentric coordinates, (axis, corner)
        inner = (4 * at[one] - 1)[:, None] * slope.T[one][:, :, None]
        side = 4 * (at[one][:, None] * slope.T[two][:, :, None] + at[two][:, None] * slope.T[one][:, :, None])
        grad = np.where(np.arange(6)[:, None, None] < 3, inner, side)
        area = 0.5 * abs(np.linalg.det(np.c_[np.ones(3), corners])) * 2 * weight
        same = np.einsum("iaq,jaq,q->ij", grad, grad, area) + rate**2 * np.einsum("iq,jq,q->ij", phi, phi, area)
        both = np.einsum("ab,ij->aibj", np.eye(2), same) + bulk * np.einsum("iaq,jbq,q->aibj", grad, grad, area)
        total[np.ix_([0, 1], element, [0, 1], element)] += both
    return total.reshape(2 * nodes, 2 * nodes)


class DenseReference:
    """The kind's reference plus the effect of the clamped edge; matrices of a pad persist between calls."""

    def __init__(self, surface_of):
        self.surface_of, self.pads = surface_of, {}

    def __call__(self, spec, layout, gathered, context, state):
        readings, after = reference(spec.model_copy(update={"boundary": None}), layout, gathered, context, state)
        for link in range(len(layout.links)):
            taxels = np.flatnonzero((layout.link_id == link) & (layout.radius > 0))
            readings[taxels] += self.moved_back(spec, layout, link, taxels, gathered[ContactDepth].depth[taxels])
        return readings, after

    def moved_back(self, spec, layout, link, taxels, depth):
        edge, drag = spec.boundary, spec.boundary.drag
        if link not in self.pads:
            surface = self.surface_of(layout.links[link].name, edge.pad)
            extent = np.ptp(surface.vertices[surface.faces].reshape(-1, 3), axis=0).max()
            pad = unroll(surface, layout.pos[taxels], layout.normal[taxels], element_size(spec.thickness, drag, float(extent)))
            matrix = membrane(pad, np.sqrt(drag) / spec.thickness, edge.bulk)
            edge_rows = np.concatenate([pad.edge, pad.edge + pad.basis.N])
            inner = np.setdiff1d(np.arange(2 * pad.basis.N), edge_rows)
            self.pads[link] = pad, inner, lu_factor(matrix[np.ix_(inner, inner)]), matrix[np.ix_(inner, edge_rows)]
        pad, inner, factors, to_edge = self.pads[link]
        free = spread(spec, pad.edge_pos, pad.edge_normal, layout.pos[taxels], layout.area[taxels] / spec.reference_area, depth)
        moved = np.zeros((2, pad.basis.N))
        moved[:, pad.edge] = -np.einsum("eak,ek->ae", pad.edge_axes, free)
        moved.ravel()[inner] = -lu_solve(factors, to_edge @ moved[:, pad.edge].ravel())
        return np.einsum("jak,aj->jk", pad.taxel_axes, moved @ pad.at_taxels.T)


def spread(spec, places, normals, sources, weights, depth):
    """Return s_d Σ_i a_i h_i r_i (c g + (1 − c) ḡ/ρ̄ ρ) [m] of the free skin, one place at a time."""
    shifts, peak = np.zeros((len(places), 3)), np.exp(-0.5) / np.sqrt(2 * spec.dilation_falloff)
    for j, (x, n) in enumerate(zip(places, normals, strict=True)):
        r = x - sources
        r = r - np.outer(r @ n, n)
        square = (r**2).sum(axis=1)
        far = peak * 2 * spec.thickness / (square + spec.thickness**2)
        size = spec.compressibility * np.exp(-spec.dilation_falloff * square) + (1 - spec.compressibility) * far
        shifts[j] = spec.dilation_strength * (weights * depth * size) @ r
    return shifts


class Clamped(KindConformance):
    kind = ELASTOMER
    parameters = {
        "standoff": 0.003, "thickness": "8 mm", "compressibility": 0.7,
        "boundary": {"pad": {"facing": [0, 0, 1], "within": "20 deg"}, "drag": 0.5, "bulk": 0.8},
    }  # fmt: skip
    gates = ("geometric",)
    test_taxel_permutation_commutes = None  # its taxels are on no pad
    test_compiled_equals_eager = None  # the same graph as a pad with a free edge

    @pytest.fixture
    def scene(self, tmp_path_factory):
        path = tmp_path_factory.getbasetemp() / "clamped.xml"
        path.write_text(PADS)
        return path

    def document(self, scene, **changes):
        draw, taxels = np.random.default_rng(4), []
        for num, (x, y, z) in ((18, PALM), (9, TIP)):
            places = draw.uniform(-0.95, 0.95, (num, 2)) * [x, y]
            taxels.append(
                [
                    {"pos": [*at, z], "normal": [0, 0, 1], "radius": 0.0 if i % 7 == 3 else 0.004}
                    for i, at in enumerate(places.tolist())
                ]
            )
        return conformance_document(scene, {**self.sensor(), **changes}, *taxels)

    def build(self, document, dtype):
        module, plain = super().build(document, dtype)
        kind = dataclasses.replace(ELASTOMER, reference=DenseReference(resolve(load(document)).surface_of))
        return module, ReferenceModule(plain.plan, kind, plain.spec)


class TestClamped(Clamped):
    """Coupled by K, and the skin is dragged as well."""


class TestClampedWithoutBulk(Clamped):
    parameters = {
        **Clamped.parameters,
        "boundary": {**Clamped.parameters["boundary"], "bulk": 0.0, "drag": 0.5},
        "friction": 0.5,
    }
    test_gradients_equal_finite_differences = None  # as in the suite above
    test_gradients_of_parameters_equal_finite_differences = None


def test_clamping_the_edge_matters(tmp_path):
    """In the suite's states clamping moves markers far more than rounding does."""
    suite, scene = TestClamped(), tmp_path / "scene.xml"
    scene.write_text(PADS)
    clamped, _ = suite.build(suite.document(scene, shear_strength=0), torch.float64)
    free = tgdsl.compile(suite.document(scene, shear_strength=0, boundary=None), dtype=torch.float64)
    for inputs in suite.states(clamped):
        readings = clamped(inputs)["s"][..., :2], free(inputs)["s"][..., :2]
        assert (readings[0] - readings[1]).abs().max() > 0.05 * readings[1].abs().max()


def chebyshev(num, length):
    """Return `num` + 1 points between 0 and a length, and the matrix of the derivative there."""
    x = np.cos(np.pi * np.arange(num + 1) / num)
    c = np.where((np.arange(num + 1) % num) == 0, 2.0, 1.0) * (-1.0) ** np.arange(num + 1)
    slope = np.outer(c, 1 / c) / (x[:, None] - x + np.eye(num + 1))
    return length / 2 * (x + 1), (slope - np.diag(slope.sum(axis=1))) * 2 / length


def collocated(width, length, rate, bulk, displacement, places, nums):
    """Return u (place, 2) of −∇²u + κ² u − K ∇(∇·u) = 0 on a rectangle whose edge `displacement` of (x, y) displaces."""
    (x, slope_x), (y, slope_y) = chebyshev(nums[0], width), chebyshev(nums[1], length)
    eye_x, eye_y = np.eye(len(x)), np.eye(len(y))
    xx, yy, xy = np.kron(slope_x @ slope_x, eye_y), np.kron(eye_x, slope_y @ slope_y), np.kron(slope_x, slope_y)
    uncoupled = rate**2 * np.eye(len(xx)) - xx - yy
    matrix = np.block([[uncoupled - bulk * xx, -bulk * xy], [-bulk * xy, uncoupled - bulk * yy]])
    at = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    on_edge = np.tile((at[:, 0] % width == 0) | (at[:, 1] % length == 0), 2)
    u = np.where(on_edge, displacement(at).T.ravel(), 0.0)
    u[~on_edge] = np.linalg.solve(matrix[np.ix_(~on_edge, ~on_edge)], -matrix[np.ix_(~on_edge, on_edge)] @ u[on_edge])
    fit = [
        np.linalg.solve(np.polynomial.chebyshev.chebvander(2 * line / size - 1, num).T, basis.T).T
        for line, size, num, basis in (
            (x, width, nums[0], np.polynomial.chebyshev.chebvander(2 * places[:, 0] / width - 1, nums[0])),
            (y, length, nums[1], np.polynomial.chebyshev.chebvander(2 * places[:, 1] / length - 1, nums[1])),
        )
    ]
    return np.einsum("pi,pj,aij->pa", *fit, u.reshape(2, len(x), len(y)))


WIDTH, LENGTH, RADIUS = 0.02, 0.012, 0.015


@pytest.mark.parametrize(("bulk", "compressibility"), [(0.0, 1.0), (2.0, 0.5)])
def test_a_ball_on_a_rectangle(tmp_path, bulk, compressibility):
    """Depths by hand, the printed sum for the free skin, Chebyshev points for the effect of the edge."""
    (tmp_path / "scene.xml").write_text(
        f'<mujoco><worldbody><body name="pad"><freejoint/><geom type="box" size="{WIDTH / 2} {LENGTH / 2} .004"/></body>'
        f'<body name="item"><freejoint/><geom type="sphere" size="{RADIUS}"/></body></worldbody></mujoco>'
    )
    draw = np.random.default_rng(1)
    places = draw.uniform([0.0005, 0.0005], [WIDTH - 0.0005, LENGTH - 0.0005], (40, 2))
    pos = np.c_[places - [WIDTH / 2, LENGTH / 2], np.full(40, 0.004)]
    taxels = [{"pos": at, "normal": [0, 0, 1], "radius": 0.002, "area": 6e-6} for at in pos.tolist()]
    sensor = {
        "kind": "elastomer", "links": "pad", "feels": ["item"], "gate": "geometric", "shear_strength": 0,
        "thickness": 0.002, "compressibility": compressibility, "normalize": "none",
        "boundary": {"pad": {"facing": [0, 0, 1], "within": "20 deg"}, "bulk": bulk},
    }  # fmt: skip
    document = {
        "tgdsl": 1,
        "robot": {
            "model": str(tmp_path / "scene.xml"),
            "layout": {"resolutions": {"r": {"pad": {"method": "points", "points": taxels}}}},
        },
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": sensor},
    }
    touch = tgdsl.compile(document, dtype=torch.float64)
    centre = np.array([0.003, -0.002, 0.004 + RADIUS - 0.0012])
    readings = touch(state(touch, pos=centre.tolist()))["s"][0].numpy()

    spec, up = ELASTOMER.spec(**{**sensor, "feels": ("item",)}), np.array([0.0, 0.0, 1.0])
    depth = np.maximum(0.0, RADIUS - np.linalg.norm(pos - centre, axis=1))

    def free(at):
        lifted = np.c_[at - [WIDTH / 2, LENGTH / 2], np.full(len(at), 0.004)]
        return spread(spec, lifted, np.tile(up, (len(at), 1)), pos, np.ones(40), depth)[:, :2]

    rate = np.sqrt(3.0) / 0.002
    back = collocated(WIDTH, LENGTH, rate, bulk, free, places, (48, 36))
    coarser = collocated(WIDTH, LENGTH, rate, bulk, free, places, (40, 30))
    rim = np.concatenate([[(x, y) for y in (0, LENGTH)] for x in np.linspace(0, WIDTH, 50)])
    rim = np.concatenate([rim, np.concatenate([[(x, y) for x in (0, WIDTH)] for y in np.linspace(0, LENGTH, 50)])])
    largest = np.abs(free(rim)).max()
    assert np.abs(back - coarser).max() < 1e-4 * largest and np.abs(back).max() > 0.2 * largest
    np.testing.assert_allclose(readings[:, :2], free(places) - back, atol=1e-3 * largest)
    bulge = 100 * np.exp(-8000 * ((places[:, None] - places) ** 2).sum(axis=2)) @ depth**1.2
    np.testing.assert_allclose(readings[:, 2], bulge, rtol=1e-12)
