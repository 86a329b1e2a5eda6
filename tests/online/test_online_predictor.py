"""Learning and prediction sample by sample: against posteriors, beside readers, through bad samples."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from streams import SHARED, model_of, same, samples, state, stream

from bayes_impedance.engines.local.model import Coverage
from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.online import OnlinePredictor

MEAN = "model.desired_trajectory.mean"
LATENTS = [Latent.FORCE, Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY]
#: Levels known: posteriors then have no uncertainty of theirs to add.
FIXED = ("model.stiffness.level=200", "model.damping.level=15", "model.mass.level=1.5")
LOCAL = "engine.name=local"


@pytest.fixture(scope="module")
def model():
    """The paper's second experiment, with wide cells, so that neighbours share samples."""
    return model_of("position_velocity", (SHARED, "engine.local.width={position: 0.2, velocity: 1.0}"))


@pytest.fixture
def predictor(model):
    return OnlinePredictor(model)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("position", (SHARED,)),
        ("position", (SHARED, f"{MEAN}=constant")),
        ("position_velocity", (SHARED,)),
        ("position_velocity", (SHARED, f"{MEAN}=reference", "model.drop_acceleration=true")),
        ("phase", (SHARED,)),
        ("phase", (SHARED, f"{MEAN}=reference")),
    ],
    ids=lambda value: value if isinstance(value, str) else ",".join(value),
)
def test_predictions_are_the_posterior_of_engine_local(name, overrides):
    """`model.posterior` given the training log, sample by sample; at known levels, variances too."""
    model = model_of(name, (*overrides, *FIXED, LOCAL))
    predictor = OnlinePredictor(model)
    expected = model.posterior(model.fitted.log, "training", LATENTS)
    every = [sample for trial in model.fitted.log.trials for sample in samples(trial, with_force=False)]
    assert predictor.samples == len(every)
    for t, sample in enumerate(every):
        found = predictor.predict(sample)
        assert found.coverage is Coverage.LEARNED
        for latent, mean, variance in zip(LATENTS, found[:6:2], found[1:6:2], strict=True):
            scale = np.abs(expected[latent.value].mean).max()
            assert mean == pytest.approx(expected[latent.value].mean[t], rel=1e-6, abs=1e-7 * scale)
            assert np.sqrt(variance) == pytest.approx(expected[latent.value].sd[t], rel=1e-4)


def test_levels_that_are_learned_widen_posteriors_and_not_predictions():
    """Online, levels are known, as for `point_predictor`; means agree, posteriors are at least as wide."""
    model = model_of("phase", (SHARED, f"{MEAN}=reference", LOCAL))
    predictor = OnlinePredictor(model)
    expected = model.posterior(model.fitted.log, "training", [Latent.FORCE])["force"]
    found = [predictor.predict(one) for trial in model.fitted.log.trials for one in samples(trial)]
    force = np.stack([one.force for one in found])
    assert force == pytest.approx(expected.mean, rel=1e-6, abs=1e-6)
    sd = np.sqrt(np.stack([one.force_variance for one in found]))
    assert (sd <= expected.sd * (1.0 + 1e-9)).all()


def test_a_stream_of_the_training_log_knows_what_a_warm_start_knows(model):
    """With room for every sample both have the same inducing inputs."""
    settings = {"inducing": 100, "novelty": 0.0}
    local = model.config.engine.local.model_copy(update=settings)
    config = model.config.model_copy(
        update={"engine": model.config.engine.model_copy(update={"local": local})}
    )
    roomy = type(model)(config, model.fitted)
    warm, cold = OnlinePredictor(roomy), OnlinePredictor(roomy, warm=False)
    assert (cold.samples, cold.cells, cold.last) == (0, 0, -np.inf)
    every = [one for i, trial in enumerate(model.fitted.log.trials) for one in samples(trial, start=10.0 * i)]
    assert {cold.update(one) for one in every} == {Coverage.LEARNED}
    assert (cold.samples, cold.cells) == (warm.samples, warm.cells)
    for one in stream(model):
        for a, b in zip(cold.predict(one)[:6], warm.predict(one)[:6], strict=True):
            assert a == pytest.approx(b, rel=1e-5, abs=1e-7)


def test_a_cold_start_predicts_the_prior(model):
    predictor = OnlinePredictor(model, warm=False)
    sample = samples(model.fitted.log.trials[0])[5]
    found = predictor.predict(sample)
    assert found.coverage is Coverage.UNVISITED
    assert (found.force == 0.0).all()
    assert (found.desired_position == sample.position).all()
    assert (found.desired_velocity == sample.velocity).all()
    prior = model.posterior(model.fitted.log.select([0]).with_trials([_without_force(model)]), "log", LATENTS)
    for latent, variance in zip(LATENTS, found[1:6:2], strict=True):
        assert np.sqrt(variance) == pytest.approx(prior[latent.value].sd[5], rel=1e-9)


def _without_force(model):
    return replace(model.fitted.log.trials[0], force=None)


def test_what_is_learned_narrows_and_moves_the_next_prediction(model):
    predictor = OnlinePredictor(model, warm=False)
    sample = samples(model.fitted.log.trials[0])[5]
    before = predictor.predict(sample)
    assert predictor.update(sample) is Coverage.LEARNED
    after = predictor.predict(sample)
    assert (after.force_variance < before.force_variance).all()
    assert (np.abs(after.force - sample.force) < np.abs(before.force - sample.force)).all()
    assert predictor.samples == 1
    assert predictor.last == sample.time


def test_prediction_looks_at_no_force_and_changes_nothing(predictor, model):
    sample = samples(model.fitted.log.trials[0])[5]
    before = state(predictor)
    one, other = predictor.predict(sample), predictor.predict(sample._replace(force=None, time=None))
    assert same(one, other)
    assert same(before, state(predictor))


def test_outside_of_the_range_the_prior_is_predicted_and_nothing_learned(predictor, model):
    before = state(predictor)[:-1]
    sample = samples(model.fitted.log.trials[0])[5]
    away = sample._replace(position=[50.0, 0.0], time=1.0)
    assert predictor.update(away) is Coverage.OUTSIDE
    found = predictor.predict(away)
    assert found.coverage is Coverage.OUTSIDE
    assert (found.force == 0.0).all()
    assert (found.force_variance > predictor.predict(sample).force_variance).all()
    # It was looked at, so the next one has to be later; but nothing was learned.
    assert predictor.last == 1.0
    assert same(before, state(predictor)[:-1])


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"force": None}, "expected a finite force for each axis to learn from, got None; predict it"),
        ({"force": [1.0, np.nan]}, "expected a finite force for each axis"),
        ({"force": [np.inf, 0.0]}, "expected a finite force for each axis"),
        ({"force": [1e300, 0.0]}, "expected a finite force for each axis"),
        ({"force": 1.0}, r"to learn from, got 1.0; predict it, and leave it out"),
        ({"force": [1.0]}, "expected a finite force for each axis"),
        ({"force": [1.0, 2.0, 3.0]}, "expected a finite force for each axis"),
        ({"force": "strong"}, "expected a finite force for each axis"),
        ({"position": None}, "expected position, which this configuration asks for, found none"),
        ({"velocity": None}, "expected velocity, which"),
        ({"acceleration": None}, "expected acceleration, which"),
        ({"jerk": None}, "expected jerk, which"),
        ({"position": [0.1, np.nan]}, "expected finite numbers below"),
        ({"jerk": [np.inf, 0.0]}, "expected finite numbers below"),
        ({"velocity": [1e160, 0.0]}, "expected finite numbers below"),
        ({"velocity": [0.1]}, "expected velocity of 2 numbers"),
        ({"position": 0.1}, "expected position of 2 numbers"),
        (
            {"time": 1.0},
            r"sample at 1.0 s: expected one later than the last, at 100.0 s; leave it out, or begin",
        ),
        ({"time": 100.0}, "expected one later than the last"),
        ({"time": np.nan}, "sample at nan s: expected one later than the last"),
        ({"time": np.inf}, "sample at inf s: expected one later than the last"),
        ({"time": None}, "sample at None s: expected one later than the last"),
        ({"time": "noon"}, "sample at noon s: expected one later than the last"),
    ],
    ids=lambda value: str(value) if isinstance(value, dict) else "",
)
def test_a_bad_sample_changes_nothing(predictor, model, change, sentence):
    good = samples(model.fitted.log.trials[0])[5]
    predictor.update(good._replace(time=100.0))
    before = state(predictor)
    with pytest.raises(LogError, match=sentence):
        predictor.update(good._replace(**{"time": 101.0, **change}))
    assert same(before, state(predictor))
    # Nor does it stand in the way of the next.
    assert predictor.update(good._replace(time=102.0)) is Coverage.LEARNED
    assert all(np.isfinite(array).all() for array in state(predictor))


def test_the_largest_numbers_that_are_taken_leave_every_sum_finite(predictor, model):
    good = samples(model.fitted.log.trials[0])[5]
    for i, field in enumerate(("acceleration", "jerk", "force")):
        predictor.update(good._replace(**{"time": 200.0 + i, field: [9e29, -9e29]}))
    assert all(np.isfinite(array).all() for array in state(predictor))
    assert all(np.isfinite(value).all() for value in predictor.predict(good)[:6])


def test_a_snapshot_does_not_learn(predictor, model):
    every = stream(model)
    snapshot = predictor.snapshot()
    before = [snapshot.predict(one) for one in every]
    now = [predictor.predict(one) for one in every]
    assert all(same(one, other) for one, other in zip(before, now, strict=True))
    for one in every:
        predictor.update(one)
    assert all(same(one, snapshot.predict(sample)) for one, sample in zip(before, every, strict=True))
    assert not all(same(one, predictor.predict(sample)) for one, sample in zip(before, every, strict=True))


def test_readers_beside_a_writer(model):
    """A controller reads in a loop, from snapshots and directly, while another thread learns."""
    predictor = OnlinePredictor(model, warm=False)
    every = stream(model)
    done, problems, reads = threading.Event(), [], [0, 0]

    def read(which):
        try:
            while not done.is_set():
                source = predictor.snapshot() if which else predictor
                for one in every[:: 7 + which]:
                    found = source.predict(one)
                    if not all(np.isfinite(value).all() for value in found[:6]):
                        problems.append(found)
                    if not all((value >= 0.0).all() for value in found[1:6:2]):
                        problems.append(found)
                    # Of one snapshot the same question has the same answer.
                    if which and not same(found, source.predict(one)):
                        problems.append("changed")
                    reads[which] += 1
        except BaseException as error:
            problems.append(error)

    threads = [threading.Thread(target=read, args=(which,)) for which in (0, 1)]
    for thread in threads:
        thread.start()
    for i in range(40):
        for one in every:
            predictor.update(one._replace(time=one.time + 100.0 * i))
    # Learning may be over before a reader had its turn.
    while min(reads) < 20 and not problems:
        done.wait(0.001)
    done.set()
    for thread in threads:
        thread.join()
    assert problems == []
    alone = OnlinePredictor(model, warm=False)
    for i in range(40):
        for one in every:
            alone.update(one._replace(time=one.time + 100.0 * i))
    # Readers change nothing: what was learned is the same to the bit.
    assert same(state(predictor), state(alone))


def test_a_snapshot_has_a_sample_in_all_of_its_cells_or_in_none(model):
    """Each sample goes into three cells, and every one of them is there at once."""
    predictor = OnlinePredictor(model, warm=False)
    every, done, problems = stream(model), threading.Event(), []
    active = model.config.engine.local.active

    def read():
        while not done.is_set():
            cells = predictor._local.snapshot.cells
            if any((cell.used == 0).any() for cell in cells.values()):
                problems.append("an empty cell")
            if 0 < len(cells) < active:
                problems.append("some cells of a sample")

    thread = threading.Thread(target=read)
    thread.start()
    for one in every:
        predictor.update(one)
    done.set()
    thread.join()
    assert problems == []


def test_two_writers_wait_for_each_other(model):
    predictor = OnlinePredictor(model, warm=False)
    every = stream(model)
    refused = []

    def write(rows):
        for one in rows:
            try:
                predictor.update(one)
            except LogError:
                refused.append(one)

    threads = [threading.Thread(target=write, args=(every[start::2],)) for start in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    # One of them may come too late with a sample, which is refused in words; none is lost silently.
    assert predictor.samples + len(refused) == len(every)
    assert all(np.isfinite(array).all() for array in state(predictor)[:-1])


def test_cells_are_bounded(model):
    config = model.config.engine.local.model_copy(update={"cells": 2, "active": 1})
    engine = model.config.engine.model_copy(update={"local": config})
    predictor = OnlinePredictor(
        type(model)(model.config.model_copy(update={"engine": engine}), model.fitted), warm=False
    )
    found = [predictor.update(one) for one in stream(model)]
    assert predictor.cells == 2
    assert Coverage.UNVISITED in found
    assert predictor.samples == sum(one is Coverage.LEARNED for one in found)


# --- groups ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_groups():
    return model_of("phase", (SHARED, *FIXED, LOCAL), groups=("ada", "bob"))


def test_each_group_has_a_predictor_of_its_own(two_groups):
    log = two_groups.fitted.log
    expected = two_groups.posterior(log, "training", LATENTS)["force"]
    for group in ("ada", "bob"):
        predictor = OnlinePredictor(two_groups, group)
        assert predictor.group == group
        for i, trial in enumerate(log.trials):
            if trial.group == group:
                rows = expected.mean[i * 20 : (i + 1) * 20]
                found = np.stack([predictor.predict(one).force for one in samples(trial)])
                assert found == pytest.approx(rows, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("group", [None, "eve"])
def test_a_group_has_to_be_one_of_the_training(two_groups, group):
    with pytest.raises(
        ConfigurationError,
        match=f"group: expected one of ada, bob, got {group}; name the one that holds the handle",
    ):
        OnlinePredictor(two_groups, group)


def test_a_model_of_one_group_needs_no_name(model):
    assert OnlinePredictor(model, "0", warm=False).group == "0"
    with pytest.raises(ConfigurationError, match="expected one of 0, got other"):
        OnlinePredictor(model, "other")


def test_a_model_must_be_fitted():
    with pytest.raises(ConfigurationError, match="expected a fitted model"):
        OnlinePredictor(ImpedanceModel.from_config("position", [SHARED]))


def test_an_input_is_needed_by_name(model):
    assert OnlinePredictor(model, warm=False).needed == ("position", "velocity", "acceleration", "jerk")
    reference = model_of("position", (SHARED, f"{MEAN}=reference"))
    assert OnlinePredictor(reference, warm=False).needed[-3:] == (
        "reference", "reference_velocity", "reference_acceleration",
    )  # fmt: skip
