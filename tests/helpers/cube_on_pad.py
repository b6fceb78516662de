"""A pad of 6 × 6 force taxels and a cube of 4 cm on it, in MuJoCo."""

from tgdsl.report.oracles.setups.scenes import FOOTPRINT, LINE, TAXELS, in_link, pad, settled, wrench

__all__ = ["FOOTPRINT", "LINE", "TAXELS", "in_link", "pad", "settled", "wrench"]
