"""Elastomer: displacement of the markers in a soft skin that is pressed and dragged, as a vision-based sensor sees them.

Taxels are both markers and sources, unless `markers` puts the markers elsewhere. Taxels of one link act on each other. n_j is
the normal at x_j and Π_n(z) = z − (z · n) n, so r_ij = Π_nj(x_j − x_i) is the tangential offset. The depth of the sensed
objects o below the skin's height s is h_i = max(0, s − min_o φ_o(x_i)) [m]. t_i is the tangential displacement of the object's
material since the taxel stuck to it [m] (`anchors`). The Gaussian kernel gives

    u_j = Σ_i a_i s_d ( r_ij h_i (c g + (1 − c) ḡ/ρ̄ ρ) + n_j h_i^α g ) + Σ_i a_i s_s Π_nj(t_i) h_i exp(−λ_s |r_ij|²)      [m]
    g = exp(−λ_d |r_ij|²),    ρ = 1/(|r_ij|² + ε²),    ḡ = e^(−1/2)/√(2 λ_d),    ρ̄ = 1/(2 ε),    a_i = A_i/A_ref

with ε [m] the thickness, or without one the taxels' spacing √mean(A). The elastic kernels give

    u_j = Σ_i G(r_ij) [τ_i, p_i] A_i,    p_i = K_n h_i,    τ_i = K_t t_i where h_i > 0

with tractions in [Pa]. G is the displacement at the markers' depth [m/N], in a half-space (`half_space`, K_t = K_n 2
(1 − ν)/(2 − ν)) or in a layer of thickness t bonded to a rigid base (`bonded_layer`, K_t = E/(2 (1 + ν) t), so that the surface
of a layer that is dragged all over moves by the drag). With friction |τ_i| ≤ μ p_i; for the Gaussian the same cap is |t_i| ≤ μ
h_i K_n/K_t. All vectors are in the frame of the taxel's link. Inactive taxels neither press nor move.

With `anchors: points` (Gaussian) the sources of shear are N points on each object, for each link that they may meet
(`point_anchors`). φ is the signed distance to the link, z_p the point's position, e_p its position where it entered the skin,
and A the object's area:

    Σ_p w s_s Π_nj(z_p − e_p) h_p exp(−λ_s |Π_nj(x_j − z_p)|²),    h_p = max(0, s − φ(z_p)),    w = A/(N A_ref)      [m]

Source: Chung et al., *Tactile Genesis*, appendix, "ElastomerTaxel". K_t/K_n of a half-space: Mindlin (Johnson, *Contact
Mechanics*, 7.4); K_t of a layer: simple shear.

Departures: the paper anchors points that are sampled on the object (`anchors: points`, the default under `model: paper`). By
default the taxels anchor themselves, with four numbers per taxel. Shear is then a fixed matrix, and planes and objects of any
size work, but its sources are as sparse as the taxels. Points resolve small features of an object and a patch that leaves the
taxels, with the noise of a random sample. Offsets are exact for each pair, on curved links too. Sums are weighted with areas,
so that they do not grow with the number of taxels or points (`model: paper`: a_i = 1, w = 1). The printed formula divides the
in-plane part by ḡ (`normalize: peak`); the code behind the paper's experiments, like the default here, does not. With the
paper's numbers the printed formula moves markers by some 20 mm at a depth of 1 mm. The clamped boundary is solved on the pad's
outline.

Limits: the skin is linear, and a taxel's load depends on its own depth alone. Without friction an elastic skin sticks to an
object until the object leaves, and its shear then ends at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeAlias

import numpy as np
import torch
from torch import Tensor

from tgdsl.geometry import planes
from tgdsl.geometry.planes import Vec
from tgdsl.layout.layout import Layout
from tgdsl.quantities.base import Gathered
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.points import Points
from tgdsl.sensors.base import (
    Alternative,
    Array,
    Axis,
    Context,
    Kind,
    Lowered,
    Memory,
    State,
    SurfaceOf,
    components,
    scalar,
    vector,
)
from tgdsl.sensors.elastomer import anchors, operators, point_anchors
from tgdsl.sensors.elastomer.operators import Operator, fold_links, operator_of
from tgdsl.sensors.elastomer.point_anchors import Markers
from tgdsl.sensors.elastomer.reference import reference
from tgdsl.sensors.elastomer.spec import ElastomerSpec
from tgdsl.sensors.noise import TAXEL

Operators: TypeAlias = tuple[Operator[Array], ...] | None  # an operator of each link; None if the skin does not need it


@dataclass(frozen=True, eq=False)
class ElastomerConstants(Generic[Array]):
    """Operators, strengths and stiffnesses, see `ElastomerSpec`; None if the skin does not need them."""

    normal: Array  # normals (3, taxel)
    marker_pos: Array | None = None  # positions of the markers (3, marker) [m]; None: taxels are markers
    marker_normal: Array | None = None  # normals of the markers (3, marker)
    spread: Operators[Array] = None
    bulge: Operators[Array] = None
    drag: Operators[Array] = None
    traction: Operators[Array] = None
    pressure: Operators[Array] = None
    dilation_strength: Array | None = None
    depth_exponent: Array | None = None
    normal_stiffness: Array | None = None
    standoff: Array | None = None
    enter: Array | None = None
    exit: Array | None = None
    slip: Array | None = None  # largest tangential displacement per depth [1]
    shear_strength: Array | None = None
    shear_stiffness: Array | None = None  # K_t [Pa/m]
    shear_falloff: Array | None = None
    is_active: Array | None = None  # 1 of taxels that are moved by points, else 0
    reference_area: Array | None = None
    # links whose taxels have one normal, by the first taxel; the values are unused
    flat: Mapping[str, Array] = field(default_factory=dict)

    @classmethod
    def of(cls, **constants: Array) -> ElastomerConstants[Array]:
        """Return constants by their names: `<operator>/<link>/<constant>`, `flat/<first taxel>`, or a field's."""
        fields: dict[str, Any] = {}
        for path, value in constants.items():
            *parents, name = path.split("/")
            of_parent = fields
            for parent in parents:
                of_parent = of_parent.setdefault(parent, {})
            of_parent[name] = value
        operators = {name: value for name, value in fields.items() if isinstance(value, dict) and name != "flat"}
        links = {name: tuple(operator_of(each[str(i)]) for i in range(len(each))) for name, each in operators.items()}
        return cls(**{**fields, **links})


def lower(spec: ElastomerSpec, layout: Layout, surface_of: SurfaceOf) -> Lowered:
    """Fold geometry and material into one operator per link; strengths and stiffnesses stay numbers.

    Raises:
        LowerError: If these links do not allow the operator or the clamped boundary.
    """
    has_shear, on_points, is_elastic = spec.has_shear, spec.anchored == "points", spec.kernel != "gaussian"
    markers = None if spec.markers is None else surface_of.taxels(spec.markers, layout)
    seen, rows = layout, None
    if markers is not None:
        table = {"link": [markers.links[i].name for i in markers.link_id], "pos": markers.pos, "normal": markers.normal}
        seen, rows = markers, Axis("marker", markers.num_taxels, table, markers.link_id)
    constants = ElastomerConstants(
        normal=layout.normal.T,
        marker_pos=None if markers is None else markers.pos.T,
        marker_normal=None if markers is None else markers.normal.T,
        **fold_links(spec, layout, markers, surface_of),
        dilation_strength=None if is_elastic else scalar(spec.dilation_strength),
        depth_exponent=None if is_elastic else scalar(spec.depth_exponent),
        normal_stiffness=None if spec.normal_stiffness is None else scalar(spec.normal_stiffness),
        standoff=scalar(spec.standoff) if has_shear else None,
        enter=scalar(spec.enter) if has_shear else None,
        exit=scalar(spec.exit) if has_shear else None,
        slip=scalar(spec.slip) if has_shear and spec.slip is not None else None,
        shear_strength=scalar(spec.shear_strength) if has_shear and not is_elastic else None,
        shear_stiffness=scalar(spec.shear_stiffness) if has_shear and is_elastic else None,
        shear_falloff=scalar(spec.shear_falloff) if on_points else None,
        is_active=(seen.radius > 0).astype(np.float64) if on_points else None,
        reference_area=scalar(spec.reference_area) if on_points and spec.model != "paper" else None,
        flat={str(first): np.asarray(1) for first in _flat_links(seen)} if on_points else {},
    )
    standoff, max_distance = np.full(layout.num_taxels, spec.standoff), spec.standoff + spec.exit
    depth = ContactDepth(spec.objects, spec.is_gated, radius=standoff)
    state, points = {}, ()
    if spec.anchored == "taxels":
        state = {name: Memory(shape=(layout.num_taxels,)) for name in anchors.PLANES}
        depth = replace(depth, range=max_distance, distance=True, frame=True)
    elif on_points:
        state = {name: Memory(shape=Points, overwritten=True) for name in point_anchors.PLANES}
        depth = replace(depth, range=max_distance)
        points = (Points(spec.objects, spec.is_gated, num_points=spec.points, range=max_distance),)
    requests = (depth, *points)
    return Lowered(vector("displacement", "m"), constants, state, requests=requests, notes=spec.notes, rows=rows)


def _flat_links(layout: Layout) -> list[int]:
    starts = np.flatnonzero(np.diff(layout.link_id, prepend=-1)).tolist()
    ends = [*starts[1:], layout.num_taxels]
    return [first for first, end in zip(starts, ends, strict=True) if (layout.normal[first:end] == layout.normal[first]).all()]


def forward(
    gathered: Gathered, context: Context, constants: ElastomerConstants[Tensor], state: State
) -> tuple[dict[str, Tensor], State]:
    """Return the displacement planes [m] and the new anchors."""
    normal = planes.split(constants.normal.T)
    touch = gathered[ContactDepth]
    shear, loads, after = None, None, {}
    if constants.standoff is not None and constants.enter is not None and constants.exit is not None:
        stick_slip = anchors.StickSlip(constants.standoff, constants.enter, constants.exit, constants.slip)
        if constants.shear_falloff is not None:
            loads, after = point_anchors.SHEAR_LOADS(list(gathered[Points].values()), stick_slip, state)
        else:
            shear, after = anchors.advance(touch, touch.pos, normal, stick_slip, state)
    marker_normal = normal if constants.marker_normal is None else planes.split(constants.marker_normal.T)
    if constants.normal_stiffness is None:
        result = _gaussian(touch.depth, shear, marker_normal, constants)
    else:
        result = _elastic(touch.depth, shear, normal, constants)
    if loads is not None and constants.shear_falloff is not None:
        assert constants.shear_strength is not None and constants.is_active is not None
        flat = frozenset(int(first) for first in constants.flat)
        pos = touch.pos if constants.marker_pos is None else planes.split(constants.marker_pos.T)
        markers = Markers(pos, marker_normal, constants.shear_falloff, constants.reference_area, flat)
        dragged = point_anchors.drag(loads, markers, touch.depth.shape[0])
        result = planes.add(result, planes.scale(constants.shear_strength * constants.is_active, dragged))
    return components("displacement", result), after


def _gaussian(depth: Tensor, shear: Vec | None, normal: Vec, constants: ElastomerConstants[Tensor]) -> Vec:
    strength = constants.dilation_strength
    assert strength is not None and constants.depth_exponent is not None
    assert constants.spread is not None and constants.bulge is not None
    in_plane = planes.vec(operators.apply(constants.spread, [strength * depth]))
    (bulge,) = operators.apply(constants.bulge, [strength * planes.power(depth, constants.depth_exponent)])
    result = planes.add(in_plane, planes.scale(bulge, normal))
    if shear is None:
        return result
    assert constants.shear_strength is not None and constants.drag is not None
    pulled = torch.stack(planes.scale(constants.shear_strength * depth, shear))
    (dragged,) = operators.apply(constants.drag, [pulled])
    along = planes.vec(dragged)
    return planes.add(result, planes.sub(along, planes.scale(planes.dot(along, normal), normal)))


def _elastic(depth: Tensor, shear: Vec | None, normal: Vec, constants: ElastomerConstants[Tensor]) -> Vec:
    assert constants.normal_stiffness is not None
    pressure = constants.normal_stiffness * depth
    if constants.pressure is not None:
        return planes.vec(operators.apply(constants.pressure, [pressure]))
    assert shear is not None and constants.shear_stiffness is not None and constants.traction is not None
    stiffness = torch.where(depth > 0, constants.shear_stiffness, 0.0)
    traction = planes.sub(planes.scale(stiffness, shear), planes.scale(pressure, normal))
    return planes.vec(operators.apply(constants.traction, traction))


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
    alternatives=alternatives,
    constants=ElastomerConstants.of,
)
