"""`tgdsl export`: a document to a program that runs without tgdsl."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tgdsl.commands.arguments import OUT, DocumentOrArtefact, Overrides, in_working_folder, module_of
from tgdsl.console.progress import StatusLine


@dataclass(frozen=True)
class Export:
    """Write a document's or an artefact's sensors and observations as a program that runs without tgdsl."""

    document: DocumentOrArtefact
    to: Literal["pt2", "aoti", "onnx"] = "pt2"
    """pt2: torch.export, for Python with torch; aoti: AOTInductor, for C++ and Python with torch; onnx: ONNX Runtime."""
    out: Annotated[Path | None, OUT] = None
    """The file; default: the document's name with the ending .pt2, .aoti.pt2 or .onnx, in the working folder."""
    dt: float | None = None
    """Time between steps [s]; default: what the document says."""
    state_dtype: Literal["float32", "float64"] = "float32"
    """Dtype of the state's floats."""
    set: Overrides = ()

    def run(self) -> None:
        """Write the file, and print what goes in and comes out."""
        from tgdsl.files.write import check_writable, with_folder
        from tgdsl.module.export.program import ENDINGS, format_of

        out = check_writable(self.out or in_working_folder(self.document, ENDINGS[self.to]))
        format_of(out, self.to)
        with StatusLine() as progress:
            touch = module_of(self.document, self.set, progress)
            progress(f"exporting to {self.to}")
            source = {"source": str(self.document.absolute()), "overrides": self.set}
            signature = touch.export(with_folder(out), self.to, dt=self.dt, state_dtype=self.state_dtype, **source)
        for way, ports in (("in", signature.inputs), ("out", signature.outputs)):
            for i, port in enumerate(ports):
                print(f"{way:<4}{i:>3}  {port.name:<34}{port.dtype:<9}(env{''.join(f', {n}' for n in port.shape)})")
        print(f"{out}: {out.stat().st_size} bytes; compare it with the module by `tgdsl verify {out}`")
