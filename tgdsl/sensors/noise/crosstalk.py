"""Crosstalk of the taxels of a link: x_j ← Σ_i W_ji x_i, W_ji = (1 − χ_i) δ_ji + χ_i G_ji, G_ji = K_ji / Σ_k K_ki.

K_ij = exp(−|x_i − x_j|²/2σ²) where the normals are within 90°, else 0. Columns of W add up to 1, so the sum over a link stays
the same, at edges and corners too, on any layout; a blur that is padded with zeros loses half of a force at a corner. Where σ
is a range, G mixes the kernels of its ends with a share that is drawn uniformly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from tgdsl.layout.layout import Layout
from tgdsl.sensors.noise.reference import ReferenceCall
from tgdsl.sensors.noise.reference import Signal as ReferenceSignal
from tgdsl.sensors.noise.stage import NoMemory, Now, Number, Signal, Stage, Table, compact
from tgdsl.tensors.link_products import LINK_PRODUCTS

KERNEL = "kernel/"
"""Kernels of the links, (σ, taxel from, taxel to): `kernel/0000` and so on, in the order of the taxels."""
NEGLIGIBLE = 1e-14
"""Share of a taxel's signal below which it is set to 0: a millionth of float32's last digit. Products with subnormal numbers
are ten times slower."""


class Crosstalk(Stage):
    """Spreads each taxel's signal over its link, a product for each: with W, or with G where χ or σ differ between episodes."""

    name = "crosstalk"
    crosstalk_strength: Annotated[Tensor | None, Number(5, "strength ", knob="crosstalk.strength")]
    """χ; None where it is part of the kernels."""
    crosstalk_sigma: Annotated[None, Number(None, knob="crosstalk.sigma", absent=(1.0, 1.0), neutral=None)]
    """σ, part of the kernels."""
    crosstalk_mixture: Annotated[Tensor | None, Number(6, None, knob=None, neutral=None)]
    """Share of the upper σ's kernel; None where σ is no range."""
    kernels: Sequence[Tensor]
    """Of each link, see `KERNEL`."""

    @classmethod
    def constants(cls, values: Table, layout: Layout) -> dict[str, np.ndarray]:
        """Return each link's W, (σ, from, to); where χ or σ is a range, G of the lower σ, and what the upper one adds."""
        result: dict[str, np.ndarray] = {}
        strength, (low, high) = values["crosstalk_strength"][:, 0], values["crosstalk_sigma"][:, 0]
        is_wider = bool((low != high).any())
        is_drawn = is_wider or bool((strength[0] != strength[1]).any())
        for i in range(len(layout.links)):
            taxels = np.flatnonzero(layout.link_id == i)
            kernel, wider = (crosstalk_kernel(layout.take(taxels), sigma[taxels]) for sigma in (low, high))
            if not is_drawn:
                kernel = np.diag(1 - strength[0, taxels]) + strength[0, taxels] * kernel
            kernels = [kernel, wider - kernel] if is_wider else [kernel]
            result[f"{KERNEL}{i:04d}"] = np.stack(kernels).transpose(0, 2, 1)
        if is_drawn:
            result["crosstalk_strength"] = compact(values["crosstalk_strength"])
        if is_wider:
            result["crosstalk_mixture"] = np.array([0.0, 1.0])[:, None, None]
        return result

    @classmethod
    def of(cls, values: Mapping[str, Tensor]) -> Crosstalk:
        kernels = [values[name] for name in sorted(name for name in values if name.startswith(KERNEL))]
        return cls(values.get("crosstalk_strength"), None, values.get("crosstalk_mixture"), kernels)

    def forward(self, signal: Signal, memory: NoMemory, now: Now) -> tuple[Signal, NoMemory]:
        strength, mixture, kernels = self.crosstalk_strength, self.crosstalk_mixture, self.kernels
        spread = signal if strength is None else signal * strength
        mixed = _product(spread, [kernel[0] for kernel in kernels])
        if mixture is not None:
            mixed = mixed + mixture * _product(spread, [kernel[1] for kernel in kernels])
        return mixed if strength is None else signal - spread + mixed, memory

    @staticmethod
    def reference(signal: ReferenceSignal, call: ReferenceCall, memory: dict[str, Any]) -> ReferenceSignal:
        if "operator" not in memory:
            memory["operator"] = _reference_operator(call)
        return memory["operator"] @ signal


def _product(signal: Signal, kernels: Sequence[Tensor]) -> Signal:
    lines = signal.flatten(0, 1)  # of all environments and channels: one product, not one for each environment
    return LINK_PRODUCTS(lines, [kernel[:, None] for kernel in kernels])[0].view(signal.shape)


def crosstalk_kernel(layout: Layout, sigma: Float[np.ndarray, " taxel"]) -> Float[np.ndarray, "taxel taxel"]:
    """Return G (to, from), each column adding up to 1.

    Args:
        layout: Taxels of one link; inactive ones keep what they have.
        sigma: Standard deviation of each giver's neighbourhood [m].
    """
    apart = layout.pos[:, None] - layout.pos[None]
    weight = np.exp(-np.sum(apart**2, axis=-1) / (2 * sigma[None] ** 2))
    weight *= layout.normal @ layout.normal.T > 0
    is_active = layout.radius > 0
    weight *= is_active[:, None] & is_active[None]
    weight[weight < NEGLIGIBLE] = 0.0
    weight[np.diag_indices(len(weight))] = 1.0
    return weight / weight.sum(axis=0)


def _reference_operator(call: ReferenceCall) -> Float[np.ndarray, "row row"]:
    """Return W (to, from), a sum over pairs of taxels."""
    strength, mixture = call.number("crosstalk_strength")[:, 0], call.share("crosstalk_mixture")
    mixed = np.eye(len(strength))
    for i in np.flatnonzero(strength).tolist():
        low, high = (_reference_column(call.layout, i, sigma) for sigma in call.range_of_row(i, "crosstalk_sigma"))
        mixed[:, i] = (1 - strength[i]) * mixed[:, i] + strength[i] * (low + mixture * (high - low))
    return mixed


def _reference_column(layout: Layout | None, i: int, sigma: float) -> Float[np.ndarray, " row"]:
    """Return the share of taxel i's signal that each taxel gets."""
    assert layout is not None
    kernel = np.zeros(layout.num_taxels)
    for j in range(layout.num_taxels):
        are_active = layout.radius[i] > 0 and layout.radius[j] > 0
        if i == j or (are_active and layout.link_id[i] == layout.link_id[j] and layout.normal[i] @ layout.normal[j] > 0):
            kernel[j] = np.exp(-sum((layout.pos[i] - layout.pos[j]) ** 2) / (2 * sigma**2))
    return kernel / kernel.sum()
