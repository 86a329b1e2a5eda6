"""`ImpedanceModel.sample` from a log to draws with verdicts."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bayes_impedance import load_config
from bayes_impedance.config import SamplingConfig
from bayes_impedance.errors import LogError, NotPositiveDefiniteError, OutputError
from bayes_impedance.identifiability import Support
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.preprocessing import PreparedLog
from bayes_impedance.sampling import chains, importance
from bayes_impedance.sampling.density import SampledDensity
from bayes_impedance.simulation.arm import arm_with
from bayes_impedance.simulation.device import BandLimitedForce
from bayes_impedance.simulation.experiment import Experiment, simulate
from bayes_impedance.simulation.generative import draw_force, repeated_motion
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Pace
from tests.engines.given import NO_RESIDUAL
from tests.impedance_functions.problems import DISTINCT, KNOWN_VARIATION, MAP, MARKOV

SMALL = (*MARKOV, *KNOWN_VARIATION, *DISTINCT, *MAP, "engine.inducing=3")
MOMENTS = tuple(item for item in SMALL if item != "engine.impedance=map")
LAPLACE = SamplingConfig(method="laplace", draws=120, chains=1, places=5)
NUTS = SamplingConfig(method="nuts", warmup=20, draws=6, chains=2, places=5)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Fewer proposals, and chains one after another in this process."""
    monkeypatch.setattr(importance, "PROPOSALS", 150)
    monkeypatch.setattr(chains, "_cores", lambda: 1)


@cache
def drawn_log(seed: int = 0, group: str = "0", axes: tuple[str, ...] = ("x",)) -> PreparedLog:
    motion = repeated_motion(3, 2.0, 10.0, axes=axes, seed=seed, group=group)
    return draw_force(load_config("phase", SMALL), motion, seed)


def without_force(log: PreparedLog) -> PreparedLog:
    return replace(log, trials=tuple(replace(trial, force=None) for trial in log.trials))


def model_of(*overrides: str, name: str = "phase") -> ImpedanceModel:
    return ImpedanceModel(load_config(name, overrides))


@cache
def fitted() -> ImpedanceModel:
    return model_of(*SMALL).fit(drawn_log())


def assert_same(one, other):
    np.testing.assert_array_equal(one.draws.standard, other.draws.standard)
    assert one.latents.keys() == other.latents.keys()
    for latent, values in one.latents.items():
        np.testing.assert_array_equal(values, other.latents[latent])
    assert one.verdicts == other.verdicts or str(one.verdicts) == str(other.verdicts)


def test_same_seed_same_draws_by_laplace():
    told = []
    model = model_of(*SMALL)
    one = model.sample(drawn_log(), settings=LAPLACE, progress=lambda *line: told.append(line))
    assert one.draws.shape == (1, 120) and one.draws.method == "laplace"
    assert_same(one, model.sample(drawn_log(), settings=LAPLACE))
    other = model.sample(drawn_log(), settings=LAPLACE.model_copy(update={"seed": 1}))
    assert (one.draws.standard != other.draws.standard).any()
    assert list(dict.fromkeys(line[0] for line in told)) == ["mode", "chain 1", "latents"]
    assert told[0][3].startswith("log posterior")
    assert told[-1][:3] == ("latents", 120, 120)
    # The log that it was drawn from has the impedance that is found.
    for one_verdict in one.verdicts:
        assert one_verdict.verdict.support is Support.SUPPORTED


def test_same_seed_same_draws_by_nuts_whatever_the_checkpoint(tmp_path):
    model = model_of(*SMALL)
    expected = model.sample(drawn_log(), settings=NUTS)
    assert expected.draws.shape == (2, 6)
    assert (expected.draws.standard[0] != expected.draws.standard[1]).any()

    def stop(what, done, total, line):
        if what == "chain 2":
            raise KeyboardInterrupt

    folder = tmp_path / "run.unfinished"
    with pytest.raises(KeyboardInterrupt):
        model.sample(drawn_log(), settings=NUTS, progress=stop, checkpoint=folder)
    assert [path.name for path in folder.iterdir()] == ["chain-1.safetensors"]
    assert_same(model.sample(drawn_log(), settings=NUTS, checkpoint=folder), expected)
    # A model that was trained on another log has another prior mean of the desired trajectory.
    climbed = []
    elsewhere = model_of(*SMALL).fit(drawn_log(4))
    other = ImpedanceModel(elsewhere.config, replace(elsewhere.fitted, functions=None))
    for own, log, settings, named in (
        (model_of(*SMALL, "model.mass.level.median=2"), drawn_log(), NUTS, "model"),
        (model, drawn_log(4), NUTS, "recordings"),
        (other, drawn_log(), NUTS, "prior mean of the desired trajectory"),
        (model, drawn_log(), NUTS.model_copy(update={"seed": 1}), "sampling.seed"),
    ):
        with pytest.raises(
            OutputError, match=f"expected a checkpoint of what is sampled now, found one of another {named}"
        ):
            own.sample(log, "log", settings, lambda *line: climbed.append(line), folder)
    # Refused before anything is computed.
    assert climbed == []
    for sentence in expected.diagnosis.findings:
        assert "set sampling." in sentence or "another sampling.seed" in sentence


def test_forces_that_are_given():
    model, log = fitted(), drawn_log(4)
    ours = model.sample(log, settings=LAPLACE)
    assert ours.density.features.counts.tolist() == [120]
    both = model.sample(without_force(log), settings=LAPLACE)
    training = model.sample(log, "training", LAPLACE)
    for one in (both, training):
        assert one.density.features.counts.tolist() == [60]
    np.testing.assert_array_equal(both.draws.standard, training.draws.standard)
    alone = model.sample(log, "log", LAPLACE)
    assert alone.density.features.counts.tolist() == [60]
    assert (alone.draws.standard != training.draws.standard).any()
    assert both.recorded("force") is None
    assert both.at_samples(Latent.FORCE).shape == (1, 120, 60, 1)


def test_logs_without_what_it_takes():
    one, other = drawn_log(), drawn_log(4, group="other")
    with pytest.raises(LogError, match="expected a log with force to sample from, found none"):
        model_of(*SMALL).sample(without_force(one), settings=LAPLACE)
    with pytest.raises(LogError, match="expected a log with force to sample from, found none"):
        fitted().sample(without_force(one), "log", LAPLACE)
    both = PreparedLog(one.axes, (*one.trials, *without_force(other).trials))
    with pytest.raises(
        LogError,
        match="expected forces of every group to sample from, found none of group 'other'; name a log",
    ):
        model_of(*SMALL).sample(both, settings=LAPLACE)
    with pytest.raises(LogError, match="expected a log with axes x"):
        fitted().sample(drawn_log(axes=("x", "y")), settings=LAPLACE)


def test_a_model_of_moments_is_sampled_as_functions():
    trained = model_of(*MOMENTS, "training.max_iterations=2").fit(drawn_log())
    found = trained.sample(drawn_log(), settings=LAPLACE)
    assert found.config.engine.impedance == "map" and found.engine.name == "markov"
    # Its hyperparameters are drawn, too: training leaves no trace.
    assert_same(found, model_of(*SMALL, "training.max_iterations=2").sample(drawn_log(), settings=LAPLACE))


def test_settings_are_those_of_the_configuration():
    settings = ("sampling.method=laplace", "sampling.draws=60", "sampling.chains=2", "sampling.places=4")
    found = model_of(*SMALL, *settings).sample(drawn_log())
    assert found.draws.shape == (1, 120)
    assert found.matrices(Latent.STIFFNESS).shape == (1, 120, 1, 4, 1, 1)


def test_around_the_hand_itself_all_is_prior():
    motion = repeated_motion(1, 2.0, 10.0, axes=("x",), seed=1)
    model = model_of("engine.impedance=map", "engine.inducing=3", name="time")
    assert model.config.model.desired_trajectory.mean == "equilibrium"
    found = model.sample(draw_force(model.config, motion, 1), settings=LAPLACE)
    assert found.places.dimension == "time"
    for one in found.verdicts:
        assert one.verdict.support is Support.PRIOR_ONLY
        assert "product of impedance and the SD" in one.verdict.sentence


def test_coupled_axes_of_two_groups_with_residual_and_offset():
    overrides = (
        *(item for item in SMALL if "residual" not in item),
        "model.axes=coupled",
        "model.residual.kernel=matern32",
        "model.residual.input=[time]",
        "model.residual.offset_sd={median: 1.0, log_sd: 0.5}",
    )
    logs = drawn_log(axes=("x", "y")), drawn_log(4, group="other", axes=("x", "y"))
    log = PreparedLog(logs[0].axes, (*logs[0].trials[:2], *logs[1].trials))
    found = model_of(*overrides).sample(log, settings=LAPLACE)
    assert found.groups == ("0", "other")
    assert {(one.latent, one.pair) for one in found.off_diagonals} == {
        (latent, "xy") for latent in (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS)
    }
    assert {"residual_sd", "residual_offset_sd"} <= found.values().keys()
    assert found.latents[Latent.RESIDUAL_FORCE].std() > 0.01
    matrices = found.matrices(Latent.STIFFNESS)
    np.testing.assert_allclose(matrices, matrices.swapaxes(-1, -2), rtol=1e-12)
    assert np.linalg.eigvalsh(matrices).min() > 0.0
    # Where the forces are is where the draws are.
    predicted, measured = found.at_samples(Latent.FORCE), found.recorded("force")
    low, high = np.quantile(predicted, [0.02, 0.98], axis=(0, 1))
    assert ((low < measured) & (measured < high)).mean() > 0.85


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("admittance", ("model.desired_trajectory.kernel=matern52", *NO_RESIDUAL)),
        ("arm", ("model.stiffness.input=[phase]", "model.damping.input=[phase]", "model.mass.input=[]")),
    ],
)
def test_a_device_that_answers_force(name, overrides):
    person = Subject("low", arm_with("low"), Pace(repetition=2.0))
    log = simulate(
        Experiment([person], FigureEight(), repetitions=2, perturbation=BandLimitedForce(8.0)), seed=1
    )
    few = ("preprocessing.rate=8", "engine.inducing=2", "model.desired_trajectory.average_knots=4")
    few += ("training.max_iterations=30",)
    model = model_of(*few, *overrides, name=name)
    found = model.sample(log, settings=LAPLACE.model_copy(update={"draws": 100}))
    assert found.density.features.loop is not None
    assert found.coupled is (name == "arm")
    assert np.isfinite(found.draws.stats["lp"]).all()
    predicted, measured = found.at_samples(Latent.FORCE), found.recorded("force")
    low, high = np.quantile(predicted, [0.02, 0.98], axis=(0, 1))
    assert ((low < measured) & (measured < high)).mean() > 0.8


def test_draws_are_about_laplace_s_posterior_in_map_mode():
    log = drawn_log()
    # So many inducing inputs that hardly anything is left out between them.
    model = model_of(*SMALL, "engine.inducing=10").fit(log)
    posterior = model.posterior(log)
    found = model.sample(log, settings=LAPLACE.model_copy(update={"draws": 400}))
    phase = found.abscissa(0)[0]
    trial = log.trials[0]
    for latent in (Latent.STIFFNESS, Latent.DAMPING, Latent.MASS):
        marginal = posterior[latent]
        low, middle, high = (
            np.interp(phase, trial.phase, marginal.quantile(p)[: trial.n_samples, 0])
            for p in (0.05, 0.5, 0.95)
        )
        drawn = found.matrices(latent)[..., 0, 0].reshape(400, -1)
        q05, q50, q95 = np.quantile(drawn, [0.05, 0.5, 0.95], axis=0)
        assert np.abs((q50 - middle) / (high - low)).max() < 0.35, latent
        ratio = (q95 - q05) / (high - low)
        assert ratio.min() > 0.5 and ratio.max() < 2.0, (latent, ratio)


def test_length_scales_that_no_engine_holds_are_where_the_density_ends():
    overrides = (*SMALL, "model.desired_trajectory.kernel=squared_exponential", "engine.name=lowrank")
    density = model_of(*overrides).sample(drawn_log(), settings=LAPLACE).density
    names = [p.name for p in density.parameters]
    point = np.zeros(density.size)
    at = sum(p.size for p in density.parameters[: names.index("desired_trajectory_length_scale")])
    point[at] = -14.0
    with pytest.raises(NotPositiveDefiniteError, match="length scales became shorter than an engine holds"):
        density.joint(point)


def test_a_density_that_overflows_says_what_to_look_at():
    class Overflowing(SampledDensity):
        def log_density(self, coordinates):
            return coordinates.exp().sum()

    density = Overflowing(1, np.ones(2, dtype=bool))
    assert density.joint(np.zeros(2))[0] == 2.0
    with pytest.raises(
        NotPositiveDefiniteError, match="expected a finite posterior density, found one that overflows"
    ):
        density.joint(np.full(2, 1e3))
