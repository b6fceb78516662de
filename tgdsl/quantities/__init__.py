"""What kinds ask of a scene, one file each (see `base`): tgdsl's, those of installed packages, and those a caller gives.

A package brings a quantity by an entry point, in its pyproject.toml:

    [project.entry-points."tgdsl.quantities"]
    my_quantity = "my_package.my_quantity:MY_QUANTITY"
"""

import dataclasses
from collections.abc import Sequence

from tgdsl.files.plugins import known
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


def known_quantities(given: Sequence[Quantity] = ()) -> tuple[Quantity, ...]:
    """Return all quantities: tgdsl's, then those of installed packages by package and name, then the given ones.

    An installed quantity that cannot be imported is skipped; a warning says so once.

    Args:
        given: Quantities of the caller's own. One that an installed package brings too may be among them.

    Raises:
        TgdslError: If two quantities have one name, or a quantity that is given is none.
    """
    return known("tgdsl.quantities", "quantity", "quantities", QUANTITIES, given, _wrong)


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
