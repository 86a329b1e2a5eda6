"""Figures of a calibration show its ranks, each quantity in a panel of its own."""

import numpy as np
import pytest

from bayes_impedance.calibration.records import Record
from bayes_impedance.calibration.run import Calibration
from bayes_impedance.plotting.calibration import (
    plot_ecdf_differences,
    plot_rank_histograms,
    save_calibration_figures,
)

NAMES = ("log stiffness x, phase 0.25", "log mass x", "noise sd x", "noise sd y", "log damping x")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    generator = np.random.default_rng(0)
    records = []
    for i in range(100):
        z = generator.standard_normal(len(NAMES)) + np.array([0.0, 1.0, 0.0, 0.0, 0.0])
        rank = np.clip(np.floor((0.5 + z / 6.0) * 100), 0, 99).astype(int)
        rank[0] = i
        records.append(
            Record(i, dict.fromkeys(NAMES, 0.0), dict(zip(NAMES, rank.tolist(), strict=True)),
                   dict(zip(NAMES, z.tolist(), strict=True)))
        )  # fmt: skip
    return Calibration("nuts", 99, tuple(records))


def visible(figure):
    return [ax for ax in figure.axes if ax.get_visible()]


def test_histograms(calibration) -> None:
    panels = visible(plot_rank_histograms(calibration))
    assert [ax.get_title().splitlines()[0] for ax in panels] == list(NAMES)
    (stairs,) = [patch for patch in panels[0].patches if hasattr(patch, "get_data")]
    assert stairs.get_data().values.tolist() == [5] * 20
    assert "p = 1" in panels[0].get_title()


def test_ecdf_differences(calibration) -> None:
    panels = visible(plot_ecdf_differences(calibration))
    assert len(panels) == len(NAMES)
    line = panels[0].lines[0].get_xydata()
    assert line[:, 0].tolist() == pytest.approx(np.linspace(0, 1, 101))
    assert np.abs(line[:, 1]).max() < 1e-12
    # What is biased low leaves its band, and its title is coloured.
    assert panels[1].title.get_color() != panels[0].title.get_color()
    assert panels[1].lines[0].get_ydata().min() < -0.2


def test_files(calibration, tmp_path) -> None:
    paths = save_calibration_figures(calibration, tmp_path)
    assert [path.name for path in paths] == ["rank_histograms.png", "ecdf_differences.png"]
    assert all(path.stat().st_size > 5000 for path in paths)
