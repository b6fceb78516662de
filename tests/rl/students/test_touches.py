"""Several kinds of touch in one simulation: each equals that of a separate environment."""

from pathlib import Path

import pytest
import torch
from felt_tasks import felt_task

from tgdsl.errors import SpecError
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import PolicyTouch
from tgdsl.rl.students.keys import grid_of
from tgdsl.rl.students.student import Images

TYPES = ("bool", "agg_bool", "depth", "agg_force", "force", "force_torque")
TOUCHES = [
    PolicyTouch(type_, placement, noise) for type_ in TYPES for placement in ("ends", "all") for noise in ("clean", "noisy")
]
ENVS = 3


@pytest.fixture
def make(tmp_path: Path):
    envs, task = [], felt_task(tmp_path)

    def environment(touches=None, **overrides):
        envs.append(TouchEnv(task, ENVS, seed=3, threads=1, overrides=overrides, touches=touches))
        return envs[-1]

    yield environment
    for env in envs:
        env.close()


def rollout(env, steps=12):
    """Return observations while the finger swings onto the object, across the end of an episode."""
    observations = [env.reset(3)]
    for step in range(steps):
        observations.append(env.step(torch.full((ENVS, 2), 1.0 if step % 8 < 4 else -1.0)).obs)
    return {name: torch.stack([obs[name] for obs in observations]) for name in observations[0]}


def assert_same(one, two):
    """Compare up to rounding: vector instructions round the tail of an array differently."""
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-6 * float(two.abs().max()))


def test_each_group_equals_that_of_a_separate_environment(make):
    """Also with noise, where no other links draw numbers first; other observations are equal too."""
    env = make(TOUCHES)
    together = rollout(env)
    assert "tactile_sensors" not in together
    for number, type_ in enumerate(TYPES):
        touch = PolicyTouch(type_, ("ends", "all")[number % 2], "clean")
        alone = rollout(make(touch=touch.type, placement=touch.placement))
        assert_same(together[touch.group], alone["tactile_sensors"])
        assert (alone["tactile_sensors"] != 0).any(), touch
        assert torch.equal(together["priv_obj_state"], alone["priv_obj_state"])
    noisy, clean = (together[PolicyTouch("depth", "all", noise).group] for noise in ("noisy", "clean"))
    assert not torch.equal(noisy, clean)
    alone = rollout(make(touch="depth", placement="all", noise="noisy"))
    assert_same(noisy, alone["tactile_sensors"])


def test_one_sensor_serves_all_types_placements_and_noises(make):
    env = make(TOUCHES)
    assert {sensor.name for sensor in env.touch.plan.sensors if sensor.name in ("bit", "deep", "soft")} == {
        "bit",
        "deep",
        "soft",
    }
    assert env.touch_sources[PolicyTouch("depth", "ends", "clean").group].layout.num_taxels == 4
    assert env.touch_sources[PolicyTouch("depth", "all", "clean").group].layout.num_taxels == 10
    assert env.groups[PolicyTouch("force_torque", "ends", "noisy").group] == 24
    assert env.groups[PolicyTouch("agg_force", "ends", "noisy").group] == 3


def test_an_empty_list_gives_no_touch(make):
    assert not [name for name in make([]).groups if name.startswith("tactile")]


def test_errors_are_named(make, tmp_path):
    with pytest.raises(SpecError, match='has no sensor of kind "elastomer", expected one'):
        make([PolicyTouch("elastomer", "all", "clean")])
    with pytest.raises(SpecError, match='no link matches "palm"'):
        make([PolicyTouch("depth", "palm", "clean")])
    both = [PolicyTouch("depth", "all", noise) for noise in ("noisy", "other")]
    with pytest.raises(SpecError, match="noise noisy, other of one sensor in one simulation, expected at most one and clean"):
        make(both)
    assert load_task(tmp_path / "task.yaml").spec.touch == "bool"


@pytest.mark.parametrize("placement", ["ends", "all"])
def test_images_of_a_network_equal_the_modules(make, placement):
    """They are built from the group's numbers; a link with a smaller grid fills a corner."""
    touch = PolicyTouch("force_torque", placement, "clean")
    env, alone = make([touch, PolicyTouch("force_torque", "all", "clean")]), make(touch="force_torque", placement=placement)
    grid = grid_of(env.touch_sources[touch.group].layout, env.groups[touch.group], touch)
    action = torch.full((ENVS, 2), 0.3)
    for _ in range(3):
        obs, separate_obs = env.step(action).obs, alone.step(action).obs
    assert_same(obs[touch.group], separate_obs["tactile_sensors"])
    assert (obs[touch.group] != 0).any()
    network_images = Images(grid).images(obs[touch.group])
    images, masks = alone.images()
    assert network_images.shape[1] == len(images) == (1 if placement == "ends" else 2)
    for link, (image, mask) in enumerate(zip(images.values(), masks.values(), strict=True)):
        rows, columns = mask.shape
        assert torch.equal(network_images[:, link, :, :rows, :columns], image)
        assert float(Images(grid).mask[link].sum()) == float(mask.sum())
