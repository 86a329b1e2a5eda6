"""One sample gives the inputs that a log gives; a bad one is refused in words."""

import numpy as np
import pytest
from streams import SHARED, model_of, samples

from bayes_impedance.errors import ConfigurationError, LogError
from bayes_impedance.features import FeatureMap
from bayes_impedance.online import OnlinePredictor, Sample
from bayes_impedance.online.inputs import SampleInputs
from bayes_impedance.simulation.generative import repeated_motion

MEAN = "model.desired_trajectory.mean"
#: A residual over position in place of one over time.
NO_TIME = ("model.residual.input=[position]", "model.residual.length_scale={}")
ALLOWED = [
    ("position", (SHARED,)),
    ("position", (SHARED, f"{MEAN}=reference")),
    ("position", (SHARED, f"{MEAN}=constant")),
    ("position", ("model.residual=null",)),
    ("position_velocity", (SHARED,)),
    ("position_velocity", (SHARED, "model.drop_acceleration=true")),
    ("position_velocity", (SHARED, f"{MEAN}=constant")),
    ("position_velocity", (SHARED, f"{MEAN}=reference", "model.drop_acceleration=true")),
    ("phase", (SHARED,)),
    ("phase", (SHARED, f"{MEAN}=reference")),
    ("phase", (SHARED, f"{MEAN}=constant")),
    ("admittance", (SHARED, "device=null", *NO_TIME)),
]


def inputs_of(model):
    log = model.fitted.log
    feature_map = FeatureMap(model.config, log.axes)
    return feature_map, SampleInputs(feature_map, model.trajectory_mean, log.groups[0])


@pytest.mark.parametrize(
    ("name", "overrides"), ALLOWED, ids=lambda v: v if isinstance(v, str) else ",".join(v)
)
def test_inputs_and_means_are_those_of_the_log(name, overrides):
    model = model_of(name, overrides)
    feature_map, inputs = inputs_of(model)
    log = model.fitted.log
    features = feature_map(log, model.trajectory_mean)
    # Without a residual nobody reads its label.
    columns = np.delete(
        np.arange(feature_map.width), [c for c in (feature_map.layout.residual,) if c is not None]
    )
    every = [sample for trial in log.trials for sample in samples(trial)]
    for t, sample in enumerate(every):
        found, means = inputs(sample)
        assert found[:, columns] == pytest.approx(
            features.inputs[:, 0, t, columns].numpy(), rel=1e-12, abs=1e-12
        )
        assert means[:, :2] == pytest.approx(
            features.trajectory_mean[:, 0, t, :2].numpy(), rel=1e-12, abs=1e-12
        )


@pytest.mark.parametrize(
    ("name", "overrides"), ALLOWED, ids=lambda v: v if isinstance(v, str) else ",".join(v)
)
def test_what_is_needed_is_enough_and_nothing_less_is(name, overrides):
    """Fields in `needed` alone give the same inputs; without any of them the sample is refused by its name."""
    model = model_of(name, overrides)
    _, inputs = inputs_of(model)
    sample = samples(model.fitted.log.trials[0])[3]
    needed = {field: getattr(sample, field) for field in ("time", *inputs.needed)}
    few = Sample(**{"position": None, "velocity": None, **needed})
    for one, other in zip(inputs(few), inputs(sample), strict=True):
        assert one[:, :2] == pytest.approx(other[:, :2], rel=1e-15)
    assert (inputs(few)[0] == inputs(sample)[0]).all()
    for field in inputs.needed:
        with pytest.raises(
            LogError,
            match=rf"sample at 0.3 s: expected {field}, which this configuration asks for, found none; give",
        ):
            inputs(few._replace(**{field: None}))


def test_a_model_of_one_axis_takes_numbers():
    log = repeated_motion(1, duration=2.0, rate=10.0, axes=("x",))
    model = model_of("position", (SHARED,))
    feature_map = FeatureMap(model.config, ("x",))
    inputs = SampleInputs(feature_map, model.trajectory_mean, "0")
    whole = samples(log.trials[0], with_force=False)[4]
    plain = Sample(whole.time, float(whole.position[0]), [whole.velocity[0]], acceleration=whole.acceleration)
    assert (inputs(plain)[0] == inputs(whole)[0]).all()


@pytest.fixture(scope="module")
def reference():
    """Every kind of field is asked for: of each axis, of the phase, of the reference."""
    return inputs_of(model_of("phase", (SHARED, f"{MEAN}=reference")))[1]


@pytest.fixture(scope="module")
def sample():
    return samples(model_of("phase", (SHARED, f"{MEAN}=reference")).fitted.log.trials[0])[3]


@pytest.mark.parametrize("field", ["position", "velocity", "acceleration", "reference", "reference_velocity"])
@pytest.mark.parametrize(
    "value",
    [
        0.1,
        [0.1],
        [0.1, 0.2, 0.3],
        [[0.1], [0.2]],
        [[0.1, 0.2]],
        [],
        "north",
        ["a", "b"],
        {"x": 0.1, "y": 0.2},
        1j,
    ],
    ids=repr,
)
def test_a_field_of_another_shape_is_refused(reference, sample, field, value):
    with pytest.raises(LogError, match=rf"expected {field} of 2 numbers \(x, y\), got .*; give one for each"):
        reference(sample._replace(**{field: value}))


@pytest.mark.parametrize("field", ["phase", "phase_velocity", "phase_acceleration"])
@pytest.mark.parametrize("value", [[0.1, 0.2], [], "half"], ids=repr)
def test_a_phase_is_one_number(reference, sample, field, value):
    with pytest.raises(LogError, match=rf"expected {field} of one, got "):
        reference(sample._replace(**{field: value}))
    assert reference(sample._replace(**{field: [getattr(sample, field)]}))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200, -1e30])
@pytest.mark.parametrize("field", ["position", "velocity", "acceleration", "phase", "phase_velocity"])
def test_a_field_that_is_not_finite_or_no_measurement_is_refused(reference, sample, field, value):
    bad = value if field.startswith("phase") else [0.1, value]
    with pytest.raises(LogError, match=rf"expected finite numbers below 1e\+30, found {field} \["):
        reference(sample._replace(**{field: bad}))


def test_fields_whose_norm_is_large_pass(reference, sample):
    large = sample._replace(position=[0.8e30, 0.8e30], velocity=[0.8e30, 0.8e30])
    assert np.isfinite(reference(large)[0]).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_a_reference_that_is_not_finite_is_refused(reference, sample, value):
    with pytest.raises(LogError, match=r"expected a finite reference below 1e\+30, found \[\["):
        reference(sample._replace(reference=[0.1, value]))


def test_fields_that_the_model_does_not_ask_for_are_not_looked_at():
    _, inputs = inputs_of(model_of("position", (SHARED,)))
    sample = samples(model_of("position", (SHARED,)).fitted.log.trials[0])[3]
    odd = sample._replace(jerk="none", phase=np.nan, reference=[1.0], force=np.nan)
    assert (inputs(odd)[0] == inputs(sample)[0]).all()


# --- models that a stream cannot have ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "overrides", "sentence"),
    [
        ("time", (), "expected functions of phase, position or velocity to predict online, got one of time"),
        (
            "position",
            (SHARED, "model.residual.input=[time]"),
            "to which a stream never returns; set model.trajectory_input=position",
        ),
        (
            "position",
            (),
            "shared.residual: expected true to predict online, where there are no trials, got false",
        ),
        (
            "phase",
            (SHARED, "shared.desired_trajectory=false"),
            "shared.desired_trajectory: expected true to predict online",
        ),
        (
            "admittance",
            (SHARED, *NO_TIME),
            "device: expected none to predict online, for what the robot's answer tells of the mass is not learned",
        ),
        ("coupled", (SHARED,), "expected model.axes: independent and an impedance model with local"),
        (
            "phase",
            (SHARED, "engine.impedance=map"),
            "engine.impedance: expected moments to predict online, got map, whose functions are found anew",
        ),
    ],
)
def test_a_model_that_a_stream_cannot_have_is_refused(name, overrides, sentence):
    with pytest.raises(ConfigurationError, match=sentence):
        OnlinePredictor(model_of(name, overrides))
