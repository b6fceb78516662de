"""The fixed matrices of an elastomer: what each source taxel of a link does to each target, per unit of its input.

On a curved link, the offset of source i and target j is projected to the target's tangent plane,
r_ij = Π_nj(x_j − x_i), exact for every pair, and tangential loads are projected there. The Gaussian kernel is so by
definition. For the elastic kernels it is an approximation that takes the surface between two taxels as flat: it is good where
the normals of interacting taxels differ by little, and it neglects curvature and the far side of a link.

Shapes: `source`, `target` taxels; a matrix is (out, in, target, source), `out` and `in` planes of a vector or scalar.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from tgdsl.sensors.elastomer import bonded_layer, half_space
from tgdsl.sensors.elastomer.bonded_layer import Layer
from tgdsl.sensors.elastomer.half_space import Profiles, patch_radius

Matrix = Float[np.ndarray, "out in target source"]


@dataclass(frozen=True, eq=False)
class LinkTaxels:
    """The taxels of one link, body frame: positions [m], unit normals, areas [m²], grid cells, and which are active."""

    pos: Float[np.ndarray, "taxel 3"]
    normal: Float[np.ndarray, "taxel 3"]
    area: Float[np.ndarray, " taxel"]
    cell: Int[np.ndarray, "taxel 2"]
    is_active: Bool[np.ndarray, " taxel"]

    @property
    def spacing(self) -> float:
        """Root of the mean area of the active taxels [m]; 1 if there are none, for then nothing depends on it."""
        return float(np.sqrt(self.area[self.is_active].mean())) if self.is_active.any() else 1.0


@dataclass(frozen=True)
class Gaussian:
    """The paper's kernels, without their strengths.

    Attributes:
        dilation_falloff: λ_d [1/m²].
        shear_falloff: λ_s [1/m²].
        compressibility: c [1].
        smoothing: ε [m].
        is_normalized: Whether the in-plane part is divided by ḡ.
    """

    dilation_falloff: float
    shear_falloff: float
    compressibility: float
    smoothing: float
    is_normalized: bool

    def spread(
        self, pos: Float[np.ndarray, "target 3"], normal: Float[np.ndarray, "target 3"], source: Float[np.ndarray, "source 3"]
    ) -> Matrix:
        """Return r_ij (c g + (1 − c) ḡ/ρ̄ ρ) [m], (3, 1, target, source); over ḡ [1] if normalized."""
        r = offset(pos, normal, source)
        square = np.einsum("kji,kji->ji", r, r)
        peak = np.exp(-0.5) / np.sqrt(2.0 * self.dilation_falloff)
        local = np.exp(-self.dilation_falloff * square)
        stretch = peak * 2.0 * self.smoothing / (square + self.smoothing**2)
        size = self.compressibility * local + (1.0 - self.compressibility) * stretch
        return (r * (size / peak if self.is_normalized else size))[:, None]

    def bulge(self, targets: LinkTaxels, source: Float[np.ndarray, "source 3"]) -> Matrix:
        """Return g of the dilation, (1, 1, target, source)."""
        return self._fall(self.dilation_falloff, targets, source)

    def drag(self, targets: LinkTaxels, source: Float[np.ndarray, "source 3"]) -> Matrix:
        """Return g of the shear, (1, 1, target, source)."""
        return self._fall(self.shear_falloff, targets, source)

    def _fall(self, falloff: float, targets: LinkTaxels, source: np.ndarray) -> Matrix:
        r = offset(targets.pos, targets.normal, source)
        return np.exp(-falloff * np.einsum("kji,kji->ji", r, r))[None, None]


@dataclass(frozen=True)
class Elastic:
    """A linear elastic taxels.

    Attributes:
        layer: Its thickness [m], infinite for a half-space, the markers' depth [m], G [Pa] and ν.
    """

    layer: Layer

    def profiles(self, r: np.ndarray, area: np.ndarray, mean_area: float, is_exact: bool = False) -> Profiles:
        """Return displacement per force [m/N] at distances r [m], (…, source), from sources of some areas [m²].

        A layer's loads are all spread over the link's mean area, a half-space's each over its own. `is_exact` evaluates a
        layer's integrals at each r instead of interpolating.
        """
        layer = self.layer
        if np.isinf(layer.thickness):
            return half_space.half_space(r, layer.depth, patch_radius(area), layer.shear_modulus, layer.poissons_ratio)
        find = bonded_layer.profiles if is_exact else bonded_layer.tabulated
        return find(r, layer, float(patch_radius(mean_area)))

    def displacement(self, taxels: LinkTaxels, source: Int[np.ndarray, " source"], targets: LinkTaxels | None = None) -> Matrix:
        """Return displacement per traction [m/Pa], (3, 3, target, source), both vectors in the body's frame.

        Args:
            taxels: The taxels of a link, which press.
            source: Which of them to take.
            targets: Markers that move; default: the taxels.
        """
        targets = taxels if targets is None else targets
        n, m = targets.normal, taxels.normal[source]
        area = taxels.area[source]
        r = offset(targets.pos, n, taxels.pos[source])
        length = np.sqrt(np.einsum("kji,kji->ji", r, r))
        e = r / np.where(length > 0, length, 1.0)
        profiles = Profiles(*(part * area for part in self.profiles(length, area, float(taxels.spacing**2))))
        flat = np.eye(3)[:, :, None] - np.einsum("jk,jl->klj", n, n)
        source_plane = np.eye(3)[:, :, None] - np.einsum("ik,il->kli", m, m)
        twist = profiles.along - profiles.bend
        # A tangential traction stays as much as it lies in the target's plane; e lies in it already.
        tangential = np.einsum("kpj,pli,ji->klji", flat, source_plane, twist)
        seen = np.einsum("pji,pli->lji", e, source_plane)
        tangential += np.einsum("kji,lji,ji->klji", e, seen, 2.0 * profiles.bend)
        tangential -= np.einsum("jk,lji,ji->klji", n, seen, profiles.lift)
        pressed = np.einsum("jk,ji->kji", n, profiles.normal) - e * profiles.spread
        return tangential + np.einsum("kji,il->klji", pressed, m)


def offset(
    pos: Float[np.ndarray, "target 3"], normal: Float[np.ndarray, "target 3"], source: Float[np.ndarray, "source 3"]
) -> Float[np.ndarray, "3 target source"]:
    """Return r_ij = Π_nj(x_j − x_i) [m]."""
    between = pos.T[:, :, None] - source.T[:, None, :]
    along = np.einsum("kji,jk->ji", between, normal)
    return between - normal.T[:, :, None] * along
