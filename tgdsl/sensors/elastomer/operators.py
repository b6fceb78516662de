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
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.sensors.base import Array
from tgdsl.sensors.elastomer.kernels import LinkTaxels
from tgdsl.tensors.link_products import LINK_PRODUCTS

COST = {"dense": 1.0, "svd": 1.0, "fft": 32.0}
"""Time per multiply-add, relative to a large matrix product (one CPU core, float32, 512 environments)."""
SAME = 1e-6
"""Relative difference up to which spacings, areas and normals of a grid count as equal."""

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
