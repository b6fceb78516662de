"""The definition of a temperature grid in float64: dense matrices over all cells and bodies, one environment at a time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from tgdsl.layout.layout import Layout
from tgdsl.quantities.patches import ContactPatches
from tgdsl.quantities.patches.reference import Patch, ReferenceObject, ReferencePatches
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceContext, ReferenceState
from tgdsl.sensors.temperature_grid.grids import counts
from tgdsl.sensors.temperature_grid.spec import FACES, TemperatureGridSpec

SIGMA, KELVIN = 5.670374419e-8, 273.15


@dataclass
class Block:
    """A box of cells, or a body of one temperature (`count` None): temperatures above ambient, C order [K]."""

    above: np.ndarray
    capacity: float
    conductivity: float
    emissivity: float
    outer: np.ndarray
    corner: np.ndarray
    size: np.ndarray
    count: tuple[int, int, int] | None
    name: str = ""

    @property
    def step(self) -> np.ndarray:
        """Sides of a cell [m]."""
        return self.size / np.array(self.count)

    def laplacian(self) -> np.ndarray:
        """Return α∇² of the cells with insulated walls (cell, cell) [1/s]."""
        assert self.count is not None
        alpha, number = self.conductivity * self.step.prod() / self.capacity, np.arange(self.above.size).reshape(self.count)
        matrix = np.zeros((self.above.size,) * 2)
        for axis in range(3):
            first, second = (
                np.take(number, range(*ends), axis=axis).ravel() for ends in ((self.count[axis] - 1,), (1, self.count[axis]))
            )
            for i, j in zip(first, second, strict=True):
                rate = alpha / self.step[axis] ** 2
                matrix[[i, i, j, j], [i, j, i, j]] += rate * np.array([-1, 1, 1, -1])
        return matrix


def reference(
    spec: TemperatureGridSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the temperatures read [°C] (row, 1), and what is remembered."""
    found: ReferencePatches = gathered[ContactPatches]
    links, objects = (
        _links(spec, layout, found),
        [_object(spec, own, found.topology.cells[i], i in found.topology.grids) for i, own in enumerate(found.objects)],
    )
    before = {name: np.array(value, dtype=np.float64) for name, value in state.items()}
    _load(links, objects, found, before, spec, context)
    if not context.is_first:
        (_advance if spec.model == "physical" else _advance_as_printed)(spec, found, links, objects, context.dt)
    after = _store(links, objects, found, before)
    seen = after["cells"]
    if spec.lag is not None:
        ratio = context.dt / spec.lag
        kept = np.exp(-ratio)
        lagged = seen + (before["measured"] - before["cells"]) * kept - (seen - before["cells"]) * (1 - kept) / ratio
        lagged = lagged if spec.model == "physical" else before["measured"] + ratio * (seen - before["measured"])
        seen = after["measured"] = seen.copy() if context.is_first else lagged
    return _output(spec, seen, counts(spec, found.boxes)) + spec.ambient, after


def _links(spec: TemperatureGridSpec, layout: Layout, found: ReferencePatches) -> list[Block]:
    links = []
    for link, box, count in zip(layout.links, found.boxes, counts(spec, found.boxes), strict=True):
        made_of, size, shape = spec.material_of(link.name), box[1] - box[0], tuple(count.tolist())
        step = size / count
        emissivity = (
            0.0 if spec.emissivity is None else made_of.emissivity if spec.emissivity == "material" else spec.emissivity
        )
        heat = made_of.density * made_of.specific_heat * step.prod()
        outer = _outer(shape, step, spec.exposed)
        links.append(Block(np.zeros(shape), heat, made_of.conductivity, emissivity, outer, box[0], size, shape, link.name))
    return links


def _object(spec: TemperatureGridSpec, own: ReferenceObject, cells: tuple[int, int, int], is_grid: bool) -> Block:
    emissivity = 0.0 if spec.emissivity is None else own.emissivity
    if not is_grid:
        heat = own.volumetric_heat * own.volume
        return Block(np.zeros(1), heat, own.conductivity, emissivity, np.array([own.area]), own.corner, own.size, None)
    step = own.size / np.array(cells)
    outer = _outer(cells, step, FACES)
    return Block(
        np.zeros(cells), own.volumetric_heat * step.prod(), own.conductivity, emissivity, outer, own.corner, own.size, cells
    )


def _outer(count: tuple[int, ...], step: np.ndarray, faces: tuple[str, ...]) -> np.ndarray:
    area = np.zeros(count)
    for face in faces:
        axis = "xyz".index(face[1])
        place = [slice(None)] * 3
        place[axis] = 0 if face[0] == "-" else -1  # type: ignore[call-overload]
        area[tuple(place)] += step.prod() / step[axis]
    return area


def _load(links, objects, found, before, spec, context) -> None:  # type: ignore[no-untyped-def]
    """Put what was remembered, or the start, into the blocks."""
    for i, block in enumerate(links):
        x, y, z = block.count
        block.above = (
            np.full(block.count, spec.start - spec.ambient) if context.is_first else before["cells"][i, :x, :y, :z].copy()
        )
    most = tuple(max(own[axis] for own in found.topology.cells) for axis in range(3)) if objects else ()
    for i, block in enumerate(objects):
        x, y, z = found.topology.cells[i]
        own = found.objects[i].start
        if context.is_first:
            block.above = np.full(block.above.shape, 0.0 if own is None else own - spec.ambient)
        else:
            block.above = before["objects"].reshape(-1, *most)[i, :x, :y, :z].reshape(block.above.shape).copy()


def _store(links, objects, found, before) -> dict[str, np.ndarray]:  # type: ignore[no-untyped-def]
    after = {name: np.zeros_like(value) for name, value in before.items()}
    for i, block in enumerate(links):
        x, y, z = block.count
        after["cells"][i, :x, :y, :z] = block.above
    if objects:
        most = tuple(max(own[axis] for own in found.topology.cells) for axis in range(3))
        shaped = np.zeros((len(objects), *most))
        for i, block in enumerate(objects):
            x, y, z = found.topology.cells[i]
            if found.topology.links[i] < 0:
                shaped[i, :x, :y, :z] = block.above.reshape(x, y, z)
        after["objects"] = shaped.ravel()
    return after


def _advance(spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float) -> None:
    _touch(spec, found, links, objects, dt)
    own = [block for i, block in enumerate(objects) if found.topology.links[i] < 0]
    for block in [*links, *own]:
        _lose(spec, block, dt)
    for block in links:
        made = _source(spec, block) * dt / block.capacity
        block.above = block.above + 0.5 * made
        block.above = _diffused(spec, block, dt) + 0.5 * made
    for block in (block for block in own if block.count is not None):
        block.above = _diffused(spec, block, dt)


def _advance_as_printed(
    spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float
) -> None:
    """Take a step by the paper's formulas; objects that are links of the sensor have their mean temperature before it."""
    others = [links[own].above.mean() if own >= 0 else objects[i].above.flat[0] for i, own in enumerate(found.topology.links)]
    for b, block in enumerate(links):
        heat = block.capacity / block.step.prod()
        block.above = _diffused(spec.model_copy(update={"scheme": "semi_implicit"}), block, dt, least=1e-6)
        if spec.source is not None and spec.source.flux is not None and spec.source.face is not None:
            block.above = block.above + dt * spec.source.flux / (block.step["xyz".index(spec.source.face[1])] * heat)
        gains = np.zeros_like(block.above)
        for o, other in enumerate(others):
            if (b, o) in found.patches:
                patch, own = found.patches[b, o], found.objects[o]
                place = np.clip(np.floor((patch.pos - block.corner) / block.step), 0, np.array(block.count) - 1).astype(int)
                k = 2 * block.conductivity * own.conductivity / (block.conductivity + own.conductivity)
                area = _area(spec, found, links, b, o, patch)
                at = tuple(place)
                gains[at] += dt * k * (other - block.above[at]) * area**2 / (block.step.prod() ** 2 * heat)
        block.above = block.above + gains
        hot, around = block.above + spec.ambient + KELVIN, spec.ambient + KELVIN
        flux = block.emissivity * SIGMA * (hot**4 - around**4) + (spec.convection or 0.0) * block.above
        block.above = block.above - dt * flux / heat * (block.outer > 0)


def _lose(spec: TemperatureGridSpec, block: Block, dt: float) -> None:
    def coefficient(above: np.ndarray) -> np.ndarray:
        hot, around = above + spec.ambient + KELVIN, spec.ambient + KELVIN
        return (spec.convection or 0.0) + block.emissivity * SIGMA * (hot + around) * (hot**2 + around**2)

    rate = block.outer.reshape(block.above.shape) * dt / block.capacity
    middle = block.above * np.exp(-0.5 * rate * coefficient(block.above))
    block.above = block.above * np.exp(-rate * coefficient(middle))


def _source(spec: TemperatureGridSpec, block: Block) -> np.ndarray:
    """Return the heat that is made in each cell [W]."""
    if spec.source is None:
        return np.zeros(block.count)  # type: ignore[arg-type]
    if spec.source.face is not None:
        return (spec.source.flux or 0.0) * _outer(block.count, block.step, (spec.source.face,))  # type: ignore[arg-type]
    return np.full(block.count, (spec.source.power or 0.0) / block.above.size)  # type: ignore[arg-type]


def _diffused(spec: TemperatureGridSpec, block: Block, dt: float, least: float = 0.0) -> np.ndarray:
    """Return temperatures after conduction within a box."""
    if spec.scheme == "exact":
        return (expm(dt * block.laplacian()) @ block.above.ravel()).reshape(block.count)
    alpha = block.conductivity * block.step.prod() / block.capacity
    modes, squared = block.above, np.zeros(block.count)  # type: ignore[arg-type]
    bases = []
    for axis, n in enumerate(block.count or ()):
        m, i = np.arange(n)[:, None], np.arange(n)[None, :]
        basis = np.cos(np.pi * m * (i + 0.5) / n)
        bases.append(basis / np.linalg.norm(basis, axis=1, keepdims=True))
        modes = np.moveaxis(np.tensordot(bases[-1], modes, axes=(1, axis)), 0, axis)
        shape = [1, 1, 1]
        shape[axis] = n
        squared = squared + (np.pi * np.arange(n) / block.size[axis]).reshape(shape) ** 2
    squared = np.maximum(squared, least)
    modes = modes * (np.exp(-alpha * dt * squared) if spec.scheme == "spectral" else 1 / (1 + alpha * dt * squared))
    for axis, basis in enumerate(bases):
        modes = np.moveaxis(np.tensordot(basis.T, modes, axes=(1, axis)), 0, axis)
    return modes


def _touch(spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float) -> None:
    """Solve the implicit step of all that touches as one dense system: cells, bodies and interfaces."""
    where, blocks = found.topology, list(links)
    blocks += [objects[i] for i in (*where.grids, *where.lumped)]
    starts = np.cumsum([0, *(block.above.size for block in blocks)])
    lumped = {i: len(links) + len(where.grids) + n for n, i in enumerate(where.lumped)}
    gridded = {i: len(links) + n for n, i in enumerate(where.grids)} | {i: own for i, own in enumerate(where.links) if own >= 0}
    size = int(starts[-1]) + len(where.interfaces)
    heat, flow = np.zeros(size), np.zeros((size, size))
    above = np.zeros(size)
    for block, start in zip(blocks, starts, strict=False):
        heat[start : start + block.above.size] = block.capacity
        above[start : start + block.above.size] = block.above.ravel()
    for (b, o), patch in found.patches.items():
        area = _area(spec, found, links, b, o, patch)
        film = 0.0 if spec.contact_conductance is None else 1.0 / (spec.contact_conductance * area) if area > 0 else 0.0
        if area <= 0:
            continue
        sides = [(b, _conductances(links[b], area, patch.pos, patch.normal))]
        if o in lumped:
            node = int(starts[lumped[o]])
            series = film + _inside(objects[o], found.objects[o], area)
        else:
            node = int(starts[-1]) + where.interfaces.index((b, o))
            sides.append((gridded[o], _conductances(blocks[gridded[o]], area, patch.object_pos, patch.object_normal)))
            series = 0.5 * film
        for block, own in sides:
            own = own / (1.0 + own.sum() * series)
            at = slice(int(starts[block]), int(starts[block]) + own.size)
            flow[at, node] += own
            flow[node, at] += own
    is_held = ~np.isfinite(heat)
    matrix = np.diag(np.where(is_held, 1.0, heat) + dt * flow.sum(axis=1)) - dt * flow
    right = np.where(is_held, 1.0, heat) * above
    for i in np.flatnonzero(is_held):
        matrix[i], right[i] = np.eye(size)[i], above[i]
    idle = np.flatnonzero((heat == 0) & (flow.sum(axis=1) == 0))
    matrix[idle, idle] = 1.0
    after = np.linalg.solve(matrix, right)
    for block, start in zip(blocks, starts, strict=False):
        block.above = after[start : start + block.above.size].reshape(block.above.shape)


def _area(spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], b: int, o: int, patch: Patch) -> float:
    if spec.contact_area != "manifold":
        return spec.contact_area
    made_of = spec.material_of(links[b].name)
    own = 0.0 if made_of.youngs_modulus is None else (1 - (made_of.poissons_ratio or 0.0) ** 2) / made_of.youngs_modulus
    radius = spec.curvature_radius or 0.5 * float(links[b].size.min())
    compliance, curvature = own + found.objects[o].compliance, 1 / radius + found.objects[o].curvature
    if spec.model == "paper":
        return max(patch.polygon, np.pi * curvature * (0.75 * patch.force * compliance / curvature) ** (2 / 3))
    return max(patch.polygon, np.pi * (0.75 * patch.force * compliance / curvature) ** (2 / 3))


def _inside(block: Block, own: ReferenceObject, area: float) -> float:
    width, radius = own.volume ** (1 / 3), np.sqrt(area / np.pi)
    spot = 4 * radius * max(0.0, 1 - np.sqrt(area) / width) / (1 + 0.5 * radius / width)
    return 1 / (own.conductivity * (2 * area / width + spot))


def _conductances(block: Block, area: float, pos: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the conductance between a patch and each cell of a box, in C order [W/K]: the equation of `shares`."""
    assert block.count is not None
    half = 0.5 * np.sqrt(area) * np.sqrt(np.maximum(0.0, 1 - normal**2)) / block.step
    axes = [_axis((pos[a] - block.corner[a]) / block.step[a], half[a], block.count[a]) for a in range(3)]
    fit = area * np.prod([within for *_, within in axes])
    depth = float(normal**2 @ block.step)
    radius = np.sqrt(fit / np.pi)
    rho = radius / np.sqrt(block.step.prod() / depth)
    few = np.prod([1 - (1 - n**2) * (1 - np.sum(shares**2)) for n, (shares, _, _) in zip(normal, axes, strict=True)])
    k = block.conductivity
    spot = 4 * k * radius / (1 + rho / 2) * (1 + 0.75 * rho * (2 * few - 1) * max(0.0, 1 - 2 * rho))
    (x, ex, _), (y, ey, _), (z, ez, _) = axes
    tx, ty, tz = 0.5 * (1 - normal**2)
    outer = lambda a, b, c: np.einsum("i,j,k->ijk", a, b, c).ravel()  # noqa: E731
    edges = tx * outer(ex, y, z) + ty * outer(x, ey, z) + tz * outer(x, y, ez)
    return 2 * k * fit / depth * outer(x, y, z) + spot * edges


def _axis(centre: float, half: float, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return shares of cells, shares of the edges, and the part of a patch that fits, along one axis in cells."""
    fits = min(half, 0.5 * count)
    within = 1.0 if half <= 0 else fits / half
    place = np.arange(count) + 0.5

    def weight(at: float) -> np.ndarray:
        at = min(max(at, place[0]), place[-1])
        return np.maximum(0.0, 1 - np.abs(at - place))

    def integral(low: float, high: float) -> np.ndarray:
        ends = np.unique([low, high, *(p for p in place if low < p < high)])
        parts = [(b - a) * 0.5 * (weight(a) + weight(b)) for a, b in itertools.pairwise(ends)]
        return np.sum(parts, axis=0)

    centre = min(max(centre, fits), count - fits)
    width = min(max(fits, 0.05), 0.5 * count)
    middle = min(max(centre, width), count - width)
    low, high = centre - fits, centre + fits
    ends = [min(1.0, max(0.0, 2 * gap)) for gap in (low, count - high)]
    return (
        integral(middle - width, middle + width) / (2 * width),
        0.5 * (ends[0] * weight(low) + ends[1] * weight(high)),
        within,
    )


def _output(spec: TemperatureGridSpec, seen: np.ndarray, count: np.ndarray) -> np.ndarray:
    own = [above[:x, :y, :z] for above, (x, y, z) in zip(seen, count.tolist(), strict=True)]
    if spec.outputs in ("max", "mean"):
        return np.array([[getattr(np, spec.outputs)(above)] for above in own])
    if spec.outputs == "surface":
        own = [above[_outer(above.shape, np.ones(3), FACES) > 0] for above in own]
    return np.concatenate([above.ravel() for above in own])[:, None]
