"""The API reference: what users call, from docstrings."""

from __future__ import annotations

import inspect
import re
from typing import Any

import tgdsl

MORE = {
    "TactileModule": ("tgdsl.module.outputs.Output", "tgdsl.plan.inputs.Inputs"),
    "TouchEnv": ("tgdsl.rl.env.Step", "tgdsl.rl.env.StepInfo", "tgdsl.rl.task.Task"),
    "SceneState": (),
    "Geoms": (),
    "BatchSimulation": (
        "tgdsl.runtime.simulators.simulation.Simulation",
        "tgdsl.runtime.simulators.simulation.SimOptions",
        "tgdsl.runtime.connection.Source",
    ),
    "WarpSimulation": (),
}
"""Classes of the public names, a page each, and what stands on the same page."""
WRITING = {
    "Kinds": ("tgdsl.sensors.base", ("Kind", "Lowered", "Channel", "Memory", "Axis", "Context", "ReferenceContext")),
    "Specs of kinds": (
        "tgdsl.sensors.base",
        ("AnySensorSpec", "SensorSpec", "OnJointsSpec", "LinkSpec", "ProbeSpec", "ContactProbeSpec"),
    ),
    "Quantities": ("tgdsl.quantities.base", ("Quantity", "Request", "Planning", "Scene", "Gathered", "Use")),
    "Sources": ("tgdsl.runtime.connection", ("Connection", "SourceKind", "SimulatorKind")),
}
"""What authors of kinds, quantities and sources use."""
HEADS = "=-"
COLON = "\ue000"
"""Stands for a colon while Napoleon reads an attribute's docstring: it takes the text before the first colon for a type."""


def api_pages() -> dict[str, str]:
    """Return the pages by name.

    Raises:
        ValueError: If a public class stands on no page.
    """
    public = {name: getattr(tgdsl, name) for name in tgdsl.__all__ if name != "testing"}
    errors = [name for name, value in public.items() if inspect.isclass(value) and issubclass(value, Exception)]
    classes = [name for name, value in public.items() if inspect.isclass(value) and name not in errors]
    functions = [name for name in public if name not in errors and name not in classes]
    if unplaced := set(classes) ^ set(MORE):
        raise ValueError(f"docs/_ext/tgdsl_docs/api.py: MORE names other classes than tgdsl.__all__: {', '.join(unplaced)}")
    pages = {"functions": _page("Functions", "".join(f".. autofunction:: tgdsl.{name}\n\n" for name in functions))}
    for name, more in MORE.items():
        place = public[name]
        pages[name] = _page(name, "".join(_class(path) for path in (f"{place.__module__}.{place.__qualname__}", *more)))
    pages["errors"] = _page("Errors", "".join(f".. autoexception:: tgdsl.errors.{name}\n   :members:\n\n" for name in errors))
    pages["writing"] = _page("Your own kinds, quantities and sources", "".join(_part(name) for name in WRITING))
    pages["testing"] = _page(
        "tgdsl.testing", ".. automodule:: tgdsl.testing\n\n" + _class("tgdsl.testing.conformance.KindConformance")
    )
    return {"api/index.rst": _index(pages)} | {f"api/{name}.rst": text for name, text in pages.items()}


def _index(pages: dict[str, str]) -> str:
    about = "``import tgdsl`` offers the functions, classes and errors. Shapes stand in the annotations, units in the text."
    return _page("API", f"{about}\n\n.. toctree::\n\n" + "".join(f"   {name}\n" for name in pages))


def _page(title: str, body: str, head: str = "=") -> str:
    return f"{title}\n{head * len(title)}\n\n{body}"


def _class(path: str) -> str:
    return f".. autoclass:: {path}\n   :members:\n\n"


def _part(name: str) -> str:
    module, names = WRITING[name]
    return _page(name, "".join(_class(f"{module}.{each}") for each in names), "-")


def hide_colons(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Hide colons of attributes' and properties' docstrings from Napoleon; types are in annotations."""
    if what in ("attribute", "property"):
        lines[:] = [line.replace(":", COLON) for line in lines]


def escape_docstring(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Keep bars and stars of equations in docstrings from being read as markup; show colons that were hidden."""
    for i, line in enumerate(lines):
        parts = re.split(r"(`[^`]*`)(?=\w)?", line.replace(COLON, ":"))
        escaped = (part if j % 2 else re.sub(r"(?<!\\)([|*])", r"\\\1", part) for j, part in enumerate(parts))
        lines[i] = re.sub(r"(`[^`]+`)(?=[A-Za-z])", r"\1\\ ", "".join(escaped))


def is_external(kind: str, target: str) -> bool:
    """Whether a reference is to something without a page here: another package's, or an alias of a type."""
    return kind in {"class", "obj", "data", "exc", "func", "meth", "attr", "mod"} and not target.startswith("#")
