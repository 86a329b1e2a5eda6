"""Mean and variance at one point, n = 500, of a new measurement, beside gpytorch's default prediction of a plain GP."""

from __future__ import annotations

import pytest
import torch

from bayes_impedance.engines.dense import Observations
from bayes_impedance.engines.pointwise import PointPredictor
from benchmarks.paired import paired
from benchmarks.problems import XI, PlainGP, force, inputs, interaction_kernel

N = 500


@pytest.mark.benchmark(group="mean and variance at one point, n = 500")
def test_one_point(benchmark, figures):
    x, u = inputs(N), force(N)
    noise = torch.tensor([0.09], dtype=torch.float64)
    predictor = PointPredictor(interaction_kernel(), Observations(x, u, noise))
    query = x[N // 2].numpy() + 1e-3
    model = PlainGP(x[:, list(XI)], u).eval()
    point = torch.from_numpy(query[list(XI)]).unsqueeze(0)

    def plain() -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            measurement = model.likelihood(model(point))
            return measurement.mean, measurement.variance

    measured = paired(lambda: predictor.predict(query), plain, rounds=10, calls=100)
    figures["one_point_n500_over_gpytorch_default"] = {**measured, "times_faster": 1.0 / measured["ratio"]}
    benchmark.pedantic(predictor.predict, args=(query,), rounds=20, iterations=20)
