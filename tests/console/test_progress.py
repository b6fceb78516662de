"""Long work reports its progress, to callbacks and on a terminal."""

import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios
import threading
import time
from pathlib import Path

import pytest

import tgdsl
from tgdsl.console import progress as progress_module
from tgdsl.console.bar import Bar
from tgdsl.console.progress import StatusLine

REPOSITORY = Path(__file__).parents[2]
SCENE = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0  .02 0 0  0 .02 0  0 0 .02"/></asset>
  <worldbody>
    <body name="pad"><geom name="pad" type="box" size=".03 .03 .01"/></body>
    <body name="side" pos=".1 0 0"><geom name="side" type="box" size=".03 .03 .01"/></body>
    <body name="item" pos="0 0 .029"><joint name="lift" type="slide" axis="0 0 1"/><geom type="mesh" mesh="wedge"/></body>
  </worldbody>
  <actuator><motor joint="lift"/></actuator>
</mujoco>
"""
DOCUMENT = """tgdsl: 1
robot:
  model: scene.xml
  layout: {resolutions: {low: {"*d*": {method: grid, rows: 2, columns: 3, direction: [0, 0, -1], radius: 4 mm}}}}
objects: {item: {body: item, tolerance: 0.5 mm, surface: visual}}
sensors:
  depth: {kind: contact_depth, links: "*", feels: [item]}
  near: {kind: proximity, links: pad, feels: [item]}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "pad.yaml").write_text(DOCUMENT)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_compile_reports_its_steps_in_order(folder):
    messages = []
    tgdsl.compile("pad.yaml", progress=messages.append)
    assert messages == [
        "reading robot and scene",
        "placing taxels on pad (1 of 2 links)",
        "placing taxels on side (2 of 2 links)",
        "lowering sensor depth",
        "lowering sensor near",
        "object item: distances",
        "object item: moments of its surface, kept for the next time",
        "compiling the scene",
    ]


def test_variants_are_counted(folder):
    shapes = [{"type": "box", "size": [0.01] * 3}, {"type": "sphere", "size": [0.01]}]
    messages = []
    overrides = {
        "objects": {"item": {"body": "item", "variants": shapes}},
        "sensors.near": {"kind": "contact", "links": "pad", "feels": ["item"]},
    }
    tgdsl.compile("pad.yaml", overrides=overrides, progress=messages.append)
    assert [line for line in messages if line.startswith("object")] == [
        "object item: distances (1 of 2 variants)",
        "object item: distances (2 of 2 variants)",
    ]


def test_a_progress_callback_does_not_change_the_plan(folder):
    plans = [tgdsl.compile("pad.yaml", progress=progress).plan.to_json() for progress in (None, lambda what: None)]
    assert plans[0] == plans[1]


def test_an_exception_of_the_callback_ends_the_work(folder):
    def stop(what):
        if what.startswith("object"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tgdsl.compile("pad.yaml", progress=stop)


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_status_line_is_overwritten_and_wiped(monkeypatch):
    monkeypatch.setenv("COLUMNS", "11")
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with StatusLine() as progress:
        progress("a first long line")
        progress("second")
    assert screen.getvalue() == "\r\x1b[Ka first lo\r\x1b[Ksecond\r\x1b[K"


def test_short_work_prints_nothing_without_a_terminal():
    stream, before = io.StringIO(), set(threading.enumerate())
    with StatusLine(stream) as progress:
        progress("first")
        assert all(thread.daemon for thread in set(threading.enumerate()) - before), (
            "an unfinished line would keep Python running"
        )
    assert stream.getvalue() == ""


def wait_for(stream: io.StringIO, text: str) -> None:
    end = time.monotonic() + 20
    while text not in stream.getvalue() and time.monotonic() < end:
        time.sleep(0.01)


def test_a_long_job_is_printed_once_without_a_terminal():
    """Also while the job blocks the thread that reported it."""
    stream = io.StringIO()
    with StatusLine(stream, period=0.05) as progress:
        progress("long")
        wait_for(stream, "long")
        time.sleep(0.2)
        progress("other")
        wait_for(stream, "other")
    progress("again")
    wait_for(stream, "again")
    progress.wipe()
    assert stream.getvalue() == "long\nother\nagain\n"


def test_lines_are_at_least_a_period_apart():
    stream, begin = io.StringIO(), time.monotonic()
    with StatusLine(stream, period=0.1) as progress:
        for i in range(50):
            progress(str(i))
            time.sleep(0.01)
    assert 1 <= len(stream.getvalue().splitlines()) <= (time.monotonic() - begin) / 0.1


def test_a_bar_prints_counts_without_a_terminal(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress_module, "LINE_PERIOD", 0.05)
    with Bar("stepping", 7, "step") as bar:
        bar.update()
        bar.update(2)
        bar.update(0)
        wait_for(stream, "stepping")
        bar.set_description_str("drawing")
        wait_for(stream, "drawing")
    assert stream.getvalue() == "stepping: 3 of 7 steps\ndrawing\n"


def test_a_bar_on_a_terminal_shows_its_new_name(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    with Bar("stepping", 7, "step") as bar:
        bar.set_description("drawing")
    assert screen.getvalue().startswith("\rstepping: ") and "\rdrawing: " in screen.getvalue()


@pytest.mark.slow
def test_a_command_shows_progress_on_a_terminal(folder):
    """Progress goes to standard error, which is the terminal; standard output is unchanged."""
    master, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "PYTHONWARNINGS": "error", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "tgdsl", "run", "pad.yaml", "--seconds", "0.05"]
    with os.fdopen(master, "rb", buffering=0) as screen:
        with os.fdopen(terminal, "wb") as out:
            process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=out, text=True)
        drawn = b""
        while True:
            try:
                part = screen.read(4096)
            except OSError:  # the other end is closed
                break
            if not part:
                break
            drawn += part
        output, _ = process.communicate()
    assert process.returncode == 0, drawn
    text = drawn.decode()
    for message in (
        "object item: distances",
        "starting the simulation",
        "stepping",
        "drawing the picture",
        "drawing the overview",
    ):
        assert message in text
    assert text.endswith("\r\x1b[K")
    assert "drawing" not in output
    assert output.splitlines()[-1] == "overview: out/overview.png"


def test_a_status_line_is_flushed_at_once():
    """Both drawing and wiping are flushed."""

    class Screen(io.TextIOWrapper):
        def isatty(self) -> bool:
            return True

    raw = io.BytesIO()
    line = StatusLine(Screen(raw, encoding="utf-8", newline="\n"))
    line("working")
    assert raw.getvalue() == b"\r\x1b[Kworking"
    line.wipe()
    assert raw.getvalue() == b"\r\x1b[Kworking\r\x1b[K"
