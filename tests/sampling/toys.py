"""Densities that look like a `JointDensity` to a sampler, with moments that are known."""

import os
import signal
from multiprocessing import current_process

import numpy as np
import torch

from bayes_impedance.errors import NotPositiveDefiniteError
from bayes_impedance.sampling.start import Start


class Toy:
    """What samplers need of a density; counts its evaluations."""

    size = 3

    def __init__(self):
        self.evaluations = 0

    def log_density(self, standard):
        self.evaluations += 1
        return self.value(standard)

    def joint(self, point):
        standard = torch.from_numpy(point).clone().requires_grad_()
        value = self.log_density(standard)
        (gradient,) = torch.autograd.grad(value, standard)
        return float(value.detach()), gradient.numpy()


class Gaussian(Toy):
    """N(`mean`, `covariance`); where the first coordinate is beyond `edge` it fails, so there it has no mass."""

    mean = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    covariance = torch.tensor([[1.0, 0.6, 0.0], [0.6, 0.5, 0.1], [0.0, 0.1, 4.0]], dtype=torch.float64)

    def __init__(self, edge=np.inf):
        super().__init__()
        self.edge = edge
        self.precision = torch.linalg.inv(self.covariance)

    def value(self, standard):
        if standard[0] > self.edge:
            raise NotPositiveDefiniteError("beyond the edge")
        away = standard - self.mean
        return -0.5 * away @ self.precision @ away


class Funnel(Toy):
    """v ~ N(0, 1), the others N(0, exp(v)) given v."""

    def value(self, standard):
        v, rest = standard[0], standard[1:]
        return -0.5 * v**2 - 0.5 * rest.square().sum() * torch.exp(-v) - 0.5 * len(rest) * v


class Mortal(Gaussian):
    """Kills its process at evaluation number `last`."""

    def __init__(self, last):
        super().__init__()
        self.last = last

    def value(self, standard):
        if self.evaluations >= self.last:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().value(standard)


class Deadly(Gaussian):
    """The second chain is killed, the third one's process leaves."""

    def value(self, standard):
        if self.evaluations > 100 and current_process().name == "chain 2":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.evaluations > 100 and current_process().name == "chain 3":
            os._exit(3)
        return super().value(standard)


class Broken(Gaussian):
    """Has a bug that shows after a while."""

    def value(self, standard):
        if self.evaluations > 200:
            raise ValueError("a bug")
        return super().value(standard)


def start(size=3, scale=1.0, at=0.0):
    return Start(np.full(size, at), scale * np.eye(size), "known")
