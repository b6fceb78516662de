from tgdsl.sensors.contact import CONTACT
from tgdsl.testing import KindConformance


class TestContact(KindConformance):
    kind = CONTACT
    is_differentiable = False


class TestContactWithHysteresis(KindConformance):
    kind = CONTACT
    parameters = {"threshold": "2 mm", "release_threshold": "0.5 mm"}
    is_differentiable = False
