"""`tgdsl calibrate hand`: what a real hand's counts mean, from a log under known forces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tgdsl.commands.arguments import FILE, OUT, OptionalFile, module_of, refuse_to_replace
from tgdsl.errors import TgdslError

if TYPE_CHECKING:
    import numpy as np

    from tgdsl.calibration.hand.loads import Load, Samples, TipRecord

Finger = Literal["thumb", "index", "middle", "ring", "pinky"]
Intervals = Annotated[
    tuple[tuple[float, float, float, float, float], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(metavar="START END FX FY FZ"),
]


@dataclass(frozen=True)
class CalibrateHand:
    """Fit scale, rotation and tare of fingertips to a log under known loads, or to a simulation of the same motion."""

    log: Annotated[Path, tyro.conf.arg(metavar="LOG.npz")]
    """A log of `tgdsl hand record`."""
    loads: OptionalFile = None
    """Known loads: a YAML file of intervals and forces."""
    finger: Finger | None = None
    """The finger that --load is about."""
    load: Intervals = ()
    """A known load instead: from when to when after the log's first reading [s], and the force on the fingertip along its
    link's axes [N]; to be repeated for each, one of them 0 0 0."""
    simulation: OptionalFile = None
    """Forces over time instead: readings.npz of `tgdsl run` (then with --document and --reading), or any .npz with `time` and
    `tip_force` (step, finger, 3) [N]."""
    document: OptionalFile = None
    """The document, or artefact, that was run."""
    reading: str = "touch"
    """Its reading whose forces (or depths) count."""
    depth_scale: float = 1e4
    """What makes a force of summed depths, as in the observation `agg_force` [N/m]."""
    max_offset: float = 2.0
    """How far the simulation's clock may be from the log's, either way [s]."""
    axes: Literal["rotation", "signs"] = "rotation"
    """Whether the sensor's axes may be turned in any way, or are parallel to the link's but for their signs."""
    keep_tare: bool = False
    """Keep the calibration's tare instead of fitting it; then no load of 0 0 0 is needed."""
    ignore_taxels: tuple[int, ...] = ()
    """Numbers of taxels that do not count as saturated, because they always are."""
    calibration: OptionalFile = None
    """The calibration to start from; default: the log's."""
    others: Finger | None = None
    """Give fingers that no load was on the scale and rotation of this one."""
    out: Annotated[Path, OUT] = Path("hand.calibration.yaml")
    """The calibration file to write."""
    plot: Annotated[Path, FILE] = Path("hand.calibration.png")
    """The picture to write: fitted over known forces."""
    force: bool = False
    """Replace the files if they are there."""

    def run(self) -> None:
        """Fit, report, and write the files."""
        from tgdsl.calibration.hand.fit import FitError, fit_finger
        from tgdsl.calibration.hand.loads import TipRecord
        from tgdsl.calibration.hand.report import calibrated, fit_text, picture, report
        from tgdsl.files.write import atomic_write, with_folder
        from tgdsl.runtime.xhand1.calibration import Calibration, load_calibration
        from tgdsl.runtime.xhand1.log.log import open_log
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        for file in (self.out, self.plot):
            refuse_to_replace(file, self.force)
        log = open_log(self.log)
        base = load_calibration(self.calibration) if self.calibration else log.calibration or Calibration.none()
        samples = self._samples(TipRecord.of(log, self.ignore_taxels))
        fits = {}
        for name, finger_samples in samples.items():
            tare = base.tare[FINGERS.index(name)] if self.keep_tare else None
            try:
                fits[name] = fit_finger(finger_samples.counts, finger_samples.force, axes=self.axes, tare=tare)
            except FitError as error:
                raise FitError(f"{name}: {error}") from error
        result = calibrated(base, fits, self.others)
        print("\n".join(report(fits, samples)))
        notes = [f"# {name}: fitted to {self.log.name}; {fit_text(fit)}\n" for name, fit in fits.items()]
        origin = f"scale and rotation are those of {self.others}" if self.others else "as in the calibration before"
        notes += [f"# {name}: not loaded; {origin}\n" for name in FINGERS if name not in fits]
        atomic_write(with_folder(self.out), ("".join(notes) + result.text()).encode())
        print(f"calibration: {self.out}")
        print(f"picture:     {picture(fits, with_folder(self.plot), f'{self.log.name}: fingertip forces')}")

    def _samples(self, record: TipRecord) -> dict[str, Samples]:
        """Return the samples to fit to, by finger."""
        from tgdsl.calibration.hand.loads import load_loads, samples_under_loads

        sources = [self.loads is not None, bool(self.load), self.simulation is not None]
        if sum(sources) != 1:
            raise TgdslError("expected the known forces as one of --loads FILE, --finger with --load, or --simulation FILE")
        if self.simulation is not None:
            return self._simulated_samples(record, self.simulation)
        loads = load_loads(self.loads) if self.loads is not None else self._loads()
        fingers = dict.fromkeys(load.finger for load in loads)
        return {finger: samples_under_loads(record, finger, loads) for finger in fingers}

    def _loads(self) -> tuple[Load, ...]:
        from pydantic import ValidationError

        from tgdsl.calibration.hand.loads import Load

        if self.finger is None:
            raise TgdslError("--load: expected --finger to say which finger it is on")
        loads = []
        for start, end, *force in self.load:
            try:
                loads.append(Load(finger=self.finger, start=start, end=end, force=(force[0], force[1], force[2])))
            except ValidationError as error:
                why = error.errors()[0]["msg"].removeprefix("Value error, ")
                raise TgdslError(f"--load {start:g} {end:g} {' '.join(f'{value:g}' for value in force)}: {why}") from error
        return tuple(loads)

    def _simulated_samples(self, record: TipRecord, path: Path) -> dict[str, Samples]:
        import numpy as np

        from tgdsl.calibration.hand.fit import time_offset
        from tgdsl.calibration.hand.loads import samples_under_forces
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        time, forces = self._known_forces(path)
        loaded = [name for name in forces if np.ptp(forces[name], axis=0).any()]
        if not loaded:
            raise TgdslError(f"{path}: no fingertip is ever loaded")
        columns = [FINGERS.index(name) for name in loaded]
        is_within = ~record.is_saturated[:, columns].any(axis=1)
        counts = record.counts[is_within][:, columns].reshape(int(is_within.sum()), -1)
        known_forces = np.concatenate([forces[name] for name in loaded], axis=1)
        offset = time_offset(record.time[is_within], counts, time, known_forces, self.max_offset)
        print(f"the log's clock is {offset:.4f} s ahead of the simulation's; fingertips with loads: {', '.join(loaded)}")
        return {name: samples_under_forces(record, name, time + offset, forces[name]) for name in loaded}

    def _known_forces(self, path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        from tgdsl.calibration.hand.loads import known_tip_forces, simulated_tip_forces

        if self.document is None:
            return known_tip_forces(path)
        return simulated_tip_forces(path, module_of(self.document), self.reading, depth_scale=self.depth_scale)
