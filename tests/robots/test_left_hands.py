"""The included left hands are mirror images of the right ones."""

import mujoco
import numpy as np
import pytest
import trimesh
from mirrored_hands import EXACT, ROBOTS, check_dynamics, check_frames, check_meshes, check_taxels, mirror, posed, reflection

from tgdsl.compiler.resolve import resolve
from tgdsl.files.find import layout_file, robot_names
from tgdsl.schema.load import load

HANDS = {
    "xhand1": {
        "low": {"hand": 90, "tips": 45, "fingers": 78, "palm": 12},
        "med": {"hand": 199, "tips": 100, "fingers": 164, "palm": 35},
        "high": {"hand": 667, "tips": 224, "fingers": 448, "palm": 219},
    },
    "sharpa": {
        "low": {"hand": 98, "tips": 45, "fingers": 89, "palm": 9},
        "med": {"hand": 206, "tips": 70, "fingers": 190, "palm": 16},
        "high": {"hand": 781, "tips": 245, "fingers": 660, "palm": 121},
    },
}
"""Chung et al., Tactile Genesis, appendix: active probes of each hand per resolution and group."""


@pytest.fixture(scope="module", params=HANDS)
def robot(request):
    return request.param


@pytest.fixture(scope="module")
def hands(robot):
    return [mujoco.MjModel.from_xml_path(str(ROBOTS / robot / f"{robot}_{side}.xml")) for side in ("right", "left")]


def test_the_files_match_the_scripts_output(robot):
    folder = ROBOTS / robot
    outputs, notes = mirror.mirrored_files(folder / f"{robot}_right.xml", folder / "layout.yaml", reflection.Mirror())
    assert notes == []
    for path, content in outputs.items():
        assert path.read_bytes() == content, path.name
    written = {path for path in outputs if path.suffix == ".stl"}
    assert written == set((folder / "assets" / "left").glob("*.stl"))
    for path in written:
        mesh = trimesh.load(path, force="mesh")
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0, path.name


def test_the_left_hand_is_the_mirror_image(hands):
    rng = np.random.default_rng(0)
    for i in range(10):
        states = posed(hands, rng)
        check_frames(("x", "site_x"), *states, 1)
        check_dynamics(hands, states, 1)
        np.testing.assert_allclose(states[1].qfrc_bias, states[0].qfrc_bias, atol=EXACT)  # gravity lies in the plane
        if i % 5 == 0:
            check_meshes(hands, states, 1)


def test_joints_and_drives_are_the_same(hands):
    right, left = hands
    assert [left.joint(i).name for i in range(left.njnt)] == [
        right.joint(i).name.replace("right", "left") for i in range(right.njnt)
    ]
    for name in ("jnt_range", "dof_damping", "dof_armature", "actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name), err_msg=name)
    np.testing.assert_array_equal(left.actuator_forcerange, right.actuator_forcerange)
    assert left.nexclude == right.nexclude


CLOSING = {
    "xhand1": [
        (tip, [f"hand_{tip.removesuffix('_rota')}_joint{i}" for i in (1, 2)], f"hand_{tip}_tip")
        for tip in ("index_rota", "mid", "ring", "pinky")
    ],
    "sharpa": [
        (finger, [f"{finger}_{joint}" for joint in ("MCP_FE", "PIP")], f"{finger}_fingertip")
        for finger in ("index", "middle", "ring", "pinky")
    ],
}
"""The joints that close each finger of a hand, and the site at its tip."""


def test_positive_values_close_the_fingers(robot, hands):
    for model, side in zip(hands, ("right", "left"), strict=True):
        for finger, joints, tip in CLOSING[robot]:
            data = mujoco.MjData(model)
            reach = []
            for value in (0.0, 0.3):
                for joint in joints:
                    data.joint(f"{side}_{joint}").qpos[0] = value
                mujoco.mj_forward(model, data)
                reach.append(data.site(f"{side}_{tip}").xpos[0])  # the palm's normal is x
            assert reach[1] > reach[0] + 0.015, f"{side} {finger}"


@pytest.mark.parametrize(
    ("robot", "resolution"),
    [
        ("xhand1", "low"),
        pytest.param("sharpa", "high", marks=pytest.mark.slow),
    ],
)
def test_taxels_of_the_left_hand_mirror_those_of_the_right(robot, resolution):
    layouts = {}
    for side in ("right", "left"):
        document = {
            "tgdsl": 1,
            "robot": {"model": f"{robot}_{side}"},
            "objects": {"base": {"body": {"xhand1": f"{side}_hand_link", "sharpa": f"{side}_hand_C_MC"}[robot]}},
            "resolution": resolution,
            "sensors": {"touch": {"kind": "surface_distance", "links": "hand", "feels": ["base"]}},
        }
        layouts[side] = resolve(load(document)).layout
    right, left = layouts["right"], layouts["left"]
    per_link = {link.name: int((left.link_id == i).sum()) for i, link in enumerate(left.links)}
    counts = {name: sum(per_link[link] for link in links) for name, links in left.groups.items()}
    assert counts == HANDS[robot][resolution]
    assert [link.name for link in left.links] == [link.name.replace("right", "left") for link in right.links]
    np.testing.assert_array_equal(left.link_id, right.link_id)
    check_taxels(right, left, 1)


def test_a_side_may_have_its_own_layout(tmp_path):
    folder = tmp_path / "hand"
    folder.mkdir()
    assert layout_file(folder / "hand_left.xml") is None
    (folder / "layout.yaml").touch()
    assert layout_file(folder / "hand_left.xml") == folder / "layout.yaml"
    (folder / "layout_left.yaml").touch()
    assert layout_file(folder / "hand_left.xml") == folder / "layout_left.yaml"
    assert layout_file(folder / "hand_right.xml") == folder / "layout.yaml"
    assert layout_file(robot_names()["xhand1_left"]).name == "layout_left.yaml"
    assert layout_file(robot_names()["xhand1"]).name == "layout.yaml"
