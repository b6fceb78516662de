"""What a task is told of its simulation."""

import pytest
from tiny_tasks import write_task

from tgdsl.rl.env import TouchEnv

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
    task = write_task(tmp_path)
    sensors = tmp_path / "sensors.yaml"
    sensors.write_text(sensors.read_text().replace("objects: {ball: {body: ball}}\n", VARIANTS))
    env = TouchEnv(task, 4, threads=1, overrides={"touch": "none"})
    assert env.task.setup.half_height.tolist() == pytest.approx([0.03, 0.05, 0.015, 0.03])
    env.close()
