"""What kinds ask of a scene, one folder each: see `base`."""

from tgdsl.quantities.base import Gathered, Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.contact_depth import ContactDepth
from tgdsl.quantities.contacts import Contacts, Loads
from tgdsl.quantities.kinematics import Joints, LinkMotion, Places
from tgdsl.quantities.known import QUANTITIES, known_quantities
from tgdsl.quantities.moments import MomentsRequest
from tgdsl.quantities.points import Points
from tgdsl.quantities.reference import References, ReferenceScene

__all__ = [
    "QUANTITIES",
    "ContactDepth",
    "Contacts",
    "Gathered",
    "Joints",
    "LinkMotion",
    "Loads",
    "MomentsRequest",
    "Places",
    "Planning",
    "Points",
    "Quantity",
    "ReferenceScene",
    "References",
    "Request",
    "Scene",
    "Use",
    "known_quantities",
]
