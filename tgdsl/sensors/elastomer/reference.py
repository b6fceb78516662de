"""The elastomer's definition in float64, target by target: the sums as they are printed, without any folded matrix.

Shapes: `taxel` taxels of the sensor; `source` active taxels of one link.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from tgdsl.layout.layout import Layout
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.points import Points
from tgdsl.quantities.reference import References
from tgdsl.sensors.base import ReferenceContext, ReferenceState
from tgdsl.sensors.elastomer.anchors import StickSlip, advance_reference
from tgdsl.sensors.elastomer.operators import elastic
from tgdsl.sensors.elastomer.point_anchors import reference_drag
from tgdsl.sensors.elastomer.spec import ElastomerSpec

Array = np.ndarray


def reference(
    spec: ElastomerSpec, layout: Layout, gathered: References, context: ReferenceContext, state: ReferenceState
) -> tuple[Float[Array, "taxel 3"], dict[str, Array]]:
    """Return the displacements [m] in the body's frame, without the boundary, and the anchors.

    Raises:
        NotImplementedError: If the edge is clamped or markers are not the taxels: those are matrices, and tested as such.
    """
    if spec.boundary is not None:
        raise NotImplementedError("the reference has no clamped boundary")
    if spec.markers is not None:
        raise NotImplementedError("the reference's markers are its taxels")
    touch = gathered[ContactDepth]
    shear, result, after = np.zeros((layout.num_taxels, 3)), np.zeros((layout.num_taxels, 3)), {}
    stick_slip = StickSlip(spec.standoff, spec.enter, spec.exit, spec.slip)
    if spec.anchored == "taxels":
        shear, after = advance_reference(touch, layout.pos, layout.normal, stick_slip, state)
    elif spec.anchored == "points":
        area = None if spec.model == "paper" else spec.reference_area
        args = layout.pos, layout.normal, stick_slip, spec.shear_falloff, area, state
        drag, after = reference_drag(gathered[Points], *args)
        result = np.where(layout.radius[:, None] > 0, spec.shear_strength * drag, 0.0)
    for link in range(len(layout.links)):
        at = np.flatnonzero((layout.link_id == link) & (layout.radius > 0))
        for j in at:
            sources = _Sources(layout.pos[at], layout.normal[at], layout.area[at], touch.depth[at], shear[at])
            move = _gaussian if spec.kernel == "gaussian" else _elastic
            result[j] += move(spec, layout.pos[j], layout.normal[j], sources)
    return result, after


class _Sources(NamedTuple):
    """The sources of one link: positions [m], normals, areas [m²], depths [m], tangential displacements [m]."""

    pos: Array
    normal: Array
    area: Array
    depth: Array
    shear: Array


def _tangential(vectors: Array, n: Array) -> Array:
    return vectors - np.outer(vectors @ n, n)


def _gaussian(spec: ElastomerSpec, x: Array, n: Array, sources: _Sources) -> Array:
    """Return u_j = Σ_i a_i (u^d_ij + u^s_ij) [m] of the paper's kernels."""
    a = np.ones(len(sources.pos)) if spec.model == "paper" else sources.area / spec.reference_area
    eps = np.sqrt(sources.area.mean()) if spec.thickness is None else spec.thickness
    c, h = spec.compressibility, sources.depth
    r = _tangential(x - sources.pos, n)
    square = (r * r).sum(axis=1)
    g, rho = np.exp(-spec.dilation_falloff * square), 1.0 / (square + eps**2)
    g_peak, rho_peak = np.exp(-0.5) / np.sqrt(2.0 * spec.dilation_falloff), 1.0 / (2.0 * eps)
    w = h * (c * g / g_peak + (1.0 - c) * rho / rho_peak) * (1.0 if spec.normalize == "peak" else g_peak)
    dilation = spec.dilation_strength * (r.T @ (a * w) + n * np.sum(a * h**spec.depth_exponent * g))
    fall = np.exp(-spec.shear_falloff * square)
    return dilation + spec.shear_strength * (_tangential(sources.shear, n).T @ (a * h * fall))


def _elastic(spec: ElastomerSpec, x: Array, n: Array, sources: _Sources) -> Array:
    """Return u_j = Σ_i G(x_j − x_i) [τ_i, p_i] A_i [m], each profile of G evaluated at its own distance."""
    assert spec.normal_stiffness is not None
    material = elastic(spec)
    pressure = spec.normal_stiffness * sources.depth
    stiffness = spec.normal_stiffness * spec.stiffness_ratio
    tau = _tangential(np.where(sources.depth[:, None] > 0, stiffness * sources.shear, 0.0), n)
    r = _tangential(x - sources.pos, n)
    length = np.linalg.norm(r, axis=1)
    e = r / np.where(length > 0, length, 1.0)[:, None]
    g = material.profiles(length, sources.area, float(sources.area.mean()), is_exact=True)
    total = np.zeros(3)
    for i, area in enumerate(sources.area):
        ahead = tau[i] @ e[i]
        into = g.normal[i] * pressure[i] + g.lift[i] * ahead
        along = g.spread[i] * pressure[i] * e[i] + g.along[i] * tau[i] + g.bend[i] * (2.0 * ahead * e[i] - tau[i])
        total += area * (along - into * n)
    return total
