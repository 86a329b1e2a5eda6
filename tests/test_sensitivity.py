"""Prior sensitivity: closed forms, fits from scratch, completeness, sentences, table, JSON and the command."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import MODEL, configuration
from rich.console import Console

from bayes_impedance import cli, sensitivity, terminal, training
from bayes_impedance.config import Config, Hyperparameter, load_config, replace_value, shipped_configurations
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError
from bayes_impedance.features import FeatureMap
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import save_model
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import LogScalePrior, build_force_model
from bayes_impedance.sensitivity import (
    MOVED,
    Change,
    Effect,
    Refit,
    Sensitivity,
    changes,
    in_sds,
    prior_sensitivity,
)
from bayes_impedance.simulation.generative import draw_force, repeated_motion

AXES = ("x", "y")


def changes_of(config: Config) -> list[Change]:
    return changes(build_force_model(config, FeatureMap(config, AXES)).entries)


def planned(config: Config, key: str) -> list[str]:
    return [change.description for change in changes_of(config) if change.key == key]


def drawn(config: Config, seed: int, repetitions: int = 2) -> PreparedLog:
    return draw_force(config, repeated_motion(repetitions, duration=3.0, rate=8.0, seed=seed), seed)


@dataclass(frozen=True)
class Case:
    """A fitted model with its sensitivity."""

    model: ImpedanceModel
    result: Sensitivity

    @property
    def config(self) -> Config:
        return self.model.config

    @property
    def log(self) -> PreparedLog:
        return self.model.fitted.log


def case(config: Config, log: PreparedLog) -> Case:
    model = ImpedanceModel(config).fit(log)
    return Case(model, prior_sensitivity(model))


def effects_of(result: Sensitivity, name: str) -> dict[str, Effect]:
    """Effects on one conclusion by label of the change."""
    return {
        refit.change.label: effect
        for refit in result.refits
        for effect in refit.effects
        if effect.name == name
    }


# --- what is changed -----------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "alpha"), [(2.0, 0.25), (0.5, 4.0)])
def test_scaling_log_sd_is_a_power_of_the_hyperprior(factor: float, alpha: float) -> None:
    h = torch.logspace(-3, 4, 50, dtype=torch.float64)
    median, log_sd = torch.tensor(300.0, dtype=torch.float64), torch.tensor(0.7, dtype=torch.float64)
    scaled = LogScalePrior(median, factor * log_sd).log_prob(h)
    powered = alpha * LogScalePrior(median, log_sd).log_prob(h)
    assert torch.allclose(scaled - powered, (scaled - powered)[0], atol=1e-10)


def hyperparameters(section: object, key: str) -> Iterator[tuple[str, Hyperparameter]]:
    """Every hyperparameter that stands in a configuration, by its key."""
    if isinstance(section, Hyperparameter):
        yield key, section
    elif hasattr(type(section), "model_fields"):
        for name in type(section).model_fields:
            yield from hyperparameters(getattr(section, name), f"{key}.{name}")


def acts(config: Config, key: str) -> bool:
    """Whether the model of this configuration has the hyperparameter that stands at `key`."""
    _, section, *rest = key.split(".")
    model = config.model
    if rest == ["shape"]:
        return model.desired_trajectory.kernel == "rational_quadratic"
    if rest == ["coupling"]:
        return model.axes == "coupled" and config.engine.impedance == "moments"
    if section == "mass" and rest in (["sd"], ["log_sd"]):
        return bool(model.mass.input) == (rest == ["log_sd"])
    if rest[:1] != ["length_scale"]:
        return True
    if section == "desired_trajectory":
        return rest[1] in model.trajectory_input.split("_")
    return rest[1] in getattr(model, section).input


@pytest.mark.parametrize("name", [*shipped_configurations(), "defaults"])
@pytest.mark.parametrize("kernel", ["squared_exponential", "rational_quadratic"])
def test_every_hyperparameter_that_acts_has_its_changes(name: str, kernel: str) -> None:
    config = Config() if name == "defaults" else load_config(name)
    config = replace_value(config, "model.desired_trajectory.kernel", kernel)
    standing = {key: spec for key, spec in hyperparameters(config.model, "model") if acts(config, key)}
    # The scale of a log_gp may be left out of the configuration.
    scales = {
        f"model.{latent}.log_sd": getattr(config.model, latent).scale for latent in ("stiffness", "damping")
    }
    found: dict[str, list[str]] = {}
    for change in changes_of(config):
        found.setdefault(change.key, []).append(change.quantity)
    for key, spec in {**scales, **standing}.items():
        expected = ["value"] * 2 if spec.fixed else ["median", "median", "log_sd", "log_sd"]
        assert found.pop(key) == expected, key
    assert found == {}


def flat(tree: object, key: str = "") -> dict[str, object]:
    if not isinstance(tree, dict):
        return {key: tree}
    return {
        k: v
        for name, branch in tree.items()
        for k, v in flat(branch, f"{key}.{name}" if key else name).items()
    }


@pytest.mark.parametrize("name", shipped_configurations())
def test_a_change_changes_one_prior_and_nothing_else(name: str) -> None:
    config = load_config(name)
    before = build_force_model(config, FeatureMap(config, AXES)).entries
    for change in changes_of(config):
        changed = replace_value(config, change.key, change.spec)
        one, two = flat(config.model_dump()), flat(changed.model_dump())
        differ = {key for key in {*one, *two} if one.get(key) != two.get(key)}
        assert differ == {f"{change.key}.{'log_sd' if change.quantity == 'log_sd' else 'median'}"}
        after = build_force_model(changed, FeatureMap(changed, AXES)).entries
        hit = {
            (entry.name, new.median / old.median, new.log_sd / old.log_sd)
            for entry, was in zip(after, before, strict=True)
            for new, old in zip(entry.specs, was.specs, strict=True)
            if new != old
        }
        ratio = change.after / change.before
        expected = (1.0, ratio) if change.quantity == "log_sd" else (ratio, 1.0)
        assert [item[1:] for item in hit] == [expected]
        assert all(change.key.startswith(f"model.{item[0]}") for item in hit)


@pytest.mark.parametrize(
    ("override", "key", "expected"),
    [
        (
            "model.stiffness.level={median: 300, log_sd: 1}",
            "model.stiffness.level",
            ["median 300 → 600 N/m", "median 300 → 150 N/m", "log_sd 1 → 2", "log_sd 1 → 0.5"],
        ),
        ("model.mass.sd=0.3", "model.mass.sd", ["value 0.3 → 0.6 kg", "value 0.3 → 0.15 kg"]),
        ("model.stiffness.log_sd=0.3", "model.stiffness.log_sd", ["value 0.3 → 0.5", "value 0.3 → 0.15"]),
        ("model.damping.log_sd=0.5", "model.damping.log_sd", ["value 0.5 → 0.25"]),
        (
            "model.noise_sd={median: 0.2, log_sd: 3}",
            "model.noise_sd",
            ["median 0.2 → 0.4 N", "median 0.2 → 0.1 N", "log_sd 3 → 5", "log_sd 3 → 1.5"],
        ),
        (
            "model.noise_sd={median: 0.2, log_sd: 5}",
            "model.noise_sd",
            ["median 0.2 → 0.4 N", "median 0.2 → 0.1 N", "log_sd 5 → 2.5"],
        ),
    ],
)
def test_changes_are_factors_of_two_within_the_limits_of_the_configuration(
    override: str, key: str, expected: list[str]
) -> None:
    assert planned(load_config("phase", [override]), key) == expected


def test_labels_name_key_and_factor() -> None:
    labels = {change.label for change in changes_of(load_config("phase", ["model.stiffness.log_sd=0.3"]))}
    assert "model.noise_sd.median × 2" in labels
    assert "model.noise_sd.log_sd ÷ 2" in labels
    assert "model.mass.sd × 2" in labels
    assert "model.stiffness.log_sd × 1.67" in labels


# --- what follows --------------------------------------------------------------------------------

#: Stiffness is the one unknown: Gaussian, constant, with x_d, damping and mass known.
REGRESSION = {
    "desired_trajectory": {**MODEL["desired_trajectory"], "sd": 1e-6},
    "stiffness": {"prior": "gp", "level": 100, "sd": 30},
    "damping": {"prior": "gp", "level": 9, "sd": 1e-10},
    "mass": {"level": 1.2, "sd": 1e-10},
    "residual": None,
    "noise_sd": 2.0,
}


def linear_regression(config: Config, log: PreparedLog, axis: int) -> tuple[float, float]:
    """Posterior mean and SD of k in u − d ė − m ë = k e + ε."""
    model = config.model
    e, de, dde, u = (np.concatenate(parts) for parts in zip(*[
        (
            trial.reference[:, axis] - trial.position[:, axis],
            trial.reference_velocity[:, axis] - trial.velocity[:, axis],
            trial.reference_acceleration[:, axis] - trial.acceleration[:, axis],
            trial.force[:, axis],
        )
        for trial in log.trials
    ], strict=True))  # fmt: skip
    rest = u - model.damping.level.median * de - model.mass.level.median * dde
    assert model.stiffness.sd is not None
    prior, noise = model.stiffness.sd.median**-2, model.noise_sd.median**-2
    precision = prior + noise * e @ e
    return (model.stiffness.level.median * prior + noise * e @ rest) / precision, precision**-0.5


@pytest.fixture(scope="module")
def regression() -> Case:
    config = configuration(**REGRESSION)
    return case(config, drawn(config, seed=5))


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize(
    "key",
    [
        "model.stiffness.level",
        "model.stiffness.sd",
        "model.damping.level",
        "model.mass.level",
        "model.noise_sd",
        "model.desired_trajectory.sd",
    ],
)
def test_conjugate_shift_equals_linear_regression(regression: Case, key: str, axis: str) -> None:
    config, log, result = regression.config, regression.log, regression.result
    mean, sd = linear_regression(config, log, AXES.index(axis))
    for refit in (refit for refit in result.refits if refit.change.key == key):
        expected, _ = linear_regression(replace_value(config, key, refit.change.spec), log, AXES.index(axis))
        effect = next(effect for effect in refit.effects if effect.name == f"stiffness {axis}{axis}")
        assert effect.before == pytest.approx(mean, rel=1e-6)
        assert effect.after == pytest.approx(expected, rel=1e-6)
        assert effect.difference == pytest.approx(expected - mean, abs=1e-4)
        assert effect.shift == pytest.approx(abs(expected - mean) / sd, abs=1e-5)


def test_what_the_configuration_fixes_is_no_conclusion(
    regression: Case,
) -> None:
    result = regression.result
    named = {effect.name for refit in result.refits for effect in refit.effects}
    assert named == {"stiffness xx", "stiffness yy", "desired position x", "desired position y"}
    assert all(refit.converged for refit in result.refits)


def test_log_likelihood_change_is_that_of_the_changed_configuration(
    regression: Case,
) -> None:
    config, log, result = regression.config, regression.log, regression.result
    base = ImpedanceModel(config).log_marginal_likelihood(log)
    for refit in result.refits:
        changed = ImpedanceModel(replace_value(config, refit.change.key, refit.change.spec))
        expected = changed.log_marginal_likelihood(log)
        for axis in AXES:
            assert refit.log_likelihood_change[axis] == pytest.approx(expected[axis] - base[axis], abs=1e-8)


def test_shift_of_the_desired_position_is_its_root_mean_square_over_samples() -> None:
    config = configuration()
    found = case(config, drawn(config, seed=3))
    before = found.model.posterior(found.log)["desired_position"]
    for refit in found.result.refits[::5]:
        changed = replace_value(config, refit.change.key, refit.change.spec)
        after = ImpedanceModel(changed).fit(found.log).posterior(found.log)["desired_position"]
        for a, axis in enumerate(AXES):
            effect = next(effect for effect in refit.effects if effect.name == f"desired position {axis}")
            distance = np.linalg.norm((after.mean - before.mean)[:, a])
            assert effect.shift == pytest.approx(distance / np.linalg.norm(before.sd[:, a]), rel=1e-6)
            assert effect.difference == pytest.approx(distance / math.sqrt(found.log.n_samples), rel=1e-6)
            assert (effect.support, effect.support_after) == (None, None)


#: Known intention, levels and noise to be learned.
LEARNED = {
    "stiffness": {"level": {"median": 150, "log_sd": 0.8}, "log_sd": 0.05},
    "damping": {"level": {"median": 15, "log_sd": 0.8}, "log_sd": 0.05},
    "mass": {"level": {"median": 2.0, "log_sd": 0.6}, "sd": 0.05},
    "desired_trajectory": {**MODEL["desired_trajectory"], "sd": 0.002},
    "residual": None,
    "noise_sd": {"median": 0.1, "log_sd": 1.0},
}


@pytest.fixture(scope="module")
def learned() -> Case:
    config = configuration(["training.restarts=1"], **LEARNED)
    truth = {**LEARNED, "stiffness": {"level": 100, "log_sd": 0.05}, "noise_sd": 0.2}
    return case(config, drawn(configuration(**truth), seed=2))


@pytest.mark.parametrize(
    "label",
    [
        "model.stiffness.level.median × 2",
        "model.damping.level.log_sd ÷ 2",
        "model.mass.sd × 2",
        "model.noise_sd.median ÷ 2",
        "model.desired_trajectory.sd × 2",
    ],
)
def test_warm_refit_equals_a_fit_from_scratch(learned: Case, label: str) -> None:
    config, log, result = learned.config, learned.log, learned.result
    refit = next(refit for refit in result.refits if refit.change.label == label)
    scratch = ImpedanceModel(replace_value(config, refit.change.key, refit.change.spec)).fit(log)
    posterior = scratch.posterior(log)
    for effect in refit.effects:
        if effect.latent is Latent.DESIRED_POSITION:
            continue
        marginal = posterior[effect.latent]
        a = AXES.index(effect.axis)
        sd = float((marginal.quantile(0.841) - marginal.quantile(0.5))[:, a].mean())
        assert effect.after == pytest.approx(float(marginal.quantile(0.5)[:, a].mean()), abs=0.03 * sd)
    likelihood = scratch.report.log_likelihood
    base = learned.model.report.log_likelihood
    for a, axis in enumerate(AXES):
        assert refit.log_likelihood_change[axis] == pytest.approx(likelihood[a] - base[a], abs=0.02)


def test_what_the_data_identify_is_robust_to_its_hyperprior(
    learned: Case,
) -> None:
    result = learned.result
    for name in ("stiffness xx", "stiffness yy", "mass xx", "mass yy"):
        key = f"model.{name[:-3]}.level"
        for label, effect in effects_of(result, name).items():
            if label.startswith(key):
                assert effect.shift < MOVED
                assert effect.support is effect.support_after is Support.SUPPORTED
    assert [effect for effect in result.drift if effect.shift > 0.03] == []
    assert result.remarks == []


def equilibrium(**model: object) -> Config:
    """The force is k (x_d − x) and noise: damping and mass are next to nothing."""
    trajectory = {**MODEL["desired_trajectory"], "mean": "equilibrium", "sd": {"median": 0.02, "log_sd": 1.0}}
    small = {"damping": {"level": 1e-3, "log_sd": 0.01}, "mass": {"level": 1e-5, "sd": 1e-6}}
    return configuration(
        trajectory_input="time", desired_trajectory=trajectory, residual=None, noise_sd=0.05, **small, **model
    )


def test_under_the_equilibrium_mean_stiffness_moves_exactly_with_its_median() -> None:
    config = equilibrium(stiffness={"level": 100, "log_sd": 0.3})
    result = case(config, drawn(configuration(), seed=1)).result
    for name in ("stiffness xx", "stiffness yy"):
        effects = effects_of(result, name)
        for factor, sign in (("× 2", 1), ("÷ 2", -1)):
            effect = effects[f"model.stiffness.level {factor}"]
            assert math.log(effect.after / effect.before) == pytest.approx(sign * math.log(2), rel=1e-9)
            assert effect.shift == pytest.approx(math.log(2) / 0.3, rel=1e-9)
            assert effect.support is effect.support_after is Support.PRIOR_ONLY
    said = next(sentence for sentence in result.sentences if sentence.startswith("stiffness xx"))
    assert said == "stiffness xx: prior only, so it follows its priors: model.stiffness.level (2.3 SD)."


def test_under_the_equilibrium_mean_a_learned_level_takes_its_share_of_the_product() -> None:
    """The force tells k σ_xd alone: k takes b² / (a² + b²) of a change of its log median, log-SDs a of k, b of σ_xd."""
    a, b = 0.5, 1.0
    config = equilibrium(stiffness={"level": {"median": 100, "log_sd": a}, "log_sd": 0.01})
    known = equilibrium(stiffness={"level": 100, "log_sd": 0.01})
    result = case(config, drawn(replace_value(known, "model.desired_trajectory.sd", 0.02), seed=1)).result
    share = b**2 / (a**2 + b**2)
    for name in ("stiffness xx", "stiffness yy"):
        for factor in ("× 2", "÷ 2"):
            effect = effects_of(result, name)[f"model.stiffness.level.median {factor}"]
            assert effect.shift == pytest.approx(share * math.log(2) / math.hypot(a, 0.01), abs=0.01)


# --- refits that fail, or do not end -------------------------------------------------------------


def test_one_refit_that_fails_is_survived(regression: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = regression.result
    fit = ImpedanceModel.fit

    def failing(self: ImpedanceModel, *arguments: object, **options: object) -> ImpedanceModel:
        if self.config.model.noise_sd.median < 2.0:
            raise NotPositiveDefiniteError("no factor [here]")
        return fit(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImpedanceModel, "fit", failing)
    result = prior_sensitivity(regression.model)
    failed = [refit for refit in result.refits if refit.failure is not None]
    assert [(refit.change.label, refit.failure, refit.effects) for refit in failed] == [
        ("model.noise_sd ÷ 2", "no factor [here]", ())
    ]
    assert [r for r in result.refits if r.failure is None] == [
        r for r in whole.refits if r.change.label != "model.noise_sd ÷ 2"
    ]
    assert "no refit: no factor [here]" in printed(result, 100)
    assert any(
        f"the {len(whole.refits) - 1} fitted of {len(whole.refits)} changes" in s for s in result.sentences
    )
    json.dumps(result.as_json(), allow_nan=False)


def test_refits_do_not_restart(regression: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    assert regression.config.training.restarts > 1
    fit, seen = ImpedanceModel.fit, []

    def watched(self: ImpedanceModel, *arguments: object, **options: object) -> ImpedanceModel:
        seen.append((self.config.training.restarts, options["start"] is not None))
        return fit(self, *arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(ImpedanceModel, "fit", watched)
    prior_sensitivity(regression.model)
    assert seen == [(1, True)] * (1 + len(regression.result.refits))


def test_training_that_had_not_converged_is_not_taken_for_sensitivity(learned: Case) -> None:
    hasty = replace_value(learned.config, "training.max_iterations", 1)
    short = ImpedanceModel(hasty).fit(learned.log)
    patient = replace_value(learned.config, "training.max_iterations", 200)
    result = prior_sensitivity(ImpedanceModel(patient, short.fitted))
    assert any(effect.moved for effect in result.drift)
    assert result.remarks[0].startswith(
        "Training had not converged: more of it, under the same priors, moves "
    )
    settled = {effect.name: effect.before for effect in learned.result.refits[0].effects}
    for name in ("stiffness xx", "mass yy"):
        for effect in effects_of(result, name).values():
            assert effect.before == pytest.approx(settled[name], rel=2e-3)
    unfinished = prior_sensitivity(short)
    assert "refits had not converged" in unfinished.remarks[-1]


def test_an_unfitted_model_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="expected a fitted model"):
        prior_sensitivity(ImpedanceModel(configuration()))


def test_ctrl_c_in_the_middle_ends_it(tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    objective, seen = training.objective, 0

    def interrupting(*arguments: object) -> object:
        nonlocal seen
        seen += 1
        if seen == 12:
            raise KeyboardInterrupt
        return objective(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(training, "objective", interrupting)
    done: list[tuple[int, int, str]] = []
    with pytest.raises(KeyboardInterrupt):
        prior_sensitivity(tiny.fitted, lambda *state: done.append(state))
    assert 0 < len(done) < 5
    assert done[0] == (0, len(changes(tiny.fitted.hyperparameters)), "model.stiffness.level.median × 2")


# --- starting where a model stands ---------------------------------------------------------------


def test_a_start_is_where_training_begins_and_is_left_alone(
    learned: Case,
) -> None:
    config, log, model = learned.config, learned.log, learned.model
    values = [entry.raw.detach().clone() for entry in model.hyperparameters]
    seen: list[float] = []
    again = ImpedanceModel(replace_value(config, "training.max_iterations", 1)).fit(
        log, lambda _, __, objective: seen.append(objective), start=model
    )
    assert all(value >= sum(model.report.objective) - 1e-9 for value in seen)
    assert again.report.log_sd == {}
    assert all(
        torch.equal(value, entry.raw) for value, entry in zip(values, model.hyperparameters, strict=True)
    )


def test_a_start_gives_nothing_to_what_is_fixed(learned: Case) -> None:
    config, log, model = learned.config, learned.log, learned.model
    fixed = ImpedanceModel(replace_value(config, "model.noise_sd", 0.7)).fit(log, start=model)
    value = next(entry.value for entry in fixed.hyperparameters if entry.name == "noise_sd")
    assert value.flatten().tolist() == pytest.approx([0.7, 0.7])


def test_a_start_of_another_structure_is_refused(learned: Case) -> None:
    config, log = learned.config, learned.log
    other = ImpedanceModel(configuration()).fit(log)
    with pytest.raises(
        ConfigurationError, match="expected a start with the hyperparameters .* same structure"
    ):
        ImpedanceModel(config).fit(log, start=other)


# --- what is said --------------------------------------------------------------------------------


def effect(
    shift: float,
    support: Support = Support.SUPPORTED,
    after: Support | None = None,
    latent: Latent = Latent.STIFFNESS,
) -> Effect:
    return Effect(latent, "x", 100.0, 110.0, 10.0, shift, support, after or support)


def refit(key: str, *effects: Effect, after: float = 2.0, **more: object) -> Refit:
    change = Change(key, "log_sd", 1.0, after, "1", Hyperparameter(median=1.0, log_sd=after))
    return replace(Refit(change, effects, {"x": 0.5}, converged=True), **more)


def test_sentences_list_what_a_conclusion_rests_on_strongest_first() -> None:
    result = Sensitivity(
        (
            refit("model.mass.sd", effect(0.7)),
            refit("model.mass.level", effect(1.31)),
            refit("model.mass.level", effect(0.8), after=0.5),
            refit("model.noise_sd", effect(0.2, after=Support.WEAK)),
            refit("model.residual.sd", effect(MOVED)),
        ),
        (),
    )
    assert result.sentences == [
        "stiffness xx: rests on model.mass.level (1.3 SD), model.mass.sd (0.7 SD), "
        "model.noise_sd (0.2 SD, then weakly supported)."
    ]


def test_sentences_on_robust_and_prior_only_conclusions() -> None:
    mass = {"latent": Latent.MASS, "support": Support.PRIOR_ONLY}
    damping = {"latent": Latent.DAMPING, "support": Support.PRIOR_ONLY}
    result = Sensitivity(
        (
            refit("model.mass.sd", effect(0.12), effect(0.001, **mass), effect(2.0, **damping)),
            refit("model.mass.level", effect(0.05), effect(0.0001, **mass), effect(0.1, **damping)),
        ),
        (),
    )
    assert result.sentences == [
        "stiffness xx: robust to all 2 changes (largest 0.12 SD, by model.mass.sd.log_sd × 2).",
        "mass xx: prior only, and so uncertain that all 2 changes stay within its interval (largest < 0.01 SD, by "
        "model.mass.sd.log_sd × 2).",
        "damping xx: prior only, so it follows its priors: model.mass.sd (2 SD).",
    ]


def test_a_shift_is_said_with_two_digits() -> None:
    assert [in_sds(s) for s in (0.0, 0.0099, 0.01, 0.123, 1.26, 12.6)] == [
        "< 0.01 SD", "< 0.01 SD", "0.01 SD", "0.12 SD", "1.3 SD", "13 SD",
    ]  # fmt: skip


def test_remarks_tell_training_that_had_not_converged() -> None:
    drifting = Sensitivity(
        (refit("model.mass.sd", effect(0.1), converged=False),), (effect(0.8), effect(0.1))
    )
    assert drifting.remarks == [
        "Training had not converged: more of it, under the same priors, moves stiffness xx (0.8 SD); train again "
        "with a larger training.max_iterations.",
        "1 of 1 refits had not converged, so what they moved may be less or more: train with a larger "
        "training.max_iterations.",
    ]
    assert Sensitivity((refit("model.mass.sd", effect(0.1)),), (effect(0.1),)).remarks == []


def printed(result: Sensitivity, width: int) -> str:
    stream = io.StringIO()
    terminal.print_sensitivity(Console(file=stream, width=width), result)
    return stream.getvalue()


MOVING = Sensitivity(
    (
        refit("model.residual.sd", effect(0.1)),
        refit("model.mass.level", effect(9.0, Support.PRIOR_ONLY)),
        refit("model.mass.sd", effect(0.7), converged=False),
        refit("model.desired_trajectory.length_scale.position", effect(1.3, after=Support.WEAK)),
        refit("model.noise_sd", failure="no factor"),
    ),
    (),
)  # fmt: skip


@pytest.mark.parametrize("width", [80, 100, 140])
def test_table_holds_what_moves_largest_first_and_fits(width: int) -> None:
    text = printed(MOVING, width)
    table = text.split("└")[0]
    assert max(map(len, text.splitlines())) <= width
    # What only its prior knows comes after what the data carry, however far it moves.
    order = ["length_scale.position", "model.mass.sd", "model.mass.level", "model.noise_sd"]
    assert sorted(order, key=table.index) == order
    assert "model.residual.sd" not in table
    words = " ".join(table.replace("│", " ").split())
    assert "100 → 110 N/m (supported → weak) 1.3 SD" in words or width < 100
    for mention in ("log_sd 1 → 2", "(not converged)", "1.3 SD", "no refit: no factor", "100 → 110 N/m"):
        assert mention in words


def test_nothing_moved_means_no_table() -> None:
    text = printed(Sensitivity((refit("model.residual.sd", effect(0.1)),), ()), 100)
    assert (
        text == "  stiffness xx: robust to all 1 changes (largest 0.1 SD, by model.residual.sd.log_sd × 2).\n"
    )


def test_desired_position_is_told_by_its_root_mean_square() -> None:
    moved = Effect(Latent.DESIRED_POSITION, "x", 0.1, 0.1, 0.0012, 1.5)
    text = printed(Sensitivity((refit("model.mass.sd", moved),), ()), 140)
    assert "desired position x" in text
    assert "by 0.0012 m rms" in text


# --- the command ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(learned: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("sensitivity") / "model"
    save_model(learned.model, place)
    return place


def test_json_is_plain_complete_and_finite(learned: Case) -> None:
    tree = json.loads(json.dumps(learned.result.as_json(), allow_nan=False))
    assert tree == learned.result.as_json()
    assert [item["prior"] for item in tree["changes"]] == [
        c.key for c in changes(learned.model.hyperparameters)
    ]
    names = {f"{name}_{axis}{axis}" for name in ("stiffness", "damping", "mass") for axis in AXES}
    names |= {f"desired_position_{axis}" for axis in AXES}
    for item in tree["changes"]:
        assert set(item["conclusions"]) == names
        assert set(item["log_likelihood_change"]) == set(AXES)
        for found in item["conclusions"].values():
            assert found["moved"] == (found["shift"] > MOVED or found["verdict"] != found["verdict_after"])


def test_show_as_json_holds_the_same_to_the_last_bit(command, folder: Path, learned: Case) -> None:
    done = command("show", folder, "--sensitivity", "--json")
    assert (done.code, done.err) == (0, "")
    shown = json.loads(done.out)
    assert shown.pop("sensitivity") == learned.result.as_json()
    assert shown == json.loads(command("show", folder, "--json").out)


def test_show_prints_it_after_the_rest(command, folder: Path, learned: Case, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "140")
    monkeypatch.setattr(cli, "prior_sensitivity", lambda model, progress: learned.result)
    without, done = command("show", folder), command("show", folder, "--sensitivity")
    assert (done.code, done.err) == (0, "")
    assert done.out.startswith(without.out)
    words = " ".join(done.out[len(without.out) :].split())
    assert all(sentence in words for sentence in learned.result.sentences)


def test_help_says_how_long_it_takes(command) -> None:
    text = " ".join(command("show", "--help").out.replace("│", " ").split())
    assert "--sensitivity" in text
    assert "some 50 refits" in text


@pytest.mark.parametrize("options", [(), ("--json",)])
def test_ctrl_c_of_the_command(command, folder: Path, monkeypatch, options: tuple[str, ...]) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(sensitivity, "_refit", interrupted)
    done = command("show", folder, "--sensitivity", *options)
    assert (done.code, done.err) == (130, "interrupted; no file was left half written\n")
    assert (done.out == "") == bool(options)


def test_progress_counts_changes() -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=True, width=100)
    with terminal.sensitivity_progress(console) as hook:
        hook(2, 38, "model.noise_sd.median × 2")
    assert "3/38 model.noise_sd.median × 2" in stream.getvalue()
