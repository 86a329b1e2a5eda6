"""The robot's own law: virtual mass and damping from motion and force."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bayes_impedance.log import Array
from bayes_impedance.recording.alike import Alike
from bayes_impedance.recording.least_squares import fit
from bayes_impedance.recording.plausibility import Sign

#: Standard errors that a mass has to be above zero to be called determined.
SURE = 2.0
#: Standard errors that a damping has to be away from zero to have a sign.
SURE_OF_SIGN = 3.0
#: A law that explains less of the variance of force is none.
SMALLEST_SHARE = 0.5


@dataclass(frozen=True, eq=False)
class DeviceLaw:
    """u + p = M a + B v for each axis: `mass` [kg], `damping` [Ns/m], their standard errors, all `(a,)`.

    `r_squared (a,)` is about the mean of an axis, `pooled` over all axes together: 1 − Σ SS_res / Σ SS_tot.
    """

    mass: Array
    damping: Array
    mass_error: Array
    damping_error: Array
    r_squared: Array
    pooled: float

    @property
    def mass_determined(self) -> npt.NDArray[np.bool_]:
        """Whether the motion accelerates enough to tell the mass of an axis from zero, `(a,)`."""
        return self.mass > SURE * self.mass_error

    @property
    def holds(self) -> bool:
        """Whether the robot answers force by a mass and a damping: they explain half of the variance over all axes."""
        return self.pooled >= SMALLEST_SHARE

    @property
    def sign(self) -> Sign:
        """What the damping says about the sign of the force: a robot does not drive itself."""
        sure = np.abs(self.damping) > SURE_OF_SIGN * self.damping_error
        if not self.holds or not sure.any():
            return Sign.UNKNOWN
        if (self.damping[sure] > 0).all():
            return Sign.EXPECTED
        return Sign.REVERSED if (self.damping[sure] < 0).all() else Sign.UNKNOWN

    def sentence(self, axis: int, name: str) -> str:
        """What was found of an axis."""
        mass = (
            f"mass {self.mass[axis]:.3g} ± {self.mass_error[axis]:.2g} kg"
            if self.mass_determined[axis]
            else "a mass that the motion does not determine"
        )
        return (
            f"{name}: the robot follows {mass} and damping {self.damping[axis]:.4g} ± {self.damping_error[axis]:.2g} "
            f"Ns/m, which explain {100 * self.r_squared[axis]:.0f} % of the variance of force"
        )


def fit_device_law(
    time: Array,
    velocity: Array | None,
    force: Array,
    perturbation: Array | None = None,
    window: float = 0.3,
    *,
    position: Array | None = None,
) -> DeviceLaw:
    """Virtual mass and damping of each axis by least squares, all signals smoothed over the same `window` [s].

    `time (n,)` [s], `velocity (n, a)` [m/s], or `position (n, a)` [m] where it was not recorded; `force (n, a)` [N] of
    the human on the robot in the base frame, `perturbation (n, a)` [N] of the robot. No intercept: a robot that nobody
    touches stands still.

    Raises:
        LogError: the recording is shorter than three windows.
    """
    alike = Alike(time, window)
    if velocity is not None:
        v, a = alike.smooth(velocity), alike.derivative(velocity)
    else:
        assert position is not None, "velocity or position"
        v, a = alike.derivative(position), alike.derivative(position, order=2)
    u = alike.smooth(force if perturbation is None else force + perturbation)
    fits = [fit(np.stack([a[:, [k]], v[:, [k]]], axis=2), u[:, [k]]) for k in range(u.shape[1])]
    coefficients = np.array([found.coefficients for found in fits])
    errors = np.array([found.standard_errors for found in fits])
    left = np.array([np.sum(found.residual**2) for found in fits])
    total = np.sum((u - u.mean(axis=0)) ** 2, axis=0)
    return DeviceLaw(
        mass=coefficients[:, 0],
        damping=coefficients[:, 1],
        mass_error=errors[:, 0],
        damping_error=errors[:, 1],
        r_squared=1.0 - left / np.maximum(total, 1e-300),
        pooled=1.0 - float(left.sum() / max(total.sum(), 1e-300)),
    )
