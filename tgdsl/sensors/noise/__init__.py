"""Sensor noise: one file per stage, the knobs of all (`spec`), and counter-based random numbers (`random`)."""

from tgdsl.sensors.noise.spec import BASE, FORCE, PROBE, PROFILES, TAXEL, Knobs, NoiseField, NoiseSpec, built_in, resolve_noise
from tgdsl.sensors.noise.stages import register

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
