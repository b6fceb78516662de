"""The stiffness of MuJoCo's contacts at rest, as `benchmarks/colliders_load.py` states it."""

import mujoco
import pytest

MASS, FRICTION, IMPRATIO, PRESS = 0.017, 0.8, 10.0, 3.0
SCENE = """<mujoco><option timestep=".005" cone="{cone}" impratio="10" gravity="0 0 0"/><worldbody>
  {planes}
  <body pos="0 0 .02"><freejoint/>
    <geom type="sphere" size=".02" mass=".017" friction=".8 .005 .0001" priority="1" solimp="{d} {d} .001"/></body>
</worldbody></mujoco>"""


def depth(cone, impedance, count):
    """Return the penetration of a pressed ball and `count` coinciding planes [m]."""
    text = SCENE.format(cone=cone, planes='<geom type="plane" size="1 1 1"/>' * count, d=impedance)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    data.xfrc_applied[1, 2] = -PRESS
    mujoco.mj_step(model, data, 2000)
    return 0.02 - data.qpos[2]


@pytest.mark.parametrize("impedance", [0.9, 0.95, 0.99])
@pytest.mark.parametrize("count", [1, 2, 6])
def test_contacts_are_springs_in_parallel(impedance, count):
    stiffness = MASS / ((1 - impedance) * 0.02**2)  # 0.02 s: the time constant of MuJoCo's default `solref`
    expected = PRESS / (count * stiffness)
    assert depth("elliptic", impedance, count) == pytest.approx(expected, rel=1e-6)


def test_pyramidal_cones_are_stiffer():
    expected = depth("elliptic", 0.95, 1) * FRICTION**2 * (1 + FRICTION**2) / (2 * IMPRATIO)
    assert depth("pyramidal", 0.95, 1) == pytest.approx(expected, rel=1e-6)
