"""Applying a fixed matrix per link to planes (…, taxel): as it is, cut to its rank, or as a convolution on a regular grid.

Every form is built at compile time:

| form | constants, per link | what it costs per environment, in multiply-adds |
|---|---|---|
| dense | `matrix` (in, source, out, target) | in · out · T² |
| svd | `left` (in, source, rank), `right` (rank, out, target) | rank · (in + out) · T |
| fft | `spectrum` (out, in, row, column, 2), `cells` (row, column), `places` (taxel,) | ((in + out) log₂ F + in · out) F |

T taxels of the link, F points of the padded grid. `dense` and `fft` are exact, `svd` is the truncation of least rank whose
error is within a tolerance of the matrix, by Frobenius' norm. The choice is by a fixed table of costs, never by timing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Generic, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.layout.layout import Layout
from tgdsl.sensors.base import Array, SurfaceOf
from tgdsl.sensors.elastomer.elastic import Layer, Profiles, half_space, patch_radius, profiles, tabulated
from tgdsl.sensors.elastomer.spec import ElastomerSpec
from tgdsl.surfaces.surface import Surface
from tgdsl.tensors.link_products import LINK_PRODUCTS

Matrix = Float[np.ndarray, "out in target source"]


@dataclass(frozen=True, eq=False)
class LinkTaxels:
    """The taxels of one link, body frame: positions [m], unit normals, areas [m²], grid cells, and which are active."""

    pos: Float[np.ndarray, "taxel 3"]
    normal: Float[np.ndarray, "taxel 3"]
    area: Float[np.ndarray, " taxel"]
    cell: Int[np.ndarray, "taxel 2"]
    is_active: Bool[np.ndarray, " taxel"]

    @property
    def spacing(self) -> float:
        """Root of the mean area of the active taxels [m]; 1 if there are none, for then nothing depends on it."""
        return float(np.sqrt(self.area[self.is_active].mean())) if self.is_active.any() else 1.0


@dataclass(frozen=True)
class Gaussian:
    """The paper's kernels, without their strengths."""

    dilation_falloff: float  # λ_d [1/m²]
    shear_falloff: float  # λ_s [1/m²]
    compressibility: float  # c [1]
    smoothing: float  # ε [m]
    is_normalized: bool  # whether the in-plane part is divided by ḡ

    def spread(
        self, pos: Float[np.ndarray, "target 3"], normal: Float[np.ndarray, "target 3"], source: Float[np.ndarray, "source 3"]
    ) -> Matrix:
        """Return r_ij (c g + (1 − c) ḡ/ρ̄ ρ) [m], (3, 1, target, source); over ḡ [1] if normalized."""
        r = offset(pos, normal, source)
        square = np.einsum("kji,kji->ji", r, r)
        peak = np.exp(-0.5) / np.sqrt(2.0 * self.dilation_falloff)
        local = np.exp(-self.dilation_falloff * square)
        stretch = peak * 2.0 * self.smoothing / (square + self.smoothing**2)
        size = self.compressibility * local + (1.0 - self.compressibility) * stretch
        return (r * (size / peak if self.is_normalized else size))[:, None]

    def bulge(self, targets: LinkTaxels, source: Float[np.ndarray, "source 3"]) -> Matrix:
        """Return g of the dilation, (1, 1, target, source)."""
        return self._fall(self.dilation_falloff, targets, source)

    def drag(self, targets: LinkTaxels, source: Float[np.ndarray, "source 3"]) -> Matrix:
        """Return g of the shear, (1, 1, target, source)."""
        return self._fall(self.shear_falloff, targets, source)

    def _fall(self, falloff: float, targets: LinkTaxels, source: np.ndarray) -> Matrix:
        r = offset(targets.pos, targets.normal, source)
        return np.exp(-falloff * np.einsum("kji,kji->ji", r, r))[None, None]


@dataclass(frozen=True)
class Elastic:
    """A linear elastic skin."""

    layer: Layer  # its thickness [m], infinite for a half-space, the markers' depth [m], G [Pa] and ν

    def profiles(self, r: np.ndarray, area: np.ndarray, mean_area: float, is_exact: bool = False) -> Profiles:
        """Return displacement per force [m/N] at distances r [m], (…, source), from sources of some areas [m²].

        A layer's loads are all spread over the link's mean area, a half-space's each over its own. `is_exact` evaluates a
        layer's integrals at each r instead of interpolating.
        """
        layer = self.layer
        if np.isinf(layer.thickness):
            return half_space(r, layer.depth, patch_radius(area), layer.shear_modulus, layer.poissons_ratio)
        find = profiles if is_exact else tabulated
        return find(r, layer, float(patch_radius(mean_area)))

    def displacement(self, taxels: LinkTaxels, source: Int[np.ndarray, " source"], targets: LinkTaxels | None = None) -> Matrix:
        """Return displacement per traction [m/Pa], (3, 3, target, source), both vectors in the body's frame.

        Args:
            taxels: The taxels of a link, which press.
            source: Which of them to take.
            targets: Markers that move; default: the taxels.
        """
        targets = taxels if targets is None else targets
        n, m = targets.normal, taxels.normal[source]
        area = taxels.area[source]
        r = offset(targets.pos, n, taxels.pos[source])
        length = np.sqrt(np.einsum("kji,kji->ji", r, r))
        e = r / np.where(length > 0, length, 1.0)
        folded = Profiles(*(part * area for part in self.profiles(length, area, float(taxels.spacing**2))))
        flat = np.eye(3)[:, :, None] - np.einsum("jk,jl->klj", n, n)
        source_plane = np.eye(3)[:, :, None] - np.einsum("ik,il->kli", m, m)
        twist = folded.along - folded.bend
        # A tangential traction stays as much as it lies in the target's plane; e lies in it already.
        tangential = np.einsum("kpj,pli,ji->klji", flat, source_plane, twist)
        seen = np.einsum("pji,pli->lji", e, source_plane)
        tangential += np.einsum("kji,lji,ji->klji", e, seen, 2.0 * folded.bend)
        tangential -= np.einsum("jk,lji,ji->klji", n, seen, folded.lift)
        pressed = np.einsum("jk,ji->kji", n, folded.normal) - e * folded.spread
        return tangential + np.einsum("kji,il->klji", pressed, m)


def offset(
    pos: Float[np.ndarray, "target 3"], normal: Float[np.ndarray, "target 3"], source: Float[np.ndarray, "source 3"]
) -> Float[np.ndarray, "3 target source"]:
    """Return r_ij = Π_nj(x_j − x_i) [m].

    The fixed matrices of an elastomer: what each source taxel of a link does to each target, per unit of its input.

    On a curved link, the offset of source i and target j is projected to the target's tangent plane, r_ij = Π_nj(x_j − x_i),
    exact for every pair, and tangential loads are projected there. The Gaussian kernel is so by definition. For the elastic
    kernels it is an approximation that takes the surface between two taxels as flat: it is good where the normals of
    interacting taxels differ by little, and it neglects curvature and the far side of a link.

    Shapes: `source`, `target` taxels; a matrix is (out, in, target, source), `out` and `in` planes of a vector or scalar.
    """
    between = pos.T[:, :, None] - source.T[:, None, :]
    along = np.einsum("kji,jk->ji", between, normal)
    return between - normal.T[:, :, None] * along


COST = {"dense": 1.0, "svd": 1.0, "fft": 32.0}
"""Time per multiply-add, relative to a large matrix product (one CPU core, float32, 512 environments)."""
SAME = 1e-6  # relative difference up to which spacings, areas and normals of a grid count as equal

Response = Callable[[Int[np.ndarray, " source"]], Float[np.ndarray, "out in target source"]]
"""Returns the responses of all taxels of the link to some source taxels."""


@dataclass(frozen=True, eq=False)
class Dense(Generic[Array]):
    """The matrix (in, source, out, target)."""

    matrix: Array

    @property
    def num_taxels(self: Dense[Tensor]) -> int:
        """Number of taxels of the link."""
        return self.matrix.shape[1]

    def __call__(self: Dense[Tensor], planes: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the output planes (…, taxel)."""
        sources, targets = self.matrix.shape[1], self.matrix.shape[3]
        return (_joined(planes) @ self.matrix.reshape(len(planes) * sources, -1)).split(targets, dim=-1)


@dataclass(frozen=True, eq=False)
class Truncated(Generic[Array]):
    """Factors of the matrix, (in, source, rank) and (rank, out, target)."""

    left: Array
    right: Array

    @property
    def num_taxels(self: Truncated[Tensor]) -> int:
        """Number of taxels of the link."""
        return self.left.shape[1]

    def __call__(self: Truncated[Tensor], planes: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the output planes (…, taxel)."""
        left, right = self.left, self.right
        out = (_joined(planes) @ left.reshape(-1, left.shape[2])) @ right.reshape(right.shape[0], -1)
        return out.split(right.shape[2], dim=-1)


@dataclass(frozen=True, eq=False)
class Convolution(Generic[Array]):
    """The transform of the response, (out, in, row, column, 2); the taxel of each cell; and the cell of each taxel."""

    spectrum: Array
    cells: Array
    places: Array

    @property
    def num_taxels(self: Convolution[Tensor]) -> int:
        """Number of taxels of the link."""
        return self.places.shape[0]

    def __call__(self: Convolution[Tensor], planes: list[Tensor]) -> tuple[Tensor, ...]:
        """Return the output planes (…, taxel)."""
        spectrum = torch.view_as_complex(self.spectrum)
        rows, columns = self.cells.shape
        size = spectrum.shape[2], 2 * (spectrum.shape[3] - 1)
        order = self.cells.reshape(-1)
        waves = [torch.fft.rfft2(plane[..., order].unflatten(-1, (rows, columns)), s=size) for plane in planes]
        results = []
        for response in spectrum:
            total = sum((wave * factor for wave, factor in zip(waves, response, strict=True)), start=torch.zeros_like(waves[0]))
            plane = torch.fft.irfft2(total, s=size)[..., :rows, :columns]
            results.append(plane.flatten(-2)[..., self.places])
        return tuple(results)


Operator: TypeAlias = Dense[Array] | Truncated[Array] | Convolution[Array]


def operator_of(constants: Mapping[str, Array]) -> Operator[Array]:
    """Return the operator of one link with these constants."""
    return next(
        form(**constants) for form in (Dense, Truncated, Convolution) if form.__dataclass_fields__.keys() == constants.keys()
    )


class OperatorForm(NamedTuple):
    """The user's form or "auto", and the allowed relative error; None: exact forms, if there is a choice."""

    form: str
    tolerance: float | None

    @property
    def error(self) -> float:
        """Relative error of a truncation."""
        return 1e-3 if self.tolerance is None else self.tolerance


def fold(
    response: Response, planes: tuple[int, int], taxels: LinkTaxels, wanted: OperatorForm, is_alike: bool = True
) -> Operator[np.ndarray]:
    """Return one link's operator.

    Args:
        response: Its matrix.
        planes: Numbers of output and input planes.
        taxels: The link's taxels.
        wanted: The form and its error.
        is_alike: Whether targets are the taxels, and the response depends on nothing but the way from source to target where
            these are alike.

    Raises:
        LowerError: If a convolution is asked for where the taxels are no regular grid.
    """
    num = len(taxels.pos)
    cells = grid(taxels) if is_alike and wanted.form in ("auto", "fft") else None
    if wanted.form == "fft" and isinstance(cells, str):
        raise LowerError(f"`fft` needs taxels on a regular planar grid: {cells}", "operator", "use dense, svd or auto")
    on_grid = cells if isinstance(cells, np.ndarray) else None
    dense = COST["dense"] * np.prod(planes) * num**2
    if on_grid is not None and (wanted.form == "fft" or _fft_cost(planes, on_grid.shape) < dense):
        return _spectrum(response, on_grid)
    matrix = np.ascontiguousarray(response(np.arange(num)).transpose(1, 3, 0, 2))
    if wanted.form == "svd" or (wanted.form == "auto" and wanted.tolerance is not None):
        left, right = _truncated(matrix, wanted.error)
        if wanted.form == "svd" or COST["svd"] * (left.size + right.size) < dense:
            return Truncated(left, right)
    return Dense(matrix)


def grid(taxels: LinkTaxels) -> Int[np.ndarray, "row column"] | str:
    """Return the taxel in each cell of a full, regular, planar grid, or the reason why it is not one."""
    if (taxels.cell < 0).any():
        return f"{int((taxels.cell < 0).any(axis=1).sum())} taxels have no row and column"
    cell = taxels.cell - taxels.cell.min(axis=0)
    rows, columns = (int(n) for n in cell.max(axis=0) + 1)
    if rows * columns != len(cell) or not taxels.is_active.all() or len(np.unique(cell, axis=0)) != len(cell):
        return f"{rows * columns - int(taxels.is_active.sum())} of {rows} × {columns} cells are empty or inactive"
    cells = np.empty((rows, columns), dtype=np.int64)
    cells[cell[:, 0], cell[:, 1]] = np.arange(len(cell))
    first = taxels.pos[cells[0, 0]]
    steps = [(taxels.pos[cells[-1, 0]] - first) / max(rows - 1, 1), (taxels.pos[cells[0, -1]] - first) / max(columns - 1, 1)]
    off = np.linalg.norm(taxels.pos - first - cell @ np.stack(steps), axis=1).max()
    pitch = min((float(np.linalg.norm(step)) for step in steps if step.any()), default=1.0)
    if off > SAME * pitch:
        return f"a taxel is {off:.2g} m off its place, the spacing is {pitch:.2g} m"
    if np.linalg.norm(taxels.normal - taxels.normal[0], axis=1).max() > SAME:
        return "the normals differ"
    if np.ptp(taxels.area) > SAME * taxels.area.max():
        return f"the areas differ, from {taxels.area.min():.3g} to {taxels.area.max():.3g} m²"
    return cells


def apply(operators: Sequence[Operator[Tensor]], planes: Sequence[Float[Tensor, "*env taxel"]]) -> tuple[Tensor, ...]:
    """Return the output planes (…, taxel) of the operators of all links, link after link.

    Args:
        operators: Of each link.
        planes: Input planes, taxels last.
    """
    dense = [operator.matrix for operator in operators if isinstance(operator, Dense)]
    if len(dense) == len(operators):
        matrices = [[matrix[i] for matrix in dense] for i in range(len(planes))]
        is_square = all(matrix.shape[1] == matrix.shape[3] for matrix in dense)  # targets may be markers
        if is_square and LINK_PRODUCTS.takes_kernel(planes[0], matrices[0]):
            lines = [plane.reshape(-1, plane.shape[-1]) for plane in planes]
            result = reduce(torch.add, [LINK_PRODUCTS(line, each) for line, each in zip(lines, matrices, strict=True)])
            return tuple(result.unflatten(1, planes[0].shape[:-1]).unbind())
    of_links = zip(*(plane.split([operator.num_taxels for operator in operators], dim=-1) for plane in planes), strict=True)
    parts = [operator(list(sources)) for operator, sources in zip(operators, of_links, strict=True)]
    return tuple(part[0] if len(part) == 1 else torch.cat(part, dim=-1) for part in zip(*parts, strict=True))


def _joined(planes: list[Tensor]) -> Tensor:
    return planes[0] if len(planes) == 1 else torch.cat(planes, dim=-1)


def _padded(num: int) -> int:
    from scipy.fft import next_fast_len

    return 2 * (next_fast_len(num, real=True) or num)


def _fft_cost(planes: tuple[int, int], shape: tuple[int, ...]) -> float:
    points = float(np.prod([_padded(num) for num in shape]))
    return COST["fft"] * points * (sum(planes) * np.log2(points) + np.prod(planes))


def _spectrum(response: Response, cells: Int[np.ndarray, "row column"]) -> Convolution[np.ndarray]:
    """Return the transform of the response to one cell: seen from the four corners it shows every offset there is."""
    size = np.array([_padded(num) for num in cells.shape])
    kernel = None
    for row in (0, cells.shape[0] - 1):
        for column in (0, cells.shape[1] - 1):
            seen = response(cells[row, column].reshape(1))[..., cells, 0]
            kernel = np.zeros((*seen.shape[:2], *size)) if kernel is None else kernel
            down, right = (np.arange(num) - at for num, at in zip(cells.shape, (row, column), strict=True))
            kernel[:, :, (down % size[0])[:, None], right % size[1]] = seen
    assert kernel is not None
    wave = np.fft.rfft2(kernel)
    spectrum = np.stack([wave.real, wave.imag], axis=-1)
    return Convolution(spectrum, cells, np.argsort(cells.reshape(-1), kind="stable"))


def _truncated(matrix: Float[np.ndarray, "in source out target"], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of least rank, at least 1, that keep the relative error within the tolerance."""
    num_in, sources, num_out, targets = matrix.shape
    u, s, v = np.linalg.svd(matrix.reshape(num_in * sources, num_out * targets), full_matrices=False)
    lost = np.sqrt(np.cumsum((s * s)[::-1])[::-1])
    rank = max(1, int(np.count_nonzero(lost > tolerance * lost[0])))
    left, right = u[:, :rank] * s[:rank], v[:rank]
    return left.reshape(num_in, sources, rank), right.reshape(rank, num_out, targets)


PLANES = {"spread": (3, 1), "bulge": (1, 1), "drag": (1, 1), "traction": (3, 3), "pressure": (3, 1)}
"""Planes that each operator puts out and takes in."""


def link_taxels(layout: Layout, link: int) -> LinkTaxels:
    """Return the taxels of one link; inactive ones, whose area may be nothing, get the others' mean."""
    at = layout.link_id == link
    is_active, area = layout.radius[at] > 0, layout.area[at]
    mean = area[is_active].mean() if is_active.any() else 1.0
    return LinkTaxels(layout.pos[at], layout.normal[at], np.where(is_active, area, mean), layout.cell[at], is_active)


def gaussian(spec: ElastomerSpec, part: LinkTaxels) -> Gaussian:
    """Return the paper's kernels for one link."""
    smoothing = part.spacing if spec.thickness is None else spec.thickness
    return Gaussian(spec.dilation_falloff, spec.shear_falloff, spec.compressibility, smoothing, spec.normalize == "peak")


def elastic(spec: ElastomerSpec) -> Elastic:
    """Return the elastic skin that a spec describes."""
    assert spec.youngs_modulus is not None
    thickness = np.inf if spec.kernel == "half_space" or spec.thickness is None else spec.thickness
    modulus = spec.youngs_modulus / (2.0 * (1.0 + spec.poissons_ratio))
    return Elastic(Layer(thickness, spec.marker_depth, modulus, spec.poissons_ratio))


def weights(spec: ElastomerSpec, part: LinkTaxels) -> Float[np.ndarray, " taxel"]:
    """Return a_i of the Gaussian kernel [1]; 0 for inactive taxels."""
    area = np.ones(len(part.area)) if spec.model == "paper" else part.area / spec.reference_area
    return np.where(part.is_active, area, 0.0)


def fold_links(
    spec: ElastomerSpec, layout: Layout, markers: Layout | None, surface_of: SurfaceOf
) -> dict[str, tuple[Operator[np.ndarray], ...]]:
    """Return the operators of all links by name, from taxels to markers; None: taxels are markers.

    Raises:
        LowerError: If a convolution is asked for where it cannot be, or the pad's edge cannot be clamped.
    """
    of_links = []
    for i, link in enumerate(layout.links):
        try:
            of_links.append(_fold_link(spec, layout, markers, i, surface_of))
        except LowerError as error:
            field = error.field or "boundary"  # errors of a surface have no field
            raise LowerError(f'link "{link.name}": {error.what}', field, error.hint) from error
    return {name: tuple(operators[name] for operators in of_links) for name in of_links[0]}


def _fold_link(
    spec: ElastomerSpec, layout: Layout, markers: Layout | None, link: int, surface_of: SurfaceOf
) -> dict[str, Operator[np.ndarray]]:
    part, targets = link_taxels(layout, link), None if markers is None else link_taxels(markers, link)
    pad = None if spec.boundary is None else surface_of(layout.links[link].name, spec.boundary.pad)
    form = OperatorForm(spec.operator, spec.tolerance)
    return {
        name: fold(response, PLANES[name], part, form, is_alike=targets is None and (pad is None or name != "spread"))
        for name, response in responses(spec, part, pad, targets).items()
    }


def responses(
    spec: ElastomerSpec, part: LinkTaxels, pad: Surface | None, targets: LinkTaxels | None = None
) -> dict[str, Response]:
    """Return the operators of one link by name, from its taxels to its markers; by default the same."""
    targets = part if targets is None else targets
    is_active = targets.is_active.astype(np.float64)[:, None]
    if spec.kernel != "gaussian":
        return _elastic_responses(spec, part, targets, is_active)
    kernel, weight = gaussian(spec, part), weights(spec, part)
    clamped = None
    if pad is not None:
        clamped = kernel.spread(part.pos, part.normal, part.pos) + clamping(spec, part, pad)

    def spread(source: np.ndarray) -> np.ndarray:
        response = kernel.spread(targets.pos, targets.normal, part.pos[source]) if clamped is None else clamped[..., source]
        return is_active * response * weight[source]

    def bulge(source: np.ndarray) -> np.ndarray:
        return is_active * kernel.bulge(targets, part.pos[source]) * weight[source]

    def drag(source: np.ndarray) -> np.ndarray:
        return is_active * kernel.drag(targets, part.pos[source]) * weight[source]

    return {"spread": spread, "bulge": bulge, **({"drag": drag} if spec.anchored == "taxels" else {})}


def _elastic_responses(
    spec: ElastomerSpec, part: LinkTaxels, targets: LinkTaxels, is_active: Float[np.ndarray, "target 1"]
) -> dict[str, Response]:
    material = elastic(spec)

    def traction(source: np.ndarray) -> np.ndarray:
        return is_active * material.displacement(part, source, targets) * part.is_active[source]

    def pressure(source: np.ndarray) -> np.ndarray:
        return -np.einsum("klji,il->kji", traction(source), part.normal[source])[:, None]

    return {"traction": traction} if spec.has_shear else {"pressure": pressure}


def clamping(spec: ElastomerSpec, part: LinkTaxels, pad: Surface) -> Float[np.ndarray, "3 1 target source"]:
    """Return the change of `spread` from a clamped edge: the edge's displacement is cancelled."""
    # Imported here: only clamped pads need scikit-fem, and a compiled module runs without it.
    from tgdsl.sensors.elastomer.clamped.pad import correction, element_size, unroll

    assert spec.boundary is not None and spec.thickness is not None
    added = np.zeros((3, 1, len(part.pos), len(part.pos)))
    if not part.is_active.any():
        return added
    active, drag = np.flatnonzero(part.is_active), spec.boundary.drag
    extent = float(np.ptp(pad.corners.reshape(-1, 3), axis=0).max())
    sheet = unroll(pad, part.pos[active], part.normal[active], element_size(spec.thickness, drag, extent))
    free = gaussian(spec, part).spread(sheet.edge_pos, sheet.edge_normal, part.pos)[:, 0]
    back = -np.einsum("eak,kei->aei", sheet.edge_axes, free).reshape(-1, len(part.pos))
    inside = (correction(sheet, spec.thickness, drag, spec.boundary.bulk) @ back).reshape(2, len(active), -1)
    added[:, 0, active] = np.einsum("jak,aji->kji", sheet.taxel_axes, inside)
    return added
