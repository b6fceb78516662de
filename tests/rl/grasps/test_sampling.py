"""Sampling of grasps: stored grasps hold, press as configured, and are reproducible."""

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


def sample_grasps(document, **overrides):
    """Sample grasps and return them."""
    progress = []
    settings = {f"grasps.{name}": value for name, value in overrides.items()}
    grasps = sample(load_task(document, settings), lambda num, total: progress.append((num, total)))
    assert progress[-1] == (len(grasps), len(grasps)) and sorted(progress) == progress
    return grasps


def problem(call):
    """Return the only problem reported by a call that must fail."""
    with pytest.raises(SpecError) as caught:
        call()
    (reported,) = caught.value.problems
    return reported


def test_grasps_cover_the_variants_and_jaws_fit_their_widths(tmp_path):
    grasps = sample_grasps(write_pincer(tmp_path), num=7, yaw=0)
    assert grasps.variant.tolist() == [0] * 4 + [1] * 3 and grasps.object == "rod"
    # Open jaws are 45 mm from the middle; soft contacts yield by 1 mm each; the variants differ by 8 mm.
    gap = 0.09 - grasps.qpos[:, 0] - grasps.qpos[:, 1]
    np.testing.assert_allclose(gap, 2 * np.array(WIDTHS)[grasps.variant], rtol=0, atol=2e-3)


def test_jaws_press_with_servo_gain_times_squeeze(tmp_path):
    document = write_pincer(tmp_path)
    env = TouchEnv(document, 2, threads=1)
    table = env.task.grasps
    lead = table.ctrl[:, :2] - table.qpos[:, :2]
    # Targets led their joints by the squeeze until the object was released; then the jaws balanced.
    assert ((lead.mean(dim=1) > 0.9 * 0.005) & (lead.mean(dim=1) < 0.0121)).all()
    force = table.contacts["contact_netforce"][:, :, 0]
    torch.testing.assert_close(-force[:, 0], GAIN * lead[:, 0], rtol=0.02, atol=0)
    torch.testing.assert_close(force[:, 1], GAIN * lead[:, 1], rtol=0.02, atol=0)
    env.close()


def test_stored_grasps_hold(tmp_path):
    """For a second without actions, with the pushes used in sampling, each object stays in place."""
    env = pincer_env(tmp_path, 6)
    start = env.now.object.pos.clone()
    for i in range(40):
        env.sim.arrays["xfrc_applied"][:, env.sim.model.body("rod").id, :3] = 0.2 * torch.eye(3).double()[i // 10 % 3]
        result = env.step(torch.zeros(6, 2))
        assert not result.terminated.any()
    assert ((env.now.object.pos - start).norm(dim=1) < 0.01).all() and (env.task.tilt < 0.2).all()
    env.close()


def test_objects_are_turned_and_moved_as_the_document_says(tmp_path):
    grasps = sample_grasps(write_pincer(tmp_path), num=40, yaw=[0, 0.3], offset=["-2 mm", "2 mm"], max_tilt=0.4)
    # Faces of the rod align with the jaws, up to friction.
    y, z = grasps.qpos[:, 4], grasps.qpos[:, 5]
    assert (np.abs(y) < 0.0025).all() and np.ptp(y) > 0.002 and np.abs(z - 0.1).max() < 0.012
    unmoved = sample_grasps(write_pincer(tmp_path), num=10, yaw=0)
    assert np.abs(unmoved.qpos[:, 4]).max() < 1e-4


def test_grasps_are_determined_by_the_seed(tmp_path):
    document = write_pincer(tmp_path)
    one, two, other = sample_grasps(document), sample_grasps(document), sample_grasps(document, seed=1)
    for name in ("qpos", "ctrl", "variant"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    assert not np.array_equal(one.qpos, other.qpos) and one.scene == other.scene and one.settings != other.settings


@pytest.fixture
def give_up_early(monkeypatch):
    """Make sampling give up early."""
    monkeypatch.setattr(sampling, "ENOUGH", 20)


def test_an_object_that_slips_is_rejected(tmp_path, give_up_early):
    """Friction carries less than the weight: 2 μ F < m g."""
    document = write_pincer(tmp_path, friction=0.01)
    error = problem(lambda: sample_grasps(document, num=8))
    assert error.path == "grasps" and error.file == str(document)
    assert "only 0 of" in error.what and "variant 0 of rod hold" in error.what and "moved away" in error.what


def test_a_grasp_by_too_few_links_is_rejected(tmp_path, give_up_early):
    document = write_pincer(tmp_path)
    error = problem(lambda: sample_grasps(document, num=8, min_links=3))
    assert "held by too few links or from one side" in error.what


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
def test_impossible_settings_are_reported_at_their_place(tmp_path, written, overrides, path, says):
    document = write_pincer(tmp_path, grasps="grasps: {num: 2, closed: closed, yaw: 0, offset: 0, squeeze: 0.01}", **written)
    error = problem(lambda: sample_grasps(document, **overrides))
    assert error.path == path and says in error.what


@pytest.mark.parametrize("joint", ['<joint name="rod" type="slide" axis="0 0 1"/><joint name="turn" type="ball"/>'])
def test_objects_on_other_joints_are_held_while_the_hand_closes(tmp_path, joint):
    """A slide and a ball joint, as on the screwdriver: the object stays up until the jaws meet it."""
    document = write_pincer(tmp_path, joint=(joint, "0 1 0 0 0"))
    grasps = sample_grasps(document, num=4)
    assert np.abs(grasps.qpos[:, 3]).max() < 0.01
    np.testing.assert_allclose(np.linalg.norm(grasps.qpos[:, 4:], axis=1), 1.0, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_grasps_of_the_screwdriver():
    """Every handle, by three fingertips in the middle of their joints' ranges; two handles in three hold at once."""
    grasps = sample_grasps(REPOSITORY / "examples" / "tasks" / "screwdriver.yaml", num=64)
    assert np.bincount(grasps.variant).tolist() == [16] * 4
    lift, quat = grasps.qpos[:, 12], grasps.qpos[:, 13:]
    assert np.abs(lift).max() < 2.5e-3  # half the limit that ends an episode
    tilt = np.arccos(1 - 2 * (quat[:, 1] ** 2 + quat[:, 2] ** 2))
    assert tilt.max() < 0.1
    yaw = np.sort(2 * np.arctan2(quat[:, 3], quat[:, 0]) % (2 * np.pi))
    assert np.diff(yaw).max() < 0.6
