"""The Pyro program is the density: potentials, guides and samplers of Pyro itself run on it."""

import numpy as np
import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import MCMC, NUTS, SVI, Trace_ELBO
from pyro.infer.autoguide import AutoMultivariateNormal, AutoNormal
from pyro.infer.mcmc.util import initialize_model
from pyro.optim import Adam

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.program import pyro_program
from tests.sampling.small_densities import joint_density, laplace


@pytest.fixture(autouse=True)
def apart():
    with torch.random.fork_rng(devices=[]), pyro.get_param_store().scope():
        torch.manual_seed(0)
        yield


@pytest.mark.parametrize("overrides", [(), ("model.desired_trajectory.kernel=squared_exponential",)])
def test_potential_is_the_density_up_to_a_constant_in_value_and_gradient(overrides):
    density = joint_density(*overrides)
    _, potential, transforms, _ = initialize_model(pyro_program(density))
    generator = np.random.default_rng(0)
    constants = []
    for _ in range(4):
        point = laplace(*overrides).at(0.5 * generator.standard_normal(density.size))
        value, gradient = density.joint(point)
        z = torch.from_numpy(point).requires_grad_()
        unconstrained = {
            name: transforms[name](site) if name in transforms else site
            for name, site in density.values(z).items()
        }
        energy = potential(unconstrained)
        (slope,) = torch.autograd.grad(energy, z)
        np.testing.assert_allclose(slope.numpy(), -gradient, rtol=1e-8, atol=1e-8)
        constants.append(energy.item() + value)
    np.testing.assert_allclose(constants, constants[0], atol=1e-8)


def test_sites_are_the_parameters_and_impedance_is_recorded():
    density = joint_density()
    trace = poutine.trace(pyro_program(density)).get_trace()
    assert trace.stochastic_nodes == [parameter.name for parameter in density.parameters]
    impedance = density.impedance({name: trace.nodes[name]["value"] for name in trace.stochastic_nodes})
    for j, name in enumerate(("stiffness", "damping", "mass")):
        torch.testing.assert_close(trace.nodes[name]["value"], impedance[:, :, j])


def test_prior_of_each_site_is_standard_normal_in_its_coordinates():
    """Densities of values and of coordinates differ by the Jacobian of one in the other."""
    density = joint_density()
    z = torch.linspace(-1.0, 1.0, density.size, dtype=torch.float64)
    values = density.values(z)
    traced = poutine.trace(poutine.condition(pyro_program(density), values)).get_trace()
    traced.compute_log_prob()
    jacobian = sum(
        (p.log_sd * values[p.name]).log().sum() for p in density.parameters if p.log_sd is not None
    )
    prior = sum(traced.nodes[p.name]["log_prob"].sum() for p in density.parameters)
    standard = torch.distributions.Normal(0.0, 1.0).log_prob(z).sum()
    torch.testing.assert_close(prior + jacobian, standard)


@pytest.mark.parametrize("guide", [AutoNormal, AutoMultivariateNormal])
def test_autoguides_of_pyro_run_on_it(guide):
    density = joint_density()
    program = pyro_program(density)
    chosen = guide(program, init_scale=0.02)
    svi = SVI(program, chosen, Adam({"lr": 0.02}), Trace_ELBO())
    losses = [svi.step() for _ in range(60)]
    assert np.isfinite(losses).all()
    assert np.mean(losses[-10:]) < np.mean(losses[:10])
    assert set(chosen.median()) == {parameter.name for parameter in density.parameters}


def test_nuts_of_pyro_runs_on_it():
    density = joint_density()
    kernel = NUTS(pyro_program(density), max_tree_depth=4)
    mcmc = MCMC(kernel, num_samples=5, warmup_steps=15, disable_progbar=True)
    mcmc.run()
    draws = mcmc.get_samples()
    for parameter in density.parameters:
        assert draws[parameter.name].shape == (5, *parameter.shape)
        assert torch.isfinite(draws[parameter.name]).all()


@pytest.mark.parametrize("failure", ["no factor", "NaN"])
def test_a_failed_factorisation_is_a_divergence_and_no_crash(monkeypatch, failure):
    """Of a mass above its median, in steps of NUTS."""
    density, point = joint_density(), laplace().point
    likelihood = density.log_likelihood
    failed = 0

    def fails(values):
        nonlocal failed
        if values["mass_weights"].item() < 0.0:
            return likelihood(values)
        failed += 1
        if failure == "NaN":
            return torch.full((), torch.nan, dtype=torch.float64)
        raise NotPositiveDefiniteError("no factor")

    monkeypatch.setattr(density, "log_likelihood", fails)
    values = density.values(torch.from_numpy(point))
    outside = {**values, "mass_weights": torch.ones_like(values["mass_weights"])}
    traced = poutine.trace(poutine.condition(pyro_program(density), outside)).get_trace()
    assert torch.isneginf(traced.nodes["force"]["fn"].log_factor)
    kernel = NUTS(pyro_program(density), max_tree_depth=3)
    mcmc = MCMC(kernel, num_samples=5, warmup_steps=10, disable_progbar=True)
    mcmc.run()
    assert failed > 1 and bool((mcmc.get_samples()["mass_weights"] < 0.0).all())
