"""Elastomer: displacement of the markers in a soft skin that is pressed and dragged, as a vision-based sensor sees them.

Taxels are markers and sources alike; those of one link act on each other. With n_j the normal at x_j, Π_n(z) = z − (z · n) n,
r_ij = Π_nj(x_j − x_i), depth h_i = max(0, s − min_o φ_o(x_i)) of the felt objects o under the skin's height s [m], and t_i
the tangential displacement of the object's material since the taxel took hold of it [m] (`anchors`), the Gaussian kernel gives

    u_j = Σ_i a_i s_d ( r_ij h_i (c g + (1 − c) ḡ/ρ̄ ρ) + n_j h_i^α g ) + Σ_i a_i s_s Π_nj(t_i) h_i exp(−λ_s |r_ij|²)      [m]
    g = exp(−λ_d |r_ij|²),    ρ = 1/(|r_ij|² + ε²),    ḡ = e^(−1/2)/√(2 λ_d),    ρ̄ = 1/(2 ε),    a_i = A_i/A_ref

with ε [m] the thickness or else the taxels' spacing √mean(A). The elastic kernels give

    u_j = Σ_i G(r_ij) [τ_i, p_i] A_i,    p_i = K_n h_i,    τ_i = K_t t_i where h_i > 0,    K_t = K_n 2 (1 − ν)/(2 − ν)

with G the displacement [m/N] at the markers' depth in a half-space (`half_space`) or in a layer bonded to a rigid base
(`bonded_layer`), tractions in [Pa]. With friction |τ_i| ≤ μ p_i, and the same cap |t_i| ≤ μ h_i K_n/K_t holds for the Gaussian.
All vectors are in the frame of the taxel's link. Inactive taxels neither press nor move.

Source: Chung et al., *Tactile Genesis*, appendix, "ElastomerTaxel"; K_t/K_n by Mindlin (Johnson, *Contact Mechanics*, 7.4).

Departures: the paper anchors points that are sampled on the object, ours are the taxels' own: four numbers per taxel, any
surface, and shear becomes a fixed matrix too, but its sources are as sparse as the taxels. Offsets are exact for each pair on
curved links. Sums are weighted with the taxels' areas, so that they do not grow with their number (`model: paper`: a_i = 1).
The printed formula divides the in-plane part by ḡ (`normalize: peak`), the code behind the paper's experiments does not
(default): with the paper's numbers 1 mm of depth would move markers by some 20 mm. The clamped boundary is solved on the pad's
own outline. Without friction an elastic skin sticks to what it touches until that leaves, and its shear then ends at once.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.geometry.query import Felt, Probes
from tgdsl.layout import Layout
from tgdsl.sensors.base import Channel, Constants, Kind, Lowered, Memory, State, SurfaceOf, scalar
from tgdsl.sensors.elastomer import anchors, operators
from tgdsl.sensors.elastomer.blocks import fold_links
from tgdsl.sensors.elastomer.reference import reference
from tgdsl.sensors.elastomer.spec import ElastomerSpec

CHANNELS = tuple(Channel(f"displacement_{axis}", "m") for axis in "xyz")


def lower(spec: ElastomerSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold geometry and material into one operator per link; strengths and stiffnesses stay numbers.

    Raises:
        LowerError: If the operator or the clamped boundary cannot be had on these links.
    """
    constants = {**fold_links(spec, layout, surface_of), "normal": layout.normal.T}
    if spec.normal_stiffness is not None:
        constants["normal_stiffness"] = scalar(spec.normal_stiffness)
    else:
        constants |= {"dilation_strength": scalar(spec.dilation_strength), "depth_exponent": scalar(spec.depth_exponent)}
    reach = np.full(layout.num_taxels, spec.standoff)
    if not spec.has_shear:
        return Lowered(CHANNELS, constants, radius=reach)
    constants |= {"standoff": scalar(spec.standoff), "enter": scalar(spec.enter), "exit": scalar(spec.exit)}
    if spec.slip is not None:
        constants["slip"] = scalar(spec.slip)
    if spec.normal_stiffness is not None:
        constants["shear_stiffness"] = scalar(spec.normal_stiffness * spec.stiffness_ratio)
    else:
        constants["shear_strength"] = scalar(spec.shear_strength)
    state = {name: Memory() for name in anchors.PLANES}
    needs = frozenset({"distance", "frame"})
    return Lowered(CHANNELS, constants, state, needs=needs, range=spec.standoff + spec.exit, radius=reach)


def forward(felt: Felt, probes: Probes, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the displacement planes [m] and the new anchors."""
    normal = planes.split(constants["normal"].T)
    shear, after = None, {}
    if "enter" in constants:
        law = anchors.Law(constants["standoff"], constants["enter"], constants["exit"], constants.get("slip"))
        shear, after = anchors.advance(felt, probes.pos, normal, law, state)
    move = _elastic if "normal_stiffness" in constants else _gaussian
    found = move(felt.depth, shear, normal, constants)
    return {channel.name: plane for channel, plane in zip(CHANNELS, found, strict=True)}, after


def _gaussian(depth: Tensor, shear: Vec | None, normal: Vec, constants: Constants) -> Vec:
    strength = constants["dilation_strength"]
    in_plane = planes.vec(operators.apply(constants, "spread", [strength * depth]))
    (bulge,) = operators.apply(constants, "bulge", [strength * _power(depth, constants["depth_exponent"])])
    found = planes.add(in_plane, planes.scale(bulge, normal))
    if shear is None:
        return found
    pulled = torch.stack(planes.scale(constants["shear_strength"] * depth, shear))
    (dragged,) = operators.apply(constants, "drag", [pulled])
    along = planes.vec(dragged)
    return planes.add(found, planes.sub(along, planes.scale(planes.dot(along, normal), normal)))


def _elastic(depth: Tensor, shear: Vec | None, normal: Vec, constants: Constants) -> Vec:
    pressure = constants["normal_stiffness"] * depth
    if shear is None:
        return planes.vec(operators.apply(constants, "pressure", [pressure]))
    stiffness = torch.where(depth > 0, constants["shear_stiffness"], 0.0)
    traction = planes.sub(planes.scale(stiffness, shear), planes.scale(pressure, normal))
    return planes.vec(operators.apply(constants, "traction", traction))


def _power(depth: Tensor, exponent: Tensor) -> Tensor:
    """Return h^α, whose derivative is 0 rather than infinite where h = 0, even for α < 1."""
    is_none = depth <= 0
    return torch.where(is_none, 0.0, torch.where(is_none, 1.0, depth) ** exponent)


ELASTOMER = Kind(ElastomerSpec, lower, forward, reference)
