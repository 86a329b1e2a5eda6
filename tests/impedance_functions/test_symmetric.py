"""Matrices by their logarithm, against scipy, autograd and finite differences."""

import numpy as np
import pytest
import torch
from scipy.linalg import expm

from bayes_impedance.impedance_functions.symmetric import assemble, derivatives, entries, exponential

AXES = [(axes, coupled) for axes in (1, 2, 3) for coupled in (False, True)]


def drawn(axes, coupled, shape=(4, 3)):
    places = entries(axes, coupled)
    generator = torch.Generator().manual_seed(axes)
    return places, torch.randn(*shape, len(places), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(("axes", "coupled"), AXES)
def test_places_are_each_entry_once_and_the_diagonal_first(axes, coupled):
    places = entries(axes, coupled)
    assert places[:axes] == tuple((a, a) for a in range(axes))
    assert len(set(places)) == len(places) == (axes * (axes + 1) // 2 if coupled else axes)
    assert all(a <= b < axes for a, b in places)


@pytest.mark.parametrize(("axes", "coupled"), AXES)
def test_exponential_is_scipys_and_positive_definite(axes, coupled):
    places, values = drawn(axes, coupled)
    found = exponential(values, places, axes)
    assert found.shape == (4, 3, axes, axes)
    for index in np.ndindex(4, 3):
        logarithm = np.zeros((axes, axes))
        for (a, b), value in zip(places, values[index].tolist(), strict=True):
            logarithm[a, b] = logarithm[b, a] = value
        np.testing.assert_array_equal(assemble(values, places, axes)[index], logarithm)
        np.testing.assert_allclose(found[index], expm(logarithm), rtol=1e-12, atol=1e-13)
        assert (np.linalg.eigvalsh(found[index]) > 0).all()


@pytest.mark.parametrize("axes", [2, 3])
def test_without_coupling_it_is_that_of_independent_axes(axes):
    places, values = drawn(axes, False)
    every = entries(axes, True)
    padded = torch.cat([values, values.new_zeros(4, 3, len(every) - axes)], dim=-1)
    torch.testing.assert_close(
        exponential(padded, every, axes), exponential(values, places, axes), rtol=1e-14, atol=1e-14
    )


@pytest.mark.parametrize(("axes", "coupled"), AXES)
def test_derivatives_are_autograds(axes, coupled):
    places, values = drawn(axes, coupled, (2,))
    jacobian = torch.autograd.functional.jacobian(lambda v: exponential(v, places, axes), values)
    found = derivatives(values, places, axes)
    for n in range(2):
        expected = jacobian[n, :, :, n].movedim(-1, 0)
        torch.testing.assert_close(found[n], expected, rtol=1e-11, atol=1e-12)


def test_derivatives_are_finite_differences():
    places, values = drawn(3, True, (2,))
    for e in range(len(places)):
        step = torch.zeros(len(places), dtype=torch.float64)
        step[e] = 1e-5
        difference = (exponential(values + step, places, 3) - exponential(values - step, places, 3)) / 2e-5
        # Errors of the difference: step² / 6 times a third derivative of the size of the matrix.
        torch.testing.assert_close(derivatives(values, places, 3)[:, e], difference, rtol=1e-7, atol=1e-7)
