"""Figures: the right numbers in the right panels, and no impedance without its verdict."""

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayes_impedance.config import load_config
from bayes_impedance.errors import OutputError
from bayes_impedance.identifiability import Support, rounded
from bayes_impedance.kernels import Latent
from bayes_impedance.log import InteractionLog
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.plotting import (
    plot_desired_trajectory,
    plot_force,
    plot_impedance,
    plot_plan,
    save_figures,
)
from bayes_impedance.plotting.plans import MARKERS
from bayes_impedance.readers import read_log
from bayes_impedance.simulation.planning import Expectation, Plan

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def posterior(tiny):
    return tiny.fitted.posterior(tiny.fitted.fitted.log)


@pytest.fixture(scope="module")
def verdicts(tiny, posterior):
    return tiny.fitted.verdicts(posterior)


@pytest.fixture(scope="module")
def bare(tiny):
    """Posterior of a log without force, phase or truth under an untrained model over time, and its verdicts."""
    levels = [f"model.{name}.level=10" for name in ("stiffness", "damping", "mass")]
    config = load_config("time", [*levels, "preprocessing.smoother.window=0.14", "preprocessing.rate=10"])
    log = read_log(tiny.other, config.log)
    trial = log.trials[0]
    model = ImpedanceModel(config)
    posterior = model.posterior(
        InteractionLog.from_arrays(trial.time, trial.position, None, axes=log.axes, trial="bare")
    )
    return posterior, model.verdicts(posterior)


def panels(figure: Figure, rows: int, columns: int) -> list[list[Axes]]:
    axes = figure.get_axes()
    assert len(axes) == rows * columns
    return [axes[row * columns : (row + 1) * columns] for row in range(rows)]


def lines(ax: Axes) -> dict[str, np.ndarray]:
    """Label → `(x, y)` of every line."""
    return {str(line.get_label()): np.array(line.get_data()) for line in ax.get_lines()}


def band(ax: Axes, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper edge of a filled band."""
    vertices = ax.collections[index].get_paths()[0].vertices
    n = (len(vertices) - 3) // 2
    return vertices[1 : n + 1, 1], vertices[n + 2 : 2 * n + 2, 1][::-1]


def test_force(posterior):
    figure = plot_force(posterior)
    assert figure.get_suptitle() == "Interaction force"
    grid = panels(figure, rows=2, columns=2)
    for a, axis in enumerate("xy"):
        assert grid[a][0].get_ylabel() == f"force {axis} [N]"
        for column, trial in enumerate(posterior.log.trials):
            ax, rows = grid[a][column], posterior.trial_slice(column)
            found = lines(ax)
            assert set(found) == {"measured", "new measurement, 90 % band"}
            np.testing.assert_array_equal(found["measured"], [trial.time, trial.force[:, a]])
            median = posterior["force"].quantile(0.5)[rows, a]
            np.testing.assert_array_equal(found["new measurement, 90 % band"], [trial.time, median])
            low, high = band(ax, 0)
            np.testing.assert_allclose(low, posterior["force"].quantile(0.05)[rows, a])
            np.testing.assert_allclose(high, posterior["force"].quantile(0.95)[rows, a])
            assert grid[0][column].get_title() == f"trial {trial.name}"
            assert grid[1][column].get_xlabel() == "time [s]"


def test_desired_trajectory(posterior):
    figure = plot_desired_trajectory(posterior, [1])
    assert figure.get_suptitle() == "Desired and actual trajectory"
    grid = panels(figure, rows=2, columns=1)
    trial, rows = posterior.log.trials[1], posterior.trial_slice(1)
    for a, axis in enumerate("xy"):
        assert grid[a][0].get_ylabel() == f"position {axis} [m]"
        found = lines(grid[a][0])
        assert set(found) == {"hand", "desired, 90 % band", "true desired"}
        np.testing.assert_array_equal(found["hand"][1], trial.position[:, a])
        np.testing.assert_array_equal(found["true desired"][1], trial.truth[f"desired_position_{axis}"])
        np.testing.assert_array_equal(
            found["desired, 90 % band"][1], posterior["desired_position"].mean[rows, a]
        )
    assert grid[0][0].get_title() == "trial 1"
    assert grid[1][0].get_xlabel() == "time [s]"


def test_impedance_never_without_its_verdict(posterior, verdicts):
    figure = plot_impedance(posterior, verdicts, trial=1)
    assert figure.get_suptitle() == "Impedance along trial 1, axes x, y"
    grid = panels(figure, rows=3, columns=2)
    said = {(verdict.latent.value, verdict.axis): verdict for verdict in verdicts}
    trial, rows = posterior.log.trials[1], posterior.trial_slice(1)
    for row, (name, unit) in enumerate([("stiffness", "N/m"), ("damping", "Ns/m"), ("mass", "kg")]):
        assert grid[row][0].get_ylabel() == f"{name} [{unit}]"
        for a, axis in enumerate("xy"):
            ax, verdict = grid[row][a], said[name, axis]
            assert ax.get_title() == (
                f"{name} {axis}{axis}: {verdict.support.value} (contraction {rounded(verdict.contraction)})"
            )
            found = lines(ax)
            assert set(found) == {"posterior, 90 % band", "truth"}
            np.testing.assert_array_equal(found["truth"], [trial.phase, trial.truth[f"{name}_{axis}{axis}"]])
            np.testing.assert_array_equal(
                found["posterior, 90 % band"][1], posterior[name].quantile(0.5)[rows, a]
            )
            for index, quantile in enumerate((posterior[name].prior_quantile, posterior[name].quantile)):
                low, high = band(ax, index)
                np.testing.assert_allclose(low, quantile(0.05)[rows, a])
                np.testing.assert_allclose(high, quantile(0.95)[rows, a])
            # What is positive by construction stands on a logarithmic axis.
            assert ax.get_yscale() == ("linear" if name == "mass" else "log")
            assert grid[2][a].get_xlabel() == "phase"


def test_impedance_needs_a_verdict_for_every_panel(posterior, verdicts):
    with pytest.raises(KeyError):
        plot_impedance(posterior, verdicts[:-1])


def test_what_a_log_lacks_is_not_drawn(bare):
    bare, verdicts = bare
    assert set(lines(plot_force(bare).get_axes()[0])) == {"new measurement, 90 % band"}
    assert set(lines(plot_desired_trajectory(bare).get_axes()[0])) == {"hand", "desired, 90 % band"}
    figure = plot_impedance(bare, verdicts)
    for ax in figure.get_axes():
        assert set(lines(ax)) == {"posterior, 90 % band"}
    assert figure.get_axes()[-1].get_xlabel() == "time [s]"
    # Nothing was learned, so every panel says so.
    assert all("prior only (contraction 0.00)" in ax.get_title() for ax in figure.get_axes())


def test_four_trials_at_most(tiny):
    many = tiny.fitted.fitted.log
    log = type(many)(many.axes, many.trials * 3)
    posterior = ImpedanceModel(tiny.config).posterior(log, "training")
    assert len(plot_force(posterior).get_axes()) == 2 * 4
    assert len(plot_force(posterior, [0, 5]).get_axes()) == 2 * 2


def test_equilibrium_of_a_single_recording_is_prior_only(tiny):
    """From one recording without a reference, a stiff arm and a soft one that aims far ahead look alike."""
    config = load_config(
        "time",
        [
            "preprocessing.smoother.window=0.14",
            "preprocessing.rate=20",
            "training.restarts=1",
            "training.max_iterations=10",
        ],
    )
    model = ImpedanceModel(config).fit(read_log(tiny.other, config.log))
    posterior = model.posterior(model.fitted.log)
    figure = plot_impedance(posterior, model.verdicts(posterior))
    titles = [ax.get_title() for ax in figure.get_axes()]
    assert [title.split(" (")[0] for title in titles[:4]] == [
        "stiffness xx: prior only",
        "stiffness yy: prior only",
        "damping xx: prior only",
        "damping yy: prior only",
    ]


@pytest.mark.parametrize(("width", "latent"), [(0.3, Latent.STIFFNESS), (None, Latent.MASS)])
def test_plan(width, latent):
    """Two axes, two perturbations, three numbers of repetitions, each with another verdict."""
    supports = dict(zip((2, 4, 8), (Support.PRIOR_ONLY, Support.WEAK, Support.SUPPORTED), strict=True))
    plan = Plan(
        tuple(
            Expectation(latent, axis, count, force, (1.0 + a) / count / force, 0.5, support)
            for a, axis in enumerate("xy")
            for force in (1.0, 5.0)
            for count, support in supports.items()
        ),
        "N",
    )
    figure = plot_plan(plan, width, latent)
    assert figure.get_suptitle() == f"Expected intervals of {latent.value}, by perturbation"
    (grid,) = panels(figure, rows=1, columns=2)
    for a, ax in enumerate(grid):
        assert ax.get_title() == f"{latent.value} {'xy'[a] * 2}"
        assert ax.get_xlabel() == "repetitions"
        assert [text.get_text() for text in ax.get_xticklabels()] == ["2", "4", "8"]
        found = lines(ax)
        for force in (1.0, 5.0):
            expected = [(2, 4, 8), [(1.0 + a) / count / force for count in (2, 4, 8)]]
            np.testing.assert_allclose(found[f"{force:g} N"], expected)
        for count, support in supports.items():
            marked = [
                line
                for line in ax.get_lines()
                if line.get_marker() == MARKERS[support] and list(line.get_xdata()) == [count]
            ]
            assert [line.get_ydata()[0] for line in marked] == [
                (1.0 + a) / count / force for force in (1.0, 5.0)
            ]
        assert ("wanted" in found) == (width is not None)
        if width is not None:
            assert set(found["wanted"][1]) == {width}
    assert grid[0].get_ylabel() == "width of the 90 % interval / median"


def test_saved_figures(posterior, verdicts, tmp_path):
    paths = save_figures(posterior, verdicts, tmp_path, trials=[1])
    assert [path.name for path in paths] == [
        "force.png",
        "desired_trajectory.png",
        "impedance.png",
        "ellipses.png",
    ]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    for path in paths:
        assert path.read_bytes().startswith(PNG)


def test_figures_that_cannot_be_written(posterior, verdicts, tmp_path, full_disk):
    with pytest.raises(OutputError, match="expected an existing folder"):
        save_figures(posterior, verdicts, tmp_path / "missing")
    with pytest.raises(OutputError, match=r"force\.png: could not be written: File too large"), full_disk():
        save_figures(posterior, verdicts, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_no_window_is_opened(posterior, verdicts):
    """The functions never touch pyplot, whose figures would pile up."""
    pyplot = pytest.importorskip("matplotlib.pyplot")
    before = pyplot.get_fignums()
    plot_force(posterior)
    plot_impedance(posterior, verdicts)
    assert pyplot.get_fignums() == before
