"""Which tests are slow, and running the command line in the test's process.

`make test` runs the tests that are not marked `slow`; `make test-full` runs the rest, and some of the quick ones again with
`--check-types`: jaxtyping and beartype then check types and shapes at every call.
"""

import contextlib
import sys
import warnings
from pathlib import Path

import pytest

MADE_UP_POSES = ("tests/sensors/", "tests/quantities/", "tests/module/", "tests/runtime/")
"""Folders whose tests make up poses, and so have taxels that no object would reach in a simulator."""

LONGEST = (
    "test_all_kinds_in_one_graph",
    "test_every_kind_is_exported",
    "test_a_robot_of_the_wheel_compiles_and_runs",
    "test_a_compiled_package_computes_the_same_in_python_and_cpp",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add `--check-types`."""
    parser.addoption("--check-types", action="store_true", help="check types and shapes of tgdsl's functions at every call")


def pytest_configure(config: pytest.Config) -> None:
    """Check types, if asked to, before anything imports tgdsl."""
    if config.getoption("--check-types"):
        from jaxtyping import install_import_hook

        install_import_hook("tgdsl", "typed_calls.check")


@pytest.fixture
def here(monkeypatch, capsys):
    """Run a command in this process, which spares the seconds that importing torch takes; return exit code and both texts."""

    def run(folder: Path, *arguments: str) -> tuple[int, str, str]:
        monkeypatch.chdir(folder)
        monkeypatch.setattr(sys, "argv", ["tgdsl", *arguments])
        monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # the command sets its own
        monkeypatch.setattr("tgdsl.console.progress.LINE_PERIOD", 1e6)  # no lines of progress on a busy machine
        capsys.readouterr()
        try:
            from tgdsl.commands.cli import main

            main()
            code = 0
        except SystemExit as ended:
            code = int(ended.code or 0)
        return code, *capsys.readouterr()

    return run


@pytest.fixture
def no_onnx(monkeypatch):
    """Write an empty file for each ONNX policy, whose export takes a second; rl/playing/test_onnx_policy.py tests that."""
    for writer in ("train.learner", "students.results"):
        monkeypatch.setattr(f"tgdsl.rl.{writer}.write_onnx_policy", lambda network, texts, file: file.touch())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the suite that kinds inherit, which has no marks: other people's pytest would not know them.

    Seven environments suffice here, where each kind has other tests too. The longest tests begin first, so that no
    process waits for one at the end. Warp compiles a CPU's kernels without optimisation, in half the time.
    """
    if (torch := sys.modules.get("torch")) and not torch.cuda.is_available():
        with contextlib.suppress(ImportError):
            import warp

            warp.config.optimization_level = 0
    items.sort(key=lambda item: getattr(item, "originalname", "") not in LONGEST)
    if suite := sys.modules.get("tgdsl.testing.conformance"):
        suite.KindConformance.num_envs = 7
    for item in items:
        if getattr(item, "originalname", "") == "test_compiled_equals_eager":
            item.add_marker("slow")
        if item.nodeid.startswith(MADE_UP_POSES):
            item.add_marker(pytest.mark.filterwarnings("ignore::tgdsl.errors.UnfeltWarning"))
