"""`tgdsl doctor`: what an installation has, and what follows where something is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tgdsl.report.doctor import Installation


@dataclass(frozen=True)
class Doctor:
    """Show versions, devices, compilers, OpenGL and caches, with faults and their fallbacks; exit code 1 at a fault."""

    json: bool = False
    """Print JSON, for a report."""

    def run(self) -> None:
        """Print what there is."""
        import json
        import sys
        from dataclasses import asdict

        from tgdsl.report.doctor import examine

        examination = examine()
        print(json.dumps(asdict(examination), indent=2, ensure_ascii=False) if self.json else _text(examination))
        if not examination.is_sound:
            sys.exit(1)


def _text(found: Installation) -> str:
    """Return it as tables."""
    from tgdsl.console.tables import text_table

    rows = [(p.name, p.installed or "–", p.wanted or "any", p.extra) for p in found.packages]
    parts = [
        _listing(found.system),
        text_table(("package", "installed", "wanted", "extra"), rows),
        text_table(("device", ""), found.devices.items()),
        text_table(("compiler", ""), [(name, place or "none") for name, place in found.compilers.items()]),
        text_table(("MUJOCO_GL", ""), [(name, "draws" if draws else "does not draw") for name, draws in found.opengl.items()]),
        text_table(("cache", ""), [(name, _size(size)) for name, size in found.caches.items()]),
    ]
    parts.append("\n".join(f"{finding.level}: {finding.what}: {finding.then}" for finding in found.findings))
    return "\n\n".join(parts)


def _listing(entries: Mapping[str, str]) -> str:
    width = max(map(len, entries))
    return "\n".join(f"{name.ljust(width)}  {value}" for name, value in entries.items())


def _size(size: int | None) -> str:
    return "none yet" if size is None else f"{size / 2**20:.1f} MiB"
