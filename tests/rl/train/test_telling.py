"""What is told while a policy is learned."""

import errno
import os

import pytest

from tgdsl.errors import FileError
from tgdsl.rl.train.telling import Board


@pytest.mark.parametrize("at", ["add", "close"])
def test_what_tensorboard_cannot_write_is_named(tmp_path, monkeypatch, at):
    """It writes in a thread of its own, and raises what that has met where it is called next, without a file's name."""
    board = Board(tmp_path, 0)
    writer = board._writer

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    board.add({"Loss/value": 1.0}, 1)
    monkeypatch.setattr(writer, "add_scalar" if at == "add" else "close", full)
    with pytest.raises(FileError, match=r"events\.out\.tfevents: No space left on device"):
        board.add({"Loss/value": 1.0}, 2) if at == "add" else board.close()
    monkeypatch.undo()
    writer.close()
