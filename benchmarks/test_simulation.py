"""The simulated arm: thirty seconds at 1 kHz, also the first of an interpreter; beside scipy; trials side by side."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from bayes_impedance.simulation.arm import Arm, motion_of_joints
from bayes_impedance.simulation.device import NO_SERVO, BandLimitedForce
from bayes_impedance.simulation.dynamics import Drive, integrate
from bayes_impedance.simulation.experiment import STEP, Experiment, simulate
from bayes_impedance.simulation.subjects import Subject
from bayes_impedance.simulation.tasks import FigureEight, Flower, Pace, Run, desired_motion
from benchmarks.paired import paired

FRESH = """
import time
import bayes_impedance.simulation.experiment as experiment
from benchmarks.test_simulation import thirty_seconds
for _ in range(2):
    start = time.perf_counter()
    experiment.simulate(thirty_seconds())
    print(time.perf_counter() - start)
"""
MASS, DAMPING = np.full(2, 2.0), np.full(2, 6.0)


def thirty_seconds() -> Experiment:
    person = Subject("P", pace=Pace(10.0, spread=0.0))
    return Experiment([person], Flower(), 1, 3, BandLimitedForce(2.0), rate=1000.0)


def test_thirty_seconds_at_1_khz(benchmark):
    benchmark.pedantic(simulate, args=(thirty_seconds(),), rounds=10, warmup_rounds=1)


def test_first_call_of_an_interpreter(figures, tmp_path):
    """Once with nothing compiled, once with what that left behind."""
    for name in ("nothing_compiled", "compiled_before"):
        printed = subprocess.run(
            [sys.executable, "-c", FRESH],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            cwd=Path(__file__).parents[1],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        first, second = map(float, printed.split())
        figures[f"simulation_30s_1khz_{name}"] = {
            "first_call_seconds": first,
            "second_call_seconds": second,
            "real_time_over_first_call": 30.0 / first,
        }


def test_three_seconds_beside_scipy(benchmark, figures):
    """The same plan for both; scipy chooses its steps, to about the error that the fixed one makes."""
    arm, n = Arm(), 3001
    half = 0.5 * STEP * np.arange(2 * n - 1)
    q, w, a = motion_of_joints(arm, *desired_motion(FigureEight(), Run(3.0, np.zeros(2)), half))
    torque = (arm.inertia(q) @ a[..., None])[..., 0] + arm.coriolis(q, w)
    desired, start = np.concatenate([q, w, torque], 1), np.concatenate([q[0], w[0]])
    none = np.zeros((n, 2))
    drive = Drive(desired, np.zeros((n, 6)), none, none, NO_SERVO, (0.0, 0.0), start)
    planned = CubicSpline(half, desired)

    def right_side(time: float, state: np.ndarray) -> np.ndarray:
        now, (angles, rates) = planned(time), (state[:2], state[2:])
        error = now[:2] - angles + arm.damping_ratio * (now[2:4] - rates)
        jacobian = arm.jacobian(angles)
        load = MASS * (arm.jacobian_rate(angles, rates) @ rates) + DAMPING * (jacobian @ rates)
        push = now[4:] + arm.joint_stiffness(arm.command(now[4:])) @ error
        push = push - arm.coriolis(angles, rates) - jacobian.T @ load
        whole = arm.inertia(angles) + jacobian.T @ (MASS[:, None] * jacobian)
        return np.concatenate([rates, np.linalg.solve(whole, push)])

    def ours():
        return integrate(arm, MASS, DAMPING, drive, STEP).q

    def theirs():
        times = STEP * np.arange(n)
        return solve_ivp(right_side, (0.0, times[-1]), start, t_eval=times, rtol=1e-7, atol=1e-9).y[:2].T

    assert np.abs(arm.hand(ours()) - arm.hand(theirs())).max() < 1e-6
    measured = paired(ours, theirs, rounds=5)
    figures["simulation_3s_over_scipy_rk45"] = {**measured, "times_faster": 1.0 / measured["ratio"]}
    benchmark.pedantic(ours, rounds=20)


def test_hundred_trials(figures):
    person = Subject("P", pace=Pace(3.0))
    together = Experiment([person], Flower(), 100, 1)
    alone = Experiment([person], Flower(), 1, 1)
    figures["simulation_100_trials_over_one_by_one"] = paired(
        lambda: simulate(together), lambda: [simulate(alone, seed) for seed in range(100)], rounds=5
    )
