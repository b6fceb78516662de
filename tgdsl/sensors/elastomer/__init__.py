"""Elastomer: what its markers do when the skin is pressed and dragged. See `kind`."""

from tgdsl.sensors.elastomer.kind import ELASTOMER
from tgdsl.sensors.elastomer.spec import ElastomerSpec

__all__ = ["ELASTOMER", "ElastomerSpec"]
