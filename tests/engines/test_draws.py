"""Joint draws given impedance: as maps of standard normal numbers against dense algebra, and by their moments.

Given forces a draw is mean + J z, z ~ N(0, I): fed with unit vectors in place of random numbers an engine shows the
mean and J, whose square is the covariance of all latents at all samples, without sampling error.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from bayes_impedance.engines.given_dense import DenseGivenImpedance
from bayes_impedance.engines.given_impedance import LATENTS
from bayes_impedance.engines.lowrank import Accuracy, LowRankEngine
from bayes_impedance.engines.markov import MarkovEngine
from bayes_impedance.engines.markov.prior_draws import Chain
from bayes_impedance.engines.markov.simulate import moments, simulate
from bayes_impedance.kernels.derivative import derivative_table
from bayes_impedance.kernels.impedance import Latent
from bayes_impedance.kernels.warped import evaluate
from tests.engines.given import NO_RESIDUAL, OVER_PHASE, OVER_TIME, given_problem

OFFSET = (*OVER_TIME, "model.residual.offset_sd=0.3")
SHARED_OVER_TIME = (*OVER_TIME, "shared.residual=true", "model.residual.kernel=matern12")
SMOOTH = (*OVER_PHASE, "model.residual.kernel=matern52", "model.residual.offset_sd=0.3")
SE = ("model.desired_trajectory.kernel=squared_exponential",)
SE_OVER_TIME = (*SE, "model.residual.kernel=squared_exponential", "model.residual.input=[time]")
SE_OFFSET = (*SE_OVER_TIME, "model.residual.offset_sd=0.3")
SE_TRIAL_EACH = (*SE_OVER_TIME, "shared.desired_trajectory=false")
SE_TIME_SHARED = (*SE_OFFSET, "shared.residual=true")
SE_PLANE = (*SE, "model.residual.input=[position]")
FINEST = Accuracy(4.5, 8.0)

CASES = [
    ("markov", "phase", NO_RESIDUAL, ("x", "y", "z"), True),
    ("markov", "phase", OFFSET, ("x", "y"), True),
    ("markov", "phase", SMOOTH, ("x", "y"), True),
    ("markov", "time", SHARED_OVER_TIME, ("x", "y"), True),
    ("markov", "time", OFFSET, ("x", "y"), False),
    ("markov", "position", NO_RESIDUAL, ("x",), False),
    ("lowrank", "phase", SE_OFFSET, ("x", "y"), True),
    ("lowrank", "phase", SE_TRIAL_EACH, ("x", "y"), False),
    ("lowrank", "time", SE_TIME_SHARED, ("x", "y"), True),
    ("dense", "phase", OFFSET, ("x", "y"), False),
    ("dense", "time", OFFSET, ("x", "y"), True),
    ("dense", "position", SE_PLANE, ("x", "y"), True),
]


def engine_of(name, problem, coupled, accuracy=FINEST):
    if name == "markov":
        return MarkovEngine(problem.features, problem.processes, coupled)
    if name == "lowrank":
        return LowRankEngine(problem.features, coupled, accuracy)
    return DenseGivenImpedance(problem.features, coupled)


def valid(features):
    return torch.ones(features.inputs.shape[1:3]).bool() if features.valid is None else features.valid


def target_of(problem):
    """Some samples of the data, then the same ones a little further, then in two trials that were never seen."""
    features, layout = problem.features, problem.processes.layout
    rows = torch.arange(0, features.inputs.shape[2], 7)
    own = [int(c) for term in problem.processes.residual if term.num_dims for c in term.active_dims]
    labels = [column for column in (layout.trajectory, layout.residual) if column is not None]
    same = features.inputs[:, :, rows]
    further, unseen = same.clone(), same.clone()
    further[..., sorted({*layout.theta, *own})] += 0.004
    parity = (torch.arange(len(rows)) % 2).double()
    for column in labels:
        unseen[..., column] = 77.0 + parity
    keep = valid(features)[:, rows]
    target = replace(
        features,
        inputs=torch.cat([same, further, unseen], dim=2),
        force=None,
        trajectory_mean=features.trajectory_mean[:, :, rows].repeat(1, 1, 3, 1),
        valid=keep.repeat(1, 3),
    )
    return target, problem.impedance[:, rows].repeat(1, 3, 1, 1, 1)


def affine(monkeypatch, draw):
    """Mean `(outputs,)` and J `(numbers, outputs)` of what `draw` makes of standard normal numbers."""
    given, place = None, 0

    def numbers(shape, generator=None, dtype=None):
        nonlocal place
        assert isinstance(generator, torch.Generator) and dtype is torch.float64
        count = int(torch.Size(shape).numel())
        result = torch.zeros(count, dtype=dtype)
        if given is not None and place <= given < place + count:
            result[given - place] = 1.0
        place += count
        return result.reshape(torch.Size(shape))

    def flat():
        drawn = draw()
        assert list(drawn) == list(LATENTS)
        return torch.stack(list(drawn.values())).flatten()

    with monkeypatch.context() as patch:
        patch.setattr(torch, "randn", numbers)
        mean, rows = flat(), []
        for one in range(place):
            given, place = one, 0
            rows.append(flat() - mean)
    return mean, torch.stack(rows)


def conditioned(problem, target, target_impedance, coupled):
    """Mean and covariance of all `LATENTS` at the valid samples of `target`, by one covariance of everything a group.

    As vectors in the order (latent, axis, group, sample); what no draw reaches is zero.
    """
    processes, features = problem.processes, problem.features
    axes, groups, m = target.inputs.shape[:3]
    shape = (len(LATENTS), axes, groups, m)
    mean, covariance = torch.zeros(shape).double(), torch.zeros(*shape, *shape).double()
    for g in range(groups):
        here, there = valid(features)[g], valid(target)[g]
        n, k = int(here.sum()), int(here.sum() + there.sum())
        x = torch.cat([features.inputs[:, g, here], target.inputs[:, g, there]], dim=1)
        w = torch.cat([problem.impedance[g, here], target_impedance[g, there]])
        if not coupled:
            w = torch.diag_embed(w.diagonal(dim1=-2, dim2=-1))
        # Of axis a: f, ḟ, f̈ and ũ at all samples.
        prior = torch.zeros(axes, 4, k, axes, 4, k).double()
        path = processes.layout.path(x.unsqueeze(1))
        common, table = derivative_table(processes.trajectory, path, path)
        for a in range(axes):
            for i in range(3):
                for j in range(3):
                    block = (common * table[i][j]).expand(axes, 1, k, k)[a, 0]
                    prior[a, i, :, a, j] = block * alike(x[a], processes.layout.trajectory)
            for term in processes.residual:
                block = evaluate(term, x.unsqueeze(1), x.unsqueeze(1)).expand(axes, 1, k, k)[a, 0]
                prior[a, 3, :, a, 3] += block * alike(x[a], processes.layout.residual)
        # What forces and latents are of these.
        force = torch.zeros(axes, k, axes, 4, k).double()
        for t in range(k):
            force[:, t, :, :3, t] = w[t].permute(1, 2, 0)
            for a in range(axes):
                force[a, t, a, 3, t] = 1.0
        latents = torch.zeros(len(LATENTS), axes, k - n, axes, 4, k).double()
        for i, latent in enumerate(LATENTS):
            if latent is Latent.FORCE:
                latents[i] = force[:, n:]
            else:
                for a in range(axes):
                    for t in range(k - n):
                        latents[i, a, t, a, i - 1, n + t] = 1.0
        errors = processes.layout.errors(x, order=2)
        known = 0.0 if errors is None else torch.einsum("njab,bnj->an", w, torch.cat(errors, dim=-1))
        known = torch.zeros(axes, k).double() + known
        prior = prior.reshape(axes * 4 * k, -1)
        observed = force[:, :n].reshape(axes * n, -1)
        wanted = latents.reshape(-1, axes * 4 * k)
        noise = processes.noise_variance.expand(axes, 1, 1)[:, :, 0].expand(axes, n).reshape(-1)
        root = torch.linalg.cholesky(observed @ prior @ observed.T + torch.diag(noise))
        white = torch.linalg.solve_triangular(root, observed @ prior @ wanted.T, upper=False)
        misfit = (features.force[:, g, here] - known[:, :n]).reshape(-1, 1)
        shift = white.T @ torch.linalg.solve_triangular(root, misfit, upper=False)
        start = torch.zeros(len(LATENTS), axes, k - n).double()
        start[0] = known[:, n:]
        start[1:4] = target.trajectory_mean[:, g, there].permute(2, 0, 1)
        mean[:, :, g, there] = start + shift.reshape(start.shape)
        full = wanted @ prior @ wanted.T - white.T @ white
        full = full.reshape(*start.shape, *start.shape)
        places = there.nonzero()[:, 0]
        for i, s in enumerate(places):
            for j, t in enumerate(places):
                covariance[:, :, g, s, :, :, g, t] = full[:, :, i, :, :, j]
    size = mean.numel()
    return mean.flatten(), covariance.reshape(size, size)


def alike(x, column):
    return 1.0 if column is None else (x[:, None, column] == x[None, :, column]).double()


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind", "overrides", "axes", "coupled"), CASES)
def test_a_draw_has_mean_and_covariance_of_dense_algebra(monkeypatch, name, kind, overrides, axes, coupled):
    problem = given_problem(kind, overrides, axes, repetitions=2, rate=6.5, groups=2)
    x = problem.features.inputs
    if kind == "phase":
        # A sample of the second repetition is where one of the first is, exactly.
        phase = x[..., problem.processes.layout.theta[0]]
        columns = [column for column in range(x.shape[-1]) if torch.equal(x[..., column], phase)]
        x[:, 0, 15, columns] = x[:, 0, 2, columns]
    target, target_impedance = target_of(problem)
    engine, generator = engine_of(name, problem, coupled), torch.Generator()
    if name == "lowrank":
        known = engine.coefficients(problem.processes, problem.impedance, target)
        monkeypatch.setattr(engine, "coefficients", lambda *_: known)

    def draw():
        return engine.draw(problem.processes, problem.impedance, target, target_impedance, generator)

    mean, root = affine(monkeypatch, draw)
    expected, covariance = conditioned(problem, target, target_impedance, coupled)
    keep = valid(target).expand(len(LATENTS), len(axes), *valid(target).shape).flatten()
    assert not root[:, ~keep].any()
    sd = covariance.diagonal().clamp_min(0.0).sqrt()[keep]
    safe = torch.where(sd > 1e-9, sd, 1.0)
    # In posterior SDs.
    assert ((mean - expected)[keep].abs() / safe).max() < 1e-7
    found = (root.T @ root)[keep][:, keep]
    assert ((found - covariance[keep][:, keep]).abs() / (safe[:, None] * safe)).max() < 1e-7


def force_of(problem, target, target_impedance, drawn, coupled):
    """Σ_j W_j e⁽ʲ⁾ + ũ, a sample at a time."""
    axes = len(target.inputs)
    errors = problem.processes.layout.errors(target.inputs, order=2)
    hand = target.trajectory_mean.clone()
    if errors is not None:
        hand -= torch.cat(errors, dim=-1)
    desired = torch.stack(list(drawn.values())[1:4], dim=-1)
    result = drawn[Latent.RESIDUAL_FORCE].clone()
    for a in range(axes):
        for b in range(axes):
            if a == b or coupled:
                for j in range(3):
                    w = target_impedance[:, :, j, a, b]
                    result[a] += w * (desired - hand)[b, :, :, j]
    return result


CONSISTENT = [
    ("markov", "phase", OFFSET, True),
    ("markov", "phase", OFFSET, False),
    ("lowrank", "phase", SE_OFFSET, True),
    ("lowrank", "position", SE_PLANE, False),
    ("dense", "phase", OFFSET, True),
    ("dense", "position", SE_PLANE, False),
]


@torch.no_grad()
@pytest.mark.parametrize(("name", "kind", "overrides", "coupled"), CONSISTENT)
def test_force_is_that_of_the_same_draw_and_seeds_decide(name, kind, overrides, coupled):
    problem = given_problem(kind, overrides, repetitions=2, rate=7.0, groups=2)
    target, w = target_of(problem)
    engine = engine_of(name, problem, coupled, None)
    one, same, other = (
        engine.draw(problem.processes, problem.impedance, target, w, torch.Generator().manual_seed(seed))
        for seed in (3, 3, 4)
    )
    for latent in LATENTS:
        assert one[latent].shape == target.inputs.shape[:3]
        assert torch.equal(one[latent], same[latent])
        assert not torch.isclose(one[latent], other[latent], rtol=1e-9, atol=0.0)[:, valid(target)].any()
    expected = force_of(problem, target, w, one, coupled)
    scale = float(expected.abs().max())
    torch.testing.assert_close(one[Latent.FORCE], expected, rtol=0, atol=1e-11 * scale)
    # Padding has the prior mean.
    if target.valid is not None:
        nothing = ~target.valid
        assert not one[Latent.RESIDUAL_FORCE][:, nothing].any()
        mean = target.trajectory_mean[:, nothing]
        assert torch.equal(one[Latent.DESIRED_POSITION][:, nothing], mean[..., 0])


PERIODIC = (*SE_OVER_TIME, "engine.impedance=map", "model.desired_trajectory.periodic=true")


@torch.no_grad()
@pytest.mark.parametrize(
    ("name", "overrides", "count"),
    [
        ("markov", OFFSET, 1000),
        ("lowrank", SE_OFFSET, 300),
        ("lowrank", PERIODIC, 300),
        ("dense", OFFSET, 200),
    ],
)
def test_moments_of_many_draws_are_those_of_the_posterior(name, overrides, count):
    problem = given_problem("phase", overrides, ("x", "y"), repetitions=2, rate=7.0)
    target, w = target_of(problem)
    processes, given = problem.processes, problem.impedance
    engine = engine_of(name, problem, True, None)
    generator = torch.Generator().manual_seed(0)
    draws = [engine.draw(processes, given, target, w, generator) for _ in range(count)]
    for latent, (mean, variance) in engine.posterior(processes, given, target, w).items():
        sample = torch.stack([drawn[latent] for drawn in draws])
        error = (sample.mean(0) - mean) / (variance / count).sqrt()
        ratio = (sample.var(0) / variance - 1.0) / (2.0 / count) ** 0.5
        # The largest of so few normal numbers is above 4.5 in one of a thousand seeds; variances have a longer tail.
        assert error.abs().max() < 4.5, latent
        assert ratio.abs().max() < 5.0, latent


def test_the_engine_takes_one_target_after_another():
    problem = given_problem("phase", OFFSET, repetitions=2, rate=7.0, groups=2)
    target, w = target_of(problem)
    fewer = replace(target, valid=valid(target) & (torch.arange(target.inputs.shape[2]) % 2 == 0))
    engine = MarkovEngine(problem.features, problem.processes, True)

    def posterior(features):
        return engine.posterior(problem.processes, problem.impedance, features, w)[Latent.DESIRED_POSITION]

    first, second, again = posterior(target), posterior(fewer), posterior(target)
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
    assert not second[1][:, ~fewer.valid].any()


STEPS = [1e-12, 1e-8, 1e-5, 1e-3, 0.03, 0.5, 1.0, 3.9, 4.1, 12.0, 60.0, 1e3]


@pytest.mark.parametrize("z", STEPS)
def test_moments_of_a_step(z):
    # Where e^(−2zt) has fallen to e^(−80) nothing is left.
    end = min(1.0, 40.0 / z)
    node, weight = np.polynomial.legendre.leggauss(80)
    t, weight = end * (node + 1.0) / 2.0, end * weight / 2.0
    expected = [np.sum(weight * t**m * np.exp(-2.0 * z * t)) for m in range(5)]
    np.testing.assert_allclose(moments(z), expected, rtol=3e-14)


@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("z", STEPS)
def test_a_step_adds_the_covariance_that_its_decay_takes(z, size):
    """q ∫₀ᶻ φ φᵀ ds of the white noise that enters the last state, entry by entry in its own SDs."""
    end = min(z, 40.0)
    node, weight = np.polynomial.legendre.leggauss(80)
    s, weight = end * (node + 1.0) / 2.0, end * weight / 2.0
    e = np.exp(-s)
    phi = {
        1: [e],
        2: [s * e, (1.0 - s) * e],
        3: [s**2 / 2 * e, (s - s**2 / 2) * e, (1.0 - 2.0 * s + s**2 / 2) * e],
    }[size]
    density = {1: 2.0, 2: 4.0, 3: 16.0 / 3.0}[size]
    expected = density * np.einsum("in,jn,n->ij", phi, phi, weight)
    factor = np.zeros((size, size))
    for j in range(size):
        states = np.zeros((2, 1, size))
        states[1, 0, j] = 1.0
        simulate_pair(size, z, states)
        factor[:, j] = states[1, 0]
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(factor @ factor.T / np.outer(sd, sd), expected / np.outer(sd, sd), atol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_a_step_of_no_length_changes_nothing_and_processes_begin_stationary(size):
    start = np.zeros((size, size))
    for j in range(size):
        states = np.ones((2, 1, size))
        states[0] = 0.0
        states[0, 0, j] = 1.0
        simulate_pair(size, 0.0, states)
        np.testing.assert_array_equal(states[1], states[0])
        start[:, j] = states[0, 0]
    third = np.array([[1.0, 0.0, -1.0 / 3.0], [0.0, 1.0 / 3.0, 0.0], [-1.0 / 3.0, 0.0, 1.0]])
    np.testing.assert_allclose(start @ start.T, third if size == 3 else np.eye(size), atol=1e-15)


def simulate_pair(size, z, states):
    chain = Chain.of(np.array([0, 0]), np.array([0.0, z]))
    simulate(size, 0, np.array([1.0]), chain.steps, chain.fresh, chain.order, states)


def test_chains_take_processes_one_by_one():
    chain = Chain.of(np.array([1, 0, 1, 0, 2]), np.array([3.0, 2.0, 1.0, 2.0, 7.0]))
    np.testing.assert_array_equal(chain.order, [1, 3, 2, 0, 4])
    np.testing.assert_array_equal(chain.steps, [0.0, 0.0, 0.0, 2.0, 0.0])
    np.testing.assert_array_equal(chain.fresh, [True, False, True, False, True])
