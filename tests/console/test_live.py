"""Live tables on a terminal and on a pipe."""

import io

from tgdsl.console import progress as module
from tgdsl.console.progress import LiveTable


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_pipe_gets_the_last_table_only(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr("sys.stdout", stream)
    live = LiveTable()
    live.show(["a", "b"])
    assert stream.getvalue() == ""
    live.show(["c", "d"], is_last=True)
    assert stream.getvalue() == "c\nd\n"


def test_a_terminal_is_drawn_over_at_most_once_per_period(monkeypatch):
    now = 100.0
    monkeypatch.setattr(module.time, "monotonic", lambda: now)
    stream = Terminal()
    monkeypatch.setattr("sys.stdout", stream)
    live = LiveTable()  # a period of 0.1 s
    live.show(["a", "b"])
    assert stream.getvalue() == "a\nb\n"
    now = 100.05
    live.show(["too soon"])
    assert stream.getvalue() == "a\nb\n"
    now = 100.11
    live.show(["c", "d", "e"])
    assert stream.getvalue() == "a\nb\n\x1b[2A\x1b[Jc\nd\ne\n"
    live.show(["last"], is_last=True)
    assert stream.getvalue().endswith("\x1b[3A\x1b[Jlast\n")


def test_output_is_flushed_at_once():
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="utf-8", newline="\n")
    LiveTable(stream).show(["a", "b"], is_last=True)
    assert raw.getvalue() == b"a\nb\n"
