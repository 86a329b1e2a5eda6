"""Plans: expected intervals against dense conditioning, what makes them narrow, what they rest on, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import MODEL, condition, configuration, oracle_of, samples_of
from scipy.stats import norm

from bayes_impedance.config import Config, load_config
from bayes_impedance.errors import SimulationError, TooManySamplesError
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.simulation import planning
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import (
    BandLimitedForce,
    ForcePulses,
    Perturbation,
    PositionDisplacement,
    Unperturbed,
)
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.planning import Expectation, Plan, plan, relative_width
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace

PERSON = Subject("P", arm_with("low"), Pace(repetition=2.0))
TEMPLATE = Experiment([PERSON], FigureEight(), repetitions=1, perturbation=BandLimitedForce(1.0), rate=100.0)
#: Gaussian stiffness and damping, whose posterior is what dense conditioning says without further ado.
GAUSSIAN = {
    "stiffness": {**MODEL["stiffness"], "prior": "gp", "log_sd": None, "sd": 30},
    "damping": {**MODEL["damping"], "prior": "gp", "log_sd": None, "sd": 3},
}
LEVELS = {
    "stiffness": {**GAUSSIAN["stiffness"], "level": {"median": 100, "log_sd": 0.5}},
    "damping": {**GAUSSIAN["damping"], "level": {"median": 9, "log_sd": 0.5}},
    "mass": {"level": {"median": 1.2, "log_sd": 0.4}, "sd": 0.2},
}
RATE = "preprocessing.rate=10"
LATENTS = ("stiffness", "damping", "mass")


def fixed(**model: object) -> Config:
    """Nothing to train, a desired trajectory known but for 2 cm."""
    return configuration([RATE], trajectory_input="phase", **model)


def session(
    model: ImpedanceModel, perturbation: Perturbation, repetitions: int, seed: int = 0, drawn: int = 4
):
    """The first repetitions of so many drawn, as a model sees them."""
    log = model.prepare(simulate(replace(TEMPLATE, trials=drawn, perturbation=perturbation), seed))
    return log.select(range(repetitions))


def standing_at_medians(config: Config) -> ImpedanceModel:
    """A fitted model whose hyperparameters are the medians of `config`."""
    known = ImpedanceModel(fixed())
    fit = known.fit(session(known, BandLimitedForce(1.0), 2)).fitted
    return ImpedanceModel(config, replace(fit, force_model=ImpedanceModel(config).force_model(("x", "y"))))


def widths(planned: Plan, latent: str = "stiffness", axis: str = "x") -> np.ndarray:
    """Perturbations by repetitions."""
    return np.array([[e.width for e in planned.along(latent, axis, p)] for p in planned.perturbations])


@pytest.mark.parametrize(
    ("model", "level_sd"),
    [(GAUSSIAN, (0.0, 0.0, 0.0)), (LEVELS, (50.0, 4.5, 0.48))],
    ids=["known", "learned"],
)
def test_widths_equal_dense_conditioning(model: dict[str, object], level_sd: Sequence[float]) -> None:
    """Of unknown levels too: their hyperprior is an offset with its variance."""
    config = fixed(**model)
    fitted = standing_at_medians(config)
    planned = plan(TEMPLATE, fitted, [2], [2.0], motions=1)
    log = session(fitted, BandLimitedForce(2.0), 2)
    force = np.concatenate([trial.force for trial in log.trials])
    oracle = oracle_of(config, axes=2)
    for a, axis in enumerate("xy"):
        samples = samples_of(config, log, a)
        u = torch.from_numpy(force[:, a].copy())
        noise = config.model.noise_sd.median**2
        for latent in LATENTS:
            mean, _ = condition(oracle, samples, u, samples, latent, noise)
            _, variance = condition(oracle, samples, u, samples, latent, noise, np.square(level_sd))
            expected = 2.0 * norm.ppf(0.95) * variance.sqrt().mean() / mean.mean()
            (found,) = planned.along(latent, axis, 2.0)
            assert found.width == pytest.approx(float(expected), rel=1e-6)


def test_warped_widths_are_those_of_the_posterior_and_verdicts_its_own() -> None:
    model = ImpedanceModel(fixed())
    planned = plan(TEMPLATE, model, [3], [1.0], motions=1)
    fitted = model.fit(session(model, BandLimitedForce(1.0), 3))
    posterior = fitted.posterior(fitted.fitted.log)
    for verdict in fitted.verdicts(posterior):
        (found,) = planned.along(verdict.latent, verdict.axis, 1.0)
        a = "xy".index(verdict.axis)
        low, middle, high = (posterior[verdict.latent].quantile(p)[:, a].mean() for p in (0.05, 0.5, 0.95))
        assert found.width == pytest.approx((high - low) / middle)
        assert found.width == relative_width(posterior[verdict.latent], a)
        assert (found.support, found.contraction) == (verdict.support, pytest.approx(verdict.contraction))


def test_more_repetitions_and_more_perturbation_narrow_the_interval_at_given_hyperparameters() -> None:
    planned = plan(TEMPLATE, ImpedanceModel(fixed()), [8, 2, 4], [4.0, 2.0, 10.0], motions=2)
    assert (planned.repetitions, planned.perturbations) == ((2, 4, 8), (2.0, 4.0, 10.0))
    for latent in LATENTS:
        for axis in planned.axes:
            found = widths(planned, latent, axis)
            assert (np.diff(found, axis=0) < 0).all()
            assert (np.diff(found, axis=1) < 0).all()


@pytest.fixture(scope="module")
def averaged() -> ImpedanceModel:
    """Not fitted; a desired trajectory from the repetitions, so that they have to be perturbed."""
    return ImpedanceModel(
        load_config(
            "admittance",
            [RATE, "model.desired_trajectory.average_knots=2", "training.max_iterations=3"],
        )
    )


@pytest.mark.parametrize(
    "kind", [BandLimitedForce(1.0), ForcePulses(1.0), PositionDisplacement()], ids=lambda k: type(k).__name__
)
def test_without_perturbation_everything_is_prior_only(averaged: ImpedanceModel, kind: Perturbation) -> None:
    planned = plan(replace(TEMPLATE, perturbation=kind), averaged, [2, 4], [0.0], motions=1)
    assert {entry.support for entry in planned.expectations} == {Support.PRIOR_ONLY}
    assert planned.smallest(1e6) == {0.0: None}
    assert planned.unit == ("m" if isinstance(kind, PositionDisplacement) else "N")


def test_one_repetition_is_prior_only(averaged: ImpedanceModel) -> None:
    planned = plan(TEMPLATE, averaged, [1, 4], [5.0], motions=1)
    assert [entry.support for entry in planned.along("mass", "x", 5.0)] == [
        Support.PRIOR_ONLY,
        Support.SUPPORTED,
    ]


def test_an_unfitted_model_is_trained_on_the_pilot_of_each_session(averaged: ImpedanceModel) -> None:
    planned = plan(TEMPLATE, averaged, [4], [1.0, 5.0], motions=1, pilot=2)
    config = averaged.config.model_copy(
        update={"training": averaged.config.training.model_copy(update={"restarts": 1})}
    )
    for perturbation in planned.perturbations:
        log = session(averaged, BandLimitedForce(perturbation), 4)
        pilot = ImpedanceModel(config).fit(log.select([0, 1]))
        posterior = ImpedanceModel(config, replace(pilot.fitted, log=log)).posterior(log)
        (found,) = planned.along("stiffness", "y", perturbation)
        assert found.width == pytest.approx(relative_width(posterior[Latent.STIFFNESS], 1))


def test_a_fitted_model_is_not_trained_and_its_own_path_plays_no_part(
    averaged: ImpedanceModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = averaged.fit(session(averaged, BandLimitedForce(1.0), 4))
    elsewhere = replace(TEMPLATE, task=FigureEight(centre=(0.2, 0.35)), trials=4)
    abroad = averaged.prepare(simulate(elsewhere, 0))
    monkeypatch.delattr(ImpedanceModel, "fit")
    here = plan(TEMPLATE, own, [4], [1.0], motions=1)
    posterior = own.posterior(own.fitted.log)
    assert widths(here)[0, 0] == pytest.approx(relative_width(posterior[Latent.STIFFNESS], 0))
    there = plan(TEMPLATE, ImpedanceModel(own.config, replace(own.fitted, log=abroad)), [4], [1.0], motions=1)
    assert here == there


def test_plans_are_reproducible_and_average_over_motions() -> None:
    model = ImpedanceModel(fixed())
    both, first, second = (
        plan(TEMPLATE, model, [2], [1.0], seed=seed, motions=motions)
        for seed, motions in ((5, 2), (5, 1), (6, 1))
    )
    assert both == plan(TEMPLATE, model, [2, 2], [1.0, 1.0], seed=5, motions=2)
    assert first != second
    np.testing.assert_allclose(widths(both), 0.5 * (widths(first) + widths(second)))


def test_rounds_of_a_trial_count_as_repetitions() -> None:
    """Two trials of two rounds are planned for as two trials of such an experiment are judged."""
    model, rounds = ImpedanceModel(fixed()), replace(TEMPLATE, repetitions=2)
    planned = plan(rounds, model, [2, 4], [1.0], motions=1, pilot=3)
    log = model.prepare(simulate(replace(rounds, trials=2), 0))
    posterior = model.posterior(log)
    found = planned.along("stiffness", "x", 1.0)
    assert [entry.repetitions for entry in found] == [2, 4]
    assert found[1].width == pytest.approx(relative_width(posterior[Latent.STIFFNESS], 0))


def test_progress_is_told(averaged: ImpedanceModel) -> None:
    steps: list[tuple[int, int, str]] = []
    plan(
        TEMPLATE,
        ImpedanceModel(fixed()),
        [1],
        [0.5, 2.0],
        motions=2,
        progress=lambda *step: steps.append(step),
    )
    assert steps == [(0, 4, "0.5 N"), (1, 4, "0.5 N"), (2, 4, "2 N"), (3, 4, "2 N")]


def test_ctrl_c_in_a_pilot_ends_the_plan(averaged: ImpedanceModel, monkeypatch: pytest.MonkeyPatch) -> None:
    interrupted = averaged.fit(session(averaged, BandLimitedForce(1.0), 2))
    report = replace(interrupted.report, interrupted=True)
    stopped = ImpedanceModel(averaged.config, replace(interrupted.fitted, report=report))
    monkeypatch.setattr(ImpedanceModel, "fit", lambda *_: stopped)
    with pytest.raises(KeyboardInterrupt):
        plan(TEMPLATE, averaged, [2], [1.0])


# --- what a plan says --------------------------------------------------------------------------------


def plan_of(
    lines: dict[float, dict[int, float]], support: Support = Support.SUPPORTED, axis: str = "x"
) -> Plan:
    """Widths of stiffness by perturbation and repetitions."""
    entries = [
        Expectation(Latent.STIFFNESS, axis, repetitions, perturbation, width, 0.9, support)
        for perturbation, line in lines.items()
        for repetitions, width in line.items()
    ]
    return Plan(tuple(entries), "N")


GRID = plan_of({1.0: {2: 0.6, 4: 0.4, 8: 0.3}, 5.0: {2: 0.3, 4: 0.2, 8: 0.1}})


@pytest.mark.parametrize(
    ("width", "found"),
    [
        (0.7, {1.0: 2, 5.0: 2}),
        (0.4, {1.0: 4, 5.0: 2}),
        (0.29, {1.0: None, 5.0: 4}),
        (0.05, {1.0: None, 5.0: None}),
    ],
)
def test_smallest_number_of_repetitions(width: float, found: dict[float, int | None]) -> None:
    assert GRID.smallest(width) == found


def test_smallest_is_not_reached_by_a_lucky_number() -> None:
    assert plan_of({1.0: {2: 0.2, 4: 0.4, 8: 0.3, 12: 0.2}}).smallest(0.3) == {1.0: 8}


@pytest.mark.parametrize(
    ("support", "found"), [(Support.SUPPORTED, 2), (Support.WEAK, 2), (Support.PRIOR_ONLY, None)]
)
def test_a_width_that_is_the_prior_s_does_not_count(support: Support, found: int | None) -> None:
    assert plan_of({1.0: {2: 0.1}}, support).smallest(0.3) == {1.0: found}


def test_smallest_along_one_axis_or_along_all() -> None:
    both = Plan((*GRID.expectations, *plan_of({1.0: {2: 0.9, 4: 0.8, 8: 0.4}}, axis="y").expectations), "N")
    both = Plan(tuple(entry for entry in both.expectations if entry.perturbation == 1.0), "N")
    assert (both.axes, both.smallest(0.4)) == (("x", "y"), {1.0: 8})
    assert (both.smallest(0.4, axis="x"), both.smallest(0.4, axis="y")) == ({1.0: 4}, {1.0: 8})


def test_sentences() -> None:
    assert GRID.sentences(0.29) == [
        "stiffness, 1 N: none of the numbers planned for, 8 repetitions at most, is enough.",
        "stiffness, 5 N: 4 repetitions.",
    ]


def test_table() -> None:
    table = GRID.table()
    assert list(table) == [
        "quantity", "axis", "perturbation [N]", "repetitions", "width", "contraction", "verdict",
    ]  # fmt: skip
    assert table.iloc[3].tolist() == ["stiffness", "x", 5.0, 2, 0.3, 0.9, "supported by these data"]
    assert len(table) == 6


def test_the_weakest_verdict_of_the_motions_stands() -> None:
    found = [plan_of({1.0: {2: 0.3}}, support).expectations[0] for support in Support]
    assert planning._average(found[:2]).support is Support.WEAK
    assert planning._average(found[::-1]).support is Support.PRIOR_ONLY


# --- refusals ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"repetitions": []}, "repetitions: expected at least one to plan for, got none; name one or more"),
        ({"perturbations": []}, "perturbations: expected at least one to plan for, got none"),
        ({"repetitions": [2, 0]}, "repetitions: expected multiples of 1, the rounds of a trial, and at least one"),
        ({"perturbations": [-1.0]}, "perturbations: expected finite values >= 0, got -1; choose others"),
        ({"perturbations": [float("inf")]}, "perturbations: expected finite values >= 0, got inf"),
        ({"motions": 0}, "motions: expected at least 1 to plan with, got 0; take more"),
        ({"pilot": 1}, "pilot: expected at least 2 to plan with, got 1"),
        (
            {"experiment": replace(TEMPLATE, subjects=[PERSON, replace(PERSON, name="Q")])},
            "subjects: expected one to plan for, got 2; plan for each of them by itself",
        ),
        (
            {"experiment": replace(TEMPLATE, perturbation=Unperturbed())},
            "perturbation: expected a kind with a size to vary, BandLimitedForce, ForcePulses, PositionDisplacement, "
            "got Unperturbed; choose one of them, of any size",
        ),
        (
            {"experiment": replace(TEMPLATE, repetitions=3), "repetitions": [4]},
            "repetitions: expected multiples of 3, the rounds of a trial, and at least one trial, got 4",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_planned_for(changes: dict[str, object], sentence: str) -> None:
    arguments = {"experiment": TEMPLATE, "repetitions": [2], "perturbations": [1.0], **changes}
    with pytest.raises(SimulationError) as refused:
        plan(model=ImpedanceModel(fixed()), **arguments)
    assert sentence in str(refused.value)


def test_too_many_samples_are_refused_before_the_pilot(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(ImpedanceModel, "fit")
    model = ImpedanceModel(
        fixed().model_copy(update={"engine": fixed().engine.model_copy(update={"max_samples": 50})})
    )
    with pytest.raises(TooManySamplesError, match="8 repetitions: expected at most engine.max_samples = 50"):
        plan(TEMPLATE, model, [2, 8], [1.0])


@pytest.mark.parametrize("width", [0.0, -0.1, float("nan"), float("inf")])
def test_widths_that_no_interval_has(width: float) -> None:
    with pytest.raises(SimulationError, match=r"width: expected a finite value > 0, got .*; \.2 asks for"):
        GRID.smallest(width)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("stifness", "x", 1.0), "quantity: expected one that was planned for, stiffness, damping, mass, got"),
        (("force", "x", 1.0), "quantity: expected one that was planned for"),
        (("stiffness", "z", 1.0), "axis: expected one that was planned for, x, got 'z'; choose one of them"),
        (("stiffness", "x", 3.0), "perturbation: expected one that was planned for, 1.0, 5.0, got 3.0"),
    ],
)  # fmt: skip
def test_what_was_not_planned_for(arguments: tuple[str, str, float], sentence: str) -> None:
    with pytest.raises(SimulationError) as refused:
        GRID.along(*arguments)
    assert sentence in str(refused.value)
    if arguments[1] == "z":
        with pytest.raises(SimulationError):
            GRID.smallest(0.3, axis="z")
