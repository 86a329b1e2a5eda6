"""Alignment of phase: known bends found again, one reference for all logs, and the same bits after save and load."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat
from scipy.ndimage import gaussian_filter1d

from bayes_impedance.config import PhaseConfig, PreprocessingConfig, load_config
from bayes_impedance.errors import LogError
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import load_model, save_model
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial, prepare
from bayes_impedance.preprocessing.warping import LEAST_SLOPE, align

WARPING = PhaseConfig(source="warping")


def symbol(u):
    """A path with corners of different sharpness, 0.1 m by 0.15 m."""
    return np.stack(
        [0.09 * u + 0.03 * np.sin(4 * np.pi * u), 0.15 * u * (1 - 0.3 * np.cos(3 * np.pi * u))], -1
    )


def progressed(name, duration, position, n=400, group="0"):
    """A prepared trial of one repetition with progress s = (t/T + (t/T)³) / 2 and its exact rates."""
    t = np.linspace(0, 1, n)
    s, pace, change = 0.5 * (t + t**3), 0.5 * (1 + 3 * t**2), 3 * t
    zeros = np.zeros((n, 2))
    return PreparedTrial(
        name, group, "memory", duration * t, position(s), zeros, zeros, zeros, np.zeros(n, dtype=np.int64),
        phase=s, phase_velocity=pace / duration, phase_acceleration=change / duration**2,
    )  # fmt: skip


def pair(bend, **other):
    """A reference along `symbol`, and a trial that is at progress s where the reference is at bend(s)."""
    return PreparedLog(
        ("x", "y"),
        (progressed("reference", 2.0, symbol), progressed("bent", 3.0, lambda s: symbol(bend(s)), **other)),
    )


BENDS = {
    "none": lambda s: s,
    "ahead": lambda s: s + 0.08 * np.sin(2 * np.pi * s),
    "to and fro": lambda s: s - 0.04 * np.sin(4 * np.pi * s),
}


@pytest.mark.parametrize("name", BENDS)
@pytest.mark.parametrize("knots", [8, 16])
def test_a_bent_path_is_aligned_back(name, knots):
    bend = BENDS[name]
    log = pair(bend)
    reference, bent = align(log, PhaseConfig(source="warping", knots=knots, reference="reference")).trials
    np.testing.assert_array_equal(reference.phase, log.trials[0].phase)
    # Warping rounds to places 1/300 apart, 1e-3 (SD); the fit of some ten coefficients to 300 pairs makes 2e-4 of it.
    assert np.sqrt(np.mean((bent.phase - bend(log.trials[1].phase)) ** 2)) < 5e-4
    gap = np.linalg.norm(bent.position - symbol(bent.phase), axis=1)
    assert gap.max() < 1e-3
    assert (bent.phase[0], bent.phase[-1]) == (0.0, 1.0)


@pytest.mark.parametrize("name", BENDS)
def test_noise_bends_little(name):
    rng = np.random.default_rng(5)
    wander = gaussian_filter1d(rng.normal(size=(400, 2)), 15, axis=0)
    wander *= 1e-3 / wander.std()
    log = pair(BENDS[name])
    log = replace(
        log, trials=(log.trials[0], replace(log.trials[1], position=log.trials[1].position + wander))
    )
    bent = align(log, PhaseConfig(source="warping", reference="reference")).trials[1]
    # One millimetre on a path of some 0.3 m, and more where it turns.
    assert np.sqrt(np.mean((bent.phase - BENDS[name](log.trials[1].phase)) ** 2)) < 2 * 1e-3 / 0.3


@pytest.mark.parametrize("n_axes", [1, 3])
def test_one_and_three_axes_are_aligned_as_two_are(n_axes):
    """An axis that rests changes nothing; a reach along one axis is told by that alone."""

    def of(log, chosen):
        trials = tuple(
            replace(t, **{k: chosen(getattr(t, k)) for k in ("position", "velocity", "acceleration", "jerk")})
            for t in log.trials
        )
        return PreparedLog(("x", "y", "z")[:n_axes], trials)

    log = pair(BENDS["ahead"])
    changed = of(log, lambda v: v[:, 1:] if n_axes == 1 else np.pad(v, ((0, 0), (0, 1))))
    alike = of(log, lambda v: np.pad(v[:, 1:], ((0, 0), (0, 1)))) if n_axes == 1 else log
    phases = [align(each, WARPING).trials[1].phase for each in (changed, replace(alike, axes=("x", "y")))]
    np.testing.assert_allclose(*phases, atol=1e-12)


def test_rates_follow_by_the_chain_rule():
    bent = align(pair(BENDS["ahead"], n=4000), PhaseConfig(source="warping", reference="reference")).trials[1]
    inner = slice(2, -2)
    rate, change = np.gradient(bent.phase, bent.time), np.gradient(bent.phase_velocity, bent.time)
    np.testing.assert_allclose(bent.phase_velocity[inner], rate[inner], atol=1e-5)
    # h''' has jumps at the knots.
    np.testing.assert_allclose(bent.phase_acceleration[inner], change[inner], atol=0.02)
    assert np.abs(np.diff(bent.phase_acceleration)).max() < 0.05


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), knots=st.sampled_from([1, 3, 8, 100]))
def test_any_two_paths_give_an_increasing_phase(seed, knots):
    rng = np.random.default_rng(seed)
    paths = np.cumsum(rng.normal(size=(2, 400, 2)), axis=1) * 10.0 ** rng.uniform(-6, 3)
    log = pair(lambda s: s)
    log = replace(log, trials=tuple(replace(t, position=p) for t, p in zip(log.trials, paths, strict=True)))
    for before, after in zip(
        log.trials, align(log, PhaseConfig(source="warping", knots=knots)).trials, strict=True
    ):
        assert after.phase[0] == 0.0 and after.phase.max() <= 1.0
        np.testing.assert_allclose(after.phase[-1], 1.0, rtol=0, atol=1e-12)
        assert (np.diff(after.phase) > 0).all()
        assert (after.phase_velocity >= LEAST_SLOPE * before.phase_velocity * (1 - 1e-12)).all()


# --- which repetition is the reference -----------------------------------------------------------


def five(groups="aaaaa"):
    durations = [2.0, 5.0, 3.0, 4.0, 1.0]
    return PreparedLog(
        ("x", "y"),
        tuple(
            progressed(
                str(i),
                duration,
                lambda s, i=i: symbol(s + (i - 2) * 0.02 * np.sin(2 * np.pi * s)),
                group=group,
            )
            for i, (duration, group) in enumerate(zip(durations, groups, strict=True))
        ),
    )


def unchanged(before, after):
    return [
        t.name for t, u in zip(before.trials, after.trials, strict=True) if np.array_equal(t.phase, u.phase)
    ]


def test_the_reference_has_the_median_duration_or_the_name_given():
    assert unchanged(five(), align(five(), WARPING)) == ["2"]
    assert unchanged(five(), align(five(), PhaseConfig(source="warping", reference="3"))) == ["3"]
    # Each group has its own; of an even number, the shorter of the middle two.
    groups = five("aabbb")
    assert unchanged(groups, align(groups, WARPING)) == ["0", "2"]
    with pytest.raises(
        LogError,
        match=r"group 'a': expected a trial '3' to align with, found '0', '1'; change preprocessing\.phase\.reference",
    ):
        align(groups, PhaseConfig(source="warping", reference="3"))


def test_a_log_is_aligned_to_one_aligned_before():
    whole = align(five(), WARPING)
    alone = align(five().select([4]), WARPING, whole)
    np.testing.assert_array_equal(alone.trials[0].phase, whole.trials[4].phase)
    # Without the reference itself any of its repetitions stands for it, up to the distance of the paths.
    rest = align(five().select([4]), WARPING, whole.select([0, 1, 3]))
    np.testing.assert_allclose(rest.trials[0].phase, whole.trials[4].phase, atol=3e-3)
    # A group that it does not hold has a reference of its own.
    other = five("aaaab").select([4])
    np.testing.assert_array_equal(align(other, WARPING, whole).trials[0].phase, other.trials[0].phase)


def test_thinning_may_leave_too_little():
    time = np.arange(300) * 0.01
    log = InteractionLog.from_arrays(time, symbol(time / 3), 1 + symbol(time / 3), axes=["x", "y"])
    with pytest.raises(
        LogError,
        match=r"memory, trial '0': expected at least two samples in a repetition that is to be aligned, found one at "
        r"0 s; raise preprocessing\.rate",
    ):
        prepare(log, PreprocessingConfig(phase=WARPING, rate=0.1))


def traced(seed, duration):
    """A symbol traced with a detour, in time that is not even."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, duration, 0.01)
    t = time / duration
    u = t + 0.1 * rng.uniform(-1, 1) * np.sin(2 * np.pi * t)
    detour = 0.03 * rng.uniform() * np.exp(-(((u - 0.4) / 0.1) ** 2))
    position = symbol(u) + np.stack([detour, 0 * u], -1)
    force = rng.normal(size=2) + np.stack([np.sin(3 * u), np.cos(5 * u)], -1)
    return InteractionLog.from_arrays(time, position, force, axes=["x", "y"], trial=str(seed)).trials[0]


def test_a_model_aligns_every_log_to_its_training_log(tmp_path):
    config = load_config(
        "phase",
        [
            "preprocessing.phase.source=warping",
            "preprocessing.rate=10",
            "training.restarts=1",
            "training.max_iterations=1",
        ],
    )
    log = InteractionLog(
        ("x", "y"), tuple(traced(seed, duration) for seed, duration in enumerate([3.0, 2.0, 2.5]))
    )
    model = ImpedanceModel(config).fit(log)
    save_model(model, tmp_path / "model")
    unseen = InteractionLog(("x", "y"), (traced(7, 4.0),))
    expected = prepare(unseen, config.preprocessing, model.fitted.log)
    assert expected.fingerprint() != prepare(unseen, config.preprocessing).fingerprint()
    for each in (model, load_model(tmp_path / "model")):
        assert each.prepare(log).fingerprint() == model.fitted.log.fingerprint()
        assert each.prepare(unseen).fingerprint() == expected.fingerprint()


# --- a real recording ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def panda(request):
    """Six times the same symbol; x and y."""
    file = request.getfixturevalue("shared_data") / "panda_comanipulation" / "symbol_17_data.mat"
    trials = []
    for number, (position, _, force) in enumerate(loadmat(file)["symbol_data"][0]):
        time = np.arange(position.shape[1]) / 1000.0
        log = InteractionLog.from_arrays(
            time, position[:2].T, force[:2].T, axes=["x", "y"], trial=str(number)
        )
        trials += log.trials
    return InteractionLog(("x", "y"), tuple(trials))


def spread(trials, phases):
    """RMS deviation of position from the mean of the trials at equal phase [m]."""
    grid = np.linspace(0, 1, 401)
    paths = np.stack(
        [
            np.stack([np.interp(grid, phase, column) for column in trial.position.T], -1)
            for trial, phase in zip(trials, phases, strict=True)
        ]
    )
    return np.sqrt(((paths - paths.mean(axis=0)) ** 2).sum(-1).mean())


def test_traces_of_one_symbol_agree_at_equal_phase(panda):
    def prepared(source):
        return prepare(
            panda,
            PreprocessingConfig(
                segmentation={"trim_rest": True},
                smoother={"window": 0.2},
                phase={"source": source},
                rate=20,
            ),
        ).trials

    trials = prepared("path")
    assert len(trials) == 6
    raw = {trial.name: trial for trial in panda.trials}
    for trial in trials:
        assert 0.4 < trial.time[0] < 2.1
        assert 0.8 < raw[trial.name].time[-1] - trial.time[-1] < 1.4
    even = [(trial.time - trial.time[0]) / np.ptp(trial.time) for trial in trials]
    by_time = spread(trials, even)
    by_path = spread(trials, [trial.phase for trial in trials])
    warped = prepared("warping")
    by_warping = spread(warped, [trial.phase for trial in warped])
    # The traces themselves lie 4 mm (rms) apart, wherever one looks; pauses of over a second spoil time as phase.
    assert by_time > 15e-3
    assert by_path < 7e-3
    assert by_warping < 0.8 * by_path
