"""Packages that look installed for one test, as pip would install them, with entry points for tgdsl."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tgdsl.files.plugins import installed


@contextlib.contextmanager
def installing(folder: Path, monkeypatch: pytest.MonkeyPatch, group: str, module: str) -> Iterator[Callable[..., None]]:
    """Yield a function that installs a package of one module, and forget them all in the end.

    Args:
        folder: Where the packages are written.
        monkeypatch: Puts them in front of the import path, as long as the test lasts.
        group: The entry points' group, as "tgdsl.kinds".
        module: The source of each package's module.

    Yields:
        A function of a package's name, its version and its entry points by name.
    """
    packages = []

    def install(package: str, version: str, **points: str) -> None:
        site = folder / f"site_{package}"
        info = site / f"{package}-{version}.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
        lines = [f"{name} = {value}" for name, value in points.items()]
        (info / "entry_points.txt").write_text(f"[{group}]\n" + "\n".join(lines) + "\n")
        (site / f"{package}.py").write_text(module)
        monkeypatch.syspath_prepend(site)
        packages.append(package)
        installed.cache_clear()

    installed.cache_clear()
    try:
        yield install
    finally:
        for package in packages:
            sys.modules.pop(package, None)
        installed.cache_clear()
