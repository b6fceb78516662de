from tgdsl.sensors.kinematic_taxel import KINEMATIC_TAXEL
from tgdsl.testing import KindConformance


class TestKinematicTaxel(KindConformance):
    kind = KINEMATIC_TAXEL


class TestKinematicTaxelAsInThePaper(KindConformance):
    kind = KINEMATIC_TAXEL
    parameters = {"model": "paper", "outputs": ["force"]}
