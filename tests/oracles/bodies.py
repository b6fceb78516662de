"""What whole bodies and single bits read: the weight on a link, and a contact's threshold and release."""

from __future__ import annotations

import numpy as np

from oracles.forces import AT_REST, AXES, MASS, G
from oracles.results import Comparison, Oracle, along, array, cases
from oracles.setups.scenes import folder, pad, probed, settled, state


def link_weight() -> Comparison:
    """Return the solver's net force on a pad that carries a cube, in the pad's frame."""
    with folder() as where:
        touch = pad(where, kind="link_contact", outputs=["force"])
        found = touch(settled(touch))["s"][0, 0].numpy()
    return Comparison(
        "A link feels the weight of what rests on it",
        "balance of forces",
        "f = −m g",
        ("link_contact",),
        "force",
        "N",
        cases(AXES),
        array([0, 0, -MASS * G]),
        found,
        atol=AT_REST,
        defects=(1,),
    )


def threshold() -> Comparison:
    """Return the bit of a probe that is pressed and let go: on above the threshold, off below the release threshold."""
    depths = np.array([0.0, 0.4, 0.6, 0.4, 0.21, 0.19, 0.4, 0.51, 0.0])
    ball = '<geom type="sphere" size=".02"/>'
    touch = probed([(0, 0, 0)], ball, kind="contact", threshold="0.5 mm", release_threshold="0.2 mm")
    found = [float(touch(state(touch, pos=[0.03 - 1e-3 * depth, 0, 0]))["s"].item()) for depth in depths]
    return Comparison(
        "Threshold and release of a contact",
        "by definition, thresholds of 0.5 and 0.2 mm",
        "b = d > 0.5 mm, held while d > 0.2 mm",
        ("contact",),
        "bit",
        "1",
        along("call", "1", np.arange(len(depths))),
        array([0, 0, 1, 1, 1, 0, 0, 1, 0]),
        array(found),
    )


ORACLES: tuple[Oracle, ...] = (link_weight, threshold)
