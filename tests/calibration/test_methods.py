"""Every method of sampling gives draws that truths can be ranked among."""

import pytest
from tiny import configuration

from bayes_impedance.calibration.draw import Settings, Trials
from bayes_impedance.simulation.generative import repeated_motion


@pytest.mark.parametrize("method", ["nuts", "svi", "laplace"])
def test_methods_give_draws_to_rank_among(method: str) -> None:
    sampling = {"method": method, "chains": 1, "draws": 60, "warmup": 40, "steps": 60}
    settings = Settings(
        configuration(sampling), repeated_motion(2, 3.0, 2.0, axes=("x",)), seed=2, thinned=19
    )
    record = Trials(settings)(0)
    assert record.failure is None
    assert all(0 <= rank <= 19 for rank in record.rank.values())
    # The truth is one of the prior, and the posterior has it.
    assert all(abs(z) < 5.0 for z in record.z.values())
    if method == "nuts":
        assert Trials(settings)(0) == record
