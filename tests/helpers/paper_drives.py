"""The ranges of drives that the paper randomises (Chung et al., *Tactile Genesis*, appendix, "Domain Randomization")."""

from tgdsl.rl.actuation import DriveSpec

PAPER = DriveSpec(
    gain=(0.95, 1.05),
    damping=(0.95, 1.05),
    strength=(0.95, 1.05),
    bias=(-0.01, 0.01),  # rad, where the paper prints m
    deadband=(0.0, 0.005),
    backlash=(0.0, 0.01),
    kick=(0.9, 1.1),
    torque_noise=0.1,
)
