"""Verdicts: thresholds, sentences and averages."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from oracles import MODEL, configuration

from bayes_impedance.config import Config, DeviceConfig
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import count_repetitions
from bayes_impedance.identifiability import (
    Support,
    Verdict,
    assess,
    caveat,
    classify,
    confounding,
    rounded,
    summarise,
    was_perturbed,
)
from bayes_impedance.kernels import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import Marginal, Posterior
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.simulation.generative import draw_force, repeated_motion

N = 6


def log_with(perturbation: float | None = None) -> PreparedLog:
    """One trial, perturbed by a constant force where the log records one."""
    log = repeated_motion(repetitions=1, duration=1.0, rate=float(N), seed=0)
    if perturbation is None:
        return log
    constant = np.full((N, 2), perturbation)
    return PreparedLog(log.axes, tuple(replace(t, perturbation=constant) for t in log.trials))


def posterior_with(
    contraction: float, prior_scale: float = 0.5, perturbation: float | None = None
) -> Posterior:
    """Every impedance at this contraction on both axes."""
    prior = np.full((N, 2), prior_scale)
    marginals = {}
    for latent, level in ((Latent.STIFFNESS, 100.0), (Latent.DAMPING, 9.0), (Latent.MASS, 1.2)):
        warped = latent is not Latent.MASS
        location = np.full((N, 2), np.log(level) if warped else level)
        scale = prior * np.sqrt(1.0 - contraction)
        marginals[latent] = Marginal(latent, warped, location + 0.1, scale, location, prior)
    return Posterior(log_with(perturbation), marginals)


def stiffness_of(posterior: Posterior, config: Config) -> Verdict:
    return next(verdict for verdict in assess(posterior, config, 2) if verdict.latent is Latent.STIFFNESS)


@pytest.mark.parametrize(
    ("contraction", "support"),
    [
        (1.0, Support.SUPPORTED),
        (0.75, Support.SUPPORTED),
        (0.7499, Support.WEAK),
        (0.25, Support.WEAK),
        (0.2499, Support.PRIOR_ONLY),
        (0.0, Support.PRIOR_ONLY),
        (-0.1, Support.PRIOR_ONLY),
    ],
)
def test_thresholds(contraction: float, support: Support) -> None:
    assert classify(contraction) is support
    assert [s.value for s in Support] == ["supported by these data", "weakly supported", "prior only"]


def test_supported_with_a_reference_has_no_caveat() -> None:
    verdict = stiffness_of(posterior_with(0.9), configuration())
    assert (
        verdict.sentence
        == "stiffness xx: supported by these data; the data removed 90 % of the prior variance."
    )
    assert verdict.support is Support.SUPPORTED


TRIAL_AVERAGE = {**MODEL["desired_trajectory"], "mean": "trial_average"}
EQUILIBRIUM = {**MODEL["desired_trajectory"], "mean": "equilibrium"}


@pytest.mark.parametrize(
    ("contraction", "words"),
    [
        (0.76, "supported by these data; the data removed 76 % of the prior variance."),
        (0.9951, "supported by these data; the data removed over 99 % of the prior variance."),
        (1.0, "supported by these data; the data removed over 99 % of the prior variance."),
        (0.4, "weakly supported; the data removed 40 % of the prior variance."),
    ],
)
def test_share_of_the_variance(contraction: float, words: str) -> None:
    for mean in (TRIAL_AVERAGE, MODEL["desired_trajectory"]):
        sentence = stiffness_of(posterior_with(contraction), configuration(desired_trajectory=mean)).sentence
        assert sentence == f"stiffness xx: {words}"


@pytest.mark.parametrize("contraction", [0.9, 0.4])
def test_claims_without_perturbation_column_come_with_a_caveat(contraction: float) -> None:
    config = configuration(desired_trajectory=TRIAL_AVERAGE)

    def caveat_of(posterior: Posterior, config: Config) -> str | None:
        return caveat(assess(posterior, config, 2), posterior.log, config)

    said = caveat_of(posterior_with(contraction), config)
    assert said is not None
    assert "something other than this person displaced the hand: the log has no perturbation column" in said
    # Perturbed by a device, of which the configuration says how it answers force.
    device = config.model_copy(update={"device": DeviceConfig.model_validate({"mass": 2.0})})
    assert caveat_of(posterior_with(contraction, perturbation=1.0), device) is None
    unknown = caveat_of(posterior_with(contraction, perturbation=1.0), config)
    assert unknown is not None
    assert "name its virtual mass in `device`" in unknown
    # A known reference needs no perturbation, and where nothing is claimed nothing is presumed.
    assert caveat_of(posterior_with(contraction), configuration()) is None
    assert caveat_of(posterior_with(0.1), config) is None


def test_prior_only_says_what_to_do() -> None:
    sentence = stiffness_of(posterior_with(0.1), configuration(desired_trajectory=TRIAL_AVERAGE)).sentence
    assert sentence == (
        "stiffness xx: prior only; the data removed 10 % of the prior variance: "
        "perturb the motion, repeat it, or give a reference."
    )


def test_prior_only_under_equilibrium_names_the_product() -> None:
    config = configuration(trajectory_input="position", desired_trajectory=EQUILIBRIUM)
    sentence = stiffness_of(posterior_with(0.0), config).sentence
    assert sentence.startswith("stiffness xx: prior only; the data removed 0 % of the prior variance: ")
    assert "the force tells only the product of impedance and the SD of x_d" in sentence
    # Rounding may make the posterior a hair wider than the prior; nobody wants to read "-0 %".
    assert "removed 0 %" in stiffness_of(posterior_with(-1e-12), config).sentence


def test_rounded_contraction_never_claims_certainty() -> None:
    assert [rounded(c) for c in (0.1234, 0.99, 0.995, 1.0)] == ["0.12", "0.99", "> 0.99", "> 0.99"]


def test_fixed_impedance_says_so() -> None:
    verdict = stiffness_of(posterior_with(0.0, prior_scale=0.0), configuration())
    assert verdict.sentence == "stiffness xx: fixed by the configuration, so the data had no say."
    assert verdict.contraction == 0.0
    assert verdict.support is Support.PRIOR_ONLY


def test_numbers_are_averages_over_the_path() -> None:
    posterior = posterior_with(0.5)
    location = posterior[Latent.STIFFNESS].location + np.linspace(-0.5, 0.5, N)[:, None] * [1.0, 2.0]
    marginals = {
        **posterior.marginals,
        Latent.STIFFNESS: replace(posterior[Latent.STIFFNESS], location=location),
    }
    posterior = replace(posterior, marginals=marginals)
    verdicts = assess(posterior, configuration(), repetitions=2)
    assert [(v.latent, v.axis) for v in verdicts] == [
        (latent, axis) for latent in (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS) for axis in "xy"
    ]
    assert [v.unit for v in verdicts] == ["N/m", "N/m", "Ns/m", "Ns/m", "kg", "kg"]
    stiffness = posterior[Latent.STIFFNESS]
    for a, verdict in enumerate(verdicts[:2]):
        assert verdict.mean == pytest.approx(stiffness.mean[:, a].mean())
        assert verdict.q05 == pytest.approx(stiffness.quantile(0.05)[:, a].mean())
        assert verdict.q95 == pytest.approx(stiffness.quantile(0.95)[:, a].mean())
        assert verdict.prior_q05 == pytest.approx(stiffness.prior_quantile(0.05)[:, a].mean())
        assert verdict.prior_q95 == pytest.approx(stiffness.prior_quantile(0.95)[:, a].mean())
        assert verdict.contraction == pytest.approx(0.5)


def test_summary_for_json() -> None:
    summary = summarise(assess(posterior_with(0.9), configuration(), repetitions=2))
    assert list(summary) == [f"{q}_{a}{a}" for q in ("stiffness", "damping", "mass") for a in "xy"]
    assert set(summary["stiffness_xx"]) == {"mean", "q05", "q95", "contraction", "verdict"}
    assert summary["mass_yy"]["verdict"] == "supported by these data"
    assert summary["mass_yy"]["contraction"] == pytest.approx(0.9)


def learned_levels(**model: object) -> Config:
    return configuration(
        ("training.restarts=1", "training.max_iterations=3"),
        stiffness={"level": {"median": 100, "log_sd": 1.0}, "log_sd": 0.1},
        damping={"level": {"median": 9, "log_sd": 1.0}, "log_sd": 0.1},
        mass={"level": {"median": 1.2, "log_sd": 0.7}, "sd": 0.1},
        **model,
    )


def test_a_known_reference_supports_and_equilibrium_does_not() -> None:
    motion = repeated_motion(repetitions=2, duration=4.0, rate=10.0, seed=3)
    known = {**MODEL["desired_trajectory"], "sd": 0.002}
    config = learned_levels(desired_trajectory=known)
    log = draw_force(configuration(desired_trajectory=known), motion, seed=3)
    verdicts = ImpedanceModel(config).fit(log).verdicts()
    assert all(v.support is Support.SUPPORTED for v in verdicts if v.latent is not Latent.MASS)
    config = learned_levels(trajectory_input="position", desired_trajectory=EQUILIBRIUM)
    for verdict in ImpedanceModel(config).fit(log).verdicts():
        assert verdict.contraction == pytest.approx(0.0, abs=1e-12)
        assert verdict.support is Support.PRIOR_ONLY


CONSTANT = {**MODEL["desired_trajectory"], "mean": "constant"}


@pytest.mark.parametrize(
    ("theta", "trajectory", "repetitions", "reason"),
    [
        ("time", MODEL["desired_trajectory"], 1, None),
        ("phase", TRIAL_AVERAGE, 2, None),
        ("phase", TRIAL_AVERAGE, 1, "seen once"),
        ("phase", CONSTANT, 4, None),
        ("time", CONSTANT, 4, "seen once"),
        ("position", CONSTANT, 4, "function of position fits any stiffness"),
        ("position_velocity", CONSTANT, 4, "function of position and velocity fits any stiffness"),
        ("position", EQUILIBRIUM, 4, "only the product"),
    ],
)
def test_designs_that_cannot_tell_impedance_from_intention(
    theta: str, trajectory: dict[str, object], repetitions: int, reason: str | None
) -> None:
    config = configuration(trajectory_input=theta, desired_trajectory=trajectory)
    found = confounding(config, repetitions)
    assert (found is None) if reason is None else (found is not None and reason in found)


@pytest.mark.parametrize(
    ("trajectory", "perturbed", "claims"),
    [
        (TRIAL_AVERAGE, None, True),
        (TRIAL_AVERAGE, True, True),
        (TRIAL_AVERAGE, False, False),
        (MODEL["desired_trajectory"], False, True),
    ],
)
def test_repetitions_that_nothing_perturbed_tell_of_the_robot(
    trajectory: dict[str, object], perturbed: bool | None, claims: bool
) -> None:
    config = configuration(trajectory_input="phase", desired_trajectory=trajectory)
    reason = confounding(config, 4, perturbed)
    assert (reason is None) if claims else (reason is not None and "nothing perturbed the hand" in reason)


def test_perturbation_is_unknown_where_one_trial_does_not_tell() -> None:
    (silent,), (still,), (moved,) = (log_with(p).trials for p in (None, 0.0, 1.0))
    assert was_perturbed([silent, moved]) is None
    assert was_perturbed([still, still]) is False
    assert was_perturbed([still, moved]) is True


def test_contraction_without_identification_claims_nothing() -> None:
    config = configuration(trajectory_input="time", desired_trajectory=CONSTANT)
    (verdict, *_) = assess(posterior_with(0.94), config, repetitions=1)
    assert verdict.support is Support.PRIOR_ONLY
    assert verdict.sentence == (
        "stiffness xx: prior only; the contraction of 0.94 rests on the assumed desired trajectory, not on the "
        "data: each desired trajectory was seen once, and x_d = x + u/k fits any stiffness: repeat the motion."
    )


def test_one_recording_around_a_constant_is_prior_only_though_it_contracts() -> None:
    truth = configuration(trajectory_input="phase")
    log = draw_force(truth, repeated_motion(repetitions=1, duration=2.0, rate=20.0), seed=0)
    config = configuration(trajectory_input="time", desired_trajectory=CONSTANT)
    verdicts = ImpedanceModel(config).verdicts(ImpedanceModel(config).posterior(log))
    assert {verdict.support for verdict in verdicts} == {Support.PRIOR_ONLY}
    assert max(verdict.contraction for verdict in verdicts) > 0.5


def test_unfitted_levels_get_no_verdict() -> None:
    config = configuration(stiffness={**MODEL["stiffness"], "level": {"median": 150, "log_sd": 1.0}})
    log = draw_force(config, repeated_motion(repetitions=1, duration=1.0, rate=20.0), seed=0)
    model = ImpedanceModel(config)
    with pytest.raises(ConfigurationError, match="expected a fitted model"):
        model.verdicts(model.posterior(log))


def test_repetitions_count_each_motion_once_in_the_group_with_fewest() -> None:
    two = repeated_motion(repetitions=2, duration=1.0, rate=20.0, seed=0)
    three = repeated_motion(repetitions=3, duration=1.0, rate=20.0, seed=1, group="1")
    both = PreparedLog(two.axes, two.trials + three.trials)
    assert count_repetitions(both) == 2
    assert count_repetitions(two, two.trials) == 2
    assert count_repetitions(two, repeated_motion(1, 1.0, 20.0, seed=5).trials) == 3
