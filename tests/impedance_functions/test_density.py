"""The density of functions and hyperparameters: gradients, engines, axes, and the Jacobian of the closed loop."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.device import Loop
from bayes_impedance.engines.closed_loop import jacobian
from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.impedance_functions.density import beside_impedance, log_jacobian
from bayes_impedance.impedance_functions.tilted import TRUSTED
from tests.impedance_functions.problems import COUPLED, DEVICE, MARKOV, density_of, small_problem, somewhere

SETTINGS = [
    (engine, (*coupled, *device), groups)
    for engine in ("dense", "markov")
    for coupled in ((), (COUPLED,))
    for device in ((), DEVICE)
    for groups in (1, 2)
]


@pytest.mark.parametrize(("engine", "overrides", "groups"), SETTINGS)
def test_gradient_is_finite_differences(engine, overrides, groups):
    problem = small_problem(*overrides, groups=groups)
    density = density_of(problem, engine)
    assert (problem.features.loop is not None) == (DEVICE[0] in overrides)
    assert (problem.features.valid is not None) == (groups > 1)
    generator = np.random.default_rng(1)
    density.tilt = density.free * generator.standard_normal(len(density.free))
    density.tilt[: density.weight_count] = 0.0
    density.anchor = density.start() + 0.1
    point = somewhere(density)
    _, gradient = density(point)
    # Some directions, for each coordinate would take minutes over all settings.
    for _ in range(4):
        direction = density.free * generator.standard_normal(len(point))
        above, below = (density(point + sign * 1e-4 * direction)[0] for sign in (1.0, -1.0))
        assert gradient @ direction == pytest.approx((above - below) / 2e-4, rel=2e-5, abs=1e-4)


@pytest.mark.parametrize("overrides", [(), (COUPLED,), (COUPLED, *DEVICE)])
def test_dense_and_markov_are_one_density(overrides):
    problem = small_problem(*overrides, groups=2)
    dense, markov = (density_of(problem, engine) for engine in ("dense", "markov"))
    point = somewhere(dense)
    mine, its = dense.joint(point), markov.joint(point)
    # The jitter of the dense engine is 1e-10 of the force's variance.
    assert mine[0] == pytest.approx(its[0], rel=1e-6)
    np.testing.assert_allclose(mine[1], its[1], rtol=1e-5, atol=1e-5 * np.abs(its[1]).max())


def test_coupled_axes_without_coupling_are_independent():
    mine, its = (density_of(small_problem(*o, *DEVICE)) for o in ((COUPLED,), ()))
    point = somewhere(its)
    weights = its.weights(torch.from_numpy(point))
    padded = []
    for part in weights:
        zero = torch.zeros(part.shape[0], 1, part.shape[2], dtype=torch.float64)
        padded.append(torch.cat([part, zero], dim=1).reshape(-1).numpy())
    together = np.concatenate([*padded, point[its.weight_count :]])
    # The jitter of the dense engine is relative to the mean variance, of an axis or of all.
    assert mine.joint(together)[0] == pytest.approx(its.joint(point)[0], rel=1e-6)


def test_tilt_is_local_and_anchor_a_hyperprior():
    density = density_of(small_problem())
    point = somewhere(density)
    value, gradient = density(point)
    assert value == density.joint(point)[0]
    density.tilt[-1], density.anchor = 3.0, point
    assert density(point)[0] == value
    assert density(point)[1][-1] == pytest.approx(gradient[-1] + 3.0, rel=1e-12)
    # Far away it is worth no more than this.
    density.anchor = point - 20.0 * TRUSTED * (np.arange(len(point)) == len(point) - 1)
    assert density(point)[0] == pytest.approx(value + 3.0 * TRUSTED - 200.0, rel=1e-12)
    density.tilt[-1] = 0.0
    density.anchor = point - TRUSTED * (np.arange(len(point)) == len(point) - 1)
    assert density(point)[0] == pytest.approx(value - 0.5, rel=1e-12)
    # Weights are free to move.
    density.anchor = point - 10.0 * (np.arange(len(point)) == 0)
    assert density(point)[0] == pytest.approx(value, rel=1e-12)


def test_hyperpriors_are_those_of_what_is_learned_beside_impedance():
    settings = "model.desired_trajectory.sd={median: 0.02, log_sd: 0.5}", "model.noise_sd=0.3"
    problem = small_problem(*settings)
    density = density_of(problem)
    names = [entry.name for entry in beside_impedance(problem.model)]
    assert names == ["desired_trajectory.sd", "desired_trajectory.length_scale"]
    with torch.no_grad():
        problem.model.kernel.impedance.trajectory.sd = 0.04
    expected = 2 * -0.5 * (np.log(2.0) / 0.5) ** 2
    assert float(density.log_hyperpriors().detach()) == pytest.approx(expected, rel=1e-12)


def test_fixed_components_do_not_move():
    mixed = (
        "model.trajectory_input=position_velocity",
        "model.desired_trajectory.mean=reference",
        "model.desired_trajectory.length_scale={position: {median: 0.1, fixed: true}, velocity: {median: 0.3}}",
    )
    density = density_of(small_problem(*mixed))
    entry = next(e for e in density.entries if e.name == "desired_trajectory.length_scale")
    assert entry.free.tolist() == [False, False, True, True]
    first = density.weight_count + sum(e.raw.numel() for e in density.entries[: density.entries.index(entry)])
    assert density.free[first : first + 8].tolist() == [False, False, True, True] * 2
    gradient = density(somewhere(density))[1]
    assert (gradient[~density.free] == 0.0).all()
    assert (gradient[density.free] != 0.0).all()


def test_overflow_is_refused():
    density = density_of(small_problem(*MARKOV), "markov")
    stiff = density.start() + 1e4 * (np.arange(len(density.free)) < density.weight_count)
    with pytest.raises(NotPositiveDefiniteError, match="look for impedance or hyperparameters that overflow"):
        density(stiff)
    problem = small_problem(*MARKOV)
    forces = replace(problem.features, force=1e200 * problem.features.force)
    density = density_of(replace(problem, features=forces), "markov")
    with pytest.raises(
        NotPositiveDefiniteError, match="expected a finite likelihood of the forces given impedance"
    ):
        density(density.start())


# --- the Jacobian of the closed loop -------------------------------------------------------------


def loop_of(axes, step=0.04):
    mass = torch.tensor([2.0, 3.0, 2.5], dtype=torch.float64)[:axes, None]
    damping = torch.tensor([6.0, 20.0, 9.0], dtype=torch.float64)[:axes, None]
    return Loop(mass, damping, torch.tensor([step], dtype=torch.float64))


def drawn_matrices(axes, n=5):
    generator = torch.Generator().manual_seed(axes)
    root = torch.randn(1, n, 3, axes, axes, generator=generator, dtype=torch.float64)
    level = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64)[:, None, None]
    return level * (root @ root.mT + 0.1 * torch.eye(axes, dtype=torch.float64))


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_jacobian_is_that_of_a_simulated_loop(axes):
    loop, matrices = loop_of(axes), drawn_matrices(axes)
    step, mass, damping = float(loop.step), loop.device_mass[:, 0], loop.device_damping[:, 0]

    def residual(force):
        """u − Σ W_j e^{(j)} around x_d = 0, where each force moves the device within its own step and after."""
        x = v = a = torch.zeros(axes, dtype=torch.float64)
        found = []
        for n in range(len(force)):
            ahead = (force[n] - damping * v) / mass
            x, v = x + step * v, v + 0.5 * step * (a + ahead)
            a = (force[n] - damping * v) / mass
            k, d, m = matrices[0, n]
            found.append(force[n] + k @ x + d @ v + m @ a)
        return torch.stack(found)

    generator = torch.Generator().manual_seed(7)
    force = torch.randn(5, axes, generator=generator, dtype=torch.float64)
    whole = torch.autograd.functional.jacobian(residual, force).reshape(5 * axes, 5 * axes)
    found = log_jacobian(loop, matrices, None, coupled=True)
    torch.testing.assert_close(found, torch.linalg.slogdet(whole).logabsdet.reshape(1, 1), rtol=1e-12, atol=0)


def test_jacobian_of_one_axis_is_that_of_a_known_apparent_mass():
    loop = loop_of(1)
    matrices = torch.tensor([300.0, 20.0, 1.5], dtype=torch.float64)[:, None, None].expand(1, 7, 3, 1, 1)
    known = 1.5 * (1.0 - 0.5 * 0.04 * 6.0 / 2.0) + 0.5 * 0.04 * 20.0
    expected = jacobian(
        *(torch.tensor(value, dtype=torch.float64) for value in (known, 0.0, 7.0)), loop.device_mass[0]
    )
    for coupled in (False, True):
        torch.testing.assert_close(log_jacobian(loop, matrices, None, coupled)[0], expected.log_expectation)


def test_jacobian_of_independent_axes_reads_the_diagonal_and_no_padding():
    loop, matrices = loop_of(2), drawn_matrices(2)
    valid = torch.tensor([[True, True, False, True, False]])
    found = log_jacobian(loop, matrices, valid, coupled=False)
    for axis in range(2):
        one = Loop(loop.device_mass[[axis]], loop.device_damping[[axis]], loop.step)
        own = matrices[:, valid[0]][..., axis : axis + 1, axis : axis + 1]
        torch.testing.assert_close(found[axis], log_jacobian(one, own, None, coupled=True)[0])
    diagonal = torch.diag_embed(matrices.diagonal(dim1=-2, dim2=-1))
    torch.testing.assert_close(
        found.sum(0, keepdim=True), log_jacobian(loop, diagonal, valid, coupled=True), rtol=1e-12, atol=0
    )


def test_likelihood_has_the_jacobian():
    problem = small_problem(COUPLED, *DEVICE)
    density = density_of(problem)
    value = density.likelihood(problem.impedance)
    alone = density.engine.log_likelihood_given_impedance(density.processes, problem.impedance)
    torch.testing.assert_close(
        value - alone, log_jacobian(problem.features.loop, problem.impedance, None, coupled=True)
    )


def test_model_is_left_at_the_point_asked_for():
    problem = small_problem(*MARKOV)
    density = density_of(problem, "markov")
    point = somewhere(density)
    density.joint(point)
    np.testing.assert_array_equal(density.start()[density.weight_count :], point[density.weight_count :])
