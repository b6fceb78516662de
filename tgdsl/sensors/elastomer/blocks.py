"""A sensor's matrices, link by link: the kernels that its spec names, weighted, and with the edge of the pad clamped.

Shapes: `taxel` taxels of one link, inactive ones among them: those neither press nor move.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tgdsl.errors import LowerError
from tgdsl.layout.layout import Layout
from tgdsl.sensors.base import SurfaceOf
from tgdsl.sensors.elastomer.bonded_layer import Layer
from tgdsl.sensors.elastomer.kernels import Elastic, Gaussian, LinkTaxels
from tgdsl.sensors.elastomer.operators import Operator, OperatorForm, Response, fold
from tgdsl.sensors.elastomer.spec import ElastomerSpec
from tgdsl.surfaces.surface import Surface

PLANES = {"spread": (3, 1), "bulge": (1, 1), "drag": (1, 1), "traction": (3, 3), "pressure": (3, 1)}
"""Planes that each operator puts out and takes in."""


def link_taxels(layout: Layout, link: int) -> LinkTaxels:
    """Return the taxels of one link; inactive ones, whose area may be nothing, get the others' mean."""
    at = layout.link_id == link
    is_active, area = layout.radius[at] > 0, layout.area[at]
    mean = area[is_active].mean() if is_active.any() else 1.0
    return LinkTaxels(layout.pos[at], layout.normal[at], np.where(is_active, area, mean), layout.cell[at], is_active)


def gaussian(spec: ElastomerSpec, part: LinkTaxels) -> Gaussian:
    """Return the paper's kernels for one link."""
    smoothing = part.spacing if spec.thickness is None else spec.thickness
    return Gaussian(spec.dilation_falloff, spec.shear_falloff, spec.compressibility, smoothing, spec.normalize == "peak")


def elastic(spec: ElastomerSpec) -> Elastic:
    """Return the elastic skin that a spec describes."""
    assert spec.youngs_modulus is not None
    thickness = np.inf if spec.kernel == "half_space" or spec.thickness is None else spec.thickness
    modulus = spec.youngs_modulus / (2.0 * (1.0 + spec.poissons_ratio))
    return Elastic(Layer(thickness, spec.marker_depth, modulus, spec.poissons_ratio))


def weights(spec: ElastomerSpec, part: LinkTaxels) -> Float[np.ndarray, " taxel"]:
    """Return a_i of the Gaussian kernel [1]; 0 for inactive taxels."""
    area = np.ones(len(part.area)) if spec.model == "paper" else part.area / spec.reference_area
    return np.where(part.is_active, area, 0.0)


def fold_links(
    spec: ElastomerSpec, layout: Layout, markers: Layout | None, surface_of: SurfaceOf
) -> dict[str, tuple[Operator[np.ndarray], ...]]:
    """Return the operators of all links by name, from taxels to markers; None: taxels are markers.

    Raises:
        LowerError: If a convolution is asked for where it cannot be, or the pad's edge cannot be clamped.
    """
    of_links = []
    for i, link in enumerate(layout.links):
        try:
            of_links.append(_fold_link(spec, layout, markers, i, surface_of))
        except LowerError as error:
            field = error.field or "boundary"  # what a surface says knows no field
            raise LowerError(f'link "{link.name}": {error.what}', field, error.hint) from error
    return {name: tuple(operators[name] for operators in of_links) for name in of_links[0]}


def _fold_link(
    spec: ElastomerSpec, layout: Layout, markers: Layout | None, link: int, surface_of: SurfaceOf
) -> dict[str, Operator[np.ndarray]]:
    part, targets = link_taxels(layout, link), None if markers is None else link_taxels(markers, link)
    pad = None if spec.boundary is None else surface_of(layout.links[link].name, spec.boundary.pad)
    form = OperatorForm(spec.operator, spec.tolerance)
    return {
        name: fold(response, PLANES[name], part, form, is_alike=targets is None and (pad is None or name != "spread"))
        for name, response in responses(spec, part, pad, targets).items()
    }


def responses(
    spec: ElastomerSpec, part: LinkTaxels, pad: Surface | None, targets: LinkTaxels | None = None
) -> dict[str, Response]:
    """Return the operators of one link by name, from its taxels to its markers; by default the same."""
    targets = part if targets is None else targets
    is_active = targets.is_active.astype(np.float64)[:, None]
    if spec.kernel != "gaussian":
        return _elastic_responses(spec, part, targets, is_active)
    kernel, weight = gaussian(spec, part), weights(spec, part)
    clamped = None
    if pad is not None:
        clamped = kernel.spread(part.pos, part.normal, part.pos) + clamping(spec, part, pad)

    def spread(source: np.ndarray) -> np.ndarray:
        response = kernel.spread(targets.pos, targets.normal, part.pos[source]) if clamped is None else clamped[..., source]
        return is_active * response * weight[source]

    def bulge(source: np.ndarray) -> np.ndarray:
        return is_active * kernel.bulge(targets, part.pos[source]) * weight[source]

    def drag(source: np.ndarray) -> np.ndarray:
        return is_active * kernel.drag(targets, part.pos[source]) * weight[source]

    return {"spread": spread, "bulge": bulge, **({"drag": drag} if spec.anchored == "taxels" else {})}


def _elastic_responses(
    spec: ElastomerSpec, part: LinkTaxels, targets: LinkTaxels, is_active: Float[np.ndarray, "target 1"]
) -> dict[str, Response]:
    material = elastic(spec)

    def traction(source: np.ndarray) -> np.ndarray:
        return is_active * material.displacement(part, source, targets) * part.is_active[source]

    def pressure(source: np.ndarray) -> np.ndarray:
        return -np.einsum("klji,il->kji", traction(source), part.normal[source])[:, None]

    return {"traction": traction} if spec.has_shear else {"pressure": pressure}


def clamping(spec: ElastomerSpec, part: LinkTaxels, pad: Surface) -> Float[np.ndarray, "3 1 target source"]:
    """Return what clamping the pad's edge adds to `spread`: the edge is moved back by as much as it would move."""
    # Here, so that only who clamps a pad waits for scikit-fem, and a compiled module runs without it.
    from tgdsl.sensors.elastomer.clamped.boundary import correction, element_size
    from tgdsl.sensors.elastomer.clamped.pad import unroll

    assert spec.boundary is not None and spec.thickness is not None
    added = np.zeros((3, 1, len(part.pos), len(part.pos)))
    if not part.is_active.any():
        return added
    active, drag = np.flatnonzero(part.is_active), spec.boundary.drag
    extent = float(np.ptp(pad.corners.reshape(-1, 3), axis=0).max())
    sheet = unroll(pad, part.pos[active], part.normal[active], element_size(spec.thickness, drag, extent))
    free = gaussian(spec, part).spread(sheet.edge_pos, sheet.edge_normal, part.pos)[:, 0]
    back = -np.einsum("eak,kei->aei", sheet.edge_axes, free).reshape(-1, len(part.pos))
    inside = (correction(sheet, spec.thickness, drag, spec.boundary.bulk) @ back).reshape(2, len(active), -1)
    added[:, 0, active] = np.einsum("jak,aji->kji", sheet.taxel_axes, inside)
    return added
