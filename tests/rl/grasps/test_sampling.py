"""Sampling of grasps: what is kept holds, presses as it was told to, and is the same each time."""

from pathlib import Path

import numpy as np
import pytest
import torch
from pincer_tasks import GAIN, WIDTHS, pincer_env, write_pincer

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.grasps import sampling
from tgdsl.rl.grasps.sampling import sample
from tgdsl.rl.load import load_task

REPOSITORY = Path(__file__).parents[3]


def sampled(document, **overrides):
    """Return grasps, sampled now."""
    told = []
    named = {f"grasps.{name}": value for name, value in overrides.items()}
    grasps = sample(load_task(document, named), lambda num, wanted: told.append((num, wanted)))
    assert told[-1] == (len(grasps), len(grasps)) and sorted(told) == told
    return grasps


def problem(call):
    """Return the only mistake that a call is refused with."""
    with pytest.raises(SpecError) as caught:
        call()
    (found,) = caught.value.problems
    return found


def test_grasps_are_spread_over_the_variants_and_jaws_are_as_far_apart_as_these_are_wide(tmp_path):
    grasps = sampled(write_pincer(tmp_path), num=7, yaw=0)
    assert grasps.variant.tolist() == [0] * 4 + [1] * 3 and grasps.object == "rod"
    # Jaws are 45 mm from the middle when they are open; soft contacts give way by a millimetre each; the variants differ by 8 mm.
    gap = 0.09 - grasps.qpos[:, 0] - grasps.qpos[:, 1]
    np.testing.assert_allclose(gap, 2 * np.array(WIDTHS)[grasps.variant], rtol=0, atol=2e-3)


def test_jaws_press_with_the_gain_of_their_servos_times_the_squeeze(tmp_path):
    document = write_pincer(tmp_path)
    env = TouchEnv(document, 2, threads=1)
    table = env.task.grasps
    lead = table.ctrl[:, :2] - table.qpos[:, :2]
    # Until the object was let go a target led its joint by the squeeze; then the jaws have evened out.
    assert ((lead.mean(dim=1) > 0.9 * 0.005) & (lead.mean(dim=1) < 0.0121)).all()
    force = table.contacts["contact_netforce"][:, :, 0]
    torch.testing.assert_close(-force[:, 0], GAIN * lead[:, 0], rtol=0.02, atol=0)
    torch.testing.assert_close(force[:, 1], GAIN * lead[:, 1], rtol=0.02, atol=0)
    env.close()


def test_what_was_kept_holds(tmp_path):
    """A second without an action: each object is where it was, and pushes that it was sampled with do not move it away."""
    env = pincer_env(tmp_path, 6)
    begin = env.now.object.pos.clone()
    for i in range(40):
        env.sim.arrays["xfrc_applied"][:, env.sim.model.body("rod").id, :3] = 0.2 * torch.eye(3).double()[i // 10 % 3]
        result = env.step(torch.zeros(6, 2))
        assert not result.terminated.any()
    assert ((env.now.object.pos - begin).norm(dim=1) < 0.01).all() and (env.task.tilt < 0.2).all()
    env.close()


def test_objects_are_turned_and_moved_as_the_document_says(tmp_path):
    grasps = sampled(write_pincer(tmp_path), num=40, yaw=[0, 0.3], offset=["-2 mm", "2 mm"], max_tilt=0.4)
    # Faces of the rod align with the jaws, but for what friction holds.
    y, z = grasps.qpos[:, 4], grasps.qpos[:, 5]
    assert (np.abs(y) < 0.0025).all() and np.ptp(y) > 0.002 and np.abs(z - 0.1).max() < 0.012
    still = sampled(write_pincer(tmp_path), num=10, yaw=0)
    assert np.abs(still.qpos[:, 4]).max() < 1e-4


def test_the_same_seed_gives_the_same_bytes_and_another_one_others(tmp_path):
    document = write_pincer(tmp_path)
    one, two, other = sampled(document), sampled(document), sampled(document, seed=1)
    for name in ("qpos", "ctrl", "variant"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(one.qpos, other.qpos) and one.scene == other.scene and one.settings != other.settings


@pytest.fixture
def soon(monkeypatch):
    """It is given up soon."""
    monkeypatch.setattr(sampling, "ENOUGH", 20)


def test_an_object_that_slides_through_is_not_kept(tmp_path, soon):
    """Friction that carries less than the weight: 2 μ F < m g."""
    document = write_pincer(tmp_path, friction=0.01)
    found = problem(lambda: sampled(document, num=8))
    assert found.path == "grasps" and found.file == str(document)
    assert "only 0 of" in found.what and "variant 0 of rod hold" in found.what and "moved away" in found.what


def test_a_grasp_by_too_few_links_is_not_kept(tmp_path, soon):
    document = write_pincer(tmp_path)
    found = problem(lambda: sampled(document, num=8, min_links=3))
    assert "held by too few links or from one side" in found.what


@pytest.mark.parametrize(
    ("written", "overrides", "path", "says"),
    [
        ({}, {"closed": "shut"}, "grasps.closed", 'the scene has no keyframe "shut"'),
        (
            {"joint": ('<joint name="rod" type="slide" axis="0 0 1"/>', "0")},
            {"yaw": 0.1},
            "grasps.yaw",
            "neither a free nor a ball joint",
        ),
        (
            {"joint": ('<joint name="rod" type="ball"/>', "1 0 0 0")},
            {"offset": 0.01},
            "grasps.offset",
            "has no free joint",
        ),
        ({"joint": ("", "")}, {}, "object", "has no joint"),
    ],
)
def test_what_cannot_be_grasped_is_told_at_its_place(tmp_path, written, overrides, path, says):
    document = write_pincer(tmp_path, grasps="grasps: {num: 2, closed: closed, yaw: 0, offset: 0, squeeze: 0.01}", **written)
    found = problem(lambda: sampled(document, **overrides))
    assert found.path == path and says in found.what


@pytest.mark.parametrize("joint", ['<joint name="rod" type="slide" axis="0 0 1"/><joint name="turn" type="ball"/>'])
def test_objects_on_other_joints_are_held_while_the_hand_closes(tmp_path, joint):
    """A slide and a ball in one body, as the screwdriver has them: in the air until the jaws have met it."""
    document = write_pincer(tmp_path, joint=(joint, "0 1 0 0 0"))
    grasps = sampled(document, num=4)
    assert np.abs(grasps.qpos[:, 3]).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(grasps.qpos[:, 4:], axis=1), 1.0, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_screwdrivers_grasps():
    """Of every handle, by three fingertips in the middle of their joints' ranges; two handles in three hold at once."""
    grasps = sampled(REPOSITORY / "examples" / "tasks" / "screwdriver.yaml", num=128)
    assert np.bincount(grasps.variant).tolist() == [32] * 4
    lift, quat = grasps.qpos[:, 12], grasps.qpos[:, 13:]
    assert np.abs(lift).max() < 2.5e-3  # half of what ends an episode
    tilt = np.arccos(1 - 2 * (quat[:, 1] ** 2 + quat[:, 2] ** 2))
    assert tilt.max() < 0.1
    yaw = np.sort(2 * np.arctan2(quat[:, 3], quat[:, 0]) % (2 * np.pi))
    assert np.diff(yaw).max() < 0.6
