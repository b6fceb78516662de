"""What episodes bring, added up to be shown: score, return and each term of the reward."""

from __future__ import annotations

from torch import Tensor

from tgdsl.console.tables import text_table
from tgdsl.rl.env import StepInfo, TouchEnv


class Tally:
    """Means over environments: of the present episodes so far, and of those that have ended.

    Attributes:
        num_ended: How many episodes have ended.
        num_faults: How many of them a fault has ended.
    """

    def __init__(self, env: TouchEnv):
        self._env = env
        self.num_ended = self.num_faults = 0
        self._now: dict[str, float] = {}
        self._sums: dict[str, float] = {}

    def add(self, info: StepInfo) -> None:
        """Add one step."""
        values = {f"score [{self._env.task.score_unit}]": info.score, "return": info.episode_return}
        values |= {f"  {name}": total for name, total in info.episode_terms.items()}
        self.num_ended += int(info.ended.sum())
        self.num_faults += int(info.faults.sum())
        self._now = {name: _mean(value) for name, value in values.items()}
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + float(value[info.ended].double().sum())

    def lines(self, time: float) -> list[str]:
        """Return the table."""
        faults = f", {self.num_faults} by a fault" if self.num_faults else ""
        first = f"t = {time:.2f} s, {self._env.num_envs} environments, {self.num_ended} episodes ended{faults}"
        count = self.num_ended
        rows = [(name, f"{now:.3g}", f"{self._sums[name] / count:.3g}" if count else "–") for name, now in self._now.items()]
        return [first, *text_table(("mean over environments", "so far", "ended"), rows).splitlines()]


def _mean(values: Tensor) -> float:
    return float(values.double().mean())
