"""The built pages: no warnings, and in a browser pictures, search and version switcher work. Nothing is fetched."""

import os
import shutil
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest

import tgdsl
from tgdsl.sensors import KINDS

pytestmark = pytest.mark.slow
REPOSITORY = Path(__file__).parents[2]
SPHINX = """
import sys
from sphinx.cmd.build import main
from tgdsl.commands.report import tests_of_clone

cases = tests_of_clone().CASES
one_each = {case.compute.func.kinds: case for case in reversed(cases) if case.is_reported and not case.is_slow}
cases[:] = one_each.values()
sys.exit(main(sys.argv[1:]))
"""
"""Builds pages with one comparison of each sensor kind; `tests/oracles` compute all."""
SOURCES = ("tgdsl", "robots", "examples", "benchmarks", "tests", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "LICENSE")


@pytest.fixture
def built(tmp_path_factory):
    """Build from a tree of links, so that generated pages do not come into the repository."""
    folder = tmp_path_factory.mktemp("docs")
    for name in SOURCES:
        (folder / name).symlink_to(REPOSITORY / name)
    shutil.copytree(REPOSITORY / "docs", folder / "docs", ignore=shutil.ignore_patterns("generated", "__pycache__"))
    built = folder / "site" / tgdsl.__version__
    command = [sys.executable, "-c", SPHINX, "-b", "html", "-W", "--keep-going", "--quiet", "docs", built]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    ran = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    return built


WITH_PICTURES = (
    "index", "generated/overview", "generated/gallery", "generated/kinds/contact", "background/hands", "start/learn",
)  # fmt: skip


class Silent(SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


@contextmanager
def browser_of(built):
    """Yield a tab of headless Chromium and the address of the built pages."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed (apt-get install chromium): the built docs are not opened in a browser")
    from playwright.sync_api import sync_playwright

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=str(built)))
    Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser.new_page(), f"http://127.0.0.1:{server.server_port}"
        browser.close()
    server.shutdown()
    server.server_close()


def test_pages_are_built_pictures_drawn_and_words_found(built):
    """One test, as building takes minutes."""
    for kind in KINDS:
        assert (built / "generated" / "kinds" / f"{kind.name}.html").is_file()
    pages = (REPOSITORY / "docs").rglob("*.md")
    for source in (page for page in pages if "generated" not in page.parts):
        assert (built / source.relative_to(REPOSITORY / "docs").with_suffix(".html")).is_file()
    assert 'href="../../_modules/tgdsl/' in (built / "generated" / "api" / "functions.html").read_text(encoding="utf-8")
    site, older = built.parent, built.parent / "0.0.9"
    older.mkdir()
    for name in ("index.html", "objects.inv"):
        shutil.copy(built / name, older)
    subprocess.run([sys.executable, REPOSITORY / "docs/_ext/tgdsl_docs/versions.py", site], check=True)
    with browser_of(site) as (tab, root):
        address = f"{root}/{tgdsl.__version__}"
        tab.goto(root)
        tab.wait_for_url(f"{address}/index.html")
        tab.goto(f"{address}/background/sound.html")
        switcher = tab.locator(".version-switcher select")
        assert switcher.locator("option").all_inner_texts() == [tgdsl.__version__, "0.0.9"]
        assert switcher.locator("option:checked").inner_text() == tgdsl.__version__
        switcher.select_option(label="0.0.9")
        tab.wait_for_url(f"{root}/0.0.9/index.html")
        for name in WITH_PICTURES:
            tab.goto(f"{address}/{name}.html", wait_until="load")
            widths = tab.eval_on_selector_all(".content img, article img", "images => images.map(image => image.naturalWidth)")
            assert widths and min(widths) > 0, name
        for word, expected in (("permittivity", "how-to/kind"), ("read_delay", "background/noise")):
            tab.goto(f"{address}/search.html?q={word}")
            tab.wait_for_selector(f'#search-results li a[href*="{expected}"]', timeout=60_000)  # they appear one by one
