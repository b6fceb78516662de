"""Elastomer: marker displacement under normal load and shear. See `kind`."""

from tgdsl.sensors.elastomer.kind import ELASTOMER
from tgdsl.sensors.elastomer.spec import ElastomerSpec

__all__ = ["ELASTOMER", "ElastomerSpec"]
