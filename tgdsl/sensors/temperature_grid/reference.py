"""The definition of a temperature grid in float64: dense matrices over all cells and bodies, one environment at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from math import factorial
from typing import Any

import numpy as np

from tgdsl.layout.layout import Layout
from tgdsl.quantities.patches import ContactPatches, ReferenceObject, ReferencePatch, ReferencePatches
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceContext, ReferenceState
from tgdsl.sensors.temperature_grid.spec import FACES, Face, TemperatureGridSpec, counts

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

        Its modes decay like the cells' modes, or with `is_smooth` like the continuous solid's.
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
        """Return the resistance between a cell and its face across an axis [m²·K/W]: the equation of `losses`."""
        assert self.count is not None
        return self.step[axis] / (2 * self.conductivity) * (1 - len(self.ends(axis)) / (3 * self.count[axis]))


def reference(
    spec: TemperatureGridSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the reading [°C] (row, 1), and the next state."""
    result: ReferencePatches = gathered[ContactPatches]
    links, objects = (
        _links(spec, layout, result),
        [_object(spec, body, result.topology.cells[i], i in result.topology.grids) for i, body in enumerate(result.objects)],
    )
    previous = {name: np.array(value, dtype=np.float64) for name, value in state.items()}
    _load(links, objects, result, previous, spec, context)
    if not context.is_first:
        (_advance if spec.model == "physical" else _advance_as_printed)(spec, result, links, objects, context.dt)
    after = _store(links, objects, result, previous)
    seen = after["cells"]
    if spec.lag is not None:
        ratio = context.dt / spec.lag
        decay = np.exp(-ratio)
        lagged = seen + (previous["measured"] - previous["cells"]) * decay - (seen - previous["cells"]) * (1 - decay) / ratio
        lagged = lagged if spec.model == "physical" else previous["measured"] + ratio * (seen - previous["measured"])
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
    """Set the blocks' temperatures from the state, or at the first call from the start."""
    for i, block in enumerate(links):
        x, y, z = block.count
        block.above = (
            np.full(block.count, spec.start - spec.ambient) if context.is_first else before["cells"][i, :x, :y, :z].copy()
        )
    most = tuple(max(count[axis] for count in found.topology.cells) for axis in range(3)) if objects else ()
    for i, block in enumerate(objects):
        x, y, z = found.topology.cells[i]
        start = found.objects[i].start
        if context.is_first:
            block.above = np.full(block.above.shape, 0.0 if start is None else start - spec.ambient)
        else:
            block.above = before["objects"].reshape(-1, *most)[i, :x, :y, :z].reshape(block.above.shape).copy()


def _store(links, objects, found, before) -> dict[str, np.ndarray]:  # type: ignore[no-untyped-def]
    after = {name: np.zeros_like(value) for name, value in before.items()}
    for i, block in enumerate(links):
        x, y, z = block.count
        after["cells"][i, :x, :y, :z] = block.above
    if objects:
        most = tuple(max(count[axis] for count in found.topology.cells) for axis in range(3))
        shaped = np.zeros((len(objects), *most))
        for i, block in enumerate(objects):
            x, y, z = found.topology.cells[i]
            if found.topology.links[i] < 0:
                shaped[i, :x, :y, :z] = block.above.reshape(x, y, z)
        after["objects"] = shaped.ravel()
    return after


def _advance(spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float) -> None:
    grids, films = [objects[i] for i in found.topology.grids], [_film(spec, block) for block in links]
    films += [np.zeros(3)] * len(grids)
    for block, film in zip([*links, *grids], films, strict=True):
        _lose(spec, block, dt, film)
    for i in found.topology.lumped:
        _lose(spec, objects[i], dt, np.zeros(3))
    touched = _touch(spec, found, links, objects, dt)
    for n, (block, film, (heat, rate, sigma)) in enumerate(zip([*links, *grids], films, touched, strict=True)):
        source = _source(spec, block) / block.capacity if n < len(links) else 0.0
        after = _diffused(spec, block, dt, film, source)
        if heat.any():
            power = _operator(spec, block, dt, film)
            _, _, of_heat, of_rate = _responses([power(k) for k in range(4)], sigma)
            after = after + (of_heat @ heat + of_rate @ rate).reshape(after.shape)
        block.above = after


def _advance_as_printed(
    spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float
) -> None:
    """Take a step by the paper's formulas; objects that are links of the sensor have their mean temperature before it."""
    bodies = found.topology.links
    temperatures = [links[b].above.mean() if b >= 0 else objects[i].above.flat[0] for i, b in enumerate(bodies)]
    for b, block in enumerate(links):
        heat = block.capacity / block.step.prod()
        block.above = _diffused(spec.model_copy(update={"scheme": "semi_implicit"}), block, dt, least=1e-6)
        if spec.source is not None and spec.source.flux is not None and spec.source.face is not None:
            block.above = block.above + dt * spec.source.flux / (block.step["xyz".index(spec.source.face[1])] * heat)
        gains = np.zeros_like(block.above)
        for o, other in enumerate(temperatures):
            if (b, o) in found.patches:
                patch, material = found.patches[b, o], found.objects[o]
                place = np.clip(np.floor((patch.pos - block.corner) / block.step), 0, np.array(block.count) - 1).astype(int)
                k = 2 * block.conductivity * material.conductivity / (block.conductivity + material.conductivity)
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
    total = float(_coefficient(spec, block, 0.0))
    return np.array([total / (1 + total * block.resistance(axis)) for axis in range(3)])


def _lose(spec: TemperatureGridSpec, block: Block, dt: float, film: np.ndarray) -> None:
    """Subtract the losses beyond a film by axis."""
    if block.count is None:
        width = block.volume ** (1 / 3) if np.isfinite(block.volume) else 1.0
        faces = [(np.array([block.area]), width / (6 * block.conductivity), 0.0)]
    else:
        across = [tuple(face for face in block.exposed if face[1] == axis) for axis in "xyz"]
        faces = [(_outer(block.count, block.step, end), block.resistance(axis), film[axis]) for axis, end in enumerate(across)]
    start = _coefficient(spec, block, block.above)
    rate = sum(area * start / (1 + start * resistance) for area, resistance, _ in faces) / block.capacity
    middle = block.above * np.exp(-0.5 * rate * dt)
    rate = np.zeros_like(block.above)
    for area, resistance, linear in faces:
        coefficient = _coefficient(spec, block, middle / (1 + start * resistance))
        rate = rate + area * (coefficient / (1 + coefficient * resistance) - linear) / block.capacity
    block.above = block.above * np.exp(-rate * dt)


def _source(spec: TemperatureGridSpec, block: Block) -> np.ndarray:
    """Return the heat source of each cell [W]."""
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
    generated = source * np.ones(block.count)  # type: ignore[arg-type]
    if spec.scheme == "exact":
        from scipy.linalg import expm

        x, y, z = axes
        one = [np.eye(n) for n in block.count or ()]
        whole = np.kron(np.kron(x, one[1]), one[2]) + np.kron(np.kron(one[0], y), one[2]) + np.kron(np.kron(one[0], one[1]), z)
        # With a last row that is 0 and a last number that stays 1 the exponential takes the source along.
        matrix = np.zeros((size + 1, size + 1))
        matrix[:size, :size], matrix[:size, size] = -whole, generated.ravel()
        return (expm(dt * matrix) @ np.append(block.above, 1.0))[:size].reshape(block.count)
    alpha = block.conductivity * block.step.prod() / block.capacity
    bases, decay = [], np.zeros(block.count)  # type: ignore[arg-type]
    modes, made_of = block.above, generated
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


def _touch(
    spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], objects: list[Block], dt: float
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Return H and J of the cells of each block of cells [K], and σ: one dense system of all cells, bodies and interfaces."""
    where, blocks = found.topology, list(links)
    blocks += [objects[i] for i in where.grids]
    bodies = [objects[i] for i in where.lumped]
    gridded = {i: len(links) + n for n, i in enumerate(where.grids)}
    gridded |= {i: link for i, link in enumerate(where.links) if link >= 0}
    sides: list[tuple[int, int, np.ndarray]] = []
    for (b, o), patch in found.patches.items():
        area = _area(spec, found, links, b, o, patch)
        if area <= 0:
            continue
        film = 0.0 if spec.contact_conductance is None else 1.0 / (spec.contact_conductance * area)
        conductances = _conductances(links[b], area, patch.pos, patch.normal)
        if o in where.lumped:
            series = film + _inside(found.objects[o], area)
            sides.append((b, where.lumped.index(o), conductances / (1.0 + conductances.sum() * series)))
            continue
        node, other = len(bodies) + where.interfaces.index((b, o)), gridded[o]
        sides.append((b, node, conductances / (1.0 + conductances.sum() * 0.5 * film)))
        conductances = _conductances(blocks[other], area, patch.object_pos, patch.object_normal)
        sides.append((other, node, conductances / (1.0 + conductances.sum() * 0.5 * film)))
    # Unknown are H and J of each side and cell that it touches, then temperatures of interfaces, in the mean and at the end.
    row, node, side, cell, flow = (
        np.concatenate([np.array(part) for part in parts]) if sides else np.zeros(0, dtype=int)
        for parts in zip(
            *(
                (np.full(at.size, r), np.full(at.size, n), np.full(at.size, s), at, dt * conductances[at])
                for s, (r, n, conductances) in enumerate(sides)
                for at in [np.flatnonzero(conductances > 0)]
            ),
            strict=True,
        )
    ) if sides else (np.zeros(0, dtype=int),) * 5  # fmt: skip
    inverse = np.array([1.0 / body.capacity for body in bodies] + [0.0] * len(where.interfaces))
    nodes = np.array([float(body.above.flat[0]) for body in bodies] + [0.0] * len(where.interfaces))
    num, faces = len(row), [n for n in range(len(bodies), len(nodes)) if (node == n).any()]
    free, sigma = np.zeros((2, num)), np.zeros(len(blocks))
    shows = np.zeros((4, num, num))
    share = flow / np.array([flow[side == s].sum() for s in side]) if num else flow
    of_node = np.array([flow[node == n].sum() for n in range(len(nodes))])
    for r, block in enumerate(blocks):
        at = row == r
        film = _film(spec, block) if r < len(links) else None
        power = _operator(spec, block, dt, film)
        phi = [power(k) for k in range(4)]
        generated = dt * _source(spec, block).ravel() / block.capacity if r < len(links) else np.zeros(block.above.size)
        for k, ends in enumerate(((1, 2), (0, 1))):
            free[k, at] = (phi[ends[0]] @ block.above.ravel() + phi[ends[1]] @ generated)[cell[at]]
        if not at.any():
            continue
        mine = [part[np.ix_(cell[at], cell[at])] for part in phi]
        weight = flow[at] / flow[at].sum()
        start, constant = (
            weight @ part @ flow[at] / block.capacity + weight @ (inverse * of_node)[node[at]] for part in mine[:2]
        )
        sigma[r] = 0.0 if spec.scheme == "semi_implicit" else _impulsiveness(start, constant)
        for k, part in enumerate(_responses(mine, float(sigma[r]))):
            # Of others a cell shows what all of its side does in the mean.
            result = np.where(cell[at][:, None] == cell[at][None], part, 0.0)
            for s, t in itertools.product(set(side[at]), set(side[at])):
                block_of = np.ix_(side[at] == s, side[at] == t)
                rest = (part - result)[block_of]
                result[block_of] += share[at][side[at] == s] @ rest @ share[at][side[at] == t]
            shows[k][np.ix_(at, at)] = result / block.capacity
    size, i, j = 2 * num + 2 * len(faces), np.arange(num), num + np.arange(num)
    matrix, right = np.eye(size), np.zeros(size)
    lump = np.array([_responses([1.0, 1.0, 0.5, 1.0 / 6.0], float(sigma[r])) for r in row]).reshape(num, 4)
    is_same = (node[:, None] == node[None]) * inverse[node][:, None] if num else np.zeros((0, 0))
    for k, (at, to) in enumerate(itertools.product((i, j), (i, j))):
        matrix[np.ix_(at, to)] += flow[:, None] * (shows[k] + is_same * lump[None, :, k])
    right[i], right[j] = (flow * (nodes[node] - part) if num else part for part in free)
    for f, n in enumerate(faces):
        for at, place in ((i, 2 * num + f), (j, 2 * num + len(faces) + f)):
            matrix[at, place] = -flow * (node == n)
            matrix[place] = 0.0
            matrix[place, at] = node == n
    found_flows = np.linalg.solve(matrix, right)
    result = []
    for r, block in enumerate(blocks):
        heat, rate = np.zeros((2, block.above.size))
        np.add.at(heat, cell[row == r], found_flows[i][row == r] / block.capacity)
        np.add.at(rate, cell[row == r], found_flows[j][row == r] / block.capacity)
        result.append((heat, rate, sigma[r]))
    for n, body in enumerate(bodies):
        body.above = body.above - inverse[n] * found_flows[i][node == n].sum()
    return result


def _responses(phi: list[Any], sigma: float) -> list[Any]:
    of_heat = lambda a, b, c: ((1 - sigma) * a + 6 * sigma * (b - c)) / (1 + 2 * sigma)  # noqa: E731
    of_rate = lambda a, b, c: ((sigma - 1) * a + (1 - 4 * sigma) * b + 6 * sigma * c) / (1 + 2 * sigma)  # noqa: E731
    return [of_heat(*phi[1:]), of_rate(*phi[1:]), of_heat(*phi[:3]), of_rate(*phi[:3])]


def _impulsiveness(start: float, constant: float) -> float:
    """Return σ of an exponential flow with these moments: the equation of `response`."""
    z = start / (1 + constant - start) + 16 * (1 - start / constant) ** 2 * constant / (1 + constant)
    if z < 0.02:
        return 1 - z / 4 + z**2 / 40 - z**4 / 5600
    heat, left = -np.expm1(-z), np.exp(-z)
    last = 2 * (heat / z - left)
    return float((last - z * left) / (2 * (heat - last)))


def _operator(spec: TemperatureGridSpec, block: Block, dt: float, film: np.ndarray | None) -> Callable[[int], np.ndarray]:
    """Return φ_k of all of a box, by its number."""
    x, y, z = block.operators(film, spec.scheme != "exact")
    one = [np.eye(n) for n in block.count or ()]
    whole = np.kron(np.kron(x, one[1]), one[2]) + np.kron(np.kron(one[0], y), one[2]) + np.kron(np.kron(one[0], one[1]), z)
    values, basis = np.linalg.eigh(dt * whole)

    def power(order: int) -> np.ndarray:
        if spec.scheme == "semi_implicit":
            return basis / (1 + values) @ basis.T
        # φ_k is the mean of e^(−x (1 − t)) with the weight t^(k−1)/(k − 1)!
        t, weight = np.polynomial.legendre.leggauss(200)
        t, weight = 0.5 * (t + 1), 0.5 * weight
        of = (
            np.exp(-values)
            if order == 0
            else np.exp(-np.outer(values, 1 - t)) @ (weight * t ** (order - 1) / factorial(order - 1))
        )
        return basis * of @ basis.T

    return power


def _area(
    spec: TemperatureGridSpec, found: ReferencePatches, links: list[Block], b: int, o: int, patch: ReferencePatch
) -> float:
    if spec.contact_area != "manifold":
        return spec.contact_area
    made_of = spec.material_of(links[b].name)
    of_link = 0.0 if made_of.youngs_modulus is None else (1 - (made_of.poissons_ratio or 0.0) ** 2) / made_of.youngs_modulus
    radius = spec.curvature_radius or 0.5 * float(links[b].size.min())
    compliance, curvature = of_link + found.objects[o].compliance, 1 / radius + found.objects[o].curvature
    if spec.model == "paper":
        return max(patch.area, np.pi * curvature * (0.75 * patch.force * compliance / curvature) ** (2 / 3))
    return max(patch.area, np.pi * (0.75 * patch.force * compliance / curvature) ** (2 / 3))


def _inside(own: ReferenceObject, area: float) -> float:
    width, radius = own.volume ** (1 / 3), np.sqrt(area / np.pi)
    spot = 4 * radius * max(0.0, 1 - np.sqrt(area) / width) / (1 + 0.5 * radius / width)
    return 1 / (own.conductivity * (2 * area / width + spot))


def _conductances(block: Block, area: float, pos: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the conductance between a patch and each cell of a box, in C order [W/K]: the equation of `patch_flow`."""
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
    grids = [above[:x, :y, :z] for above, (x, y, z) in zip(seen, count.tolist(), strict=True)]
    if spec.outputs in ("max", "mean"):
        return np.array([[getattr(np, spec.outputs)(above)] for above in grids])
    if spec.outputs == "surface":
        grids = [above[_outer(above.shape, np.ones(3), FACES) > 0] for above in grids]
    return np.concatenate([above.ravel() for above in grids])[:, None]
