"""Hands whose inner sides are known because they were made so: in each link's frame, z goes along it and x is its inner side."""

from dataclasses import dataclass, field

INNER = (1.0, 0.0, 0.0)


def finger(name: str, pos: str, euler: str = "0 0 0", num: int = 3, axis: str = "0 1 0", span: str = "0 90") -> str:
    """Return a chain of links that turn from z toward x; `span` goes with the axis."""
    text = ""
    for i in range(num, 0, -1):
        where = f'pos="{pos}" euler="{euler}"' if i == 1 else 'pos="0 0 .032"'
        text = (
            f'<body name="{name}{i}" {where}><joint name="{name}_j{i}" axis="{axis}" range="{span}"/>'
            f'<geom type="box" size=".006 .008 .014" pos="0 0 .016"/>{text}</body>'
        )
    return text


def arm(inside: str, num: int = 5, name: str = "arm", pos: str = "0 0 0", euler: str = "0 0 0") -> str:
    """Return an arm with something on its last link."""
    text = inside
    for i in range(num, 0, -1):
        where = f'pos="{pos}" euler="{euler}"' if i == 1 else 'pos="0 0 .2"'
        axis = "0 0 1" if i % 2 else "0 1 0"
        text = (
            f'<body name="{name}{i}" {where}><joint axis="{axis}" range="-170 170"/>'
            f'<geom type="box" size=".03 .03 .07" pos="0 0 .1"/>{text}</body>'
        )
    return text


def palm_and_fingers(thumb: str, side: int = 1, pos: str = "0 0 .2", name: str = "", joint: str = "") -> str:
    """Return a palm whose inner side is x, four fingers and a thumb; the other hand is mirrored along y."""
    fingers = "".join(finger(f"{name}f{i}_", f"0 {side * (0.03 - 0.02 * i):.3g} .085") for i in range(4))
    palm = '<geom type="box" size=".012 .04 .04" pos="0 0 .04"/>'
    return f'<body name="{name}palm" pos="{pos}">{joint}{palm}{fingers}{thumb}</body>'


def thumb(side: int, is_away: bool = False, name: str = "") -> str:
    """Return a thumb at the palm's edge that points away from it; or one that stands there and curls away from the palm."""
    bends = {"axis": "0 1 0", "span": "0 50"} if side > 0 else {"axis": "0 -1 0", "span": "-50 0"}
    if is_away:
        return finger(f"{name}thumb", f"0 {-side * 0.055:.3g} .02", "0 0 180", **bends)
    return finger(f"{name}thumb", f"0 {-side * 0.045:.3g} .02", f"{side * 90} 0 0", **bends)


def slides(start: str = "closed", name: str = "") -> str:
    """Return a gripper of two slides, whose jaws meet at x = 0."""
    at, span = (0.005, "0 .04") if start == "closed" else (0.045, "-.04 0")
    jaws = "".join(
        f'<body name="{name}jaw{i}" pos="{x:.3g} 0 .04" euler="0 0 {turn}"><joint name="{name}slide{i}" type="slide" '
        f'axis="-1 0 0" range="{span}"/><geom type="box" size=".005 .01 .025" pos="0 0 .03"/></body>'
        for i, (x, turn) in enumerate(((at, 180), (-at, 0)))
    )
    return f'<body name="{name}gripper" pos="0 0 .2"><geom type="box" size=".06 .02 .02"/>{jaws}</body>'


def hinged_jaws(geom: str = '<geom type="box" size=".05 .02 .015"/>') -> str:
    """Return two jaws on hinges that are closed at the start and open by 40 deg."""
    jaws = "".join(
        f'<body name="jaw{i}" pos="{x:.3g} 0 .03" euler="0 0 {turn}"><joint name="hinge{i}" axis="0 -1 0" range="0 40"/>'
        '<geom type="box" size=".005 .01 .03" pos="0.01 0 .04"/></body>'
        for i, (x, turn) in enumerate(((0.02, 180), (-0.02, 0)))
    )
    return f'<body name="base">{geom}{jaws}</body>'


def parallel_jaws(level: float = -1.0, follow: float = 1.0) -> str:
    """Return two linkages of mimicked joints; each has a second bar whose loop stays open.

    Args:
        level: How far a tip turns on its bar, of how far this turns; by -1 it stays upright, above 0 it curls.
        follow: How far the second bar turns.
    """
    sides = "".join(
        f"""<body name="{s}_bar" pos="{x:.3g} 0 .02" euler="0 0 {turn}"><joint name="{s}_drive" axis="0 1 0" range="0 45"/>
          <geom type="box" size=".004 .006 .024" pos="0 0 .03"/>
          <body name="{s}_tip" pos="0 0 .06"><joint name="{s}_level" axis="0 1 0" range="{"-45 0" if level < 0 else "0 45"}"/>
            <geom type="box" size=".005 .01 .02" pos=".006 0 .02"/></body></body>
        <body name="{s}_second" pos="{0.7 * x:.3g} 0 .02" euler="0 0 {turn}"><joint name="{s}_follow" axis="0 1 0" range="0 45"/>
          <geom type="box" size=".002 .006 .02" pos="0 0 .03"/></body>"""
        for s, x, turn in (("left", 0.06, 180), ("right", -0.06, 0))
    )
    gears = {"left_level": level, "left_follow": follow, "right_drive": 1.0, "right_level": level, "right_follow": follow}
    mimics = "".join(f'<joint joint1="{one}" joint2="left_drive" polycoef="0 {gear:g} 0 0 0"/>' for one, gear in gears.items())
    return f"""<mujoco><worldbody><body name="base"><geom type="box" size=".08 .02 .012"/>{sides}</body></worldbody>
      <equality>{mimics}</equality></mujoco>"""


def looped_jaws() -> str:
    """Return two parallelograms: an outer knuckle and the finger on it, to which a connect holds an inner knuckle."""
    sides = "".join(
        f"""<body name="{s}_outer" pos="{x:.3g} 0 .02" euler="0 0 {turn}"><joint name="{s}_drive" axis="0 1 0" range="-10 40"/>
          <geom type="box" size=".004 .006 .018" pos="0 0 .025"/>
          <body name="{s}_finger" pos="0 0 .05"><joint axis="0 1 0" range="-60 60"/>
            <geom type="box" size=".005 .008 .025" pos="0 0 .03"/></body></body>
        <body name="{s}_inner" pos="{0.6 * x:.3g} 0 .02" euler="0 0 {turn}"><joint axis="0 1 0"/>
          <geom type="box" size=".002 .006 .018" pos="0 0 .025"/></body>"""
        for s, x, turn in (("left", 0.05, 180), ("right", -0.05, 0))
    )
    loops = "".join(f'<connect body1="{s}_inner" body2="{s}_finger" anchor="0 0 .05"/>' for s in ("left", "right"))
    return f"""<mujoco><worldbody><body name="base"><geom type="box" size=".08 .02 .012"/>{sides}</body></worldbody>
      <equality>{loops}</equality></mujoco>"""


def one_jaw(span: str = "0 70", ref: float = 0.0, side: int = 1, pos: str = "0 0 0") -> str:
    """Return a jaw that closes on a fixed one, which is at -x for the side 1; at the angle `ref` it is beside it."""
    turn = 180 if side > 0 else 0
    return (
        f'<body name="fixed" pos="{pos}"><geom type="box" size=".03 .02 .015"/>'
        f'<geom type="box" size=".006 .01 .05" pos="{-0.016 * side:.3g} 0 .05"/>'
        f'<body name="jaw" pos="{0.006 * side:.3g} 0 .04" euler="0 0 {turn}">'
        f'<joint name="hinge" axis="0 -1 0" range="{span}" ref="{ref:g}"/>'
        '<geom type="box" size=".005 .01 .03" pos="0 0 .035"/></body></body>'
    )


def _three(finger: str) -> str:
    """Return a palm whose inner side is z, and three fingers around it: names and frames stand in for `#` and `@`."""
    places = (("a", "-.04 0 .02", 0), ("b", ".04 .025 .02", 180), ("c", ".04 -.025 .02", 180))
    fingers = "".join(finger.replace("#", n).replace("@", f'pos="{pos}" euler="0 0 {turn}"') for n, pos, turn in places)
    return f'<worldbody><body name="palm"><geom type="box" size=".06 .05 .01"/>{fingers}</body></worldbody>'


def spread_fingers() -> str:
    """Return three fingers whose outer links stay upright; two of them spread together, from one end of ±30 deg."""
    finger = (
        '<body name="#0" @><joint name="#_spread" axis="0 0 1" range="-30 30" ref="30"/>'
        '<geom type="box" size=".006 .006 .003" pos="0 0 .002"/>'
        '<body name="#1" pos="0 0 .01"><joint name="#_flex" axis="0 1 0" range="0 60"/>'
        '<geom type="box" size=".005 .008 .018" pos="0 0 .02"/>'
        '<body name="#2" pos="0 0 .045"><joint name="#_level" axis="0 1 0" range="-60 0"/>'
        '<geom type="box" size=".005 .008 .018" pos="0 0 .02"/></body></body></body>'
    )
    body = _three(finger).replace('<joint name="a_spread" axis="0 0 1" range="-30 30" ref="30"/>', "")
    mimics = "".join(f'<joint joint1="{n}_level" joint2="{n}_flex" polycoef="0 -1 0 0 0"/>' for n in "abc")
    return f'<mujoco>{body}<equality>{mimics}<joint joint1="c_spread" joint2="b_spread" polycoef="0 -1 0 0 0"/></equality></mujoco>'


def single_links(joint: str = 'range="0 60" ref="40"', rest: str = "") -> str:
    """Return three fingers of one link, upright at the start, which close toward the low end of their range."""
    finger = f'<body name="#" @><joint name="#_hinge" axis="0 -1 0" {joint}/><geom type="box" size=".005 .008 .03" pos="0 0 .035"/></body>'
    return f"<mujoco>{_three(finger)}{rest}</mujoco>"


def world(inside: str) -> str:
    """Return a model."""
    return f"<mujoco><worldbody>{inside}</worldbody></mujoco>"


@dataclass(frozen=True)
class MadeHand:
    """A hand as made.

    Attributes:
        text: Its MJCF.
        tips: Its last links.
        left_out: Links that are no part of a hand.
        facing: Inner sides that are not x.
        doubted: Links with a guess that something speaks against.
    """

    text: str
    tips: frozenset[str]
    left_out: frozenset[str] = frozenset()
    facing: dict[str, tuple[float, ...]] = field(default_factory=dict)
    doubted: frozenset[str] = frozenset()


def _fingertips(name: str = "") -> set[str]:
    return {*(f"{name}f{i}_3" for i in range(4)), f"{name}thumb3"}


def _arm(name: str = "arm", num: int = 5) -> frozenset[str]:
    return frozenset(f"{name}{i}" for i in range(1, num + 1))


_TWO_HANDS = "".join(
    arm(palm_and_fingers(thumb(side, name=name), side, name=name), 4, f"{name}arm", f"0 {-side * 0.2} .1", f"{side * 90} 0 0")
    for name, side in (("right_", 1), ("left_", -1))
)
_HEAD = '<body name="head" pos="0 0 .3"><joint axis="0 0 1" range="-60 60"/><geom size=".08" pos="0 0 .05"/></body>'
_BRANCHED = (
    '<body name="meta" pos="0 .07 .085"><joint name="arch" axis="0 1 0" range="0 20"/><geom type="box" size=".01 .02 .012" '
    f'pos="0 0 .015"/>{finger("a", "0 .012 .03")}{finger("b", "0 -.012 .03")}</body>'
)
_ARCH = (
    '<body name="wrist" pos="0 0 .2"><geom type="box" size=".01 .02 .012"/>'
    f'{finger("thumb", "0 -.03 0", "60 0 0", 2)}<body name="arch" pos="0 0 .02"><joint axis="0 1 0" range="-5 15"/>'
    '<geom type="box" size=".01 .04 .03" pos="0 0 .03"/>'
    f"{''.join(finger(f'f{i}_', f'0 {0.02 * i - 0.02:.3g} .065') for i in range(3))}</body></body>"
)
_UP = {"gripper": (0.0, 0.0, 1.0), "base": (0.0, 0.0, 1.0), "palm": (0.0, 0.0, 1.0)}
_JAWS = frozenset({"fixed", "jaw"})
_OUTWARD = (-1.0, 0.0, 0.0)

MADE = {
    "five_fingers": MadeHand(world(palm_and_fingers(thumb(1))), frozenset(_fingertips())),
    **{
        f"thumb_away_from_the_{'right' if side > 0 else 'left'}_palm": MadeHand(
            world(palm_and_fingers(thumb(side, is_away=True), side)),
            frozenset(_fingertips()),
            doubted=frozenset({"thumb1", "thumb2"}),
        )
        for side in (1, -1)
    },
    "arm_and_slides": MadeHand(world(arm(slides())), frozenset({"jaw0", "jaw1"}), _arm(), _UP),
    "forearm_and_hand": MadeHand(
        world(arm(palm_and_fingers(thumb(1), joint='<joint axis="1 0 0" range="-40 40"/>'))), frozenset(_fingertips()), _arm()
    ),
    "welded_to_the_arm": MadeHand(world(arm(palm_and_fingers(thumb(-1), -1))), frozenset(_fingertips()), _arm()),
    "slides_open_at_the_start": MadeHand(world(slides("open")), frozenset({"jaw0", "jaw1"}), facing=_UP),
    "hinges": MadeHand(world(hinged_jaws()), frozenset({"jaw0", "jaw1"}), facing=_UP, doubted=frozenset({"jaw0", "jaw1"})),
    "no_palm": MadeHand(world(hinged_jaws("")), frozenset({"jaw0", "jaw1"}), doubted=frozenset({"jaw0", "jaw1"})),
    "parallel_jaws": MadeHand(parallel_jaws(), frozenset({"left_tip", "right_tip"}), facing=_UP),
    "two_hands": MadeHand(
        world(f'<body name="torso"><geom type="box" size=".1 .15 .2"/>{_TWO_HANDS}{_HEAD}</body>'),
        frozenset(_fingertips("right_") | _fingertips("left_")),
        frozenset({"torso", "head"}) | _arm("right_arm", 4) | _arm("left_arm", 4),
    ),
    "branched_metacarpal": MadeHand(world(palm_and_fingers(_BRANCHED + thumb(1))), frozenset(_fingertips() | {"a3", "b3"})),
    "arch": MadeHand(world(arm(_ARCH)), frozenset({"thumb2", "f0_3", "f1_3", "f2_3"}), _arm()),
    "one_jaw": MadeHand(world(one_jaw()), _JAWS, doubted=_JAWS),
    "one_jaw_of_the_other_side": MadeHand(world(one_jaw(side=-1)), _JAWS, facing={"fixed": _OUTWARD}, doubted=_JAWS),
    "one_jaw_on_an_arm": MadeHand(world(arm(one_jaw("-40 40", -40, pos="0 0 .2"))), _JAWS, _arm()),
    "looped_jaws": MadeHand(looped_jaws(), frozenset({"left_finger", "right_finger"}), facing=_UP),
    "curling_jaws_with_slow_bars": MadeHand(parallel_jaws(0.6, 0.2), frozenset({"left_tip", "right_tip"}), facing=_UP),
    "spread_fingers": MadeHand(spread_fingers(), frozenset({"a2", "b2", "c2"}), facing={**_UP, "a0": (0.0, 0.0, 1.0)}),
    "single_links": MadeHand(single_links(), frozenset("abc"), facing=_UP),
    "radians_read_as_degrees": MadeHand(single_links('range="0 1.05" ref="0.7"'), frozenset("abc"), facing=_UP),
}
