"""Cells nearest to a sample against a search through all of them."""

import itertools

import numpy as np
import pytest

from bayes_impedance.engines.local.grid import BANDWIDTH, OUTSIDE, Grid, nearest, weights_of


def grid_of(p, cells=7, columns=None):
    generator = np.random.default_rng(p)
    return Grid(
        np.arange(p) if columns is None else np.array(columns),
        generator.normal(size=p),
        generator.uniform(0.1, 10.0, size=p),
        np.full(p, cells),
    )


def found(grid, x, active):
    codes, weights = np.full(active, 77), np.full(active, 77.0)
    inside = nearest(grid, np.ascontiguousarray(x), codes, weights)
    return inside, codes, weights


def squared_distances(grid, x):
    """Of every cell's centre from `x`, in cells; by code."""
    place = (x[grid.columns] - grid.lower) / grid.width
    centres = np.array(list(itertools.product(*(range(n) for n in grid.shape)))) + 0.5
    return ((centres - place) ** 2).sum(axis=1)


def inner(grid, generator):
    """A place with so many cells on every side that the border is no matter."""
    middle = grid.shape // 2
    return grid.lower + grid.width * (middle + generator.uniform(size=len(middle)))


@pytest.mark.parametrize("active", range(1, 10))
@pytest.mark.parametrize("p", range(1, 7))
def test_nearest_cells_of_all_there_are(p, active):
    grid = grid_of(p, cells=9 if p == 1 else 5 if p < 5 else 4 if p == 5 else 3)
    generator = np.random.default_rng(10 * p + active)
    for _ in range(60 if p < 6 else 25):
        x = inner(grid, generator)
        inside, codes, weights = found(grid, x, active)
        assert inside
        distances = squared_distances(grid, x)
        expected = np.sort(distances)[:active]
        assert len(set(codes.tolist())) == active
        assert distances[codes] == pytest.approx(expected, abs=1e-9)
        assert weights == pytest.approx(np.exp(-(expected - expected[0]) / (2.0 * BANDWIDTH**2)), rel=1e-9)


@pytest.mark.parametrize("p", range(1, 7))
def test_the_first_cell_is_the_one_that_holds_the_sample(p):
    grid = grid_of(p, cells=3)
    generator = np.random.default_rng(p)
    for _ in range(100):
        x = grid.lower + grid.width * grid.shape * generator.uniform(size=p)
        inside, codes, weights = found(grid, x, 3)
        place = np.floor((x - grid.lower) / grid.width).astype(int)
        assert inside
        assert codes[0] == np.ravel_multi_index(place, grid.shape)
        assert weights[0] == 1.0


@pytest.mark.parametrize("p", range(1, 5))
def test_at_a_border_the_cells_that_are_there(p):
    """In a corner, cells of the grid alone, nearest first, without a code twice or one from outside."""
    grid = grid_of(p, cells=2)
    x = grid.lower + 0.3 * grid.width
    inside, codes, weights = found(grid, x, 9)
    here = min(9, 2**p)
    assert inside
    assert (codes[here:] == OUTSIDE).all()
    assert (weights[here:] == 77.0).all()
    distances = squared_distances(grid, x)
    assert distances[codes[:here]] == pytest.approx(np.sort(distances)[:here], abs=1e-9)


def test_a_grid_of_one_cell():
    grid = Grid(np.array([2]), np.array([-1.0]), np.array([2.0]), np.array([1]))
    inside, codes, weights = found(grid, np.array([9.0, 9.0, 0.4]), 3)
    assert inside
    assert codes.tolist() == [0, OUTSIDE, OUTSIDE]
    assert weights[0] == 1.0
    assert grid.size == 1


@pytest.mark.parametrize("p", [1, 2, 4, 6])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, -1e300])
def test_what_is_no_place_is_outside(p, value):
    grid = grid_of(p, cells=3)
    for c in range(p):
        x = grid.lower + 1.5 * grid.width
        x[c] = value
        inside, codes, _ = found(grid, x, 3)
        assert not inside
        assert codes.tolist() == [77, 77, 77]


def test_the_lower_border_is_inside_and_the_upper_is_not():
    grid = Grid(np.array([0]), np.array([0.0]), np.array([0.25]), np.array([4]))
    assert found(grid, np.array([0.0]), 1)[1].tolist() == [0]
    assert found(grid, np.array([np.nextafter(1.0, 0.0)]), 1)[1].tolist() == [3]
    assert not found(grid, np.array([1.0]), 1)[0]
    assert not found(grid, np.array([np.nextafter(0.0, -1.0)]), 1)[0]


def test_columns_that_are_not_in_the_grid_do_not_matter():
    grid = grid_of(2, columns=(3, 1))
    x = np.full(5, np.nan)
    x[[3, 1]] = grid.lower + 2.2 * grid.width
    inside, codes, _ = found(grid, x, 4)
    assert inside
    assert codes[0] == 2 * 7 + 2


def test_many_at_once():
    grid = grid_of(3, cells=4)
    generator = np.random.default_rng(0)
    inputs = grid.lower + grid.width * generator.uniform(-1.0, 5.0, size=(200, 3))
    codes, weights = weights_of(grid, inputs, 5)
    outside = 0
    for x, own, weight in zip(inputs, codes, weights, strict=True):
        inside, expected, others = found(grid, x, 5)
        outside += not inside
        if inside:
            assert own.tolist() == expected.tolist()
            assert weight[own >= 0] == pytest.approx(others[own >= 0])
            assert (weight[own < 0] == 0.0).all()
        else:
            assert (own == OUTSIDE).all()
            assert (weight == 0.0).all()
    assert 0 < outside < 200


def test_codes_of_a_large_grid_are_exact():
    """Up to 2⁵³ cells a code has 64 bits."""
    grid = Grid(np.arange(2), np.zeros(2), np.ones(2), np.array([2**26, 2**27]))
    x = np.array([2.0**26 - 0.5, 2.0**27 - 0.5])
    assert found(grid, x, 1)[1].tolist() == [2**53 - 1]
    assert grid.size == 2**53
