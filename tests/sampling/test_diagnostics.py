"""Every sentence of the diagnostics, provoked; and numbers that are those of ArviZ, or missing."""

import json

import numpy as np
import pytest
from arviz_stats.base import array_stats

from bayes_impedance.sampling.diagnostics import diagnose
from bayes_impedance.sampling.draws import Draws

NAMES = ("mass", "noise_sd", "stiffness_weights[0]", "stiffness_weights[1]", "damping_weights[0]")


def white(chains=4, count=500, seed=0):
    return np.random.default_rng(seed).standard_normal((chains, count, len(NAMES)))


def nuts(standard=None, lost=(), **stats):
    standard = white() if standard is None else standard
    shape = standard.shape[:2]
    sound = {
        "lp": np.zeros(shape),
        "diverging": np.zeros(shape, dtype=bool),
        "n_steps": np.full(shape, 7),
        "energy": np.random.default_rng(1).standard_normal(shape),
    }
    return Draws("nuts", standard, {**sound, **stats}, lost=lost)


def approximate(standard=None, pareto_k=0.3, method="laplace", remarks=()):
    standard = white(1, 1000) if standard is None else standard
    return Draws(method, standard, {"lp": np.zeros(standard.shape[:2])}, pareto_k, remarks=remarks)


def walk(seed=2, chains=4, count=500, correlation=0.99):
    """A coordinate that moves slowly, with its stationary spread."""
    generator = np.random.default_rng(seed)
    values = generator.standard_normal((chains, count))
    for i in range(1, count):
        values[:, i] = correlation * values[:, i - 1] + np.sqrt(1 - correlation**2) * values[:, i]
    return values


def only(diagnosis):
    (sentence,) = diagnosis.findings
    assert not diagnosis.is_sound
    return sentence


def test_independent_draws_are_sound():
    draws = nuts()
    found = diagnose(draws, NAMES)
    assert found.is_sound and found.findings == ()
    assert (found.method, found.names, found.chains, found.draws) == ("nuts", NAMES, 4, 500)
    assert (found.divergences, found.saturated, found.pareto_k, found.lost) == (0, 0.0, None, ())
    for i in range(len(NAMES)):
        x = draws.standard[..., i]
        assert found.rhat[i] == pytest.approx(float(array_stats.rhat(x, method="rank")))
        assert found.ess_bulk[i] == pytest.approx(float(array_stats.ess(x, method="bulk")))
        assert found.ess_tail[i] == pytest.approx(float(array_stats.ess(x, method="tail", prob=(0.05, 0.95))))
    # Ratio of squared differences to the variance, two for white energies.
    np.testing.assert_allclose(found.e_bfmi, 2.0, atol=5 * np.sqrt(12.0 / 500))


def test_chains_apart_are_named_worst_first():
    standard = white()
    for name, shift in ((0, 1.0), (2, 3.0), (3, 2.0), (4, 0.7)):
        standard[0, :, name] += shift
    found = diagnose(nuts(standard), NAMES)
    rhat = next(line for line in found.findings if line.startswith("R-hat is"))
    assert "for stiffness_weights[0], " in rhat and rhat.index("weights[0]") < rhat.index("weights[1]")
    assert "for mass and 1 more, above 1.01: chains have not come to one posterior" in rhat
    assert "set sampling.draws and sampling.warmup higher, and plot the chains: those that stay apart" in rhat
    assert found.rhat[1] < 1.01 < found.rhat[2]


def test_few_effective_draws_say_how_many_are_needed():
    standard = white()
    standard[..., 1] = walk()
    found = diagnose(nuts(standard), NAMES)
    bulk = next(line for line in found.findings if line.startswith("bulk ESS"))
    value = found.ess_bulk[1]
    assert (
        f"bulk ESS is {value:.0f} for noise_sd, below 400 (100 a chain): means and SDs are not yet exact"
        in bulk
    )
    assert f"set sampling.draws to {int(np.ceil(400 / value)) * 500}" in bulk
    tail = next(line for line in found.findings if line.startswith("tail ESS"))
    assert "for noise_sd, below 400 (100 a chain): 5 and 95 % quantiles are not yet exact" in tail


def test_least_ess_is_of_each_chain():
    assert diagnose(nuts(white(2)), NAMES).least_ess == 200


def test_divergences():
    diverging = np.zeros((4, 500), dtype=bool)
    diverging[2, 3] = True
    sentence = only(diagnose(nuts(diverging=diverging), NAMES))
    assert sentence.startswith(
        "1 of 2000 draws diverged: the posterior has corners that the chains cannot enter"
    )
    assert (
        "set sampling.target_acceptance nearer 1 (.95, then .99), and check that no prior under model"
        in sentence
    )


def test_trees_that_end_at_their_largest_depth():
    steps = np.full((4, 500), 7)
    steps[0] = 2**5 - 1
    found = diagnose(nuts(n_steps=steps), NAMES, max_tree_depth=5)
    assert found.saturated == 0.25
    sentence = only(found)
    assert "25% of iterations ended at the largest tree depth 5: the posterior is longer in some" in sentence
    assert (
        "direction than steps reach; set sampling.warmup higher, then sampling.max_tree_depth to 6"
        in sentence
    )
    assert diagnose(nuts(n_steps=steps), NAMES).is_sound


def test_energies_that_hardly_change():
    energy = np.random.default_rng(1).standard_normal((4, 500))
    energy[1] = np.cumsum(energy[1])
    sentence = only(diagnose(nuts(energy=energy), NAMES))
    assert (
        sentence.startswith("E-BFMI is 0.")
        and "for chain 1, below 0.3: tails of the posterior are hardly" in sentence
    )
    assert (
        "visited; set sampling.warmup higher, and check that no prior under model is wider than" in sentence
    )


def test_lost_chains_are_told():
    sentence = only(diagnose(nuts(lost=("chain 3: out of memory",)), NAMES))
    assert sentence.startswith("a chain died (chain 3: out of memory), and the draws are those of the others")
    assert sentence.endswith("sample again with another sampling.seed")


def test_no_chain_is_left():
    empty = nuts(np.zeros((0, 500, len(NAMES))), lost=("killed",))
    found = diagnose(empty, NAMES)
    assert found.findings[1].startswith("no chain is left to say anything of; check the priors under model")
    assert set(found.rhat) == {None}
    json.dumps(found.as_dict(), allow_nan=False)


def test_one_chain_has_no_rhat_and_says_so():
    found = diagnose(nuts(white(1)), NAMES)
    assert only(found).startswith(
        "one chain cannot be compared with others, which is what R-hat does; set sampling.chains"
    )
    assert found.rhat == (None,) * len(NAMES) and None not in found.ess_bulk


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_too_few_draws_are_told(count):
    found = diagnose(nuts(white(4, count)), NAMES)
    assert (
        f"{count} draws a chain are too few for R-hat and ESS; set sampling.draws to 100 or more"
        in found.findings
    )
    assert found.rhat == found.ess_bulk == found.ess_tail == (None,) * len(NAMES)
    assert set(found.e_bfmi) == {None} and not found.stuck
    json.dumps(found.as_dict(), allow_nan=False)


@pytest.mark.parametrize("chains", [1, 2, 4])
@pytest.mark.parametrize("count", [4, 5, 6, 7, 9, 20])
def test_few_draws_never_give_nan(chains, count):
    for seed in range(5):
        found = diagnose(nuts(white(chains, count, seed)), NAMES)
        values = [v for each in (found.rhat, found.ess_bulk, found.ess_tail, found.e_bfmi) for v in each]
        assert all(value is None or np.isfinite(value) for value in values)
        assert not found.is_sound and not any("nan" in line for line in found.findings)


def test_a_chain_that_never_moved():
    standard = white()
    standard[3] = standard[3, :1]
    found = diagnose(nuts(standard), NAMES)
    assert any(
        line.startswith(
            "chain 3 never moved; set sampling.target_acceptance nearer 1, sampling.warmup longer"
        )
        for line in found.findings
    )
    assert found.stuck == (3,) and found.still == ()


def test_no_chain_moved():
    found = diagnose(nuts(np.repeat(white(4, 1), 100, axis=1)), NAMES)
    assert found.stuck == (0, 1, 2, 3) and len(found.findings) == 4
    json.dumps(found.as_dict(), allow_nan=False)


def test_a_coordinate_that_never_moved():
    standard = white()
    standard[..., 1] = 0.5
    found = diagnose(nuts(standard), NAMES)
    assert only(found).startswith(
        "noise_sd never moved in any chain; sample again with another sampling.seed"
    )
    assert found.rhat[1] is None and found.ess_bulk[1] is None and found.rhat[0] is not None


def test_energies_that_are_not_finite_are_no_crash():
    found = diagnose(nuts(energy=np.full((4, 500), np.inf)), NAMES)
    assert found.e_bfmi == (None,) * 4


def test_an_approximation_is_sound_without_rhat_and_divergences():
    found = diagnose(approximate(), NAMES)
    assert found.is_sound and found.divergences is None and found.rhat == (None,) * len(NAMES)
    assert found.ess_bulk == (1000.0,) * len(NAMES) and found.pareto_k == 0.3


@pytest.mark.parametrize("method", ["laplace", "svi"])
def test_a_large_k_is_not_to_be_trusted(method):
    sentence = only(diagnose(approximate(pareto_k=1.234, method=method), NAMES))
    assert (
        f"Pareto k is 1.23, above 0.7: {method} is too far from the posterior to be corrected by weights"
        in sentence
    )
    assert sentence.endswith("cannot be trusted; use sampling.method=nuts")


def test_copies_count_for_what_they_are_worth():
    distinct = white(1, 300)
    standard = np.concatenate([distinct, np.repeat(distinct[:, :1], 700, axis=1)], axis=1)
    sentence = only(diagnose(approximate(standard), NAMES))
    worth = 1000**2 / (299 + 701**2)
    assert (
        f"the 1000 draws are worth {worth:.0f} independent ones, fewer than 400: copies of few proposals"
        in sentence
    )
    assert "set sampling.draws higher, and if that does not help sampling.method=nuts" in sentence


def test_few_draws_of_an_approximation():
    assert "3 draws are too few for any diagnostics; set sampling.draws to 100 or more" in only(
        diagnose(approximate(white(1, 3)), NAMES)
    )


def test_an_approximation_of_one_point():
    found = diagnose(approximate(np.repeat(white(1, 1), 100, axis=1)), NAMES)
    assert only(found).startswith("mass, noise_sd, stiffness_weights[0] and 2 more are the same in all draws")


def test_remarks_are_findings():
    assert (
        only(diagnose(approximate(remarks=("the fit has not settled",)), NAMES)) == "the fit has not settled"
    )


def test_summary_holds_numbers_and_sentences_only():
    standard = white()
    standard[0, :, 2] += 3.0
    diverging = np.ones((4, 500), dtype=bool)
    found = diagnose(nuts(standard, lost=("killed",), diverging=diverging), NAMES)
    summary = found.as_dict()
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["rhat_max_of"] == "stiffness_weights[0]" and summary["rhat_max"] == max(found.rhat)
    assert summary["ess_bulk_min"] == min(found.ess_bulk) and summary["e_bfmi_min"] == min(found.e_bfmi)
    assert (summary["divergences"], summary["is_sound"], summary["lost_chains"]) == (2000, 0, ["killed"])
    assert summary["findings"] == list(found.findings) and "pareto_k" not in summary
    assert diagnose(approximate(), NAMES).as_dict() == {
        "method": "laplace",
        "chains": 1,
        "draws": 1000,
        "is_sound": 1,
        "ess_bulk_min_of": "mass",
        "ess_bulk_min": 1000.0,
        "ess_tail_min_of": "mass",
        "ess_tail_min": 1000.0,
        "pareto_k": 0.3,
    }
