"""`tgdsl cache`: what is kept of earlier compilations."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Cache:
    """Show where baked distances, moments and modes are kept, how many and how large they are; or remove them all."""

    clear: bool = False
    """Remove all of it; it is recomputed when it is wanted."""

    def run(self) -> None:
        """Say what there is, or what was removed."""
        from tgdsl.files import cache

        if self.clear:
            removed = cache.evict(-1)
            print(f"{cache.folder()}: removed {_counted([entry.size for entry in removed])}")
            return
        limit = cache.max_bytes()
        print(f"{cache.folder()}: {_counted([entry.size for entry in cache.entries()])}, of at most {limit} bytes")


def _counted(sizes: list[int]) -> str:
    return f"{len(sizes)} {'entry' if len(sizes) == 1 else 'entries'}, {sum(sizes)} bytes"
