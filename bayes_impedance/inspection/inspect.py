"""A recording looked at from all sides: contents, clocks, what looks wrong, the robot, smoothing, trials."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

from bayes_impedance.config import ClockConfig, Config, Smoother
from bayes_impedance.errors import BayesImpedanceError, BayesImpedanceWarning, LogError
from bayes_impedance.inspection.findings import gathered, look_at, middle, of_clock
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.preprocessing import PreparedLog, prepare
from bayes_impedance.preprocessing.bandwidth import SmootherEffect, smoother_effect
from bayes_impedance.readers.force import Preparation
from bayes_impedance.readers.read import as_log, open_files, read_tables
from bayes_impedance.readers.table import Opened, Table
from bayes_impedance.readers.trials import Reading
from bayes_impedance.recording.clock import ClockReport, choose_clock
from bayes_impedance.recording.device_law import DeviceLaw, fit_device_law
from bayes_impedance.recording.lag import LagEstimate, estimate_lag
from bayes_impedance.recording.quality import Finding

#: Windows that are compared, as multiples of the one that is configured.
WINDOWS = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Inspection:
    """What is in some recordings. Later parts are None where `refusal` says why they cannot be had.

    `tables`: what each file holds; `preparations`: tool and lag that reading found, by file; `log` and `prepared`: what
    the model would see; `findings`: what looks wrong; `repairs`: what reading mended on its own; `clocks` by trial or
    topic; `smoothing`: the window that is configured beside others; `law`: the robot's virtual mass and damping; `lag`
    of force behind motion.
    """

    config: Config
    tables: tuple[Table, ...]
    preparations: Mapping[str, Preparation] = field(default_factory=dict)
    log: InteractionLog | None = None
    prepared: PreparedLog | None = None
    findings: tuple[Finding, ...] = ()
    repairs: tuple[str, ...] = ()
    clocks: Mapping[str, ClockReport] = field(default_factory=dict)
    smoothing: tuple[SmootherEffect, ...] = ()
    law: DeviceLaw | None = None
    lag: LagEstimate | None = None
    refusal: BayesImpedanceError | None = None


def inspect_recordings(files: Sequence[Path], config: Config) -> Inspection:
    """Everything that can be said of some files under a configuration.

    What keeps them from being read ends up in `refusal`; what keeps them from being opened is raised.

    Raises:
        LogError: a file is missing, or of no known format.
    """
    repairs: list[str] = []
    with _heard(repairs):
        opened = list(open_files(files, config.log))
        result = Inspection(config, tuple(table for file in opened for table in file.tables))
        try:
            result, log = _as_read(result, opened)
        except BayesImpedanceError as error:
            return replace(result, refusal=error, repairs=tuple(repairs))
    law, lag = _answers(log)
    result = replace(result, log=log, law=law, lag=lag)
    with _heard(repairs):
        try:
            result = replace(result, prepared=prepare(log, config.preprocessing))
        except BayesImpedanceError as error:
            result = replace(result, refusal=error)
    # Of other windows nobody asked: what is said of them is not to be heard.
    with _heard([]):
        result = replace(result, smoothing=_smoothing(log, config.preprocessing.smoother))
    return replace(result, repairs=tuple(dict.fromkeys(repairs)))


def _as_read(result: Inspection, opened: Sequence[Opened]) -> tuple[Inspection, InteractionLog]:
    """What samples as they were read tell, and the log; afterwards the samples can go: an hour of them is much."""
    readings = [reading for file in opened for reading in read_tables(file, require_force=False)]
    clocks = _clocks(readings)
    found = [finding for name, clock in clocks.items() for finding in of_clock(name, clock)]
    found += gathered([(reading.source, look_at(reading)) for reading in readings])
    known = {reading.source: reading.preparation for reading in readings}
    result = replace(result, findings=tuple(found), clocks=clocks, preparations=known)
    return result, as_log(readings)


@contextmanager
def _heard(repairs: list[str]) -> Iterator[None]:
    """Our warnings as sentences in place of warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", BayesImpedanceWarning)
        try:
            yield
        finally:
            for warning in caught:
                if issubclass(warning.category, BayesImpedanceWarning):
                    repairs.append(str(warning.message))
    for warning in caught:
        if not issubclass(warning.category, BayesImpedanceWarning):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)


def _clocks(readings: Sequence[Reading]) -> dict[str, ClockReport]:
    """The time stamps of each topic, or of each trial where the log has one column of time."""
    clocks: dict[str, ClockReport] = {}
    for reading in readings:
        clocks |= {f"{reading.source}, {name}": clock for name, clock in reading.sensed.clocks.items()}
        if not reading.sensed.clocks:
            labels = reading.sensed.labels.get("trial")
            for trial in reading.trials:
                where = f"{reading.source}, trial {trial.name}"
                # As logged: samples with equal stamps are no longer in the trial.
                own = slice(None) if labels is None else labels == trial.name
                try:
                    clock = choose_clock(
                        reading.sensed.time[own], None, ClockConfig(duplicates="drop"), where
                    )
                except LogError:
                    # Time that goes back is refused where the trial is checked.
                    continue
                clocks[where] = clock.report
    return clocks


def _answers(log: InteractionLog) -> tuple[DeviceLaw | None, LagEstimate | None]:
    """How motion and force of the longest trial belong together: the robot's law, and the lag of force."""
    trial = max((trial for trial in log.trials if trial.force is not None), key=_length, default=None)
    if trial is None:
        return None, None
    trial = _middle(trial)
    assert trial.force is not None
    lag = estimate_lag(trial.time, trial.position, trial.force, perturbation=trial.perturbation)
    try:
        law = fit_device_law(
            trial.time, trial.velocity, trial.force, trial.perturbation, position=trial.position
        )
    except LogError:
        # Too short to tell.
        return None, lag
    return law, lag


def _length(trial: Trial) -> int:
    return trial.n_samples


def _middle(trial: Trial) -> Trial:
    part = middle(trial.n_samples)
    cut = {
        name: value[part]
        for name in ("time", "position", "velocity", "force", "perturbation", "repetition")
        if (value := getattr(trial, name)) is not None
    }
    return replace(trial, **cut, acceleration=None, reference=None, phase=None, truth={}, rows=None)


def _smoothing(log: InteractionLog, smoother: Smoother | None) -> tuple[SmootherEffect, ...]:
    """The configured window and others, on the longest trial."""
    if smoother is None:
        return ()
    trial = _middle(max(log.trials, key=_length))
    effects = []
    for factor in WINDOWS:
        try:
            effects.append(
                smoother_effect(trial, smoother.model_copy(update={"window": factor * smoother.window}))
            )
        except LogError:
            # Longer than the trial.
            continue
    # Short windows end up as the shortest that the order allows.
    return tuple({round(effect.window, 9): effect for effect in effects}.values())
