"""Architecture: rooms stand on floors, imports go down without circles, and each foreign library is imported in its place."""

import ast
from functools import cache
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "tgdsl"
FLOORS = (
    ("errors",),
    ("fields", "console", "tensors", "files"),
    ("geometry", "surfaces", "layout"),
    ("quantities", "modal"),
    ("sensors", "observations"),
    ("plan", "schema"),
    ("scene",),
    ("module", "formats"),
    ("placement",),
    ("compiler", "runtime"),
    ("tuning", "view"),
    ("adapters", "calibration", "rl"),
    ("report",),
    ("commands",),
)
FLOOR_OF = {part: floor for floor, parts in enumerate(FLOORS) for part in parts}
EXEMPT = {
    "__init__": "hands out the public names of every floor, each imported when it is first used",
    "__main__": "starts the command line",
    "testing": "stands beside the floors: the suite that kinds inherit runs a document all the way through",
}
PURE = ("sensors", "geometry", "layout", "plan", "module", "tensors")
"""What a compiled module is made of: it knows neither MuJoCo nor YAML."""
SOURCES = sorted(PACKAGE.rglob("*.py"))


def name_of(file: Path) -> str:
    """Return a module's name below tgdsl, `schema.load`; a package's own is its folder's."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {name_of(file): file for file in SOURCES}
PACKAGES = {"tgdsl", *(f"tgdsl.{name_of(f)}" for f in SOURCES if f.name == "__init__.py" and f.parent != PACKAGE)}


def read_imports(text: str, file: Path) -> list[tuple[str, bool]]:
    """Return the imports of a file's text as absolute names, and whether each is inside a function."""
    found = []

    def visit(node: ast.AST, is_inside: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, (ast.stmt, ast.excepthandler, ast.match_case)):
                continue  # an expression imports nothing
            if isinstance(child, ast.Import):
                found.extend((alias.name, is_inside) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                package = ["tgdsl", *file.relative_to(PACKAGE).parts[:-1]]
                base = package[: len(package) - child.level + 1] if child.level else []
                module = ".".join([*base, *([child.module] if child.module else [])])
                # `from tgdsl import errors` names a module; `from tgdsl.errors import TgdslError` does not.
                found.extend((f"{module}.{a.name}" if module in PACKAGES else module, is_inside) for a in child.names)
            visit(child, is_inside or isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)))

    visit(ast.parse(text), False)
    return found


@cache
def imports(file: Path) -> list[tuple[str, bool]]:
    """Return the imports of a file."""
    return read_imports(file.read_text(encoding="utf-8"), file)


def room_of(name: str) -> str:
    return name.split(".")[0]


def own(file: Path) -> list[str]:
    """Return the modules of tgdsl that a file imports, as names below tgdsl; `import tgdsl` itself is ''."""
    names = [
        name.removeprefix("tgdsl").lstrip(".") for name, _ in imports(file) if name == "tgdsl" or name.startswith("tgdsl.")
    ]
    return [name if name in MODULES or not name else name.rpartition(".")[0] for name in names]


BESIDE = {"helpers", "oracles", "benchmarks", "robots", "examples", "docs"}
"""Folders of tests that are no rooms."""
CLAMPED = "sensors.elastomer.clamped."
"""Finite elements of a pad at compile time; a module, once compiled, does without."""
LEARNING = ("rl.train.", "rl.students.")
LEARNERS = {"gymnasium", "rsl_rl", "tensordict", "imageio_ffmpeg", "skrl", "stable_baselines3"}
"""Extras: what imports them at the top of a file is itself imported in functions alone."""
SETTINGS = ("tgdsl.rl.train.spec", "tgdsl.rl.students.spec")
TASKS = ("in_hand_repose", "in_palm_rotate", "screwdriver")
"""Tasks whose settings of learning differ from the defaults."""
IN_FUNCTIONS = {
    ("geometry.bvh", "warp"),
    ("runtime.warp.stream", "mujoco_warp"),
    ("runtime.warp.stream", "warp"),
    ("surfaces.meshlab", "pymeshlab"),
}
"""Where warp, an extra, and pymeshlab, which is GPL-3, are imported: inside functions, and nowhere else but in adapters to simulators on warp."""


def places(*libraries: str) -> set[tuple[str, str, bool]]:
    """Return which modules import these libraries, and whether inside a function."""
    return {
        (name, room_of(i), inside) for name, file in MODULES.items() for i, inside in imports(file) if room_of(i) in libraries
    }


def test_imports_go_down_without_circles():
    text = "import numpy.linalg\nfrom tgdsl import errors\nfrom . import lower\nfrom ..geometry.shapes import box\ndef f():\n  import mujoco\n"
    assert read_imports(text, PACKAGE / "compiler" / "imaginary.py") == [
        ("numpy.linalg", False),
        ("tgdsl.errors", False),
        ("tgdsl.compiler.lower", False),
        ("tgdsl.geometry.shapes", False),
        ("mujoco", True),
    ]
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "__main__", "errors"}
    homeless = sorted({room_of(name) for name in MODULES} - FLOOR_OF.keys() - EXEMPT.keys())
    assert not homeless, f"give {homeless} a floor in FLOORS"
    assert not FLOOR_OF.keys() & EXEMPT.keys()

    wrong = []
    for name, file in MODULES.items():
        here = room_of(name)
        for imported in own(file) if here not in EXEMPT else ():
            there = room_of(imported)
            if not imported:  # `import tgdsl`: to find the package's folder
                wrong += [f"{name} imports tgdsl as a whole"] if here != "files" else []
            elif there not in FLOOR_OF:
                wrong.append(f"{name} imports tgdsl.{imported}, which is on no floor")
            elif FLOOR_OF[there] > FLOOR_OF[here]:
                wrong.append(f"{name} imports tgdsl.{imported}, which is above it")
            elif {here, there} == {"compiler", "runtime"}:
                wrong.append(f"{name} imports tgdsl.{imported}: compiler and runtime do not know each other")
    assert not wrong, "\n".join(wrong)

    files = {name: {i for i in own(file) if i and i != name} for name, file in MODULES.items() if room_of(name) not in EXEMPT}
    rooms: dict[str, set[str]] = {}
    for name, names in files.items():
        rooms.setdefault(room_of(name), set()).update(room_of(i) for i in names if room_of(i) != room_of(name))
    for waiting in (files, rooms):
        while ready := [name for name, needed in waiting.items() if not needed & waiting.keys()]:
            for name in ready:
                del waiting[name]
        assert not waiting, "a circle"

    folders = {path.parent.relative_to(REPOSITORY / "tests").as_posix() for path in (REPOSITORY / "tests").rglob("test_*.py")}
    assert {path for path in folders if not (PACKAGE / path).is_dir()} <= BESIDE


def test_foreign_libraries_are_imported_in_their_places():
    """A module knows neither MuJoCo nor YAML; extras and heavy libraries are imported where they are used."""
    for name, file in MODULES.items():
        if room_of(name) in PURE:
            foreign = {room_of(imported) for imported, _ in imports(file)}
            assert not foreign & {"mujoco", "mujoco_warp", "ruamel", "pymeshlab"}, name
            assert name.startswith(CLAMPED) or not foreign & {"trimesh", "igl", "skfem"}, name
    heavy = {place for place in places("warp", "mujoco_warp", "pymeshlab") if not place[0].startswith("adapters.")}
    assert heavy == {(*place, True) for place in IN_FUNCTIONS}
    assert not {name for name, _, inside in places("pxr") if not inside}, (
        "pxr takes a quarter of a second: import it in functions"
    )
    assert {room_of(name) for name, *_ in places("ruamel")} == {"schema"}

    uses = {(name, i, inside) for name, file in MODULES.items() for i, inside in imports(file) if i.startswith("tgdsl.")}
    clamped = {(name, inside) for name, i, inside in uses if i.startswith(f"tgdsl.{CLAMPED}") and not name.startswith(CLAMPED)}
    assert clamped == {("sensors.elastomer.operators", True)}

    assert {place for place in places(*LEARNERS) if not place[0].startswith(LEARNING)} == {
        ("rl.adapters.gymnasium", "gymnasium", False),
        ("rl.adapters.rsl_rl", "rsl_rl", False),
        ("rl.adapters.rsl_rl", "tensordict", False),
        ("rl.playing.video", "imageio_ffmpeg", True),
    }
    learning = tuple(f"tgdsl.{room}" for room in (*LEARNING, "rl.adapters"))
    at_top = {(name, i) for name, i, inside in uses if i.startswith(learning) and not inside}
    at_top = {(name, i) for name, i in at_top if not name.startswith((*LEARNING, "commands."))}
    assert at_top <= {(name, i) for name in ("rl.spec", *(f"rl.tasks.{task}" for task in TASKS)) for i in SETTINGS}
    assert not {place for place in places(*LEARNERS) if f"tgdsl.{place[0]}" in SETTINGS}
