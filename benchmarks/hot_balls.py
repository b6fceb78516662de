"""Write documents of the paper's settings in which a hand learns to find a ball by its heat, and tabulate their evaluations.

    python benchmarks/hot_balls.py documents out/hot_balls
    cd out/hot_balls                                                # then for each setting NAME:
    tgdsl train NAME.yaml --device cuda --minutes 10 --out NAME
    tgdsl evaluate NAME.yaml --policy NAME/policy.pt --out NAME.json
    python benchmarks/hot_balls.py table out/hot_balls

`documents` writes examples/tasks/hot_ball.yaml and bin.yaml for each setting, with different fingers. By physics they are those
of bin.yaml: walls of half a millimetre with a contact area of 1 cm². By the paper's formula they are solid, with π δ as the
area, δ = 1 mm. `table` has a row per evaluated setting: seconds S on the hot ball with the latch on, and the paper's result.
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from tgdsl.errors import TgdslError
from tgdsl.fields.materials import MATERIALS
from tgdsl.files.write import atomic_write_all, with_folder

TASKS = Path(__file__).parents[1] / "examples" / "tasks"
LIKE = {1.0: "glass", 10.0: "stainless_steel", 100.0: "aluminium", 150.0: "aluminium"}
"""Material with a fingertip's other properties, by the paper's conductivities [W/(m·K)]."""
WALL = 0.1
"""Solid share of a thin-walled finger's box."""
PAPERS_AREA = 3.1416e-3
"""π δ for a penetration of 1 mm: a length, which the paper's formula uses as an area."""


@dataclass(frozen=True)
class Setting:
    """A cell of the paper's table, and the model of conduction.

    Attributes:
        model: "physics" or "paper".
        conductivity: Conductivity of the fingers [W/(m·K)].
        emissivity: Emissivity of the fingers.
        flux: Power of the heaters per area of one end [W/m²].
    """

    model: str
    conductivity: float
    emissivity: float
    flux: float = 500.0

    @property
    def name(self) -> str:
        """Stem of its files."""
        return f"{self.model}_{self.conductivity:g}_{self.emissivity:g}"

    @property
    def is_found_by_the_paper(self) -> bool:
        """Whether the paper's hand keeps touching the ball, by its figure on temperature."""
        return self.conductivity == 150.0 and self.emissivity == 0.5


SETTINGS = (
    Setting("physics", 150.0, 0.5),
    Setting("physics", 150.0, 0.85),
    Setting("physics", 100.0, 0.5),
    Setting("physics", 10.0, 0.5),
    Setting("paper", 1.0, 0.5),
    Setting("paper", 10.0, 0.5),
)
"""Settings in which a pressed fingertip latches within 20 s by docs/background/heat.md, or has as thin walls; steel never does.

By the paper's formula good conductors diverge.
"""


def heat_of(setting: Setting, heat: Mapping[str, Any], density: float) -> dict[str, Any]:
    """Return the fields of the temperature grid of a setting.

    Args:
        setting: The setting.
        heat: The fields in bin.yaml.
        density: Density of the fingers' material [kg/m³].
    """
    material = {"like": LIKE[setting.conductivity], "conductivity": setting.conductivity, "emissivity": setting.emissivity}
    fields = dict(heat) | {"material": material, "source": {"flux": setting.flux, "face": "-z"}}
    if setting.model == "physics":
        fields["material"] = material | {"density": WALL * density}
        return fields
    del fields["convection"]
    return fields | {"model": "paper", "contact_area": PAPERS_AREA}


def documents(folder: Path) -> list[Path]:
    """Write a task and its sensors' document for each setting; return the tasks' files."""
    task, sensors = (YAML(typ="safe").load(TASKS / name) for name in ("hot_ball.yaml", "bin.yaml"))
    sensors["scene"] = {"model": str(TASKS / "bin.xml")}
    contents, files = {}, []
    for setting in SETTINGS:
        density = MATERIALS[LIKE[setting.conductivity]].density
        heat = heat_of(setting, sensors["sensors"]["heat"], density)
        document = sensors | {"sensors": sensors["sensors"] | {"heat": heat}}
        files.append(folder / f"{setting.name}.yaml")
        contents[folder / f"{setting.name}_sensors.yaml"] = _yaml(document)
        contents[files[-1]] = _yaml(task | {"document": f"{setting.name}_sensors.yaml"})
    with_folder(files[0])
    atomic_write_all(contents)
    return files


def table(folder: Path) -> str:
    """Return a Markdown table with a row for each setting whose evaluation is in a folder.

    Raises:
        TgdslError: If there is no evaluation, or one of another task.
    """
    lines = ["| by | k [W/(m·K)] | ε | S [s], of 20 | 95 % | episodes | the paper's hand |", "|" + "---|" * 7]
    for setting in SETTINGS:
        file = folder / f"{setting.name}.json"
        if not file.is_file():
            continue
        evaluation = json.loads(file.read_text())
        if evaluation["task"] != "hot_ball":
            raise TgdslError(f'{file}: an evaluation in "{evaluation["task"]}", expected one in "hot_ball"')
        model = "physics, thin walls" if setting.model == "physics" else "the paper's formula"
        verdict, interval = "✓" if setting.is_found_by_the_paper else "–", evaluation["score_interval"]
        bounds = "–" if None in interval else "{:.2f} to {:.2f}".format(*interval)  # none for a single episode
        cells = f"{model} | {setting.conductivity:g} | {setting.emissivity:g} | {evaluation['score']:.2f} | {bounds}"
        lines.append(f"| {cells} | {evaluation['episodes']} | {verdict} |")
    if len(lines) == 2:
        raise TgdslError(f"{folder}: there is no evaluation of {', '.join(setting.name for setting in SETTINGS)}")
    return "\n".join(lines)


def _yaml(value: dict[str, Any]) -> bytes:
    text = io.BytesIO()
    YAML(typ="safe").dump(value, text)
    return text.getvalue()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("documents", "table"))
    parser.add_argument("folder", type=Path)
    options = parser.parse_args(arguments)
    try:
        print("\n".join(map(str, documents(options.folder))) if options.command == "documents" else table(options.folder))
    except TgdslError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
