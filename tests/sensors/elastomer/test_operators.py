"""One operator as a matrix, a truncation and a convolution; where each may be used; and its clamped edge."""

import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.errors import LowerError, SpecError
from tgdsl.module.state import SceneState
from tgdsl.sensors.elastomer import ElastomerSpec
from tgdsl.sensors.elastomer.operators import (
    COST,
    PLANES,
    Convolution,
    Dense,
    LinkTaxels,
    OperatorForm,
    Truncated,
    apply,
    clamping,
    fold,
    gaussian,
    grid,
    responses,
)
from tgdsl.surfaces.surface import Surface

ELASTIC = {"kernel": "half_space", "youngs_modulus": 2e5, "poissons_ratio": 0.4, "normal_stiffness": 1e8}
TILT = np.array([[0.6, 0.0, 0.8], [0.48, 0.8, -0.36], [-0.64, 0.6, 0.48]])
"""Rows: two directions of a grid and its normal."""


def spec(**fields):
    return ElastomerSpec.model_validate({"kind": "elastomer", "links": "pad", "feels": ["item"], **fields})


def regular(rows, columns, pitch=(1.5e-3, 2e-3), shuffle=None):
    cell = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.arange(len(cell)) if shuffle is None else np.random.default_rng(shuffle).permutation(len(cell))
    cell, num = cell[order], len(cell)
    pos = (cell * pitch) @ TILT[:2] + [0.01, -0.02, 0.03]
    return LinkTaxels(pos, np.tile(TILT[2], (num, 1)), np.full(num, 3e-6), cell, np.ones(num, dtype=bool))


def applied(response, planes, part, form, tolerance=None, seed=0, dtype=torch.float64):
    folded = fold(response, planes, part, OperatorForm(form, tolerance))
    values = [torch.from_numpy(np.random.default_rng(seed + i).normal(size=(5, len(part.pos)))) for i in range(planes[1])]
    return torch.stack(apply([bound(folded)], values)), folded


def bound(operator):
    """Return an operator of tensors."""
    return type(operator)(**{name: torch.from_numpy(value) for name, value in vars(operator).items()})


@pytest.mark.parametrize("shape", [(9, 12), (7, 1), (1, 1), (4, 5)])
@pytest.mark.parametrize("fields", [{"compressibility": 0.3}, {**ELASTIC, "friction": 0.5}, {**ELASTIC, "shear_strength": 0}])
def test_the_convolution_equals_the_matrix(shape, fields):
    """To 1e-12 of the largest value, for every operator of both kernels, on a tilted grid with taxels in any order."""
    part = regular(*shape, shuffle=1)
    for name, response in responses(spec(**fields), part, None).items():
        dense, _ = applied(response, PLANES[name], part, "dense")
        fft, folded = applied(response, PLANES[name], part, "fft")
        assert isinstance(folded, Convolution)
        torch.testing.assert_close(fft, dense, rtol=0, atol=1e-12 * float(dense.abs().max()) + 1e-300)


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-6])
def test_a_truncation_has_the_least_rank_within_its_tolerance(tolerance):
    part = regular(9, 12)
    for name, response in responses(spec(), part, None).items():
        every = np.arange(len(part.pos))
        matrix = response(every).transpose(1, 3, 0, 2).reshape(PLANES[name][1] * len(every), -1)
        _, folded = applied(response, PLANES[name], part, "svd", tolerance)
        left, right = folded.left.reshape(len(matrix), -1), folded.right.reshape(folded.right.shape[0], -1)
        whole = np.linalg.norm(matrix)
        assert np.linalg.norm(left @ right - matrix) <= tolerance * whole
        if left.shape[1] > 1:
            fewer = left[:, :-1] @ right[:-1]
            assert np.linalg.norm(fewer - matrix) > tolerance * whole
        assert left.shape[1] < len(every)


def test_a_truncation_reads_within_its_tolerance():
    part = regular(9, 12)
    response = responses(spec(), part, None)["drag"]
    dense, _ = applied(response, (1, 1), part, "dense")
    cut, _ = applied(response, (1, 1), part, "svd", 1e-3)
    error = float((cut - dense).norm() / dense.norm())
    assert 0 < error < 5e-3


def test_links_do_not_couple():
    """Two links: each plane holds the two links' values, one after the other."""
    first, second = regular(3, 4), regular(5, 2)
    links = [
        bound(fold(responses(spec(), part, None)["spread"], (3, 1), part, OperatorForm(form, 1e-9)))
        for part, form in ((first, "fft"), (second, "svd"))
    ]
    values = torch.zeros(2, 22, dtype=torch.float64)
    values[0, 3], values[1, 15] = 1.0, 1.0
    results = torch.stack(apply(links, [values]))
    assert not results[:, 0, 12:].any() and results[:, 0, :12].abs().max() > 0
    assert results[:, 1, :12].abs().max() == 0 and results[:, 1, 12:].abs().max() > 0


def test_the_choice_follows_the_table(monkeypatch):
    """Dense unless another form is cheaper by the table; a truncation, which is inexact, only with a tolerance."""
    part = regular(9, 12)
    response = responses(spec(), part, None)["drag"]

    def chosen_form(tolerance=None, form="auto", taxels=part):
        return type(fold(response, (1, 1), taxels, OperatorForm(form, tolerance)))

    assert chosen_form() is Dense
    assert chosen_form(1e-2) is Truncated
    assert chosen_form(1e-15) is Dense  # the whole rank costs more than the matrix
    monkeypatch.setitem(COST, "fft", 1e-3)
    assert chosen_form() is chosen_form(1e-2) is Convolution
    monkeypatch.setitem(COST, "dense", 1e-6)
    assert chosen_form() is Dense


def test_a_large_grid_is_convolved_without_its_matrix():
    """100 × 100 taxels: the matrix would have 10⁸ entries; only four of its columns are ever formed."""
    part = regular(100, 100)
    response = responses(spec(), part, None)["bulge"]
    sizes = []

    def recording_response(source):
        sizes.append(len(source))
        return response(source)

    folded = fold(recording_response, (1, 1), part, OperatorForm("auto", None))
    assert isinstance(folded, Convolution) and sum(sizes) == 4


IRREGULAR = {
    "have no row and column": lambda p: LinkTaxels(p.pos, p.normal, p.area, np.full_like(p.cell, -1), p.is_active),
    "cells are empty or inactive": lambda p: LinkTaxels(p.pos, p.normal, p.area, p.cell, np.arange(12) != 5),
    "off its place": lambda p: LinkTaxels(p.pos + 1e-8 * np.eye(12, 3), p.normal, p.area, p.cell, p.is_active),
    "the normals differ": lambda p: LinkTaxels(p.pos, p.normal + 1e-5 * np.eye(12, 3), p.area, p.cell, p.is_active),
    "the areas differ": lambda p: LinkTaxels(p.pos, p.normal, p.area * np.linspace(1, 1.001, 12), p.cell, p.is_active),
}


@pytest.mark.parametrize("what", IRREGULAR)
def test_a_convolution_on_an_irregular_grid_is_refused_by_name(what):
    part = IRREGULAR[what](regular(3, 4))
    assert what in str(grid(part))
    with pytest.raises(LowerError, match=what) as caught:
        fold(responses(spec(), part, None)["drag"], (1, 1), part, OperatorForm("fft", None))
    assert caught.value.field == "operator"
    assert isinstance(fold(responses(spec(), part, None)["drag"], (1, 1), part, OperatorForm("auto", None)), Dense)


def test_a_hole_in_the_grid_is_refused():
    part = regular(3, 4)
    keep = np.arange(12) != 5
    holed = LinkTaxels(part.pos[keep], part.normal[keep], part.area[keep], part.cell[keep], part.is_active[keep])
    assert "1 of 3 × 4 cells are empty" in str(grid(holed))
    assert isinstance(grid(part), np.ndarray)


SCENE = """<mujoco><worldbody><body name="pad"><freejoint/><geom type="box" size=".012 .01 .005"/></body>
<body name="item"><freejoint/><geom type="sphere" size=".01"/></body></worldbody></mujoco>"""


def document(folder, **sensor):
    path = folder / "scene.xml"
    path.write_text(SCENE)
    placed = {"method": "grid", "rows": 8, "columns": 9, "direction": [0, 0, -1], "radius": "1 mm"}
    return {
        "tgdsl": 1,
        "robot": {"model": str(path), "layout": {"resolutions": {"r": {"pad": placed}}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {"s": {"kind": "elastomer", "links": "pad", "feels": ["item"], "gate": "geometric", **sensor}},
    }


def readings(folder, **sensor):
    module = tgdsl.compile(document(folder, **sensor), dtype=torch.float64)
    outputs = []
    for at in ([0.001, 0.002, 0.0142], [0.0015, 0.0018, 0.0143]):
        pos = {"pad": [0.0, 0, 0], "item": at}
        state = SceneState(
            body_pos=torch.tensor([[pos[body] for body in module.inputs.bodies]], dtype=torch.float64),
            body_quat=torch.tensor([[[1.0, 0, 0, 0]] * 2], dtype=torch.float64),
        )
        outputs.append(module(state)["s"])
    return torch.stack(outputs), module


@pytest.mark.parametrize("fields", [{}, {**ELASTIC, "friction": 0.4}])
def test_all_forms_give_the_same_readings(tmp_path, fields):
    """A sphere pressed into a grid projected on a box, then dragged: all three forms, through the plan."""
    dense, _ = readings(tmp_path, operator="dense", **fields)
    fft, module = readings(tmp_path, operator="fft", **fields)
    svd, _ = readings(tmp_path, operator="svd", tolerance=1e-9, **fields)
    largest = float(dense.abs().max())
    assert largest > 1e-6 and any(name.endswith("spectrum") for name in module.plan.sensors[0].constants)
    torch.testing.assert_close(fft, dense, rtol=0, atol=1e-12 * largest)
    torch.testing.assert_close(svd, dense, rtol=0, atol=1e-7 * largest)


def test_a_convolution_on_a_curved_link_is_a_mistake(tmp_path):
    source = document(tmp_path, operator="fft")
    (tmp_path / "scene.xml").write_text(SCENE.replace('type="box" size=".012 .01 .005"', 'type="sphere" size=".02"'))
    with pytest.raises(SpecError, match=r"sensors\.s\.operator.*regular planar grid"):
        tgdsl.compile(source)


def rectangle(x, y):
    vertices = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]) / 2
    return Surface(vertices, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, dtype=np.int64), (("pad",),))


def pad_of(num, side, inset):
    """Return num × num taxels on a flat pad, the outermost `inset` [m] from its edge."""
    line = np.linspace(inset - side / 2, side / 2 - inset, num)
    pos = np.stack([*np.meshgrid(line, line, indexing="ij"), np.zeros((num, num))], axis=-1).reshape(-1, 3)
    return LinkTaxels(
        pos, np.tile([0.0, 0, 1], (num**2, 1)), np.full(num**2, 4e-6), np.full((num**2, 2), -1), np.ones(num**2, dtype=bool)
    )


def test_a_clamped_edge_is_fixed_and_the_middle_hardly_changes():
    """Taxels 20 µm from the wall move by about 20 µm/(t/√β) of the free field's normal slope; the middle is 10 t/√β away."""
    fields = {"thickness": 1.5e-3, "boundary": {}}
    part = pad_of(7, 0.018, 2e-5)
    clamped, free = (
        responses(spec(**f), part, p) for f, p in ((fields, rectangle(0.018, 0.018)), ({"thickness": 1.5e-3}, None))
    )
    every = np.arange(49)
    a, b = clamped["spread"](every)[:, 0], free["spread"](every)[:, 0]
    is_edge = np.abs(part.pos[:, :2]).max(axis=1) > 0.0089
    middle = np.abs(part.pos[:, :2]).max(axis=1) < 1e-4
    print(
        "edge",
        np.abs(a[:, is_edge]).max() / np.abs(b[:, is_edge]).max(),
        "middle",
        np.abs(a - b)[:, middle].max() / np.abs(b).max(),
    )
    assert np.abs(a[:, is_edge]).max() < 0.06 * np.abs(b[:, is_edge]).max()
    assert np.abs(a - b)[:, middle].max() < 1e-3 * np.abs(b).max()
    assert np.abs(a[2]).max() < 1e-15 * np.abs(b).max()  # the edge of a flat pad acts in its plane
    for name in ("bulge", "drag"):
        np.testing.assert_array_equal(clamped[name](every), free[name](every))


def test_clamping_is_linear_and_driven_by_the_edges_displacement():
    """Far from its ends a long pad is a strip: the free displacement of its edge drives a sinh profile across it.

    Sources on the middle line are equal along y, so the field depends only on x and points along it at the edges x = ±w:
    u_corr(x) = −u_free(w) sinh(κx)/sinh(κw), κ = √(β/(1 + K))/t.
    """
    thickness, drag, bulk, half = 2e-3, 3.0, 0.5, 3e-3
    x, y = np.linspace(-2.7e-3, 2.7e-3, 9), np.linspace(-0.0115, 0.0115, 47)
    row = np.array([[value, 0, 0] for value in x])
    column = np.array([[0.0, value, 0] for value in y])
    pos = np.concatenate([row, column])
    num = len(pos)
    part = LinkTaxels(pos, np.tile([0.0, 0, 1], (num, 1)), np.full(num, 1e-6), np.full((num, 2), -1), np.ones(num, dtype=bool))
    elastomer = spec(thickness=thickness, dilation_falloff=80000, boundary={"drag": drag, "bulk": bulk})
    added = clamping(elastomer, part, rectangle(2 * half, 0.024))[:, 0, :9, 9:].sum(axis=2)
    edge = np.array([[half, 0.0, 0]])
    free = gaussian(elastomer, part).spread(edge, np.array([[0.0, 0, 1]]), column)[0, 0, 0].sum()
    kappa = np.sqrt(drag / (1 + bulk)) / thickness
    expected = -free * np.sinh(kappa * x) / np.sinh(kappa * half)
    np.testing.assert_allclose(added[0], expected, atol=0.01 * abs(free))
    assert np.abs(added[1]).max() < 1e-3 * abs(free)


def test_a_clamped_pad_is_never_convolved():
    """Near its edge a response differs from the middle's, whatever the tolerance."""
    part = regular(5, 5, pitch=(2e-3, 2e-3))
    folded = fold(responses(spec(), part, None)["spread"], (3, 1), part, OperatorForm("auto", None), is_alike=False)
    assert isinstance(folded, Dense)


def test_a_boundary_changes_readings_in_the_plane(tmp_path):
    """The pad is a region of the link, here its upper face; by default it is the whole closed box, which has no edge."""
    face = {"pad": {"facing": [0, 0, 1], "within": "10 deg"}}
    clamped, _ = readings(tmp_path, thickness=2e-3, shear_strength=0, boundary=face)
    free, _ = readings(tmp_path, thickness=2e-3, shear_strength=0)
    assert float((clamped - free).abs().max()) > 1e-3 * float(free.abs().max())
    torch.testing.assert_close(clamped[..., 2], free[..., 2], rtol=0, atol=1e-15)
    with pytest.raises(SpecError, match=r"sensors\.s\.boundary"):
        readings(tmp_path, thickness=2e-3, boundary={})
