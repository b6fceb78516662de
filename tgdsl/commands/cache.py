"""`tgdsl cache`: cached results of earlier compilations."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cache:
    """Show the folder, number and size of cached distances, moments and modes; or remove them all."""

    clear: bool = False
    """Remove all of it; it is recomputed when it is wanted."""

    def run(self) -> None:
        """Print the cache's contents, or how much was removed."""
        from tgdsl.files import cache

        if self.clear:
            removed = cache.evict(-1)
            print(f"{cache.folder()}: removed {_counted([entry.size for entry in removed])}")
            return
        limit = cache.max_bytes()
        print(f"{cache.folder()}: {_counted([entry.size for entry in cache.entries()])}, of at most {limit} bytes")


def _counted(sizes: list[int]) -> str:
    return f"{len(sizes)} {'entry' if len(sizes) == 1 else 'entries'}, {sum(sizes)} bytes"
