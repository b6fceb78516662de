"""The definition of a temperature grid in float64: dense matrices over all cells and bodies, one environment at a time."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from tgdsl.layout.layout import Layout
from tgdsl.quantities.patches import ContactPatches, ReferenceObject, ReferencePatch, ReferencePatches
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceContext, ReferenceState
from tgdsl.sensors.temperature_grid.grids import counts
from tgdsl.sensors.temperature_grid.spec import FACES, Face, TemperatureGridSpec

SIGMA, KELVIN = 5.670374419e-8, 273.15


@dataclass
class Block:
    """A box of cells, or a body of one temperature (`count` None): temperatures above ambient, C order [K]."""

    above: np.ndarray
    capacity: float
    conductivity: float
    emissivity: float
    exposed: tuple[Face, ...]
    corner: np.ndarray
    size: np.ndarray
    count: tuple[int, int, int] | None
    name: str = ""
    area: float = 0.0
    volume: float = 0.0

    @property
    def step(self) -> np.ndarray:
        """Sides of a cell [m]."""
        return self.size / np.array(self.count)

    def operators(self, film: np.ndarray | None = None, is_smooth: bool = False) -> list[np.ndarray]:
        """Return −α∇² along each axis (cell, cell), with what exposed ends lose through a film by axis [W/(m²·K)], [1/s].

        Its modes decay as those of the cells, or as those of the continuous solid.
        """
        assert self.count is not None
        alpha, result = self.conductivity * self.step.prod() / self.capacity, []
        for axis, n in enumerate(self.count):
            matrix, rate = np.zeros((n, n)), alpha / self.step[axis] ** 2
            for i in range(n - 1):
                matrix[i : i + 2, i : i + 2] += rate * np.array([[1, -1], [-1, 1]])
            if film is not None:
                for end in self.ends(axis):
                    matrix[end, end] += film[axis] * self.step.prod() / self.step[axis] / self.capacity
            if is_smooth:
                values, basis = np.linalg.eigh(matrix)
                wave = np.pi * np.arange(n) / n
                matrix = basis * (values + rate * (wave**2 - 2 * (1 - np.cos(wave)))) @ basis.T
            result.append(matrix)
        return result

    def ends(self, axis: int) -> list[int]:
        """Return the first or the last cell along an axis, or both, as its faces are exposed."""
        return [0 if face[0] == "-" else -1 for face in self.exposed if face[1] == "xyz"[axis]]

    def resistance(self, axis: int) -> float:
        """Return that between what a cell holds and its face across an axis [m²·K/W]: the equation of `losses`."""
        assert self.count is not None
        return self.step[axis] / (2 * self.conductivity) * (1 - len(self.ends(axis)) / (3 * self.count[axis]))


def reference(
    spec: TemperatureGridSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the temperatures read [°C] (row, 1), and what is remembered."""
    result: ReferencePatches = gathered[ContactPatches]
    links, objects = (
        _links(spec, layout, result),
        [_object(spec, own, result.topology.cells[i], i in result.topology.grids) for i, own in enumerate(result.objects)],
    )
    before = {name: np.array(value, dtype=np.float64) for name, value in state.items()}
    _load(links, objects, result, before, spec, context)
    if not context.is_first:
        (_advance if spec.model == "physical" else _advance_as_printed)(spec, result, links, objects, context.dt)
    after = _store(links, objects, result, before)
    seen = after["cells"]
    if spec.lag is not None:
        ratio = context.dt / spec.lag
        kept = np.exp(-ratio)
        lagged = seen + (before["measured"] - before["cells"]) * kept - (seen - before["cells"]) * (1 - kept) / ratio
        lagged = lagged if spec.model == "physical" else before["measured"] + ratio * (seen - before["measured"])
        seen = after["measured"] = seen.copy() if context.is_first else lagged
    return _output(spec, seen, counts(spec, result.boxes)) + spec.ambient, after


def _links(spec: TemperatureGridSpec, layout: Layout, found: ReferencePatches) -> list[Block]:
    links = []
    for link, box, count in zip(layout.links, found.boxes, counts(spec, found.boxes), strict=True):
        made_of, size, shape = spec.material_of(link.name), box[1] - box[0], tuple(count.tolist())
        step = size / count
        emissivity = (
            0.0 if spec.emissivity is None else made_of.emissivity if spec.emissivity == "material" else spec.emissivity
        )
        heat = made_of.density * made_of.specific_heat * step.prod()
        links.append(
            Block(np.zeros(shape), heat, made_of.conductivity, emissivity, spec.exposed, box[0], size, shape, link.name)
        )
    return links


def _object(spec: TemperatureGridSpec, own: ReferenceObject, cells: tuple[int, int, int], is_grid: bool) -> Block:
    emissivity = 0.0 if spec.emissivity is None else own.emissivity
    if not is_grid:
        heat = own.volumetric_heat * own.volume
        shape = own.corner, own.size, None
        return Block(np.zeros(1), heat, own.conductivity, emissivity, (), *shape, area=own.area, volume=own.volume)
    heat = own.volumetric_heat * (own.size / np.array(cells)).prod()
    return Block(np.zeros(cells), heat, own.conductivity, emissivity, FACES, own.corner, own.size, cells)


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
    films = [_film(spec, block) for block in links]
    for block, film in zip(links, films, strict=True):
        _lose(spec, block, dt, film)
        block.above = _diffused(spec, block, dt, film, source=_source(spec, block) / block.capacity)
    for block in (block for i, block in enumerate(objects) if found.topology.links[i] < 0):
        _lose(spec, block, dt, np.zeros(3))
        block.above = block.above if block.count is None else _diffused(spec, block, dt)


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
        block.above = block.above - dt * flux / heat * (_outer(block.count, np.ones(3), spec.exposed) > 0)  # type: ignore[arg-type]


def _coefficient(spec: TemperatureGridSpec, block: Block, above: np.ndarray | float) -> np.ndarray | float:
    hot, around = np.asarray(above) + spec.ambient + KELVIN, spec.ambient + KELVIN
    return (spec.convection or 0.0) + block.emissivity * SIGMA * (hot + around) * (hot**2 + around**2)


def _film(spec: TemperatureGridSpec, block: Block) -> np.ndarray:
    """Return u₀ by axis [W/(m²·K)]: what surfaces near ambient lose to it."""
    total = float(_coefficient(spec, block, 0.0))
    return np.array([total / (1 + total * block.resistance(axis)) for axis in range(3)])


def _lose(spec: TemperatureGridSpec, block: Block, dt: float, film: np.ndarray) -> None:
    """Take off what is lost beyond a film by axis."""
    if block.count is None:
        width = block.volume ** (1 / 3) if np.isfinite(block.volume) else 1.0
        faces = [(np.array([block.area]), width / (6 * block.conductivity), 0.0)]
    else:
        across = [tuple(face for face in block.exposed if face[1] == axis) for axis in "xyz"]
        faces = [(_outer(block.count, block.step, own), block.resistance(axis), film[axis]) for axis, own in enumerate(across)]
    start = _coefficient(spec, block, block.above)
    rate = sum(area * start / (1 + start * resistance) for area, resistance, _ in faces) / block.capacity
    middle = block.above * np.exp(-0.5 * rate * dt)
    rate = np.zeros_like(block.above)
    for area, resistance, linear in faces:
        own = _coefficient(spec, block, middle / (1 + start * resistance))
        rate = rate + area * (own / (1 + own * resistance) - linear) / block.capacity
    block.above = block.above * np.exp(-rate * dt)


def _source(spec: TemperatureGridSpec, block: Block) -> np.ndarray:
    """Return the heat that is made in each cell [W]."""
    if spec.source is None:
        return np.zeros(block.count)  # type: ignore[arg-type]
    if spec.source.face is not None:
        return (spec.source.flux or 0.0) * _outer(block.count, block.step, (spec.source.face,))  # type: ignore[arg-type]
    return np.full(block.count, (spec.source.power or 0.0) / block.above.size)  # type: ignore[arg-type]


def _diffused(
    spec: TemperatureGridSpec,
    block: Block,
    dt: float,
    film: np.ndarray | None = None,
    source: np.ndarray | float = 0.0,
    least: float = 0.0,
) -> np.ndarray:
    """Return temperatures after conduction within a box, linear losses and a constant source [K/s]."""
    axes, size = block.operators(film, spec.scheme != "exact"), block.above.size
    made = source * np.ones(block.count)  # type: ignore[arg-type]
    if spec.scheme == "exact":
        from scipy.linalg import expm

        x, y, z = axes
        one = [np.eye(n) for n in block.count or ()]
        whole = np.kron(np.kron(x, one[1]), one[2]) + np.kron(np.kron(one[0], y), one[2]) + np.kron(np.kron(one[0], one[1]), z)
        # With a last row that is 0 and a last number that stays 1 the exponential takes the source along.
        matrix = np.zeros((size + 1, size + 1))
        matrix[:size, :size], matrix[:size, size] = -whole, made.ravel()
        return (expm(dt * matrix) @ np.append(block.above, 1.0))[:size].reshape(block.count)
    alpha = block.conductivity * block.step.prod() / block.capacity
    bases, decay = [], np.zeros(block.count)  # type: ignore[arg-type]
    modes, made_of = block.above, made
    for axis, matrix in enumerate(axes):
        values, basis = np.linalg.eigh(matrix)
        bases.append(basis)
        modes, made_of = (np.moveaxis(np.tensordot(basis.T, part, (1, axis)), 0, axis) for part in (modes, made_of))
        shape = [1, 1, 1]
        shape[axis] = -1
        decay = decay + values.reshape(shape)
    decay = np.maximum(decay, alpha * least) * dt
    if spec.scheme == "spectral":
        safe = np.where(decay > 1e-9, decay, 1.0)
        modes = modes * np.exp(-decay) + dt * made_of * np.where(decay > 1e-9, -np.expm1(-safe) / safe, 1.0 - 0.5 * decay)
    else:
        modes = (modes + dt * made_of) / (1 + decay)
    for axis, basis in enumerate(bases):
        modes = np.moveaxis(np.tensordot(basis, modes, (1, axis)), 0, axis)
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
    sides_of: dict[int, list[np.ndarray]] = {}
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
            sides_of.setdefault(block, []).append(own)
    shown = np.ones(size)
    for block, own_sides in sides_of.items():
        film = _film(spec, blocks[block]) if block < len(links) else None
        at = slice(int(starts[block]), int(starts[block]) + blocks[block].above.size)
        shown[at] = _response(spec, blocks[block], dt, film, own_sides)
    heat = heat / shown
    is_held = ~np.isfinite(heat)
    matrix = np.diag(np.where(is_held, 1.0, heat) + dt * flow.sum(axis=1)) - dt * flow
    right = np.where(is_held, 1.0, heat) * above
    for i in np.flatnonzero(is_held):
        matrix[i], right[i] = np.eye(size)[i], above[i]
    idle = np.flatnonzero((heat == 0) & (flow.sum(axis=1) == 0))
    matrix[idle, idle] = 1.0
    after = above + (np.linalg.solve(matrix, right) - above) / shown
    for block, start in zip(blocks, starts, strict=False):
        block.above = after[start : start + block.above.size].reshape(block.above.shape)


def _response(
    spec: TemperatureGridSpec,
    block: Block,
    dt: float,
    film: np.ndarray | None,
    sides: list[np.ndarray],
) -> np.ndarray:
    """Return κ of each cell: the equation of `response`, sides being conductances."""
    every = np.sum([own * own.sum() / (own @ own) for own in sides], axis=0)
    assert block.count is not None
    at_end = _diffused(spec, _like(block, every), dt, film).ravel()
    evenly = _diffused(spec, _like(block, np.zeros(block.above.size)), dt, film, source=every.reshape(block.count) / dt).ravel()
    falling = np.zeros(block.count)
    if spec.scheme != "semi_implicit":
        for axis, matrix in enumerate(block.operators(film, spec.scheme == "spectral")):
            falling += dt * np.moveaxis(np.tensordot(matrix, at_end.reshape(block.count), (1, axis)), 0, axis)
    whole, kept, average = (np.zeros(block.above.size) for _ in range(3))
    for own in sides:
        left, on_average = (own @ part / (own @ every) for part in (at_end, evenly - 0.5 * at_end - falling.ravel() / 12))
        whole, kept, average = whole + own, kept + own * left, average + own * on_average
    safe = np.where(whole > 0, whole, 1.0)
    return np.where(whole > 0, np.maximum(average / safe, kept / safe - block.capacity / (dt * safe)), 1.0)


def _like(block: Block, above: np.ndarray) -> Block:
    """Return a block at other temperatures."""
    return replace(block, above=above.reshape(block.above.shape))


def _area(
    spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], b: int, o: int, patch: ReferencePatch
) -> float:
    if spec.contact_area != "manifold":
        return spec.contact_area
    made_of = spec.material_of(links[b].name)
    own = 0.0 if made_of.youngs_modulus is None else (1 - (made_of.poissons_ratio or 0.0) ** 2) / made_of.youngs_modulus
    radius = spec.curvature_radius or 0.5 * float(links[b].size.min())
    compliance, curvature = own + found.objects[o].compliance, 1 / radius + found.objects[o].curvature
    if spec.model == "paper":
        return max(patch.area, np.pi * curvature * (0.75 * patch.force * compliance / curvature) ** (2 / 3))
    return max(patch.area, np.pi * (0.75 * patch.force * compliance / curvature) ** (2 / 3))


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
