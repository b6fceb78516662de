"""Compare a hand's surfaces with its vendor's: distance and angle from our taxels to the same link's mesh there.

Used by the hands' own `measure.py`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import igl
import numpy as np

from tgdsl.formats.model import Model
from tgdsl.formats.robot import load_model
from tgdsl.placement.sample.sample import Samples, sample
from tgdsl.schema import yaml
from tgdsl.schema.placement import LayoutSpec, Placement
from tgdsl.surfaces.surface import Surface

MAX_DISTANCE = 1e-3
"""The mean distance must be below this [m]."""
MAX_ANGLE = 20.0
"""The mean angle between normals must be below this [deg]."""


def layout(folder: Path) -> dict[str, dict[str, Placement]]:
    """Return how each link is sampled, by resolution and link name."""
    file = folder / "layout.yaml"
    return LayoutSpec.model_validate(yaml.parse(file.read_text(encoding="utf-8"), file.name).value).resolutions


def surface(robot: Model, link: str) -> Surface:
    """Return the surface of a link, in its body frame."""
    return robot.surface(robot.touchable(link))


def taxels(robot: Model, placements: dict[str, Placement], folder: Path) -> dict[str, Samples]:
    """Return each link's taxels, in its body frame."""
    return {link: sample(surface(robot, link), placement, folder) for link, placement in placements.items()}


def errors(samples: Samples, reference: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [m] of each taxel to a surface, and the angle [deg] to its normal at the nearest point."""
    squared, face, _ = igl.point_mesh_squared_distance(samples.pos, reference.vertices, reference.faces)
    cosine = (reference.face_normals[np.asarray(face)] * samples.normal).sum(axis=1)
    return np.sqrt(squared), np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def row(name: str, distance: np.ndarray, angle: np.ndarray) -> str:
    """Return a line of the report."""
    return (
        f"{name:<30} {len(distance):6d} {1e3 * distance.mean():8.3f} {1e3 * distance.max():7.3f}"
        f" {angle.mean():9.2f} {angle.max():8.2f}"
    )


def same_counts(folder: Path, ours: Model, reference: Model) -> bool:
    """Print the number of taxels at each resolution; return whether each link has as many on both surfaces."""
    is_same = True
    for resolution, placements in layout(folder).items():
        mine, theirs = (
            {link: len(samples.pos) for link, samples in taxels(robot, placements, folder).items()}
            for robot in (ours, reference)
        )
        print(f"{resolution}: {sum(mine.values())} taxels on our surfaces, {sum(theirs.values())} on the vendor's")
        is_same &= mine == theirs
    return is_same


def compare(folder: Path, model: str) -> None:
    """Print the comparison at the highest resolution, per link and in total; the argument names the vendor's folder.

    Exits with 1 if the mean distance is too large, the mean angle is, or the two give different taxel counts.

    Args:
        folder: Folder of the hand's model and layout.
        model: Name of the model's file there.
    """
    parser = argparse.ArgumentParser(description="Compare our surfaces with the vendor's.")
    parser.add_argument("reference_dir", type=Path, help="folder that holds the vendor's URDF and meshes")
    [urdf] = parser.parse_args().reference_dir.glob("*.urdf")
    ours, reference = load_model(folder / model), load_model(urdf)
    is_good = same_counts(folder, ours, reference)
    placed = taxels(ours, layout(folder)["high"], folder)
    found = {link: errors(samples, surface(reference, link)) for link, samples in placed.items()}
    print(f"{'link':<30} taxels  mean mm  max mm  mean deg  max deg")
    for link, (distance, angle) in found.items():
        print(row(link, distance, angle))
    distance, angle = (np.concatenate(parts) for parts in zip(*found.values(), strict=True))
    print(row("all", distance, angle))
    sys.exit(0 if is_good and distance.mean() < MAX_DISTANCE and angle.mean() < MAX_ANGLE else 1)
