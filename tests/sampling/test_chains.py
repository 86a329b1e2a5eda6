"""Chains side by side: the same draws in any number of processes, killed, interrupted or not; deaths are told."""

import multiprocessing
import multiprocessing.reduction
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toys import Broken, Deadly, Gaussian, Mortal, start

from bayes_impedance.config import SamplingConfig, load_config
from bayes_impedance.errors import JournalWarning, OutputError, SamplingError
from bayes_impedance.features import FeatureMap
from bayes_impedance.impedance_functions.function import choose_inducing
from bayes_impedance.priors import build_force_model
from bayes_impedance.sampling.chains import by_value, sample_nuts
from bayes_impedance.sampling.checkpoint import Checkpoint
from bayes_impedance.sampling.density import JointDensity
from bayes_impedance.sampling.task import Task, fingerprint
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.trajectory_mean import TrajectoryMean

SETTINGS = SamplingConfig(chains=2, warmup=60, draws=40)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Checkpoint:
    return Checkpoint(tmp_path / "posterior.nc.unfinished", {"model": "a"}, every=0.0)


@pytest.fixture(scope="module")
def expected():
    return sample_nuts(Gaussian(), start(), SETTINGS, processes=1)


def assert_same(draws, expected):
    assert (draws.standard == expected.standard).all()
    assert draws.stats.keys() == expected.stats.keys()
    assert all((values == expected.stats[name]).all() for name, values in draws.stats.items())


def test_in_processes_as_in_this_one(expected):
    reports = []
    draws = sample_nuts(Gaussian(), start(), SETTINGS, lambda *told: reports.append(told), processes=2)
    assert_same(draws, expected)
    assert draws.method == "nuts" and draws.shape == (2, 40) and draws.lost == ()
    assert draws.stats["lp"].shape == (2, 40)
    assert (draws.standard[0] != draws.standard[1]).any()
    for chain in range(2):
        done = [told[1] for told in reports if told[0] == chain]
        assert done[0] == 0 and done[-1] == 100 and done == sorted(done)
    assert {told[2] for told in reports} == {100}
    assert reports[-1][3].startswith("step size") and reports[-1][3].endswith("divergences")


def test_killed_and_resumed_gives_the_same_bits(expected, checkpoint):
    # In the middle of an iteration, first of the warm-up and then of what comes after it.
    done = []
    for last in (200, 900):
        with pytest.raises(
            SamplingError, match="chain 1 was ended by signal 9.*too little memory is the usual"
        ):
            sample_nuts(Mortal(last), start(), SETTINGS, checkpoint=checkpoint, processes=2)
        done.append([int(state_of(checkpoint, chain)["done"]) for chain in range(2)])
    assert all(0 < first < 60 < second < 100 for first, second in zip(*done, strict=True)), done
    assert_same(sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=checkpoint, processes=1), expected)
    # What is finished is taken as it is.
    assert_same(sample_nuts(Broken(), start(), SETTINGS, checkpoint=checkpoint, processes=1), expected)


def state_of(checkpoint, chain):
    return replace(checkpoint, fingerprint={**checkpoint.fingerprint, **fingerprint(SETTINGS)}).read(chain)


@pytest.mark.parametrize("processes", [1, 2])
def test_interrupted_and_resumed(expected, checkpoint, processes):
    def interrupt(chain, done, total, line):
        if chain == processes - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample_nuts(Gaussian(), start(), SETTINGS, interrupt, checkpoint, processes=processes)
    assert multiprocessing.active_children() == []
    assert_same(sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=checkpoint, processes=1), expected)


def test_a_chain_that_dies_takes_no_other_with_it():
    settings = SETTINGS.model_copy(update={"chains": 4})
    draws = sample_nuts(Deadly(), start(), settings, processes=2)
    second, third = draws.lost
    assert second.startswith("chain 2 was ended by signal 9, Killed (too little memory is the usual cause")
    assert third.startswith("chain 3 ended without a word (exit code 3)")
    whole = sample_nuts(Gaussian(), start(), settings, processes=1)
    assert (draws.standard == whole.standard[[0, 3]]).all()


def test_all_dead():
    with pytest.raises(
        SamplingError, match="draws of 2 chains, found that all of them died: chain 1 died of ValueE"
    ):
        sample_nuts(Broken(), start(), SETTINGS.model_copy(update={"warmup": 300}), processes=1)


def test_nowhere_finite():
    with pytest.raises(SamplingError, match="died of NotPositiveDefiniteError: beyond the edge"):
        sample_nuts(Gaussian(edge=-np.inf), start(), SETTINGS, processes=1)


def test_checkpoint_of_other_settings(checkpoint):
    sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=checkpoint, processes=1)
    other = SETTINGS.model_copy(update={"target_acceptance": 0.9})
    with pytest.raises(OutputError, match=r"another sampling\.target_acceptance \(0\.8, now 0\.9\)"):
        sample_nuts(Gaussian(), start(), other, checkpoint=checkpoint)
    with pytest.raises(OutputError, match=r"another model \(a, now c\)"):
        sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=Checkpoint(checkpoint.folder, {"model": "c"}))
    # More chains of the same go on from those that are there.
    more = sample_nuts(
        Gaussian(), start(), SETTINGS.model_copy(update={"chains": 3}), None, checkpoint, processes=1
    )
    assert more.shape == (3, 40)


def test_goes_on_where_nothing_can_be_kept(expected, tmp_path):
    (tmp_path / "file").write_text("in the way")
    nowhere = Checkpoint(tmp_path / "file", {}, every=0.0)
    with pytest.raises(OutputError, match="expected a checkpoint that can be read"):
        sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=nowhere)
    missing = Checkpoint(Path("/proc/nowhere"), {}, every=0.0)
    with pytest.warns(JournalWarning, match="sampling goes on, but if it is killed, chain [12] is not kept"):
        draws = sample_nuts(Gaussian(), start(), SETTINGS, checkpoint=missing, processes=1)
    assert_same(draws, expected)


@pytest.mark.parametrize("kernel", ["matern52", "squared_exponential", "rational_quadratic"])
def test_a_density_travels_to_other_processes(kernel):
    about = [
        f"model.desired_trajectory.kernel={kernel}",
        "log.axes=[x]",
        "engine.impedance=map",
        "engine.inducing=3",
    ]
    config = load_config("phase", about)
    log = draw_force(config, repeated_motion(2, 2.0, 10.0, axes=("x",)), seed=0)
    layout = FeatureMap(config, ("x",))
    features = layout(log, TrajectoryMean.from_training(config.model.desired_trajectory, log), observed=True)
    model = build_force_model(config, layout)
    density = JointDensity(config, model, features, choose_inducing(config, model, features))
    task = Task(density, start(density.size), SETTINGS, None)
    arrived = multiprocessing.reduction.ForkingPickler.loads(by_value(task))
    point = 0.1 * np.random.default_rng(0).standard_normal(density.size)
    (value, gradient), (other, other_gradient) = density.joint(point), arrived.density.joint(point)
    assert value == other and (gradient == other_gradient).all()
    assert arrived.settings == SETTINGS
