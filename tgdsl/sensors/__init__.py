"""Sensor kinds, one file each: equation, spec, float64 reference, batched forward."""

from __future__ import annotations

from tgdsl.sensors.actuation_audio import ACTUATION_AUDIO
from tgdsl.sensors.base import Kind
from tgdsl.sensors.contact import CONTACT
from tgdsl.sensors.contact_audio.kind import CONTACT_AUDIO
from tgdsl.sensors.contact_depth import CONTACT_DEPTH
from tgdsl.sensors.elastomer import ELASTOMER
from tgdsl.sensors.force_taxel.kind import FORCE_TAXEL
from tgdsl.sensors.kinematic_taxel import KINEMATIC_TAXEL
from tgdsl.sensors.link_contact import LINK_CONTACT
from tgdsl.sensors.microphone import MICROPHONE
from tgdsl.sensors.proximity import PROXIMITY
from tgdsl.sensors.surface_distance import SURFACE_DISTANCE
from tgdsl.sensors.temperature_grid.kind import TEMPERATURE_GRID

KINDS: tuple[Kind, ...] = (
    CONTACT_DEPTH,
    CONTACT,
    KINEMATIC_TAXEL,
    SURFACE_DISTANCE,
    PROXIMITY,
    ELASTOMER,
    FORCE_TAXEL,
    LINK_CONTACT,
    TEMPERATURE_GRID,
    CONTACT_AUDIO,
    ACTUATION_AUDIO,
    MICROPHONE,
)
"""The kinds that come with tgdsl."""


__all__ = [
    "ACTUATION_AUDIO",
    "CONTACT",
    "CONTACT_AUDIO",
    "CONTACT_DEPTH",
    "ELASTOMER",
    "FORCE_TAXEL",
    "KINDS",
    "KINEMATIC_TAXEL",
    "LINK_CONTACT",
    "MICROPHONE",
    "PROXIMITY",
    "SURFACE_DISTANCE",
    "TEMPERATURE_GRID",
    "Kind",
]
