"""The small task with two links that feel, by sensors of three kinds."""

from pathlib import Path

from small_tasks import small_task

SENSORS = """tgdsl: 1
robot:
  model: scene.xml
  layout:
    groups: {ends: [tip], all: ["*"]}
    resolutions:
      low:
        tip: {method: grid, rows: 2, columns: 2, direction: [0, 0, 1], radius: 8 mm}
        finger: {method: grid, rows: 3, columns: 2, direction: [0, -1, 0], radius: 8 mm}
objects: {item: {body: item}}
resolution: low
sensors:
  bit: {kind: contact, links: tip, feels: [item], threshold: 0.5 mm, release_threshold: 0.2 mm}
  deep: {kind: contact_depth, links: tip, feels: [item]}
  soft: {kind: kinematic_taxel, links: tip, feels: [item], normal_stiffness: 500}
  felt: {kind: link_contact, links: tip, feels: [item], outputs: [force]}
  gap: {kind: surface_distance, links: tip, feels: [item], max_range: 10 cm}
"""


def felt_task(folder: Path) -> Path:
    """Write the task's files; return its document."""
    task = small_task(folder)
    (folder / "sensors.yaml").write_text(SENSORS)
    task.write_text(task.read_text().replace("randomise: {", "randomise: {friction: [0.5, 1], "))
    return task
