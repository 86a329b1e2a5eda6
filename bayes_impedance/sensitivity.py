"""Prior sensitivity: which conclusions move when one prior is made otherwise (docs/model.md §8)?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bayes_impedance.config import Config, Hyperparameter, replace_value
from bayes_impedance.config.model import LARGEST_LOG_SD
from bayes_impedance.config.sections import LARGEST_HYPERPRIOR_LOG_SD
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Posterior
from bayes_impedance.posterior.results import UNITS, Array
from bayes_impedance.priors import Entry

#: Every prior is made this much wider, narrower, higher and lower: ± log 2.
FACTOR = 2.0
#: A conclusion moves when it shifts by more posterior SDs than this: of what the new posterior says, the old 90 %
#: interval then holds less than 86 %.
MOVED = 0.5
#: The variance of a posterior is a difference: below this share of the prior's SD its SD is rounding.
ROUNDING = 1e-7

LATENTS = (*IMPEDANCE_ORDER, Latent.DESIRED_POSITION)

#: Called as progress(changes done, changes in all, the change that comes).
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Change:
    """One prior made otherwise: `quantity` of what stands at `key` in the configuration, in `unit`.

    A learned hyperparameter has a `median` and a `log_sd`, a fixed one a `value`; `spec` is what then stands there.
    """

    key: str
    quantity: Literal["median", "log_sd", "value"]
    before: float
    after: float
    unit: str
    spec: Hyperparameter

    @property
    def description(self) -> str:
        """The quantity from before to after: "median 300 → 600 N/m"."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.quantity} {self.before:.4g} → {self.after:.4g}{unit}"

    @property
    def label(self) -> str:
        """What is multiplied or divided by how much: "model.noise_sd.median × 2"."""
        name = self.key if self.quantity == "value" else f"{self.key}.{self.quantity}"
        ratio = self.after / self.before
        return f"{name} × {ratio:.3g}" if ratio > 1 else f"{name} ÷ {1 / ratio:.3g}"


@dataclass(frozen=True)
class Effect:
    """What a refit did to one conclusion.

    `before`, `after`: posterior median averaged over the samples; `difference`: after − before, of the desired
    position root mean square over the samples, all in the unit of the latent. `shift` [1] is the same difference of
    the Gaussian variable (the logarithm where warped) in posterior SDs. There is no verdict on the desired position.
    """

    latent: Latent
    axis: str
    before: float
    after: float
    difference: float
    shift: float
    support: Support | None = None
    support_after: Support | None = None

    @property
    def name(self) -> str:
        """Name of the conclusion: "stiffness xx", "desired position x"."""
        axes = self.axis * (2 if self.latent in IMPEDANCE_ORDER else 1)
        return f"{self.latent.value.replace('_', ' ')} {axes}"

    @property
    def unit(self) -> str:
        """SI unit of the conclusion."""
        return UNITS[self.latent]

    @property
    def reversed(self) -> bool:
        """Whether the verdict is another one."""
        return self.support is not self.support_after

    @property
    def moved(self) -> bool:
        """Whether the conclusion is another one."""
        return self.shift > MOVED or self.reversed


@dataclass(frozen=True)
class Refit:
    """One change and what followed: effects and the change of log p(u) by axis [nats], or why there are none.

    Coupled axes have one log p(u). Effects are on diagonals.
    """

    change: Change
    effects: tuple[Effect, ...]
    log_likelihood_change: dict[str, float]
    converged: bool
    failure: str | None = None


@dataclass(frozen=True)
class Sensitivity:
    """How conclusions depend on priors: one refit a change, against a refit under the priors as they are.

    `drift` is what that refit did to the conclusions of the model itself: nothing, where training had converged.
    """

    refits: tuple[Refit, ...]
    drift: tuple[Effect, ...]

    @property
    def sentences(self) -> list[str]:
        """One for each conclusion: what it rests on, or that it is robust."""
        found: dict[str, list[tuple[Change, Effect]]] = {}
        for refit in self.refits:
            for effect in refit.effects:
                found.setdefault(effect.name, []).append((refit.change, effect))
        return [f"{name}: {_finding(pairs, len(self.refits))}." for name, pairs in found.items()]

    @property
    def remarks(self) -> list[str]:
        """What limits the comparison, where something does."""
        said = []
        restless = [f"{effect.name} ({in_sds(effect.shift)})" for effect in self.drift if effect.moved]
        if restless:
            said.append(
                f"Training had not converged: more of it, under the same priors, moves {', '.join(restless)}; train "
                "again with a larger training.max_iterations."
            )
        unfinished = sum(refit.failure is None and not refit.converged for refit in self.refits)
        if unfinished:
            said.append(
                f"{unfinished} of {len(self.refits)} refits had not converged, so what they moved may be less or more: "
                "train with a larger training.max_iterations."
            )
        return said

    def as_json(self) -> dict[str, Any]:
        """Plain mappings of finite numbers and text: every change with its effects, and the sentences."""
        return {
            "factor": FACTOR,
            "moved_beyond_sd": MOVED,
            "changes": [_refit_json(refit) for refit in self.refits],
            "drift": _effects_json(self.drift),
            "sentences": self.sentences,
            "remarks": self.remarks,
        }


def prior_sensitivity(model: ImpedanceModel, progress: Progress | None = None) -> Sensitivity:
    """Refit a fitted model under every change of one prior, and compare what it concludes at its training samples.

    Changes are those of `changes`; of log h ~ N(log median, log_sd²), log_sd × 2 and ÷ 2 are p(h)^α with α = ¼ and 4.
    Refits start at the model's optimum, with its training settings and no restarts. Ctrl-C ends it.

    Raises:
        ConfigurationError: the model is not fitted, or impedance is a function.
        NotPositiveDefiniteError: the model does not refit under its own priors.
    Source: power-scaling of priors, Kallioinen, Paananen, Bürkner, Vehtari (Statistics and Computing 34:57, 2024).
    """
    planned = changes(model.hyperparameters)
    if model.config.engine.impedance == "map":
        raise ConfigurationError(
            "expected engine.impedance: moments for prior sensitivity, whose refits start at the hyperparameters that "
            "were found, got map; train with engine.impedance=moments, or train again with one prior changed by --set"
        )
    base = _conclude(_refit(model, model.config))
    refits = []
    for done, change in enumerate(planned):
        if progress is not None:
            progress(done, len(planned), change.label)
        refits.append(_compare(base, change))
    return Sensitivity(tuple(refits), _effects(_conclude(model), base))


def in_sds(shift: float) -> str:
    """A shift as text: "1.3 SD"."""
    return f"{shift:.2g} SD" if shift >= 0.01 else "< 0.01 SD"


def changes(entries: Sequence[Entry]) -> list[Change]:
    """Every change of every prior: of a learned hyperparameter median and log_sd, of a fixed one its value.

    Components that share a key of the configuration (ARD length scales) change together. What the configuration
    limits goes as far as its limit.
    """
    specs: dict[str, tuple[Hyperparameter, str]] = {}
    for entry in entries:
        for label, spec, unit in zip(entry.labels, entry.specs, entry.units, strict=True):
            # Length scales are configured by kind of input: position, not position_x.
            kind = f".{label.partition('_')[0]}" if label else ""
            specs[f"model.{entry.name}{kind}"] = (spec, unit)
    return [change for key, (spec, unit) in specs.items() for change in _changes_of(key, spec, unit)]


def _changes_of(key: str, spec: Hyperparameter, unit: str) -> list[Change]:
    largest = LARGEST_LOG_SD if key.endswith(".log_sd") else np.inf
    listed: list[Change] = []
    for factor in (FACTOR, 1.0 / FACTOR):
        median = min(factor * spec.median, largest)
        if median != spec.median:
            changed = spec.model_copy(update={"median": median})
            quantity: Literal["value", "median"] = "value" if spec.fixed else "median"
            listed.append(Change(key, quantity, spec.median, median, unit, changed))
    for factor in () if spec.fixed else (FACTOR, 1.0 / FACTOR):
        log_sd = min(factor * spec.log_sd, LARGEST_HYPERPRIOR_LOG_SD)
        if log_sd != spec.log_sd:
            changed = spec.model_copy(update={"log_sd": log_sd})
            listed.append(Change(key, "log_sd", spec.log_sd, log_sd, "1", changed))
    return listed


@dataclass(frozen=True)
class _Conclusions:
    """What a model concludes at its training samples."""

    model: ImpedanceModel
    posterior: Posterior
    supports: dict[tuple[Latent, str], Support]


def _refit(model: ImpedanceModel, config: Config) -> ImpedanceModel:
    """The model under another configuration, trained from where it stands."""
    once = config.model_copy(update={"training": config.training.model_copy(update={"restarts": 1})})
    refitted = ImpedanceModel(once).fit(model.fitted.log, start=model)
    if refitted.report.interrupted:
        raise KeyboardInterrupt
    return refitted


def _conclude(model: ImpedanceModel) -> _Conclusions:
    posterior = model.posterior(model.fitted.log, latents=LATENTS)
    supports = {(verdict.latent, verdict.axis): verdict.support for verdict in model.verdicts(posterior)}
    return _Conclusions(model, posterior, supports)


def _compare(base: _Conclusions, change: Change) -> Refit:
    try:
        changed = _conclude(_refit(base.model, replace_value(base.model.config, change.key, change.spec)))
    except NotPositiveDefiniteError as error:
        return Refit(change, (), {}, converged=False, failure=str(error))
    before, after = base.model.report, changed.model.report
    likelihoods = zip(base.model.parts, before.log_likelihood, after.log_likelihood, strict=True)
    return Refit(
        change,
        _effects(base, changed),
        {axis: new - old for axis, old, new in likelihoods},
        after.restarts[0].converged,
    )


def _effects(base: _Conclusions, changed: _Conclusions) -> tuple[Effect, ...]:
    """Effects on every conclusion that the configuration does not fix."""
    effects = []
    for latent in LATENTS:
        one, two = base.posterior[latent], changed.posterior[latent]
        for a, axis in enumerate(base.posterior.axes):
            if np.isclose(one.prior_scale[:, a], 0.0).all():
                continue
            before, after = (marginal.quantile(0.5)[:, a] for marginal in (one, two))
            width = max(_rms(one.scale[:, a]), ROUNDING * _rms(one.prior_scale[:, a]))
            moved = two.location[:, a] - one.location[:, a]
            if latent in IMPEDANCE_ORDER:
                difference, shift = float((after - before).mean()), abs(float(moved.mean())) / width
            else:
                difference, shift = _rms(moved), _rms(moved) / width
            supports = [each.supports.get((latent, axis)) for each in (base, changed)]
            effects.append(
                Effect(latent, axis, float(before.mean()), float(after.mean()), difference, shift, *supports)
            )
    return tuple(effects)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))


def _finding(pairs: Sequence[tuple[Change, Effect]], planned: int) -> str:
    """What one conclusion rests on, strongest first, given each change that could be fitted with its effect."""
    strongest: dict[str, Effect] = {}
    for change, effect in sorted(pairs, key=lambda pair: -pair[1].shift):
        known = strongest.get(change.key)
        if effect.moved and (known is None or (effect.reversed and not known.reversed)):
            strongest[change.key] = effect
    prior_only = pairs[0][1].support is Support.PRIOR_ONLY
    if strongest:
        listed = ", ".join(f"{key} ({_extent(effect)})" for key, effect in strongest.items())
        return f"prior only, so it follows its priors: {listed}" if prior_only else f"rests on {listed}"
    change, effect = max(pairs, key=lambda pair: pair[1].shift)
    tried = f"all {planned}" if len(pairs) == planned else f"the {len(pairs)} fitted of {planned}"
    largest = f"(largest {in_sds(effect.shift)}, by {change.label})"
    if prior_only:
        return f"prior only, and so uncertain that {tried} changes stay within its interval {largest}"
    return f"robust to {tried} changes {largest}"


def _extent(effect: Effect) -> str:
    extent = in_sds(effect.shift)
    if effect.reversed and effect.support_after is not None:
        return f"{extent}, then {effect.support_after.value}"
    return extent


def _refit_json(refit: Refit) -> dict[str, Any]:
    change = refit.change
    return {
        "prior": change.key,
        "change": change.description,
        "quantity": change.quantity,
        "before": change.before,
        "after": change.after,
        "unit": change.unit,
        "converged": refit.converged,
        "failure": refit.failure,
        "log_likelihood_change": refit.log_likelihood_change,
        "conclusions": _effects_json(refit.effects),
    }


def _effects_json(effects: Sequence[Effect]) -> dict[str, Any]:
    return {
        effect.name.replace(" ", "_"): {
            "before": effect.before,
            "after": effect.after,
            "difference": effect.difference,
            "unit": effect.unit,
            "shift": effect.shift,
            "moved": effect.moved,
            "verdict": None if effect.support is None else effect.support.value,
            "verdict_after": None if effect.support_after is None else effect.support_after.value,
        }
        for effect in effects
    }
