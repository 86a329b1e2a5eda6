"""Generated configurations and recordings through the commands; `make faults` does the same with five thousand."""

import json
from pathlib import Path

from hypothesis import HealthCheck, Phase, given, settings

from bayes_impedance.config import load_config
from bayes_impedance.errors import ConfigurationError
from bayes_impedance.features import FeatureMap
from bayes_impedance.priors import build_force_model
from benchmarks.generated_inputs import Case, follow
from tests.strategies import cases, configuration_files

COMMITTED = json.loads(
    (Path(__file__).resolve().parent.parent / "results" / "faults.json").read_text(encoding="utf-8")
)

#: The same examples every time, and no shrinking: each takes a tenth of a second.
QUICK = {
    "database": None,
    "deadline": None,
    "derandomize": True,
    "phases": [Phase.generate],
    "suppress_health_check": list(HealthCheck),
}


@settings(max_examples=150, **QUICK)
@given(cases())
def test_commands_end_well_or_in_one_sentence(case: Case) -> None:
    follow(case)


@settings(max_examples=150, **QUICK)
@given(configuration_files(spoilt=False))
def test_plausible_configurations_make_a_model_or_are_refused(tmp_path_factory, content: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "plausible.yaml"
    path.write_bytes(content)
    try:
        config = load_config(path)
    except ConfigurationError:
        return
    for axes in (("x",), ("x", "y", "z")):
        model = build_force_model(config, FeatureMap(config, axes))
        for entry in model.entries:
            assert entry.raw.isfinite().all(), entry.name


def test_five_thousand_inputs_gave_no_traceback() -> None:
    assert COMMITTED["command"] == "make faults"
    assert COMMITTED["generated"] >= 5000
    assert COMMITTED["tracebacks"] == 0
    accepted, refused = (COMMITTED["commands"][f"train {ending}"] for ending in ("accepted", "refused"))
    assert accepted + refused == COMMITTED["generated"]
    assert min(accepted, refused) > 500
