"""Which engine computes the likelihood given impedance: the cheapest that is exact, with its reasons."""

import pytest

from bayes_impedance.config import EngineConfig
from bayes_impedance.engines.choice import MOMENTS, EngineChoice, build_engine, choose_engine
from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.lowrank import LowRankEngine
from bayes_impedance.engines.markov import MarkovEngine
from bayes_impedance.errors import ConfigurationError, TooManySamplesError
from tests.engines.given import NO_RESIDUAL, OVER_TIME, given_problem

SMOOTH = ("model.desired_trajectory.kernel=squared_exponential", *NO_RESIDUAL)
PERIODIC = (*SMOOTH, "engine.impedance=map", "model.desired_trajectory.periodic=true")
VECTOR = (
    *SMOOTH,
    "model.trajectory_input=position_velocity",
    "model.desired_trajectory.mean=reference",
)
#: Samples of an axis of every problem here.
FEW = {"repetitions": 2, "rate": 10.0}
SIZE = 40


def choose(overrides=NO_RESIDUAL, coupled=False, **config):
    problem = given_problem(overrides=overrides, **FEW)
    return choose_engine(
        EngineConfig(impedance="map", **config), problem.processes, problem.features, coupled
    )


def test_automatic_choice_prefers_what_grows_with_the_number_of_samples():
    choice = choose()
    assert choice == EngineChoice("markov", "exact, at a cost that grows with the number of samples")
    assert str(choice) == "engine markov: exact, at a cost that grows with the number of samples"


@pytest.mark.parametrize("coupled", [False, True])
def test_automatic_choice_is_exact_as_long_as_samples_are_few(coupled):
    forces = 2 * SIZE if coupled else SIZE
    dense = choose(SMOOTH, coupled, max_samples=forces)
    assert dense.name == "dense"
    assert dense.reason.startswith(
        f"exact for any process, and {forces} forces are few; not markov: expected the ker"
    )
    assert "set model.desired_trajectory.kernel=matern52" in dense.reason
    low_rank = choose(SMOOTH, coupled, max_samples=forces - 1)
    assert low_rank.name == "lowrank"
    assert low_rank.reason.startswith(
        "features stand for the processes; not markov: expected the kernel matern52"
    )


def test_automatic_choice_of_a_periodic_phase():
    choice = choose(PERIODIC)
    assert choice.name == "lowrank"
    assert "not markov: expected a desired trajectory whose ends are free with markov" in choice.reason


def test_no_engine_holds_the_model():
    with pytest.raises(
        ConfigurationError,
        match=rf"expected processes that one of the engines holds, found {SIZE} forces in a group, with dense for at "
        r"most engine\.max_samples = 39 and no periodic phase; not markov: expected a desired trajectory over one "
        r"number .*; not lowrank: expected a desired trajectory over at most \d inputs, got 4",
    ):
        choose(VECTOR, max_samples=SIZE - 1)


@pytest.mark.parametrize("name", ["dense", "markov", "lowrank"])
def test_the_engine_asked_for(name):
    overrides = SMOOTH if name == "lowrank" else NO_RESIDUAL
    assert choose(overrides, name=name) == EngineChoice(name, "asked for by engine.name")


@pytest.mark.parametrize(
    ("name", "overrides", "names"),
    [
        ("markov", VECTOR, r"over one number \(time, phase\) .*; set engine\.name=dense or lowrank, or"),
        ("markov", PERIODIC, r"ends are free .*; set engine\.name=lowrank"),
        ("markov", SMOOTH, r"kernel matern52 .*; set model\.desired_trajectory\.kernel=matern52"),
        ("lowrank", NO_RESIDUAL, r"kernel=squared_exponential.* engine\.name=markov"),
        ("lowrank", (*SMOOTH, *OVER_TIME), r"residual\.kernel=squared_exponential, got .*engine\.name=dense"),
    ],
)
def test_an_engine_that_cannot_names_what_works(name, overrides, names):
    with pytest.raises(
        ConfigurationError, match=rf"expected an engine that holds this model, got {name}: expected .*{names}"
    ):
        choose(overrides, name=name)


def test_dense_engine_has_its_limits():
    with pytest.raises(TooManySamplesError, match=r"engine\.max_samples = 39"):
        choose(SMOOTH, name="dense", max_samples=SIZE - 1)
    with pytest.raises(TooManySamplesError, match=r"got 80"):
        choose(SMOOTH, True, name="dense", max_samples=2 * SIZE - 1)
    with pytest.raises(
        ConfigurationError,
        match=r"expected lowrank with model\.desired_trajectory\.periodic, which joins the ends of the phase",
    ):
        choose(PERIODIC, name="dense")


def test_what_is_built():
    problem, smooth = (given_problem(overrides=o, **FEW) for o in (NO_RESIDUAL, SMOOTH))
    config = EngineConfig(impedance="map")
    built = [
        build_engine(name, config, p.processes, p.features, False)
        for name, p in (("markov", problem), ("lowrank", smooth), ("dense", problem))
    ]
    assert [type(engine) for engine in built] == [MarkovEngine, LowRankEngine, DenseGivenImpedance]
    with pytest.raises(TooManySamplesError):
        build_engine(
            "dense", EngineConfig(impedance="map", max_samples=10), problem.processes, problem.features, False
        )


def test_the_moment_engine_is_dense():
    assert str(EngineChoice("dense", MOMENTS)) == (
        "engine dense: stiffness, damping and mass are integrated out, which only dense covariances do"
    )
