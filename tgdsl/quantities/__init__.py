"""Quantities that kinds request from a scene, one file each (see `base`): from tgdsl, installed packages or the caller.

A package brings a quantity by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.quantities"]
    my_quantity = "my_package.my_quantity:MY_QUANTITY"
"""

import dataclasses

from tgdsl.files.plugins import Registry
from tgdsl.quantities.base import Gathered, Planning, Quantity, Request, Scene, Use
from tgdsl.quantities.contact_depth import CONTACT_DEPTH, ContactDepth
from tgdsl.quantities.contacts import CONTACTS, LOADS, Contacts, Loads
from tgdsl.quantities.kinematics import JOINTS, MOTION, PLACES, Joints, LinkMotion, Places
from tgdsl.quantities.moments import MOMENTS, MomentsRequest
from tgdsl.quantities.patches import PATCHES
from tgdsl.quantities.points import POINTS, Points
from tgdsl.quantities.reference import References, ReferenceScene

# fmt: off
__all__ = [
    "QUANTITIES", "ContactDepth", "Contacts", "Gathered", "Joints", "LinkMotion", "Loads", "MomentsRequest", "Places",
    "Planning", "Points", "Quantity", "ReferenceScene", "References", "Request", "Scene", "Use", "known_quantities",
]
# fmt: on

# In the order in which they are planned and gathered.
QUANTITIES: tuple[Quantity, ...] = (CONTACT_DEPTH, CONTACTS, MOMENTS, POINTS, MOTION, PATCHES, LOADS, JOINTS, PLACES)


def _wrong(quantity: object) -> str:
    """Return why something is no quantity, or nothing."""
    if not isinstance(quantity, Quantity):
        return f"found {type(quantity).__name__}, expected a tgdsl.quantities.Quantity"
    if not (isinstance(quantity.request, type) and issubclass(quantity.request, Request)):
        return "its `request` is no type of tgdsl.quantities.Request"
    if not (isinstance(quantity.part, type) and dataclasses.is_dataclass(quantity.part)):
        return f'quantity "{quantity.name}": its `part` is no frozen dataclass'
    if any(mark in quantity.name for mark in "/."):
        return f'quantity "{quantity.name}": its name has "/" or ".", which part the names of arrays'
    return ""


known_quantities = Registry[Quantity]("tgdsl.quantities", "quantity", "quantities", QUANTITIES, _wrong).known
"""Returns all quantities: see `tgdsl.files.plugins.Registry.known`."""
