"""A hand on an admittance-controlled device: the loop that makes acceleration answer force (docs/model.md §6).

    M_r ẍ + D_r ẋ = u + p,    u = k (x_d − x) + d (ẋ_d − ẋ) + m (ẍ_d − ẍ) + ũ + ε

One axis, constant impedance. The controller acts on the measured force, so the noise ε of its sensor moves the hand
too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayes_impedance.log import InteractionLog, Trial
from bayes_impedance.simulation.device import Admittance

Array = NDArray[np.float64]

#: Of the controller [s].
STEP = 1e-3
#: Amplitude [m] of the first and second harmonic of the desired trajectory over a repetition.
HARMONICS = (0.08, 0.03)


@dataclass(frozen=True)
class ConstantImpedance:
    """Constant stiffness k [N/m], damping d [Ns/m] and mass m [kg] of one axis."""

    stiffness: float = 100.0
    damping: float = 9.0
    mass: float = 1.2


@dataclass(frozen=True)
class Signal:
    """A sum of sinusoids: `amplitude` · sin(`omega` t + `shift`), `(terms,)` each [unit, rad/s, rad]."""

    amplitude: Array
    omega: Array
    shift: Array

    def __call__(self, time: Array | float, order: int = 0) -> Array:
        """Time derivative of `order` at `time` `(n,)` [s]."""
        angle = np.multiply.outer(time, self.omega) + self.shift + 0.5 * math.pi * order
        return np.asarray(np.sin(angle) @ (self.amplitude * self.omega**order))


def held_device(
    arm: ConstantImpedance,
    device: Admittance,
    perturbation_sd: float,
    residual_sd: float = 0.4,
    noise_sd: float = 0.05,
    repetitions: int = 6,
    duration: float = 4.0,
    every: int = 5,
    seed: int = 0,
) -> InteractionLog:
    """Repetitions of one desired trajectory along x, perturbed by the device, as a logger would write them.

    `perturbation_sd` [N]: band-limited noise of .3 to 4 Hz that the device adds; `residual_sd` [N]: what the person
    adds beside the impedance, a Gaussian process of .1 s; `noise_sd` [N]: white, of the force sensor at the rate of
    the controller, 1 kHz, of which the log has one sample in `every`. `duration` [s] of a repetition. The log has
    phase, perturbation, the desired trajectory as `reference`, and the truth.
    """
    generator = np.random.default_rng(seed)
    omega = 2.0 * math.pi / duration
    desired = Signal(np.array(HARMONICS), omega * np.array([1.0, 2.0]), np.zeros(2))
    time = STEP * np.arange(round(duration / STEP), dtype=np.float64)
    trials = []
    for repetition in range(repetitions):
        perturbation = _noise(perturbation_sd, 2.0 * math.pi * generator.uniform(0.3, 4.0, 30), generator)(
            time
        )
        # The spectral density of a squared exponential of length ℓ is Gaussian with SD 1/ℓ.
        residual = _noise(residual_sd, generator.standard_normal(200) / 0.1, generator)(time)
        noise = noise_sd * generator.standard_normal(time.size)
        position, force = held_impedance(arm, device, desired, perturbation, residual + noise, time)
        truth = {
            "desired_position_x": desired(time),
            "residual_force_x": residual,
            "stiffness_xx": np.full_like(time, arm.stiffness),
            "damping_xx": np.full_like(time, arm.damping),
            "mass_xx": np.full_like(time, arm.mass),
        }
        logged = slice(None, None, every)
        trials.append(
            Trial(
                name=str(repetition), group="0", source="memory", time=time[logged],
                position=position[logged, None],
                force=force[logged, None],
                perturbation=perturbation[logged, None],
                reference=desired(time[logged])[:, None],
                repetition=np.zeros(time[logged].size, dtype=np.int64),
                phase=time[logged] / duration,
                truth={name: values[logged] for name, values in truth.items()},
            )
        )  # fmt: skip
    return InteractionLog(("x",), tuple(trials))


def _noise(sd: float, omega: Array, generator: np.random.Generator) -> Signal:
    shift = generator.uniform(0.0, 2.0 * math.pi, omega.size)
    return Signal(np.full(omega.size, sd * math.sqrt(2.0 / omega.size)), omega, shift)


def held_impedance(
    arm: ConstantImpedance,
    device: Admittance,
    desired: Signal,
    perturbation: Array,
    added: Array,
    time: Array,
) -> tuple[Array, Array]:
    """Position [m] and force [N] from rest beside the desired trajectory, acceleration held for each step.

    `added` [N] is what the force holds beside the impedance.
    """
    target, target_velocity, target_acceleration = (desired(time, order) for order in range(3))
    position, force = np.empty_like(time), np.empty_like(time)
    x, v = float(target[0]), float(target_velocity[0])
    for i in range(time.size):
        tracking = arm.stiffness * (target[i] - x) + arm.damping * (target_velocity[i] - v)
        tracking += arm.mass * target_acceleration[i] + added[i]
        driven = (perturbation[i] - device.damping * v) / device.mass
        # ẍ = u/M_r + driven put into the law of the arm, and solved for u.
        u = (tracking - arm.mass * driven) / (1.0 + arm.mass / device.mass)
        position[i], force[i] = x, u
        acceleration = u / device.mass + driven
        x += STEP * v + 0.5 * STEP**2 * acceleration
        v += STEP * acceleration
    return position, force
