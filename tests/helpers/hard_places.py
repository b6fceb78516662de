"""Places on and in primitives where the nearest point is not unique."""

from tgdsl.report.hard.places import HALF, HARD, R

__all__ = ["HALF", "HARD", "R"]
