"""What a task is told of its simulation."""

import pytest
import torch
from tiny_tasks import write_task

from tgdsl.errors import SimulationError, SpecError
from tgdsl.rl import env as env_file
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.sensed import num_variants

VARIANTS = """objects:
  ball:
    body: ball
    variants:
      - {type: sphere, size: [30 mm], density: 300}
      - {type: box, size: [10 mm, 20 mm, 50 mm], density: 300}
      - {type: cylinder, size: [20 mm, 15 mm], density: 300}
"""


def test_half_heights_are_those_of_each_environments_own_variant(tmp_path):
    """Geoms of the other variants are in each model too, and do not count."""
    env = TouchEnv(varied_task(tmp_path), 4, threads=1, overrides={"touch": "none"})
    assert env.task.setup.half_height.tolist() == pytest.approx([0.03, 0.05, 0.015, 0.03])
    env.close()


def test_an_object_stands_where_it_would_among_the_environments_of_all_processes(tmp_path):
    """Whichever variant the first environment of a process has: a box of 50 mm, a cylinder, and after them the sphere again."""
    task = varied_task(tmp_path)
    made = [
        TouchEnv(task, num, threads=1, overrides={"touch": "none"}, first_env=first) for num, first in ((6, 0), (1, 1), (3, 2))
    ]
    every, *others = (env.sim.qpos.clone() for env in made)
    torch.testing.assert_close(torch.cat(others), every[1:5], rtol=0, atol=0)
    assert len(set(every[:3, 5].tolist())) == 3
    for env in made:
        env.close()


@pytest.mark.parametrize(("chosen", "heights"), [([2, 0], [0.015, 0.03, 0.015]), ([1], [0.05] * 3)])
def test_a_task_takes_some_variants_in_its_own_order(tmp_path, chosen, heights):
    """Of one alone nothing is varied: it is the body's own geom."""
    task, overrides = varied_task(tmp_path), {"touch": "none", "variants": chosen}
    env = TouchEnv(task, 3, threads=1, overrides=overrides)
    setup = env.task.setup
    assert setup.half_height.tolist() == pytest.approx(heights)
    assert num_variants(load_task(task, overrides)) == setup.num_variants == len(chosen)
    assert setup.variant.tolist() == [env % len(chosen) for env in range(3)]
    env.close()


def test_variants_that_are_not_there_are_refused_at_their_place(tmp_path):
    plain = write_task(tmp_path)
    plain.write_text(plain.read_text() + "variants: [0]\n")
    assert refused(plain).endswith('variants: the object "ball" of "sensors.yaml" has no variants; leave it out')
    for found in ("[1, 3]", "[1, 1]"):
        task = varied_task(tmp_path)
        task.write_text(task.read_text() + f"variants: {found}\n")
        assert refused(task).endswith(f"variants[1]: variant {found[4]}, expected each once, from 0 to 2")


def refused(task):
    """Return what a document is refused with, which names its file and line."""
    with pytest.raises(SpecError) as caught:
        TouchEnv(task, 1, threads=1)
    (line,) = str(caught.value).splitlines()
    assert f"{task.name}:{task.read_text().count(chr(10))}:" in line
    return line


def varied_task(folder):
    """Write a task whose object has three variants; return its document."""
    task, sensors = write_task(folder), folder / "sensors.yaml"
    sensors.write_text(sensors.read_text().replace("objects: {ball: {body: ball}}\n", VARIANTS))
    return task


@pytest.mark.parametrize(("most", "threads"), [(0, 2), (2**16, 1)])
def test_logic_has_one_thread_and_readings_of_many_taxels_have_all(tmp_path, monkeypatch, most, threads):
    monkeypatch.setattr(env_file, "SINGLE_THREAD_MAX_TAXELS", most)
    env, seen = TouchEnv(varied_task(tmp_path), 4, threads=1), {}

    def noted(owner, name):
        method = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *given: (seen.setdefault(name, torch.get_num_threads()), method(*given))[1])

    for owner, name in ((env.sim, "read"), (env, "_judged"), (env, "_commanded"), (env, "_begin")):
        noted(owner, name)
    env.steps.fill_(env.max_steps)  # so that all episodes end
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        env.step(torch.zeros(4, env.num_actions))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert seen == {"read": threads, "_judged": 1, "_commanded": 1, "_begin": 1}


@pytest.mark.parametrize("num_envs", [0, -1, True])
def test_numbers_of_environments_that_are_none(tmp_path, num_envs):
    with pytest.raises(SimulationError, match=f"num_envs is {num_envs!r}, expected a whole number of at least 1"):
        TouchEnv(write_task(tmp_path), num_envs, threads=1, overrides={"touch": "none"})


def test_seeds_have_64_bits_and_environments_are_made_in_inference_mode_too(tmp_path):
    """Outside of it they go on."""
    task = write_task(tmp_path)
    with torch.inference_mode():
        env = TouchEnv(task, 1, threads=1, seed=2**63 - 1, overrides={"touch": "none"})
        env.step(torch.zeros(1, env.num_actions))
    env.step(torch.zeros(1, env.num_actions))
    assert env.num_envs == 1 and int(env.state_dict()["seed"]["seed"]) == 2**63 - 1
    with pytest.raises(SimulationError, match="the seed is 9223372036854775808, expected a whole number of 64 bits"):
        env.reset(2**63)
    env.close()
    with pytest.raises(SimulationError, match="the seed is -9223372036854775809"):
        TouchEnv(task, 1, threads=1, seed=-(2**63) - 1, overrides={"touch": "none"})


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_environments_are_the_same_whatever_torchs_default_dtype_is(tmp_path, dtype):
    """To the bit: made and stepped under another one."""
    task, made = write_task(tmp_path), []
    for default in (torch.float32, dtype):
        torch.set_default_dtype(default)
        try:
            env = TouchEnv(task, 2, threads=1, seed=3)
            steps = [env.step(torch.full((2, env.num_actions), 0.3, dtype=torch.float32)) for _ in range(5)]
        finally:
            torch.set_default_dtype(torch.float32)
        made.append([[*step.obs.values(), step.reward, step.info.episode_return] for step in steps] + [[env.sim.qpos.clone()]])
        env.close()
    for one, other in zip(*made, strict=True):
        assert all(own.dtype == its.dtype and torch.equal(own, its) for own, its in zip(one, other, strict=True))
