"""Hands that nobody has described: from a robot file to readings by commands alone."""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

import tgdsl
from tgdsl.commands.cli import main
from tgdsl.formats.robot import load_model
from tgdsl.placement.links import links_table, open_robot
from tgdsl.placement.propose.propose import escaped, propose
from tgdsl.schema.load import load_layout
from tgdsl.schema.placement import LayoutSpec

BALL = 0.008
"""Radius of the ball that is felt [m]."""
PRESSED = 0.0005
"""How deep it is pressed into the skin [m]."""
DEPTH_ATOL = 1e-12
"""Everything is float64, half a metre from the origin."""

# Two fingers of three links that one tendon pulls each, on a floating base; names, classes and shapes of all sorts.
TENDON = """
<mujoco model="tendon hand">
  <default>
    <geom friction=".8"/>
    <default class="finger"><joint type="hinge" axis="0 1 0" range="0 90" damping=".1"/><geom type="capsule" size=".006 .012"/>
      <default class="phalanx"><geom pos="0 0 .015"/>
        <default class="last"><geom type="box" size=".006 .006 .012"/><default class="pad"><geom type="ellipsoid"/></default></default>
      </default>
    </default>
  </default>
  <worldbody>
    <body name="hand/base link" pos="0 0 .3">
      <freejoint/>
      <geom type="box" size=".04 .03 .008" mass=".4"/>
      <geom type="cylinder" size=".02 .02" pos="0 0 -.02"/>
      <site name="a0" pos=".03 0 .005"/><site name="b0" pos="-.03 0 .005"/>
      <body name="hand/f.1/proximal" pos=".035 0 .01" euler="0 0 180" childclass="phalanx">
        <joint/><geom/><site name="a1" pos=".006 0 .02"/>
        <body name="hand/f.1/middle" pos="0 0 .034"><joint/><geom/><site name="a2" pos=".006 0 .02"/>
          <body name="hand/f.1/the tip" pos="0 0 .034" childclass="last"><joint/><geom/>
            <geom class="pad" size=".008 .006 .01" pos=".003 0 .015"/><site name="a3" pos=".006 0 .02"/></body>
        </body>
      </body>
      <body name="hand/f.2/proximal" pos="-.035 0 .01" childclass="phalanx">
        <joint/><geom/><site name="b1" pos=".006 0 .02"/>
        <body name="hand/f.2/middle" pos="0 0 .034"><joint/><geom/><site name="b2" pos=".006 0 .02"/>
          <body name="hand/f.2/the tip" pos="0 0 .034" childclass="last"><joint/><geom/>
            <geom class="pad" size=".008 .006 .01" pos=".003 0 .015"/><site name="b3" pos=".006 0 .02"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="a"><site site="a0"/><site site="a1"/><site site="a2"/><site site="a3"/></spatial>
    <spatial name="b"><site site="b0"/><site site="b1"/><site site="b2"/><site site="b3"/></spatial>
  </tendon>
  <actuator><motor tendon="a"/><motor tendon="b"/></actuator>
</mujoco>
"""

# A gripper of two four-bars: driver and rocker hang on the base, the finger on the driver, and a connect closes the loop.
_SIDE = """
      <body name="{0}_driver" pos="{1} 0 .02" euler="0 0 {2}"><joint axis="0 1 0" range="0 45"/>
        <geom type="capsule" fromto="0 0 0 0 0 .03" size=".004"/>
        <body name="{0}_finger" pos="0 0 .04"><joint axis="0 1 0" range="-45 45"/>
          <geom type="box" size=".005 .008 .02" pos=".004 0 .02"/>
          <body name="{0}_pad" pos=".011 0 .03"><geom name="{0}_rubber" type="box" size=".002 .008 .01"/></body>
        </body>
      </body>
      <body name="{0}_rocker" pos="{3} 0 .02" euler="0 0 {2}"><joint axis="0 1 0" range="0 45"/>
        <geom type="capsule" fromto="0 0 0 0 0 .03" size=".003"/></body>"""
FOUR_BAR = f"""
<mujoco>
  <option><flag gravity="disable"/></option>
  <worldbody>
    <geom type="plane" size="1 1 .1" pos="0 0 -.1"/>
    <body name="base"><geom type="box" size=".05 .02 .015"/>{_SIDE.format("left", 0.03, 180, 0.045)}{_SIDE.format("right", -0.03, 0, -0.045)}
      <body name="bracket" pos="0 0 -.02"><geom type="box" size=".01 .01 .005"/></body>
      <body name="camera" pos="0 0 -.05"/>
    </body>
  </worldbody>
  <equality>
    <connect body1="left_rocker" body2="left_finger" anchor="0 0 .04"/>
    <connect body1="right_rocker" body2="right_finger" anchor="0 0 .04"/>
  </equality>
</mujoco>
"""

# No mesh and no box; bodies that are called like groups, and one like a pattern.
CAPSULES = """
<mujoco>
  <default><geom type="capsule" size=".008"/><joint axis="0 -1 0" range="-10 95"/></default>
  <worldbody>
    <body name="wrist"><joint axis="1 0 0" range="-30 30"/><geom fromto="0 0 -.06 0 0 -.03" size=".015"/>
      <body name="palm">
        <joint axis="0 1 0" range="-30 30"/>
        <geom fromto="0 -.03 0 0 .03 0"/><geom fromto="0 -.03 .015 0 .03 .015"/><geom fromto="0 -.03 .03 0 .03 .03"/>
        <body name="f[1]" pos="0 .025 .045"><joint/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="tips" pos="0 0 .04"><joint/><geom fromto="0 0 .005 0 0 .02"/></body></body>
        <body name="f[2]" pos="0 -.025 .045"><joint/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="f[2] end" pos="0 0 .04"><joint/><geom fromto="0 0 .005 0 0 .02"/></body></body>
        <body name="thumb" pos="-.05 0 .02"><joint axis="0 1 0"/><geom fromto="0 0 .005 0 0 .03"/>
          <body name="thumb end" pos="0 0 .04"><joint axis="0 1 0"/><geom fromto="0 0 .005 0 0 .02"/></body></body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

# Only visual geoms, a mesh among them; jaws that slide on the world itself; a table, an unnamed body and a target stand by.
VISUAL = """
<mujoco>
  <default><geom contype="0" conaffinity="0"/></default>
  <asset><mesh name="wedge" vertex="0 -.01 0  0 .01 0  0 -.01 .04  0 .01 .04  .01 -.01 0  .01 .01 0"/></asset>
  <worldbody>
    <body name="jaw a" pos=".02 0 0"><joint type="slide" axis="1 0 0" range="0 .03"/><geom type="mesh" mesh="wedge"/>
      <geom type="sphere" size=".006" pos="0 0 .03"/></body>
    <body name="jaw b" pos="-.02 0 0" euler="0 0 180"><joint type="slide" axis="1 0 0" range="0 .03"/><geom type="mesh" mesh="wedge"/></body>
    <body name="table" pos="0 0 -.5"><geom type="box" size=".2 .2 .1"/></body>
    <body name="floor"><geom type="plane" size="1 1 .1" pos="0 0 -1"/></body>
    <body name="target" mocap="true"><geom size=".01" pos="0 0 .5"/></body>
    <body pos="0 0 -.7"><geom size=".01"/></body>
  </worldbody>
</mujoco>
"""


@dataclass(frozen=True)
class OddHand:
    """A hand, and what should be made of it."""

    text: str
    tips: tuple[str, ...]
    palm: tuple[str, ...]
    fingers: tuple[str, ...]
    others: tuple[str, ...] = ()
    facing: tuple[tuple[str, tuple[float, ...] | None], ...] = ()
    collides: bool = True


HANDS = {
    "tendon": OddHand(
        TENDON,
        tips=("hand/f.1/the tip", "hand/f.2/the tip"),
        palm=("hand/base link",),
        fingers=tuple(f"hand/f.{i}/{part}" for i in (1, 2) for part in ("proximal", "middle", "the tip")),
        facing=(("hand/f.1/the tip", (1, 0, 0)), ("hand/f.2/middle", (1, 0, 0)), ("hand/base link", None)),
    ),
    "four_bar": OddHand(
        FOUR_BAR,
        tips=("left_pad", "right_pad"),
        palm=("base",),
        fingers=tuple(f"{side}_{part}" for side in ("left", "right") for part in ("driver", "finger", "pad", "rocker")),
        others=("bracket",),
        facing=(("left_pad", None), ("base", None)),
    ),
    "capsules": OddHand(
        CAPSULES,
        tips=("tips", "f[2] end", "thumb end"),
        palm=("palm",),
        fingers=("f[1]", "tips", "f[2]", "f[2] end", "thumb", "thumb end"),
        others=("wrist",),
        facing=(("tips", (-1, 0, 0)), ("f[2]", (-1, 0, 0)), ("thumb end", (1, 0, 0)), ("wrist", None)),
    ),
    "visual": OddHand(
        VISUAL,
        tips=("jaw a", "jaw b"),
        palm=(),
        fingers=("jaw a", "jaw b"),
        facing=(("jaw a", (-1, 0, 0)), ("jaw b", (-1, 0, 0))),
        collides=False,
    ),
}


def command(folder: Path, *arguments: str) -> int:
    """Run a command in a folder; return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["tgdsl", *arguments])
        patch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
        try:
            main()
        except SystemExit as ended:
            return int(ended.code or 0)
    return 0


@pytest.fixture
def here(capsys):
    """Run a command in a folder; return exit code and both texts."""

    def run(folder: Path, *arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = command(folder, *arguments)
        return code, *capsys.readouterr()

    return run


@pytest.fixture(scope="module", params=HANDS)
def odd(request, tmp_path_factory):
    """A hand, and a folder where the command has made its layout."""
    folder = tmp_path_factory.mktemp(request.param)
    hand = HANDS[request.param]
    (folder / "hand.xml").write_text(hand.text)
    assert command(folder, "layout", "new", "hand.xml", "--density", "2/cm2") == 0
    return hand, folder


@pytest.fixture(scope="module")
def touch(odd):
    """The hand with a sensor on each group: the tips feel what MuJoCo has in contact with them, if it has anything."""
    hand, folder = odd
    gates = {"tips": "contact_pair"} if hand.collides else {}
    groups = ("hand", "tips", "fingers", *(("palm",) if hand.palm else ()))
    return compiled(folder, {group: gates.get(group, "geometric") for group in groups})


def compiled(folder: Path, gates: dict[str, str], resolution: str = "med") -> tgdsl.TactileModule:
    """Compile a document that puts a sensor on each of some groups, in a scene that includes the hand and a ball."""
    ball = f'<body name="the ball" pos="0 0 5"><freejoint/><geom type="sphere" size="{BALL}" mass=".01"/></body>'
    (folder / "scene.xml").write_text(f'<mujoco><include file="hand.xml"/><worldbody>{ball}</worldbody></mujoco>')
    lines = [
        "tgdsl: 1",
        "robot: {model: hand.xml, layout: layout.yaml}",
        "scene: {model: scene.xml}",
        "objects: {ball: {body: the ball}}",
        f"resolution: {resolution}",
        "sensors:",
        *(f"  {g}: {{kind: contact_depth, links: {g}, feels: [ball], gate: {gate}}}" for g, gate in gates.items()),
    ]
    (folder / "document.yaml").write_text("\n".join(lines))
    return tgdsl.compile(folder / "document.yaml", dtype=torch.float64)


def test_from_the_file_to_readings(odd, touch):
    """A ball pressed into the middle of each tip is felt as deep as its pose says; nothing else reads anything."""
    hand, _ = odd
    sim = tgdsl.simulate(touch, 1)
    for _ in range(5):
        sim.step()
        assert not any(reading.any() for reading in touch(sim.state()).values())  # the ball is far away
    for tip in hand.tips:
        taxel, expected = pressed(touch, sim, tip)
        sim.step()
        readings = {name: reading[0, :, 0].numpy() for name, reading in touch(sim.state()).items()}
        table = touch.taxels["hand"]
        np.testing.assert_allclose(readings["hand"], expected, rtol=0, atol=DEPTH_ATOL)
        assert readings["hand"][taxel] == pytest.approx(table["radius"][taxel] + PRESSED, abs=DEPTH_ATOL)
        assert not readings["hand"][expected == 0].any() and (expected == 0).any()
        rows = [np.flatnonzero(table["link"] == link) for link in dict.fromkeys(touch.taxels["tips"]["link"])]
        for name, own in zip(dict.fromkeys(touch.taxels["tips"]["link"]), rows, strict=True):
            found = readings["tips"][touch.taxels["tips"]["link"] == name]
            is_felt = name == tip or not hand.collides  # contacts are with the pressed tip alone
            np.testing.assert_allclose(found, expected[own] * is_felt, rtol=0, atol=DEPTH_ATOL)


def pressed(touch: tgdsl.TactileModule, sim, tip: str) -> tuple[int, np.ndarray]:
    """Press the ball into the middle of a tip's taxels; return the middle one, and how deep each taxel feels it [m]."""
    table = touch.taxels["hand"]
    rows = np.flatnonzero(table["link"] == tip)
    pos = world_points(sim, table)
    middle = table["pos"][rows].mean(axis=0)
    taxel = int(rows[np.linalg.norm(table["pos"][rows] - middle, axis=1).argmin()])
    normal = posed(sim).body(str(table["body"][taxel])).xmat.reshape(3, 3) @ table["normal"][taxel]
    ball = pos[taxel] + (BALL - PRESSED) * normal
    start = int(sim.model.jnt_qposadr[sim.model.body("the ball").jntadr[0]])
    sim.batch.qpos[0, start : start + 3] = ball
    sim.batch.qvel[:] = 0
    return taxel, np.maximum(0.0, table["radius"] - (np.linalg.norm(pos - ball, axis=1) - BALL))


def posed(sim) -> mujoco.MjData:
    """Return MuJoCo's own kinematics of the first environment."""
    data = mujoco.MjData(sim.model)
    data.qpos[:] = sim.batch.qpos[0]
    mujoco.mj_kinematics(sim.model, data)
    return data


def world_points(sim, table: np.ndarray) -> np.ndarray:
    """Return taxels in the world [m]."""
    data = posed(sim)
    bodies = [data.body(str(name)) for name in table["body"]]
    turned = np.stack([body.xmat.reshape(3, 3) @ pos for body, pos in zip(bodies, table["pos"], strict=True)])
    return turned + np.stack([body.xpos for body in bodies])


def test_what_a_hand_is_taken_for(odd, touch):
    hand, folder = odd
    groups = touch.plan.layout.groups
    assert set(groups["tips"]) == set(hand.tips)
    assert groups.get("palm", ()) == hand.palm
    assert set(groups["fingers"]) == set(hand.fingers)
    assert set(groups["hand"]) == {*hand.fingers, *hand.palm, *hand.others}
    for sensor, table in touch.taxels.items():
        assert set(table["link"]) == set(groups[sensor])
    placements = load_layout(folder / "layout.yaml").spec.resolutions["med"]
    for name, facing in hand.facing:
        region = placements[escaped(name)].region
        assert [part.facing for part in region] == ([] if facing is None else [facing]), name


def test_the_same_command_writes_the_same_file(odd):
    _, folder = odd
    assert command(folder, "layout", "new", "hand.xml", "--density", "2e4/m2", "-o", "new/again.yaml") == 0
    text = (folder / "layout.yaml").read_text()
    assert (folder / "new/again.yaml").read_text() == text
    assert str(folder) not in text


def test_counts_follow_the_density(odd):
    """Each count is the link's area times the density, rounded, and at least 1: four times the density, four times the count."""
    _, folder = odd
    placements = load_layout(folder / "layout.yaml").spec.resolutions
    assert command(folder, "layout", "new", "hand.xml", "--density", "20/cm2", "-o", "dense.yaml") == 0
    dense = load_layout(folder / "dense.yaml").spec.resolutions
    for name, placement in placements["high"].items():
        low, med = placements["low"][name].count, placements["med"][name].count
        assert abs(placement.count - 4 * med) <= 2
        assert abs(med - 4 * low) <= 2 or low == 1
        assert dense["med"][name].count == pytest.approx(2.5 * placement.count, rel=0.1)


def test_taxels_are_as_dense_as_asked(odd, touch):
    table = touch.taxels["hand"]
    assert len(table) / table["area"].sum() == pytest.approx(2e4, rel=0.05)


def test_the_file_says_what_was_left_out_and_what_is_a_guess(tmp_path, here):
    (tmp_path / "hand.xml").write_text(VISUAL)
    code, said, _ = here(tmp_path, "layout", "new", "hand.xml")
    assert code == 0
    text = (tmp_path / "layout.yaml").read_text()
    for line in (
        "# Left out: floor: unnamed plane geom 4 of body floor has no bounded surface to put taxels on\n",
        '# Left out: "1 more": bodies with geoms but no name\n',
        "# Left out: table, target: stands or floats by itself: taken for scenery or an object\n",
        "  # no palm: the chains branch off from nothing that has a surface, or there is only one chain\n",
        '  tips: ["jaw a", "jaw b"]\n',
    ):
        assert line in text
    assert "left out: floor: " in said
    (tmp_path / "hand.xml").write_text(CAPSULES)
    here(tmp_path, "layout", "new", "hand.xml", "--force")
    text = (tmp_path / "layout.yaml").read_text()
    assert '  tips: ["[t]ips", "f[[]2] end", "thumb end"]\n' in text and '  palm: ["[p]alm"]\n' in text


URDF = """<robot name="jaws">
  <link name="base"><collision><geometry><box size=".1 .1 .02"/></geometry></collision></link>
  <link name="left"><collision><origin xyz="0 0 .03"/><geometry><box size=".01 .02 .06"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0 0 .03"/><geometry><box size=".01 .02 .06"/></geometry></collision></link>
  <joint name="l" type="prismatic"><parent link="base"/><child link="left"/><origin xyz="-.04 0 .01"/><axis xyz="1 0 0"/>
    <limit lower="0" upper=".03" effort="1" velocity="1"/></joint>
  <joint name="r" type="prismatic"><parent link="base"/><child link="right"/><origin xyz=".04 0 .01"/><axis xyz="1 0 0"/>
    <limit lower="-.03" upper="0" effort="1" velocity="1"/></joint>
</robot>
"""


def test_the_text_is_the_proposal(tmp_path, here):
    """The file holds what the mapping does; of a URDF here, whose jaws close from opposite ends of their ranges."""
    (tmp_path / "jaws.urdf").write_text(URDF)
    code, said, error = here(tmp_path, "layout", "new", "jaws.urdf", "--density", "1/cm2")
    assert code == 0, error
    proposal = propose(load_model(tmp_path / "jaws.urdf"), 1e4)
    assert load_layout(tmp_path / "layout.yaml").spec == LayoutSpec.model_validate(proposal.mapping())
    found = {link.name: (link.facing, link.counts) for link in proposal.links}
    assert found["left"] == ((1, 0, 0), {"low": 3, "med": 12, "high": 48})
    assert found["right"] == ((-1, 0, 0), {"low": 3, "med": 12, "high": 48})
    assert found["base"] == ((0, 0, 1), {"low": 25, "med": 100, "high": 400})
    assert said.splitlines()[0] == "3 links: 31 taxels at low, 124 taxels at med, 496 taxels at high"


def test_without_groups(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    assert here(tmp_path, "layout", "new", "hand.xml", "--groups", "none")[0] == 0
    layout = load_layout(tmp_path / "layout.yaml").spec
    assert layout.groups == {} and set(layout.resolutions) == {"low", "med", "high"}
    assert "groups:" not in (tmp_path / "layout.yaml").read_text()


def test_a_file_is_not_overwritten(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    (tmp_path / "layout.yaml").write_text("mine")
    code, _, error = here(tmp_path, "layout", "new", "hand.xml")
    assert (code, error) == (
        2,
        "tgdsl: layout.yaml: this file is there already; give --force to replace it, or --out for another\n",
    )
    assert (tmp_path / "layout.yaml").read_text() == "mine"
    assert here(tmp_path, "layout", "new", "hand.xml", "--force")[0] == 0
    assert (tmp_path / "layout.yaml").read_text().startswith("# A layout for hand.xml, proposed by")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hand.xml", "layout.yaml"]


@pytest.mark.parametrize(
    ("density", "message"),
    [
        ("many", '--density: "many" is not a quantity, expected a number in /m2 or a string such as "4 /mm2"'),
        ("4 cm2", '--density: "cm2" is not a unit of density, expected one of /m2, /cm2, /mm2'),
        ("0/cm2", "--density: 0/cm2 is out of range, expected more than 0"),
        ("-1/cm2", "--density: -1/cm2 is out of range, expected more than 0"),
        ("1e9/cm2", 'link "base" would have'),
    ],
)
def test_a_density_that_is_none(tmp_path, here, density, message):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    code, _, error = here(tmp_path, "layout", "new", "hand.xml", f"--density={density}")
    assert code == 2
    assert error.startswith(f"tgdsl: {message}")
    assert not (tmp_path / "layout.yaml").exists()


def test_densities_in_other_units_are_the_same(tmp_path, here):
    (tmp_path / "hand.xml").write_text(FOUR_BAR)
    texts = []
    for density in ("25/cm2", "25e4/m2", "0.25 /mm2", "25e4"):
        assert here(tmp_path, "layout", "new", "hand.xml", "--density", density, "--force")[0] == 0
        texts.append((tmp_path / "layout.yaml").read_text())
    assert len(set(texts)) == 1


def test_a_robot_without_surface_and_one_that_is_not_there(tmp_path, here):
    (tmp_path / "hand.xml").write_text('<mujoco><worldbody><body name="frame"/></worldbody></mujoco>')
    code, _, error = here(tmp_path, "layout", "new", "hand.xml")
    assert (code, error) == (2, 'tgdsl: hand.xml: no link has a surface for taxels ("frame": no geoms)\n')
    for command in (("layout", "new"), ("links",)):
        code, _, error = here(tmp_path, *command, "xhand2")
        assert code == 2 and error.startswith('tgdsl: there is no file or robot "xhand2"; did you mean "xhand1')


def test_names_that_yaml_and_selections_could_misread(tmp_path, here):
    names = ["no", "1e3", "a: b", "#c", "[d]", "*", "e?", 'f"g\\h', "i\u2028j", "😀", "- k", "hand", "{l}", "&m", "!n", "~"]
    parts = "".join(
        f'<body name="{name.replace("&", "&amp;").replace(chr(34), "&quot;")}"><joint axis="{1 + i} 1 0"/><geom size=".01" pos="{i} 0 0"/></body>'
        for i, name in enumerate(names)
    )
    (tmp_path / "hand.xml").write_text(f"<mujoco><worldbody>{parts}</worldbody></mujoco>", encoding="utf-8")
    code, _, error = here(tmp_path, "layout", "new", "hand.xml", "--density", "1/cm2")
    assert code == 0, error
    groups = compiled(tmp_path, {"hand": "geometric"}, "low").plan.layout.groups
    assert groups == {"tips": tuple(names), "fingers": tuple(names), "hand": tuple(names)}


def test_a_shared_name_is_told(tmp_path, here):
    text = FOUR_BAR.replace('name="left_rubber"', 'name="right_finger"')
    (tmp_path / "hand.xml").write_text(text)
    here(tmp_path, "layout", "new", "hand.xml")
    line = "# Mind: geoms or meshes of other links are also called right_finger; a selection by that name takes both.\n"
    assert line in (tmp_path / "layout.yaml").read_text()


@pytest.mark.parametrize(("robot", "stem"), [("xhand1", "right_hand"), ("xhand1_left", "left_hand")])
def test_the_xhand1_is_taken_for_what_its_own_layout_says(robot, stem):
    proposal = propose(open_robot(robot), 1e4)
    tips = ("thumb_rota_link2", "index_rota_link2", "mid_link2", "ring_link2", "pinky_link2")
    assert proposal.groups["tips"] == tuple(f"{stem}_{tip}" for tip in tips)
    assert proposal.groups["palm"] == (f"{stem}_link",)
    facing = {link.name.removeprefix(f"{stem}_"): link.facing for link in proposal.links}
    assert facing["thumb_rota_link2"] == (0, 0, 1)
    assert {facing[name] for name in ("link", "index_rota_link2", "mid_link1", "mid_link2", "pinky_link2")} == {(1, 0, 0)}


# links

SHAPES = """
<mujoco>
  <worldbody>
    <geom name="ground" type="plane" size="1 1 .1"/>
    <body name="box"><freejoint name="base"/><geom name="b" type="box" size=".01 .02 .03" mass=".1"/>
      <geom name="shown" type="sphere" size=".05" contype="0" conaffinity="0" mass="0"/>
      <body name="ball" pos=".1 0 0"><joint name="turn" axis="0 0 1" range="-45 90"/><joint type="slide" axis="1 0 0" range="0 .02"/>
        <geom type="sphere" size=".02" mass=".2"/>
        <body name="rod" pos=".1 0 0"><joint type="ball"/><geom type="cylinder" size=".01 .03" mass=".3"/></body>
      </body>
      <body pos="0 .1 0"><geom type="box" size=".01 .01 .01" contype="0" conaffinity="0"/></body>
      <body name="frame"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture
def shapes(tmp_path):
    (tmp_path / "shapes.xml").write_text(SHAPES)
    return tmp_path


def cells(line: str) -> list[str]:
    """Return the cells of a line: columns are two blanks apart at least."""
    return [cell for cell in line.strip().split("  ") if cell.strip()]


def test_links_areas_have_closed_forms(shapes, here):
    _, said, _ = here(shapes, "links", "shapes.xml")
    lines = {line.split()[0]: line for line in said.splitlines() if not line.startswith(" " * 20)}
    for name, area, rtol in (
        ("box", 8 * (1 * 2 + 2 * 3 + 1 * 3), 1e-3),
        ("ball", 4 * np.pi * 2**2, 3e-3),
        ("rod", 2 * np.pi * 1 * (1 + 6), 2e-3),
    ):
        found = next(float(cell) for cell in cells(lines[name])[1:] if cell.strip().replace(".", "").isdigit())
        assert found == pytest.approx(area, rel=rtol), name


def test_links_table(shapes, here):
    layout = "groups: {first: box, others: {include: [ball, rod]}, all: [first, others]}\n"
    (shapes / "layout.yaml").write_text(layout + "resolutions: {low: {box: {method: poisson, count: 3, radius: 1 mm}}}\n")
    code, said, error = here(shapes, "links", "shapes.xml", "--layout", "layout.yaml")
    assert code == 0, error
    assert said.splitlines() == links_table(load_model(shapes / "shapes.xml"), shapes / "layout.yaml")
    assert (
        said
        == """\
body                  joints                     geoms                     area [cm²]  mass [g]  groups
world                                            ground: plane, colliding   unbounded
  box                 base: free                 b: box, colliding              88.00     100.0  first, all
                                                 shown: sphere, visual
    ball              turn: hinge -45 to 90 deg  sphere, colliding              50.21     200.0  others, all
                      slide 0 to 20 mm
      rod             ball unlimited             cylinder, colliding            43.97     300.0  others, all
    (unnamed body 4)  -                          box, visual                        -       8.0
    frame             -                          -                                  -       0.0
"""
    )


def test_links_of_a_robot_by_name_shows_its_own_groups(tmp_path, here):
    code, said, error = here(tmp_path, "links", "xhand1")
    assert code == 0, error
    (line,) = [line for line in said.splitlines() if line.strip().startswith("right_hand_mid_link2")]
    assert line.startswith("      right_hand_mid_link2 ") and line.endswith("tips, fingers, hand")
    assert "hinge 0 to 110 deg" in line


def test_links_tells_the_mistakes_of_a_layout(shapes, here):
    (shapes / "layout.yaml").write_text(
        "groups: {first: bux}\nresolutions: {low: {box: {method: poisson, count: 3, radius: 1 mm}}}\n"
    )
    code, _, error = here(shapes, "links", "shapes.xml", "--layout", "layout.yaml")
    assert code == 2
    assert error.splitlines()[0] == 'layout.yaml:1:17: groups.first: no link matches "bux"; did you mean "box"?'
    code, _, error = here(shapes, "links", "shapes.xml", "--layout", "none.yaml")
    assert (code, error) == (2, "none.yaml: cannot read this file: No such file or directory\n1 mistake\n")
