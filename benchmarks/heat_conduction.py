"""Conduction on a CPU: a step of `exact` against the paper's, for `heat.py conduction`."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tgdsl.quantities.patches import modes
from tgdsl.sensors.temperature_grid import diffusion

LINKS, BLOCK = 5, 5
"""Boxes, and calls per timed block."""


class Mirrored(torch.nn.Module):
    """The paper's step: cells are mirrored along each axis, and modes divided by 1 + αΔt|k|²."""

    def __init__(self, rate: Tensor, num: int):
        """Take αΔt/L² of each row, and the number of cells along each axis."""
        super().__init__()
        k, last = (torch.pi * f(2 * num, 1.0 / (2 * num)) for f in (torch.fft.fftfreq, torch.fft.rfftfreq))
        square = k[:, None, None] ** 2 + k[:, None] ** 2 + last**2
        self.divisor, self.num = 1.0 + rate[:, None, None, None] * square, num

    def forward(self, cells: Tensor) -> Tensor:
        """Return the cells after a step."""
        for axis in (2, 3, 4):
            cells = torch.cat([cells, cells.flip(axis)], dim=axis)
        spectrum = torch.fft.rfftn(cells, dim=(2, 3, 4)) / self.divisor
        return torch.fft.irfftn(spectrum, s=cells.shape[2:], dim=(2, 3, 4))[:, :, : self.num, : self.num, : self.num]


class Exact(torch.nn.Module):
    """A step of `exact`, which computes its operators from Δt."""

    def __init__(self, rate: Tensor, num: int):
        """Take αΔt/L² of each row, and the number of cells along each axis."""
        super().__init__()
        count = torch.full((len(rate),), num).numpy()
        self.rate = rate[None] * num**2
        vectors, values = (torch.from_numpy(part).float() for part in modes(count, np.zeros((len(rate), num))))
        totals = torch.zeros_like(values)
        totals[:, 0] = num**0.5
        self.modes = diffusion.Modes(vectors, totals, values)

    def forward(self, cells: Tensor) -> Tensor:
        """Return the cells after a step."""
        return cells + diffusion.spread(cells, [diffusion.along_axis(self.rate, self.modes)] * 3).gained


def timed(numbers: Sequence[int], num_envs: int, repeats: int) -> list[dict[str, Any]]:
    """Return and print the CPU times of alternating steps, a row per number of cells."""
    torch.set_num_threads(1)
    rows = []
    print("cells  mirrored [ms]  exact, eager [ms]  compiled [ms]  ratio, eager  compiled")
    for num in numbers:
        rate = 0.02 * (1.0 + torch.arange(LINKS))
        cells = torch.randn(num_envs, LINKS, num, num, num, generator=torch.Generator().manual_seed(0))
        mirrored, exact = Mirrored(rate, num), Exact(rate, num)
        check(mirrored, exact, cells[:4], rate)
        torch.compiler.reset()
        calls = {"mirrored": mirrored, "eager": exact, "compiled": torch.compile(exact, fullgraph=True)}
        times: dict[str, list[float]] = {name: [] for name in calls}
        with torch.no_grad():
            for i in range(repeats + 2):
                for name, call in calls.items():
                    start = time.thread_time()
                    for _ in range(BLOCK):
                        call(cells)
                    times[name] += [1e3 * (time.thread_time() - start) / BLOCK] if i >= 2 else []
        ms = {name: statistics.median(values) for name, values in times.items()}
        rows.append({"cells": num, "envs": num_envs, **ms, "ratio": ms["mirrored"] / ms["compiled"]})
        ratios = (ms["mirrored"] / ms[name] for name in ("eager", "compiled"))
        print(f"{num}³  " + "  ".join(f"{value:.3f}" for value in ms.values()) + "  " + "  ".join(f"{r:.1f}" for r in ratios))
    return rows


def check(mirrored: Mirrored, exact: Exact, cells: Tensor, rate: Tensor) -> None:
    """Assert that the mirrored step equals `semi_implicit`, and that `exact` conserves the sum."""
    num = mirrored.num
    k = torch.pi * torch.arange(num)
    smooth = (exact.modes._replace(exponent=(k * k).expand(LINKS, -1)),) * 3
    x = rate[:, None, None, None] * diffusion.squared_wavenumbers([torch.ones(LINKS)] * 3, smooth)
    expected = cells + diffusion.semi_implicit(cells, x[None], smooth).gained
    torch.testing.assert_close(mirrored(cells), expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(exact(cells).sum(dim=(2, 3, 4)), cells.sum(dim=(2, 3, 4)), rtol=0, atol=1e-4 * num**1.5)
