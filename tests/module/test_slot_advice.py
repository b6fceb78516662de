"""The warning about contacts beyond the slots says how many slots are enough for all pairs that it names."""

import re

import pytest
import torch

import tgdsl

SCENE = """<mujoco><worldbody>
  <body name="pad"><geom type="box" size=".02 .02 .01"/></body>
  <body name="tip" pos=".1 0 0"><geom type="sphere" size=".01"/></body>
  <body name="item" pos="0 0 .03"><freejoint/><geom type="box" size=".02 .02 .02"/></body>
</worldbody></mujoco>"""


@pytest.fixture
def touch(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    point = {"method": "points", "points": [{"pos": [0, 0, 0.01], "normal": [0, 0, 1], "radius": 0.003}]}
    return tgdsl.compile({
        "tgdsl": 1,
        "robot": {"model": str(tmp_path / "scene.xml"), "layout": {"resolutions": {"r": {"pad": point, "tip": point}}}},
        "objects": {"item": {"body": "item"}},
        "sensors": {"touch": {"kind": "force_taxel", "links": "*", "feels": ["item"], "slots": 4}},
    })  # fmt: skip


@pytest.mark.parametrize("found", [(6.0, 9.0), (9.0, 6.0)])
def test_slots_are_enough_for_the_pair_with_the_most_contacts(touch, found):
    state = touch.example_state(3)
    state.contact_found = torch.full((3, 2), 2.0)
    state.contact_found[1] = torch.tensor(found)
    links = ", ".join(re.escape(f"{pair.link} – item") for pair in touch.inputs.pairs)
    with pytest.warns(UserWarning, match=rf"contacts of {links} are more than `slots: 4`.*`slots: 9` would do"):
        touch(state)


def test_as_many_contacts_as_slots_give_no_warning(touch):
    state = touch.example_state(3)
    state.contact_found = torch.full((3, 2), 4.0)
    touch(state)


def test_each_pair_is_warned_of_once(touch):
    state = touch.example_state(3)
    state.contact_found = torch.full((3, 2), 4.0)
    for pair, link in enumerate(pair.link for pair in touch.inputs.pairs):
        state.contact_found[2, pair] = 5.0
        with pytest.warns(UserWarning, match=f"contacts of {link} – item are more than"):
            touch(state)
        touch(state)
