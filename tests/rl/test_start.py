"""Setup of a task from its simulation, and construction of environments."""

import pytest
import torch
from tiny_tasks import write_task

from tgdsl.errors import SimulationError, SpecError
from tgdsl.rl import env as env_file
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import load_task
from tgdsl.rl.sensors import num_variants

VARIANTS = """objects:
  ball:
    body: ball
    variants:
      - {type: sphere, size: [30 mm], density: 300}
      - {type: box, size: [10 mm, 20 mm, 50 mm], density: 300}
      - {type: cylinder, size: [20 mm, 15 mm], density: 300}
"""


def test_half_heights_follow_each_environments_variant(tmp_path):
    """Each model also contains the other variants' geoms, which do not count."""
    env = TouchEnv(varied_task(tmp_path), 4, threads=1, overrides={"touch": "none"})
    assert env.task.setup.half_height.tolist() == pytest.approx([0.03, 0.05, 0.015, 0.03])
    env.close()


def test_starting_heights_do_not_depend_on_the_split_into_processes(tmp_path):
    """A process may begin with any variant: a box of 50 mm, a cylinder, then the sphere again."""
    task = varied_task(tmp_path)
    envs = [
        TouchEnv(task, num, threads=1, overrides={"touch": "none"}, first_env=first) for num, first in ((6, 0), (1, 1), (3, 2))
    ]
    whole, *parts = (env.sim.qpos.clone() for env in envs)
    torch.testing.assert_close(torch.cat(parts), whole[1:5], rtol=0, atol=0)
    assert len(set(whole[:3, 5].tolist())) == 3
    for env in envs:
        env.close()


@pytest.mark.parametrize(("chosen", "heights"), [([2, 0], [0.015, 0.03, 0.015]), ([1], [0.05] * 3)])
def test_a_task_chooses_and_orders_variants(tmp_path, chosen, heights):
    """With a single variant nothing varies: its geom belongs to the body itself."""
    task, overrides = varied_task(tmp_path), {"touch": "none", "variants": chosen}
    env = TouchEnv(task, 3, threads=1, overrides=overrides)
    setup = env.task.setup
    assert setup.half_height.tolist() == pytest.approx(heights)
    assert num_variants(load_task(task, overrides)) == setup.num_variants == len(chosen)
    assert setup.variant.tolist() == [env % len(chosen) for env in range(3)]
    env.close()


def test_unknown_variants_are_refused_at_their_place(tmp_path):
    plain = write_task(tmp_path)
    plain.write_text(plain.read_text() + "variants: [0]\n")
    assert refusal(plain).endswith('variants: the object "ball" of "sensors.yaml" has no variants; leave it out')
    for variants in ("[1, 3]", "[1, 1]"):
        task = varied_task(tmp_path)
        task.write_text(task.read_text() + f"variants: {variants}\n")
        assert refusal(task).endswith(f"variants[1]: variant {variants[4]}, expected each once, from 0 to 2")


def refusal(task):
    """Return the error of a refused document, which names its file and line."""
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
def test_logic_uses_one_thread_and_large_readings_use_all(tmp_path, monkeypatch, most, threads):
    monkeypatch.setattr(env_file, "SINGLE_THREAD_MAX_TAXELS", most)
    env, num_threads = TouchEnv(varied_task(tmp_path), 4, threads=1), {}

    def record(owner, name):
        method = getattr(owner, name)
        monkeypatch.setattr(
            owner, name, lambda *args: (num_threads.setdefault(name, torch.get_num_threads()), method(*args))[1]
        )

    for owner, name in ((env.sim, "read"), (env, "_judged"), (env, "_commanded"), (env, "_begin")):
        record(owner, name)
    env.steps.fill_(env.max_steps)  # all episodes end
    default = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        env.step(torch.zeros(4, env.num_actions))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(default)
    assert num_threads == {"read": threads, "_judged": 1, "_commanded": 1, "_begin": 1}


@pytest.mark.parametrize("num_envs", [0, -1, True])
def test_invalid_numbers_of_environments_are_refused(tmp_path, num_envs):
    with pytest.raises(SimulationError, match=f"num_envs is {num_envs!r}, expected a whole number of at least 1"):
        TouchEnv(write_task(tmp_path), num_envs, threads=1, overrides={"touch": "none"})


def test_seeds_have_64_bits_and_inference_mode_is_allowed(tmp_path):
    """Environments made in inference mode also step outside of it."""
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
def test_environments_do_not_depend_on_torchs_default_dtype(tmp_path, dtype):
    """Equal to the bit when made and stepped under another dtype."""
    task, outputs = write_task(tmp_path), []
    for default in (torch.float32, dtype):
        torch.set_default_dtype(default)
        try:
            env = TouchEnv(task, 2, threads=1, seed=3)
            steps = [env.step(torch.full((2, env.num_actions), 0.3, dtype=torch.float32)) for _ in range(5)]
        finally:
            torch.set_default_dtype(torch.float32)
        outputs.append(
            [[*step.obs.values(), step.reward, step.info.episode_return] for step in steps] + [[env.sim.qpos.clone()]]
        )
        env.close()
    for one, other in zip(*outputs, strict=True):
        assert all(
            value.dtype == other_value.dtype and torch.equal(value, other_value)
            for value, other_value in zip(one, other, strict=True)
        )
