"""Shared by commands: types of options, and the handling of documents, robots, overrides, policies and outputs.

The help of an option without a value names its default, so none of these types prints `(default: None)`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union

import tyro

from tgdsl.console.progress import Progress
from tgdsl.errors import TgdslError, did_you_mean
from tgdsl.files.write import atomic_write, check_writable

if TYPE_CHECKING:
    from tgdsl.console.bar import Bar
    from tgdsl.module.module import TactileModule
    from tgdsl.rl.env import TouchEnv
    from tgdsl.rl.playing.policy import PolicyFile
    from tgdsl.rl.playing.rollout import Actor
    from tgdsl.runtime.xhand1.calibration import Calibration


def optional(metavar: str, *aliases: str) -> Any:
    """Return what marks an option that may have no value."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases or None, help_behavior_hint="")


Names = Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]", help_behavior_hint="")]
OptionalNumbers = Annotated[tuple[float, ...], tyro.conf.arg(help_behavior_hint="")]
OptionalName = Annotated[str | None, optional("NAME")]
OptionalInt = Annotated[int | None, optional("INT")]
OptionalFloat = Annotated[float | None, optional("FLOAT")]
OptionalFile = Annotated[Path | None, optional("FILE")]
OptionalFolder = Annotated[Path | None, optional("FOLDER")]
OptionalOut = Annotated[Path | None, optional("FILE", "-o")]
OptionalOutFolder = Annotated[Path | None, optional("FOLDER", "-o")]
File = Annotated[Path, tyro.conf.arg(metavar="FILE")]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")]
OutFolder = Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")]
Document = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="The YAML document.", metavar="FILE")]
DocumentOrArtefact = Annotated[
    Document, tyro.conf.arg(help="The YAML document, or an artefact (.safetensors) that `tgdsl compile` wrote.")
]
Robot = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        help="A robot's file (MJCF, URDF, USD), or the name of a robot that comes with tgdsl, such as xhand1.", metavar="ROBOT"
    ),
]
Layout = Annotated[OptionalFile, tyro.conf.arg(help="Layout of the robot; default: layout.yaml next to its file.")]
Task = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="The task's YAML document.", metavar="TASK")]
DeviceName = Annotated[str, tyro.conf.arg(metavar="DEVICE")]
Device = Annotated[DeviceName, tyro.conf.arg(help="Device of physics, touch and networks: cpu, cuda or cuda:1.")]
Seed = Annotated[int, tyro.conf.arg(help="Seed of all random numbers.")]
Compiled = Annotated[bool, tyro.conf.arg(help="Compile the module with torch.compile first.")]
Replace = Annotated[bool, tyro.conf.arg(help="Replace existing files.")]
Groups = Annotated[
    Names,
    tyro.conf.arg(
        help="Observation groups that the policy takes, in its order; default: the groups of its card, or without a card "
        "proprio, tactile_sensors and goal, if the task has them."
    ),
]
Overrides = Annotated[
    tuple[str, ...],
    tyro.conf.arg(
        name="set",
        help="Override a value of the document, such as `--set resolution=high`.",
        metavar="KEY=VALUE",
    ),
    tyro.conf.UseAppendAction,
]


def subcommands(*commands: type, **named: type) -> Any:
    """Return the union of commands, each by its class's name in lower case, or by a given name."""
    by_name = {re.sub(r"(?<!^)(?=[A-Z])", "-", command.__name__).lower(): command for command in commands} | named
    return Union[tuple(Annotated[command, tyro.conf.subcommand(name)] for name, command in by_name.items())]  # type: ignore[return-value]  # noqa: UP007


def robot_document(hand: str, layout: Path | None) -> Path | dict[str, object]:
    """Return the document that an argument names, or a document of a robot and its layout only.

    Raises:
        TgdslError: If it names nothing, or a robot without a layout.
    """
    from tgdsl.files.find import is_file, layout_of, robot_names

    path, names = Path(hand), robot_names()
    if path.suffix in (".yaml", ".yml"):
        if layout is not None:
            raise TgdslError(f"--layout {layout}: a document names its layout itself; try --set robot.layout={layout}")
        return path
    if hand not in names and not is_file(path):
        raise TgdslError(f'there is no document, artefact or robot "{hand}"; {did_you_mean(hand, names, "robots")}')
    layout_file = layout or layout_of(hand)
    if layout_file is None:
        raise TgdslError(f"{hand}: there is no layout.yaml next to this robot; name its layout with --layout")
    return {"tgdsl": 1, "robot": {"model": hand, "layout": str(layout_file)}}


def parsed_overrides(pairs: tuple[str, ...]) -> dict[str, str]:
    """Return `KEY=VALUE` arguments as a mapping; a key that is repeated has its last value and place."""
    result: dict[str, str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise TgdslError(f'--set {pair}: expected KEY=VALUE, such as "resolution=high"')
        result.pop(key, None)
        result[key] = value
    return result


def joined_overrides(before: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Return older overrides, without those at or below a newer one's key, then the newer ones."""
    unchanged = {key: value for key, value in before.items() if not any(f"{key}.".startswith(f"{other}.") for other in new)}
    return unchanged | dict(new)


def module_of(document: Path, overrides: tuple[str, ...] = (), progress: Progress | None = None) -> TactileModule:
    """Return the module of a document, or of an artefact."""
    from tgdsl.module.artifact import load
    from tgdsl.tuning.compile import compile

    if document.suffix == ".safetensors":
        if overrides:
            raise TgdslError("an artefact cannot be overridden; compile the document with --set instead")
        return load(document)
    return compile(document, overrides=parsed_overrides(overrides), progress=progress)


def actor_for(
    env: TouchEnv, saved: PolicyFile | None, actions: str = "zero", seed: int = 0, groups: tuple[str, ...] = ()
) -> Actor:
    """Return a policy for a task's environments, or without one the actor of `--actions`; print the changes since training."""
    from tgdsl.rl.playing.policy import policy_for
    from tgdsl.rl.playing.rollout import actor_of

    actor = actor_of(env, actions, seed) if saved is None else policy_for(env, saved, groups)
    print_changes("policy", actor.changes)
    return actor


def print_changes(learner: str, changes: Iterable[str]) -> None:
    """Print what of a task has changed since a policy or a teacher was learned."""
    for line in changes:
        print(f"changed since the {learner} was learned: {line}")


def saved_policy(file: Path | None, groups: tuple[str, ...] = ()) -> PolicyFile | None:
    """Return the policy of a file, if one is given."""
    from tgdsl.rl.playing.policy import read_policy

    if groups and file is None:
        raise TgdslError("--groups belong to a policy; give one with --policy")
    return None if file is None else read_policy(file)


def calibration_of(file: Path | None) -> Calibration | None:
    """Return the calibration of a file, if one is given."""
    from tgdsl.runtime.xhand1.calibration import load_calibration

    return None if file is None else load_calibration(file)


def progress_bar(job: str, total: int | None = None, unit: str = "step") -> Bar:
    """Return a bar that counts on a terminal, and is wiped at the end; elsewhere a line every few seconds."""
    from tgdsl.console.bar import Bar

    return Bar(job, total, unit)


def check_learning_device(device: str) -> None:
    """Raise an error if there is no such device; without a GPU, it names the option of a CPU."""
    from tgdsl.tensors.devices import device_of

    try:
        device_of(device)
    except TgdslError as error:
        raise TgdslError(f"{error}: pass --device cpu" if device.startswith("cuda") else str(error)) from error


def check_least(command: object, **least: float) -> None:
    """Raise an error if one of a command's numbers is given, and less than the least."""
    for name, low in least.items():
        value = getattr(command, name)
        if value is not None and not value >= low:
            raise TgdslError(f"--{name} {value}: expected at least {low}")


def in_working_folder(source: str | Path, suffix: str) -> Path:
    """Return a command's default output: the input's name with another ending, in the working folder."""
    return Path(Path(source).with_suffix(suffix).name)


def refuse_to_replace(out: Path, is_forced: bool) -> None:
    """Raise an error if a file cannot be written, or is there and may not be replaced."""
    if out.is_file() and not is_forced:
        raise TgdslError(f"{out}: this file is there already; give --force to replace it, or another name")
    check_writable(out)


def write_json(file: Path, value: object) -> None:
    """Write a value as an indented JSON file."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    atomic_write(file, f"{text}\n".encode())
