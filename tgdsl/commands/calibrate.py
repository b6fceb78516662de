"""`tgdsl calibrate`: parameters of sensors, or what a real hand's counts mean, from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from tgdsl.commands import arguments as args
from tgdsl.console.progress import StatusLine
from tgdsl.errors import TgdslError
from tgdsl.files.write import atomic_write, with_folder

if TYPE_CHECKING:
    import numpy as np

    from tgdsl.calibration.hand.loads import Load, Samples, TipRecord

Finger = Literal["thumb", "index", "middle", "ring", "pinky"]
OptionalFinger = Annotated[Finger | None, args.optional("{thumb,index,middle,ring,pinky}")]
Intervals = Annotated[
    tuple[tuple[float, float, float, float, float], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(metavar="START END FX FY FZ"),
]


@dataclass(frozen=True)
class CalibrateSensor:
    """Fit parameters of a document's sensors to recordings. docs/how-to/calibrate.md has the format of recordings."""

    document: tyro.conf.Positional[args.File]
    """The document; the search starts from its values."""
    recordings: Annotated[tyro.conf.Positional[tuple[Path, ...]], args.optional("RECORDING")]
    """The recordings, at least one: .npz files, YAML documents of CSV files, or logs of an XHand1 that pressed fixtures."""
    fit: Annotated[tuple[str, ...], args.optional("[SENSOR.FIELD[=RANGE] ...]")] = ()
    """Parameters to fit; a range limits the search: skin.thickness="1 mm:9 mm". Default: none, only the error is measured."""
    compare: args.OptionalFile = None
    """A YAML file with `compare:`, a list of models to fit in turn and compare in one table; default: one model."""
    reading: Literal["none", "offset", "scale", "affine"] = "none"
    """Unknowns of each recording's frame: an offset, a scale as well, or an affine map of the rows' positions."""
    gain: bool = False
    """Fit one gain per recording."""
    robust: bool = False
    """Give outliers, such as lost markers, less weight."""
    hold_out: Literal["none", "taxel", "blocks", "time", "recording"] = "none"
    """Parts that are held out in turn, to measure the error on unseen data."""
    folds: int = 6
    """Number of held-out parts."""
    starts: int = 8
    """Number of starting points of the search."""
    intervals: Literal["profile", "bootstrap", "none"] = "profile"
    """Method of the 95 % intervals; none computes them from derivatives only."""
    seed: int = 0
    """Seed of starting points, folds and the bootstrap."""
    set: args.Overrides = ()
    out: args.OptionalOut = None
    """The document to write, with the fitted values; it must be in the document's folder. Default: no file."""
    plot: args.OptionalFile = None
    """The picture to write: targets, fits and residuals; default: no file."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.calibration.fit import calibrate, compare

        names = ("reading", "gain", "robust", "hold_out", "folds", "starts", "intervals", "seed")
        options: dict[str, Any] = {name: getattr(self, name) for name in names} | {"overrides": args.parsed_overrides(self.set)}
        if self.compare is not None:
            if self.fit or self.out is not None or self.plot is not None:
                raise TgdslError("--compare prints a table of several models, expected no --fit, --out or --plot")
            with StatusLine() as progress:
                table = compare(self.document, list(self.recordings), self.compare, progress=progress, **options)
            print(table)
            return
        for file in (self.out, self.plot):
            if file is not None:
                args.refuse_to_replace(file, self.force)
        with StatusLine() as progress:
            fit = calibrate(self.document, list(self.recordings), self.fit, progress=progress, **options)
        print(fit)
        if self.out is not None:
            print(f"document: {fit.document(self.out)}")
        if self.plot is not None:
            print(f"picture:  {fit.plot(self.plot)}")


@dataclass(frozen=True)
class CalibrateHand:
    """Fit scale, rotation and tare of fingertips to a log under known loads, or to a simulation of the same motion."""

    log: Annotated[Path, tyro.conf.arg(metavar="LOG.npz")]
    """The log of `tgdsl hand record`."""
    loads: args.OptionalFile = None
    """Known loads: a YAML file of times [s] and forces [N]; default: --load or --simulation."""
    finger: OptionalFinger = None
    """The finger of --load; required with it."""
    load: Intervals = ()
    """A known load: start and end after the log's first reading [s], and the force on the fingertip in its link's frame [N].
    One of the loads must be 0 0 0."""
    simulation: args.OptionalFile = None
    """Simulated forces instead of loads: readings.npz of `tgdsl run`, with --document and --reading, or an .npz file with
    `time` [s] and `tip_force` (step, finger, 3) [N]."""
    document: args.OptionalFile = None
    """The document or artefact of --simulation; required with readings.npz."""
    reading: Annotated[str, tyro.conf.arg(metavar="NAME")] = "touch"
    """The reading of --document with the forces or depths."""
    depth_scale: float = 1e4
    """Force per summed depth, as in the observation `agg_force` [N/m]."""
    max_offset: float = 2.0
    """Largest offset between the clocks of simulation and log, in either direction [s]."""
    axes: Literal["rotation", "signs"] = "rotation"
    """Orientation of the sensor's axes: any rotation, or parallel to the link's axes with unknown signs."""
    keep_tare: bool = False
    """Keep the tare of --calibration instead of fitting it; no load of 0 0 0 is needed then."""
    ignore_taxels: Annotated[tuple[int, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """Indices of taxels that are always saturated, and are ignored; default: none."""
    calibration: args.OptionalFile = None
    """The calibration file to start from; default: the log's."""
    others: OptionalFinger = None
    """Use the scale and rotation of this finger for fingers without loads; default: theirs in --calibration."""
    out: args.Out = Path("hand.calibration.yaml")
    """The calibration file to write."""
    plot: args.File = Path("hand.calibration.png")
    """The picture to write: fitted forces over known forces."""
    force: args.Replace = False

    def run(self) -> None:
        from tgdsl.calibration.hand.fit import FitError, fit_finger
        from tgdsl.calibration.hand.loads import TipRecord
        from tgdsl.calibration.hand.report import calibrated, fit_text, picture, report
        from tgdsl.runtime.xhand1.calibration import Calibration
        from tgdsl.runtime.xhand1.log.log import open_log
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        for file in (self.out, self.plot):
            args.refuse_to_replace(file, self.force)
        log = open_log(self.log)
        base = args.calibration_of(self.calibration) or log.calibration or Calibration.none()
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
        origin = f"scale and rotation as for {self.others}" if self.others else "as in the calibration before"
        notes += [f"# {name}: not loaded; {origin}\n" for name in FINGERS if name not in fits]
        atomic_write(with_folder(self.out), ("".join(notes) + result.text()).encode())
        print(f"calibration: {self.out}")
        print(f"picture:     {picture(fits, self.plot, f'{self.log.name}: fingertip forces')}")

    def _samples(self, record: TipRecord) -> dict[str, Samples]:
        """Return the samples to fit to, by finger."""
        from tgdsl.calibration.hand.loads import load_loads, samples_under_loads

        if sum([self.loads is not None, bool(self.load), self.simulation is not None]) != 1:
            raise TgdslError("expected the known forces as one of --loads FILE, --finger with --load, or --simulation FILE")
        if self.simulation is not None:
            return self._simulated_samples(record, self.simulation)
        loads = load_loads(self.loads) if self.loads is not None else self._loads()
        return {finger: samples_under_loads(record, finger, loads) for finger in dict.fromkeys(load.finger for load in loads)}

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
        from tgdsl.calibration.hand.loads import known_tip_forces, samples_under_forces, simulated_tip_forces
        from tgdsl.runtime.xhand1.wire.protocol import FINGERS

        forces: dict[str, np.ndarray]
        if self.document is None:
            time, forces = known_tip_forces(path)
        else:
            time, forces = simulated_tip_forces(path, args.module_of(self.document), self.reading, depth_scale=self.depth_scale)
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


@dataclass(frozen=True)
class Calibrate:
    """Fit sensor parameters, or a real hand's calibration, to recordings."""

    action: Annotated[args.subcommands(sensor=CalibrateSensor, hand=CalibrateHand), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    """What to calibrate."""

    def run(self) -> None:
        self.action.run()
