"""Posteriors with `engine.name: local` against dense ones: exact with one cell, near with many."""

from dataclasses import replace

import numpy as np
import pytest
from streams import SHARED, model_of

from bayes_impedance.config import load_config
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap, LogFeatures, label_trials, labels_of
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.posterior import conditioning
from bayes_impedance.posterior.independent import IndependentPrior
from bayes_impedance.posterior.local import LocalConditioner, infer_local
from bayes_impedance.trajectory_mean import TrajectoryMean

MEAN = "model.desired_trajectory.mean"


def with_engine(model, name, **local):
    """The same fit with another engine."""
    engine = model.config.engine
    engine = engine.model_copy(
        update={
            "name": name,
            "local": engine.local.model_copy(update={"novelty": 0.0, "inducing": 300, **local}),
        }
    )
    return ImpedanceModel(model.config.model_copy(update={"engine": engine}), model.fitted)


def one_cell(model):
    """A grid so wide that its middle cell holds every motion."""
    components = {
        "position_velocity": {"position": 50.0, "velocity": 50.0}, "position": {"position": 50.0},
        "phase": {"phase": 50.0}, "time": {"time": 500.0},
    }  # fmt: skip
    return with_engine(model, "local", active=1, width=components[model.config.model.trajectory_input])


def assert_same(found, expected, latents=tuple(Latent), relative=1e-6):
    for latent in latents:
        one, other = found[latent.value], expected[latent.value]
        assert one.warped is other.warped
        for a, b in ((one.location, other.location), (one.prior_location, other.prior_location)):
            assert np.abs(a - b).max() <= relative * np.abs(b).max(), latent
        # A variance is a difference of the prior's and of what is known; the prior says to how many digits.
        prior = (other.prior_scale**2).max()
        assert np.abs(one.prior_scale**2 - other.prior_scale**2).max() <= relative * prior, latent
        assert np.abs(one.scale**2 - other.scale**2).max() <= relative * prior, latent
        assert one.scale == pytest.approx(other.scale, rel=1e-3), latent


CASES = [
    ("position_velocity", (SHARED,)),
    ("position_velocity", (SHARED, f"{MEAN}=reference")),
    ("position_velocity", (f"{MEAN}=constant", "model.drop_acceleration=true")),
    ("position", (f"{MEAN}=reference",)),
    ("phase", ()),
    ("phase", (SHARED, "model.residual.offset_sd=0.5")),
    ("phase", ("model.desired_trajectory.kernel=matern52", f"{MEAN}=reference")),
    ("phase", ("shared.desired_trajectory=false", "model.residual=null")),
    ("time", ()),
]


@pytest.fixture(scope="module", params=CASES, ids=lambda case: ",".join((case[0], *case[1])))
def model(request):
    return model_of(request.param[0], request.param[1])


@pytest.mark.parametrize("given", ["training", "both", "log"])
def test_one_cell_is_dense_for_every_latent(model, given):
    """Levels are learned, so their uncertainty is in every variance."""
    log = model.fitted.log
    target = log.with_trials(
        [replace(log.trials[1], name="new", force=None if given != "log" else log.trials[1].force)]
    )
    found = one_cell(model).posterior(target, given)
    expected = with_engine(model, "dense").posterior(target, given)
    assert_same(found, expected)
    assert found["force"].mean.shape == expected["force"].mean.shape


def test_levels_widen_what_depends_on_them():
    """Against the same hyperparameters with levels that are known."""
    overrides = (SHARED, f"{MEAN}=reference")
    levels = ("model.stiffness.level=300", "model.damping.level=20", "model.mass.level=1.5")
    free, known = model_of("phase", overrides), model_of("phase", (*overrides, *levels))
    assert known.config.model.stiffness.level.fixed
    found = one_cell(free).posterior(free.fitted.log, "training")
    certain = one_cell(known).posterior(known.fitted.log, "training")
    assert_same(certain, with_engine(known, "dense").posterior(known.fitted.log, "training"))
    # log_sd of the level is 1, of the process .3 or so.
    assert (found["stiffness"].prior_scale > 1.0).all()
    assert (certain["stiffness"].prior_scale < 0.6).all()
    assert (found["stiffness"].scale < found["stiffness"].prior_scale).all()


def test_many_cells_are_near_to_dense():
    model = model_of("phase", (SHARED, f"{MEAN}=reference"), n=80)
    found = with_engine(model, "local", active=3).posterior(model.fitted.log, "training", [Latent.FORCE])
    expected = with_engine(model, "dense").posterior(model.fitted.log, "training", [Latent.FORCE])
    difference = np.abs(found["force"].mean - expected["force"].mean)
    # A cell knows less than all samples do, and its mean is that much off at most, by its own account.
    assert (difference <= 3.0 * found["force"].sd).all()
    assert np.median(difference / found["force"].sd) < 0.3


def test_only_what_is_asked_for():
    model = one_cell(model_of("position", (SHARED,)))
    found = model.posterior(model.fitted.log, "training", [Latent.STIFFNESS])
    assert set(found.marginals) == {Latent.STIFFNESS}
    with pytest.raises(KeyError):
        found["force"]


# --- groups ------------------------------------------------------------------------------------------


def test_each_group_is_conditioned_on_its_own_forces():
    model = model_of("phase", (SHARED,), groups=("ada", "bob"))
    found = one_cell(model).posterior(model.fitted.log, "training")
    assert_same(found, with_engine(model, "dense").posterior(model.fitted.log, "training"))


def test_groups_of_unequal_length():
    model = model_of("phase", (SHARED,), groups=("ada", "bob"))
    log = model.fitted.log
    uneven = log.with_trials([log.trials[0].part(slice(0, 13)), *log.trials[1:]])
    model = ImpedanceModel(model.config, replace(model.fitted, log=uneven))
    found = one_cell(model).posterior(uneven, "training")
    assert_same(found, with_engine(model, "dense").posterior(uneven, "training"))


def test_a_sample_without_force_teaches_nothing():
    model = model_of("phase", (SHARED,))
    log = model.fitted.log
    force = log.trials[0].force.copy()
    force[3:9] = np.nan
    part = log.with_trials([replace(log.trials[0], force=force), log.trials[1]])
    model = ImpedanceModel(model.config, replace(model.fitted, log=part))
    found = one_cell(model).posterior(part, "training")
    assert_same(found, with_engine(model, "dense").posterior(part, "training"))


def test_a_group_that_is_not_given_keeps_its_prior():
    model = model_of("position", (SHARED,), groups=("ada", "bob"))
    log = model.fitted.log
    bob = log.with_trials([trial for trial in log.trials if trial.group == "bob"])
    local = one_cell(ImpedanceModel(model.config, replace(model.fitted, log=bob)))
    forceless = log.with_trials([replace(trial, force=None) for trial in log.trials])
    found = local.posterior(forceless, "training")
    ada = slice(0, 40)
    for latent in Latent:
        marginal = found[latent.value]
        assert marginal.scale[ada] == pytest.approx(marginal.prior_scale[ada])
    assert (found["force"].scale[40:] < found["force"].prior_scale[40:]).all()


def test_without_any_force_all_is_prior():
    model = one_cell(model_of("position", (SHARED,)))
    log = model.fitted.log
    forceless = log.with_trials([replace(trial, force=None) for trial in log.trials])
    found = model.posterior(forceless, "log")
    expected = with_engine(model, "dense").posterior(forceless, "log")
    assert_same(found, expected, relative=1e-12)


def test_outside_of_the_range_all_is_prior():
    model = with_engine(model_of("position", (SHARED, f"{MEAN}=constant")), "local", width={"position": 0.05})
    trial = model.fitted.log.trials[0]
    away = replace(trial, name="away", force=None, position=trial.position + 3.0)
    found = model.posterior(model.fitted.log.with_trials([away]), "training")
    prior = model.posterior(model.fitted.log.with_trials([away]), "log")
    assert_same(found, prior, relative=1e-12)
    near = model.posterior(
        model.fitted.log.with_trials([replace(trial, name="near", force=None)]), "training"
    )
    assert (near["force"].scale < near["force"].prior_scale).all()


def test_a_long_target_is_taken_in_pieces(monkeypatch):
    model = one_cell(model_of("phase", (SHARED,)))
    expected = model.posterior(model.fitted.log, "training")
    name = next(
        name for name, value in vars(conditioning).items() if name.isupper() and isinstance(value, int)
    )
    monkeypatch.setattr(conditioning, name, 7)
    assert_same(model.posterior(model.fitted.log, "training"), expected, relative=1e-9)


# --- refusals and what is said of the engine ---------------------------------------------------------


def test_what_the_engine_says_of_itself():
    model = model_of("position", (SHARED, "engine.name=local"))
    assert model.engine.name == "local"
    assert "training is dense, posteriors come from local sparse models" in model.engine.reason


def test_a_fit_with_engine_local_is_the_dense_one():
    overrides = (SHARED, "training.restarts=1", "training.max_iterations=1")
    log = model_of("position", overrides).fitted.log
    local = ImpedanceModel.from_config("position", (*overrides, "engine.name=local")).fit(log)
    dense = ImpedanceModel.from_config("position", overrides).fit(log)
    for one, other in zip(local.hyperparameters, dense.hyperparameters, strict=True):
        assert np.array_equal(one.value.detach(), other.value.detach())
    found = local.posterior(log, "training")
    assert found["stiffness"].mean.shape == (40, 2)


def test_functions_are_refused():
    with pytest.raises(
        ConfigurationError,
        match=r"name: expected auto, dense, markov or lowrank with impedance: map, got local, whose covariance",
    ):
        load_config("phase", ["engine.impedance=map", "engine.name=local"])


@pytest.mark.parametrize(
    ("key", "value", "sentence"),
    [
        ("inducing", 1, "greater than or equal to 2"),
        ("active", 0, "greater than or equal to 1"),
        ("active", 10, "less than or equal to 9"),
        ("novelty", -0.1, "greater than or equal to 0"),
        ("cells", 0, "greater than or equal to 1"),
        ("forgetting", 0, "greater than 0"),
        ("width", "{position: 0}", "greater than 0"),
        ("width", "{torque: 1}", "torque"),
        ("forget", 3, "forgetting"),
    ],
)
def test_settings_out_of_range_are_refused(key, value, sentence):
    with pytest.raises(ConfigurationError, match=rf"(?s)engine\.local\.{key}.*{sentence}|{sentence}"):
        load_config("phase", [f"engine.local.{key}={value}"])


def test_fewer_cells_than_the_motion_visits_are_refused():
    model = with_engine(model_of("position", (SHARED,)), "local", cells=2)
    with pytest.raises(ConfigurationError, match="which the given motion visits, got 2; raise it, or widen"):
        model.posterior(model.fitted.log, "training")


def test_a_device_that_answers_is_refused():
    model = model_of("admittance", ("engine.name=local",))
    with pytest.raises(
        ConfigurationError,
        match="device: expected none with engine.name: local, which takes the recorded motion as",
    ):
        model.posterior(model.fitted.log, "training")


def test_coupled_axes_are_refused():
    model = model_of("coupled", (SHARED, "engine.name=local"))
    with pytest.raises(
        ConfigurationError, match="expected model.axes: independent and an impedance model with local"
    ):
        model.posterior(model.fitted.log, "training")


def test_conditioning_beneath_the_model():
    """`infer_local` and its conditioner, as the model calls them."""
    model = one_cell(model_of("phase", (SHARED,)))
    log = model.fitted.log
    feature_map = FeatureMap(model.config, log.axes)
    mean = TrajectoryMean.from_training(model.config.model.desired_trajectory, log)
    features = LogFeatures(feature_map, log, mean, labels_of(log, label_trials(log)))
    force_model = model.force_model(log.axes)
    settings = model.config.engine.local
    found = infer_local(force_model, features, features, settings, [Latent.FORCE])
    assert_same(found, model.posterior(log, "training", [Latent.FORCE]), [Latent.FORCE], relative=1e-12)
    conditioner = LocalConditioner(
        IndependentPrior(force_model), feature_map, settings, features(observed=True)
    )
    moments = conditioner.moments(features(), [Latent.MASS])
    assert len(conditioner.learned) == 1
    assert moments[Latent.MASS][0].shape == (2, 1, 40)
