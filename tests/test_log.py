"""Interaction logs: what they accept, refuse and keep."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayes_impedance.errors import LogError, LogWarning
from bayes_impedance.log import InteractionLog, RowNumbers, Trial


def arrays(n=20, axes="xy", **changes):
    """Valid keyword arguments of InteractionLog.from_arrays."""
    time = np.arange(n) * 0.01
    position = np.stack([np.sin(time + index) for index in range(len(axes))], axis=-1)
    return {"time": time, "position": position, "force": 1 + position, "axes": axes} | changes


def make(n=20, axes="xy", **changes):
    return InteractionLog.from_arrays(**arrays(n, axes, **changes))


def changed(values, index, value):
    values = np.array(values, dtype=float)
    values[index] = value
    return values


def test_keeps_what_it_was_given():
    given_ = arrays()
    phase = np.linspace(0, 1, 20)
    log = make(
        group="A",
        trial="t",
        velocity=given_["position"] * 2,
        acceleration=given_["position"] * 3,
        reference=given_["position"] * 4,
        perturbation=given_["position"] * 5,
        phase=phase,
        truth={"stiffness_xy": phase, "desired_position_x": phase},
    )
    (trial,) = log.trials
    assert (trial.name, trial.group, trial.source) == ("t", "A", "memory")
    np.testing.assert_array_equal(trial.time, given_["time"])
    for factor, name in enumerate(
        ["position", "velocity", "acceleration", "reference", "perturbation"], start=1
    ):
        np.testing.assert_array_equal(getattr(trial, name), given_["position"] * factor)
    np.testing.assert_array_equal(trial.force, given_["force"])
    np.testing.assert_array_equal(trial.phase, phase)
    np.testing.assert_array_equal(trial.truth["stiffness_xy"], phase)
    np.testing.assert_array_equal(trial.repetition, np.zeros(20))
    assert trial.repetition.dtype == np.int64
    assert (log.axes, log.groups, log.n_samples) == (("x", "y"), ("A",), 20)
    assert repr(log) == "InteractionLog(axes=xy, 1 trials, 20 samples)"
    assert repr(trial) == "Trial('t', group='A', source='memory', 20 samples)"


def test_converts_copies_and_freezes():
    position = np.asfortranarray(np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32))
    log = make(position=position, force=np.ones((20, 2), dtype=int).tolist(), truth={"mass_xx": np.ones(20)})
    trial = log.trials[0]
    for array in (trial.time, trial.position, trial.force, trial.repetition, trial.truth["mass_xx"]):
        assert array.flags.c_contiguous and not array.flags.writeable
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    assert trial.position.dtype == trial.force.dtype == np.float64
    before = trial.position.copy()
    position += 1
    np.testing.assert_array_equal(trial.position, before)


def test_single_axis_takes_flat_vectors_and_no_force():
    log = make(axes="z", position=np.arange(20.0) / 10, force=None)
    assert log.trials[0].position.shape == (20, 1)
    assert log.trials[0].force is None


def test_repetitions_are_coded_in_order_of_appearance():
    labels = np.repeat(["late", "early", "b"], [5, 10, 5])
    np.testing.assert_array_equal(
        make(repetition=labels).trials[0].repetition, np.repeat([0, 1, 2], [5, 10, 5])
    )
    numbers = np.repeat([7.0, 3.0], 10)
    np.testing.assert_array_equal(make(repetition=numbers).trials[0].repetition, np.repeat([0, 1], 10))


def test_phase_may_restart_with_each_repetition():
    phase = np.tile(np.linspace(0, 1, 10), 2)
    log = make(phase=phase, repetition=np.repeat([1, 2], 10))
    np.testing.assert_array_equal(log.trials[0].phase, phase)


TWENTY = np.arange(20) * 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": "xw"}, r"axes: expected some of x, y, z, each once, found \['x', 'w'\]"),
        ({"axes": "xx"}, r"found \['x', 'x'\]"),
        (
            {"time": TWENTY[:, None]},
            r"memory, trial '0', column time: expected shape \(n,\), found \(20, 1\)",
        ),
        (
            {"time": TWENTY[:1]},
            "trial '0': expected at least two samples, found one sample; leave the trial out",
        ),
        ({"time": TWENTY[:0]}, "expected at least two samples, found none"),
        ({"time": ["a"] * 20}, "column time: expected real numbers, found something else; convert"),
        ({"force": np.ones((20, 2), dtype=complex)}, "column force: expected real numbers"),
        ({"position": [[1, 2], [3]]}, "column position: expected real numbers"),
        (
            {"force": np.ones((19, 2))},
            r"force: expected shape \(20, 2\), as many rows as time has and one column for each of the axes "
            r"x, y, found \(19, 2\)",
        ),
        ({"position": np.ones((20, 3))}, r"position: expected shape \(20, 2\).* found \(20, 3\); mend"),
        (
            {"phase": np.ones(3)},
            r"column phase: expected shape \(20,\), as many rows as time has, found \(3,\)",
        ),
        ({"repetition": np.ones(3)}, r"column repetition: expected shape \(20,\).*, found \(3,\)"),
        ({"truth": {"stiffness_xx": np.ones(3)}}, r"column stiffness_xx: expected shape \(20,\)"),
        ({"truth": {"stiff": np.ones(20)}}, "expected truth columns such as .* found 'stiff'; rename it"),
        ({"time": changed(TWENTY, 3, np.nan)}, "column time: expected finite numbers, found nan at row 3;"),
        (
            {"position": changed(arrays()["position"], ([2, 4, 6, 8], 1), np.inf)},
            "memory, trial '0', column position_y: expected finite numbers, found inf at rows 2, 4, 6 and 1 "
            "more; "
            "fill or remove",
        ),
        ({"truth": {"mass_xx": changed(np.ones(20), 5, np.nan)}}, "column mass_xx: .* found nan at row 5"),
        ({"repetition": changed(np.ones(20), 5, np.nan)}, "column repetition: expected finite .* row 5"),
        ({"time": changed(TWENTY, 7, 0.0)}, r"time goes back at row 7 \(from 0.06 to 0 s\); sort the rows"),
        (
            {"time": changed(changed(TWENTY, 7, 0.06), 11, 0.10)},
            r"found duplicate time stamps at rows 7, 11 \(0.06 s\); keep one sample a time stamp",
        ),
        (
            {"phase": np.linspace(0, 1.1, 20)},
            r"expected values between 0 and 1, found 1.04.* at rows 18, 19; divide",
        ),
        (
            {"phase": np.tile(np.linspace(0, 1, 10), 2)},
            "expected phase to increase strictly within a repetition, found 0 after 1 at row 10; "
            "label repetitions",
        ),
        (
            {"repetition": np.repeat([1, 2, 1], [5, 10, 5])},
            "expected the samples of a repetition next to each other, found label 1 again at row 15; number",
        ),
        (
            {"repetition": np.array([1, "a"] * 10, dtype=object)},
            "expected labels of one kind, found a mixture",
        ),
        (
            {"position": np.stack([TWENTY, np.full(20, 0.25)], axis=-1)},
            "memory: expected motion along axis y, found position_y = 0.25 m throughout: nothing moves, so "
            "impedance "
            "cannot be inferred; drop y from log.axes",
        ),
        (
            {"force": np.stack([0 * TWENTY, TWENTY], axis=-1)},
            "expected interaction force along axis x, found force_x = 0 throughout; check log.columns.force",
        ),
    ],
)
def test_refuses(changes, message):
    with pytest.raises(LogError, match=message):
        make(**changes)


def test_errors_name_the_rows_of_the_source():
    rows = RowNumbers("line", np.arange(20) + 102)
    given_ = arrays(time=changed(TWENTY, 7, 0.06))
    trial = Trial("0", "0", "a.csv", given_["time"], given_["position"], given_["force"], rows=rows)
    with pytest.raises(LogError, match=r"a.csv, trial '0', column time: .* at line 109 \(0.06 s\)"):
        InteractionLog(("x", "y"), (trial,))


def test_needs_axes_and_a_trial():
    with pytest.raises(LogError, match=r"axes: expected some of x, y, z, each once, found \[\]; mend"):
        InteractionLog((), make().trials)
    with pytest.raises(LogError, match="expected at least one trial, found none"):
        InteractionLog(("x",), ())


def test_warns_of_units_that_make_a_hand_fly():
    with pytest.warns(
        LogWarning, match=r"position_x spans 19 m, units .* that far; check log.units.position"
    ):
        make(axes="x", position=np.arange(20.0))
    with pytest.warns(LogWarning, match="position_x spans 19000 m, units that make a hand move kilometres"):
        make(axes="x", position=1000 * np.arange(20.0))


def several():
    resting = np.stack([np.zeros(20), np.linspace(0, 1, 20)], axis=-1)
    return InteractionLog.concatenate(
        [
            make(trial="a", group="S2"),
            make(trial="b", group="S1"),
            make(trial="c", group="S2"),
            InteractionLog(("x", "y"), (*make().trials, Trial("d", "S3", "memory", TWENTY, resting))),
        ]
    )


def test_concatenate_and_select():
    log = several()
    assert [trial.name for trial in log.trials] == ["a", "b", "c", "0", "d"]
    assert log.groups == ("S2", "S1", "0", "S3")
    assert log.n_samples == 100
    assert [trial.name for trial in log.select([2, -5]).trials] == ["c", "a"]
    assert [trial.name for trial in log.select(lambda trial: trial.group == "S2").trials] == ["a", "c"]
    # An axis may rest in a part of a log.
    assert log.select([4]).axes == ("x", "y")
    assert log.select(np.array([0, 1])).n_samples == 40


@pytest.mark.parametrize(
    ("which", "message"),
    [
        ([5], "expected indices of trials between 0 and 4, found 5; select by index"),
        ([True, False], "expected indices of trials between 0 and 4, found True"),
        (np.array([False] * 5), "expected indices of trials"),
        ([], "expected at least one of 5 trials to be selected, found none"),
        (lambda trial: False, "expected at least one of 5 trials to be selected, found none"),
        ([1, 1], "memory: expected each trial of a source once, found trial 'b' twice"),
    ],
)
def test_select_refuses(which, message):
    with pytest.raises(LogError, match=message):
        several().select(which)


def test_concatenate_refuses():
    with pytest.raises(
        LogError, match=r"found axes that differ: x, y in memory and x in memory; set log.axes"
    ):
        InteractionLog.concatenate([make(), make(axes="x")])
    with pytest.raises(LogError, match="found trial '0' twice; give trials different names"):
        InteractionLog.concatenate([make(), make()])
    with pytest.raises(LogError, match="expected at least one log, found none"):
        InteractionLog.concatenate([])


def test_fingerprint_depends_on_everything_but_the_place():
    log = make()
    assert log.fingerprint() == make().fingerprint() == log.select([0]).fingerprint()
    assert len(log.fingerprint()) == 64
    others = [
        make(trial="1"),
        make(group="1"),
        make(axes="yx"),
        make(force=None),
        make(force=np.nextafter(log.trials[0].force, 9)),
        make(repetition=np.repeat([0, 1], 10)),
        make(perturbation=log.trials[0].force, force=None),
        make(truth={"mass_xx": np.ones(20)}),
        make(truth={"mass_yy": np.ones(20)}),
    ]
    assert len({log.fingerprint(), *(other.fingerprint() for other in others)}) == 1 + len(others)


def test_pickles():
    log = several()
    assert pickle.loads(pickle.dumps(log)).fingerprint() == log.fingerprint()


@given(st.lists(st.sampled_from("abc"), min_size=2, max_size=12))
def test_repetition_codes_equal_a_slow_loop(labels):
    seen, contiguous = [], True
    for before, label in zip([None, *labels], labels, strict=False):
        if label not in seen:
            seen.append(label)
        elif label != before:
            contiguous = False
    n = len(labels)
    if not contiguous:
        with pytest.raises(LogError, match="next to each other"):
            make(n, repetition=np.array(labels))
        return
    expected = [seen.index(label) for label in labels]
    np.testing.assert_array_equal(make(n, repetition=np.array(labels)).trials[0].repetition, expected)
