"""Elastomer: displacement of the markers in a soft skin that is pressed and dragged, as a vision-based sensor sees them.

Taxels are markers and sources alike, unless `markers` are given, at places of their own; those of one link act on each other.
With n_j the normal at x_j, Π_n(z) = z − (z · n) n,
r_ij = Π_nj(x_j − x_i), depth h_i = max(0, s − min_o φ_o(x_i)) of the felt objects o under the skin's height s [m], and t_i
the tangential displacement of the object's material since the taxel stuck to it [m] (`anchors`), the Gaussian kernel gives

    u_j = Σ_i a_i s_d ( r_ij h_i (c g + (1 − c) ḡ/ρ̄ ρ) + n_j h_i^α g ) + Σ_i a_i s_s Π_nj(t_i) h_i exp(−λ_s |r_ij|²)      [m]
    g = exp(−λ_d |r_ij|²),    ρ = 1/(|r_ij|² + ε²),    ḡ = e^(−1/2)/√(2 λ_d),    ρ̄ = 1/(2 ε),    a_i = A_i/A_ref

with ε [m] the thickness or else the taxels' spacing √mean(A). The elastic kernels give

    u_j = Σ_i G(r_ij) [τ_i, p_i] A_i,    p_i = K_n h_i,    τ_i = K_t t_i where h_i > 0

with G the displacement [m/N] at the markers' depth in a half-space (`half_space`, K_t = K_n 2 (1 − ν)/(2 − ν)) or in a layer
of thickness t bonded to a rigid base (`bonded_layer`, K_t = E/(2 (1 + ν) t): dragged all over, its surface moves by the drag),
tractions in [Pa]. With friction |τ_i| ≤ μ p_i, and the same cap |t_i| ≤ μ h_i K_n/K_t holds for the Gaussian.
All vectors are in the frame of the taxel's link. Inactive taxels neither press nor move.

With `anchors: points` (Gaussian) the shear's sources are N points on each object, for each link that they may meet
(`point_anchors`): φ is the signed distance to the link, z_p its place, e_p that where it sank in, A the object's area,

    Σ_p w s_s Π_nj(z_p − e_p) h_p exp(−λ_s |Π_nj(x_j − z_p)|²),    h_p = max(0, s − φ(z_p)),    w = A/(N A_ref)      [m]

Source: Chung et al., *Tactile Genesis*, appendix, "ElastomerTaxel"; K_t/K_n of a half-space by Mindlin (Johnson, *Contact
Mechanics*, 7.4), K_t of a layer by simple shear.

Departures: the paper anchors points that are sampled on the object (`anchors: points`, the default under `model: paper`); by
default anchors are the taxels' own: four numbers per taxel instead of four per point and link, planes and objects of any size
too, and shear becomes a fixed matrix, but its sources are as sparse as the taxels. Points follow an object's small features and
a patch that leaves the taxels behind, with the noise of a random sample. Offsets are exact for each pair on curved links. Sums
are weighted with areas, so that they do not grow with the number of taxels or points (`model: paper`: a_i = 1, w = 1).
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
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.points import Points
from tgdsl.sensors.base import Alternative, Axis, Channel, Constants, Context, Kind, Lowered, Memory, State, SurfaceOf, scalar
from tgdsl.sensors.elastomer import anchors, operators, point_anchors
from tgdsl.sensors.elastomer.blocks import fold_links
from tgdsl.sensors.elastomer.point_anchors import Markers
from tgdsl.sensors.elastomer.reference import reference
from tgdsl.sensors.elastomer.spec import ElastomerSpec
from tgdsl.sensors.noise import TAXEL

FLAT = "flat/"
"""Constants `flat/<first taxel>`: links whose taxels have one normal. That they are there is all they say."""
CHANNELS = tuple(Channel(f"displacement_{axis}", "m") for axis in "xyz")


def lower(spec: ElastomerSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold geometry and material into one operator per link; strengths and stiffnesses stay numbers.

    Raises:
        LowerError: If the operator or the clamped boundary cannot be had on these links.
    """
    markers = None if spec.markers is None else surface_of.taxels(spec.markers, layout)
    constants = {**fold_links(spec, layout, markers, surface_of), "normal": layout.normal.T}
    rows = None
    if markers is not None:
        constants |= {"marker_pos": markers.pos.T, "marker_normal": markers.normal.T}
        table = {"link": [markers.links[i].name for i in markers.link_id], "pos": markers.pos, "normal": markers.normal}
        rows = Axis("marker", markers.num_taxels, table, markers.link_id)
    if spec.normal_stiffness is not None:
        constants["normal_stiffness"] = scalar(spec.normal_stiffness)
    else:
        constants |= {"dilation_strength": scalar(spec.dilation_strength), "depth_exponent": scalar(spec.depth_exponent)}
    standoff = np.full(layout.num_taxels, spec.standoff)
    if spec.anchored is None:
        depth = ContactDepth(spec.objects, spec.is_gated, radius=standoff)
        return Lowered(CHANNELS, constants, requests=(depth,), notes=spec.notes, rows=rows)
    constants |= {"standoff": scalar(spec.standoff), "enter": scalar(spec.enter), "exit": scalar(spec.exit)}
    if spec.slip is not None:
        constants["slip"] = scalar(spec.slip)
    if spec.normal_stiffness is not None:
        constants["shear_stiffness"] = scalar(spec.normal_stiffness * spec.stiffness_ratio)
    else:
        constants["shear_strength"] = scalar(spec.shear_strength)
    max_distance = spec.standoff + spec.exit
    if spec.anchored == "taxels":
        state = {name: Memory(shape=(layout.num_taxels,)) for name in anchors.PLANES}
        depth = ContactDepth(spec.objects, spec.is_gated, radius=standoff, range=max_distance, distance=True, frame=True)
        return Lowered(CHANNELS, constants, state, requests=(depth,), notes=spec.notes, rows=rows)
    seen = layout if markers is None else markers
    constants |= {"shear_falloff": scalar(spec.shear_falloff), "is_active": (seen.radius > 0).astype(np.float64)}
    constants |= {f"{FLAT}{first}": np.asarray(1) for first in _flat_links(seen)}
    if spec.model != "paper":
        constants["reference_area"] = scalar(spec.reference_area)
    state = {name: Memory(shape=Points, overwritten=True) for name in point_anchors.PLANES}
    depth = ContactDepth(spec.objects, spec.is_gated, radius=standoff, range=max_distance)
    points = Points(spec.objects, spec.is_gated, num_points=spec.points, range=max_distance)
    return Lowered(CHANNELS, constants, state, requests=(depth, points), notes=spec.notes, rows=rows)


def _flat_links(layout: Layout) -> list[int]:
    """Return the first taxel of each link all of whose taxels have the same normal."""
    starts = np.flatnonzero(np.diff(layout.link_id, prepend=-1)).tolist()
    ends = [*starts[1:], layout.num_taxels]
    return [first for first, end in zip(starts, ends, strict=True) if (layout.normal[first:end] == layout.normal[first]).all()]


def forward(gathered: Gathered, context: Context, constants: Constants, state: State) -> tuple[dict[str, Tensor], State]:
    """Return the displacement planes [m] and the new anchors."""
    normal = planes.split(constants["normal"].T)
    felt = gathered[ContactDepth]
    shear, loads, after = None, None, {}
    if "enter" in constants:
        stick_slip = anchors.StickSlip(constants["standoff"], constants["enter"], constants["exit"], constants.get("slip"))
        if "shear_falloff" in constants:
            loads, after = point_anchors.SHEAR_LOADS(list(gathered[Points].values()), stick_slip, state)
        else:
            shear, after = anchors.advance(felt, felt.pos, normal, stick_slip, state)
    marker_normal = planes.split(constants["marker_normal"].T) if "marker_normal" in constants else normal
    if "normal_stiffness" in constants:
        result = _elastic(felt.depth, shear, normal, constants)
    else:
        result = _gaussian(felt.depth, shear, marker_normal, constants)
    if loads is not None:
        flat = frozenset(int(name.removeprefix(FLAT)) for name in constants if name.startswith(FLAT))
        pos = planes.split(constants["marker_pos"].T) if "marker_pos" in constants else felt.pos
        markers = Markers(pos, marker_normal, constants["shear_falloff"], constants.get("reference_area"), flat)
        dragged = point_anchors.drag(loads, markers, felt.depth.shape[0])
        result = planes.add(result, planes.scale(constants["shear_strength"] * constants["is_active"], dragged))
    return {channel.name: plane for channel, plane in zip(CHANNELS, result, strict=True)}, after


def _gaussian(depth: Tensor, shear: Vec | None, normal: Vec, constants: Constants) -> Vec:
    strength = constants["dilation_strength"]
    in_plane = planes.vec(operators.apply(constants, "spread", [strength * depth]))
    (bulge,) = operators.apply(constants, "bulge", [strength * planes.power(depth, constants["depth_exponent"])])
    result = planes.add(in_plane, planes.scale(bulge, normal))
    if shear is None:
        return result
    pulled = torch.stack(planes.scale(constants["shear_strength"] * depth, shear))
    (dragged,) = operators.apply(constants, "drag", [pulled])
    along = planes.vec(dragged)
    return planes.add(result, planes.sub(along, planes.scale(planes.dot(along, normal), normal)))


def _elastic(depth: Tensor, shear: Vec | None, normal: Vec, constants: Constants) -> Vec:
    pressure = constants["normal_stiffness"] * depth
    if shear is None:
        return planes.vec(operators.apply(constants, "pressure", [pressure]))
    stiffness = torch.where(depth > 0, constants["shear_stiffness"], 0.0)
    traction = planes.sub(planes.scale(stiffness, shear), planes.scale(pressure, normal))
    return planes.vec(operators.apply(constants, "traction", traction))


def alternatives(spec: ElastomerSpec) -> list[Alternative]:
    """Return the forms of the operator; with anchors of points, fewer points or more."""
    forms = [Alternative(f"svd, {100 * error:g} %", {"operator": "svd", "tolerance": error}) for error in (0.1, 1e-2, 1e-3)]
    exact_forms = ("dense",) if spec.markers is not None else ("fft", "dense")
    forms += [Alternative(form, {"operator": form, "tolerance": None}, is_exact=True) for form in exact_forms]
    if spec.anchored != "points":
        return forms
    exact = {"operator": "dense", "tolerance": None}
    return forms[:-1] + [Alternative(f"{num} points", {**exact, "points": num}) for num in (250, 1000, 4000)]


ELASTOMER = Kind(
    ElastomerSpec,
    lower,
    forward,
    reference,
    knobs=TAXEL,
    gains_depth=True,
    indices=lambda found, _: operators.indices(found),
    alternatives=alternatives,
)
