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

The features of each group, in order, of the documents in `examples/tasks/`: what `print(env.describe())` shows. Of other
documents (`touch`, `placement`, `resolution`, `goal`, `temporal`) they are others.

- A unit is that of the quantity; features are the quantity times `scale`.
- `world` are the scene's axes, `link` those of the link's body; `–`: no direction.
- Six numbers of an orientation are its matrix's first column, the turned x axis, then the second one.
- Rows of a sensor are those of `env.touch.rows[sensor]`: places in the frame of `body`, normals, radii.
- Velocities are those of the body frame's origin.
- All is of one instant: after a step, of the start of its last physics step.
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
