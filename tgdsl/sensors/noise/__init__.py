"""Sensor noise: its stages, the knobs of all (`spec`), and counter-based random numbers (`random`)."""

from tgdsl.sensors.noise.pipeline import register
from tgdsl.sensors.noise.profiles import PROFILES, Knobs, NoiseField, NoiseSpec, built_in, resolve_noise
from tgdsl.sensors.noise.stages import BASE, FORCE, PROBE, TAXEL

__all__ = [
    "BASE",
    "FORCE",
    "PROBE",
    "PROFILES",
    "TAXEL",
    "Knobs",
    "NoiseField",
    "NoiseSpec",
    "built_in",
    "register",
    "resolve_noise",
]
