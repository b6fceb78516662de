"""Readings of whole bodies and single bits: the weight on a link, and a contact's threshold and release."""

import numpy as np

from oracles.comparison import Values, field
from oracles.forces import AT_REST, AXES, MASS, G
from oracles.setups.scenes import BALL, probed, resting, state


@field("forces: bodies and bits", "link_contact")(
    "A link feels the weight of what rests on it", "f = −m g", "balance of forces", "force [N]", at=AXES, atol=AT_REST,
    defects=(1,),
)  # fmt: skip
def link_weight():
    touch, scene = resting(kind="link_contact", outputs=["force"])
    return [0, 0, -MASS * G], touch(scene)["s"][0, 0]


@field("forces: bodies and bits", "contact")(
    "Threshold and release of a contact", "b = d > 0.5 mm, held while d > 0.2 mm",
    "by definition, thresholds of 0.5 and 0.2 mm", "bit [1]", "call [1]",
)  # fmt: skip
def threshold():
    depths = np.array([0.0, 0.4, 0.6, 0.4, 0.21, 0.19, 0.4, 0.51, 0.0])
    touch = probed([(0, 0, 0)], BALL, kind="contact", threshold="0.5 mm", release_threshold="0.2 mm")
    bits = [float(touch(state(touch, pos=[0.03 - 1e-3 * depth, 0, 0]))["s"].item()) for depth in depths]
    return Values([0, 0, 1, 1, 1, 0, 0, 1, 0], bits, at=np.arange(len(depths)))
