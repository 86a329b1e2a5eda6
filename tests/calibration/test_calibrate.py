"""Runs of a calibration: the same in any order and process, continued where they stopped, honest about failures."""

import json
import multiprocessing
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np
import pytest
from tiny import configuration, importance, settings

from bayes_impedance.calibration import run
from bayes_impedance.calibration.draw import Trials, doubts, thinned
from bayes_impedance.calibration.quantities import Ranked
from bayes_impedance.calibration.records import FILE, Record
from bayes_impedance.calibration.run import Calibration, calibrate
from bayes_impedance.errors import ConfigurationError, NotPositiveDefiniteError, OutputError, SimulationError
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.sampling.draws import Draws
from bayes_impedance.simulation.generative import repeated_motion

CONFIG = configuration()


def quick(density, config):
    """Draws of the prior, which take no time."""
    generator = np.random.default_rng(config.sampling.seed)
    draws = generator.standard_normal((1, config.sampling.draws, density.size))
    return Draws("laplace", draws, {}, pareto_k=0.9 if draws[0, 0, 0] > 0 else 0.1)


def test_draws_do_not_depend_on_their_order() -> None:
    trials = Trials(settings(CONFIG))
    assert [trials(2), trials(0)] == [Trials(settings(CONFIG))(i) for i in (2, 0)]
    assert trials(0).rank != trials(1).rank
    assert Trials(settings(CONFIG, seed=1))(0) != trials(0)


def test_processes_give_what_one_gives_and_end_with_it(tmp_path) -> None:
    def impatient(done: int, planned: int, state: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    alone = calibrate(settings(CONFIG, sampler=quick), 20)
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        calibrate(settings(CONFIG, sampler=quick), 20, tmp_path, processes=2, progress=impatient)
    assert set(multiprocessing.active_children()) <= before
    kept = [json.loads(line) for line in (tmp_path / FILE).read_text().splitlines()[1:]]
    assert [alone.records[record["draw"]].rank for record in kept] == [record["rank"] for record in kept]
    assert len(kept) == 3
    assert calibrate(settings(CONFIG, sampler=quick), 20, tmp_path) == alone


def test_a_process_that_dies_ends_in_a_sentence(monkeypatch) -> None:
    def broken(pool, function, index):
        raise BrokenProcessPool

    monkeypatch.setattr(run.ProcessPoolExecutor, "submit", broken)
    with pytest.raises(SimulationError, match="found that one died, perhaps for want of memory"):
        calibrate(settings(CONFIG, sampler=quick), 20, processes=2)


def test_interrupted_and_torn_it_continues(tmp_path) -> None:
    made = []

    def counting(density, config):
        made.append(config.sampling.seed)
        if len(made) == 8:
            raise KeyboardInterrupt
        return quick(density, config)

    with pytest.raises(KeyboardInterrupt):
        calibrate(settings(CONFIG, sampler=counting), 20, tmp_path)
    path = tmp_path / FILE
    assert len(path.read_text().splitlines()) == 1 + 7
    path.write_bytes(path.read_bytes()[:-5])
    told = []
    continued = calibrate(
        settings(CONFIG, sampler=counting), 20, tmp_path, progress=lambda *state: told.append(state)
    )
    assert len(made) == 8 + 20 - 6
    assert told[0][:2] == (7, 20) and told[-1][:2] == (20, 20)
    assert continued == calibrate(settings(CONFIG, sampler=quick), 20)
    # More draws go on from there; fewer are the first of them.
    assert calibrate(settings(CONFIG, sampler=counting), 22, tmp_path).records[:20] == continued.records
    assert calibrate(settings(CONFIG, sampler=counting), 20, tmp_path) == continued


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (settings(CONFIG, sampler=quick, seed=1), "another seed"),
        (settings(CONFIG, sampler=quick, thinned=19), "another draws of a rank"),
        (settings(configuration({"method": "svi"}), sampler=quick), "another method and configuration"),
        (settings(CONFIG, repeated_motion(2, 3.0, 3.0, axes=("x",)), quick), "another motion"),
    ],
)
def test_records_of_another_calibration_are_refused(tmp_path, other, named) -> None:
    calibrate(settings(CONFIG, sampler=quick), 20, tmp_path)
    before = (tmp_path / FILE).read_bytes()
    with pytest.raises(
        OutputError, match="expected the records of this calibration, found those of one with"
    ) as error:
        calibrate(other, 20, tmp_path)
    assert named in str(error.value)
    assert (tmp_path / FILE).read_bytes() == before


@pytest.mark.parametrize("content", ["a,b\n1,2\n", "[1]\n", '{"calibration": 1}\n{"x": 1}\n'])
def test_another_file_is_refused(tmp_path, content) -> None:
    (tmp_path / FILE).write_text(content)
    with pytest.raises(OutputError, match="expected the records of a calibration, found another file"):
        calibrate(settings(CONFIG, sampler=quick), 20, tmp_path)


def test_a_folder_in_place_of_records_is_refused(tmp_path) -> None:
    (tmp_path / FILE).mkdir()
    with pytest.raises(OutputError, match="records of the calibration could not be kept"):
        calibrate(settings(CONFIG, sampler=quick), 20, tmp_path)


def test_failures_and_doubts_are_counted() -> None:
    def failing(density, config):
        if config.sampling.seed % 3 == 0:
            raise NotPositiveDefiniteError("no factor")
        return quick(density, config)

    calibration = calibrate(settings(CONFIG, sampler=failing), 40)
    failed = [record for record in calibration.records if record.failure is not None]
    doubtful = [record for record in calibration.records if record.unsound]
    assert failed and doubtful and len(calibration.sampled) == 40 - len(failed)
    assert calibration.remarks() == [
        f"{len(failed)} of 40 draws have no posterior and no rank: NotPositiveDefiniteError: no factor",
        f"{len(doubtful)} of 40 draws, ranked as they are: Pareto k above 0.7.",
    ]
    # The prior is too wide a posterior.
    verdicts = {found.name: found.verdict for found in calibration.uniformity}
    assert len(calibration.uniformity[0].verdict) and "log stiffness x" in verdicts
    json.dumps(calibration.as_json())


def test_nothing_but_failures_leaves_no_verdict() -> None:
    def failing(density, config):
        raise NotPositiveDefiniteError("no factor")

    calibration = calibrate(settings(CONFIG, sampler=failing), 20)
    assert calibration.names == ()
    with pytest.raises(
        ConfigurationError, match="draws with a posterior, for a test of uniform ranks, found 0"
    ):
        calibration.uniformity  # noqa: B018


def test_draws_that_never_moved_have_no_rank() -> None:
    def still(density, config):
        return Draws("nuts", np.zeros((1, 200, density.size)), {})

    record = Trials(settings(CONFIG, sampler=still))(0)
    assert record.failure is not None and record.failure.startswith(
        "all draws are the same: log stiffness x, "
    )
    assert record.rank == {}


def test_a_rank_counts_draws_below_the_truth() -> None:
    trials = Trials(settings(CONFIG, sampler=importance))
    record = trials(0)
    assert set(record.rank) == set(record.truth) == set(record.z)
    for name, z in record.z.items():
        # Both say on which side the truth lies, wherever it lies clearly.
        if abs(z) > 0.7:
            assert (record.rank[name] > 49) == (z > 0)


def test_quantities_of_groups_axes_and_functions() -> None:
    log = {"stiffness": {"level": {"median": 150, "log_sd": 0.5}, "log_sd": 0.3, "input": ["phase"]}}
    config = configuration(model=log | {"axes": "coupled"})
    motions = [repeated_motion(1, 3.0, 2.0, group=group, seed=g) for g, group in enumerate("ab")]
    ranked = Ranked(
        Trials(settings(config, PreparedLog(("x", "y"), motions[0].trials + motions[1].trials))).problem
    )
    point = np.random.default_rng(0).standard_normal(ranked.problem.prior.size)
    recording = ranked.problem.draw(point, 0)
    truth = ranked.truth(point, recording)
    assert sum(name.startswith("log stiffness x, group a, phase") for name in truth) == 2
    assert sum(name.startswith("stiffness xy, group b, phase") for name in truth) == 2
    assert "log mass y, group b" in truth and "damping xy, group a" in truth and "noise sd y" in truth
    # Against the truth beside the force.
    for g, group in enumerate("ab"):
        for row, label in zip(ranked.places.rows[g], ranked.places.labels[g], strict=True):
            own = recording.trials[g].truth
            at = f"group {group}, {label}"
            assert truth[f"log stiffness y, {at}"] == pytest.approx(
                np.log(own["stiffness_yy"][row]), rel=1e-9
            )
            assert truth[f"stiffness xy, {at}"] == pytest.approx(own["stiffness_xy"][row], rel=1e-9)
            assert truth[f"desired position x, {at}"] == own["desired_position_x"][row]


def test_places_are_samples_where_theta_is_time() -> None:
    config = configuration(model={"trajectory_input": "time"})
    assert Trials(settings(config)).ranked.places.labels == (("sample 4", "sample 11"),)


def test_thinned_draws_are_spread_over_all_chains() -> None:
    standard = np.arange(60.0).reshape(3, 20, 1)
    assert thinned(standard, 4)[:, 0].tolist() == [0.0, 20.0, 39.0, 59.0]
    with pytest.raises(ConfigurationError, match="found 60 that chains came to; sample more"):
        thinned(standard, 61)


def test_doubts_about_chains() -> None:
    generator = np.random.default_rng(0)
    draws = Draws(
        "nuts", generator.standard_normal((2, 200, 3)), {"diverging": np.zeros((2, 200), dtype=bool)}
    )
    assert doubts(draws, 99) == ()
    assert doubts(draws, 2000) == ("fewer than 2000 effective draws",)
    apart = replace(
        draws, standard=draws.standard + np.array([0.0, 3.0])[:, None, None], lost=("chain 2: killed",)
    )
    apart.stats["diverging"][0, 3] = True
    assert doubts(apart, 1) == ("a chain was lost", "divergences", "R-hat above 1.05")


def test_what_cannot_be_calibrated_is_refused() -> None:
    with pytest.raises(
        ConfigurationError, match="engine.impedance: expected map, whose functions are sampled"
    ):
        Trials(settings(configuration(engine={"impedance": "moments"})))
    with pytest.raises(
        ConfigurationError, match="sampling.draws: expected at least 99 draws over all chains"
    ):
        Trials(settings(configuration({"draws": 98})))
    with pytest.raises(ConfigurationError, match="--draws: expected at least 20 draws"):
        calibrate(settings(CONFIG), 19)


def test_a_calibration_of_records() -> None:
    records = tuple(Record(i, {"k": 1.0}, {"k": i % 10}, {"k": 0.0}) for i in range(40))
    calibration = Calibration("svi", 9, records)
    assert calibration.names == ("k",) and calibration.ranks("k").tolist() == [i % 10 for i in range(40)]
    (found,) = calibration.uniformity
    assert found.p == pytest.approx(1.0) and found.bins == 5
