"""Unknown hands: from a robot file to readings, by commands alone."""

import mujoco
import numpy as np
import pytest
from odd_hands import BALL, CAPSULES, HANDS, VISUAL, command, compiled

import tgdsl
from tgdsl.placement.propose.propose import escaped
from tgdsl.schema.load import load_layout

PRESSED = 0.0005
"""How deep the ball is pressed into the skin [m]."""
DEPTH_ATOL = 1e-12
"""Everything is float64, half a metre from the origin."""
DENSITY = 0.3e4
"""Taxels per square metre, as given to the command."""
LINES = {
    VISUAL: (
        "# Left out: floor: unnamed plane geom 4 of body floor has no bounded surface to put taxels on\n",
        '# Left out: "world/[6]": no name, so no document can mean it\n',
        "# Left out: table, target: stands or floats by itself: taken for scenery or an object; --include adds it\n",
        "  # no palm: the chains part from nothing that has a surface, or there is only one chain\n",
        '  tips: ["jaw a", "jaw b"]\n',
    ),
    CAPSULES: ('  tips: [tips, "f[[]2] end", "thumb end"]\n', "  palm: [palm]\n"),
}
"""Expected lines of the file."""


@pytest.fixture(scope="module", params=HANDS)
def odd(request, tmp_path_factory):
    """Return a hand, and a folder where the command has written its layout."""
    folder = tmp_path_factory.mktemp(request.param)
    hand = HANDS[request.param]
    (folder / "hand.xml").write_text(hand.text)
    assert command(folder, "layout", "new", "hand.xml", "--density", "0.3/cm2") == 0
    return hand, folder


@pytest.fixture(scope="module")
def touch(odd):
    """Return the hand's module with a sensor on each group; tips are gated by MuJoCo's contacts if they collide."""
    hand, folder = odd
    gates = {"tips": "contact_pair"} if hand.collides else {}
    groups = ("hand", "tips", "fingers", *(("palm",) if hand.palm else ()))
    return compiled(folder, {group: gates.get(group, "geometric") for group in groups})


def test_from_the_file_to_readings(odd, touch):
    """A ball pressed into the middle of each tip reads the depth of its pose; other taxels read 0."""
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
        for name, ids in zip(dict.fromkeys(touch.taxels["tips"]["link"]), rows, strict=True):
            tip_readings = readings["tips"][touch.taxels["tips"]["link"] == name]
            is_felt = name == tip or not hand.collides  # contacts are with the pressed tip alone
            np.testing.assert_allclose(tip_readings, expected[ids] * is_felt, rtol=0, atol=DEPTH_ATOL)


def pressed(touch: tgdsl.TactileModule, sim, tip: str) -> tuple[int, np.ndarray]:
    """Press the ball into the middle of a tip's taxels; return the middle taxel and all expected depths [m]."""
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
    """Return MuJoCo's kinematics of the first environment."""
    data = mujoco.MjData(sim.model)
    data.qpos[:] = sim.batch.qpos[0]
    mujoco.mj_kinematics(sim.model, data)
    return data


def world_points(sim, table: np.ndarray) -> np.ndarray:
    """Return positions of taxels in the world [m]."""
    data = posed(sim)
    bodies = [data.body(str(name)) for name in table["body"]]
    rotated = np.stack([body.xmat.reshape(3, 3) @ pos for body, pos in zip(bodies, table["pos"], strict=True)])
    return rotated + np.stack([body.xpos for body in bodies])


def test_groups_and_inner_sides_are_recognised(odd, touch):
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


def test_the_file_names_left_out_bodies_and_guesses(odd):
    hand, folder = odd
    text = (folder / "layout.yaml").read_text()
    for line in LINES.get(hand.text, ()):
        assert line in text


def test_counts_follow_the_resolution(odd):
    """`low` has a quarter of the taxels of `med`, at least 1; `high` has four times as many."""
    _, folder = odd
    placements = load_layout(folder / "layout.yaml").spec.resolutions
    for name, placement in placements["high"].items():
        low, med = placements["low"][name].count, placements["med"][name].count
        assert abs(placement.count - 4 * med) <= 2
        assert abs(med - 4 * low) <= 2 or low == 1


def test_taxels_have_the_requested_density(odd, touch):
    table = touch.taxels["hand"]
    assert len(table) / table["area"].sum() == pytest.approx(DENSITY, rel=0.05)
