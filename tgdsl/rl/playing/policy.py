"""A learned policy in a file, the card that describes its training, and differences between card and present task.

The file is TorchScript, as rsl_rl's `export_policy_to_jit` writes it: it takes concatenated groups of observations,
(env, feature), and returns actions, (env, joint). rsl_rl's files do not name the groups: they are the actor's, in the order of
the runner's `obs_groups`. Files of `tgdsl train` have a card that names them. Weights may be stored in float16: the loaded
module has float32.

Shapes: `env` environments, `joint` joints that the policy moves, `feature` numbers of a group.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any
from zipfile import ZipFile, is_zipfile

import mujoco
import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import ValidationError
from torch import Tensor

from tgdsl.errors import TaxelError, TgdslError, did_you_mean
from tgdsl.files.write import atomic_path, atomic_write
from tgdsl.layout.identity import Columns
from tgdsl.module.export.program import write_onnx
from tgdsl.module.module import TactileModule
from tgdsl.module.taxels import HasPlan, check_taxels, plan_tables
from tgdsl.rl.env import TouchEnv
from tgdsl.rl.load import LoadedTask
from tgdsl.rl.playing.rollout import Actor
from tgdsl.rl.sensors import GROUP, sensors_document
from tgdsl.rl.spec import TaskSpec

ELSEWHERE = {"tgdsl", "robot", "scene", "resolution", "observations"}
"""Keys of a sensors' document that are compared by joints, taxels and scene, or that the task's document sets."""
SCENE = {
    "gravity": ("opt.gravity",),
    "bodies": ("body_mass", "body_inertia", "body_ipos", "body_pos", "body_quat"),
    "geoms": ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_contype", "geom_conaffinity", "geom_friction"),
    "joints": (
        "jnt_type",
        "jnt_pos",
        "jnt_axis",
        "jnt_range",
        "jnt_stiffness",
        "dof_damping",
        "dof_armature",
        "dof_frictionloss",
    ),
    "actuators": ("actuator_gainprm", "actuator_biasprm", "actuator_ctrlrange", "actuator_forcerange"),
}
"""Arrays of MuJoCo's model by part of the scene."""
LEAST = 1e-12  # magnitude that counts as 0, in the array's unit: rounding differs between machines


def provenance(loaded: LoadedTask, model: mujoco.MjModel) -> dict[str, Any]:
    """Return a card's entries for sensors and scene, as plain values."""
    spec = sensors_document(loaded).spec
    return {
        "sensors": spec.model_dump(mode="json", exclude=ELSEWHERE),
        "scene": {part: _digest(model, names) for part, names in SCENE.items()},
    }


def changes_around(card: Mapping[str, Any], loaded: LoadedTask, model: mujoco.MjModel) -> list[str]:
    """Return changes of sensors and scene since a policy was learned, a line each; none for older cards."""
    if "sensors" not in card:
        return []
    present, scene = provenance(loaded, model), card["scene"]
    lines = differences(card["sensors"], _with_keys_of(card["sensors"], present["sensors"]))
    results = [f"{loaded.spec.document}: {line}" for line in lines]
    return results + [f"the scene's {part}" for part, digest in present["scene"].items() if scene.get(part, digest) != digest]


def _with_keys_of(saved: Any, present: Any) -> Any:
    if not (isinstance(saved, dict) and isinstance(present, dict)):
        return present
    return {name: _with_keys_of(saved[name], value) for name, value in present.items() if name in saved}


def _digest(model: mujoco.MjModel, names: tuple[str, ...]) -> str:
    """Return a hash of arrays to five digits, within which machines and versions of MuJoCo agree."""
    result = hashlib.sha256()
    for name in names:
        values = np.asarray(attrgetter(name)(model), dtype=np.float64)
        rounded = np.where(np.abs(values) < LEAST, 0.0, values) + 0.0
        result.update(f"{name} {values.shape} {' '.join(f'{value:.4e}' for value in rounded.flat)}\n".encode())
    return result.hexdigest()[:16]


def differences(before: Any, now: Any, path: str = "") -> list[str]:
    """Return how two plain values differ, a line each: `rewards.spin: 2.0, now 3.0`."""
    if isinstance(before, dict) and isinstance(now, dict):
        names = dict.fromkeys((*before, *now))
        return [line for name in names for line in differences(before.get(name), now.get(name), f"{path}.{name}".lstrip("."))]
    return [] if is_close(before, now) else [f"{path}: {json.dumps(before)}, now {json.dumps(now)}"]


def is_close(one: Any, other: Any) -> bool:
    """Return whether plain values are equal, numbers up to rounding: 0.7 cm is not exactly 7 mm."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(is_close(value, other[name]) for name, value in one.items())
    if isinstance(one, list | tuple) and isinstance(other, list | tuple):
        return len(one) == len(other) and all(map(is_close, one, other))
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=1e-9)
    return one == other


def spec_differences(
    before: Mapping[str, Any], now: Mapping[str, Any], model: type[TaskSpec], leave_out: tuple[str, ...] = ()
) -> list[str]:
    """Return how two documents differ."""
    with suppress(ValidationError):  # of a version with other names: its values stand as they are
        before = model.model_validate(before).model_dump(mode="json")
    left, other = ({name: value for name, value in spec.items() if name not in leave_out} for spec in (before, now))
    return differences(left, other)


ACTOR_GROUPS = ("proprio", "tactile_sensors", "goal")
"""Groups that a policy sees by default, if they exist."""


OF_LEARNING, OF_TOUCH = ("train", "distill"), ("touch", "placement", "resolution", "noise")
"""Keys of a document that matter only for learning, and only for touch."""
POLICY = "policy.pt"  # name of a run's policy in its folder
CARD = "card.json"  # name of the card in the file
TAXELS = "taxels.csv"  # name of the table of taxels in the file


class PolicyError(TgdslError):
    """A policy that cannot be read, or that does not fit the environments."""


@dataclass(frozen=True, eq=False)
class PolicyFile:
    """A snapshot of a policy's file, unaffected by later writes."""

    file: Path  # the file
    content: bytes  # its bytes
    card: dict[str, Any] | None  # its card; None: it has none
    taxels: Mapping[str, Columns]
    """Taxels of its touch by sensor, as in `TactileModule.taxels`; empty if the file lists none."""

    def module(self, device: torch.device | str) -> torch.jit.ScriptModule:
        """Return the TorchScript module on a device."""
        return _module(self.content, device)


def read_policy(file: Path) -> PolicyFile:
    """Read a policy's file, once; raise `PolicyError` if it cannot be read, or is no TorchScript."""
    file = file / POLICY if file.is_dir() else file
    try:
        content = file.read_bytes()
    except OSError as error:
        raise PolicyError(f"{file}: cannot read this file: {error.strerror or error}") from error
    extra: dict[str, Any] = {CARD: "", TAXELS: ""}
    try:
        _module(content, "cpu", extra)
        card = json.loads(extra[CARD]) if extra[CARD] else None
    except (RuntimeError, ValueError) as error:
        archive = io.BytesIO(content)
        files = {Path(name).name for name in ZipFile(archive).namelist()} if is_zipfile(archive) else set()
        if "data.pkl" in files and "constants.pkl" not in files:  # `torch.save`, where TorchScript has a file of constants
            policy = f"the policy of a run is its {POLICY}; rsl_rl's runner writes one with `export_policy_to_jit`"
            raise PolicyError(f"{file}: this is a checkpoint, from which learning goes on; {policy}") from error
        if file.suffix == ".onnx":
            raise PolicyError(f"{file}: this is the ONNX form of a policy, expected the {POLICY} beside it") from error
        problem = "this is no TorchScript file, as rsl_rl's `export_policy_to_jit` writes it"
        reason = f": {str(error).strip().splitlines()[0]}" if files else ""
        raise PolicyError(f"{file}: {problem}{reason}") from error
    return PolicyFile(file, content, card, taxel_tables(extra[TAXELS].decode()))


def write_policy(scripted: torch.nn.Module, texts: Mapping[str, str], file: Path) -> None:
    """Write a policy as TorchScript with its `card_texts` in it, and the card as a JSON file."""
    content = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript itself
        torch.jit.save(scripted, content, _extra_files=dict(texts))
    atomic_write(file, content.getvalue())
    atomic_write(file.with_suffix(".json"), texts[CARD].encode())


def card_texts(touch: TactileModule, card: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts in a policy's file by name: its card, and the taxels of its touch."""
    return {CARD: json.dumps(card, indent=2, ensure_ascii=False, allow_nan=False) + "\n", TAXELS: taxel_csv(touch)}


def taxel_csv(touch: TactileModule) -> str:
    """Return the taxels of all sensors as a table: sensor, and the columns of `touch.taxels`, vectors by their components."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, (sensor, table) in enumerate(touch.taxels.items()):
        columns = {name: np.asarray(table[name]) for name in table.dtype.names or ()}
        if i == 0:
            parts = [name if a.ndim == 1 else [f"{name}_{k}" for k in range(a.shape[1])] for name, a in columns.items()]
            writer.writerow(["sensor", *np.hstack(parts)])
        for row in table.tolist():
            cells = [[repr(x) for x in value.tolist()] if isinstance(value, np.ndarray) else [str(value)] for value in row]
            writer.writerow([sensor, *itertools.chain(*cells)])
    return text.getvalue()


def taxel_tables(text: str) -> dict[str, Columns]:
    """Return the taxels of each sensor from a text of `taxel_csv`."""
    rows, tables = list(csv.DictReader(io.StringIO(text))), dict[str, Columns]()
    for sensor in dict.fromkeys(row["sensor"] for row in rows):
        columns = {name: np.array([row[name] for row in rows if row["sensor"] == sensor]) for name in rows[0]}
        table = {name: columns[name] for name in ("link", "body")}
        for name in ("pos", "normal", "tangent"):
            table[name] = np.stack([columns[f"{name}_{i}"] for i in range(3)], axis=1).astype(np.float64)
        table |= {name: columns[name].astype(np.float64) for name in ("radius", "area")}
        tables[sensor] = table | {name: columns[name].astype(np.int64) for name in ("row", "column")}
    return tables


def actor_groups(
    groups: Mapping[str, int], named: Sequence[str] = (), card: Mapping[str, Any] | None = None
) -> tuple[str, ...]:
    """Return the groups of observations that a policy takes; raise `PolicyError` if there is no such group."""
    named = tuple(named) or tuple((card or {}).get("groups", ()))
    for name in named:
        if name not in groups:
            raise PolicyError(f'there is no group of observations "{name}"; {did_you_mean(name, groups, "groups")}')
    return tuple(named) or tuple(name for name in ACTOR_GROUPS if name in groups)


class Policy(Actor):
    """A learned policy that acts in some environments: takes `groups` of observations, in their order.

    `std` is the standard deviation of its actions in training, None if its card lacks it.
    """

    def __init__(
        self, saved: PolicyFile, groups: Mapping[str, int], num_envs: int, num_actions: int, device: torch.device | str = "cpu"
    ):
        """Check a policy; raise `PolicyError` if it does not fit."""
        self.groups = tuple(groups)
        self._module, card, file = saved.module(device), saved.card, saved.file
        std = (card or {}).get("std")
        self.std = torch.tensor(std, dtype=torch.float32, device=device) if std else None
        total, taken = sum(groups.values()), _summands(groups)
        first = next((weight.shape[1] for weight in self._module.parameters() if weight.ndim == 2), total)
        theirs = f"{first} numbers" if card is None else _summands(card["groups"])
        if first != total if card is None else not _is_in_order(card["groups"], groups):
            raise PolicyError(f"{file}: this policy takes {theirs}, not {taken}; name its groups, in its order")
        try:
            with torch.no_grad():
                output = self._module(torch.zeros((num_envs, total), dtype=torch.float32, device=device))
        except Exception as error:  # whatever TorchScript raises
            last = str(error).strip().splitlines()[-1]
            problem = f"this policy does not take {taken} numbers of {num_envs} environments"
            raise PolicyError(f"{file}: {problem}: {last}") from error
        if not isinstance(output, Tensor) or tuple(output.shape) != (num_envs, num_actions):
            shape = f"actions {tuple(output.shape)}" if isinstance(output, Tensor) else f"a {type(output).__name__}"
            raise PolicyError(f"{file}: this policy returns {shape}, expected ({num_envs}, {num_actions}): joints are others")
        self.begin(torch.ones(num_envs, dtype=torch.bool))

    def __call__(self, obs: Mapping[str, Float[Tensor, "env feature"]]) -> Float[Tensor, "env joint"]:
        with torch.no_grad():
            return self._module(torch.cat([obs[name] for name in self.groups], dim=1))

    def begin(self, ended: Bool[Tensor, " env"]) -> None:
        if hasattr(self._module, "begin"):
            self._module.begin(ended)
        elif hasattr(self._module, "reset") and bool(ended.all()):
            self._module.reset()


def policy_for(env: TouchEnv, saved: PolicyFile, named: Sequence[str] = ()) -> Policy:
    """Return a policy that acts in some environments."""
    card, file = saved.card, saved.file
    if card is not None:
        check_learned(card, file, env.spec)
        check_card(saved, env.joint_names, env.touch)
        touch = card["spec"].get("touch", env.spec.touch)
        if GROUP in card["groups"] and touch != env.spec.touch:
            raise PolicyError(f"{file}: this policy feels {touch}, not {env.spec.touch}; try --set touch={touch}")
    groups = {name: env.groups[name] for name in actor_groups(env.groups, named, card)}
    policy = Policy(saved, groups, env.num_envs, env.num_actions, env.device)
    if card is not None:
        policy.changes = [*changes_since(card, env.spec), *changes_around(card, env.loaded, env.sim.model)]
    return policy


def changes_since(card: Mapping[str, Any], spec: TaskSpec, leave_out: tuple[str, ...] = ()) -> list[str]:
    """Return changes of a task's document since a policy was learned, a line each."""
    unfelt = () if GROUP in card["groups"] else OF_TOUCH
    return spec_differences(card["spec"], spec.model_dump(mode="json"), type(spec), (*OF_LEARNING, *unfelt, *leave_out))


def check_learned(card: Mapping[str, Any], file: Path, spec: TaskSpec, who: str = "policy") -> None:
    """Check that a policy was learned in a task, with its actions and control steps; raise `PolicyError` if not."""
    theirs, ours = dict(card["spec"]), spec.model_dump(mode="json")
    with suppress(ValidationError):  # an invalid action differs anyway
        theirs["action"] = type(spec.action).model_validate(theirs["action"]).model_dump(mode="json")  # of today's fields
    if _without_folder(theirs["task"]) != _without_folder(ours["task"]):
        raise PolicyError(f'{file}: this {who} was learned in the task "{theirs["task"]}", not "{ours["task"]}"')
    steps = [round(each["physics"]["timestep"] * each["physics"]["substeps"], 9) for each in (theirs, ours)]
    for name, learned, now in (("actions", theirs["action"], ours["action"]), ("control steps [s]", *steps)):
        if not is_close(learned, now):
            texts = (json.dumps(value, ensure_ascii=False) for value in (learned, now))
            raise PolicyError("{}: this {} was learned with other {}: {}, here {}".format(file, who, name, *texts))


def _without_folder(task: str) -> str:
    file, colon, class_ = task.rpartition(":")
    return f"{Path(file).name}{colon}{class_}"


def _summands(groups: Mapping[str, int]) -> str:
    return f"{' + '.join(f'{name} ({size})' for name, size in groups.items())} = {sum(groups.values())}"


def _is_in_order(card: Mapping[str, int], groups: Mapping[str, int]) -> bool:
    """Whether groups equal a card's, in its order; the touch group may have the name of `PolicyTouch.group`."""
    pairs = zip(card.items(), groups.items(), strict=False)
    return len(card) == len(groups) and all(
        size == result and (name == other or (name == GROUP and other.startswith(f"{GROUP}/")))
        for (name, size), (other, result) in pairs
    )


def check_card(saved: PolicyFile, joints: Sequence[str], touch: HasPlan) -> None:
    """Check that a policy with a card fits the environments' joints and taxels.

    Taxels may differ by rounding, as after a robot's export. Sensors that the environments lack, such as sensors that only the
    task reads, are not compared.
    """
    card, file = saved.card, saved.file
    assert card is not None
    if list(joints) != list(card["joints"]):
        raise PolicyError(f"{file}: this policy moves {', '.join(card['joints'])}, not {', '.join(joints)}")
    if GROUP in card["groups"]:
        here = plan_tables(touch.plan)
        shared = {name: table for name, table in saved.taxels.items() if name in here}
        try:
            check_taxels(touch, shared or saved.taxels)
        except TaxelError as error:
            raise PolicyError(f"{file}: this policy feels with other taxels: {error}") from error


def _module(content: bytes, device: torch.device | str, extra_files: dict[str, Any] | None = None) -> torch.jit.ScriptModule:
    """Return the module of a TorchScript file, float16 weights as float32; `extra_files` are filled in."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # TorchScript itself, which rsl_rl writes
        module = torch.jit.load(io.BytesIO(content), map_location=device, _extra_files=extra_files).eval()
    for weight in module.parameters():
        if weight.dtype == torch.float16:
            weight.data = weight.data.float()
    return module


def write_onnx_policy(network: Any, texts: dict[str, str], file: Path) -> None:
    """Write a policy as ONNX."""
    module = network.cpu().eval().requires_grad_(False)
    inputs = network.get_dummy_inputs()
    env = torch.export.Dim("env", min=1)
    with torch.no_grad():
        program = torch.export.export(module, inputs, dynamic_shapes=tuple({0: env} for _ in inputs))
    with atomic_path(file) as temporary:
        write_onnx(program, network.input_names, network.output_names, texts, temporary)
