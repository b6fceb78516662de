"""How much a struck plate still rings."""

from tgdsl.module.module import TactileModule


def energy(touch: TactileModule) -> float:
    """Return Σ |z|² of all modes now [N²·s²]."""
    return float((touch.memory.get_buffer("s:phasors").double() ** 2).sum())
