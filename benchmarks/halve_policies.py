"""Halve the size of policies' files: weights in float16, taxels to five digits; cards and normalisation do not change.

    python benchmarks/halve_policies.py policies/*.pt

`tgdsl` reads such weights as float32. A file is replaced only if the policy's actions change by at most a hundredth, for random
observations with the mean and variance of the normalisation. The largest change of an action and both sizes are printed.
"""

from __future__ import annotations

import argparse
import csv
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from tgdsl.files.write import atomic_write
from tgdsl.rl.playing.policy import CARD, read_policy

TAXELS, DIGITS = "taxels.csv", 5
MOST_CHANGE = 0.01
"""Largest accepted change of an action, whose range is of the order of 1."""


def halved(content: bytes) -> bytes:
    """Return the same policy with float16 weights."""
    extra: dict[str, Any] = {CARD: "", TAXELS: ""}
    module = torch.jit.load(io.BytesIO(content), map_location="cpu", _extra_files=extra)
    for weight in module.parameters():
        if weight.dtype == torch.float32:
            weight.data = weight.data.half()
    extra[TAXELS] = _rounded(_text(extra[TAXELS]))
    written = io.BytesIO()
    torch.jit.save(module, written, _extra_files={name: _text(text) for name, text in extra.items() if text})
    return written.getvalue()


def largest_change(one: torch.jit.ScriptModule, other: torch.jit.ScriptModule, rows: int = 1000) -> float:
    """Return the largest difference of two policies' actions, for observations by the mean and variance of normalisation."""
    buffers = {name.rpartition(".")[2].lstrip("_"): value for name, value in one.named_buffers()}
    deviation = buffers["var"].flatten().sqrt()
    torch.manual_seed(0)
    x = buffers["mean"].flatten() + deviation * torch.randn(rows, len(deviation))
    with torch.no_grad():
        return float((other(x.float()) - one(x.float())).abs().max())


def _text(value: str | bytes) -> str:
    return value if isinstance(value, str) else value.decode()


def _rounded(table: str) -> str:
    """Return a table with rounded numbers."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for row in csv.reader(io.StringIO(table)):
        writer.writerow([_rounded_cell(cell) for cell in row])
    return text.getvalue()


def _rounded_cell(cell: str) -> str:
    try:
        return f"{float(cell):.{DIGITS}g}" if "." in cell or "e" in cell else cell
    except ValueError:
        return cell


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    for file in parser.parse_args().files:
        saved = read_policy(file)
        content = halved(saved.content)
        change = largest_change(saved.module("cpu"), replace(saved, content=content).module("cpu"))
        if change > MOST_CHANGE:
            raise SystemExit(f"{file}: an action would change by {change:.2g}")
        atomic_write(file, content)
        print(f"{file}: {change:.1g}, {len(saved.content) / 1024:,.0f} to {len(content) / 1024:,.0f} KiB")


if __name__ == "__main__":
    main()
