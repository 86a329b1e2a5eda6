"""Which engine computes the likelihood given impedance, and why."""

from __future__ import annotations

from dataclasses import dataclass

from bayes_impedance.config import EngineConfig
from bayes_impedance.engines import lowrank, markov
from bayes_impedance.engines.dense import check_capacity
from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import ConditionalEngine, Processes
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import Features

#: Forces up to which dense is taken unasked: finding functions takes hundreds of evaluations, of a second each there.
FEW = 1500
MOMENTS = "stiffness, damping and mass are integrated out, which only dense covariances do"
LOCAL = "asked for by engine.name; training is dense, posteriors come from local sparse models of the same covariance"


@dataclass(frozen=True)
class EngineChoice:
    """An engine by `name`, and the `reason` for it, a sentence without its full stop.

    Example:
        >>> print(EngineChoice("dense", "asked for by engine.name"))
        engine dense: asked for by engine.name
    """

    name: str
    reason: str

    def __str__(self) -> str:
        """Both, for people."""
        return f"engine {self.name}: {self.reason}"


def choose_engine(
    config: EngineConfig, processes: Processes, features: Features, coupled: bool, few: int = FEW
) -> EngineChoice:
    """The engine asked for, or the cheapest that is exact and holds the processes: Markov, then dense, then low-rank.

    Dense goes before low-rank up to `few` forces, and beyond only where features cannot hold the processes.

    Raises:
        ConfigurationError: the engine asked for cannot hold them, or none can.
        TooManySamplesError: dense is asked for, and the samples are too many.
    """
    if config.name == "dense":
        _check_dense(config, processes, features, coupled)
    if config.name in ("markov", "lowrank"):
        refusal = _refusal(config.name, processes, features, coupled)
        if refusal is not None:
            raise ConfigurationError(
                f"engine.name: expected an engine that holds this model, got {config.name}: {refusal}"
            )
    if config.name != "auto":
        return EngineChoice(config.name, "asked for by engine.name")
    not_markov = _refusal("markov", processes, features, coupled)
    if not_markov is None:
        return EngineChoice("markov", "exact, at a cost that grows with the number of samples")
    size = _largest(features, coupled)
    dense_serves = size <= min(config.max_samples, FEW) and not processes.periodic
    few_forces = EngineChoice(
        "dense", f"exact for any process, and {size} forces are few; not markov: {not_markov}"
    )
    if dense_serves and size <= few:
        return few_forces
    not_lowrank = _refusal("lowrank", processes, features, coupled)
    if not_lowrank is None:
        return EngineChoice("lowrank", f"features stand for the processes; not markov: {not_markov}")
    if dense_serves:
        return few_forces
    most = f"engine.max_samples = {config.max_samples}" if config.max_samples <= FEW else str(FEW)
    raise ConfigurationError(
        f"engine.name: expected processes that one of the engines holds, found {size} forces in a group, with dense "
        f"for at most {most} and no periodic phase; not markov: {not_markov}; not lowrank: {not_lowrank}; mend one of "
        "these, thin the log with preprocessing.rate, or set engine.name=dense and wait"
    )


def build_engine(
    name: str, config: EngineConfig, processes: Processes, features: Features, coupled: bool
) -> ConditionalEngine:
    """The engine of that name for the samples of `features`.

    Raises:
        ConfigurationError: it cannot hold the processes.
        TooManySamplesError: it is dense, and the samples are too many.
    """
    if name == "markov":
        return markov.MarkovEngine(features, processes, coupled)
    if name == "lowrank":
        return lowrank.LowRankEngine(features, coupled)
    _check_dense(config, processes, features, coupled)
    return DenseGivenImpedance(features, coupled, config.jitter)


def _refusal(name: str, processes: Processes, features: Features, coupled: bool) -> str | None:
    """Why that engine cannot hold the processes, without the key that chooses it; None where it can."""
    unsupported = markov.unsupported if name == "markov" else lowrank.unsupported
    reason = unsupported(processes, features, coupled)
    return None if reason is None else reason.removeprefix("engine.name: ")


def _check_dense(config: EngineConfig, processes: Processes, features: Features, coupled: bool) -> None:
    if processes.periodic:
        raise ConfigurationError(
            "engine.name: expected lowrank with model.desired_trajectory.periodic, which joins the ends of the phase "
            "by Fourier features, got dense; set engine.name=lowrank"
        )
    size = _largest(features, coupled)
    check_capacity(size, config.max_samples, "impedance: map")


def _largest(features: Features, coupled: bool) -> int:
    """Forces of the largest covariance."""
    n: int = features.inputs.shape[-2]
    return n * features.inputs.shape[0] if coupled else n
