"""A plate that is pressed and rubbed by a ball as a test says, and what it sounds like."""

from tgdsl.module.module import TactileModule
from tgdsl.report.oracles.setups.sounds import MODES, STEP, plate, plate_document, pressed, ringing, sound

__all__ = ["MODES", "STEP", "energy", "plate", "plate_document", "pressed", "ringing", "sound"]


def energy(touch: TactileModule) -> float:
    """Return Σ |z|² of all modes now [N²·s²]."""
    return float((touch.memory.get_buffer("s:phasors").double() ** 2).sum())
