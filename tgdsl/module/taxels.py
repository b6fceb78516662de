"""The taxels of a module as tables and images, the check that two modules' taxels agree, and artefacts' files.

Shapes: `env` environments, `taxel` taxels of one sensor, `channel` numbers per taxel, `row`, `column` cells of a link's grid.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialized
from torch import Tensor

from tgdsl.console.tables import TaxelTable
from tgdsl.errors import ArtifactError, TaxelError, TgdslError, did_you_mean
from tgdsl.files.arrays import read_arrays
from tgdsl.files.write import atomic_write
from tgdsl.layout.identity import REQUIRED, Columns, check_same_rows, columns_of, is_same_id
from tgdsl.layout.layout import Layout
from tgdsl.module.memory import last_step
from tgdsl.plan.plan import Plan
from tgdsl.quantities import QUANTITIES
from tgdsl.quantities.base import Quantity
from tgdsl.scene.asset_paths import check_scene
from tgdsl.tensors.torch_internals import HookedModule

METADATA_KEY = "tgdsl"
_TAXELS = "taxels"
_ID = re.compile(r"[0-9a-f]{32}")


def save_plan(plan: Plan, path: str | PathLike[str]) -> int:
    """Write the artefact of a plan: its arrays, and the rest as sorted JSON in the metadata; return the bytes written."""
    content = serialized({name: np.asarray(value) for name, value in plan.arrays.items()}, {METADATA_KEY: plan.to_json()})
    atomic_write(Path(path), content)
    return len(content)


def load_plan(path: str | PathLike[str], quantities: Sequence[Quantity] = QUANTITIES) -> Plan:
    """Read an artefact that may ask for some quantities. Only the artefact itself is opened: no file that it names.

    Raises:
        ArtifactError: If the file is not an artefact, is damaged, is of another version, or names files in places where an
            artefact's files cannot be.
    """
    if Path(path).is_dir():
        raise ArtifactError(f"{path}: this is a folder, expected an artefact such as {Path(path) / 'hand.safetensors'}")
    try:
        with safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except (SafetensorError, OSError) as error:
        if isinstance(error, SafetensorError) and Path(path).suffix in (".yaml", ".yml"):
            raise ArtifactError(f"{path}: this is a document, not an artefact; tgdsl.compile reads documents") from error
        raise ArtifactError(f"{path}: cannot read this artefact: {error}") from error
    if METADATA_KEY not in metadata:
        raise ArtifactError(f"{path}: this safetensors file was not written by tgdsl")
    for array in arrays.values():
        array.flags.writeable = False
    try:
        plan = Plan.from_json(metadata[METADATA_KEY], arrays, quantities)
        check_scene(plan.scene)
        return plan
    except ArtifactError as error:
        raise ArtifactError(f"{path}: {error}") from error


@runtime_checkable
class HasPlan(Protocol):
    """A module, as far as its taxels go."""

    @property
    def plan(self) -> Plan:
        """What it was built from."""
        ...


Taxels = HasPlan | Mapping[str, Any] | str | PathLike[str]  # taxels that are expected, see `check_taxels`


def check_taxels(touch: HasPlan, expected: Taxels, what: str = "this module") -> None:
    """Raise an error if a module's sensors have other taxels than expected, or the same taxels in another order.

    Comparisons allow for rounding: see `layout.identity`. Sensors without an expected table may have any taxels.

    Args:
        touch: The module.
        expected: Another module; tables by sensor, as `TactileModule.taxels` has them; the file of an artefact (.safetensors)
            or of a rollout (.npz); or the id of a module's taxels, `TactileModule.taxels_id`.
        what: Name of the module, with which the message begins.

    Raises:
        TaxelError: If taxels differ; the message has the number of rows, and the first row that differs.
        ArtifactError: If an artefact cannot be read.
        TgdslError: If `expected` is none of these.
    """
    plan = touch.plan
    if isinstance(expected, str) and _ID.fullmatch(expected):
        if not is_same_id(plan.taxels_id, expected):
            has = f"the taxels' id is {plan.taxels_id}, {expected} is expected: {plan.layout.num_taxels} taxels of"
            hint = "a table, an artefact or a module would say which rows differ"
            raise TaxelError(f"{what}: {has} {len(plan.layout.links)} links are others; {hint}")
        return
    tables, module_tables = _tables(expected), plan_tables(plan)
    for sensor, table in tables.items():
        if sensor not in module_tables:
            hint = did_you_mean(sensor, module_tables, "sensors with taxels")
            raise TaxelError(f'{what}: there is no sensor "{sensor}", whose taxels are expected; {hint}')
        check_same_rows(module_tables[sensor], table, f'{what}: sensor "{sensor}"')


def plan_tables(plan: Plan) -> dict[str, dict[str, np.ndarray]]:
    """Return the taxels of each sensor that has some, by columns."""
    return {sensor.sensor: columns_of(plan.layout_of(sensor)) for sensor in plan.sensors if len(sensor.taxels)}


class SavedTaxels(HookedModule):
    """Notes a module's taxels in the metadata of its state dict, and refuses a state dict of other taxels.

    It has no tensors, so that the state dict has no more keys. One without metadata, a plain dictionary, is not looked at.
    """

    def __init__(self, plan: Plan):
        super().__init__()
        self.plan = plan
        self.register_state_dict_post_hook(_note_taxels)

    def on_load_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Compare the taxels that are noted with the module's own."""

        def unpacked(column: list[str] | Tensor) -> np.ndarray:
            return column.cpu().numpy() if isinstance(column, Tensor) else np.array(column)

        if _TAXELS in metadata:
            saved = metadata[_TAXELS].items()
            tables = {name: {key: unpacked(column) for key, column in table.items()} for name, table in saved}
            check_taxels(self, tables, "the state dict is of another module")


def _note_taxels(module: SavedTaxels, state_dict: Any, prefix: str, metadata: dict[str, Any]) -> None:
    """Note tables as texts and tensors, which `torch.load` reads with `weights_only`."""

    def packed(column: np.ndarray) -> list[str] | Tensor:
        return column.tolist() if column.dtype.kind == "U" else torch.from_numpy(column.copy())

    tables = plan_tables(module.plan).items()
    metadata[_TAXELS] = {name: {key: packed(column) for key, column in table.items()} for name, table in tables}


def _tables(expected: Taxels) -> Mapping[str, Columns]:
    """Return the tables by sensor that something other than an id holds."""
    if isinstance(expected, Mapping):
        return {str(name): _columns(table, f'taxels["{name}"]') for name, table in expected.items()}
    if isinstance(plan := getattr(expected, "plan", None), Plan):
        return plan_tables(plan)
    if isinstance(expected, (str, PathLike)):
        path = Path(expected)
        if path.suffix == ".safetensors":
            return plan_tables(load_plan(path))
        if path.suffix == ".npz":
            return _rollout_tables(path)
    kinds = "a module, tables by sensor, an artefact (.safetensors), a rollout (.npz) or an id of 32 hexadecimal digits"
    raise TgdslError(f"taxels are expected by {kinds}, found {expected!r}")


def _columns(table: Any, name: str) -> dict[str, np.ndarray]:
    names = getattr(getattr(table, "dtype", None), "names", None) or (tuple(table) if isinstance(table, Mapping) else ())
    if missing := [column for column in REQUIRED if column not in names]:
        raise TgdslError(f"{name} has no column {', '.join(missing)}, expected a table as in `TactileModule.taxels`")
    return {column: np.asarray(table[column]) for column in names}


def _rollout_tables(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """Return the tables that the file of a rollout holds, by sensor: `<reading>:<column>`."""
    tables: dict[str, dict[str, np.ndarray]] = {}
    for key, array in read_arrays(path, "the .npz file of a rollout").items():
        reading, _, column = key.rpartition(":")
        tables.setdefault(reading, {})[column] = array
    result = {name.partition("/")[0]: table for name, table in tables.items() if {"pos", "link"} <= table.keys()}
    if not result:
        raise TgdslError(f"{path}: this .npz file holds no table of taxels")
    return {name: _columns(table, f"{path}: {name}") for name, table in result.items()}


def _structured(columns: Mapping[str, np.ndarray], size: int) -> TaxelTable:
    fields = [(name, column.dtype, column.shape[1:]) for name, column in columns.items()]
    table = np.empty(size, dtype=np.dtype(fields, align=True))  # torch takes a column without a copy
    for name, column in columns.items():
        table[name] = column
    return table.view(TaxelTable)


def taxel_table(layout: Layout) -> TaxelTable:
    """Return a layout as a NumPy structured array that prints as a table, a row per taxel.

    Columns: `link`, `body`, `pos` and `normal` and `tangent` (body frame), `radius` [m], `area` [m²], `row`, `column` (−1 where
    there is no grid), `groups` (names joined by commas).
    """
    groups = [",".join(g for g, members in layout.groups.items() if link.name in members) for link in layout.links]
    return _structured({**columns_of(layout), "groups": np.array(groups)[layout.link_id]}, layout.num_taxels)


def row_tables(plan: Plan) -> dict[str, TaxelTable]:
    """Return what the rows of each reading of a sensor are: of taxels `taxel_table`, else what its kind declares."""
    result = {}
    for sensor in plan.sensors:
        for reading, axis in zip(sensor.readings, sensor.axes, strict=True):
            if axis.name == "taxel":
                result[reading.name] = taxel_table(plan.layout_of(sensor))
                continue
            columns = {**{name: np.array(texts) for name, texts in axis.texts.items()}, **axis.numbers}
            if axis.name == "body" and "body" in axis.texts:
                links = plan.layout_of(sensor).links
                names = [",".join(link.name for link in links if link.body == body) for body in axis.texts["body"]]
                columns["links"] = np.array(names)
            result[reading.name] = _structured(columns or {"row": np.arange(axis.size)}, axis.size)
    return result


def images_of(
    plan: Plan, name: str, readings: Mapping[str, Tensor]
) -> tuple[dict[str, Float[Tensor, "env channel row column"]], dict[str, Bool[Tensor, "row column"]]]:
    """Return a reading of taxels as one image per link, and where its pixels are taxels: see `TactileModule.images`."""
    owner = {r.name: sensor for sensor in plan.sensors for r in sensor.readings if r.rows == "taxel"}
    if name not in owner:
        raise TgdslError(f'there is no reading of taxels "{name}"; {did_you_mean(name, owner, "readings of taxels")}')
    if not isinstance(readings, Mapping):
        raise TgdslError(f"found a {type(readings).__name__}, expected readings by name, as a call of the module returns them")
    by_channel = last_step(readings[name]).transpose(1, 2)
    images, masks = {}, {}
    for link, index in image_indices(plan.layout_of(owner[name])).items():
        place = torch.from_numpy(index).to(by_channel.device)
        masks[link] = place >= 0
        images[link] = torch.where(masks[link], by_channel[:, :, place.clamp(min=0)], 0.0)
    return images, masks


def image_indices(layout: Layout) -> Mapping[str, Int[np.ndarray, "row column"]]:
    """Return which taxel is in which cell of its link's grid, by link; −1 where there is none.

    Inactive fillers (radius 0) are none. Links whose taxels are on no grid are left out.
    """
    result: dict[str, np.ndarray] = {}
    for i, link in enumerate(layout.links):
        link_rows = np.flatnonzero(layout.link_id == i)
        rows, columns = layout.cell[link_rows].T
        if (rows < 0).any():
            continue
        image = np.full((rows.max() + 1, columns.max() + 1), -1, dtype=np.int64)
        image[rows, columns] = np.where(layout.radius[link_rows] > 0, link_rows, -1)
        result[link.name] = image
    if not result:
        names = ", ".join(link.name for link in layout.links)
        raise TgdslError(f"no image without a grid: the taxels of {names} are not laid out with `method: grid`")
    return result
