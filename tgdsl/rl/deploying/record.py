"""A record of what a policy did on a source, as one `.npz` file, and in short.

Shapes: `step` control steps, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tgdsl.console.tables import text_table
from tgdsl.files.write import atomic_open, with_folder
from tgdsl.rl.deploying.deploy import Moment
from tgdsl.rl.deploying.prepared import Prepared


class DeployRecord:
    """Keeps control steps and writes them.

    The file holds, of each control step, its `episode` and `index` in it (step,), observations `obs:<group>` (step, feature)
    that the action was chosen from, the `action` (step, joint) from −1 to 1, the `target` (step, joint) [rad], `age` and
    `inference` (step,) [s], and the `score` so far (step,); an age and a score that are not known are NaN. `joints` names the
    joints.
    """

    def __init__(self, prepared: Prepared):
        """Begin."""
        self._joints = prepared.moved.names
        self._rows: list[dict[str, np.ndarray]] = []

    @property
    def num_steps(self) -> int:
        """How many steps it holds."""
        return len(self._rows)

    def add(self, moment: Moment) -> None:
        """Keep one step."""
        row = {name: np.array(getattr(moment, name)) for name in ("episode", "index")}
        row |= {f"obs:{name}": value[0].numpy() for name, value in moment.obs.items()}
        row |= {"action": moment.action[0].numpy(), "target": moment.target[0].numpy()}
        row["age"] = np.array(np.nan if moment.age_s is None else moment.age_s)
        row["inference"] = np.array(moment.inference_s)
        self._rows.append(row | {"score": np.array(np.nan if moment.judged is None else moment.judged.score)})

    def lines(self) -> list[str]:
        """Return a table of actions and targets, joint by joint."""
        action, target = (np.stack([row[name] for row in self._rows]) for name in ("action", "target"))
        rows = [
            (name, f"{action[:, i].mean():.3f}", f"{action[:, i].std():.3f}", f"{low:.3f} to {high:.3f}")
            for i, (name, low, high) in enumerate(zip(self._joints, target.min(axis=0), target.max(axis=0), strict=True))
        ]
        return text_table(("joint", "mean action", "spread", "targets [rad]"), rows).splitlines()

    def write(self, path: Path) -> None:
        """Write the file; it appears whole or not at all."""
        columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        with atomic_open(with_folder(path)) as file:
            np.savez_compressed(file, **columns, joints=np.array(self._joints))  # type: ignore[arg-type]
