"""The batched noise alone, fed a signal of our choice call by call; layouts for crosstalk; bounds of statistics."""

from tgdsl.report.oracles.setups.signals import (
    KOLMOGOROV,
    MM,
    Noise,
    correlation,
    line,
    make_layout,
    normal_distance,
    one,
    standard_errors,
    uniform_distance,
)

__all__ = [
    "KOLMOGOROV", "MM", "Noise", "correlation", "line", "make_layout", "normal_distance", "one", "standard_errors",
    "uniform_distance",
]  # fmt: skip
