"""Scenes at rest that tremble."""

from tgdsl.report.hard.trembling import NUM_STEPS, jittered, repeated

__all__ = ["NUM_STEPS", "jittered", "repeated"]
