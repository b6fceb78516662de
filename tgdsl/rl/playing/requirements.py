"""What a policy is required to do: `coasting<0.1, penetration<2 mm, held>=95 %`, by the names of its evaluation and gait."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from operator import ge, gt, le, lt

from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.fields.units import Dimension, parse
from tgdsl.rl.playing.evaluation import Evaluation

SHARE = "share"
"""A plain number, or one in percent."""
SPIN = Dimension("angular speed", {"rad/s": 1.0})
DIMENSIONS: dict[str, str | Dimension] = {
    "score": "number",
    "held": SHARE,
    "coasting": SHARE,
    "untouched": SHARE,
    "saturation": SHARE,
    "any_saturation": SHARE,
    "penetration": "length",
    "force": "force",
    "speed": "speed",
    "spin": SPIN,
    "max_speed": "speed",
    "max_spin": SPIN,
    "joint_speed": SHARE,
}
"""What may be required: names of `Evaluation` and `Gait`, and what each is."""
COMPARISONS: dict[str, Callable[[float, float], bool]] = {"<=": le, ">=": ge, "<": lt, ">": gt}
_PART = re.compile(r"\s*(?P<name>[^\s<>=]+)\s*(?P<sign><=|>=|<|>)\s*(?P<value>[^<>=]+?)\s*\Z")


@dataclass(frozen=True)
class Requirement:
    """One thing that is required.

    Attributes:
        text: As it was written.
        name: A key of `DIMENSIONS`.
        sign: A key of `COMPARISONS`.
        bound: What the value is compared with, in SI units.
    """

    text: str
    name: str
    sign: str
    bound: float

    def failure(self, found: Evaluation) -> str | None:
        """Return why an evaluation does not meet this; None if it does."""
        value = getattr(found, self.name) if self.name in ("score", "held") else getattr(found.gait, self.name)
        if value is None:
            return f"not met: {self.text}: it was not measured: the task has none, or nothing was touched"
        return None if COMPARISONS[self.sign](value, self.bound) else f"not met: {self.text}: found {value:.4g}{self._unit}"

    @property
    def _unit(self) -> str:
        units = {"length": " m", "force": " N", "speed": " m/s", SPIN: " rad/s"}
        return units.get(DIMENSIONS[self.name], "")


def parse_requirements(text: str) -> list[Requirement]:
    """Return what a text requires, its parts separated by commas.

    Raises:
        TgdslError: If a part is not NAME<VALUE with a name and a unit that are known.
    """
    return [_requirement(part.strip()) for part in text.split(",")]


def _requirement(part: str) -> Requirement:
    match = _PART.match(part)
    if not match:
        expected = 'expected NAME<VALUE, such as "coasting<0.1, penetration<2 mm", with <, <=, > or >='
        raise TgdslError(f'--require "{part}": {expected}')
    name = match["name"]
    if name not in DIMENSIONS:
        raise TgdslError(f'--require "{part}": nothing is called "{name}"; {did_you_mean(name, DIMENSIONS, "names")}')
    try:
        bound = _bound(match["value"], DIMENSIONS[name])
    except ValueError as error:
        raise TgdslError(f'--require "{part}": {error}') from error
    return Requirement(part, name, match["sign"], bound)


def _bound(value: str, dimension: str | Dimension) -> float:
    if dimension != SHARE:
        return parse(value, dimension)
    return 0.01 * parse(value.removesuffix("%"), "number") if value.endswith("%") else parse(value, "number")
