"""`step` as one Triton kernel, for a GPU in float32 without derivatives: small boxes, and one object of one temperature.

A program takes a block of environments, all rows and cells of them as one block of numbers, from the patches' areas to what
cells and the object, the node, gain. Conduction goes mode by mode, over a table that is computed beforehand: how modes decay is
the same in all environments.

Shapes of blocks: `C` cells of a box, `E` environments, `R` rows, each a power of two. Cells come first: a thread then holds
those of one patch, and what there is once for all of them is computed once.
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
    modes: Tensor,
    objects: list[Tensor],
    around: list[Tensor],
    convection: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return what cells and the node gain [K], and rows and node from radiation, convection and contact (env, 3, …) [J].

    Args:
        state: Temperatures of the cells (env, row, x, y, z) and of the node (env, 1), above ambient [K].
        patches: Area, resistance in series, centre and normal: eight planes (env, row, 1).
        rows: Conductivity, heat capacity by volume, and volume of a cell (row,); lowest corner, sides of a cell and number of
            cells (row, 9); numbers of exposed faces of cells along each axis (row, cell).
        films: Resistance between a cell and its faces across each axis, and what modes lose there, (row, 6); the share of that
            which is radiation (row,).
        emissivity: Of the rows; None if nothing radiates.
        source: Heat source in each cell (row, x, y, z) [W].
        modes: Of each mode of the boxes its values in the cells, their sum, and what `response.decays` returns of it,
            (row, mode, cells + 5).
        objects: Heat capacity by volume, volume, area, conductivity and emissivity (env or 1, 1).
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
    modes: Tensor,
    objects: Sequence[Tensor],
    around: Sequence[Tensor],
    convection: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run the kernel, plain or wrapped, on the arguments of `heat_step`."""
    cells, nodes = (part.contiguous() for part in state)
    num_envs, num_rows, x, y, z = cells.shape
    dt = around[0]
    gained, nodes_gained = cells.new_empty(cells.shape), nodes.new_empty(nodes.shape)
    got, nodes_got = cells.new_empty((num_envs, 3, num_rows)), cells.new_empty((num_envs, 3, 1))
    block = block_of(num_rows, x * y * z)
    size = block[0] * block[1]
    envs = max(1, MIN_PROGRAMS // size)
    strides = [part.stride(0) if part.shape[0] > 1 else 0 for part in objects]
    run[(triton.cdiv(num_envs, envs),)](
        cells, nodes, *(part.contiguous() for part in patches), *(part.contiguous() for part in (*rows, *films)),
        dt if emissivity is None else emissivity.contiguous(), dt if source is None else source.contiguous(),
        modes.contiguous(), *objects, *strides,
        *around, dt if convection is None else convection, gained, nodes_gained, got, nodes_got, num_envs, num_rows,
        NX=x, NY=y, NZ=z, ENVS=envs, ROWS=block[0], CELLS=block[1],
        RADIATES=emissivity is not None, BLOWS=convection is not None, HAS_SOURCE=source is not None,
        num_warps=max(1, min(8, envs * size // max(OF_WARP[0], min(OF_WARP[1], size)))),
    )  # fmt: skip
    return gained, nodes_gained, got, nodes_got


def block_of(num_rows: int, num_cells: int) -> tuple[int, int]:
    """Return how many rows and cells a block holds: the next powers of two."""
    rows, cells = (1 << (number - 1).bit_length() for number in (num_rows, num_cells))
    return rows, cells


@triton.jit
def step_kernel(
    cells, nodes, area, series, pos_x, pos_y, pos_z, normal_x, normal_y, normal_z,
    conductivity, heat, cell_volume, boxes, ends_x, ends_y, ends_z, films, film_radiated, emissivity, source, modes,
    node_heat, node_volume, node_area, node_conductivity, node_emissivity,
    heat_env, volume_env, area_env, own_k_env, emissivity_env,
    dt, ambient, convection, gained, nodes_gained, got, nodes_got, num_envs, num_rows,
    NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr, ENVS: tl.constexpr, ROWS: tl.constexpr, CELLS: tl.constexpr,
    RADIATES: tl.constexpr, BLOWS: tl.constexpr, HAS_SOURCE: tl.constexpr,
):  # fmt: skip
    """Make a step of some environments."""
    env = tl.program_id(0).to(tl.int64) * ENVS + tl.arange(0, ENVS)
    row, cell = tl.arange(0, ROWS), tl.arange(0, CELLS)
    is_env, is_row, is_cell = env < num_envs, row < num_rows, cell < NX * NY * NZ
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
    at_side, is_at_side = env[:, None] * num_rows + row[None, :], is_env[:, None] & is_row[None, :]
    size = tl.load(area + at_side, is_at_side, 0.0)
    pos = (_at(pos_x, at_side, is_at_side), _at(pos_y, at_side, is_at_side), _at(pos_z, at_side, is_at_side))
    normal = (_at(normal_x, at_side, is_at_side), _at(normal_y, at_side, is_at_side), _at(normal_z, at_side, is_at_side))
    found = _conductances(size, pos, normal, k, volume, box_x, box_y, box_z, place, there)
    whole = tl.sum(found, axis=0)
    # What is no number stays none: minima and maxima lose it.
    rest = 0.0 * (size + pos[0] + pos[1] + pos[2] + normal[0] + normal[1] + normal[2])
    flow = found * (step / (1.0 + whole * _at(series, at_side, is_at_side)) + rest)[None, :, :]
    shares = found * (1.0 / tl.where(size > 0, whole, 1.0))[None, :, :]
    # The node.
    phi = tl.load(nodes + env, is_env, 0.0)
    own_volume = tl.load(node_volume + env * volume_env, is_env, 1.0)
    inverse = 1.0 / (tl.load(node_heat + env * heat_env, is_env, 1.0) * own_volume)
    # Losses beyond what modes lose.
    around, blowing = tl.load(ambient) + ZERO, 0.0
    if BLOWS:
        blowing = tl.load(convection)
    lost, share = tl.zeros((CELLS, ENVS, ROWS), tl.float32), tl.zeros((CELLS, ENVS, ROWS), tl.float32)
    own_lost, own_share = tl.zeros((ENVS,), tl.float32), tl.zeros((ENVS,), tl.float32)
    linear_share = tl.load(film_radiated + row, is_row, 0.0)
    if RADIATES:
        glow = SIGMA * tl.load(emissivity + row, is_row, 0.0)
        face_x = _face(ends_x, films, row, place[0], NX, is_at, by_volume * box_x[1], is_row, 0)
        face_y = _face(ends_y, films, row, place[1], NY, is_at, by_volume * box_y[1], is_row, 1)
        face_z = _face(ends_z, films, row, place[2], NZ, is_at, by_volume * box_z[1], is_row, 2)
        lost, share = _lost(
            before, face_x, face_y, face_z, linear_share[None, None, :], glow[None, None, :], blowing, around, step
        )
    if RADIATES or BLOWS:
        own_glow = tl.zeros((ENVS,), tl.float32)
        if RADIATES:
            own_glow = SIGMA * tl.load(node_emissivity + env * emissivity_env, is_env, 0.0)
        own_exposed = tl.load(node_area + env * area_env, is_env, 0.0) * inverse
        own_k = tl.load(node_conductivity + env * own_k_env, is_env, 1.0)
        width = tl.exp(tl.log(tl.where(inverse > 0, own_volume, 1.0)) * (1.0 / 3.0))
        own_lost, own_share = _lost_by_one(phi, (own_exposed, width / (6.0 * own_k), 0.0), own_glow, blowing, around, step)
    # Without contact: conduction, with linear losses and a source; and what modes show of contact, see `response`.
    made = tl.zeros((CELLS, ENVS, ROWS), tl.float32)
    if HAS_SOURCE:
        made = tl.load(source + (at_cell - env[None, :, None] * (num_rows * NX * NY * NZ)), is_at_cell, 0.0)
        made *= (step / capacity)[None, None, :]
    weight = there.to(tl.float32)
    weight = tl.where(is_row[None, :], weight / tl.sum(weight, axis=0)[None, :], 0.0)
    now = before + lost
    mean = tl.sum(now * weight[:, None, :], axis=0)
    apart = now - mean[None, :, :]
    average, end = tl.zeros((CELLS, ENVS, ROWS), tl.float32), tl.zeros((CELLS, ENVS, ROWS), tl.float32)
    entered = tl.zeros((ENVS, ROWS), tl.float32)
    none, nothing = tl.zeros((CELLS, ROWS), tl.float32), tl.zeros((ENVS, ROWS), tl.float32)
    by_cell, by_side = (none, none, none, none), (nothing, nothing, nothing, nothing)
    if NX * NY * NZ <= UNROLLED:
        for mode in tl.static_range(0, NX * NY * NZ):
            average, end, entered, by_cell, by_side = _without_contact(
                average, end, entered, by_cell, by_side, apart, mean, made, shares, modes, mode, row, is_row, cell, is_at,
                NX * NY * NZ, HAS_SOURCE,
            )  # fmt: skip
    else:
        for mode in range(NX * NY * NZ):
            average, end, entered, by_cell, by_side = _without_contact(
                average, end, entered, by_cell, by_side, apart, mean, made, shares, modes, mode, row, is_row, cell, is_at,
                NX * NY * NZ, HAS_SOURCE,
            )  # fmt: skip
    # Contact: see `conduction`.
    met = tl.sum(flow, axis=0)
    bodies = inverse * tl.sum(met, axis=1)
    sigma = _impulsiveness(
        by_side[0] * met * (1.0 / capacity)[None, :] + bodies[:, None],
        by_side[1] * met * (1.0 / capacity)[None, :] + bodies[:, None],
        met > 0,
    )
    heat_of, rate_of, own_touched = _touched(
        now + (average + 0.5 * made), now + (end + made), phi + own_lost, capacity, inverse, flow,
        shares, by_cell, by_side, sigma,
    )  # fmt: skip
    spread, through = tl.zeros((CELLS, ENVS, ROWS), tl.float32), tl.zeros((ENVS, ROWS), tl.float32)
    if NX * NY * NZ <= UNROLLED:
        for mode in tl.static_range(0, NX * NY * NZ):
            spread, through = _with_contact(
                spread, through, heat_of, rate_of, sigma, modes, mode, row, is_row, cell, is_at, NX * NY * NZ
            )
    else:
        for mode in range(NX * NY * NZ):
            spread, through = _with_contact(
                spread, through, heat_of, rate_of, sigma, modes, mode, row, is_row, cell, is_at, NX * NY * NZ
            )
    spread, entered = spread + end, entered + through
    excess = tl.sum(spread, axis=0) - entered
    spread -= excess[None, :, :] * weight[:, None, :]
    tl.store(gained + at_cell, (lost + heat_of) + (spread + made), is_at_cell)
    tl.store(nodes_gained + env, own_touched * inverse + own_lost, is_env)
    # Accounts.
    at_row = env[:, None] * (3 * num_rows) + row[None, :]
    radiated = tl.sum(lost * share, axis=0) + entered * linear_share[None, :]
    blown = tl.sum(lost * (1.0 - share), axis=0) + entered * (1.0 - linear_share)[None, :]
    tl.store(got + at_row, radiated * capacity[None, :], is_at_side)
    tl.store(got + at_row + num_rows, blown * capacity[None, :], is_at_side)
    tl.store(got + at_row + 2 * num_rows, tl.sum(heat_of, axis=0) * capacity[None, :], is_at_side)
    is_finite = inverse > 0
    own_capacity = tl.where(is_finite, 1.0, 0.0) / tl.where(is_finite, inverse, 1.0)
    tl.store(nodes_got + 3 * env, own_lost * own_share * own_capacity, is_env)
    tl.store(nodes_got + 3 * env + 1, own_lost * (1.0 - own_share) * own_capacity, is_env)
    tl.store(nodes_got + 3 * env + 2, tl.where(is_finite, own_touched, 0.0), is_env)


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
def _mode(modes, mode, row, is_row, cell, is_at, NUM: tl.constexpr):
    """Return a mode's values in the cells (C, R), their sum, and φ₀ − 1, φ₁ − 1, φ₂ − ½ and φ₃ − ⅙ of it (R)."""
    at = modes + (row * NUM + mode) * (NUM + 5)
    wave = tl.load(at[None, :] + cell[:, None], is_at, 0.0)
    total, a = tl.load(at + NUM, is_row, 0.0), tl.load(at + NUM + 1, is_row, 0.0)
    b, c, d = tl.load(at + NUM + 2, is_row, 0.0), tl.load(at + NUM + 3, is_row, 0.0), tl.load(at + NUM + 4, is_row, 0.0)
    return wave, total, a, b, c, d


@triton.jit
def _without_contact(
    average, end, entered, by_cell, by_side, apart, mean, made, shares, modes, mode, row, is_row, cell, is_at,
    NUM: tl.constexpr, HAS_SOURCE: tl.constexpr,
):  # fmt: skip
    """Add a mode to what cells gain without contact, in the mean and at the end, and to what all show: see `response`."""
    wave, total, a, b, c, d = _mode(modes, mode, row, is_row, cell, is_at, NUM)
    part = tl.sum(apart * wave[:, None, :], axis=0) + mean * total[None, :]
    of_mean, of_end = part * b[None, :], part * a[None, :]
    if HAS_SOURCE:
        warmed = tl.sum(made * wave[:, None, :], axis=0)
        of_mean += warmed * c[None, :]
        of_end += warmed * b[None, :]
    average += of_mean[None, :, :] * wave[:, None, :]
    end += of_end[None, :, :] * wave[:, None, :]
    entered += of_end * total[None, :]
    a, b, c, d = a + 1.0, b + 1.0, c + 0.5, d + 1.0 / 6.0
    squared, own = wave * wave, tl.sum(shares * wave[:, None, :], axis=0)
    own *= own
    by_cell = (
        by_cell[0] + squared * a[None, :], by_cell[1] + squared * b[None, :],
        by_cell[2] + squared * c[None, :], by_cell[3] + squared * d[None, :],
    )  # fmt: skip
    by_side = (
        by_side[0] + own * a[None, :], by_side[1] + own * b[None, :],
        by_side[2] + own * c[None, :], by_side[3] + own * d[None, :],
    )  # fmt: skip
    return average, end, entered, by_cell, by_side


@triton.jit
def _with_contact(spread, through, heat, rate, sigma, modes, mode, row, is_row, cell, is_at, NUM: tl.constexpr):
    """Add a mode to what cells gain of contact beyond the heat that they get (C, E, R), and through faces (E, R)."""
    wave, total, a, b, c, _ = _mode(modes, mode, row, is_row, cell, is_at, NUM)
    _, _, of_heat, of_rate = _response((a[None, :], b[None, :], c[None, :], c[None, :]), sigma)
    along = tl.sum(heat * wave[:, None, :], axis=0) * of_heat + tl.sum(rate * wave[:, None, :], axis=0) * of_rate
    return spread + along[None, :, :] * wave[:, None, :], through + along * total[None, :]


@triton.jit
def _response(phi, sigma):
    """Return what H and J show in the mean and at the end of a step: see `response`."""
    over = 1.0 / (1.0 + 2.0 * sigma)
    impulse, constant, linear = (1.0 - sigma) * over, (1.0 - 4.0 * sigma) * over, 6.0 * sigma * over
    return (
        impulse * phi[1] + linear * (phi[2] - phi[3]), constant * phi[2] + linear * phi[3] - impulse * phi[1],
        impulse * phi[0] + linear * (phi[1] - phi[2]), constant * phi[1] + linear * phi[2] - impulse * phi[0],
    )  # fmt: skip


@triton.jit
def _impulsiveness(start, constant, is_any):
    """Return σ of what rows show of an impulse and of a constant flow: see `response`."""
    spread = tl.where(is_any, 1.0 - start / tl.where(is_any, constant, 1.0), 0.0)
    z = start / (1.0 + constant - start) + 16.0 * spread * spread * constant / (1.0 + constant)
    far, near = tl.where(z > 0.5, z, 1.0), tl.where(z > 0.5, 0.5, z)
    left = tl.exp(-far)
    last = 2.0 * ((1.0 - left) / far - left)
    square = near * near
    series = 1.0 - 0.25 * near + square * (1.0 / 40.0 - square * (1.0 / 5600.0 - square * (1.0 / 504000.0)))
    return tl.where(z > 0.5, (last - far * left) / (2.0 * (1.0 - left - last)), series)


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
    """Return the conductances between sides and cells (C, E, R) [W/K]: see `shares`."""
    is_any = size > 0
    safe = tl.where(is_any, size, 1e-6)
    edge = 0.5 * tl.sqrt(safe)
    x = _along(pos[0], normal[0], edge, box_x, place[0], (place[1] == 0) & (place[2] == 0))
    y = _along(pos[1], normal[1], edge, box_y, place[1], (place[0] == 0) & (place[2] == 0))
    z = _along(pos[2], normal[2], edge, box_z, place[2], (place[0] == 0) & (place[1] == 0))
    fit = safe * x[3] * y[3] * z[3]
    depth = normal[0] * normal[0] * box_x[1][None, :] + normal[1] * normal[1] * box_y[1][None, :]
    depth += normal[2] * normal[2] * box_z[1][None, :]
    radius = tl.sqrt(fit / PI)
    rho = radius * tl.sqrt(depth * (1.0 / volume)[None, :])
    few = (1.0 - x[4] * (1.0 - x[2])) * (1.0 - y[4] * (1.0 - y[2])) * (1.0 - z[4] * (1.0 - z[2]))
    fitted = 1.0 + 0.75 * rho * (2.0 * few - 1.0) * tl.maximum(1.0 - 2.0 * rho, 0.0)
    own = k[None, :]
    cover = tl.where(is_any, 2.0 * own * fit / depth, 0.0)
    spot = tl.where(is_any, 2.0 * own * radius / (1.0 + 0.5 * rho) * fitted, 0.0)
    of_x, of_y, of_z = (spot * x[4])[None, :, :], (spot * y[4])[None, :, :], (spot * z[4])[None, :, :]
    result = x[0] * (y[0] * (cover[None, :, :] * z[0] + of_z * z[1]) + of_y * y[1] * z[0]) + of_x * x[1] * y[0] * z[0]
    return tl.where(there[:, None, :], result, 0.0)


@triton.jit
def _along(pos, normal, edge, box, place, is_first_of_others):
    """Return shares and edges (C, E, R), Σ w², the part that is in the box, and 1 − n² (E, R) along an axis."""
    low, number, scale = box[0][None, :], box[2][None, :], (1.0 / box[1])[None, :]
    across = tl.maximum(1.0 - normal * normal, 0.0)
    half = edge * tl.sqrt(across) * scale
    middle = 0.5 * number
    fits = tl.minimum(half, middle)
    within = tl.where(half > 0, fits / tl.where(half > 0, half, 1.0), 1.0)
    width = tl.minimum(tl.maximum(fits, LEAST), middle)
    centre = (pos - low) * scale
    about = tl.minimum(tl.maximum(centre, width), number - width)
    centre = tl.minimum(tl.maximum(centre, fits), number - fits)
    at = (place.to(tl.float32) + 0.5)[:, None, None]
    top = number - 0.5
    first, last = about - width, about + width
    covered = _below(_inside(last, top)[None, :, :] - at) - _below(_inside(first, top)[None, :, :] - at)
    before = tl.maximum(0.5 - first, 0.0) - tl.maximum(0.5 - last, 0.0)
    after = tl.maximum(last - top, 0.0) - tl.maximum(first - top, 0.0)
    covered += tl.where(at < 1.0, before[None, :, :], 0.0)
    covered += tl.where(tl.abs(at - top[None, :, :]) < 0.25, after[None, :, :], 0.0)
    shares = covered * (0.5 / width)[None, :, :]
    start, end = centre - fits, centre + fits
    open_start = tl.minimum(tl.maximum(2.0 * start, 0.0), 1.0)[None, :, :]
    open_end = tl.minimum(tl.maximum(2.0 * (number - end), 0.0), 1.0)[None, :, :]
    at_start = tl.maximum(1.0 - tl.abs(_inside(start, top)[None, :, :] - at), 0.0)
    at_end = tl.maximum(1.0 - tl.abs(_inside(end, top)[None, :, :] - at), 0.0)
    edges = 0.5 * (open_start * at_start + open_end * at_end)
    squared = tl.sum(tl.where(is_first_of_others[:, None, None], shares * shares, 0.0), axis=0)
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
def _touched(average, end, phi, capacity, inverse, flow, shares, by_cell, by_side, sigma):
    """Return H and J of cells over their capacity (C, E, R) [K], and what the node gets (E) [J]: see `conduction`."""
    over = (1.0 / capacity)[None, :]
    a, b, c, d = _response(
        (by_cell[0][:, None, :], by_cell[1][:, None, :], by_cell[2][:, None, :], by_cell[3][:, None, :]), sigma[None, :, :]
    )
    ra, rb, rc, rd = _response(by_side, sigma)
    squared = shares * shares
    ra, rb = (ra - tl.sum(squared * a, axis=0)) * over, (rb - tl.sum(squared * b, axis=0)) * over
    rc, rd = (rc - tl.sum(squared * c, axis=0)) * over, (rd - tl.sum(squared * d, axis=0)) * over
    # Cells: H and J are f S (temperatures of the node − free).
    per = flow * over[None, :, :]
    sa, sb, sc, sd = _inverted(1.0 + per * a, per * b, per * c, 1.0 + per * d)
    ya, yb, yc, yd = tl.sum(flow * sa, axis=0), tl.sum(flow * sb, axis=0), tl.sum(flow * sc, axis=0), tl.sum(flow * sd, axis=0)
    one, other = tl.sum(flow * (sa * average + sb * end), axis=0), tl.sum(flow * (sc * average + sd * end), axis=0)
    # Sides: H and J are F (Y (temperatures of the node) − …).
    fa, fb, fc, fd = _inverted(1.0 + ya * ra + yb * rc, ya * rb + yb * rd, yc * ra + yd * rc, 1.0 + yc * rb + yd * rd)
    za, zb, zc, zd = fa * ya + fb * yc, fa * yb + fb * yd, fc * ya + fd * yc, fc * yb + fd * yd
    one, other = fa * one + fb * other, fc * one + fd * other
    # The node.
    whole = 1.0 / (1.0 + 2.0 * sigma)
    of_heat, of_rate = (1.0 + sigma) * whole, -0.5 * whole
    na, nb, nc, nd = _inverted(
        1.0 + inverse * tl.sum(of_heat * za + of_rate * zc, axis=1), inverse * tl.sum(of_heat * zb + of_rate * zd, axis=1),
        inverse * tl.sum(za, axis=1), 1.0 + inverse * tl.sum(zb, axis=1),
    )  # fmt: skip
    right, left = phi + inverse * tl.sum(of_heat * one + of_rate * other, axis=1), phi + inverse * tl.sum(one, axis=1)
    near, last = (na * right + nb * left)[:, None], (nc * right + nd * left)[:, None]
    one, other = za * near + zb * last - one, zc * near + zd * last - other
    near, last = near - (ra * one + rb * other), last - (rc * one + rd * other)
    one_of, other_of = per * (near[None, :, :] - average), per * (last[None, :, :] - end)
    heat, rate = sa * one_of + sb * other_of, sc * one_of + sd * other_of
    heat = per * (near[None, :, :] - (average + a * heat + b * rate))
    return heat, rate, -tl.sum(tl.sum(heat, axis=0) * capacity[None, :], axis=1)


@triton.jit
def _inverted(a, b, c, d):
    """Return the inverse of a matrix of two by two."""
    over = 1.0 / (a * d - b * c)
    return d * over, -b * over, -c * over, a * over
