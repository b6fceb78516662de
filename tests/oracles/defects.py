"""Findings about the paper's published implementation, and where this package's figure for each is computed.

Each was measured on that implementation (release 1.4.5, on a CPU) or read from its code.
"""

from __future__ import annotations

from typing import Literal, NamedTuple


class Defect(NamedTuple):
    """A finding; `measured` is empty if it was read from the code, `answered_in` names the report with our figure."""

    number: int
    about: str
    measured: str
    answered_in: Literal["oracles", "hard"]


DEFECTS = (
    Defect(1, "forces of taxels follow depth, not load", "24.06 N for 0.245 N and for 2.45 N", "oracles"),
    Defect(2, "no static friction, no friction cone", "−0.04 N for 0.50 N", "oracles"),
    Defect(3, "friction has the opposite sign of the normal force", "−15.2 N for +13.1 N", "oracles"),
    Defect(4, "torque is about the link's origin alone", "", "oracles"),
    Defect(5, "a probe fires before the surfaces meet, if the link touches anywhere", "at 3.5 mm of clearance", "hard"),
    Defect(6, "distance fields end at a tenth of the object's size", "0 beyond 4 mm of a 10 mm radius", "oracles"),
    Defect(7, "boxes, cylinders and capsules are distance grids", "0.44 mm at an edge, normals off by 1.8°", "oracles"),
    Defect(8, "markers of a curved pad are laid on one plane", "1.35 mm for 2.46 mm, normals off by 70°", "oracles"),
    Defect(9, "sums over taxels are not weighted with areas", "grows with the number of taxels", "oracles"),
    Defect(10, "crosstalk loses force at edges and corners", "70 % kept at an edge, 49 % at a corner", "oracles"),
    Defect(11, "radiation and convection lack the exposed area", "100 °C is −19.6 °C after 1 s", "oracles"),
    Defect(12, "the box of cells of a turned link has a negative volume", "at a pitch of 110°", "hard"),
    Defect(13, "conduction between bodies is explicit and unstable", "−184,677 °C in two steps", "hard"),
    Defect(14, "a reset with lag reads 0 °C", "0 °C for 22 °C", "hard"),
    Defect(15, "a point contact's area πδ is a length", "", "oracles"),
    Defect(16, "setters and resets act on all environments", "", "hard"),
    Defect(17, "state of terms that are off", "297 to 730 bytes per taxel for 24 of output", "hard"),
    Defect(18, "a history of readings is copied whole at each call", "", "hard"),
    Defect(19, "noise comes before the delay", "", "oracles"),
    Defect(20, "queries of meshes at run time are along rays", "", "oracles"),
    Defect(21, "hysteresis depends on the step", "", "oracles"),
    Defect(22, "MuJoCo's tactile plate has a wrong tangent frame", "", "hard"),
    Defect(23, "the elastomer's printed formula divides by the kernel's peak", "208.55 times the code's", "oracles"),
    Defect(24, "proximity torque is about the link's origin", "", "oracles"),
    Defect(25, "velocities of the origin and of the centre of mass are mixed up", "9 % of force, 8 mm apart", "oracles"),
)
"""All findings."""
