"""Which bodies can collide, against MuJoCo."""

import mujoco
import pytest

from tgdsl.formats.robot import load_model

FREE = "<freejoint/>"
HINGE = "<joint axis='0 0 1'/>"


def two_bodies(a: str = "", b: str = "", geom_a: str = "", geom_b: str = "", rest: str = "", nested: bool = False) -> str:
    """Return a scene in which the balls of bodies `a` and `b` overlap."""
    inner = f"<body name='b' {b.split('|')[0]}>{b.split('|')[-1]}<geom name='gb' size='.1' {geom_b}/></body>"
    outer = f"<body name='a'>{a}<geom name='ga' size='.1' pos='.05 0 0' {geom_a}/>"
    bodies = f"{outer}{inner}</body>" if nested else f"{outer}</body>{inner}"
    return f"<mujoco><worldbody>{bodies}</worldbody>{rest}</mujoco>"


EXCLUDE = "<contact><exclude body1='b' body2='a'/></contact>"
PAIR = "<contact><pair geom1='ga' geom2='gb'/></contact>"
NO_MASK = "contype='0' conaffinity='0'"
TOUCHING_VISUAL = "<geom name='visual' size='.1' contype='0' conaffinity='0' mass='0'/>"
CASES = {
    "free_bodies": (two_bodies(FREE, f"|{FREE}"), True),
    "one_is_static": (two_bodies("", f"|{FREE}"), True),
    "both_static": (two_bodies(), False),
    "contype_alone": (two_bodies(FREE, f"|{FREE}", "contype='2' conaffinity='0'", "contype='0' conaffinity='2'"), True),
    "conaffinity_alone": (two_bodies(FREE, f"|{FREE}", "contype='0' conaffinity='4'", "contype='4' conaffinity='0'"), True),
    "other_bits": (two_bodies(FREE, f"|{FREE}", "contype='2' conaffinity='2'", "contype='1' conaffinity='1'"), False),
    "contypes_only": (two_bodies(FREE, f"|{FREE}", "contype='1' conaffinity='0'", "contype='1' conaffinity='0'"), False),
    "excluded": (two_bodies(FREE, f"|{FREE}", rest=EXCLUDE), False),
    "parent_and_child": (two_bodies(FREE, f"|{HINGE}", nested=True), False),
    "parent_filter_off": (
        two_bodies(FREE, f"|{HINGE}", nested=True, rest="<option><flag filterparent='disable'/></option>"),
        True,
    ),
    "static_parent_and_child": (two_bodies("", f"|{HINGE}", nested=True), True),
    "welded_child": (two_bodies(FREE, "", nested=True), False),
    "welded_child_filter_off": (
        two_bodies(FREE, "", nested=True, rest="<option><flag filterparent='disable'/></option>"),
        False,
    ),
    "grandchild_through_weld": (
        f"<mujoco><worldbody><body name='a'>{FREE}<geom name='ga' size='.1'/><body name='mid'><geom size='.01' pos='1 0 0'/>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></body></worldbody></mujoco>",
        False,
    ),
    "grandchild": (
        f"<mujoco><worldbody><body name='a'>{FREE}<geom name='ga' size='.1'/><body name='mid'>{HINGE}<geom size='.01' pos='1 0 0'/>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></body></worldbody></mujoco>",
        True,
    ),
    "siblings": (
        f"<mujoco><worldbody><body name='p'>{FREE}<geom size='.01' pos='1 0 0'/><body name='a'>{HINGE}<geom name='ga' size='.1'/></body>"
        f"<body name='b'>{HINGE}<geom name='gb' size='.1'/></body></body></worldbody></mujoco>",
        True,
    ),
    "explicit_pair_of_masked_geoms": (two_bodies(FREE, f"|{FREE}", NO_MASK, NO_MASK, PAIR), True),
    "explicit_pair_of_excluded": (
        two_bodies(FREE, f"|{FREE}", rest="<contact><exclude body1='b' body2='a'/><pair geom1='ga' geom2='gb'/></contact>"),
        True,
    ),
    "explicit_pair_of_parent_and_child": (two_bodies(FREE, f"|{HINGE}", nested=True, rest=PAIR), True),
    "explicit_pair_of_a_masked_geom_beside_a_colliding_one": (
        two_bodies(
            f"{FREE}<geom name='far' size='.01' pos='3 0 0' contype='8' conaffinity='8'/>", f"|{FREE}", NO_MASK, NO_MASK, PAIR
        ),
        True,
    ),
    "one_of_two_geoms_collides": (two_bodies(FREE + TOUCHING_VISUAL, f"|{FREE}"), True),
    "contacts_disabled": (two_bodies(FREE, f"|{FREE}", rest="<option><flag contact='disable'/></option>"), False),
    "constraints_disabled": (two_bodies(FREE, f"|{FREE}", rest="<option><flag constraint='disable'/></option>"), False),
    "mocap_and_free": (two_bodies(FREE, "mocap='true'|"), True),
    "mocap_and_static": (two_bodies("", "mocap='true'|"), False),
    "mocap_and_its_child": (two_bodies("", f"|{HINGE}", nested=True).replace("'a'", "'a' mocap='true'"), False),
    "two_mocaps": (two_bodies("", "mocap='true'|").replace("'a'", "'a' mocap='true'"), False),
    "planes_of_the_world": (
        f"<mujoco><worldbody><body name='a'><geom name='ga' type='plane' size='1 1 1'/></body>"
        f"<body name='b'>{FREE}<geom name='gb' size='.1'/></body></worldbody></mujoco>",
        True,
    ),
    "with_the_world": (
        f"<mujoco><worldbody><geom name='ga' type='plane' size='1 1 1'/><body name='b'>{HINGE}<geom name='gb' size='.1'/></body>"
        "</worldbody></mujoco>",
        True,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_can_collide_matches_mujoco(tmp_path, case):
    text, expected = CASES[case]
    (tmp_path / "scene.xml").write_text(text)
    model = load_model(tmp_path / "scene.xml")
    first, second = ("a" if "a" in model.bodies else "world"), "b"
    data = mujoco.MjData(model.compiled)
    mujoco.mj_forward(model.compiled, data)
    body_ids = {model.compiled.body(first).id, model.compiled.body(second).id}
    bodies = [{int(b) for b in model.compiled.geom_bodyid[[c.geom1, c.geom2]]} for c in data.contact]
    assert (body_ids in bodies) is expected  # the oracle, MuJoCo, agrees with the table
    assert model.can_collide(first, second) is expected
    assert model.can_collide(second, first) is expected
