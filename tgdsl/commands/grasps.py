"""`tgdsl grasps`: the grasps that episodes of a task begin from, sampled beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from tgdsl.commands.arguments import OUT, Document, Overrides, parsed_overrides
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError


@dataclass(frozen=True)
class Grasps:
    """Sample the grasps that episodes of a task begin from; the task finds them in the user's cache, or in a file."""

    document: Annotated[Document, tyro.conf.arg(help="The task's YAML document.")]
    num: int | None = None
    """How many, as many of each variant of the object; default: as the document says."""
    seed: int | None = None
    """Seed of everything random; default: as the document says."""
    out: Annotated[Path | None, OUT] = None
    """A file to write them to, for `grasps: {file: …}` of the document; default: the user's cache alone."""
    set: Overrides = ()

    def run(self) -> None:
        """Sample, unless they are there, and say where they are."""
        from tqdm import tqdm

        from tgdsl.files.cache import folder
        from tgdsl.files.write import check_writable
        from tgdsl.rl.grasps.grasps import grasp_spec, write_grasps
        from tgdsl.rl.grasps.sampling import cached_grasps
        from tgdsl.rl.load import load_task
        from tgdsl.rl.sensed import compile_sensed
        from tgdsl.rl.start import moved_joints

        if self.out is not None:
            check_writable(self.out)
        options = {"grasps.num": self.num, "grasps.seed": self.seed}
        overrides = parsed_overrides(self.set) | {name: value for name, value in options.items() if value is not None}
        loaded = load_task(self.document, overrides)
        spec = grasp_spec(loaded.spec)
        if spec is None:
            raise TgdslError(f"{self.document}: episodes of the task {loaded.spec.task} do not begin with grasps")
        with StatusLine() as progress:
            sensed = compile_sensed(loaded, "cpu", progress, only=("link_contact",))
        joints, scene = moved_joints(loaded, sensed), sensed.touch.plan.scene
        with tqdm(total=spec.num, desc="sampling", unit="grasp", disable=None, leave=False) as bar:

            def count(num: int, _: int) -> None:
                bar.update(num - bar.n)

            grasps = cached_grasps(loaded, scene, joints, count)
        variants = len(set(grasps.variant.tolist()))
        print(f"{len(grasps)} grasps of {variants} variant{'s' if variants > 1 else ''} of {grasps.object}: {folder()}")
        if self.out is not None:
            write_grasps(grasps, self.out)
            print(f"file: {self.out}")
        elif options != dict.fromkeys(options):
            print("the task finds these where its document, or --set, has the same `grasps: {num, seed}`")
