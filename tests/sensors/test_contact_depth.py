from tgdsl.sensors.contact_depth import CONTACT_DEPTH
from tgdsl.testing import KindConformance


class TestContactDepth(KindConformance):
    kind = CONTACT_DEPTH
