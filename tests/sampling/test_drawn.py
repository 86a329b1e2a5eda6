"""A posterior by its draws: latents, values and names where they belong, whatever the layout."""

import numpy as np
import pytest
import torch
from drawn_cases import CASES, CHAINS, DRAWS, PLACES, drawn

from bayes_impedance.features import FeatureMap
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.sampling.dataset import names_of_coordinates
from bayes_impedance.trajectory_mean import TrajectoryMean


@pytest.mark.parametrize("case", CASES)
def test_impedance_at_the_places_is_that_of_each_draw_at_their_inputs(case):
    posterior = drawn(case)
    assert posterior.draws.shape == (CHAINS, DRAWS)
    feature_map = FeatureMap(posterior.config, posterior.axes)
    mean = TrajectoryMean.from_training(posterior.config.model.desired_trajectory, posterior.log)
    trials, rows = posterior.kept(posterior.places.places)
    matrices = {latent: posterior.matrices(latent) for latent in IMPEDANCE_ORDER}
    is_phase = posterior.places.dimension == "phase"
    seen = 0
    for trial, own in zip(trials, rows, strict=True):
        # One trial alone, with the functions of its group.
        alone = feature_map(posterior.places.log.select([posterior.places.log.trials.index(trial)]), mean)
        group = posterior.groups.index(trial.group)
        for chain, number in ((0, 3), (1, 40)):
            values = posterior.density.values(torch.from_numpy(posterior.draws.standard[chain, number]))
            values = {
                name: value[group : group + 1] if name.endswith("_weights") else value
                for name, value in values.items()
            }
            expected = posterior.density.impedance(values, alone)[0, own].numpy()
            for latent, j in IMPEDANCE_ORDER.items():
                found = matrices[latent][chain, number]
                found = found[group] if is_phase else found[seen : seen + len(own)]
                np.testing.assert_allclose(found, expected[:, j], rtol=1e-9)
        seen += 0 if is_phase else len(own)
        of_group = posterior.of_group(matrices[Latent.STIFFNESS], group)
        assert of_group.shape[2] == len(posterior.places_of(group))
    prior = posterior.prior_impedance(3)[Latent.MASS]
    flat = matrices[Latent.MASS].reshape(CHAINS, DRAWS, -1, 2, 2)
    assert prior.shape == (3, *flat.shape[2:])


@pytest.mark.parametrize("case", CASES)
def test_forces_are_those_at_the_samples_of_each_trial(case):
    posterior = drawn(case)
    trials, rows = posterior.kept(posterior.places.forces)
    assert [trial.name for trial in posterior.log.trials] == [trial.name for trial in trials]
    force, recorded = posterior.at_samples(Latent.FORCE), posterior.recorded("force")
    assert force.shape == (CHAINS, DRAWS, *recorded.shape)
    start = 0
    names = [trial.name for trial in posterior.places.log.trials]
    for trial, own in zip(trials, rows, strict=True):
        part = slice(start, start + len(own))
        np.testing.assert_array_equal(recorded[part], trial.force[own])
        g, number = posterior.groups.index(trial.group), names.index(trial.name)
        for sample, at in ((0, start), (len(own) - 1, start + len(own) - 1)):
            place = (posterior.target.rows[g] == (number, own[sample])).all(axis=1)
            (row,) = np.flatnonzero(place)
            latent = posterior.latents[Latent.FORCE][:, :, g, row].reshape(CHAINS, DRAWS, 2)
            np.testing.assert_array_equal(force[:, :, at], latent)
        start += len(own)
    assert posterior.recorded("smoothing") is None


@pytest.mark.parametrize("case", CASES)
def test_a_draw_is_one_whole(case):
    """Desired trajectory, impedance and residual of a draw at a sample give the force there, but for noise."""
    posterior = drawn(case)
    names = [trial.name for trial in posterior.places.log.trials]
    noise = posterior.values()["noise_sd"].reshape(CHAINS * DRAWS, 2)
    scores = []
    for g, rows in enumerate(posterior.target.rows):
        for at, (number, sample) in enumerate(rows[::7]):
            trial = posterior.places.log.trials[number]
            hand = trial.position, trial.velocity, trial.acceleration
            total = posterior.latents[Latent.RESIDUAL_FORCE][:, :, g, 7 * at].copy()
            for latent, desired, own in zip(
                IMPEDANCE_ORDER,
                (Latent.DESIRED_POSITION, Latent.DESIRED_VELOCITY, Latent.DESIRED_ACCELERATION),
                hand,
                strict=True,
            ):
                error = posterior.latents[desired][:, :, g, 7 * at] - own[sample]
                total += np.einsum("dab,db->da", posterior.latents[latent][:, g, 7 * at], error)
            scores.append((posterior.latents[Latent.FORCE][:, :, g, 7 * at] - total) / noise)
    scores = np.stack(scores)
    assert len(names) == len(set(names))
    assert abs(scores.mean()) < 4.5 / scores.size**0.5
    assert abs(scores.var() - 1.0) < 4.5 * (2.0 / scores.size) ** 0.5


def test_what_is_plotted_against_what():
    assert [drawn("groups").abscissa(group)[1] for group in (0, 1)] == ["phase", "phase"]
    time, name = drawn("time").abscissa(0)
    assert name == "time [s]" and time[0] == 0.0 and len(time) == PLACES
    number, name = drawn("times").abscissa(0)
    assert name == "sample" and len(number) == 3 * PLACES == len(drawn("times").places_of(0))
    assert drawn("times").abscissa(1)[0].shape == (2 * PLACES,)


def test_a_constant_is_told_once_for_each_group():
    posterior = drawn("inside one trial")
    assert posterior.is_constant(Latent.DAMPING) and not posterior.is_constant(Latent.STIFFNESS)
    damping = posterior.matrices(Latent.DAMPING)
    np.testing.assert_array_equal(posterior.first_place(damping), damping[:, :, :, 0])
    assert (np.ptp(damping, axis=3) < 1e-9).all()
    for case in ("times", "position"):
        mass = drawn(case).matrices(Latent.MASS)
        first = drawn(case).first_place(mass)
        assert first.shape == (CHAINS, DRAWS, 2, 2, 2)
        for group in (0, 1):
            np.testing.assert_allclose(first[:, :, group], mass[:, :, drawn(case).places_of(group)[1]], rtol=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_every_coordinate_has_a_name_of_its_own(case):
    posterior = drawn(case)
    names = names_of_coordinates(posterior.parameters, posterior.axes)
    assert len(names) == len(set(names)) == posterior.density.size
    assert posterior.diagnosis.names == tuple(names)
    # A coordinate moves what its name says, of the axis that it says.
    middle = torch.zeros(posterior.density.size, dtype=torch.float64)
    before = posterior.density.values(middle)
    for i, name in enumerate(names):
        moved = middle.clone()
        moved[i] = 1.0
        after = posterior.density.values(moved)
        (changed,) = [key for key in after if (after[key] != before[key]).any()]
        assert name.split()[0] == changed
        if "noise_sd" in name:
            (row,) = np.flatnonzero((after[changed] != before[changed]).any(-1))
            assert name.split()[-1] == posterior.axes[row]
