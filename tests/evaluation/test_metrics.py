"""Scores against the formulas of Rasmussen & Williams §2.5."""

import json
import math

import numpy as np
import pytest

from bayes_impedance.evaluation.metrics import Prediction, pooled_score, score, varies


def predictions(n: int = 200, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    generator = np.random.default_rng(seed)
    mean, sd = generator.normal(2.0, 3.0, n), generator.uniform(0.2, 1.5, n)
    force = mean + 1.3 * sd * generator.standard_normal(n)
    return mean, sd, force, generator.normal(1.5, 3.5, 500)


def negative_log_density(u: float, mean: float, sd: float) -> float:
    return 0.5 * math.log(2.0 * math.pi * sd**2) + (u - mean) ** 2 / (2.0 * sd**2)


def test_scores_equal_direct_formulas() -> None:
    mean, sd, force, training = predictions()
    n = len(force)
    scores = score(mean, sd, force, training)
    test_mean = sum(force) / n
    squared = [(u - m) ** 2 for u, m in zip(force, mean, strict=True)]
    variance = sum((u - test_mean) ** 2 for u in force) / n
    assert scores.smse == pytest.approx(sum(squared) / n / variance)
    loss = [negative_log_density(*values) for values in zip(force, mean, sd, strict=True)]
    training_mean = sum(training) / len(training)
    training_sd = math.sqrt(sum((u - training_mean) ** 2 for u in training) / len(training))
    trivial = [negative_log_density(u, training_mean, training_sd) for u in force]
    assert scores.nlpd == pytest.approx(sum(loss) / n)
    assert scores.msll == pytest.approx(sum(loss) / n - sum(trivial) / n)
    inside = [abs(u - m) <= 1.6448536269514722 * s for u, m, s in zip(force, mean, sd, strict=True)]
    assert scores.coverage90 == sum(inside) / n
    assert scores.n == n


def test_trivial_predictor_scores_nought() -> None:
    _, _, force, training = predictions()
    scores = score(np.full_like(force, training.mean()), np.full_like(force, training.std()), force, training)
    assert scores.msll == pytest.approx(0.0, abs=1e-14)


def test_predicting_the_mean_of_the_test_forces_has_unit_smse() -> None:
    _, sd, force, training = predictions()
    assert score(np.full_like(force, force.mean()), sd, force, training).smse == pytest.approx(1.0)


def test_coverage_of_right_predictions_is_nominal() -> None:
    generator = np.random.default_rng(1)
    n = 20_000
    mean, sd = generator.normal(size=n), generator.uniform(0.5, 2.0, n)
    force = mean + sd * generator.standard_normal(n)
    coverage = score(mean, sd, force, force).coverage90
    assert abs(coverage - 0.9) < 4.0 * math.sqrt(0.9 * 0.1 / n)


def test_pooled_scores_are_those_of_every_sample() -> None:
    """Parts of different size; each has trivial predictions of its own."""
    first, second = predictions(200, seed=0), predictions(50, seed=1)
    pooled = pooled_score([Prediction(*first), Prediction(*second)])
    each = [score(*first), score(*second)]
    assert pooled.n == 250
    for name in ("msll", "nlpd", "coverage90"):
        expected = (200 * getattr(each[0], name) + 50 * getattr(each[1], name)) / 250
        assert getattr(pooled, name) == pytest.approx(expected)
    squares = sum(
        scores.smse * np.var(part[2]) * scores.n for scores, part in zip(each, (first, second), strict=True)
    )
    assert pooled.smse == pytest.approx(squares / 250 / np.var(np.concatenate([first[2], second[2]])))


@pytest.mark.parametrize("force", [np.zeros(5), np.full(5, 3.0), 3.0 + 1e-12 * np.arange(5)])
def test_smse_is_undefined_where_force_does_not_vary(force: np.ndarray) -> None:
    mean, sd, _, training = predictions(5)
    assert not varies(force)
    scores = score(mean, sd, force, training)
    assert math.isnan(scores.smse)
    assert math.isfinite(scores.msll)
    assert varies(force + 1e-6 * np.arange(5))


def test_scores_are_json_of_plain_numbers() -> None:
    mean, sd, force, training = predictions()
    content = json.loads(json.dumps(score(mean, sd, force, training).as_dict()))
    assert set(content) == {"smse", "msll", "nlpd", "coverage90", "n"}
    assert content["n"] == 200
