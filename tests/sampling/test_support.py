"""Verdicts on draws that are made by hand."""

import numpy as np
import pytest

from bayes_impedance.config import load_config
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.sampling.support import Evidence, exact_off_diagonals, exact_verdicts

CONFIG = load_config("phase")
PLACES = 3


def evidence(
    posterior_sd=0.1, prior_sd=0.4, count=2000, go_with=0.0, push=0.0, level=100.0, trajectory=True, axes=1
):
    """Log-normal draws of every quantity about `level`; log k goes with log σ_xd as `go_with` says.

    The prior of the level, standard normal, is `push` SDs away from where the draws are.
    """
    generator = np.random.default_rng(0)
    own = generator.standard_normal((count, axes))
    sd = np.exp(-go_with * own + np.sqrt(1.0 - go_with**2) * generator.standard_normal((count, axes)))
    prior = generator.standard_normal((500, axes))
    eye = np.eye(axes)
    impedance, before, log_prior = {}, {}, {}
    for latent in IMPEDANCE_ORDER:
        values = level * np.exp(posterior_sd * own)
        impedance[latent] = np.repeat((values[:, None, :, None] * eye), PLACES, axis=1)
        before[latent] = np.repeat((level * np.exp(prior_sd * prior))[:, None, :, None] * eye, PLACES, axis=1)
        log_prior[latent] = -0.5 * np.square(push + posterior_sd / max(prior_sd, 1e-9) * own)
    return Evidence(impedance, before, sd if trajectory else None, log_prior)


def verdicts(own, axes="x", repetitions=3, perturbed=True, config=CONFIG):
    return exact_verdicts(own, config, axes, repetitions, perturbed)


@pytest.mark.parametrize(
    ("posterior_sd", "support"), [(0.1, Support.SUPPORTED), (0.3, Support.WEAK), (0.38, Support.PRIOR_ONLY)]
)
def test_contraction_is_that_of_the_logarithm(posterior_sd, support):
    found = verdicts(evidence(posterior_sd, axes=2), axes="xy")
    assert [(one.verdict.latent, one.verdict.axis) for one in found] == [
        (latent, axis) for latent in IMPEDANCE_ORDER for axis in "xy"
    ]
    for one in found:
        assert one.verdict.contraction == pytest.approx(1.0 - (posterior_sd / 0.4) ** 2, abs=0.08)
        assert one.verdict.support is support
        assert abs(one.correlation) < 0.1
        half = 1.645 * posterior_sd
        assert one.verdict.q05 == pytest.approx(100.0 * np.exp(-half), rel=0.05)
        assert one.verdict.q95 == pytest.approx(100.0 * np.exp(half), rel=0.05)
        assert one.verdict.prior_q95 == pytest.approx(100.0 * np.exp(1.645 * 0.4), rel=0.2)


def test_what_goes_with_the_scale_of_the_desired_trajectory_is_no_claim():
    for go_with, support in ((0.95, Support.PRIOR_ONLY), (0.5, Support.SUPPORTED)):
        one = verdicts(evidence(go_with=go_with))[0]
        assert one.correlation == pytest.approx(-go_with, abs=0.03)
        assert one.verdict.support is support
        told = "it goes with the SD of the desired trajectory (correlation -0.9" in one.verdict.sentence
        assert told is (support is Support.PRIOR_ONLY)
    one = verdicts(evidence(go_with=0.95, trajectory=False))[0]
    assert np.isnan(one.correlation) and one.verdict.support is Support.SUPPORTED


def test_the_design_of_the_experiment_comes_first():
    one = verdicts(evidence(go_with=0.95), repetitions=1)[0]
    assert one.verdict.support is Support.PRIOR_ONLY
    assert "seen once" in one.verdict.sentence
    one = verdicts(evidence(), perturbed=False)[0]
    assert one.verdict.support is Support.PRIOR_ONLY


def test_sensitivity_is_small_within_the_prior_and_large_in_its_tail():
    inside = verdicts(evidence())[0]
    tail = verdicts(evidence(posterior_sd=0.18, push=3.0))[0]
    assert inside.sensitivity < 0.05 < tail.sensitivity
    assert "It moves with its prior (sensitivity" in tail.verdict.sentence
    assert "sensitivity" not in inside.verdict.sentence
    # Nothing is claimed that could move.
    silent = verdicts(evidence(posterior_sd=0.39, push=3.0))[0]
    assert "sensitivity" not in silent.verdict.sentence


def test_what_is_fixed():
    for one in verdicts(evidence(posterior_sd=0.0, prior_sd=0.0)):
        assert one.verdict.contraction == 0.0 and one.verdict.support is Support.PRIOR_ONLY
        assert one.verdict.sentence.endswith("fixed by the configuration, so the data had no say.")
        assert np.isnan(one.correlation) and np.isnan(one.sensitivity)


@pytest.mark.parametrize("count", [1, 2, 99])
def test_a_few_draws_claim_nothing(count):
    for one in verdicts(evidence(count=count)):
        assert one.verdict.support is Support.PRIOR_ONLY
        assert f"{count} draws are too few to tell what the data said" in one.verdict.sentence
        assert np.isnan(one.correlation) and np.isnan(one.sensitivity)
    assert verdicts(evidence(count=100))[0].verdict.support is Support.SUPPORTED


def test_draws_that_never_moved_go_with_nothing():
    one = verdicts(evidence(posterior_sd=0.0))[0]
    assert np.isnan(one.correlation) and np.isnan(one.sensitivity)


def test_entries_beside_the_diagonal():
    own = evidence(axes=2)
    generator = np.random.default_rng(1)
    for part, sd in ((own.impedance, 2.0), (own.prior, 8.0)):
        values = 5.0 * (part is own.impedance) + sd * generator.standard_normal(len(part[Latent.STIFFNESS]))
        for a, b in ((0, 1), (1, 0)):
            part[Latent.STIFFNESS][:, :, a, b] = values[:, None]
    stiffness, damping, mass = exact_off_diagonals(own, "xy")
    assert (stiffness.latent, stiffness.pair, damping.latent, mass.latent) == (
        Latent.STIFFNESS,
        "xy",
        Latent.DAMPING,
        Latent.MASS,
    )
    assert stiffness.mean == pytest.approx(5.0, abs=0.2)
    assert stiffness.contraction == pytest.approx(1.0 - 1.0 / 16.0, abs=0.02)
    assert stiffness.q05 == pytest.approx(5.0 - 1.645 * 2.0, abs=0.4)
    # Nothing couples them, before forces or after.
    assert damping.contraction == 0.0
