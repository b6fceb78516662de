"""A kind for tests of what hears: a tone of each link, at the place of its frame's origin."""

from tgdsl.report.oracles.setups.tone import TONE

__all__ = ["TONE"]
