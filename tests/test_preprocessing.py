"""Preprocessing: grids, filters and derivatives against polynomials, slow fits and linearity."""

import json
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from safetensors.numpy import load, save
from scipy.signal import savgol_filter

from bayes_impedance.config import Columns, LogConfig, PreprocessingConfig, Smoother, Units, Window
from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.preprocessing import PreparedLog, PreparedTrial, prepare
from bayes_impedance.readers import read_log

AS_LOGGED = PreprocessingConfig(smoother=None)


def smoother(window=0.1, order=4, **other):
    return PreprocessingConfig(smoother=Smoother(window=window, polynomial_order=order), **other)


def make(time, position, force=None, **optional):
    position = np.asarray(position)
    flat = position.ndim == 1
    axes = "x" if flat else "xyz"[: position.shape[1]]
    force = 1 + position if force is None else force
    return InteractionLog.from_arrays(time, position, force, axes=axes, **optional)


def only(log, config=None):
    """The single prepared trial of `log`."""
    (trial,) = prepare(log, config or PreprocessingConfig()).trials
    return trial


def jittered(n, step, seed=0, share=0.3):
    return np.arange(n) * step + np.random.default_rng(seed).uniform(-share, share, n) * step


# --- derivatives ---------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(
    st.integers(3, 7).flatmap(
        lambda order: st.tuples(
            st.just(order), st.lists(st.floats(-1, 1), min_size=order + 1, max_size=order + 1)
        )
    ),
    st.sampled_from([100.0, 250.0]),
)
def test_polynomials_are_reproduced_exactly(order_and_coefficients, rate):
    order, coefficients = order_and_coefficients
    time = 3 + np.arange(80) / rate
    # In units of the record length, so that every derivative is of order one there.
    span = time[-1] - time[0]
    path = Polynomial(np.array(coefficients) + 0.5, domain=[time[0], time[-1]], window=[-1, 1])
    log = make(time, path(time), reference=2 * path(time), perturbation=3 * path(time))
    trial = only(log, smoother(0.12, order))
    for derivative, name in enumerate(["position", "velocity", "acceleration", "jerk"]):
        expected = path.deriv(derivative)(time) if derivative else path(time)
        # Rounding of the position (1e-16) grows by the distance of samples, to the power of the derivative.
        tolerance = 1e-12 * (1 + 5 * rate**derivative + span**-derivative)
        np.testing.assert_allclose(getattr(trial, name)[:, 0], expected, rtol=1e-9, atol=tolerance)
        if derivative < 3:
            name = ["reference", "reference_velocity", "reference_acceleration"][derivative]
            np.testing.assert_allclose(
                getattr(trial, name)[:, 0], 2 * expected, rtol=1e-9, atol=2 * tolerance
            )
    np.testing.assert_allclose(trial.force[:, 0], 1 + path(time), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(trial.perturbation[:, 0], 3 * path(time), rtol=1e-12, atol=1e-12)


def slow(values, length, order, step, derivative):
    """Savitzky–Golay as a loop of least-squares fits, those at the ends to the first and last window."""
    half, n = length // 2, len(values)
    out = np.empty(n)
    for index in range(n):
        start = min(max(index - half, 0), n - length)
        offsets = (np.arange(start, start + length) - index) * step
        fit = Polynomial.fit(offsets, values[start : start + length], deg=order)
        out[index] = fit.deriv(derivative)(0.0) if derivative else fit(0.0)
    return out


@pytest.mark.parametrize(("length", "order"), [(5, 3), (9, 7), (51, 3), (51, 4)])
def test_agrees_with_scipy_where_that_is_accurate(length, order):
    path = np.cumsum(np.random.default_rng(6).normal(size=300)) * 1e-3
    trial = only(make(np.arange(300) * 0.001, path), smoother(length * 0.001, order))
    for derivative, name in enumerate(["position", "velocity", "acceleration", "jerk"]):
        expected = savgol_filter(path, length, order, deriv=derivative, delta=0.001, mode="interp")
        scale = np.abs(expected).max()
        np.testing.assert_allclose(getattr(trial, name)[:, 0], expected, rtol=0, atol=1e-7 * scale)


@pytest.mark.parametrize(("length", "order"), [(101, 7), (501, 7), (1501, 5)])
def test_long_windows_keep_their_digits(length, order):
    # scipy's savgol_filter returns zeros for the second of these, with no warning.
    time = np.arange(2000) * 0.001
    path = Polynomial([0.6, 0.3, -0.5, 0.2, 0.1, 0.05], domain=[0, 2], window=[-1, 1])
    trial = only(make(time, path(time)), smoother(length * 0.001, order))
    for derivative, name in enumerate(["position", "velocity", "acceleration", "jerk"]):
        expected = path.deriv(derivative)(time) if derivative else path(time)
        # Rounding of the position, 1e-16, over the half window to the power of the derivative.
        tolerance = 1e-13 * (50 / (length * 0.0005)) ** derivative
        np.testing.assert_allclose(getattr(trial, name)[:, 0], expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("logged", [(), ("velocity",), ("acceleration",), ("velocity", "acceleration")])
def test_every_channel_sees_the_same_filter(logged):
    rng = np.random.default_rng(1)
    time = np.arange(60) * 0.01
    channels = ("force", "reference", "perturbation", *logged)
    noise = {name: rng.normal(size=60) for name in channels}
    position = rng.normal(size=60)
    trial = only(make(time, position, **noise))

    def expected(values, derivative):
        return slow(values, 11, 4, 0.01, derivative)

    sources = [position, noise.get("velocity"), noise.get("acceleration")]
    for rank, name in enumerate(["position", "velocity", "acceleration", "jerk"]):
        # From the highest derivative that was logged, at or below the one wanted.
        source = max(index for index in range(min(rank, 2) + 1) if sources[index] is not None)
        np.testing.assert_allclose(
            getattr(trial, name)[:, 0], expected(sources[source], rank - source), rtol=1e-8, atol=1e-8
        )
    for name in ("force", "reference", "perturbation"):
        np.testing.assert_allclose(getattr(trial, name)[:, 0], expected(noise[name], 0), rtol=1e-8, atol=1e-9)
    for derivative, name in enumerate(["reference_velocity", "reference_acceleration"], start=1):
        np.testing.assert_allclose(
            getattr(trial, name)[:, 0], expected(noise["reference"], derivative), rtol=1e-8, atol=1e-8
        )


@pytest.mark.parametrize("window", [0.03, 0.1, 0.5])
def test_a_linear_law_survives_smoothing(window):
    rng = np.random.default_rng(2)
    mass, damping, stiffness = 1.3, 9.0, 120.0
    position, velocity, acceleration = rng.normal(size=(3, 500, 2))
    force = mass * acceleration + damping * velocity + stiffness * position
    trial = only(
        make(np.arange(500) * 0.002, position, force, velocity=velocity, acceleration=acceleration),
        smoother(window),
    )
    law = mass * trial.acceleration + damping * trial.velocity + stiffness * trial.position
    np.testing.assert_allclose(trial.force, law, rtol=0, atol=1e-9)


def test_smoothing_both_sides_keeps_the_stiffness():
    # docs/model.md §6: micrometre noise, differentiated twice without a filter, swamps acceleration and with it k.
    rng = np.random.default_rng(3)
    time = np.arange(4000) * 0.001
    omega = 2 * np.pi * np.array([0.7, 1.9, 3.1])[:, None]
    amplitude = np.array([0.03, 0.01, 0.004])[:, None]
    position = (amplitude * np.sin(omega * time)).sum(0)
    velocity = (amplitude * omega * np.cos(omega * time)).sum(0)
    acceleration = -(amplitude * omega**2 * np.sin(omega * time)).sum(0)
    force = -(1.2 * acceleration + 9 * velocity + 100 * position)
    trial = only(make(time, position + 1e-6 * rng.normal(size=4000), force))
    design = -np.hstack([trial.acceleration, trial.velocity, trial.position])
    mass, damping, stiffness = np.linalg.lstsq(design, trial.force[:, 0], rcond=None)[0]
    assert stiffness == pytest.approx(100, rel=0.01)
    assert damping == pytest.approx(9, rel=0.01)
    assert mass == pytest.approx(1.2, rel=0.02)


# --- grid, window, rate --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("window", "rate", "order", "length"),
    [(0.1, 100, 4, 11), (0.099, 100, 4, 9), (0.1, 1000, 4, 101), (0.05, 100, 3, 5), (0.09, 100, 5, 9)],
)
def test_window_is_the_nearest_odd_number_of_samples(window, rate, order, length):
    values = np.random.default_rng(4).normal(size=200)
    trial = only(make(np.arange(200) / rate, values), smoother(window, order))
    np.testing.assert_allclose(trial.position[:, 0], slow(values, length, order, 1 / rate, 0), atol=1e-9)


@pytest.mark.parametrize(("order", "length"), [(3, 5), (4, 7), (5, 7), (6, 9)])
def test_a_window_too_short_for_the_order_grows_with_a_warning(order, length):
    values = np.random.default_rng(4).normal(size=50)
    log = make(np.arange(50) / 20, values)
    message = (
        rf"too short for order {order} at 20 Hz, so its window is {length / 20:.3g} s \({length} samples"
    )
    with pytest.warns(LogWarning, match=message):
        trial = only(log, smoother(0.1, order))
    np.testing.assert_allclose(trial.position[:, 0], slow(values, length, order, 1 / 20, 0), atol=1e-9)


def test_uneven_sampling():
    omega, step = 2 * np.pi, 0.005
    time = jittered(800, step)
    path = [np.sin, np.cos, lambda x: -np.sin(x), lambda x: -np.cos(x)]
    truth = np.sin(omega * time)
    trial = only(make(time, np.sin(omega * time), truth={"stiffness_xx": truth}), smoother(0.15))
    steps = np.diff(trial.time)
    np.testing.assert_allclose(steps, np.median(np.diff(time)), rtol=1e-9)
    assert trial.time[0] == time[0] and time[-1] - steps[0] < trial.time[-1] <= time[-1]
    # A monotone cubic errs by at most h²/8 |x''| at a turning point, with h the largest step: 1.3e-4.
    h = np.diff(time).max()
    np.testing.assert_allclose(trial.position[:, 0], np.sin(omega * trial.time), atol=(h * omega) ** 2 / 8)
    np.testing.assert_allclose(trial.force[:, 0], 1 + np.sin(omega * trial.time), atol=(h * omega) ** 2 / 8)
    np.testing.assert_allclose(
        trial.truth["stiffness_xx"], np.sin(omega * trial.time), atol=(h * omega) ** 2 / 8
    )
    inside = slice(15, -15)
    for derivative, name, tolerance in [(1, "velocity", 0.003), (2, "acceleration", 0.02)]:
        expected = omega**derivative * path[derivative](omega * trial.time)
        np.testing.assert_allclose(
            getattr(trial, name)[inside, 0], expected[inside], atol=tolerance * omega**derivative
        )


def test_small_jitter_is_left_alone():
    time = jittered(100, 0.01, share=0.004)
    trial = only(make(time, np.sin(time)))
    np.testing.assert_array_equal(trial.time, time)


def test_gap():
    time = np.arange(200) * 0.01
    time[120:] += 0.6
    log = make(time, np.sin(time))
    with pytest.raises(
        LogError,
        match=r"memory, trial '0': expected steps of at most 0.5 s, found a gap of 0.61 s from 1.19 to 1.8 s; "
        r"cut there with log.window, or raise preprocessing.max_gap",
    ):
        prepare(log, PreprocessingConfig())
    with pytest.raises(LogError, match=r"found a gap of 0.61 s"):
        prepare(log, AS_LOGGED)
    assert only(log, PreprocessingConfig(max_gap=0.7)).n_samples == 260
    # A step of exactly max_gap is no gap, whatever its rounding.
    assert only(make(np.arange(99) * 0.1, np.arange(99) / 99), smoother(1.0, max_gap=0.1)).n_samples == 99


def test_too_few_samples_for_the_window():
    time = np.arange(10) * 0.01
    with pytest.raises(
        LogError, match=r"trial '0': expected at least 11 samples, one window .*\(0.11 s\), found 10; shorten"
    ):
        prepare(make(time, np.sin(time)), PreprocessingConfig())


@pytest.mark.parametrize(
    ("rate", "every"), [(100, 1), (100.5, 1), (70, 1), (60, 2), (50, 2), (20, 5), (0.01, 10000)]
)
def test_rate(rate, every):
    time = np.arange(100) * 0.01
    optional = {"phase": time, "reference": time, "perturbation": time, "truth": {"mass_xx": time}}
    log = make(time, np.sin(time), repetition=np.zeros(100), **optional)
    full, thin = only(log), only(log, PreprocessingConfig(rate=rate))
    for name in PreparedTrial.__slots__:
        if isinstance(getattr(full, name), np.ndarray):
            np.testing.assert_array_equal(getattr(thin, name), getattr(full, name)[::every], err_msg=name)
    np.testing.assert_array_equal(thin.truth["mass_xx"], time[::every])


def test_rate_above_the_native_one():
    time = np.arange(100) * 0.01
    with pytest.raises(
        LogError, match=r"preprocessing.rate of at most the native rate, 100 Hz, found 120 Hz; lower"
    ):
        prepare(make(time, np.sin(time)), PreprocessingConfig(rate=120))


# --- phase and repetitions -----------------------------------------------------------------------


def two_repetitions(lengths=(60, 40), step=0.01):
    """Cubic phases that jump back between repetitions, as time, phase and derivatives, repetition, polynomials."""
    time = np.arange(sum(lengths)) * step
    edges = np.concatenate([[0], np.cumsum(lengths)])
    phase, exact = np.empty((3, len(time))), []
    for start, end in pairwise(edges):
        part = Polynomial([0.5, 0.35, 0, 0.1], domain=[time[start], time[end - 1]], window=[-1, 1])
        exact.append(part)
        for derivative in range(3):
            curve = part.deriv(derivative) if derivative else part
            phase[derivative, start:end] = curve(time[start:end])
    return time, phase, np.repeat(np.arange(len(lengths)), lengths), exact


@pytest.mark.parametrize("lengths", [(60, 40), (60, 8), (7, 60, 9), (5, 60)])
def test_phase_is_differentiated_within_repetitions(lengths):
    time, phase, repetition, _ = two_repetitions(lengths)
    trial = only(make(time, np.sin(time), phase=phase[0], repetition=repetition))
    np.testing.assert_allclose(trial.phase, phase[0], atol=1e-12)
    np.testing.assert_allclose(trial.phase_velocity, phase[1], rtol=1e-9)
    np.testing.assert_allclose(trial.phase_acceleration, phase[2], rtol=1e-7, atol=1e-7)
    np.testing.assert_array_equal(trial.repetition, repetition)


def test_phase_of_a_repetition_of_two_samples_is_a_line():
    phase, repetition = np.append(np.linspace(0, 1, 50), [0.2, 0.4]), np.repeat([0, 1], [50, 2])
    time = np.arange(52) * 0.01
    for config in (PreprocessingConfig(), AS_LOGGED):
        log = make(time, np.sin(time), phase=phase, repetition=repetition, velocity=time, acceleration=time)
        trial = only(log, config)
        np.testing.assert_allclose(trial.phase_velocity[50:], 20)
        np.testing.assert_allclose(trial.phase_acceleration[50:], 0, atol=1e-9)


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("config", [PreprocessingConfig(), AS_LOGGED])
def test_phase_of_a_repetition_of_one_sample_is_refused(even, config):
    time = np.arange(50) * 0.01 if even else jittered(50, 0.01)
    phase, repetition = np.append(np.linspace(0, 1, 49), 0.2), np.repeat([0, 1], [49, 1])
    log = make(time, np.sin(time), phase=phase, repetition=repetition, velocity=time, acceleration=time)
    with pytest.raises(
        LogError, match=r"at least two samples in a repetition, .* found one at 0.49.* s; cut it off"
    ):
        prepare(log, config)
    # Without phase there is nothing to differentiate.
    prepare(make(time, np.sin(time), repetition=repetition, velocity=time, acceleration=time), config)


def test_smoothed_phase_must_increase():
    time = np.arange(100) * 0.01
    # A jump between two near-pauses: the filter overshoots on both sides of it.
    phase = np.where(time < 0.5, 0.1, 0.9) + 1e-6 * time
    with pytest.raises(
        LogError, match=r"expected smoothed phase to increase within repetition 0, found it resting"
    ):
        prepare(make(time, np.sin(time), phase=phase), PreprocessingConfig())


def test_uneven_sampling_across_repetitions():
    even, _, _, exact = two_repetitions((200, 150))
    time = jittered(len(even), 0.01)
    repetition = np.repeat([0, 1], [200, 150])
    phase = np.where(repetition == 0, exact[0](time), exact[1](time))
    phase = np.clip(phase, 0, 1)
    trial = only(make(time, np.sin(time), phase=phase, repetition=repetition), smoother(0.15))
    # The nearest sample of the log decides, by a slow loop; only next to the jump does it matter.
    nearest = [repetition[np.argmin(np.abs(time - instant))] for instant in trial.time]
    np.testing.assert_array_equal(trial.repetition, nearest)
    expected = np.where(trial.repetition == 0, exact[0](trial.time), exact[1](trial.time))
    # No sample in between the two phases: nothing was interpolated across the jump.
    np.testing.assert_allclose(trial.phase, expected, atol=1e-3)
    rates = np.where(trial.repetition == 0, exact[0].deriv()(trial.time), exact[1].deriv()(trial.time))
    np.testing.assert_allclose(trial.phase_velocity, rates, rtol=0.1)


def test_a_long_step_between_repetitions_is_halved_between_them():
    time = np.append(np.arange(50) * 0.01, 0.90 + np.arange(50) * 0.01)
    repetition, phase = np.repeat([0, 1], 50), np.tile(np.linspace(0.2, 0.8, 50), 2)
    trial = only(make(time, np.sin(time), phase=phase, repetition=repetition))
    np.testing.assert_array_equal(trial.repetition, trial.time > 0.695)
    # Each phase goes on at the slope it has at its end.
    slope = 0.6 / 49 / 0.01
    np.testing.assert_allclose(trial.phase_velocity, slope, rtol=1e-9)
    first = trial.time < 0.695
    np.testing.assert_allclose(trial.phase[first], 0.2 + slope * trial.time[first])


# --- without smoother ----------------------------------------------------------------------------


def test_without_smoother_values_stay():
    rng = np.random.default_rng(5)
    time = jittered(40, 0.01)
    names = ("velocity", "acceleration", "reference", "perturbation")
    optional = {name: rng.normal(size=(40, 2)) for name in names}
    position, force = rng.normal(size=(2, 40, 2))
    phase, repetition = np.tile(np.linspace(0, 1, 20) ** 2, 2), np.repeat([0, 1], 20)
    truth = {"damping_xx": time}
    trial = only(
        make(time, position, force, phase=phase, repetition=repetition, truth=truth, **optional), AS_LOGGED
    )
    for name, values in {
        "time": time,
        "position": position,
        "force": force,
        "phase": phase,
        **optional,
    }.items():
        np.testing.assert_array_equal(getattr(trial, name), values)
    np.testing.assert_array_equal(trial.truth["damping_xx"], time)
    np.testing.assert_array_equal(trial.jerk, np.gradient(optional["acceleration"], time, axis=0))
    reference = np.gradient(optional["reference"], time, axis=0)
    np.testing.assert_array_equal(trial.reference_velocity, reference)
    np.testing.assert_array_equal(trial.reference_acceleration, np.gradient(reference, time, axis=0))
    for part in (slice(0, 20), slice(20, 40)):
        rate = np.gradient(phase[part], time[part])
        np.testing.assert_array_equal(trial.phase_velocity[part], rate)
        np.testing.assert_array_equal(trial.phase_acceleration[part], np.gradient(rate, time[part]))


@pytest.mark.parametrize(("given_", "lacking"), [("velocity", "acceleration"), ("acceleration", "velocity")])
def test_without_smoother_derivatives_must_be_logged(given_, lacking):
    time = np.arange(40) * 0.01
    with pytest.raises(LogError, match=f"not smoothed, found no {lacking}; set preprocessing.smoother"):
        prepare(make(time, np.sin(time), **{given_: time}), AS_LOGGED)


# --- prepared logs -------------------------------------------------------------------------------

values = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def prepared_logs(draw):
    axes = draw(st.sampled_from([("x",), ("z", "x"), ("x", "y", "z")]))
    trials = []
    for index in range(draw(st.integers(1, 3))):
        n = draw(st.integers(1, 4))

        def array(*shape):
            size = int(np.prod(shape))
            return np.array(draw(st.lists(values, min_size=size, max_size=size))).reshape(shape)

        vectors = ["position", "velocity", "acceleration", "jerk"]
        optional = ["force", "reference", "reference_velocity", "reference_acceleration", "perturbation"]
        vectors += sorted(draw(st.sets(st.sampled_from(optional))))
        scalars = sorted(draw(st.sets(st.sampled_from(["phase", "phase_velocity", "phase_acceleration"]))))
        truths = sorted(draw(st.sets(st.sampled_from(["stiffness_xx", "desired_position_x"]))))
        trials.append(
            PreparedTrial(
                name=f"{index}.a",
                group=draw(st.text(max_size=3)),
                source="a/b.csv",
                time=array(n),
                repetition=np.arange(n),
                truth={name: array(n) for name in truths},
                **{name: array(n, len(axes)) for name in vectors},
                **{name: array(n) for name in scalars},
            )
        )
    return PreparedLog(axes, tuple(trials))


@settings(max_examples=50, deadline=None)
@given(prepared_logs())
def test_arrays_round_trip(log):
    header = json.loads(json.dumps(log.header()))
    other = PreparedLog.from_arrays(header, load(save(log.arrays())))
    assert other.axes == log.axes and other.groups == log.groups
    assert other.fingerprint() == log.fingerprint()
    assert other.header() == log.header()
    for mine, its in zip(log.trials, other.trials, strict=True):
        assert sorted(mine.truth) == sorted(its.truth)
        for name in PreparedTrial.__slots__:
            value = getattr(mine, name)
            if isinstance(value, np.ndarray):
                assert (
                    getattr(its, name).tobytes() == value.tobytes()
                    and getattr(its, name).dtype == value.dtype
                )
                assert not getattr(its, name).flags.writeable
            elif name != "truth":
                assert getattr(its, name) == value


def three_trials():
    time = np.arange(30) * 0.01
    trials = tuple(
        Trial(
            str(index), f"S{index % 2}", "a.csv", time, np.sin(time + index)[:, None], truth={"mass_xx": time}
        )
        for index in range(3)
    )
    return prepare(InteractionLog(("x",), trials), PreprocessingConfig())


def test_prepared_log():
    log = three_trials()
    assert log.groups == ("S0", "S1") and log.n_samples == 90
    assert repr(log) == "PreparedLog(axes=x, 3 trials, 90 samples)"
    assert repr(log.trials[1]) == "PreparedTrial('1', group='S1', source='a.csv', 30 samples)"
    assert {"trials.2.position", "trials.0.truth.mass_xx", "trials.1.repetition"} <= set(log.arrays())
    assert log.header() == {
        "axes": ["x"],
        "trials": [{"name": str(index), "group": f"S{index % 2}", "source": "a.csv"} for index in range(3)],
    }
    assert [trial.name for trial in log.select(lambda trial: trial.group == "S0").trials] == ["0", "2"]
    assert [trial.name for trial in log.select([2]).trials] == ["2"]
    assert log.select([0]).fingerprint() != log.fingerprint() == three_trials().fingerprint()
    with pytest.raises(LogError, match="expected indices of trials between 0 and 2, found 3"):
        log.select([3])
    with pytest.raises(ValueError, match="read-only"):
        log.trials[0].jerk[0] = 0
    assert log.trials[0].force is None


def test_from_arrays_refuses():
    log = three_trials()
    arrays = log.arrays()
    del arrays["trials.1.jerk"]
    with pytest.raises(
        LogError, match=r"stored log: expected an array trials.1.jerk, found none; store the log anew"
    ):
        PreparedLog.from_arrays(log.header(), arrays)
    for name in ("trials.3.position", "trials.0.junk", "weights"):
        with pytest.raises(LogError, match=f"expected arrays of 3 trials, found '{name}' besides"):
            PreparedLog.from_arrays(log.header(), log.arrays() | {name: np.zeros(2)})
    for header in (
        {},
        {"axes": ["x"]},
        {"axes": ["x"], "trials": [{"name": "0"}]},
        {"axes": ["x"], "trials": ["0"]},
    ):
        with pytest.raises(LogError, match="expected axes and trials in the header, found another one"):
            PreparedLog.from_arrays(header, log.arrays())


# --- real recordings -----------------------------------------------------------------------------


def test_iiwa_gives_its_known_stiffness(shared_data):
    (path,) = (shared_data / "iiwa_known_equilibrium").glob("*.txt")
    columns = Columns(position="{axis}", force="f_{axis}", reference="{axis}0", velocity="d{axis}")
    config = LogConfig(
        axes=("z",), columns=columns, force_direction="robot_on_human", window=Window(start=6.0)
    )
    trial = only(read_log(path, config))
    displacement = (trial.reference - trial.position)[:, 0]
    # The data's own README: 138 N/m with an offset in the regression, 144 without.
    assert np.polyfit(displacement, trial.force[:, 0], 1)[0] == pytest.approx(138, abs=1)
    assert displacement @ trial.force[:, 0] / (displacement @ displacement) == pytest.approx(144, abs=1)


def test_delta_robot_is_put_on_an_even_grid(shared_data):
    path = shared_data / "delta_robot" / "pHRI_test_experiment_dataset.csv"
    columns = Columns(time="t", position="{axis}", force="F{axis}", velocity="v{axis}")
    log = read_log(path, LogConfig(columns=columns, units=Units(position="mm", velocity="mm/s")))
    with pytest.warns(
        LogWarning, match=r"0.1 s is too short for order 4 at 21.28 Hz, so its window is 0.329 s"
    ):
        trial = only(log)
    np.testing.assert_allclose(np.diff(trial.time), 0.047, rtol=1e-6)
    assert trial.n_samples == pytest.approx(55.04 / 0.047, abs=2)
    assert np.isfinite(trial.jerk).all()
