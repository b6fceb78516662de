"""Inputs by the names of another scene."""

import re

import pytest

from tgdsl.errors import StateError
from tgdsl.plan.inputs import ContactPart, Inputs
from tgdsl.quantities.pairs import Pair

INPUTS = Inputs(
    fields=("body_pos", "joint_pos", "last_action", "contact_found"),
    bodies=("cube", "tip", "world"),
    pairs=(Pair("tip", "box"), Pair("tip", "floor")),
    bodies_of={"box": "cube", "floor": "world"},
    slots=0,
    joints=("bend",),
    actuators=("bend_motor",),
    contacts_of={"floor": (ContactPart("geom", "ground"),)},
    link_parts={"tip": (ContactPart("body", "tip"), ContactPart("subtree", "nail"))},
)


def test_a_prefix_and_names_are_put_wherever_a_name_of_the_scene_stands():
    there = INPUTS.renamed({"cube": "object/cube", "ground": "terrain"}, prefix="robot/")
    assert there == Inputs(
        fields=INPUTS.fields,
        bodies=("object/cube", "robot/tip", "world"),
        pairs=(Pair("robot/tip", "box"), Pair("robot/tip", "floor")),  # objects go by the document's names
        bodies_of={"box": "object/cube", "floor": "world"},
        slots=0,
        joints=("robot/bend",),
        actuators=("robot/bend_motor",),
        contacts_of={"floor": (ContactPart("geom", "terrain"),)},
        link_parts={"robot/tip": (ContactPart("body", "robot/tip"), ContactPart("subtree", "robot/nail"))},
    )
    assert there.parts_of_link("robot/tip") == there.link_parts["robot/tip"]
    assert INPUTS.renamed() == INPUTS


def test_a_name_that_is_not_read_is_refused_with_the_nearest():
    message = 'this module reads no body, geom, joint or actuator "bnd"; did you mean "bend"?'
    with pytest.raises(StateError, match=re.escape(message)):
        INPUTS.renamed({"bnd": "robot/bend"})
