"""From a task's document to its spec and class: every mistake is reported at its place. The JSON Schema of tasks."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from pkgutil import resolve_name
from types import FunctionType
from typing import Any, TypeVar, cast

from pydantic import ValidationError

from tgdsl.errors import Problem, SpecError, TgdslError, did_you_mean, listed, raised_at
from tgdsl.fields.models import SpecModel
from tgdsl.rl.spec import TaskSpec
from tgdsl.rl.task import Task
from tgdsl.rl.tasks import TASKS
from tgdsl.rl.terms import TERMS, CurriculumTerm, ObservationTerm, RewardTerm, Term, event_term
from tgdsl.schema.document import conditional
from tgdsl.schema.load import read_source
from tgdsl.schema.validation import validate
from tgdsl.schema.yaml import Path as Place
from tgdsl.schema.yaml import Source, from_mapping

C = TypeVar("C")
SHARED_GROUPS = ("proprio", "tactile_sensors", "priv_proprio")  # groups of observations that all tasks have
REQUIRED = ("tgdsl", "task", "document", "object", "joints")


@dataclass(frozen=True, eq=False)
class LoadedTask:
    """A task's document: its model, and the values and places of its text."""

    spec: TaskSpec  # the document
    task: type[Task[Any]]  # the task's class
    source: Source  # its text's values and places
    folder: Path  # folder that file names in it are relative to
    terms: Mapping[str, Term] = field(default_factory=dict)  # terms that it adds to the task, by name

    @property
    def senses(self) -> tuple[str, ...]:
        """Kinds of sensors that the task and its terms read."""
        return tuple(dict.fromkeys(kind for part in (self.task, *self.terms.values()) for kind in part.senses))

    def error(self, place: Place, what: str, hint: str = "") -> SpecError:
        """Return an error at a place of the document."""
        return SpecError([self.source.problem(place, what, hint)])


def load_task(document: str | PathLike[str] | Mapping[str, Any], overrides: Mapping[str, Any] | None = None) -> LoadedTask:
    """Read a task's document.

    Args:
        document: A YAML file, or the same as a mapping (file names in it are then relative to the working folder).
        overrides: Values to set first by dotted path, as YAML text or plain, such as `{"rewards.spin": 3}`.

    Raises:
        SpecError: All its mistakes, with file, line and column.
        TgdslError: If the document is neither a file's name nor a mapping.
    """
    if not isinstance(document, (str, PathLike, Mapping)):
        raise TgdslError(f"a task is a YAML file's name or a mapping, found {type(document).__name__}")
    if isinstance(document, Mapping):
        source, folder = from_mapping(document, "<mapping>"), Path.cwd()
    else:
        source, folder = read_source(Path(document)), Path(document).parent
    for dotted, value in (overrides or {}).items():
        source.set(dotted, value)
    if not isinstance(source.value, dict) or not isinstance(source.value.get("task"), str):
        problem = 'missing key "task", one of: ' + ", ".join(TASKS)
        if isinstance(source.value, dict) and "sensors" in source.value:
            problem = "this is a document of sensors, which a task's document names: `document: …`"
        raise SpecError([*source.problems, source.problem(("task",), problem, on_key=True)])
    task: type[Task[Any]] = _class_of(source, folder, ("task",), source.value["task"], Task, TASKS, "tasks")
    problems: list[Problem] = list(source.problems)
    spec = validate(source, (), task.Spec, problems, REQUIRED)
    terms = _terms(source, folder, task, spec, problems) if isinstance(spec, TaskSpec) else {}
    if isinstance(spec, TaskSpec) and task.own_groups is not None:
        added = [name for name, term in terms.items() if isinstance(term, ObservationTerm)]
        named = {**train_groups(spec), ("distill", "groups"): spec.distill.groups}
        problems += wrong_groups(source, named, [*SHARED_GROUPS, *added, *task.own_groups])
    if problems or not isinstance(spec, TaskSpec):
        raise SpecError(source.hinted(problems))
    return LoadedTask(spec, task, source, folder, terms)


def _terms(source: Source, folder: Path, task: type[Task[Any]], spec: TaskSpec, problems: list[Problem]) -> dict[str, Term]:
    """Return the terms that a document adds; append their mistakes to `problems`."""
    terms, known_terms = {}, TERMS.by_name()
    for name, value in spec.terms.items():
        place = ("terms", name)
        try:
            class_ = _class_of(source, folder, (*place, "term"), str(value.get("term", name)), Term, known_terms, "terms")
        except SpecError as error:
            problems += error.problems
            continue
        term = validate(source, place, class_, problems, ())
        if isinstance(term, RewardTerm) and getattr(getattr(spec, "rewards", None), name, None) is not None:
            problems.append(source.problem(place, f'the task has a term "{name}"', f"set `rewards.{name}`", on_key=True))
        elif isinstance(term, ObservationTerm) and name in SHARED_GROUPS:
            problem = f'all tasks have a group "{name}"'
            problems.append(source.problem(place, problem, "give the term another name", on_key=True))
        elif isinstance(term, Term):
            terms[name] = term
    owners = number_owners(task, spec, terms)
    for name, term in terms.items():
        if not isinstance(term, CurriculumTerm):
            continue
        if term.of not in owners:
            problem, hint = f'there is no number "{term.of}" that can change', did_you_mean(term.of, owners, "numbers")
            problems.append(source.problem(("terms", name, "of"), problem, hint))
            continue
        owner, key = owners[term.of], term.of.rpartition(".")[2]
        for value in term.extremes():
            try:
                type(owner).model_validate({**dict(owner), key: value})
            except ValidationError as error:
                reason = error.errors()[0]["msg"].removeprefix("Value error, ")
                problems.append(source.problem(("terms", name), f"{term.of} would be {value:g}: {reason}"))
    return terms


def train_groups(spec: TaskSpec) -> dict[tuple[str, ...], Sequence[str] | None]:
    """Return the groups of observations that a learner names, by place in the document; None where the default holds."""
    train = spec.train
    named: dict[tuple[str, ...], Sequence[str] | None] = {("train", "actor"): train.actor, ("train", "critic"): train.critic}
    return named if train.rnd == "off" else {**named, ("train", "rnd", "groups"): train.rnd.groups}


def wrong_groups(
    source: Source, named: Mapping[tuple[str, ...], Sequence[str] | None], groups: Collection[str], empty: Collection[str] = ()
) -> list[Problem]:
    """Return, located, the groups of observations that are named and are not among `groups`, or are empty."""
    problems = []
    for place, names in named.items():
        for i, name in enumerate(names or ()):
            if name not in groups:
                problem, hint = f'there is no group of observations "{name}"', did_you_mean(name, groups, "groups")
                problems.append(source.problem((*place, i), problem, hint))
            elif name in empty:
                problems.append(source.problem((*place, i), f'the group of observations "{name}" is empty'))
    return problems


def number_owners(task: type[Task[Any]], spec: TaskSpec, terms: Mapping[str, Term]) -> dict[str, SpecModel]:
    """Return the models of the numbers that a curriculum may change, by dotted path: of the task and of the terms."""
    keys = [name for name in type(spec).model_fields if name not in (*TaskSpec.model_fields, *task.constants)]
    owners: dict[str, SpecModel] = {name: spec for name in keys if isinstance(getattr(spec, name), float)}
    models = {name: getattr(spec, name) for name in keys}
    models |= {f"terms.{name}": term for name, term in terms.items() if not isinstance(term, CurriculumTerm)}
    for path, model in models.items():
        constants = model.constants if isinstance(model, Term) else ()
        numbers = model if isinstance(model, SpecModel) else ()
        owners |= {f"{path}.{key}": model for key, value in numbers if isinstance(value, float) and key not in constants}
    return owners


def _class_of(
    source: Source, folder: Path, place: Place, name: str, base: type[C], known: Mapping[str, Any], which: str
) -> type[C]:
    """Return the class that a document names: of `known`, or as `package.module:Class` or `file.py:Class`."""
    entry = known.get(name, name)
    if not isinstance(entry, str):
        return entry
    module, colon, class_ = entry.partition(":")
    if not colon:
        hint = f"{did_you_mean(name, known, which)}; one of your own is package.module:Class or file.py:Class"
        raise SpecError([source.problem(place, f'there is no {which[:-1]} "{name}"', hint)])
    try:
        user_module = _user_module(module, folder)
    except Exception as error:  # whatever a user's code raises
        line = f"{raised_at(str((folder / module).resolve()), error)}: " if module.endswith(".py") else ""
        problem = f'cannot import "{name}": {line}{type(error).__name__}: {error}'
        raise SpecError([source.problem(place, problem)]) from error
    result = getattr(user_module, class_, None)
    if result is None:
        classes = [key for key, value in vars(user_module).items() if isinstance(value, type) and issubclass(value, base)]
        hint = did_you_mean(class_, classes, f"{which} in it")
        raise SpecError([source.problem(place, f'{module} has no class "{class_}"', hint)])
    if isinstance(result, FunctionType) and base is Term:
        return cast(type[C], event_term(result))
    if not (isinstance(result, type) and issubclass(result, base)):
        raise SpecError([source.problem(place, f'"{name}" is no subclass of {base.__module__}.{base.__name__}')])
    lacks = sorted(getattr(result, "__abstractmethods__", ()))
    lacks += [key for key in ("Spec", "score_unit") if base is Task and not hasattr(result, key)]
    if lacks:
        raise SpecError([source.problem(place, f'"{name}" lacks {listed(lacks)}')])
    senses = getattr(result, "senses", ())
    if isinstance(senses, str):
        raise SpecError([source.problem(place, f'"{name}": senses is "{senses}", expected a tuple, ("{senses}",)')])
    return result


def _user_module(name: str, folder: Path) -> Any:
    """Import a module by its name, or from a file, relative to the document."""
    if not name.endswith(".py"):
        return importlib.import_module(name)
    file = (folder / name).resolve()
    module_name = f"tgdsl_task_{file.stem}_{abs(hash(str(file)))}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    module_spec = importlib.util.spec_from_file_location(module_name, file)
    if module_spec is None or module_spec.loader is None or not file.is_file():
        raise FileNotFoundError("there is no such file")
    module = importlib.util.module_from_spec(module_spec)
    sys.modules[module_name] = module
    sys.path.insert(0, str(file.parent))  # modules in the same folder, as when Python runs the file
    try:
        module_spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[module_name]
        raise
    finally:
        sys.path.remove(str(file.parent))
    return module


def task_schema() -> dict[str, Any]:
    """Return the schema of all tasks of tgdsl by name; a user's task has the keys that all tasks share."""
    specs: dict[str, type[TaskSpec]] = {name: resolve_name(place).Spec for name, place in TASKS.items()}
    definitions: dict[str, Any] = {}
    for model in (TaskSpec, *dict.fromkeys(specs.values())):
        schema = model.model_json_schema(ref_template="#/$defs/{model}")
        parts = schema.pop("$defs", {})
        new_names = {name: f"{model.__name__}.{name}" for name, part in parts.items() if definitions.get(name, part) != part}
        definitions |= _renamed({new_names.get(name, name): part for name, part in parts.items()}, new_names)
        schema.pop("title", None)
        definitions[model.__name__] = _renamed(schema, new_names)
    task_spec = definitions["TaskSpec"]
    task_spec["additionalProperties"] = True
    description = task_spec["properties"]["randomise"]["description"]
    task_spec["properties"]["randomise"] = {"type": "object", "description": description}
    definitions = {name: conditional(definition, definitions) for name, definition in definitions.items()}
    chain: dict[str, Any] = {"$ref": "#/$defs/TaskSpec"}
    for name, model in reversed(specs.items()):
        is_named = {"properties": {"task": {"const": name}}, "required": ["task"]}
        chain = {"if": is_named, "then": {"$ref": f"#/$defs/{model.__name__}"}, "else": chain}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "tgdsl task",
        "type": "object",
        "properties": {"task": {"anyOf": [{"enum": list(TASKS)}, {"type": "string", "pattern": ":"}]}},
        **chain,
        "$defs": dict(sorted(definitions.items())),
    }


def _renamed(schema: Any, new_names: Mapping[str, str]) -> Any:
    if isinstance(schema, list):
        return [_renamed(part, new_names) for part in schema]
    if not isinstance(schema, dict):
        return schema
    result = {name: _renamed(part, new_names) for name, part in schema.items()}
    if isinstance(result.get("$ref"), str):
        folder, _, name = result["$ref"].rpartition("/")
        result["$ref"] = f"{folder}/{new_names.get(name, name)}"
    return result
