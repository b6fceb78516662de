"""The five floors of the design: imports only go down, and what is heavy or foreign stays where it belongs."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tgdsl"
FLOORS = {
    5: {
        "cli",
        "arguments",
        "cache_commands",
        "run_commands",
        "calibrate_commands",
        "hand_commands",
        "robot_commands",
        "rl",
        "report",
    },
    4: {"compiler", "runtime"},
    3: {
        "schema",
        "module",
        "queries",
        "buffers",
        "moment_sources",
        "clock",
        "history",
        "reading",
        "memory",
        "felt_objects",
        "taxels",
        "observing",
        "outputs",
        "calls",
        "env_ids",
        "example",
        "state",
        "scene",
        "slot_watch",
        "artifact",
        "explain",
    },
    2: {"sensors", "observations", "proprioception", "layout", "plan", "places"},
    1: {"geometry", "devices", "progress", "tables", "units", "fields", "fusion", "graphed", "regions", "errors"},
}
FLOOR_OF = {part: floor for floor, parts in FLOORS.items() for part in parts}
EXEMPT = {
    "__init__": "hands out the public names of every floor, each imported when it is first used",
    "__main__": "starts the command line",
    "testing": "stands beside the floors: the suite that kinds inherit runs a document all the way through",
}
PURE = ("sensors", "geometry", "layout", "plan", "state", "module")
"""What a compiled module is made of: it knows neither MuJoCo nor YAML."""
SOURCES = sorted(PACKAGE.rglob("*.py"))


def name_of(file: Path) -> str:
    """Return a module's name below tgdsl, `schema.load`; a package's own is its folder's."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {name_of(file): file for file in SOURCES}


def imports(file: Path) -> list[tuple[str, bool]]:
    """Return all that a file imports, as absolute names, and whether it does so inside a function."""
    found = []

    def visit(node: ast.AST, is_inside: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                found.extend((alias.name, is_inside) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                package = ["tgdsl", *file.relative_to(PACKAGE).parts[:-1]]
                base = package[: len(package) - child.level + 1] if child.level else []
                module = ".".join([*base, *([child.module] if child.module else [])])
                # `from tgdsl import errors` names a module; `from tgdsl.errors import TgdslError` does not.
                found.extend((f"{module}.{a.name}" if module in PACKAGES else module, is_inside) for a in child.names)
            visit(child, is_inside or isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)))

    visit(ast.parse(file.read_text(encoding="utf-8")), False)
    return found


PACKAGES = {"tgdsl", *(f"tgdsl.{name_of(f)}" for f in SOURCES if f.name == "__init__.py" and f.parent != PACKAGE)}


def part_of(name: str) -> str:
    return name.split(".")[0]


def own(file: Path) -> list[str]:
    """Return the modules of tgdsl that a file imports, as names below tgdsl; `import tgdsl` itself is ''."""
    return [name.removeprefix("tgdsl").lstrip(".") for name, _ in imports(file) if name == "tgdsl" or name.startswith("tgdsl.")]


def test_the_reader_of_imports(tmp_path, monkeypatch):
    file = PACKAGE / "compiler" / "imaginary.py"
    text = "import numpy.linalg\nfrom tgdsl import errors\nfrom . import lower\nfrom ..geometry.shapes import box\ndef f():\n  import mujoco\n"
    monkeypatch.setattr(Path, "read_text", lambda self, encoding=None: text)
    assert imports(file) == [
        ("numpy.linalg", False),
        ("tgdsl.errors", False),
        ("tgdsl.compiler.lower", False),
        ("tgdsl.geometry.shapes", False),
        ("mujoco", True),
    ]


def test_every_module_has_a_floor():
    homeless = sorted({part_of(name) for name in MODULES} - FLOOR_OF.keys() - EXEMPT.keys())
    assert not homeless, f"give {homeless} a floor in FLOORS"
    assert not FLOOR_OF.keys() & EXEMPT.keys()


@pytest.mark.parametrize("name", [name for name in MODULES if part_of(name) not in EXEMPT])
def test_imports_go_down(name):
    here = part_of(name)
    for imported in own(MODULES[name]):
        there = part_of(imported)
        if not imported:  # `import tgdsl`: to find the package's folder
            assert name == "schema.files", f"{name} imports tgdsl as a whole"
            continue
        assert there in FLOOR_OF, f"{name} imports tgdsl.{imported}, which is on no floor"
        assert FLOOR_OF[there] <= FLOOR_OF[here], (
            f"{name} (floor {FLOOR_OF[here]}) imports tgdsl.{imported} ({FLOOR_OF[there]})"
        )
        assert {here, there} != {"compiler", "runtime"}, f"{name} imports tgdsl.{imported}"


def test_no_circles():
    """Within a floor too: every module can be loaded after those that it imports (imports inside functions aside)."""
    waiting = {}
    for name, file in MODULES.items():
        if part_of(name) in EXEMPT:
            continue
        names = {imported.removeprefix("tgdsl.") for imported, is_inside in imports(file) if not is_inside}
        waiting[name] = {other for other in names & MODULES.keys() if other != name}
    while ready := [name for name, needed in waiting.items() if not needed & waiting.keys()]:
        for name in ready:
            del waiting[name]
    assert not waiting


@pytest.mark.parametrize("name", [name for name in MODULES if part_of(name) in PURE])
def test_what_a_module_is_made_of_knows_neither_mujoco_nor_yaml(name):
    foreign = {part_of(imported) for imported, _ in imports(MODULES[name])}
    assert not foreign & {"mujoco", "mujoco_warp", "ruamel", "pymeshlab", "trimesh", "igl"}


def test_warp_is_imported_in_two_functions():
    """It is an extra: only a query of triangles at run time and physics on a GPU may ask for it."""
    found = [
        (name, part_of(i), is_inside)
        for name, file in MODULES.items()
        for i, is_inside in imports(file)
        if part_of(i) in ("warp", "mujoco_warp")
    ]
    assert sorted(found) == [
        ("geometry.bvh", "warp", True),
        ("runtime.warp.lane", "mujoco_warp", True),
        ("runtime.warp.lane", "warp", True),
    ]


def test_pxr_is_imported_in_functions():
    """It takes a quarter of a second and is wanted for USD alone."""
    found = {name for name, file in MODULES.items() for i, is_inside in imports(file) if part_of(i) == "pxr" and not is_inside}
    assert not found


def test_only_schema_reads_yaml():
    readers = {part_of(name) for name, file in MODULES.items() if any(part_of(i) == "ruamel" for i, _ in imports(file))}
    assert readers == {"schema"}


def test_pymeshlab_is_imported_in_one_function():
    """It is GPL-3: no compiled module, and nothing that only imports tgdsl, may load it."""
    found = [(name, is_inside) for name, file in MODULES.items() for i, is_inside in imports(file) if part_of(i) == "pymeshlab"]
    assert found == [("compiler.meshlab", True)]
