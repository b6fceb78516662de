"""Things that are closed at the end of a `with` block."""

from typing import Self


class Closable:
    """A context manager that calls `close` at the end."""

    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
