"""Contact audio: the sound of bodies that are struck and scraped, as a block of samples per physics step.

Each mode i of a ringing body is a phasor z_i [N·s] that impulses excite and that decays:

    ż_i = (−d_i + 2πi f_i) z_i + Σ_n u_n δ(t − t_n)                                            [N·s]
    s(t) = Σ_i g_i Im z_i(t)                                                                  [m/s]

f is its frequency [Hz], d the decay rate of its amplitude [1/s] and g its gain [1/kg]. One impulse J at t = 0 sounds as
J Σ g e^(−dt) sin(2πft), the pseudo-velocity of the surface (see `modal.modes`). Sample k = 1 … K of a physics step is s at
k Δt/K after its start, so the rate is K/Δt, and samples at common times are equal for all K.

Five impulses u act in each step:

    u_0 = J, t_0 = 0;   u_n = ξ_n √(m_s W Δt/4), t_n = (n − 1 + j_n/16) Δt/4, n = 1 … 4        [N·s], [s]

with ξ_n ~ N(0, 1) and j_n uniform in 0 … 15, both drawn at each step:

- J is the impulse of a collision, summed over its steps in the solver and over all that touches the body (see `impulses`).
- The noise is from sliding: W = Σ F |v_t| over the contacts, with the normal force F [N] and the sliding speed v_t [m/s]. m_s
  [kg] is the variance of one second's impulses at 1 N and 1 m/s [N²·s²]. The noise gets a fixed fraction of the friction's
  energy, and its level grows by 10 dB with ten times the force or ten times the speed.

`gains: contact` weights a contact by the mode shapes φ_i there: J and W count for mode i as s_i J and s_i² W, with
s_i = φ_i(x) · n / a_i. x is the centre of a pair's contacts, n the mean of their normals into the body and a_i the root mean
square of φ_i along the normal over the surface (see `shares`). So s_i² has the mean 1 over the surface and g_i is unchanged. An
impulse is weighted by where its load acted while it grew. The reading remains a mean over the surface.

`outputs: bands` reads, at the end of each step, the mean square of the modes in each third octave:

    E_b = ½ Σ_(i in b) g_i² |z_i|²   [m²/s²],   or   10 lg(1 + E_b/E₀), E₀ = (1 µm/s)²   [dB]

A step is one matrix, computed in float64 when the module is built: exact for any step and without drift. Components of phasors
within 1e-12 N·s of zero are flushed to it.

A microphone hears this kind at the frames of the ringing bodies, as ρc √(A/4π) s at 1 m [Pa]. That is the pressure that a
surface of A = 0.01 m² radiates if it moves with s, equal at all frequencies (Kinsler et al., *Fundamentals of Acoustics*, 7.5).

With `model: force` no impulse is collected. The force F on a body drives each mode, a damped oscillator of unit modal mass
whose surface moves with q_i, at every step:

    q̈ + 2d q̇ + (d² + ω²) q = F,   ω = 2πf,   s(t) = Σ_i g_i q̇_i(t)                           [m/s]

q is per g [N·s²] and q̇ an impulse [N·s]. The phasor z is the vibration about the deflection that F alone would hold:

    z(t) = ∫ e^(λ(t−t′)) F(t′) dt′ + F(t)/λ,   ż = λz + Ḟ/λ,   λ = −d + iω,   q̇ = Re z − (d/ω) Im z

F is linear within a step, from F₀ at its start, the normal force of the step before [N], to F₁ at its end. The integral is
then closed for any Δt:

    z(t) = e^(λt) z(0) + (F₁ − F₀)/Δt · (e^(λt) − 1)/λ²,   0 ≤ t ≤ Δt                          [N·s]

A collision that is short compared with the mode's period leaves |z| = Σ F Δt, its impulse, whatever Δt and its duration. Any
other leaves the spectrum of its force, |∫ F e^(−λt) dt|. A steady force adds nothing, and the first force of an episode counts
as steady. F is summed over all that touches the body, with `gains: contact` as s_i F. Sliding noise is as above. Bands read z,
which rings on if the force stays constant.

With `model: paper` y[k] = a₁ y[k−1] − a₂ y[k−2] + u[k], a₁ = 2r cos(2πfΔt/K), a₂ = r², r = e^(−dΔt/K), and s = Σ g y, with
u[1] = Δt (F − F_before)₊ and noise at each sample. The loudness of an impact then depends on K and Δt.

Source: Chung et al., *Tactile Genesis*, appendix, "Contact and Actuation Audio". Duhamel's integral of a force that is linear
between samples: Nigam and Jennings, *Bull. Seism. Soc. Am.* 59 (1969). Noise by the power of friction: van den Doel, Kry and
Pai, *FoleyAutomatic* (SIGGRAPH 2001).

Departures: the response and the impulses; `model: paper` keeps the paper's.

Limits: modes are linear and independent of other contacts: a hand that holds a glass does not damp it. A load that is spread
over a body's surface acts at its centre alone. Friction excites modes along the normal, as pressing does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.modal.modes import ModeShapes
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contacts import Loads
from tgdsl.quantities.kinematics import Places
from tgdsl.sensors.base import Channel, Constants, Context, Kind, Lowered, Memory, State, SurfaceOf, scalar
from tgdsl.sensors.contact_audio.modes import (
    ContactAudioSpec,
    alternatives,
    axis_of,
    least,
    membership,
    middle,
    operators,
    quiet,
    radiated,
    ringing,
    turn_of,
)
from tgdsl.sensors.contact_audio.reference import reference
from tgdsl.sensors.noise import random
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND
from tgdsl.surfaces.surface import Surface

Load = Float[Tensor, "env body object"]
UNKNOWN = 1e30  # steady load at the beginning of an episode [N]: no first load exceeds it, and the second finds the first


def impulses(
    force: Load, constants: Constants, state: State, share: Float[Tensor, "env body object mode"] | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the impulses that strike at the start of this step [N·s], and the next state.

    The solver spreads a collision over one or more steps, depending on its time step and contact stiffness, but a stiff body
    rings from the whole impulse. So the excess of the load F over a steady load F̄ is summed up, and strikes at once when it
    no longer grows:

        A ← κA + (F − F̄)₊ Δt,   F̄ ← F + κ(F̄ − F),   κ = e^(−Δt/τ)                               [N·s], [N]
        J = A, and A ← 0, F̄ ← F, where (F − F̄)₊ Δt ≤ (1 − κ) A                                   [N·s]

    A collision of duration T ≪ τ strikes with its impulse ∫F dt, whatever the number of steps. A load that rises at the rate R
    for much longer than τ strikes with R τ² alone, and a steady load not at all. The first load of an episode counts as steady.

    With mode shapes each mode i has its own A_i, which grows by s_i (F − F̄)₊ Δt and strikes when A does. s_i is the mode's
    share at the load's position, so each part of an impulse is weighted by where the load was when it grew.

    `model: force` collects nothing: its drive is the rise of the force in each step.

    Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `mode` modes.

    Args:
        force: F [N].
        constants: The sensor's.
        state: The memory.
        share: s of each mode; the impulses then have the axes (env, body, object, mode).
    """
    above, decay = force - state["steady"], constants["kept"]
    grown = above.clamp(min=0.0) * constants["step"]
    if "is_paper" in constants:
        return grown if share is None else grown[..., None] * share, {"steady": force}
    pending = state["pending"].clone()  # derivatives by constants look at it once the state has gone on
    is_over = grown <= constants["leaked"] * pending
    impulse = torch.where(is_over, pending, 0.0 * grown)  # not-a-number strikes at once
    after = torch.where(is_over, force, torch.addcmul(force, above, decay, value=-1))
    new = {"pending": torch.where(is_over, 0.0, torch.addcmul(grown, pending, decay)), "steady": after}
    if share is None:
        return impulse, new
    growth, each = grown[..., None] * share, state["weighted"].clone()
    new["weighted"] = torch.where(is_over[..., None], 0.0, torch.addcmul(growth, each, decay))
    return torch.where(is_over[..., None], each, 0.0 * growth), new


def rises(
    force: Load,
    context: Context,
    constants: Constants,
    state: State,
    share: Float[Tensor, "env body object mode"] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return by how much the force on each row rises in this step (env, row, *mode) [N], and the next state.

    Args:
        force: F [N].
        context: When.
        constants: The sensor's.
        state: The memory.
        share: s of each mode.
    """
    load = of_rows(force if share is None else force[..., None] * share, constants)
    is_first = context.is_first.view(-1, *[1] * (load.ndim - 1))
    return load - torch.where(is_first, load, state["load"]), {"load": load}


def of_rows(pairs: Tensor, constants: Constants) -> Tensor:
    """Return the sum over what touches each body (or object) that rings, (env, row, *mode), of (env, body, object, *mode)."""
    dim = 1 if "is_of_object" in constants else 2
    return pairs.squeeze(dim) if pairs.shape[dim] == 1 else pairs.sum(dim=dim)


def tables(shapes: Sequence[ModeShapes], num_modes: int) -> dict[str, np.ndarray]:
    """Return the grids of all rows as constants; grids that are equal are one.

    Args:
        shapes: Mode shapes of each row.
        num_modes: Modes of the row with most.
    """
    most = max(shape.value.shape[2] for shape in shapes)
    offsets: dict[bytes, int] = {}
    blocks: list[np.ndarray] = []
    first, owner = np.zeros(len(shapes), np.int64), np.zeros((len(shapes), most, num_modes))
    for row, shape in enumerate(shapes):
        value = np.zeros((len(shape.value), 3, most), np.float32)
        value[:, :, : shape.value.shape[2]] = shape.value
        key = value.tobytes()
        if key not in offsets:
            offsets[key] = sum(map(len, blocks))
            blocks.append(value.reshape(len(value), -1))
        first[row] = offsets[key]
        owner[row, np.arange(len(shape.owner)), shape.owner] = 1.0
    result = {
        "shape_value": np.concatenate(blocks),
        "shape_first": first,
        "shape_num": np.stack([shape.num for shape in shapes]),
        "shape_axes": np.stack([shape.axes for shape in shapes]),
        "shape_low": np.stack([shape.low for shape in shapes]),
        "shape_rate": np.stack([1.0 / shape.step for shape in shapes]),
    }
    # Without any that are one, field i is mode i.
    return result if (owner.sum(axis=1) <= 1).all() else result | {"shape_owner": owner}


def shares(center: Vec, along: Vec, constants: Constants) -> Float[Tensor, "env body object mode"]:
    """Return each mode's share s, the factor on its gain at a contact; 0 where nothing touches, since `along` is 0 there.

        s_i = Σ_k w_k φ_i(node k) · n,   or √(Σ_f (…)²) over the fields f of modes that symmetry makes one

    with the eight nodes around the centre of a pair's contacts on the grid of the body's mode shapes, trilinear weights w, and
    the mean normal n of the contacts, weighted by their forces, into the body. Both are in the body's frame. Mode shapes φ are
    divided by the root mean square of their normal component, so the mean of s² over the surface is 1. Outside the grid's box
    φ has its value at the box's nearest point.

    Shapes: `env` environments, `body` bodies that carry the sensor, `object` felt objects, `row` ringing bodies or objects,
    `node` nodes of all grids, `mode` modes of the row with most, `field` fields of the row with most.

    Args:
        center: Centre of the contacts, (env, body, object), in the ringing body's frame [m].
        along: Their mean normal.
        constants: The sensor's.
    """
    dim = 0 if "is_of_object" in constants else 1
    first, num, axes, low, rate = (
        constants[f"shape_{name}"].unsqueeze(dim) for name in ("first", "num", "axes", "low", "rate")
    )
    rotation = planes.rot(axes[..., i, j] for i in range(3) for j in range(3))
    pos, turned = planes.rotate(rotation, center), planes.rotate(rotation, along)
    node, weights, last = first, [], num - 1
    for i, part in enumerate(pos):
        at = torch.minimum(((part - low[..., i]) * rate[..., i]).clamp(min=0.0), last[..., i].to(part.dtype))
        cell = torch.minimum(at.to(torch.int64).clamp(min=0), last[..., i] - 1)  # not-a-number is some cell
        weights.append((1.0 - (at - cell), at - cell))
        stride = num[..., 2] * num[..., 1] if i == 0 else num[..., 2] if i == 1 else 1
        node = node + cell * stride
    interpolated = None
    for x, y, z in product(range(2), repeat=3):
        corner = constants["shape_value"][node + (x * num[..., 1] + y) * num[..., 2] + z]
        part = (weights[0][x] * weights[1][y] * weights[2][z])[..., None] * corner
        interpolated = part if interpolated is None else interpolated + part
    assert interpolated is not None
    fields = sum(n[..., None] * component for n, component in zip(turned, interpolated.chunk(3, dim=-1), strict=True))
    assert isinstance(fields, Tensor)
    return _of_modes(fields, constants["shape_owner"].unsqueeze(dim)) if "shape_owner" in constants else fields


def _of_modes(fields: Tensor, owner: Tensor) -> Tensor:
    by_mode = fields[..., None] * owner
    return torch.where(owner.sum(dim=-2) > 1, planes.safe_sqrt((by_mode * by_mode).sum(dim=-2)), by_mode.sum(dim=-2))


def lower(spec: ContactAudioSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """The modes that are heard become the matrices of a step."""
    step = spec.timestep
    if step is None:
        raise LowerError("the time of a physics step is not known", "timestep", "give it, `timestep: 2 ms`")

    def surface(name: str) -> Surface:
        return surface_of(name, ()) if spec.of == "link" else surface_of.of_object(name)

    modes, rows = ringing(spec, layout, step, surface, surface_of.progress), axis_of(spec, layout)
    constants = {
        "frequency": modes.frequency,
        "decay": modes.decay,
        "gain": modes.gain,
        "samples": scalar(float(spec.samples)),
        "settling": scalar(spec.settling),
        "scrape": scalar(spec.scrape),
    }
    constants |= tables(modes.shapes, modes.frequency.shape[1]) if modes.shapes else {}
    constants |= {"is_of_object": scalar(1.0)} if spec.of == "object" else {}
    constants |= {f"is_{spec.model}": scalar(1.0)} if spec.model != "physical" else {}
    channels = (Channel("sound", "m/s"),)
    if spec.outputs == "bands":
        constants["band"] = membership(modes.frequency, modes.bands)
        constants |= {"is_decibel": scalar(1.0)} if spec.scale == "decibel" else {}
        unit = "dB" if spec.scale == "decibel" else "m²/s²"
        channels = tuple(Channel(f"band_{middle(number):.0f}", unit) for number in modes.bands)
    num_modes, pairs = modes.frequency.shape[1], (len(layout.bodies), len(spec.feels))
    per_mode = (num_modes,) if modes.shapes else ()
    state = {"phasors": Memory(shape=(rows.size, 2 * num_modes))}
    if spec.model == "force":
        state["load"] = Memory(shape=(rows.size, *per_mode))
    else:
        state["steady"] = Memory(UNKNOWN, pairs)
    if spec.model == "physical":
        state["pending"] = Memory(shape=pairs)
        state |= {"weighted": Memory(shape=(*pairs, *per_mode))} if per_mode else {}
    is_heard, loads = spec.outputs == "samples", Loads(spec.feels, slots=spec.slots, of=spec.of, has_center=bool(modes.shapes))
    return Lowered(
        channels=channels,
        constants=constants | operators(constants, step),
        state=state,
        requests=(loads, *((_places(spec, layout),) if is_heard else ())),
        rows=rows,
        notes=(f"{spec.samples} samples per step of {step:g} s: {spec.samples / step:g} Hz", *modes.notes),
        substeps=spec.substeps,
        samples=spec.samples if is_heard else 0,
        timestep=step,
        provides=SOUND if is_heard else frozenset(),
        sound=spec.samples if is_heard else 0,
    )


def _places(spec: ContactAudioSpec, layout: Layout) -> Places:
    if spec.of == "object":
        return Places(spec.feels)
    return Places(bodies=layout.bodies, offset=np.zeros((len(layout.bodies), 3)))


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the samples of a step (env, sample, 1, row) [m/s], or the energies of its bands (env, band, row)."""
    loads, share, sliding = gathered[Loads], None, gathered[Loads].sliding
    if loads.center is not None and loads.along is not None and "shape_value" in constants:
        share = shares(loads.center, loads.along, constants)
        sliding = sliding[..., None] * (share * share)
    if "is_force" in constants:
        drive, new = rises(loads.force, context, constants, state, share)
    else:
        impulse, new = impulses(loads.force, constants, state, share)
        drive = of_rows(impulse, constants)
    phasors, turn = state["phasors"], turn_of(constants, context.step[0] + context.substep)
    after, grains = _turned(phasors, drive, turn, constants), []
    if "noise" in constants:
        grains = _grains(of_rows(sliding, constants), context, constants)
    row = torch.arange(phasors.shape[1], device=phasors.device)
    for n, (size, slot) in enumerate(grains):
        both = torch.cat([size, size], dim=-1) if size.ndim == 3 else size[..., None]
        after = torch.addcmul(after, both.expand_as(after), constants["grain_left"][n][slot, row])
    new["phasors"] = after = torch.nn.functional.hardshrink(after, least())
    if "heard" in constants:  # environments last: libraries multiply few rows by many columns faster
        parts = torch.cat([phasors, drive if drive.ndim == 3 else drive[..., None]], dim=-1).permute(1, 2, 0)
        signal = torch.bmm(constants["heard"].transpose(1, 2), parts).permute(2, 0, 1)
        for n, (size, slot) in enumerate(grains):
            grain = size[..., None] * constants["grain_heard"][n][slot, row]
            signal = signal + (grain.sum(dim=2) if size.ndim == 3 else grain)
        signal = signal.transpose(1, 2)
        return {"signal": signal[:, :, None], SAMPLES: radiated() * signal, PLACE: torch.stack(gathered[Places], dim=1)}, new
    energy = torch.bmm((after * after).transpose(0, 1), constants["energy"]).permute(1, 2, 0)
    return {"signal": _level(energy) if "is_decibel" in constants else energy}, new


def _turned(phasors: Tensor, drive: Tensor, turn: Tensor, constants: Constants) -> Tensor:
    """Return the phasors at the end of a step without noise, (env, row, part · mode) [N·s]."""
    # Not a product of matrices: those may be in TF32, and phasors would then grow or decay by it.
    along, across = turn.unbind()
    crossed = phasors.roll(phasors.shape[-1] // 2, dims=-1)
    after = torch.addcmul(phasors * along, crossed, across)
    # Eager multiplication of equal shapes is faster than broadcasting.
    spread = torch.cat([drive, drive], dim=-1) if drive.ndim == 3 else drive[..., None].expand_as(after).contiguous()
    return torch.addcmul(after, spread, constants["driven"])


def _grains(sliding: Tensor, context: Context, constants: Constants) -> list[tuple[Tensor, Tensor]]:
    """Return each impulse of sliding (env, row, *mode) [N·s], and the slot in which it arrives (env, row)."""
    assert context.stream is not None
    rows, (grains, slots) = sliding.shape[1], constants["grain_left"].shape[:2]
    count = (grains + 1) // 2
    index = torch.arange(rows * (count + 1), dtype=torch.int32, device=sliding.device)
    words = random.words(context.stream, index)
    normals = torch.stack(random.normal_pair(words[:, : rows * count], sliding.dtype), dim=-1).view(-1, rows, 2 * count)
    size, last = constants["noise"] * planes.safe_sqrt(sliding), words[:, rows * count :]
    result = []
    for n in range(grains):
        normal = normals[..., n]
        # The paper's have one slot each, whatever is drawn.
        slot = ((last >> (4 * n % 32)) & (slots - 1)).long()
        result.append((size * (normal if size.ndim == 2 else normal[..., None]), slot))
    return result


def _level(energy: Tensor) -> Tensor:
    return 10.0 * torch.log10(1.0 + energy / quiet())


def retimed(constants: Mapping[str, np.ndarray], dt: float) -> Mapping[str, np.ndarray]:
    """Return the matrices of another time step."""
    return operators(constants, dt)


CONTACT_AUDIO = Kind(
    ContactAudioSpec,
    lower,
    forward,
    reference,
    knobs=frozenset(),
    is_timed=True,
    is_random=True,
    retimed=retimed,
    alternatives=alternatives,
    provides=SOUND,
)
