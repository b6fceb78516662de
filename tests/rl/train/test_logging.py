"""What is told while a policy is learned."""

import errno
import os

import pytest

from tgdsl.errors import FileError
from tgdsl.rl.train.run import Board, ProgressBar


@pytest.mark.parametrize("at", ["add", "close"])
def test_what_tensorboard_cannot_write_is_named(tmp_path, monkeypatch, at):
    """It writes in a thread of its own, and raises what that has met where it is called next, without a file's name."""
    board = Board(tmp_path, 0)
    writer = board.writer

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    board.add({"Loss/value": 1.0}, 1)
    monkeypatch.setattr(writer, "add_scalar" if at == "add" else "close", full)
    with pytest.raises(FileError, match=r"events\.out\.tfevents: No space left on device"):
        board.add({"Loss/value": 1.0}, 2) if at == "add" else board.close()
    monkeypatch.undo()
    writer.close()


@pytest.mark.parametrize(("iterations", "begins"), [(6000, "38/6000: "), (None, "38: ")])
@pytest.mark.parametrize(("left", "shown"), [(119.7, "0:02:00 left"), (59.4, "0:00:59 left"), (3599.9, "1:00:00 left")])
def test_a_line_tells_what_ends_the_run(capsys, iterations, begins, left, shown):
    """Its iterations, or where there are none its time, in whole seconds."""
    bar = ProgressBar(iterations, 0, "turns")
    bar.show({"iteration": 38, "seconds": 20.0, "steps_per_second": 1234.5}, left)
    bar.close()
    assert capsys.readouterr().out == f"{begins}1,234 steps/s, {shown}\n"
