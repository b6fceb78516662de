"""`step` as one Triton kernel, for a GPU in float32 without derivatives: small boxes, and objects of one temperature.

A program takes a block of environments, all rows, sides and cells of them as one block of numbers, from the patches' areas to
what cells and objects gain. Every object is a node and side n of a row is at node n; their system is solved by Gauss–Jordan
steps without pivots, as its diagonal dominates. Conduction goes mode by mode.

Shapes of blocks: `C` cells of a box, `E` environments, `R` rows, `S` sides, each a power of two. Cells come first: a thread
then holds those of one patch, and what there is once for all of them is computed once.
"""

# Only Triton's compiler knows the types in a kernel.
# pyright: reportArgumentType=false, reportGeneralTypeIssues=false, reportOperatorIssue=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import triton
import triton.language as tl
from torch import Tensor
from torch.library import triton_op, wrap_triton

from tgdsl.sensors.temperature_grid.losses import stefan_boltzmann, zero_celsius
from tgdsl.sensors.temperature_grid.shares import least_width

SIGMA, ZERO = tl.constexpr(stefan_boltzmann()), tl.constexpr(zero_celsius())
LEAST = tl.constexpr(least_width())
PI = tl.constexpr(3.141592653589793)
UNROLLED = tl.constexpr(8)
"""Modes up to which they are written out one by one."""
MIN_PROGRAMS = 512
"""Numbers of a program's block at least: more environments are taken together."""
OF_WARP = (256, 512)
"""Numbers of a block for each warp: an environment's, within these bounds. Between warps, sums go through shared memory."""


@triton_op("tgdsl::heat_step", mutates_args={})
def heat_step(
    state: list[Tensor],
    patches: list[Tensor],
    rows: list[Tensor],
    films: list[Tensor],
    emissivity: Tensor | None,
    source: Tensor | None,
    modes: list[Tensor],
    objects: list[Tensor],
    around: list[Tensor],
    convection: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what cells and nodes gain [K], and rows and nodes from radiation, convection and contact (env, 3, …) [J].

    Args:
        state: Temperatures of the cells (env, row, x, y, z) and of the nodes (env, node), above ambient [K].
        patches: Area, resistance in series, centre and normal: eight planes (env, row, side).
        rows: Conductivity, heat capacity by volume, and volume of a cell (row,); lowest corner, sides of a cell and number of
            cells (row, 9); numbers of exposed faces of cells along each axis (row, cell).
        films: Resistance between a cell and its faces across each axis, and what modes lose there, (row, 6); the share of that
            which is radiation (row,).
        emissivity: Of the rows; None if nothing radiates.
        source: Heat source in each cell (row, x, y, z) [W].
        modes: Modes (row, mode, cell) of three axes, then their sums, then what αΔt/Δ² is multiplied with, (row, mode) each.
        objects: Heat capacity by volume, volume, area, conductivity and emissivity (env or 1, node).
        around: Δt and the temperature of the surroundings [°C], scalars.
        convection: Heat transfer coefficient; None if there is none.
    """
    wrapped = wrap_triton(step_kernel)
    return launch(wrapped, state, patches, rows, films, emissivity, source, modes, objects, around, convection)


def launch(
    run: Any,
    state: Sequence[Tensor],
    patches: Sequence[Tensor],
    rows: Sequence[Tensor],
    films: Sequence[Tensor],
    emissivity: Tensor | None,
    source: Tensor | None,
    modes: Sequence[Tensor],
    objects: Sequence[Tensor],
    around: Sequence[Tensor],
    convection: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run the kernel, plain or wrapped, on the arguments of `heat_step`."""
    cells, nodes = (part.contiguous() for part in state)
    num_envs, num_rows, x, y, z = cells.shape
    num_sides, dt = nodes.shape[1], around[0]
    gained, nodes_gained = cells.new_empty(cells.shape), nodes.new_empty(nodes.shape)
    got, nodes_got = cells.new_empty((num_envs, 3, num_rows)), cells.new_empty((num_envs, 3, num_sides))
    block = block_of(num_rows, num_sides, x * y * z)
    size = block[0] * block[1] * block[2]
    envs = max(1, MIN_PROGRAMS // size)
    strides = [(part.stride(0) if part.shape[0] > 1 else 0, part.stride(1)) for part in objects]
    run[(triton.cdiv(num_envs, envs),)](
        cells, nodes, *(part.contiguous() for part in patches), *(part.contiguous() for part in (*rows, *films)),
        dt if emissivity is None else emissivity.contiguous(), dt if source is None else source.contiguous(),
        *(part.contiguous() for part in modes), *objects, *(number for pair in strides for number in pair),
        *around, dt if convection is None else convection, gained, nodes_gained, got, nodes_got, num_envs, num_rows,
        NX=x, NY=y, NZ=z, SIDES=num_sides, ENVS=envs, ROWS=block[0], SIDE=block[1], CELLS=block[2],
        RADIATES=emissivity is not None, BLOWS=convection is not None, HAS_SOURCE=source is not None,
        FIRST=1 if emissivity is None and convection is None else 0,
        num_warps=max(1, min(8, envs * size // max(OF_WARP[0], min(OF_WARP[1], size)))),
    )  # fmt: skip
    return gained, nodes_gained, got, nodes_got


def block_of(num_rows: int, num_sides: int, num_cells: int) -> tuple[int, int, int]:
    """Return how many rows, sides and cells a block holds: the next powers of two."""
    rows, sides, cells = (1 << (number - 1).bit_length() for number in (num_rows, num_sides, num_cells))
    return rows, sides, cells


@triton.jit
def step_kernel(
    cells, nodes, area, series, pos_x, pos_y, pos_z, normal_x, normal_y, normal_z,
    conductivity, heat, cell_volume, boxes, ends_x, ends_y, ends_z, films, film_radiated, emissivity, source,
    mode_x, mode_y, mode_z, total_x, total_y, total_z, exponent_x, exponent_y, exponent_z,
    node_heat, node_volume, node_area, node_conductivity, node_emissivity,
    heat_env, heat_node, volume_env, volume_node, area_env, area_node, own_k_env, own_k_node, emissivity_env, emissivity_node,
    dt, ambient, convection, gained, nodes_gained, got, nodes_got, num_envs, num_rows,
    NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr, SIDES: tl.constexpr,
    ENVS: tl.constexpr, ROWS: tl.constexpr, SIDE: tl.constexpr, CELLS: tl.constexpr,
    RADIATES: tl.constexpr, BLOWS: tl.constexpr, HAS_SOURCE: tl.constexpr, FIRST: tl.constexpr,
):  # fmt: skip
    """Make a step of some environments."""
    env = tl.program_id(0).to(tl.int64) * ENVS + tl.arange(0, ENVS)
    row, side, cell = tl.arange(0, ROWS), tl.arange(0, SIDE), tl.arange(0, CELLS)
    is_env, is_row, is_side, is_cell = env < num_envs, row < num_rows, side < SIDES, cell < NX * NY * NZ
    place = (cell // (NY * NZ), (cell // NZ) % NY, cell % NZ)
    step = tl.load(dt)
    # Rows.
    box_x, box_y, box_z = _box(boxes, row, is_row, 0), _box(boxes, row, is_row, 1), _box(boxes, row, is_row, 2)
    k, by_volume = tl.load(conductivity + row, is_row, 1.0), tl.load(heat + row, is_row, 1.0)
    volume = tl.load(cell_volume + row, is_row, 1.0)
    capacity = by_volume * volume
    at = row[None, :] * (NX * NY * NZ) + cell[:, None]
    is_at = is_row[None, :] & is_cell[:, None]
    there = is_at & _is_there(box_x, place[0]) & _is_there(box_y, place[1]) & _is_there(box_z, place[2])
    at_cell = env[None, :, None] * (num_rows * NX * NY * NZ) + at[:, None, :]
    is_at_cell = is_env[None, :, None] & is_at[:, None, :]
    before = tl.load(cells + at_cell, is_at_cell, 0.0)
    # Patches.
    at_side = (env[:, None, None] * num_rows + row[None, :, None]) * SIDES + side[None, None, :]
    is_at_side = is_env[:, None, None] & is_row[None, :, None] & is_side[None, None, :]
    size = tl.load(area + at_side, is_at_side, 0.0)
    pos = (_at(pos_x, at_side, is_at_side), _at(pos_y, at_side, is_at_side), _at(pos_z, at_side, is_at_side))
    normal = (_at(normal_x, at_side, is_at_side), _at(normal_y, at_side, is_at_side), _at(normal_z, at_side, is_at_side))
    found = _conductances(size, pos, normal, k, volume, box_x, box_y, box_z, place, there)
    whole = tl.sum(found, axis=0)
    # What is no number stays none: minima and maxima lose it.
    rest = 0.0 * (size + pos[0] + pos[1] + pos[2] + normal[0] + normal[1] + normal[2])
    flow = found * (step / (1.0 + whole * _at(series, at_side, is_at_side)) + rest)[None, :, :, :]
    # Nodes.
    at_node = env[:, None] * SIDES + side[None, :]
    is_node = is_env[:, None] & is_side[None, :]
    phi = tl.load(nodes + at_node, is_node, 0.0)
    own_heat = tl.load(node_heat + env[:, None] * heat_env + side[None, :] * heat_node, is_node, 1.0)
    own_volume = tl.load(node_volume + env[:, None] * volume_env + side[None, :] * volume_node, is_node, 1.0)
    inverse = 1.0 / (own_heat * own_volume)
    # What cells show of the heat that they get: see `response`.
    rate = k / by_volume * step
    rates = (rate / (box_x[1] * box_x[1]), rate / (box_y[1] * box_y[1]), rate / (box_z[1] * box_z[1]))
    waves, powers = (mode_x, mode_y, mode_z), (exponent_x, exponent_y, exponent_z)
    sums = (total_x, total_y, total_z)
    shares = found * (1.0 / tl.where(size > 0, whole, 1.0))[None, :, :, :]
    over = tl.where(size > 0, 1.0, 0.0) / tl.where(size > 0, tl.sum(shares * shares, axis=0), 1.0)
    at_end, evenly = tl.zeros((ENVS, ROWS, SIDE), tl.float32), tl.zeros((ENVS, ROWS, SIDE), tl.float32)
    if NX * NY * NZ <= UNROLLED:
        for mode in tl.static_range(0, NX * NY * NZ):
            at_end, evenly = _left(
                at_end, evenly, shares, over, mode, rates, waves, powers, place, row, is_row, is_at, NX, NY, NZ
            )
    else:
        for mode in range(NX * NY * NZ):
            at_end, evenly = _left(
                at_end, evenly, shares, over, mode, rates, waves, powers, place, row, is_row, is_at, NX, NY, NZ
            )
    if SIDES > 1:
        every = tl.sum(shares * over[None, :, :, :], axis=3)
        meets = tl.where(size > 0, tl.sum(shares * every[:, :, :, None], axis=0), 1.0)
        at_end, evenly = at_end / meets, evenly / meets
    total = tl.sum(flow, axis=3)
    is_met = total > 0
    per_flow = 1.0 / tl.where(is_met, total, 1.0)
    on_average = tl.sum(flow * evenly[None, :, :, :], axis=3)
    kept = tl.sum(flow * at_end[None, :, :, :], axis=3) - capacity[None, None, :]
    larger = 1.0 / tl.where(is_met, tl.maximum(on_average, kept) * per_flow, 1.0)
    touched, own_touched = _touched(before, phi, capacity[None, None, :] * larger, inverse, flow, SIDES, ENVS, SIDE)
    touched = touched * larger
    # Losses beyond what modes lose.
    around, blowing = tl.load(ambient) + ZERO, 0.0
    if BLOWS:
        blowing = tl.load(convection)
    lost, share = tl.zeros((CELLS, ENVS, ROWS), tl.float32), tl.zeros((CELLS, ENVS, ROWS), tl.float32)
    own_lost, own_share = tl.zeros((ENVS, SIDE), tl.float32), tl.zeros((ENVS, SIDE), tl.float32)
    linear_share = tl.load(film_radiated + row, is_row, 0.0)
    if RADIATES:
        glow = SIGMA * tl.load(emissivity + row, is_row, 0.0)
        face_x = _face(ends_x, films, row, place[0], NX, is_at, by_volume * box_x[1], is_row, 0)
        face_y = _face(ends_y, films, row, place[1], NY, is_at, by_volume * box_y[1], is_row, 1)
        face_z = _face(ends_z, films, row, place[2], NZ, is_at, by_volume * box_z[1], is_row, 2)
        lost, share = _lost(
            before + touched, face_x, face_y, face_z, linear_share[None, None, :], glow[None, None, :], blowing, around, step
        )
    if RADIATES or BLOWS:
        own_glow = tl.zeros((ENVS, SIDE), tl.float32)
        if RADIATES:
            own_glow = SIGMA * tl.load(
                node_emissivity + env[:, None] * emissivity_env + side[None, :] * emissivity_node, is_node, 0.0
            )
        own_exposed = tl.load(node_area + env[:, None] * area_env + side[None, :] * area_node, is_node, 0.0) * inverse
        own_k = tl.load(node_conductivity + env[:, None] * own_k_env + side[None, :] * own_k_node, is_node, 1.0)
        width = tl.exp(tl.log(tl.where(inverse > 0, own_volume, 1.0)) * (1.0 / 3.0))
        body = (own_exposed, width / (6.0 * own_k), 0.0)
        own_lost, own_share = _lost_by_one(phi + own_touched, body, own_glow, blowing, around, step)
    # Conduction, with linear losses and a source.
    made = tl.zeros((CELLS, ROWS), tl.float32)
    if HAS_SOURCE:
        made = tl.load(source + at, is_at, 0.0) * (step / capacity)[None, :]
    gain = touched + lost
    apart = before + gain
    weight = there.to(tl.float32)
    weight = weight / tl.sum(weight, axis=0)[None, :]
    weight = tl.where(is_row[None, :], weight, 0.0)
    mean = tl.sum(apart * weight[:, None, :], axis=0)
    apart -= mean[None, :, :]
    spread, entered = tl.zeros((CELLS, ENVS, ROWS), tl.float32), tl.zeros((ENVS, ROWS), tl.float32)
    if NX * NY * NZ <= UNROLLED:
        for mode in tl.static_range(FIRST, NX * NY * NZ):
            spread, entered = _with_mode(
                spread, entered, apart, mean, made, mode, rates, waves, sums, powers, place, row, is_row, is_at, NX, NY, NZ,
                HAS_SOURCE,
            )  # fmt: skip
    else:
        for mode in range(FIRST, NX * NY * NZ):
            spread, entered = _with_mode(
                spread, entered, apart, mean, made, mode, rates, waves, sums, powers, place, row, is_row, is_at, NX, NY, NZ,
                HAS_SOURCE,
            )  # fmt: skip
    excess = tl.sum(spread, axis=0) - entered
    spread -= excess[None, :, :] * weight[:, None, :]
    tl.store(gained + at_cell, gain + (spread + made[:, None, :]), is_at_cell)
    tl.store(nodes_gained + at_node, own_touched + own_lost, is_node)
    # Accounts.
    at_row, is_at_row = env[:, None] * (3 * num_rows) + row[None, :], is_env[:, None] & is_row[None, :]
    radiated = tl.sum(lost * share, axis=0) + entered * linear_share[None, :]
    blown = tl.sum(lost * (1.0 - share), axis=0) + entered * (1.0 - linear_share)[None, :]
    tl.store(got + at_row, radiated * capacity[None, :], is_at_row)
    tl.store(got + at_row + num_rows, blown * capacity[None, :], is_at_row)
    tl.store(got + at_row + 2 * num_rows, tl.sum(touched, axis=0) * capacity[None, :], is_at_row)
    is_finite = inverse > 0
    own_capacity = tl.where(is_finite, 1.0, 0.0) / tl.where(is_finite, inverse, 1.0)
    own = env[:, None] * (3 * SIDES) + side[None, :]
    tl.store(nodes_got + own, own_lost * own_share * own_capacity, is_node)
    tl.store(nodes_got + own + SIDES, own_lost * (1.0 - own_share) * own_capacity, is_node)
    tl.store(nodes_got + own + 2 * SIDES, own_touched * own_capacity, is_node)


@triton.jit
def _at(plane, at, is_there):
    """Load a plane; 0 where there is nothing."""
    return tl.load(plane + at, is_there, 0.0)


@triton.jit
def _box(boxes, row, is_row, AXIS: tl.constexpr):
    """Return the lowest corner, the cells' side and their number along an axis (R)."""
    at = boxes + 9 * row + AXIS
    return tl.load(at, is_row, 0.0), tl.load(at + 3, is_row, 1.0), tl.load(at + 6, is_row, 1.0)


@triton.jit
def _is_there(box, place):
    """Return which cells a row has along an axis (C, R)."""
    return place[:, None].to(tl.float32) < box[2][None, :]


@triton.jit
def _left(
    at_end, evenly, shares, over, mode, rates, waves, powers, place, row, is_row, is_at,
    NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr,
):  # fmt: skip
    """Return r_E and r_φ − ½ r_E − r_F/12 of each side (E, R, S) with what a mode has of them: see `response`."""
    x, y, z = mode // (NY * NZ), (mode // NZ) % NY, mode % NZ
    wave = _wave(waves[0], row, x, place[0], NX, is_at)
    wave *= _wave(waves[1], row, y, place[1], NY, is_at) * _wave(waves[2], row, z, place[2], NZ, is_at)
    power = rates[0] * _of_mode(powers[0], row, x, NX, is_row)
    power += rates[1] * _of_mode(powers[1], row, y, NY, is_row)
    power += rates[2] * _of_mode(powers[2], row, z, NZ, is_row)
    own = tl.sum(shares * wave[:, None, :, None], axis=0)
    every = tl.sum(own * over, axis=2)
    decay = _expm1(-power)
    left = 1.0 + decay
    at_end += own * (every * left[None, :])[:, :, None]
    average = 1.0 + _delayed(power, decay) - left * (0.5 + power * (1.0 / 12.0))
    return at_end, evenly + own * (every * average[None, :])[:, :, None]


@triton.jit
def _with_mode(
    spread, entered, apart, mean, made, mode, rates, waves, sums, powers, place, row, is_row, is_at,
    NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr, HAS_SOURCE: tl.constexpr,
):  # fmt: skip
    """Return `spread` (C, E, R) with what a mode adds in a step, and `entered` (E, R) with what of it came through the faces.

    Of the mode's part of the cells e^(−x) − 1, of that of a source φ₁(−x) − 1.
    """
    x, y, z = mode // (NY * NZ), (mode // NZ) % NY, mode % NZ
    wave = _wave(waves[0], row, x, place[0], NX, is_at)
    wave *= _wave(waves[1], row, y, place[1], NY, is_at) * _wave(waves[2], row, z, place[2], NZ, is_at)
    total = (
        _of_mode(sums[0], row, x, NX, is_row) * _of_mode(sums[1], row, y, NY, is_row) * _of_mode(sums[2], row, z, NZ, is_row)
    )
    power = rates[0] * _of_mode(powers[0], row, x, NX, is_row)
    power += rates[1] * _of_mode(powers[1], row, y, NY, is_row)
    power += rates[2] * _of_mode(powers[2], row, z, NZ, is_row)
    decay = _expm1(-power)
    along = (tl.sum(apart * wave[:, None, :], axis=0) + mean * total[None, :]) * decay[None, :]
    if HAS_SOURCE:
        along += (_delayed(power, decay) * tl.sum(made * wave, axis=0))[None, :]
    return spread + along[None, :, :] * wave[:, None, :], entered + along * total[None, :]


@triton.jit
def _delayed(power, decay):
    """Return φ₁(x) − 1 = (1 − e^(−x))/x − 1 from x and e^(−x) − 1."""
    is_any = power > 1e-3
    return tl.where(is_any, -decay / tl.where(is_any, power, 1.0) - 1.0, -0.5 * power * (1.0 - power * (1.0 / 3.0)))


@triton.jit
def _wave(vectors, row, mode, place, NUM: tl.constexpr, is_at):
    """Return a mode along an axis (C, R)."""
    return tl.load(vectors + (row[None, :] * NUM + mode) * NUM + place[:, None], is_at, 0.0)


@triton.jit
def _of_mode(values, row, mode, NUM: tl.constexpr, is_row):
    """Return a number of a mode along an axis (R)."""
    return tl.load(values + row * NUM + mode, is_row, 0.0)


@triton.jit
def _face(ends, films, row, place, NUM: tl.constexpr, is_at, heat, is_row, AXIS: tl.constexpr):
    """Return exposed area over heat capacity (C, 1, R), resistance, and what modes lose (1, 1, R), of faces across an axis."""
    exposed = tl.load(ends + row[None, :] * NUM + place[:, None], is_at, 0.0) / heat[None, :]
    resistance, film = tl.load(films + 6 * row + AXIS, is_row, 0.0), tl.load(films + 6 * row + 3 + AXIS, is_row, 0.0)
    return exposed[:, None, :], resistance[None, None, :], film[None, None, :]


@triton.jit
def _expm1(x):
    """Return eˣ − 1 to a few roundings; a difference near 0 would lose digits."""
    near = tl.maximum(tl.minimum(x, 0.5), -0.5)
    series = 1.0 + near * (1.0 / 8.0)
    for n in tl.static_range(7, 1, -1):
        series = 1.0 + near * (1.0 / n) * series
    return tl.where(tl.abs(x) < 0.5, x * series, tl.exp(x) - 1.0)


@triton.jit
def _lost(above, face_x, face_y, face_z, linear_share, glow, blowing, around, step):
    """Return what temperatures above the surroundings gain, and the share of it that is radiation: see `losses`."""
    total = _radiated(above, glow, around) + blowing
    x, y, z = 1.0 / (1.0 + total * face_x[1]), 1.0 / (1.0 + total * face_y[1]), 1.0 / (1.0 + total * face_z[1])
    middle = above * tl.exp(-0.5 * step * total * (face_x[0] * x + face_y[0] * y + face_z[0] * z))
    rate, glowing = _through(middle * x, face_x, linear_share, glow, blowing, around)
    more, more_glowing = _through(middle * y, face_y, linear_share, glow, blowing, around)
    rate, glowing = rate + more, glowing + more_glowing
    more, more_glowing = _through(middle * z, face_z, linear_share, glow, blowing, around)
    return _decayed(above, rate + more, glowing + more_glowing, step)


@triton.jit
def _lost_by_one(above, face, glow, blowing, around, step):
    """Return the same of bodies with one face."""
    total = _radiated(above, glow, around) + blowing
    part = 1.0 / (1.0 + total * face[1])
    middle = above * tl.exp(-0.5 * step * total * (face[0] * part))
    rate, glowing = _through(middle * part, face, 0.0, glow, blowing, around)
    return _decayed(above, rate, glowing, step)


@triton.jit
def _decayed(above, rate, glowing, step):
    """Return what temperatures gain at a rate, and the share of it that is radiation."""
    is_any = rate != 0
    return above * _expm1(-step * rate), tl.where(is_any, glowing, 0.0) / tl.where(is_any, rate, 1.0)


@triton.jit
def _through(surface, face, linear_share, glow, blowing, around):
    """Return the rate at which faces across an axis lose heat beyond what modes lose, and what of it is radiation [1/s]."""
    own_glow = _radiated(surface, glow, around)
    own = own_glow + blowing
    open_part = 1.0 / (1.0 + own * face[1])
    return face[0] * (own * open_part - face[2]), face[0] * (own_glow * open_part - face[2] * linear_share)


@triton.jit
def _radiated(above, glow, around):
    """Return the heat transfer coefficient of radiation."""
    hot = above + around
    return glow * (hot + around) * (hot * hot + around * around)


@triton.jit
def _conductances(size, pos, normal, k, volume, box_x, box_y, box_z, place, there):
    """Return the conductances between sides and cells (C, E, R, S) [W/K]: see `shares`."""
    is_any = size > 0
    safe = tl.where(is_any, size, 1e-6)
    edge = 0.5 * tl.sqrt(safe)
    x = _along(pos[0], normal[0], edge, box_x, place[0], (place[1] == 0) & (place[2] == 0))
    y = _along(pos[1], normal[1], edge, box_y, place[1], (place[0] == 0) & (place[2] == 0))
    z = _along(pos[2], normal[2], edge, box_z, place[2], (place[0] == 0) & (place[1] == 0))
    fit = safe * x[3] * y[3] * z[3]
    depth = normal[0] * normal[0] * box_x[1][None, :, None] + normal[1] * normal[1] * box_y[1][None, :, None]
    depth += normal[2] * normal[2] * box_z[1][None, :, None]
    radius = tl.sqrt(fit / PI)
    rho = radius * tl.sqrt(depth * (1.0 / volume)[None, :, None])
    few = (1.0 - x[4] * (1.0 - x[2])) * (1.0 - y[4] * (1.0 - y[2])) * (1.0 - z[4] * (1.0 - z[2]))
    fitted = 1.0 + 0.75 * rho * (2.0 * few - 1.0) * tl.maximum(1.0 - 2.0 * rho, 0.0)
    own = k[None, :, None]
    cover = tl.where(is_any, 2.0 * own * fit / depth, 0.0)
    spot = tl.where(is_any, 2.0 * own * radius / (1.0 + 0.5 * rho) * fitted, 0.0)
    of_x, of_y, of_z = (spot * x[4])[None, :, :, :], (spot * y[4])[None, :, :, :], (spot * z[4])[None, :, :, :]
    result = x[0] * (y[0] * (cover[None, :, :, :] * z[0] + of_z * z[1]) + of_y * y[1] * z[0]) + of_x * x[1] * y[0] * z[0]
    return tl.where(there[:, None, :, None], result, 0.0)


@triton.jit
def _along(pos, normal, edge, box, place, is_first_of_others):
    """Return shares and edges (C, E, R, S), Σ w², the part that is in the box, and 1 − n² (E, R, S) along an axis."""
    low, number, scale = box[0][None, :, None], box[2][None, :, None], (1.0 / box[1])[None, :, None]
    across = tl.maximum(1.0 - normal * normal, 0.0)
    half = edge * tl.sqrt(across) * scale
    middle = 0.5 * number
    fits = tl.minimum(half, middle)
    within = tl.where(half > 0, fits / tl.where(half > 0, half, 1.0), 1.0)
    width = tl.minimum(tl.maximum(fits, LEAST), middle)
    centre = (pos - low) * scale
    about = tl.minimum(tl.maximum(centre, width), number - width)
    centre = tl.minimum(tl.maximum(centre, fits), number - fits)
    at = (place.to(tl.float32) + 0.5)[:, None, None, None]
    top = number - 0.5
    first, last = about - width, about + width
    covered = _below(_inside(last, top)[None, :, :, :] - at) - _below(_inside(first, top)[None, :, :, :] - at)
    before = tl.maximum(0.5 - first, 0.0) - tl.maximum(0.5 - last, 0.0)
    after = tl.maximum(last - top, 0.0) - tl.maximum(first - top, 0.0)
    covered += tl.where(at < 1.0, before[None, :, :, :], 0.0)
    covered += tl.where(tl.abs(at - top[None, :, :, :]) < 0.25, after[None, :, :, :], 0.0)
    shares = covered * (0.5 / width)[None, :, :, :]
    start, end = centre - fits, centre + fits
    open_start = tl.minimum(tl.maximum(2.0 * start, 0.0), 1.0)[None, :, :, :]
    open_end = tl.minimum(tl.maximum(2.0 * (number - end), 0.0), 1.0)[None, :, :, :]
    at_start = tl.maximum(1.0 - tl.abs(_inside(start, top)[None, :, :, :] - at), 0.0)
    at_end = tl.maximum(1.0 - tl.abs(_inside(end, top)[None, :, :, :] - at), 0.0)
    edges = 0.5 * (open_start * at_start + open_end * at_end)
    squared = tl.sum(tl.where(is_first_of_others[:, None, None, None], shares * shares, 0.0), axis=0)
    return shares, edges, squared, within, across


@triton.jit
def _inside(point, top):
    """Return the nearest point between the centres of the first and the last cell."""
    return tl.minimum(tl.maximum(point, 0.5), top)


@triton.jit
def _below(offset):
    """Return the integral of a cell's weight up to `offset` beyond its centre, less that up to the centre."""
    offset = tl.minimum(tl.maximum(offset, -1.0), 1.0)
    return offset * (1.0 - 0.5 * tl.abs(offset))


@triton.jit
def _touched(cells, nodes, capacity, inverse, flow, SIDES: tl.constexpr, ENVS: tl.constexpr, SIDE: tl.constexpr):
    """Return what cells of some capacity (C, E, R) and nodes (E, S) gain by contact [K]: see `conduction`."""
    over = 1.0 / (capacity + tl.sum(flow, axis=3))
    weight = flow * (capacity * over)[:, :, :, None]
    pull = tl.sum(tl.sum(weight, axis=0), axis=1)
    right = nodes + inverse * tl.sum(tl.sum(weight * cells[:, :, :, None], axis=0), axis=1)
    if SIDES == 1:
        after = right / (1.0 + inverse * pull)
        left = tl.zeros((ENVS, SIDE), tl.float32)
    else:
        number = tl.arange(0, SIDE)
        is_diagonal = (number[:, None] == number[None, :])[None, :, :]
        share = flow * over[:, :, :, None]
        coupled = tl.zeros((ENVS, SIDE, SIDE), tl.float32)
        for m in tl.static_range(SIDES):
            of_other = tl.sum(tl.where((number == m)[None, None, None, :], share, 0.0), axis=3)
            both = tl.sum(tl.sum(flow * of_other[:, :, :, None], axis=0), axis=1)
            coupled += tl.where((number == m)[None, None, :], both[:, :, None], 0.0)
        coupled = tl.where(is_diagonal, 0.0, coupled)
        diagonal = 1.0 + inverse * (pull + tl.sum(coupled, axis=2))
        after = _solved(
            tl.where(is_diagonal, diagonal[:, :, None], -inverse[:, :, None] * coupled), right, is_diagonal, SIDES, SIDE
        )
        left = tl.sum(coupled * (after[:, :, None] - after[:, None, :]), axis=2)
    across = after[None, :, None, :] - cells[:, :, :, None]
    left += tl.sum(tl.sum(weight * across, axis=0), axis=1)
    return tl.sum(flow * across, axis=3) * over, -inverse * left


@triton.jit
def _solved(matrix, right, is_diagonal, SIDES: tl.constexpr, SIDE: tl.constexpr):
    """Return the solution (E, S) of a system whose diagonal dominates."""
    number = tl.arange(0, SIDE)
    for n in tl.static_range(SIDES):
        is_own = (number == n)[None, :]
        pivot_row = tl.sum(tl.where(is_own[:, :, None], matrix, 0.0), axis=1)
        pivot = tl.sum(tl.where(is_own, pivot_row, 0.0), axis=1)
        column = tl.sum(tl.where(is_own[:, None, :], matrix, 0.0), axis=2)
        factor = tl.where(is_own, 0.0, column / pivot[:, None])
        matrix -= factor[:, :, None] * pivot_row[:, None, :]
        right -= factor * tl.sum(tl.where(is_own, right, 0.0), axis=1)[:, None]
    return right / tl.sum(tl.where(is_diagonal, matrix, 0.0), axis=2)
