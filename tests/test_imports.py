"""The house: rooms on floors, imports only go down, no circles, files of a size; what is foreign stays where it belongs."""

import ast
from pathlib import Path

import pytest

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
    ("calibrate", "rl"),
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
LARGEST_ROOM, LONGEST_FILE = 16, 400


def name_of(file: Path) -> str:
    """Return a module's name below tgdsl, `schema.load`; a package's own is its folder's."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)


MODULES = {name_of(file): file for file in SOURCES}
PACKAGES = {"tgdsl", *(f"tgdsl.{name_of(f)}" for f in SOURCES if f.name == "__init__.py" and f.parent != PACKAGE)}


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


def room_of(name: str) -> str:
    return name.split(".")[0]


def own(file: Path) -> list[str]:
    """Return the modules of tgdsl that a file imports, as names below tgdsl; `import tgdsl` itself is ''."""
    names = [
        name.removeprefix("tgdsl").lstrip(".") for name, _ in imports(file) if name == "tgdsl" or name.startswith("tgdsl.")
    ]
    return [name if name in MODULES or not name else name.rpartition(".")[0] for name in names]


def test_the_reader_of_imports(monkeypatch):
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


def test_nothing_stands_at_the_root_but_rooms():
    assert {path.stem for path in PACKAGE.glob("*.py")} == {"__init__", "__main__", "errors"}
    homeless = sorted({room_of(name) for name in MODULES} - FLOOR_OF.keys() - EXEMPT.keys())
    assert not homeless, f"give {homeless} a floor in FLOORS"
    assert not FLOOR_OF.keys() & EXEMPT.keys()


@pytest.mark.parametrize("name", [name for name in MODULES if room_of(name) not in EXEMPT])
def test_imports_go_down(name):
    here = room_of(name)
    for imported in own(MODULES[name]):
        there = room_of(imported)
        if not imported:  # `import tgdsl`: to find the package's folder
            assert room_of(name) == "files", f"{name} imports tgdsl as a whole"
            continue
        assert there in FLOOR_OF, f"{name} imports tgdsl.{imported}, which is on no floor"
        assert FLOOR_OF[there] <= FLOOR_OF[here], f"{name} imports tgdsl.{imported}, which is above it"
        assert {here, there} != {"compiler", "runtime"}, f"{name} imports tgdsl.{imported}"


def test_no_circles():
    """Neither between files, imports inside functions counted, nor between rooms."""
    files = {name: {i for i in own(file) if i and i != name} for name, file in MODULES.items() if room_of(name) not in EXEMPT}
    rooms: dict[str, set[str]] = {}
    for name, names in files.items():
        rooms.setdefault(room_of(name), set()).update(room_of(i) for i in names if room_of(i) != room_of(name))
    for waiting in (files, rooms):
        while ready := [name for name, needed in waiting.items() if not needed & waiting.keys()]:
            for name in ready:
                del waiting[name]
        assert not waiting


def test_rooms_are_not_crowded():
    counts = {folder: len(list(folder.glob("*.py"))) for folder in {file.parent for file in SOURCES}}
    assert not {folder: count for folder, count in counts.items() if count > LARGEST_ROOM}


@pytest.mark.parametrize("folder", ["tgdsl", "tests", "benchmarks", "examples", "robots", "docs"])
def test_files_are_short(folder):
    lengths = {file: len(file.read_text(encoding="utf-8").splitlines()) for file in (REPOSITORY / folder).rglob("*.py")}
    assert not {file.name: length for file, length in lengths.items() if length > LONGEST_FILE}


def test_tests_mirror_the_rooms():
    beside = {"helpers", "benchmarks", "robots", "examples", "docs"}
    found = {path.parent.relative_to(REPOSITORY / "tests").as_posix() for path in (REPOSITORY / "tests").rglob("test_*.py")}
    assert {path for path in found if not (PACKAGE / path).is_dir()} <= beside


CLAMPED = "sensors.elastomer.clamped."
"""Finite elements of a pad at compile time; a module, once compiled, does without."""


def test_the_clamped_pad_is_imported_in_one_function():
    found = {
        (name, is_inside)
        for name, file in MODULES.items()
        if not name.startswith(CLAMPED)
        for i, is_inside in imports(file)
        if i.startswith(f"tgdsl.{CLAMPED}")
    }
    assert found == {("sensors.elastomer.blocks", True)}


@pytest.mark.parametrize("name", [name for name in MODULES if room_of(name) in PURE])
def test_what_a_module_is_made_of_knows_neither_mujoco_nor_yaml(name):
    foreign = {room_of(imported) for imported, _ in imports(MODULES[name])}
    if not name.startswith(CLAMPED):
        assert not foreign & {"trimesh", "igl", "skfem"}
    assert not foreign & {"mujoco", "mujoco_warp", "ruamel", "pymeshlab"}


def test_warp_is_imported_in_two_functions():
    """It is an extra: only a query of triangles at run time and physics on a GPU may ask for it."""
    found = [
        (name, room_of(i), is_inside)
        for name, file in MODULES.items()
        for i, is_inside in imports(file)
        if room_of(i) in ("warp", "mujoco_warp")
    ]
    assert sorted(found) == [
        ("geometry.bvh", "warp", True),
        ("runtime.warp.stream", "mujoco_warp", True),
        ("runtime.warp.stream", "warp", True),
    ]


def test_pxr_is_imported_in_functions():
    """It takes a quarter of a second and is wanted for USD alone."""
    found = {name for name, file in MODULES.items() for i, is_inside in imports(file) if room_of(i) == "pxr" and not is_inside}
    assert not found


def test_only_schema_reads_yaml():
    readers = {room_of(name) for name, file in MODULES.items() if any(room_of(i) == "ruamel" for i, _ in imports(file))}
    assert readers == {"schema"}


def test_pymeshlab_is_imported_in_one_function():
    """It is GPL-3: no compiled module, and nothing that only imports tgdsl, may load it."""
    found = [(name, is_inside) for name, file in MODULES.items() for i, is_inside in imports(file) if room_of(i) == "pymeshlab"]
    assert found == [("surfaces.meshlab", True)]


LEARNING, SETTINGS = ("rl.train.", "rl.students."), ("tgdsl.rl.train.spec", "tgdsl.rl.students.spec")


TASKS = ("in_hand_repose", "in_palm_rotate", "screwdriver")
"""Tasks whose numbers of learning are not the defaults."""


def test_what_learners_bring_is_imported_by_adapters_learning_and_the_video():
    """It is an extra; what is imported in no function is in files that the rest of tgdsl imports in functions alone."""
    learners = ("gymnasium", "rsl_rl", "tensordict", "imageio_ffmpeg", "skrl", "stable_baselines3")
    found = {
        (name, room_of(i), is_inside)
        for name, file in MODULES.items()
        for i, is_inside in imports(file)
        if room_of(i) in learners and not name.startswith(LEARNING)
    }
    assert found == {
        ("rl.adapters.gymnasium", "gymnasium", False),
        ("rl.adapters.rsl_rl", "rsl_rl", False),
        ("rl.adapters.rsl_rl", "tensordict", False),
        ("rl.playing.video", "imageio_ffmpeg", True),
    }
    others = {name: file for name, file in MODULES.items() if not name.startswith((*LEARNING, "commands."))}
    places = tuple(f"tgdsl.{room}" for room in (*LEARNING, "rl.adapters"))
    taken = [
        (name, i) for name, file in others.items() for i, is_inside in imports(file) if i.startswith(places) and not is_inside
    ]
    assert set(taken) <= {
        (name, settings) for name in ("rl.spec", *(f"rl.tasks.{task}" for task in TASKS)) for settings in SETTINGS
    }
    files = [MODULES[name.removeprefix("tgdsl.")] for name in SETTINGS]
    assert not [i for file in files for i, _ in imports(file) if room_of(i) in learners]
