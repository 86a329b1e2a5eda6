"""Groups in batches: the numbers of one group at a time, whatever the lengths, the pieces and the threads."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from oracles import MODEL, configuration, feature_map

from bayes_impedance.config import Config, load_config
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.features import label_trials
from bayes_impedance.model import Fit, ImpedanceModel
from bayes_impedance.posterior import Posterior, batches, compute_posterior, conditioning
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.priors import build_force_model
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.training import TrainingReport
from bayes_impedance.trajectory_mean import TrajectoryMean

ROOT = Path(__file__).parents[1]
#: Rounding of sums in another order, through a covariance of condition 1e6 or so.
RTOL = 1e-10
DESIGNS = {
    "phase": {"trajectory_input": "phase"},
    "time": {"trajectory_input": "time"},
    "coupled": {"trajectory_input": "phase", "axes": "coupled"},
    "levels": {
        "trajectory_input": "phase",
        "stiffness": {**MODEL["stiffness"], "level": {"median": 100, "log_sd": 0.6}},
        "mass": {"level": {"median": 1.2, "log_sd": 0.4}, "sd": 0.2},
    },
}


def config_of(name: str) -> Config:
    if name == "loop":
        return load_config(
            "admittance", ["model.desired_trajectory.mean=reference", "device.acceleration=measured"]
        )
    if name == "coupled":
        return load_config("coupled", ["model.desired_trajectory.mean=reference"])
    return configuration(**DESIGNS[name])


def uneven_log(config: Config, forceless: bool = True) -> PreparedLog:
    """Groups of 6 to 40 samples in one to three trials, their trials mixed; the last has no force."""
    trials = []
    for g, (repetitions, rate) in enumerate(
        [(3, 6.0), (1, 3.0), (2, 5.0), (1, 20.0), (1, 3.0), (2, 5.0), (1, 4.0)]
    ):
        motion = repeated_motion(repetitions, duration=2.0, rate=rate, seed=g, group=f"g{g}")
        drawn = draw_force(config, motion, seed=g).trials
        trials += [replace(trial, name=f"{g}.{i}") for i, trial in enumerate(drawn)]
    if forceless:
        trials[-1] = replace(trials[-1], force=None)
    order = np.random.default_rng(0).permutation(len(trials))
    return PreparedLog(("x", "y"), tuple(trials[i] for i in order))


def without_some_forces(log: PreparedLog) -> PreparedLog:
    """The first trial with force knows it at half of its samples."""
    trials = list(log.trials)
    first = next(i for i, trial in enumerate(trials) if trial.force is not None)
    force = trials[first].force.copy()
    force[::2] = np.nan
    trials[first] = replace(trials[first], force=force)
    return replace(log, trials=tuple(trials))


def arrays_of(posterior: Posterior) -> Iterator[tuple[str, np.ndarray]]:
    for kind in ("marginals", "couplings"):
        for latent, marginal in getattr(posterior, kind).items():
            for name in ("location", "scale", "prior_location", "prior_scale"):
                yield f"{kind} {latent.value} {name}", getattr(marginal, name)
    for latent, terms in posterior.terms.items():
        for name in ("expected", "own", "covariance", "prior_covariance"):
            yield f"terms {latent.value} {name}", getattr(terms, name)


def assert_same(one: Posterior, two: Posterior, rtol: float = RTOL) -> None:
    for (name, left), (other, right) in zip(arrays_of(one), arrays_of(two), strict=True):
        assert name == other
        scale = np.abs(right).max(initial=1e-300)
        np.testing.assert_allclose(left, right, rtol=rtol, atol=rtol * scale, err_msg=name)


def bits_of(posterior: Posterior) -> bytes:
    return b"".join(array.tobytes() for _, array in arrays_of(posterior))


# --- numbers -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*DESIGNS, "loop"])
def test_many_groups_equal_one_at_a_time(name: str) -> None:
    config = config_of(name)
    log = without_some_forces(uneven_log(config))
    model = ImpedanceModel(config)
    together = model.posterior(log)
    assert len({trial.group for trial in log.trials}) == 7
    starts = np.cumsum([0, *(trial.n_samples for trial in log.trials)])
    for members in log.by_group.values():
        alone = model.posterior(log.select(members))
        rows = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in members])
        for (label, left), (_, right) in zip(arrays_of(together), arrays_of(alone), strict=True):
            scale = np.abs(right).max(initial=1e-300)
            np.testing.assert_allclose(left[rows], right, rtol=RTOL, atol=RTOL * scale, err_msg=label)


def test_sixty_four_groups_equal_calls_of_one_trial() -> None:
    config = configuration(trajectory_input="phase")
    drawn = [
        draw_force(config, repeated_motion(1, 4.0, 25.0, seed=g, group=f"g{g}"), seed=g) for g in range(4)
    ]
    trials = [replace(drawn[g % 4].trials[0], name=f"{g}", group=f"g{g}") for g in range(64)]
    log = PreparedLog(("x", "y"), tuple(trials))
    model = ImpedanceModel(config)
    together = model.posterior(log)
    for g in range(4):
        alone = model.posterior(log.select([g]))
        for again in range(g, 64, 4):
            rows = together.trial_slice(again)
            for (label, left), (_, right) in zip(arrays_of(together), arrays_of(alone), strict=True):
                scale = np.abs(right).max(initial=1e-300)
                np.testing.assert_allclose(left[rows], right, rtol=RTOL, atol=RTOL * scale, err_msg=label)


@pytest.mark.parametrize("name", ["phase", "coupled"])
def test_batches_equal_one_padded_batch_of_all(name: str) -> None:
    config = config_of(name)
    log = uneven_log(config, forceless=False)
    mapping = feature_map(config, log)
    features = mapping(
        log, TrajectoryMean.from_training(config.model.desired_trajectory, log), label_trials(log)
    )
    padded = compute_posterior(
        build_force_model(config, mapping), log, features, features, config.engine.jitter
    )
    assert_same(ImpedanceModel(config).posterior(log), padded)


@pytest.mark.parametrize("name", [*DESIGNS, "loop"])
def test_pieces_change_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven targets at a time, across trials, with the forces conditioned on anew every two pieces."""
    config = config_of(name)
    log = uneven_log(config)
    whole = ImpedanceModel(config).posterior(log)
    monkeypatch.setattr(conditioning, "CHUNK", 7)
    monkeypatch.setattr(batches, "PIECES", 2)
    monkeypatch.setattr(batches, "PADDING", 1e9)
    assert_same(ImpedanceModel(config).posterior(log), whole)


def test_targets_beyond_the_training_log() -> None:
    config = configuration(trajectory_input="time")
    log = uneven_log(config, forceless=False)
    report = TrainingReport((), (0, 0), (0.0, 0.0), (0.0, 0.0), {}, False, log.n_samples)
    model = ImpedanceModel(config, Fit(build_force_model(config, feature_map(config, log)), log, report))
    other = PreparedLog(
        log.axes, tuple(replace(t, force=None, name=f"new {t.name}") for t in reversed(log.trials))
    )
    found, same = model.posterior(other, given="training"), model.posterior(log, given="training")
    for i in range(len(log.trials)):
        one, two = found.trial_slice(len(log.trials) - 1 - i), same.trial_slice(i)
        for (label, left), (_, right) in zip(arrays_of(found), arrays_of(same), strict=True):
            scale = np.abs(right).max(initial=1e-300)
            np.testing.assert_allclose(left[one], right[two], rtol=RTOL, atol=RTOL * scale, err_msg=label)


# --- plans -------------------------------------------------------------------------------------------


def motion_of(lengths: dict[str, list[int]], forceless: set[str] = frozenset()) -> PreparedLog:
    trials = []
    for group, sizes in lengths.items():
        for i, n in enumerate(sizes):
            motion = repeated_motion(1, n / 10.0, 10.0, seed=i, group=group).trials[0]
            force = None if group in forceless else np.zeros((n, 2))
            trials.append(replace(motion, name=f"{group}.{i}", force=force))
    return PreparedLog(("x", "y"), tuple(trials))


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize(
    ("entries", "chunk", "most"), [(2**18, 512, 16), (3000, 512, 16), (500, 16, 2), (1, 5, 1)]
)
def test_every_sample_is_in_one_piece(monkeypatch, coupled, entries, chunk, most) -> None:
    monkeypatch.setattr(conditioning, "ENTRIES", entries)
    monkeypatch.setattr(conditioning, "CHUNK", chunk)
    monkeypatch.setattr(batches, "PIECES", most)
    generator = np.random.default_rng(1)
    lengths = {f"g{g}": generator.integers(5, 60, size=1 + g % 3).tolist() for g in range(20)}
    lengths["long"] = [400]
    log = motion_of(lengths, forceless={"g3", "g7"})
    seen: list[tuple[int, int]] = []
    for batch in batches.plan(log, log.select(lambda trial: trial.force is not None), coupled):
        for piece in batch.pieces:
            assert len(piece) == len(batch.target)
            seen += [(i, int(s)) for i, samples in zip(batch.target, piece, strict=True) for s in samples]
            per_group: dict[str, int] = {}
            for i, samples in zip(batch.target, piece, strict=True):
                per_group[log.trials[i].group] = per_group.get(log.trials[i].group, 0) + len(samples)
            assert max(per_group.values()) <= chunk
    assert sorted(seen) == [(i, s) for i, trial in enumerate(log.trials) for s in range(trial.n_samples)]


def test_batches_are_bounded_and_hold_groups_of_similar_length() -> None:
    generator = np.random.default_rng(2)
    lengths = {f"g{g}": [int(n)] for g, n in enumerate(generator.choice([20, 60, 300], size=90))}
    log = motion_of(lengths, forceless={"g0", "g1"})
    plan = batches.plan(log, log.select(lambda trial: trial.force is not None), coupled=False)
    assert len(plan) < 40
    for batch in plan:
        groups = {log.trials[i].group for i in batch.target}
        sizes = [log.trials[i].n_samples for i in batch.target]
        assert max(sizes) ** 2 * len(sizes) <= 1.3 * sum(size**2 for size in sizes)
        assert len(groups) == 1 or 2 * len(groups) * max(sizes) ** 2 <= conditioning.ENTRIES
        assert not batch.given or {log.trials[i].group for i in batch.target} == groups
        assert (groups <= {"g0", "g1"}) == (not batch.given)


def test_memory_does_not_grow_with_groups() -> None:
    """Beyond what the results hold: some thirty arrays of 2 MB, where one batch of all groups has 300 MB."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.inference_memory", "many", "150"],
        capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    assert json.loads(done.stdout)["beyond_mb"] < 150.0


# --- threads -----------------------------------------------------------------------------------------


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", ["phase", "coupled", "loop"])
def test_threads_change_no_bit(name: str, monkeypatch: pytest.MonkeyPatch, two_threads: None) -> None:
    config = config_of(name)
    log = uneven_log(config)
    monkeypatch.setattr(batches, "PIECES", 1)
    monkeypatch.setattr(conditioning, "CHUNK", 9)
    on_two = ImpedanceModel(config).posterior(log)
    torch.set_num_threads(1)
    assert bits_of(ImpedanceModel(config).posterior(log)) == bits_of(on_two)


def test_two_threads_are_at_work_and_each_is_one_of_torch(two_threads: None) -> None:
    log = motion_of({f"g{g}": [300] for g in range(8)})
    together = threading.Barrier(2, timeout=30.0)
    seen: list[tuple[str, int]] = []

    def work(batch: batches.Batch) -> Iterator[int]:
        # Nobody passes alone.
        together.wait()
        seen.append((threading.current_thread().name, torch.get_num_threads()))
        yield 1

    plan = batches.plan(log, log, coupled=False)
    assert len(plan) % 2 == 0
    batches.for_each(work, plan, len(plan))
    assert len({thread for thread, _ in seen}) == 2
    assert {count for _, count in seen} == {1}
    assert torch.get_num_threads() == 2


def test_only_a_large_batch_alone_has_all_threads(two_threads: None) -> None:
    seen = []

    def work(batch: batches.Batch) -> Iterator[int]:
        seen.append(torch.get_num_threads())
        yield 1

    for size in (batches.LARGE, batches.LARGE - 1):
        batches.for_each(work, [batches.Batch((), (), (), size)], 1)
    assert seen == [2, 1]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_one_batch_raises_ends_all(threads: int, error: type[BaseException], two_threads: None) -> None:
    torch.set_num_threads(threads)
    log = motion_of({f"g{g}": [300] for g in range(40)})
    plan = batches.plan(log, log, coupled=False)
    begun = []

    def work(batch: batches.Batch) -> Iterator[int]:
        begun.append(batch)
        if len(begun) == 3:
            raise error
        yield 1
        yield 1

    with pytest.raises(error):
        batches.for_each(work, plan, len(plan))
    assert len(begun) < len(plan)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("threads", [1, 2])
def test_progress_counts_samples_up_to_all(threads: int, two_threads: None) -> None:
    torch.set_num_threads(threads)
    config = config_of("phase")
    log = uneven_log(config)
    heard: list[tuple[int, int]] = []
    ImpedanceModel(config).posterior(log, progress=lambda done, total: heard.append((done, total)))
    assert {total for _, total in heard} == {log.n_samples}
    counts = [done for done, _ in heard]
    assert counts == sorted(counts)
    assert counts[-1] == log.n_samples


def test_a_covariance_without_factor_is_refused_from_any_thread(two_threads: None) -> None:
    """Two trials of the same motion without noise and jitter."""
    config = configuration(
        ("engine.jitter=0", "model.noise_sd=1e-12"), trajectory_input="phase", residual=None
    )
    drawn = uneven_log(config_of("phase"), forceless=False)
    trials = [
        replace(trial, name=f"{trial.name} {k}", time=trial.time + k)
        for trial in drawn.trials
        for k in range(2)
    ]
    with pytest.raises(NotPositiveDefiniteError, match="is not positive definite at row"):
        ImpedanceModel(config).posterior(PreparedLog(drawn.axes, tuple(trials)))
