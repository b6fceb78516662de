"""Types and shapes are checked at run time in tests, and only there; and the command line is run as users run it."""

import gc
import sys
import warnings
from collections.abc import Generator
from pathlib import Path

import jaxtyping
import pytest
import quick_checks
import quick_compiles
from jaxtyping import install_import_hook

quick_compiles.prepare()
quick_checks.prepare()
install_import_hook("tgdsl", "beartype.beartype")

from tgdsl.quantities.base import Gathered, Scene  # noqa: E402

for traced in (Gathered, Scene):
    # A call that torch.compile traces makes objects of these, and Dynamo cannot look into checks of such objects' methods,
    # not even with `jaxtyping_disable`.
    for name, method in list(vars(traced).items()):
        if hasattr(method, "__wrapped__"):
            setattr(traced, name, method.__wrapped__)


MADE_UP = ("tests/sensors/", "tests/quantities/", "tests/module/", "tests/runtime/")
"""Rooms whose tests make up the poses too, and so have taxels where no object would come in a simulator."""


@pytest.fixture
def here(monkeypatch, capsys):
    """Run a command in this process, which spares the seconds that importing torch takes; return exit code and both texts."""

    def run(folder: Path, *arguments: str) -> tuple[int, str, str]:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["tgdsl", *arguments])
        monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
        capsys.readouterr()
        try:
            from tgdsl.commands.cli import main

            main()
            code = 0
        except SystemExit as ended:
            code = int(ended.code or 0)
        return code, *capsys.readouterr()

    return run


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, object, object]:
    """Check no types and shapes on a GPU, where torch compiles: it cannot trace run-time checks."""
    if item.get_closest_marker("slow"):
        quick_compiles.quicken()
    with pytest.MonkeyPatch.context() as patch:
        if item.get_closest_marker("gpu"):
            patch.setattr(jaxtyping.config, "jaxtyping_disable", True)
        made = yield
    if item.get_closest_marker("slow") and (nextitem is None or nextitem.path != item.path):
        quick_compiles.forget()
    return made


def pytest_collection_finish() -> None:
    """By now all that tests import is imported, but for what compiles."""
    quick_compiles.settle()


def pytest_unconfigure() -> None:
    """Have all freed, or else nanobind tells at the end of what was not."""
    gc.unfreeze()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark as slow what slow.txt lists, and what is slow in the suite that kinds inherit; take taxels as they are in some rooms.

    That suite has no marks: other people's pytest would not know them.
    """
    listed = (Path(__file__).parent / "slow.txt").read_text(encoding="utf-8").splitlines()
    slow = {line for line in listed if not line.startswith("#")}
    for item in items:
        if getattr(item, "originalname", "") == "test_compiled_equals_eager" or item.nodeid.split("[")[0] in slow:
            item.add_marker("slow")
        if item.nodeid.startswith(MADE_UP):
            item.add_marker(pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning"))
