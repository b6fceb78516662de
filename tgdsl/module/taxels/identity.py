"""Whether a module has the taxels that something else was made with: a policy, a recording, a state, another module."""

from __future__ import annotations

import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from zipfile import BadZipFile

import numpy as np
import torch

from tgdsl.errors import TaxelError, TgdslError, did_you_mean
from tgdsl.layout.identity import REQUIRED, Columns, check_same_rows, columns_of, is_same_id
from tgdsl.module.plan_file import load_plan
from tgdsl.plan.plan import Plan
from tgdsl.tensors.torch_internals import HookedModule

_TAXELS = "taxels"
_ID = re.compile(r"[0-9a-f]{32}")


@runtime_checkable
class HasPlan(Protocol):
    """A module, as far as its taxels go."""

    @property
    def plan(self) -> Plan:
        """What it was built from."""
        ...


Taxels = HasPlan | Mapping[str, Any] | str | PathLike[str]  # taxels that are expected, see `check_taxels`


def check_taxels(touch: HasPlan, expected: Taxels, what: str = "this module") -> None:
    """Refuse a module whose sensors have other taxels than expected, or the same ones in another order.

    Tables and ids are compared within rounding, as `layout.identity` says. Sensors of the module that nothing is expected of
    may have any taxels.

    Args:
        touch: The module.
        expected: Another module; tables by sensor, as `TactileModule.taxels` has them; the file of an artefact (.safetensors)
            or of a rollout (.npz); or the id of a module's taxels, `TactileModule.taxels_id`.
        what: Whose taxels are checked, as the message begins.

    Raises:
        TaxelError: If they are others: how many rows, and the first that differs, here and there.
        ArtifactError: If an artefact cannot be read.
        TgdslError: If what is expected is none of these.
    """
    plan = touch.plan
    if isinstance(expected, str) and _ID.fullmatch(expected):
        _check_id(plan, expected, what)
        return
    tables = _tables(expected)
    module_tables = plan_tables(plan)
    for sensor, table in tables.items():
        if sensor not in module_tables:
            hint = did_you_mean(sensor, module_tables, "sensors with taxels")
            raise TaxelError(f'{what}: there is no sensor "{sensor}", whose taxels are expected; {hint}')
        check_same_rows(module_tables[sensor], table, f'{what}: sensor "{sensor}"')


def plan_tables(plan: Plan) -> dict[str, dict[str, np.ndarray]]:
    """Return the taxels of each sensor that has some, by columns."""
    return {sensor.sensor: columns_of(plan.layout_of(sensor)) for sensor in plan.sensors if len(sensor.taxels)}


def _packed(plan: Plan) -> dict[str, Any]:
    """Return the taxels of each sensor as texts and tensors, which `torch.load` reads with `weights_only`."""
    sensors = {}
    for name, table in plan_tables(plan).items():
        sensors[name] = {key: column.tolist() if column.dtype.kind == "U" else torch.from_numpy(column.copy())
                         for key, column in table.items()}  # fmt: skip
    return sensors


def _unpacked(column: list[str] | torch.Tensor) -> np.ndarray:
    return column.cpu().numpy() if isinstance(column, torch.Tensor) else np.array(column)


class SavedTaxels(HookedModule):
    """Notes a module's taxels in the metadata of its state dict, and refuses a state dict of other taxels.

    It has no tensors, so that the state dict has no more keys. One without metadata, a plain dictionary, is not looked at.
    """

    def __init__(self, plan: Plan):
        """Note the plan."""
        super().__init__()
        self.plan = plan
        self.register_state_dict_post_hook(_note_taxels)

    def on_load_metadata(self, metadata: Mapping[str, Any]) -> None:
        """Compare the taxels that are noted with the module's own.

        Raises:
            TaxelError: As `check_taxels` does.
        """
        if _TAXELS in metadata:
            saved = metadata[_TAXELS].items()
            tables = {name: {key: _unpacked(column) for key, column in table.items()} for name, table in saved}
            check_taxels(self, tables, "the state dict is of another module")


def _note_taxels(module: SavedTaxels, state_dict: Any, prefix: str, metadata: dict[str, Any]) -> None:
    metadata[_TAXELS] = _packed(module.plan)


def _check_id(plan: Plan, expected: str, what: str) -> None:
    if not is_same_id(plan.taxels_id, expected):
        has = f"the taxels' id is {plan.taxels_id}, {expected} is expected: {plan.layout.num_taxels} taxels of"
        hint = "a table, an artefact or a module would say which rows differ"
        raise TaxelError(f"{what}: {has} {len(plan.layout.links)} links are others; {hint}")


def _tables(expected: Taxels) -> Mapping[str, Columns]:
    """Return tables by sensor."""
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
    """Return the tables that the file of a rollout holds, by sensor."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            places = [key.rpartition(":")[0] for key in archive.files if key.endswith(":pos") and f"{key[:-4]}:link" in archive]
            keys = {name: [key for key in archive.files if key.rpartition(":")[0] == name] for name in places}
            result = {
                name.partition("/")[0]: {k.rpartition(":")[2]: archive[k] for k in keys_of} for name, keys_of in keys.items()
            }
    except (OSError, EOFError, ValueError, BadZipFile) as error:
        raise TgdslError(f"{path}: expected the .npz file of a rollout: {error}") from error
    if not result:
        raise TgdslError(f"{path}: this .npz file holds no table of taxels")
    return {name: _columns(table, f"{path}: {name}") for name, table in result.items()}
