"""Ellipses and couplings: the right matrices in the right places, at the scale that is written beside them."""

from dataclasses import replace

import numpy as np
import pytest

from bayes_impedance.errors import LogError
from bayes_impedance.identifiability import Support, Verdict
from bayes_impedance.impedance_functions.log_matrix import LogMatrix
from bayes_impedance.impedance_functions.symmetric import entries
from bayes_impedance.kernels.impedance import IMPEDANCE_ORDER, Latent
from bayes_impedance.plotting import plot_ellipses, plot_impedance, save_figures
from bayes_impedance.plotting.ellipses import ANGLES, ellipse_radii, evenly_spaced
from bayes_impedance.posterior import Marginal, Posterior, draw_matrices

LEVELS = (150.0, 12.0, 1.5)


def verdict(latent, axis, support=Support.SUPPORTED, contraction=0.9) -> Verdict:
    return Verdict(latent, axis, 1.0, 0.5, 2.0, 0.1, 10.0, contraction, support, "")


def verdicts(axes: str) -> list[Verdict]:
    return [verdict(latent, axis) for latent in IMPEDANCE_ORDER for axis in axes]


def law_of(level: float, axes: int, samples: int, spread: float = 0.1) -> LogMatrix:
    """Coupled matrices that turn and grow along the samples."""
    places = entries(axes, coupled=True)
    along = np.linspace(0.0, 1.0, samples)[:, None]
    centre = np.concatenate([np.full(axes, np.log(level)), np.zeros(len(places) - axes)])
    location = centre + along * np.linspace(0.1, 0.4, len(places))
    covariance = np.tile(spread**2 * np.eye(len(places)), (samples, 1, 1))
    return LogMatrix(places, location, covariance, np.tile(centre, (samples, 1)), 9.0 * covariance)


def coupled(log, axes: str, truth: bool = True) -> Posterior:
    """A posterior with coupled matrices at the first trial of a log, whose truth is the median at each sample."""
    trial = log.trials[0]
    time = trial.time - trial.time[0]
    position = np.stack([0.1 * np.sin(time * (a + 1)) for a in range(len(axes))], axis=1)
    laws = {
        latent: law_of(level, len(axes), len(time))
        for latent, level in zip(IMPEDANCE_ORDER, LEVELS, strict=True)
    }
    known = {
        f"{latent.value}_{axes[a]}{axes[b]}": law.matrix()[:, a, b]
        for latent, law in laws.items()
        for a, b in law.places
    }
    own = replace(
        trial, position=position, velocity=position, acceleration=position, force=None, perturbation=None,
        reference=None, truth=known if truth else {},
    )  # fmt: skip
    diagonal = {
        latent: Marginal(latent, True, *law.diagonal(), *law.diagonal(prior=True))
        for latent, law in laws.items()
    }
    beside = {
        latent: Marginal(latent, False, *law.beside(), *law.beside(prior=True))
        for latent, law in laws.items()
    }
    return Posterior(replace(log, axes=tuple(axes), trials=(own,)), diagonal, beside, laws)


@pytest.fixture(scope="module")
def log(tiny):
    return tiny.fitted.fitted.log


@pytest.fixture(scope="module")
def planar(log):
    return coupled(log, "xy")


def test_radii_are_those_of_the_image_of_the_unit_circle():
    generator = np.random.default_rng(0)
    roots = generator.standard_normal((20, 2, 2))
    matrices = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(2)
    for matrix, radii in zip(matrices, ellipse_radii(matrices), strict=True):
        for angle, radius in zip(ANGLES, radii, strict=True):
            point = radius * np.array([np.cos(angle), np.sin(angle)])
            # What W makes of the circle is what W⁻¹ puts back onto it.
            assert np.linalg.norm(np.linalg.solve(matrix, point)) == pytest.approx(1.0, rel=1e-9)


def test_places_are_evenly_spaced_and_differ():
    phase = np.array([0.9, 0.1, 0.3, 0.5, 0.7, 0.31])
    assert evenly_spaced(phase, 2).tolist() == [2, 4]
    assert sorted(evenly_spaced(phase, 50).tolist()) == [0, 1, 2, 3, 4, 5]


def test_ellipses_stand_on_the_path_at_the_scale_of_the_bar(planar):
    figure = plot_ellipses(planar, verdicts("xy"), count=4, draws=300, seed=1)
    (trial,) = planar.log.trials
    places = evenly_spaced(trial.phase, 4)
    drawn = draw_matrices(planar, 300, 1)[:, places]
    panels = figure.get_axes()
    assert len(panels) == 3
    for (latent, order), ax, unit in zip(IMPEDANCE_ORDER.items(), panels, ("N/m", "Ns/m", "kg"), strict=True):
        assert ax.get_title() == f"{latent.value}: supported by these data (contraction ≥ 0.90)"
        assert (ax.get_xlabel(), ax.get_aspect()) == ("x [m]", 1.0)
        found = ax.get_lines()
        labels = [line.get_label() for line in found]
        np.testing.assert_array_equal(found[0].get_xydata(), trial.position)
        assert {"hand", "posterior, 90 % band", "truth"} <= set(labels)
        number, _, written = ax.texts[0].get_text().partition(" ")
        assert written == unit
        bar = found[-1].get_xdata()
        scale = (bar[1] - bar[0]) / float(number)
        outlines = [line for line in found if len(line.get_xdata()) == len(ANGLES)]
        solid = [line for line in outlines if line.get_linestyle() == "-"]
        dashed = [line for line in outlines if line.get_linestyle() == "--"]
        assert len(solid) == len(dashed) == 4
        median = np.median(drawn[:, :, order], axis=0)
        for k, place in enumerate(places):
            names = [f"{latent.value}_{entry}" for entry in ("xx", "xy", "xy", "yy")]
            truth = np.array([trial.truth[name][place] for name in names]).reshape(2, 2)
            for line, matrix in ((solid[k], median[k]), (dashed[k], truth)):
                offsets = (line.get_xydata() - trial.position[place]) / scale
                # W⁻¹ brings every force back onto the unit circle.
                back = np.linalg.norm(np.linalg.solve(matrix, offsets.T), axis=0)
                np.testing.assert_allclose(back, 1.0, rtol=1e-9)
            edge = np.linalg.norm((ax.patches[k].get_xy() - trial.position[place]) / scale, axis=1)
            outer = edge[: len(ANGLES)]
            low, high = np.quantile(ellipse_radii(drawn[:, k, order]), (0.05, 0.95), axis=0)
            np.testing.assert_allclose(outer, high, rtol=1e-9)
            np.testing.assert_allclose(edge[len(ANGLES) : 2 * len(ANGLES)], low[::-1], rtol=1e-9)
        # The prior lies below the path.
        assert ax.patches[4].get_label() == "prior, median"
        assert ax.patches[4].get_xy()[:, 1].max() < trial.position[:, 1].min()


def test_verdicts_that_differ_are_both_told(planar):
    said = [v for v in verdicts("xy") if (v.latent.value, v.axis) != ("stiffness", "y")]
    said.append(verdict(next(iter(IMPEDANCE_ORDER)), "y", Support.WEAK, 0.4))
    title = plot_ellipses(planar, said, count=2, draws=20).get_axes()[0].get_title()
    assert title == ("stiffness: xx supported by these data,\nyy weakly supported (contraction ≥ 0.40)")


def test_ellipses_need_a_verdict_for_every_panel(planar):
    with pytest.raises(KeyError):
        plot_ellipses(planar, verdicts("xy")[:-1], draws=20)


def test_axes_may_be_independent_and_truth_unknown(tiny):
    """Upright ellipses by a model of moments; a log that has no truth beside the diagonal shows none."""
    posterior = tiny.fitted.posterior(tiny.fitted.fitted.log)
    figure = plot_ellipses(posterior, tiny.fitted.verdicts(posterior), count=3, draws=50)
    for ax in figure.get_axes():
        assert "truth" not in [line.get_label() for line in ax.get_lines()]
        outline = next(line for line in ax.get_lines() if line.get_label() == "posterior, 90 % band")
        offsets = outline.get_xydata() - outline.get_xydata()[:-1].mean(axis=0)
        # Mirrored in both of its axes.
        np.testing.assert_allclose(offsets[1:61, 1], -offsets[-2:59:-1, 1], atol=1e-12)


def test_three_axes_have_three_planes(log):
    posterior = coupled(log, "xyz")
    figure = plot_ellipses(posterior, verdicts("xyz"), count=2, draws=20)
    assert len(figure.get_axes()) == 9
    assert [ax.get_xlabel()[0] + ax.get_ylabel()[:1] for ax in figure.get_axes()[::3]] == ["xy", "xz", "yz"]
    (position,) = [trial.position for trial in posterior.log.trials]
    chosen = plot_ellipses(posterior, verdicts("xyz"), planes=["yz"], count=2, draws=20).get_axes()
    assert len(chosen) == 3
    np.testing.assert_array_equal(chosen[0].get_lines()[0].get_xydata(), position[:, 1:])


def test_planes_that_there_are_not(planar, log):
    with pytest.raises(LogError, match="expected a log of two or three axes for ellipses, found one, y"):
        plot_ellipses(coupled(log, "y"), verdicts("y"))
    with pytest.raises(LogError, match="expected some of xy, the planes of this log's axes, got 'yx'"):
        plot_ellipses(planar, verdicts("xy"), planes=["yx"])


def test_impedance_shows_what_couples_the_axes(planar):
    figure = plot_impedance(planar, verdicts("xy"))
    panels = figure.get_axes()
    assert len(panels) == 9
    (trial,) = planar.log.trials
    order = np.argsort(trial.phase)
    for row, latent in enumerate(IMPEDANCE_ORDER):
        ax, marginal = panels[3 * row + 2], planar.couplings[latent]
        contraction = marginal.contraction[0]
        assert ax.get_title() == f"{latent.value} xy (contraction {contraction:.2f})"
        assert ax.get_yscale() == "linear"
        found = {line.get_label(): line.get_ydata() for line in ax.get_lines()}
        np.testing.assert_array_equal(found["truth"], trial.truth[f"{latent.value}_xy"][order])
        np.testing.assert_array_equal(found["posterior, 90 % band"], marginal.quantile(0.5)[order, 0])
        path = ax.collections[0].get_paths()[0].vertices[:, 1]
        assert path.min() == pytest.approx(marginal.prior_quantile(0.05).min())
        assert path.max() == pytest.approx(marginal.prior_quantile(0.95).max())
        # The diagonal shares its scale.
        assert panels[3 * row].get_ylim() == panels[3 * row + 1].get_ylim()


def test_one_axis_has_no_file_of_ellipses(log, tmp_path):
    posterior = coupled(log, "x")
    alone = replace(posterior, couplings={})
    for latent in (Latent.FORCE, Latent.DESIRED_POSITION):
        values = np.zeros((len(alone.log.trials[0].time), 1))
        alone.marginals[latent] = Marginal(latent, False, values, values + 1.0, values, values + 1.0)
    paths = save_figures(alone, verdicts("x"), tmp_path)
    assert [path.name for path in paths] == ["force.png", "desired_trajectory.png", "impedance.png"]
