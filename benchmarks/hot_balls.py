"""Whether a hand can learn to find a ball by its heat: documents of the paper's settings, and a table of what was learned.

    python benchmarks/hot_balls.py documents out/hot_balls
    cd out/hot_balls                                                # then for each setting NAME:
    tgdsl train NAME.yaml --device cuda --minutes 10 --out NAME
    tgdsl evaluate NAME.yaml --policy NAME/policy.pt --out NAME.json
    python benchmarks/hot_balls.py table out/hot_balls

`documents` writes examples/tasks/hot_ball.yaml and bin.yaml once for each setting, with other fingers: by physics those of
bin.yaml, walls of half a millimetre whose pad lies on 1 cm²; by the paper's formula solid ones, with π δ for an area, δ = 1 mm.
`table` has a row for each setting that was evaluated: seconds S on the hot ball with the latch on, beside the paper's mark.
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
"""What a fingertip of each of the paper's conductivities [W/(m·K)] is like in all else."""
WALL = 0.1
"""Share of a finger's box that is solid, where it is a thin wall."""
PAPERS_AREA = 3.1416e-3
"""π δ for a penetration of 1 mm: a length, which the paper's formula takes for an area."""


@dataclass(frozen=True)
class Setting:
    """A cell of the paper's table, and by whose conduction.

    Attributes:
        model: "physics" or "paper".
        conductivity: Of the fingers [W/(m·K)].
        emissivity: Of the fingers.
        flux: Heat made in them, per area of one end [W/m²].
    """

    model: str
    conductivity: float
    emissivity: float
    flux: float = 500.0

    @property
    def name(self) -> str:
        """What its files are called."""
        return f"{self.model}_{self.conductivity:g}_{self.emissivity:g}"

    @property
    def is_found_by_the_paper(self) -> bool:
        """Whether the paper's hand keeps in touch with the ball: its figure on temperature."""
        return self.conductivity == 150.0 and self.emissivity == 0.5


SETTINGS = (
    Setting("physics", 150.0, 0.5),
    Setting("physics", 150.0, 0.85),
    Setting("physics", 100.0, 0.5),
    Setting("physics", 10.0, 0.5),
    Setting("paper", 1.0, 0.5),
    Setting("paper", 10.0, 0.5),
)
"""In these a pressed fingertip latches within 20 s by docs/background/heat.md, or walls are as thin; one of steel never does.

Good conductors diverge by the paper's formula."""


def heat_of(setting: Setting, heat: Mapping[str, Any], density: float) -> dict[str, Any]:
    """Return the fields of the temperature grid of a setting.

    Args:
        setting: The setting.
        heat: Those of bin.yaml.
        density: Of what the fingers are made of [kg/m³].
    """
    material = {"like": LIKE[setting.conductivity], "conductivity": setting.conductivity, "emissivity": setting.emissivity}
    own = dict(heat) | {"material": material, "source": {"flux": setting.flux, "face": "-z"}}
    if setting.model == "physics":
        own["material"] = material | {"density": WALL * density}
        return own
    del own["convection"]
    return own | {"model": "paper", "contact_area": PAPERS_AREA}


def documents(folder: Path) -> list[Path]:
    """Write a task and its sensors' document for each setting; return the tasks' files.

    Raises:
        FileError: If one cannot be written.
    """
    task, sensors = (YAML(typ="safe").load(TASKS / name) for name in ("hot_ball.yaml", "bin.yaml"))
    sensors["scene"] = {"model": str(TASKS / "bin.xml")}
    contents, files = {}, []
    for setting in SETTINGS:
        density = MATERIALS[LIKE[setting.conductivity]].density
        heat = heat_of(setting, sensors["sensors"]["heat"], density)
        own = sensors | {"sensors": sensors["sensors"] | {"heat": heat}}
        files.append(folder / f"{setting.name}.yaml")
        contents[folder / f"{setting.name}_sensors.yaml"] = _yaml(own)
        contents[files[-1]] = _yaml(task | {"document": f"{setting.name}_sensors.yaml"})
    with_folder(files[0])
    atomic_write_all(contents)
    return files


def table(folder: Path) -> str:
    """Return a table in Markdown, with a row for each setting whose evaluation is in a folder.

    Raises:
        TgdslError: If there is none, or one is of another task.
    """
    lines = ["| by | k [W/(m·K)] | ε | S [s], of 20 | 95 % | episodes | the paper's hand |", "|" + "---|" * 7]
    for setting in SETTINGS:
        file = folder / f"{setting.name}.json"
        if not file.is_file():
            continue
        try:
            found = json.loads(file.read_text())
        except ValueError as error:
            raise TgdslError(f"{file}: {error}; expected a file of tgdsl evaluate --out") from error
        if found.get("task") != "hot_ball":
            raise TgdslError(f'{file}: an evaluation in "{found.get("task")}", expected one in "hot_ball"')
        if missing := {"score", "score_interval", "episodes"} - found.keys():
            raise TgdslError(f"{file}: there is no {min(missing)}: this is not what tgdsl evaluate --out wrote")
        own = "physics, thin walls" if setting.model == "physics" else "the paper's formula"
        mark, ends = "✓" if setting.is_found_by_the_paper else "–", found["score_interval"]
        bounds = "–" if None in ends else "{:.2f} to {:.2f}".format(*ends)  # of one episode there is none
        cells = (
            own,
            f"{setting.conductivity:g}",
            f"{setting.emissivity:g}",
            f"{found['score']:.2f}",
            bounds,
            found["episodes"],
            mark,
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    if len(lines) == 2:
        raise TgdslError(f"{folder}: there is no evaluation of {', '.join(own.name for own in SETTINGS)}")
    return "\n".join(lines)


def _yaml(value: dict[str, Any]) -> bytes:
    text = io.BytesIO()
    YAML(typ="safe").dump(value, text)
    return text.getvalue()


def main(arguments: list[str] | None = None) -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("documents", "table"))
    parser.add_argument("folder", type=Path)
    given = parser.parse_args(arguments)
    try:
        print("\n".join(map(str, documents(given.folder))) if given.what == "documents" else table(given.folder))
    except TgdslError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
