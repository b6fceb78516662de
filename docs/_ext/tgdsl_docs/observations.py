"""What the features of tasks' observations are: `env.describe()` of each task's document."""

from __future__ import annotations

from pathlib import Path

from tgdsl.rl.description import HEADER, Description
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.tasks import TASKS
from tgdsl_docs.tables import table

FEWER = {"screwdriver": {"grasps.num": 4}}
"""What of a document is less for these pages, and changes no feature."""
TEXT = """# Observations

This page lists the features of each group, in order, for the documents in `examples/tasks/`, as `print(env.describe())` does.
A document with another `touch`, `placement`, `resolution`, `goal` or `temporal` has other features.

- A feature is the quantity times `scale`; the unit belongs to the quantity.
- `world` means the scene's axes, `link` the axes of the link's body, `–` no direction.
- The six numbers of an orientation are the first two columns of its rotation matrix.
- `env.touch.rows[sensor]` has the rows of a sensor: positions in the frame of `body`, normals, radii.
- A velocity is the velocity of the body frame's origin.
- All features belong to one instant: the start of the last physics step.
"""


def observation_pages(source: Path) -> dict[str, str]:
    """Return one page with the features of all tasks."""
    text = [TEXT]
    for name in TASKS:
        document = source.parent / "examples" / "tasks" / f"{name}.yaml"
        env = TouchEnv(document, 1, threads=1, overrides=FEWER.get(name))
        text.append(f"\n## `{name}`\n\n{table(HEADER, _rows(env.describe()))}")
        env.close()
    return {"observations.md": "".join(text)}


def _rows(description: Description) -> list[tuple[str, ...]]:
    return [(f"`{group}`", *cells) for group, *cells in description.rows()]
