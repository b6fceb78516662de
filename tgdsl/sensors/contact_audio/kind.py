"""Contact audio: what bodies sound like that are struck and scraped, as a block of samples per physics step.

Each mode i of a body that rings is a phasor z_i [N·s], which is struck by impulses and decays:

    ż_i = (−d_i + 2πi f_i) z_i + Σ_n u_n δ(t − t_n)                                            [N·s]
    s(t) = Σ_i g_i Im z_i(t)                                                                  [m/s]

with its frequency f [Hz], the decay rate d of its amplitude [1/s], and its gain g [1/kg]. An impulse J at t = 0 alone sounds as
J Σ g e^(−dt) sin(2πft): the pseudo-velocity of the surface, see `modal.modes`. Sample k = 1 … K of a physics step is s at
k Δt/K after its start, so that the rate is K/Δt, and samples at common times are the same for all K.

Five impulses u act in each step:

    u_0 = J, t_0 = 0;   u_n = ξ_n √(m_s W Δt/4), t_n = (n − 1 + j_n/16) Δt/4, n = 1 … 4        [N·s], [s]

with ξ_n ~ N(0, 1) and j_n one of 0 … 15, all alike probable and drawn anew in each step:

- J is the impulse of a collision, over all steps that it takes the solver, once it has been passed on: see `impulses`. It is
  summed over what touches the body.
- The noise is of sliding: W = Σ F |v_t| over the contacts, with the normal force F [N] and the sliding speed v_t [m/s], and
  m_s [kg] the variance of the impulses of one second at 1 N and 1 m/s [N²·s²]. The energy that it brings is a fixed part of
  that of friction, and the level grows by 10 dB with ten times the force or ten times the speed.

`gains: contact` weights what a contact brings by the mode shapes φ_i there: J and W of a contact count for mode i as s_i J and
s_i² W, with its share s_i = φ_i(x) · n / a_i of the centre x of a pair's contacts, the mean n of their normals into the body,
and the root mean square a_i of φ_i along the normal over the surface; see `shares`. So s_i² is 1 in the mean over the surface,
and g_i stays. An impulse is weighted by where its load acted while it grew. What is heard remains a mean over the surface.

`outputs: bands` reads instead, at the end of each step, the mean square of what is heard of the modes in each third octave:

    E_b = ½ Σ_(i in b) g_i² |z_i|²   [m²/s²],   or   10 lg(1 + E_b/E₀), E₀ = (1 µm/s)²   [dB]

A step is one matrix, made in float64 beforehand: exact at any step, without drift. Components of phasors within 1e-12 N·s of
zero are flushed to it.

A microphone hears it at the frames of the bodies that ring, as ρc √(A/4π) s at 1 m [Pa]: what a surface of A = 0.01 m² radiates
that moves with s, at all frequencies alike (Kinsler et al., *Fundamentals of Acoustics*, 7.5).

`model: force`: no impulse is collected; the force F on a body drives each of its modes, a damped oscillator of unit modal mass
whose surface moves with q_i, at every step:

    q̈ + 2d q̇ + (d² + ω²) q = F,   ω = 2πf,   s(t) = Σ_i g_i q̇_i(t)                           [m/s]

q is per g [N·s²], q̇ an impulse [N·s]. The phasor z is the vibration about the deflection that F alone would hold:

    z(t) = ∫ e^(λ(t−t′)) F(t′) dt′ + F(t)/λ,   ż = λz + Ḟ/λ,   λ = −d + iω,   q̇ = Re z − (d/ω) Im z

F is linear within a step, from F₀ at its start, the normal forces of the step before [N], to F₁ at its end, so the integral is
closed for any Δt:

    z(t) = e^(λt) z(0) + (F₁ − F₀)/Δt · (e^(λt) − 1)/λ²,   0 ≤ t ≤ Δt                          [N·s]

A collision short to the mode's period leaves |z| = Σ F Δt, its impulse, whatever Δt and its duration; any other the spectrum of
its force, |∫ F e^(−λt) dt|. A steady force adds nothing, and the first one of an episode counts as steady. F is summed over
what touches the body, with `gains: contact` as s_i F. Noise of sliding is as above. Bands read z, which rings on if the force
stays as it is.

`model: paper`: y[k] = a₁ y[k−1] − a₂ y[k−2] + u[k], a₁ = 2r cos(2πfΔt/K), a₂ = r², r = e^(−dΔt/K), and s = Σ g y, with
u[1] = Δt (F − F_before)₊ and noise at each sample; how loud an impact is then depends on K and Δt.

Source: Chung et al., *Tactile Genesis*, appendix, "Contact and Actuation Audio"; Duhamel's integral of a force that is linear
between samples, Nigam and Jennings, *Bull. Seism. Soc. Am.* 59 (1969); noise by the power of friction as in van den Doel, Kry
and Pai, *FoleyAutomatic* (SIGGRAPH 2001). Departures: the response and the impulses above, see `model: paper`.

Limits: modes are linear and do not see what else the body touches: a hand that holds a glass does not damp it. A load that is
spread over a body's surface strikes at its centre alone; friction strikes along the normal, as pressing does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from tgdsl.errors import LowerError
from tgdsl.geometry import planes
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.kinematics import Places
from tgdsl.quantities.loads import Loads
from tgdsl.sensors.base import Channel, Constants, Context, Kind, Lowered, Memory, State, SurfaceOf, scalar
from tgdsl.sensors.contact_audio.bands import membership, middle
from tgdsl.sensors.contact_audio.impulses import UNKNOWN, impulses, of_rows, rises
from tgdsl.sensors.contact_audio.operators import least, operators, quiet, radiated, turn_of
from tgdsl.sensors.contact_audio.reference import reference
from tgdsl.sensors.contact_audio.rows import axis_of, ringing
from tgdsl.sensors.contact_audio.shares import shares, tables
from tgdsl.sensors.contact_audio.spec import ContactAudioSpec, alternatives
from tgdsl.sensors.noise import random
from tgdsl.sensors.upstream import PLACE, SAMPLES, SOUND
from tgdsl.surfaces.surface import Surface


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
    own = (num_modes,) if modes.shapes else ()
    state = {"phasors": Memory(shape=(rows.size, 2 * num_modes))}
    if spec.model == "force":
        state["load"] = Memory(shape=(rows.size, *own))
    else:
        state["steady"] = Memory(UNKNOWN, pairs)
    if spec.model == "physical":
        state["pending"] = Memory(shape=pairs)
        state |= {"weighted": Memory(shape=(*pairs, *own))} if own else {}
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
        made = torch.bmm(constants["heard"].transpose(1, 2), parts).permute(2, 0, 1)
        for n, (size, slot) in enumerate(grains):
            own = size[..., None] * constants["grain_heard"][n][slot, row]
            made = made + (own.sum(dim=2) if size.ndim == 3 else own)
        made = made.transpose(1, 2)
        return {"signal": made[:, :, None], SAMPLES: radiated() * made, PLACE: torch.stack(gathered[Places], dim=1)}, new
    energy = torch.bmm((after * after).transpose(0, 1), constants["energy"]).permute(1, 2, 0)
    return {"signal": _level(energy) if "is_decibel" in constants else energy}, new


def _turned(phasors: Tensor, drive: Tensor, turn: Tensor, constants: Constants) -> Tensor:
    """Return the phasors at the end of a step without noise, (env, row, part · mode) [N·s].

    By products alone, not of a matrix: matrices may be multiplied in TF32, and phasors would then grow or decay by it.

    Args:
        phasors: Those at its start, real parts first [N·s].
        drive: Impulse [N·s] or rise of the force [N], (env, row); or of each mode, (env, row, mode).
        turn: What is left of each part, and what it has of the other, (2, row, part · mode).
        constants: The sensor's.
    """
    along, across = turn.unbind()
    crossed = phasors.roll(phasors.shape[-1] // 2, dims=-1)
    after = torch.addcmul(phasors * along, crossed, across)
    # Eager, tensors that are alike are multiplied faster than those that broadcast.
    spread = torch.cat([drive, drive], dim=-1) if drive.ndim == 3 else drive[..., None].expand_as(after).contiguous()
    return torch.addcmul(after, spread, constants["driven"])


def _grains(sliding: Tensor, context: Context, constants: Constants) -> list[tuple[Tensor, Tensor]]:
    """Return each impulse of sliding (env, row, *mode) [N·s], and the slot in which it arrives (env, row).

    Args:
        sliding: Its power (env, row, *mode) [W].
        context: The stream that they are drawn from.
        constants: The sensor's.
    """
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
    """Return the level of energies [dB]."""
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
