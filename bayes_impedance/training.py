"""Hyperparameters from the marginal likelihood: MAP by L-BFGS with restarts, and its Laplace approximation.

Axes have their own hyperparameters and share none, so one objective is optimised for all of them
together (each evaluation is batched over axes and groups) and the best restart is chosen an axis at a time. Where axes
are coupled they have one objective, and one best restart. A part is what has an objective of its own: an axis, or all.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from bayes_impedance.config import TrainingConfig
from bayes_impedance.engines.closed_loop import log_likelihood
from bayes_impedance.engines.coupled_loop import coupled_log_likelihood
from bayes_impedance.engines.dense import Observations
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import Features
from bayes_impedance.journal import Journal
from bayes_impedance.kernels.coupled import join_axes, rows_of
from bayes_impedance.priors import Entry, ForceModel

Array = NDArray[np.float64]

#: The optimiser stays within this many hyperprior log-SDs of the median: beyond, a density of e⁻¹⁸
#: and overflowing covariances are all there is.
BOUND = 6.0
#: Unconstrained range of a hyperparameter that lives in an interval (a sigmoid).
INTERVAL_BOUND = 8.0
#: Relative improvement an iteration at which a restart has converged: 1e-5 of a hundred nats.
RELATIVE_TOLERANCE = 1e-7
HESSIAN_STEP = 1e-3
NOTHING_FREE = "every hyperparameter is fixed"


@dataclass(frozen=True)
class RestartReport:
    """How one restart ended; `objective` log posterior density and `log_likelihood`, one a part [nats]."""

    restart: int
    objective: tuple[float, ...]
    log_likelihood: tuple[float, ...]
    iterations: int
    evaluations: int
    seconds: float
    outcome: str

    @property
    def converged(self) -> bool:
        """Whether the optimiser ended by its own tolerances, or had nothing to do."""
        return self.outcome.startswith(("CONVERGENCE", NOTHING_FREE))


@dataclass(frozen=True)
class TrainingReport:
    """Result of training.

    `best[a]` is the restart that part a took; `log_sd[name]` `(axes, components)` is the Laplace SD of the
    logarithm of each hyperparameter, NaN where it is fixed; `interrupted` where the user stopped it. Parts are the
    axes, or one for all of them where they are coupled.
    """

    restarts: tuple[RestartReport, ...]
    best: tuple[int, ...]
    log_likelihood: tuple[float, ...]
    objective: tuple[float, ...]
    log_sd: dict[str, list[list[float]]]
    interrupted: bool
    samples: int


#: Called as progress(restart, iteration, objective summed over parts).
Progress = Callable[[int, int, float], None]


def observations(model: ForceModel, features: Features) -> Observations:
    """Force less its prior mean, with noise, of a log that has force; where axes are coupled all of them in one row."""
    assert features.force is not None
    residual = features.force - model.prior_mean(features.inputs)
    if not model.is_coupled:
        return Observations(features.inputs, residual, model.noise_variance, features.valid)
    inputs = join_axes(features.inputs, model.kernel.impedance.layout)
    axes, n = residual.shape[0], residual.shape[-1]
    valid = None if features.valid is None else features.valid.repeat_interleave(axes, dim=-1)
    return Observations(inputs, rows_of(residual), model.noise_variance.reshape(axes).repeat(n), valid)


def log_evidence(model: ForceModel, features: Features, jitter: float) -> Tensor:
    """log p(u) summed over groups, `(axes,)`, or `(1,)` where axes are coupled [nats].

    Raises:
        NotPositiveDefiniteError: no Cholesky factor at this jitter.
    """
    given, loop = observations(model, features), features.loop
    if model.is_coupled and loop is not None:
        return coupled_log_likelihood(model.kernel, given, loop, jitter).sum(-1).reshape(-1)
    return log_likelihood(model.kernel, given, loop, jitter).sum(-1).reshape(-1)


def objective(model: ForceModel, features: Features, jitter: float) -> tuple[Tensor, Tensor]:
    """Log posterior density of the hyperparameters and log marginal likelihood, `(parts,)` each [nats]."""
    likelihood = log_evidence(model, features, jitter)
    return likelihood + model.log_prior(), likelihood


def train(
    model: ForceModel,
    features: Features,
    config: TrainingConfig,
    jitter: float,
    progress: Progress | None = None,
    warm: bool = False,
    laplace: bool = True,
    journal: Journal | None = None,
) -> TrainingReport:
    """Set the hyperparameters of `model` to their MAP estimate; deterministic under `config.seed`.

    Restart 0 starts at the hyperprior medians or, when `warm`, where `model` stands; the others at draws from the
    hyperprior. Interrupting (Ctrl-C) keeps the best found so far. Without `laplace` the report holds no `log_sd`, which
    takes two evaluations a hyperparameter. What `journal` remembers is not computed again.

    Raises:
        NotPositiveDefiniteError: no restart found a covariance that factorises and a finite likelihood.
    """
    search = _Search(model, features, jitter, journal)
    generator = np.random.default_rng(config.seed)
    reports: list[RestartReport] = []
    interrupted = False
    failure: NotPositiveDefiniteError | None = None
    for restart in range(config.restarts):
        start = search.here() if warm and not restart else search.start(generator if restart else None)
        search.begin(restart, progress)
        clock = time.perf_counter()
        try:
            outcome = _climb(search, start, config)
        except NotPositiveDefiniteError as error:
            failure, outcome = error, f"stopped: {error}"
        except KeyboardInterrupt:
            interrupted, outcome = True, "interrupted"
        reports.append(search.summary(restart, outcome, time.perf_counter() - clock))
        if interrupted or not start.size:
            break
    if not np.isfinite(search.best_objective).all():
        if failure is not None:
            raise failure
        raise KeyboardInterrupt
    search.restore()
    log_sd: dict[str, list[list[float]]] = {}
    if laplace and not interrupted:
        try:
            log_sd = _laplace(search)
        except KeyboardInterrupt:
            interrupted = True
            search.restore()
    return TrainingReport(
        restarts=tuple(reports),
        best=tuple(int(r) for r in search.best_restart),
        log_likelihood=tuple(float(v) for v in search.best_likelihood),
        objective=tuple(float(v) for v in search.best_objective),
        log_sd=log_sd,
        interrupted=interrupted,
        samples=sum(len(rows) for rows in features.rows),
    )


def _climb(search: _Search, start: Array, config: TrainingConfig) -> str:
    """One run of L-BFGS from `start`; how it ended."""
    if not start.size:
        search(start)
        return NOTHING_FREE
    result = minimize(  # type: ignore[call-overload] # the stubs know no bounds as a list of pairs with a callback
        search,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=search.bounds,
        callback=search.report,
        options={
            "maxiter": config.max_iterations,
            "gtol": config.gradient_tolerance,
            "ftol": RELATIVE_TOLERANCE,
        },
    )
    return str(result.message)


class _Search:
    """The objective as scipy sees it: a function of one vector, the free unconstrained values by part."""

    def __init__(self, model: ForceModel, features: Features, jitter: float, journal: Journal | None) -> None:
        self.model, self.features, self.jitter, self.journal = model, features, jitter, journal
        self.entries: list[Entry] = [entry for entry in model.entries if bool(entry.free.any())]
        self.parts = 1 if model.is_coupled else features.inputs.shape[0]
        free = [np.tile(entry.free.numpy(), self._members(entry)) for entry in self.entries]
        self.free = np.concatenate(free) if free else np.zeros(0, dtype=bool)
        self.bounds = self._bounds()
        self.best_objective = np.full(self.parts, -np.inf)
        self.best_likelihood = np.full(self.parts, -np.inf)
        self.best_restart = np.zeros(self.parts, dtype=int)
        self.best_point = self.pack()
        self.begin(0, None)

    def begin(self, restart: int, progress: Progress | None) -> None:
        self.restart, self.progress = restart, progress
        self.iterations = self.evaluations = 0
        self.reached = np.full(self.parts, -np.inf)
        self.reached_likelihood = np.full(self.parts, -np.inf)

    def _members(self, entry: Entry) -> int:
        """Values of each component of a hyperparameter that belong to one part."""
        return int(entry.raw.shape[0]) // self.parts

    def pack(self) -> Array:
        """Free unconstrained values, `(parts, free)`."""
        if not self.entries:
            return np.zeros((self.parts, 0))
        raw = [entry.raw.detach().reshape(self.parts, -1).numpy() for entry in self.entries]
        return np.concatenate(raw, axis=1)[:, self.free].copy()

    def unpack(self, point: Array) -> None:
        """Write `(parts, free)` values into the model."""
        if not self.entries:
            return
        full = np.concatenate(
            [entry.raw.detach().reshape(self.parts, -1).numpy() for entry in self.entries], axis=1
        ).copy()
        full[:, self.free] = point.reshape(self.parts, -1)
        column = 0
        with torch.no_grad():
            for entry in self.entries:
                width = entry.raw.numel() // self.parts
                entry.raw.copy_(torch.from_numpy(full[:, column : column + width]).reshape(entry.raw.shape))
                column += width

    def start(self, generator: np.random.Generator | None) -> Array:
        """Hyperprior medians, or a draw from the hyperprior, inside the bounds."""
        columns = []
        for entry in self.entries:
            deviation = np.zeros((entry.raw.shape[0], len(entry.specs)))
            if generator is not None:
                deviation = generator.standard_normal(deviation.shape)
            values = entry.medians * torch.exp(entry.log_sds * torch.from_numpy(deviation))
            raw = torch.stack([entry.inverse(row)[0].reshape(-1) for row in values])
            columns.append(raw.reshape(self.parts, -1).numpy())
        point = np.concatenate(columns, axis=1)[:, self.free].reshape(-1) if columns else np.zeros(0)
        return self._inside(point)

    def here(self) -> Array:
        """Where the model stands, inside the bounds."""
        return self._inside(self.pack().reshape(-1))

    def _inside(self, point: Array) -> Array:
        lower, upper = np.array(self.bounds).reshape(-1, 2).T
        return np.asarray(np.clip(point, lower, upper))

    def evaluate(self, point: Array) -> tuple[Array, Array, Array]:
        """Objective and likelihood `(parts,)`, gradient of the objective `(parts, free)`, known or computed."""
        known = None if self.journal is None else self.journal.find(point)
        if known is not None:
            return (
                known[: self.parts],
                known[self.parts : 2 * self.parts],
                known[2 * self.parts :].reshape(self.parts, -1),
            )
        computed = self.compute(point)
        if self.journal is not None:
            self.journal.keep(point, np.concatenate([part.reshape(-1) for part in computed]))
        return computed

    def compute(self, point: Array) -> tuple[Array, Array, Array]:
        """What `evaluate` returns, from the covariance."""
        self.unpack(point)
        raws = [entry.raw for entry in self.entries]
        for raw in raws:
            raw.grad = None
        value, likelihood = objective(self.model, self.features, self.jitter)
        if raws:
            value.sum().backward()
            # A hyperparameter that the data do not touch still has its hyperprior's gradient.
            parts = [_gradient(raw).reshape(self.parts, -1).numpy() for raw in raws]
            gradient = np.concatenate(parts, axis=1)[:, self.free]
        else:
            gradient = np.zeros((self.parts, 0))
        if not (bool(value.isfinite().all()) and np.isfinite(gradient).all()):
            raise NotPositiveDefiniteError(
                "expected a finite likelihood of the forces, found one that overflows, or its gradient does; check "
                "log.units, and that the medians under model are of the size that their unit lets expect"
            )
        return value.detach().numpy(), likelihood.detach().numpy(), gradient

    def __call__(self, point: Array) -> tuple[float, Array]:
        value, likelihood, gradient = self.evaluate(point)
        self.evaluations += 1
        better = value > self.reached
        self.reached = np.where(better, value, self.reached)
        self.reached_likelihood = np.where(better, likelihood, self.reached_likelihood)
        best = value > self.best_objective
        self.best_objective = np.where(best, value, self.best_objective)
        self.best_likelihood = np.where(best, likelihood, self.best_likelihood)
        self.best_restart = np.where(best, self.restart, self.best_restart)
        self.best_point = np.where(best[:, None], point.reshape(self.parts, -1), self.best_point)
        return -float(value.sum()), -gradient.reshape(-1)

    def report(self, _: Array) -> None:
        self.iterations += 1
        if self.progress is not None:
            self.progress(self.restart, self.iterations, float(self.reached.sum()))

    def summary(self, restart: int, outcome: str, seconds: float) -> RestartReport:
        return RestartReport(
            restart, tuple(self.reached.tolist()), tuple(self.reached_likelihood.tolist()),
            self.iterations, self.evaluations, seconds, outcome,
        )  # fmt: skip

    def restore(self) -> None:
        self.unpack(self.best_point)

    def _bounds(self) -> list[tuple[float, float]]:
        one_part: list[tuple[float, float]] = []
        for entry in self.entries:
            bounded = bool(torch.isfinite(entry.constraint.upper_bound).all())
            for spec in entry.specs * self._members(entry):
                if spec.fixed:
                    continue
                if bounded:
                    one_part.append((-INTERVAL_BOUND, INTERVAL_BOUND))
                else:
                    centre, width = np.log(spec.median) / entry.power, BOUND * spec.log_sd / entry.power
                    one_part.append((centre - width, centre + width))
        return one_part * self.parts


def _gradient(raw: torch.nn.Parameter) -> Tensor:
    return torch.zeros_like(raw) if raw.grad is None else raw.grad


def _laplace(search: _Search) -> dict[str, list[list[float]]]:
    """SD of log h from the curvature at the optimum: central differences of the gradient, all parts at once."""
    point = search.best_point
    size = point.shape[1]
    hessian = np.zeros((search.parts, size, size))
    for column in range(size):
        step = np.zeros_like(point)
        step[:, column] = HESSIAN_STEP
        try:
            above, below = search.evaluate(point + step)[2], search.evaluate(point - step)[2]
        except NotPositiveDefiniteError:
            above = below = np.full_like(point, np.nan)
        hessian[:, column] = -(above - below) / (2.0 * HESSIAN_STEP)
    search.restore()
    hessian = 0.5 * (hessian + hessian.transpose(0, 2, 1))
    raw_sd = np.array([_standard_deviations(h) for h in hessian]).reshape(search.parts, size)
    spread = np.full((search.parts, search.free.size), np.nan)
    spread[:, search.free] = raw_sd
    result: dict[str, list[list[float]]] = {}
    column = 0
    for entry in search.entries:
        width = entry.raw.numel() // search.parts
        # d log h / d raw: `power` for a logarithmic constraint, less inside an interval.
        raw = entry.raw.detach().clone().requires_grad_()
        log_value = entry.power * entry.constraint.transform(raw).log()
        (slope,) = torch.autograd.grad(log_value.sum(), raw)
        scaled = spread[:, column : column + width] * slope.reshape(search.parts, -1).numpy()
        result[entry.name] = scaled.reshape(-1, len(entry.specs)).tolist()
        column += width
    return result


def _standard_deviations(hessian: Array) -> Array:
    """√diag(H⁻¹); NaN where the optimum is no proper maximum (at a bound, say)."""
    if not np.isfinite(hessian).all():
        return np.full(len(hessian), np.nan)
    values, vectors = np.linalg.eigh(hessian)
    if (values <= 0).any():
        return np.full(len(hessian), np.nan)
    return np.asarray(np.sqrt(np.square(vectors) @ (1.0 / values)))
