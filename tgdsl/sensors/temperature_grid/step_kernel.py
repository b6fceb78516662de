"""`step` as one Triton kernel, for a GPU in float32 without derivatives: small boxes, and one object of one temperature.

A program takes some whole environments, and computes from the patches' areas to the gains of cells and of the object, the node.
Conduction goes mode by mode, over factors that are computed beforehand: how modes decay is the same in all environments.

Shapes of blocks: `C` cells of a box, `P` pairs of an environment and a row, environment by environment; each a power of two. A
thread has all cells of a pair, or some of them, so that sums over cells stay within threads.
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
from tgdsl.sensors.temperature_grid.patch_flow import least_width

SIGMA, ZERO = tl.constexpr(stefan_boltzmann()), tl.constexpr(zero_celsius())
LEAST = tl.constexpr(least_width())
PI = tl.constexpr(3.141592653589793)
UNROLLED = tl.constexpr(8)  # modes up to which they are written out one by one
MAX_PAIRS = 32  # pairs of a program, where boxes are small: one for each thread of a warp
MAX_NUMBERS = 2048  # numbers of a program's block, unless one environment has more
OF_WARP = 128  # numbers of a block for each warp. Between warps, sums go through shared memory.


@triton_op("tgdsl::heat_step", mutates_args={})
def heat_step(
    state: list[Tensor],
    patches: list[Tensor],
    rows: list[Tensor],
    film: Tensor | None,
    film_radiated: Tensor | None,
    emissivity: Tensor | None,
    source: Tensor | None,
    modes: list[Tensor],
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
        film: Losses of the modes at such faces (row, 3); None if nothing.
        film_radiated: The share of radiation in them (row,).
        emissivity: Of the rows; None if nothing radiates.
        source: Heat source in each cell (row, x, y, z) [W].
        modes: Vectors of the modes along each axis (row, mode, cell), and their sums (row, mode); then what `response.decays`
            returns of the modes of the boxes, four tables (row, mode).
        objects: Heat capacity by volume, volume, area, conductivity and emissivity (env or 1, 1).
        around: Δt and the temperature of the surroundings [°C], scalars.
        convection: Heat transfer coefficient; None if there is none.
    """
    wrapped = wrap_triton(step_kernel)
    return launch(wrapped, state, patches, rows, film, film_radiated, emissivity, source, modes, objects, around, convection)


def launch(
    run: Any,
    state: Sequence[Tensor],
    patches: Sequence[Tensor],
    rows: Sequence[Tensor],
    film: Tensor | None,
    film_radiated: Tensor | None,
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
    dt = around[0]
    gained, nodes_gained = cells.new_empty(cells.shape), nodes.new_empty(nodes.shape)
    got, nodes_got = cells.new_empty((num_envs, 3, num_rows)), cells.new_empty((num_envs, 3, 1))
    pairs, block = block_of(num_rows, x * y * z)
    strides = [part.stride(0) if part.shape[0] > 1 else 0 for part in objects]
    optional = (film, film_radiated, emissivity, source, convection)
    run[(triton.cdiv(num_envs, pairs // num_rows),)](
        cells, nodes, *(part.contiguous() for part in (*patches, *rows, *modes)),
        *(dt if part is None else part.contiguous() for part in optional), *objects, *strides,
        *around, gained, nodes_gained, got, nodes_got, num_envs,
        NX=x, NY=y, NZ=z, ROWS=num_rows, PAIRS=pairs, CELLS=block, HAS_FILM=film is not None, RADIATES=emissivity is not None,
        BLOWS=convection is not None, HAS_SOURCE=source is not None, num_warps=max(1, min(8, pairs * block // OF_WARP)),
    )  # fmt: skip
    return gained, nodes_gained, got, nodes_got


def block_of(num_rows: int, num_cells: int) -> tuple[int, int]:
    """Return how many pairs and cells a block holds."""
    rows, cells = (1 << (number - 1).bit_length() for number in (num_rows, num_cells))
    return max(rows, min(MAX_PAIRS, MAX_NUMBERS // cells)), cells


@triton.jit
def step_kernel(
    cells, nodes, area, series, pos_x, pos_y, pos_z, normal_x, normal_y, normal_z,
    conductivity, heat, cell_volume, boxes, ends_x, ends_y, ends_z,
    modes_x, modes_y, modes_z, totals_x, totals_y, totals_z, zeroth, first, second, third,
    film, film_radiated, emissivity, source, convection,
    node_heat, node_volume, node_area, node_conductivity, node_emissivity,
    heat_env, volume_env, area_env, own_k_env, emissivity_env,
    dt, ambient, gained, nodes_gained, got, nodes_got, num_envs,
    NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr, ROWS: tl.constexpr, PAIRS: tl.constexpr, CELLS: tl.constexpr,
    HAS_FILM: tl.constexpr, RADIATES: tl.constexpr, BLOWS: tl.constexpr, HAS_SOURCE: tl.constexpr,
):  # fmt: skip
    """Make a step of some environments."""
    NUM: tl.constexpr = NX * NY * NZ
    ENVS: tl.constexpr = PAIRS // ROWS
    lane, cell = tl.arange(0, PAIRS), tl.arange(0, CELLS)
    row, begin = lane % ROWS, lane - lane % ROWS
    env = tl.program_id(0).to(tl.int64) * ENVS + lane // ROWS
    is_pair = (lane < ENVS * ROWS) & (env < num_envs)
    pair = tl.program_id(0).to(tl.int64) * (ENVS * ROWS) + lane
    place = (cell // (NY * NZ), (cell // NZ) % NY, cell % NZ)
    step = tl.load(dt)
    # Rows.
    box_x, box_y, box_z = _box(boxes, row, 0), _box(boxes, row, 1), _box(boxes, row, 2)
    k, by_volume, volume = tl.load(conductivity + row), tl.load(heat + row), tl.load(cell_volume + row)
    capacity = by_volume * volume
    over = 1.0 / capacity
    is_cell = (cell < NUM)[:, None] & is_pair[None, :]
    there = (cell < NUM)[:, None] & _is_there(box_x, place[0]) & _is_there(box_y, place[1]) & _is_there(box_z, place[2])
    at_cell = pair[None, :] * NUM + cell[:, None]
    start = tl.load(cells + at_cell, is_cell, 0.0)
    # Patches.
    size = tl.load(area + pair, is_pair, 0.0)
    pos = (_at(pos_x, pair, is_pair), _at(pos_y, pair, is_pair), _at(pos_z, pair, is_pair))
    normal = (_at(normal_x, pair, is_pair), _at(normal_y, pair, is_pair), _at(normal_z, pair, is_pair))
    shares = _conductances(size, pos, normal, k, volume, box_x, box_y, box_z, place, there)
    whole = tl.sum(shares, axis=0)
    # Propagate NaN: minima and maxima drop it.
    rest = 0.0 * (size + pos[0] + pos[1] + pos[2] + normal[0] + normal[1] + normal[2])
    met = whole * (step / (1.0 + whole * _at(series, pair, is_pair))) + rest
    shares *= (1.0 / tl.where(size > 0, whole, 1.0))[None, :]
    # The node.
    phi = tl.load(nodes + env, is_pair, 0.0)
    own_volume = tl.load(node_volume + env * volume_env, is_pair, 1.0)
    inverse = 1.0 / (tl.load(node_heat + env * heat_env, is_pair, 1.0) * own_volume)
    # Losses beyond what modes lose.
    num_there = box_x[2] * box_y[2] * box_z[2]
    around, blowing, linear_share = tl.load(ambient) + ZERO, 0.0, tl.zeros((PAIRS,), tl.float32)
    if BLOWS:
        blowing = tl.load(convection)
    if HAS_FILM:
        linear_share = tl.load(film_radiated + row)
    lost, radiated = tl.zeros((CELLS, PAIRS), tl.float32), tl.zeros((PAIRS,), tl.float32)
    if RADIATES:
        glow = SIGMA * tl.load(emissivity + row)
        faces = (
            _face(ends_x, film, row, place[0], NX, there, box_x[1], k, by_volume, num_there, 0, HAS_FILM),
            _face(ends_y, film, row, place[1], NY, there, box_y[1], k, by_volume, num_there, 1, HAS_FILM),
            _face(ends_z, film, row, place[2], NZ, there, box_z[1], k, by_volume, num_there, 2, HAS_FILM),
        )
        lost, glowing = _lost(start, faces, linear_share, glow, blowing, around, step)
        radiated = tl.sum(glowing, axis=0)
    own_lost, own_radiated = tl.zeros((PAIRS,), tl.float32), tl.zeros((PAIRS,), tl.float32)
    if RADIATES or BLOWS:
        own_glow = tl.zeros((PAIRS,), tl.float32)
        if RADIATES:
            own_glow = SIGMA * tl.load(node_emissivity + env * emissivity_env, is_pair, 0.0)
        own_exposed = tl.load(node_area + env * area_env, is_pair, 0.0) * inverse
        own_k = tl.load(node_conductivity + env * own_k_env, is_pair, 1.0)
        width = tl.exp(tl.log(tl.where(inverse > 0, own_volume, 1.0)) * (1.0 / 3.0))
        own_lost, own_radiated = _lost_by_one(phi, own_exposed, width / (6.0 * own_k), own_glow, blowing, around, step)
    # Without contact: conduction, with linear losses and a source; and what modes show of contact, see `response`.
    generated = tl.zeros((CELLS, PAIRS), tl.float32)
    if HAS_SOURCE:
        generated = tl.load(source + (row[None, :] * NUM + cell[:, None]), there, 0.0) * (step * over)[None, :]
    weight = tl.where(there, (1.0 / num_there)[None, :], 0.0)
    now = start + lost
    mean = tl.sum(now * weight, axis=0)
    apart = now - mean[None, :]
    none = tl.zeros((CELLS, PAIRS), tl.float32)
    average, end = none, none
    entered, nothing = tl.zeros((PAIRS,), tl.float32), tl.zeros((PAIRS,), tl.float32)
    by_cell, by_side = (none, none, none, none), (nothing, nothing, nothing, nothing)
    vectors, totals = (modes_x, modes_y, modes_z), (totals_x, totals_y, totals_z)
    decays = (zeroth, first, second, third)
    if NUM <= UNROLLED:
        for mode in tl.static_range(0, NUM):
            average, end, entered, by_cell, by_side = _without_contact(
                average, end, entered, by_cell, by_side, apart, mean, generated, shares,
                _mode(vectors, totals, decays, mode, row, place, there, NX, NY, NZ), HAS_SOURCE,
            )  # fmt: skip
    else:
        for mode in range(NUM):
            average, end, entered, by_cell, by_side = _without_contact(
                average, end, entered, by_cell, by_side, apart, mean, generated, shares,
                _mode(vectors, totals, decays, mode, row, place, there, NX, NY, NZ), HAS_SOURCE,
            )  # fmt: skip
    # Contact: see `conduction`.
    bodies = inverse * _of_env(met, begin, ROWS, PAIRS)
    sigma = _impulsiveness(by_side[0] * met * over + bodies, by_side[1] * met * over + bodies, met > 0)
    flow, free = shares * met[None, :], (now + (average + 0.5 * generated), now + (end + generated))
    heat_of, rate_of, own_touched = _touched(
        free, phi + own_lost, capacity, inverse, flow, shares, by_cell, by_side, sigma, begin, ROWS, PAIRS
    )
    spread, through = end, entered
    if NUM <= UNROLLED:
        for mode in tl.static_range(0, NUM):
            spread, through = _with_contact(
                spread, through, heat_of, rate_of, sigma, _mode(vectors, totals, decays, mode, row, place, there, NX, NY, NZ)
            )
    else:
        for mode in range(NUM):
            spread, through = _with_contact(
                spread, through, heat_of, rate_of, sigma, _mode(vectors, totals, decays, mode, row, place, there, NX, NY, NZ)
            )
    spread -= (tl.sum(spread, axis=0) - through)[None, :] * weight
    tl.store(gained + at_cell, (lost + heat_of) + (spread + generated), is_cell)
    # Accounts.
    at_row = env * (3 * ROWS) + row
    tl.store(got + at_row, (radiated + through * linear_share) * capacity, is_pair)
    tl.store(got + at_row + ROWS, ((tl.sum(lost, axis=0) - radiated) + through * (1.0 - linear_share)) * capacity, is_pair)
    tl.store(got + at_row + 2 * ROWS, tl.sum(heat_of, axis=0) * capacity, is_pair)
    is_node, is_finite = is_pair & (row == 0), inverse > 0
    own_capacity = tl.where(is_finite, 1.0, 0.0) / tl.where(is_finite, inverse, 1.0)
    tl.store(nodes_gained + env, own_touched * inverse + own_lost, is_node)
    tl.store(nodes_got + 3 * env, own_radiated * own_capacity, is_node)
    tl.store(nodes_got + 3 * env + 1, (own_lost - own_radiated) * own_capacity, is_node)
    tl.store(nodes_got + 3 * env + 2, tl.where(is_finite, own_touched, 0.0), is_node)


@triton.jit
def _sums2(a, b):
    """Return sums over cells (P): one reduction costs the barriers of one sum."""
    return tl.reduce((a, b), 0, _add2)


@triton.jit
def _sums3(a, b, c):
    return tl.reduce((a, b, c), 0, _add3)


@triton.jit
def _add2(a, b, other_a, other_b):
    return a + other_a, b + other_b


@triton.jit
def _add3(a, b, c, other_a, other_b, other_c):
    return a + other_a, b + other_b, c + other_c


@triton.jit
def _at(plane, at, is_there):
    return tl.load(plane + at, is_there, 0.0)


@triton.jit
def _box(boxes, row, AXIS: tl.constexpr):
    at = boxes + 9 * row + AXIS
    return tl.load(at), tl.load(at + 3), tl.load(at + 6)


@triton.jit
def _is_there(box, place):
    return place[:, None].to(tl.float32) < box[2][None, :]


@triton.jit
def _of_env(values, begin, ROWS: tl.constexpr, PAIRS: tl.constexpr):
    """Return the sum over the rows of an environment (P)."""
    total = tl.gather(values, begin, 0)
    for k in tl.static_range(1, ROWS):
        total += tl.gather(values, tl.minimum(begin + k, PAIRS - 1), 0)
    return total


@triton.jit
def _mode(vectors, totals, decays, mode, row, place, there, NX: tl.constexpr, NY: tl.constexpr, NZ: tl.constexpr):
    """Return a mode's values in the cells (C, P), their sum, and φ₀ − 1, φ₁ − 1, φ₂ − ½ and φ₃ − ⅙ of it (P)."""
    x, y, z = row * NX + mode // (NY * NZ), row * NY + (mode // NZ) % NY, row * NZ + mode % NZ
    wave = tl.load(vectors[0] + (x * NX)[None, :] + place[0][:, None], there, 0.0)
    wave *= tl.load(vectors[1] + (y * NY)[None, :] + place[1][:, None], there, 0.0)
    wave *= tl.load(vectors[2] + (z * NZ)[None, :] + place[2][:, None], there, 0.0)
    total, at = tl.load(totals[0] + x) * tl.load(totals[1] + y) * tl.load(totals[2] + z), row * (NX * NY * NZ) + mode
    return wave, total, tl.load(decays[0] + at), tl.load(decays[1] + at), tl.load(decays[2] + at), tl.load(decays[3] + at)


@triton.jit
def _without_contact(average, end, entered, by_cell, by_side, apart, mean, made, shares, mode, HAS_SOURCE: tl.constexpr):
    """Add a mode to what cells gain without contact, in the mean and at the end, and to what all show: see `response`."""
    wave, total, a, b, c, d = mode
    if HAS_SOURCE:
        part, mean_wave, warmed = _sums3(apart * wave, shares * wave, made * wave)
    else:
        part, mean_wave = _sums2(apart * wave, shares * wave)
    part += mean * total
    of_mean, of_end = part * b, part * a
    if HAS_SOURCE:
        of_mean += warmed * c
        of_end += warmed * b
    average += of_mean[None, :] * wave
    end += of_end[None, :] * wave
    entered += of_end * total
    a, b, c, d = a + 1.0, b + 1.0, c + 0.5, d + 1.0 / 6.0
    squared = wave * wave
    mean_wave *= mean_wave
    by_cell = (
        by_cell[0] + squared * a[None, :], by_cell[1] + squared * b[None, :],
        by_cell[2] + squared * c[None, :], by_cell[3] + squared * d[None, :],
    )  # fmt: skip
    by_side = by_side[0] + mean_wave * a, by_side[1] + mean_wave * b, by_side[2] + mean_wave * c, by_side[3] + mean_wave * d
    return average, end, entered, by_cell, by_side


@triton.jit
def _with_contact(spread, through, heat, rate, sigma, mode):
    """Add a mode to what cells gain of contact beyond the heat that they get (C, P), and through faces (P)."""
    wave, total, a, b, c, _ = mode
    _, _, of_heat, of_rate = _response((a, b, c, c), sigma)
    heat_part, rate_part = _sums2(heat * wave, rate * wave)
    along = heat_part * of_heat + rate_part * of_rate
    return spread + along[None, :] * wave, through + along * total


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
def _face(
    ends, film, row, place, NUM: tl.constexpr, there, side, k, heat, num_there, AXIS: tl.constexpr, HAS_FILM: tl.constexpr
):
    """Return exposed area over heat capacity (C, P), resistance, and what modes lose (P), of faces across an axis."""
    ends = tl.load(ends + (row * NUM)[None, :] + place[:, None], there, 0.0)
    exposed = tl.sum(ends, axis=0) / num_there
    lost = tl.zeros_like(side)
    if HAS_FILM:
        lost = tl.load(film + 3 * row + AXIS)
    resistance = side / (2.0 * k) * (1.0 - exposed * (1.0 / 3.0))
    return ends * (1.0 / (heat * side))[None, :], resistance[None, :], lost[None, :]


@triton.jit
def _lost(above, faces, linear_share, glow, blowing, around, step):
    """Return what temperatures above the surroundings gain, and what of it is radiation: see `losses`."""
    x, y, z = faces
    glow, linear_share = glow[None, :], linear_share[None, :]
    total = _radiated(above, glow, around) + blowing
    a, b, c = _open(total, total, total, faces)
    middle = above * tl.exp(-0.5 * step * total * (x[0] * a + y[0] * b + z[0] * c))
    of_x, of_y, of_z = (
        _radiated(middle * a, glow, around),
        _radiated(middle * b, glow, around),
        _radiated(middle * c, glow, around),
    )
    a, b, c = _open(of_x + blowing, of_y + blowing, of_z + blowing, faces)
    rate = x[0] * ((of_x + blowing) * a - x[2]) + y[0] * ((of_y + blowing) * b - y[2]) + z[0] * ((of_z + blowing) * c - z[2])
    glowing = x[0] * (of_x * a - x[2] * linear_share) + y[0] * (of_y * b - y[2] * linear_share)
    return _decayed(above, rate, glowing + z[0] * (of_z * c - z[2] * linear_share), step)


@triton.jit
def _lost_by_one(above, exposed, resistance, glow, blowing, around, step):
    """Return the same of bodies with one face."""
    total = _radiated(above, glow, around) + blowing
    part = 1.0 / (1.0 + total * resistance)
    radiated = _radiated(above * tl.exp(-0.5 * step * total * (exposed * part)) * part, glow, around)
    open_part = exposed / (1.0 + (radiated + blowing) * resistance)
    return _decayed(above, (radiated + blowing) * open_part, radiated * open_part, step)


@triton.jit
def _open(x, y, z, faces):
    """Return 1/(1 + H R) of heat transfer coefficients of faces across each axis."""
    x, y, z = 1.0 + x * faces[0][1], 1.0 + y * faces[1][1], 1.0 + z * faces[2][1]
    both = x * y
    over = 1.0 / (both * z)
    return y * z * over, x * z * over, both * over


@triton.jit
def _decayed(above, rate, glowing, step):
    """Return what temperatures gain at a rate, and what of it is radiation, at its rate."""
    x = -step * rate
    is_near = tl.abs(x) < 0.5
    near, far = tl.where(is_near, x, 0.0), tl.where(is_near, 1.0, x)
    first = 1.0 + near * (1.0 / 8.0)
    for n in tl.static_range(7, 1, -1):
        first = 1.0 + near * (1.0 / n) * first
    gain = above * tl.where(is_near, first, (tl.exp(far) - 1.0) / far)
    return gain * x, gain * (-step * glowing)


@triton.jit
def _radiated(above, glow, around):
    hot = above + around
    return glow * (hot + around) * (hot * hot + around * around)


@triton.jit
def _conductances(size, pos, normal, k, volume, box_x, box_y, box_z, place, there):
    """Return the conductances between patches and cells (C, P) [W/K]: see `patch_flow`."""
    is_any = size > 0
    safe = tl.where(is_any, size, 1e-6)
    edge = 0.5 * tl.sqrt(safe)
    x = _along(pos[0], normal[0], edge, box_x, place[0], (place[1] == 0) & (place[2] == 0))
    y = _along(pos[1], normal[1], edge, box_y, place[1], (place[0] == 0) & (place[2] == 0))
    z = _along(pos[2], normal[2], edge, box_z, place[2], (place[0] == 0) & (place[1] == 0))
    fit = safe * x[3] * y[3] * z[3]
    depth = normal[0] * normal[0] * box_x[1] + normal[1] * normal[1] * box_y[1] + normal[2] * normal[2] * box_z[1]
    radius = tl.sqrt(fit / PI)
    rho = radius * tl.sqrt(depth / volume)
    few = (1.0 - x[4] * (1.0 - x[2])) * (1.0 - y[4] * (1.0 - y[2])) * (1.0 - z[4] * (1.0 - z[2]))
    fitted = 1.0 + 0.75 * rho * (2.0 * few - 1.0) * tl.maximum(1.0 - 2.0 * rho, 0.0)
    cover = tl.where(is_any, 2.0 * k * fit / depth, 0.0)
    spot = tl.where(is_any, 2.0 * k * radius / (1.0 + 0.5 * rho) * fitted, 0.0)
    of_x, of_y, of_z = (spot * x[4])[None, :], (spot * y[4])[None, :], (spot * z[4])[None, :]
    result = x[0] * (y[0] * (cover[None, :] * z[0] + of_z * z[1]) + of_y * y[1] * z[0]) + of_x * x[1] * y[0] * z[0]
    return tl.where(there, result, 0.0)


@triton.jit
def _along(pos, normal, edge, box, place, is_first_of_others):
    """Return shares and edges (C, P), Σ w², the part that is in the box, and 1 − n² (P) along an axis."""
    low, number, scale = box[0], box[2], 1.0 / box[1]
    across = tl.maximum(1.0 - normal * normal, 0.0)
    half = edge * tl.sqrt(across) * scale
    middle = 0.5 * number
    fits = tl.minimum(half, middle)
    within = tl.where(half > 0, fits / tl.where(half > 0, half, 1.0), 1.0)
    width = tl.minimum(tl.maximum(fits, LEAST), middle)
    centre = (pos - low) * scale
    about = tl.minimum(tl.maximum(centre, width), number - width)
    centre = tl.minimum(tl.maximum(centre, fits), number - fits)
    at = (place.to(tl.float32) + 0.5)[:, None]
    top = number - 0.5
    first, last = about - width, about + width
    covered = _below(_inside(last, top)[None, :] - at) - _below(_inside(first, top)[None, :] - at)
    before_first = tl.maximum(0.5 - first, 0.0) - tl.maximum(0.5 - last, 0.0)
    after = tl.maximum(last - top, 0.0) - tl.maximum(first - top, 0.0)
    covered += tl.where(at < 1.0, before_first[None, :], 0.0)
    covered += tl.where(tl.abs(at - top[None, :]) < 0.25, after[None, :], 0.0)
    shares = covered * (0.5 / width)[None, :]
    start, end = centre - fits, centre + fits
    open_start = tl.minimum(tl.maximum(2.0 * start, 0.0), 1.0)[None, :]
    open_end = tl.minimum(tl.maximum(2.0 * (number - end), 0.0), 1.0)[None, :]
    at_start = tl.maximum(1.0 - tl.abs(_inside(start, top)[None, :] - at), 0.0)
    at_end = tl.maximum(1.0 - tl.abs(_inside(end, top)[None, :] - at), 0.0)
    edges = 0.5 * (open_start * at_start + open_end * at_end)
    squared = tl.sum(tl.where(is_first_of_others[:, None], shares * shares, 0.0), axis=0)
    return shares, edges, squared, within, across


@triton.jit
def _inside(point, top):
    return tl.minimum(tl.maximum(point, 0.5), top)


@triton.jit
def _below(offset):
    offset = tl.minimum(tl.maximum(offset, -1.0), 1.0)
    return offset * (1.0 - 0.5 * tl.abs(offset))


@triton.jit
def _touched(
    free, phi, capacity, inverse, flow, shares, by_cell, by_side, sigma, begin, ROWS: tl.constexpr, PAIRS: tl.constexpr
):
    """Return H and J of cells over their capacity (C, P) [K], and the node's heat (P) [J]: see `conduction`."""
    average, end = free
    over = 1.0 / capacity
    a, b, c, d = _response(by_cell, sigma[None, :])
    ra, rb, rc, rd = _response(by_side, sigma)
    squared = shares * shares
    own_a, own_b = _sums2(squared * a, squared * b)
    own_c, own_d = _sums2(squared * c, squared * d)
    ra, rb, rc, rd = (ra - own_a) * over, (rb - own_b) * over, (rc - own_c) * over, (rd - own_d) * over
    # Cells: H and J are f S (temperatures of the node − free).
    per = flow * over[None, :]
    sa, sb, sc, sd = _inverted(1.0 + per * a, per * b, per * c, 1.0 + per * d)
    ya, yb, one = _sums3(flow * sa, flow * sb, flow * (sa * average + sb * end))
    yc, yd, other = _sums3(flow * sc, flow * sd, flow * (sc * average + sd * end))
    # Sides: H and J are F (Y (temperatures of the node) − …).
    fa, fb, fc, fd = _inverted(1.0 + ya * ra + yb * rc, ya * rb + yb * rd, yc * ra + yd * rc, 1.0 + yc * rb + yd * rd)
    za, zb, zc, zd = fa * ya + fb * yc, fa * yb + fb * yd, fc * ya + fd * yc, fc * yb + fd * yd
    one, other = fa * one + fb * other, fc * one + fd * other
    # The node.
    whole = 1.0 / (1.0 + 2.0 * sigma)
    of_heat, of_rate = (1.0 + sigma) * whole, -0.5 * whole
    na, nb, nc, nd = _inverted(
        1.0 + inverse * _of_env(of_heat * za + of_rate * zc, begin, ROWS, PAIRS),
        inverse * _of_env(of_heat * zb + of_rate * zd, begin, ROWS, PAIRS),
        inverse * _of_env(za, begin, ROWS, PAIRS),
        1.0 + inverse * _of_env(zb, begin, ROWS, PAIRS),
    )
    right = phi + inverse * _of_env(of_heat * one + of_rate * other, begin, ROWS, PAIRS)
    left = phi + inverse * _of_env(one, begin, ROWS, PAIRS)
    near, last = na * right + nb * left, nc * right + nd * left
    one, other = za * near + zb * last - one, zc * near + zd * last - other
    near, last = near - (ra * one + rb * other), last - (rc * one + rd * other)
    one_of, other_of = per * (near[None, :] - average), per * (last[None, :] - end)
    heat, rate = sa * one_of + sb * other_of, sc * one_of + sd * other_of
    heat = per * (near[None, :] - (average + a * heat + b * rate))
    return heat, rate, -_of_env(tl.sum(heat, axis=0) * capacity, begin, ROWS, PAIRS)


@triton.jit
def _inverted(a, b, c, d):
    over = 1.0 / (a * d - b * c)
    return d * over, -b * over, -c * over, a * over
