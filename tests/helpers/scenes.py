"""A probe-bearing pad and one object of a given shape, for closed-form cases."""

from tgdsl.report.oracles.setups.scenes import module, state

__all__ = ["module", "state"]
