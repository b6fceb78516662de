"""Applying a fixed matrix per link to planes (…, taxel): as it is, cut to its rank, or as a convolution on a regular grid.

Every form is made at compile time and is known by its constants:

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
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.sensors.elastomer.kernels import LinkTaxels
from tgdsl.tensors.link_products import LINK_PRODUCTS

COST = {"dense": 1.0, "svd": 1.0, "fft": 32.0}
"""Time per multiply-add of each form, over that of a large matrix product (one CPU core, float32, 512 environments)."""
SAME = 1e-6
"""Relative difference up to which spacings, areas and normals of a grid count as equal."""

Response = Callable[[Int[np.ndarray, " source"]], Float[np.ndarray, "out in target source"]]
"""Returns what some source taxels do to all taxels of the link."""


class OperatorForm(NamedTuple):
    """What the user asked for: a form or "auto", and the relative error that is allowed; None: none, if there is a choice."""

    form: str
    tolerance: float | None

    @property
    def error(self) -> float:
        """Relative error of a truncation."""
        return 1e-3 if self.tolerance is None else self.tolerance


def fold(
    response: Response, planes: tuple[int, int], taxels: LinkTaxels, wanted: OperatorForm, is_alike: bool = True
) -> dict[str, np.ndarray]:
    """Return the constants of one link's operator.

    Args:
        response: Its matrix.
        planes: Numbers of planes that go out and in.
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
            return {"left": left, "right": right}
    return {"matrix": matrix}


def grid(taxels: LinkTaxels) -> Int[np.ndarray, "row column"] | str:
    """Return the taxel in each cell of a full, regular, planar grid, or else say what it lacks."""
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
        return f"a taxel is {off:.2g} m beside its place, the spacing is {pitch:.2g} m"
    if np.linalg.norm(taxels.normal - taxels.normal[0], axis=1).max() > SAME:
        return "the normals differ"
    if np.ptp(taxels.area) > SAME * taxels.area.max():
        return f"the areas differ, from {taxels.area.min():.3g} to {taxels.area.max():.3g} m²"
    return cells


def apply(constants: Mapping[str, Tensor], name: str, planes: Sequence[Float[Tensor, "*env taxel"]]) -> tuple[Tensor, ...]:
    """Return the planes (…, taxel) that come out of an operator, link after link.

    Args:
        constants: Holds the operator's constants as `<name>/<link>/<constant>`.
        name: The operator's name.
        planes: What goes in: any number of leading axes, taxels last.
    """
    matrices = _matrices(constants, name)
    is_square = all(matrix.shape[0] == matrix.shape[2] for each in matrices for matrix in each)  # markers may be others
    if matrices and is_square and LINK_PRODUCTS.takes_kernel(planes[0], matrices[0]):
        lines = [plane.reshape(-1, plane.shape[-1]) for plane in planes]
        result = reduce(torch.add, [LINK_PRODUCTS(own, each) for own, each in zip(lines, matrices, strict=True)])
        return tuple(result.unflatten(1, planes[0].shape[:-1]).unbind())
    parts: list[tuple[Tensor, ...]] = []
    start = 0
    while (form := _form(constants, f"{name}/{len(parts)}")) is not None:
        constant, num, use = form
        parts.append(use(constant, [plane[..., start : start + num] for plane in planes]))
        start += num
    return tuple(part[0] if len(part) == 1 else torch.cat(part, dim=-1) for part in zip(*parts, strict=True))


def _matrices(constants: Mapping[str, Tensor], name: str) -> list[list[Float[Tensor, "_source out _target"]]]:
    """Return the matrices of all links, for each plane that goes in; nothing if there are other forms."""
    results: list[Tensor] = []
    while (form := _form(constants, f"{name}/{len(results)}")) is not None:
        if "matrix" not in form[0]:
            return []
        results.append(form[0]["matrix"])
    return [[matrix[i] for matrix in results] for i in range(len(results[0]))] if results else []


Block = Mapping[str, Tensor]
Use = Callable[[Block, list[Tensor]], tuple[Tensor, ...]]


def _form(constants: Mapping[str, Tensor], prefix: str) -> tuple[Block, int, Use] | None:
    """Return the constants of one link, its number of taxels, and how to apply them; None if there is no such link."""
    if (matrix := constants.get(f"{prefix}/matrix")) is not None:
        return {"matrix": matrix}, matrix.shape[1], _use_matrix
    if (left := constants.get(f"{prefix}/left")) is not None:
        return {"left": left, "right": constants[f"{prefix}/right"]}, left.shape[1], _use_factors
    if (places := constants.get(f"{prefix}/places")) is not None:
        names = ("spectrum", "cells", "places")
        return {name: constants[f"{prefix}/{name}"] for name in names}, places.shape[0], _use_spectrum
    return None


def _use_matrix(block: Block, planes: list[Tensor]) -> tuple[Tensor, ...]:
    matrix = block["matrix"]
    sources, targets = matrix.shape[1], matrix.shape[3]
    out = _joined(planes) @ matrix.reshape(len(planes) * sources, -1)
    return out.split(targets, dim=-1)


def _use_factors(block: Block, planes: list[Tensor]) -> tuple[Tensor, ...]:
    left, right = block["left"], block["right"]
    out = (_joined(planes) @ left.reshape(-1, left.shape[2])) @ right.reshape(right.shape[0], -1)
    return out.split(right.shape[2], dim=-1)


def _use_spectrum(block: Block, planes: list[Tensor]) -> tuple[Tensor, ...]:
    cells, spectrum = block["cells"], torch.view_as_complex(block["spectrum"])
    rows, columns = cells.shape
    size = spectrum.shape[2], 2 * (spectrum.shape[3] - 1)
    order = cells.reshape(-1)
    waves = [torch.fft.rfft2(plane[..., order].unflatten(-1, (rows, columns)), s=size) for plane in planes]
    results = []
    for response in spectrum:
        total = sum((wave * factor for wave, factor in zip(waves, response, strict=True)), start=torch.zeros_like(waves[0]))
        plane = torch.fft.irfft2(total, s=size)[..., :rows, :columns]
        results.append(plane.flatten(-2)[..., block["places"]])
    return tuple(results)


def indices(constants: Mapping[str, np.ndarray]) -> dict[str, int]:
    """Return of how many cells a transform's constants are indices, by their names."""
    grids = {name.removesuffix("cells"): cells.size for name, cells in constants.items() if name.endswith("/cells")}
    return {f"{prefix}{name}": size for prefix, size in grids.items() for name in ("cells", "places")}


def _joined(planes: list[Tensor]) -> Tensor:
    return planes[0] if len(planes) == 1 else torch.cat(planes, dim=-1)


def _padded(num: int) -> int:
    """Return an even length that FFTs like and that holds all offsets of a row of cells."""
    from scipy.fft import next_fast_len

    return 2 * (next_fast_len(num, real=True) or num)


def _fft_cost(planes: tuple[int, int], shape: tuple[int, ...]) -> float:
    points = float(np.prod([_padded(num) for num in shape]))
    return COST["fft"] * points * (sum(planes) * np.log2(points) + np.prod(planes))


def _spectrum(response: Response, cells: Int[np.ndarray, "row column"]) -> dict[str, np.ndarray]:
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
    return {"spectrum": spectrum, "cells": cells, "places": np.argsort(cells.reshape(-1), kind="stable")}


def _truncated(matrix: Float[np.ndarray, "in source out target"], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of least rank, at least 1, that keep the relative error within the tolerance."""
    num_in, sources, num_out, targets = matrix.shape
    u, s, v = np.linalg.svd(matrix.reshape(num_in * sources, num_out * targets), full_matrices=False)
    lost = np.sqrt(np.cumsum((s * s)[::-1])[::-1])
    rank = max(1, int(np.count_nonzero(lost > tolerance * lost[0])))
    left, right = u[:, :rank] * s[:rank], v[:rank]
    return left.reshape(num_in, sources, rank), right.reshape(rank, num_out, targets)
