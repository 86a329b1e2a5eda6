"""Configuration: what ships, what is refused and in which words, and that nothing else ever escapes."""

import re
from collections.abc import Callable

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import configurations, keys, names, sections, yamlish

from bayes_impedance.config import (
    Config,
    DeviceConfig,
    Hyperparameter,
    dump_config,
    load_config,
    parse_config,
    replace_value,
    shipped_configurations,
)
from bayes_impedance.errors import ConfigurationError

SHIPPED = shipped_configurations()


#: Keys that time.yaml does not show: they act only with another kernel, mean, prior or input.
def stated(content: dict, known: set[str], prefix: str = "") -> set[str]:
    """Keys of `known` that stand in `content`."""
    found = set()
    for name, value in content.items():
        if prefix + name in known:
            found.add(prefix + name)
        elif isinstance(value, dict):
            found |= stated(value, known, f"{prefix}{name}.")
    return found


def refusal(*overrides: str, content: object = None) -> str:
    """The sentence in which a configuration is refused."""
    with pytest.raises(ConfigurationError) as caught:
        parse_config({} if content is None else content, "c.yaml", overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- what ships ----------------------------------------------------------------------------------


def test_shipped_configurations_are_these():
    assert set(SHIPPED) == {
        "time",
        "phase",
        "admittance",
        "arm",
        "coupled",
        "position",
        "position_velocity",
        "recordings/delta_robot",
        "recordings/gp_mpc",
        "recordings/panda_comanipulation",
        "recordings/iiwa_known_equilibrium",
    }


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configuration_loads_by_name_and_by_path(name):
    assert load_config(name) == load_config(SHIPPED[name]) == load_config(f"{name}.yaml")
    assert load_config(name) != Config()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configuration_says_what_it_is_for(name):
    text = SHIPPED[name].read_text(encoding="utf-8")
    head = re.match(r"(#.*\n)+", text)
    assert head is not None
    assert len(head[0].splitlines()) >= 4


def test_every_scale_in_time_yaml_says_its_unit():
    scales = [
        line
        for line in SHIPPED["time"].read_text(encoding="utf-8").splitlines()
        if re.match(r"\s+(level|sd|noise_sd|offset_sd|rate|max_gap|window|smoother): ", line)
    ]
    assert len(scales) >= 12
    for line in scales:
        assert re.search(r"#.*\[(m|s|N|kg|Hz|N/m|Ns/m)\]", line), line


def test_time_yaml_holds_every_key_of_the_schema():
    known = keys(Config)
    content = yaml.safe_load(SHIPPED["time"].read_text(encoding="utf-8"))
    assert known - stated(content, known) == set()


def test_admittance_yaml_holds_every_key_of_a_device():
    content = yaml.safe_load(SHIPPED["admittance"].read_text(encoding="utf-8"))
    assert set(content["device"]) == set(DeviceConfig.model_fields)


def test_time_yaml_holds_the_defaults_except_for_the_rate():
    """As the header of the file claims; the scales of a log_gp are implicit by default."""
    default, shipped = Config(), load_config("time")
    assert (default.preprocessing.rate, shipped.preprocessing.rate) == (None, 50)
    for name in ("stiffness", "damping"):
        assert getattr(shipped.model, name).scale == getattr(default.model, name).scale
    implicit = ["preprocessing.rate=null", "model.stiffness.log_sd=null", "model.damping.log_sd=null"]
    assert load_config("time", implicit) == default


def test_unknown_name_lists_or_suggests_the_shipped_ones(tmp_path):
    with pytest.raises(ConfigurationError, match=r"found neither at 'phse'; did you mean 'phase'\?"):
        load_config("phse")
    with pytest.raises(
        ConfigurationError,
        match="shipped are admittance, arm, coupled, phase, position, position_velocity, rec.*, time",
    ):
        load_config(tmp_path / "nothing" / "like" / "it.json")


def test_a_file_extends_another(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("extends: phase\npreprocessing: {rate: 10}\n")
    assert load_config(own) == load_config("phase", ["preprocessing.rate=10"])
    other = tmp_path / "folder" / "other.yaml"
    other.parent.mkdir()
    other.write_text("extends: ../own.yaml\nlog: {axes: [x]}\n")
    assert load_config(other, ["training.seed=3"]) == load_config(
        "phase", ["preprocessing.rate=10", "log.axes=[x]", "training.seed=3"]
    )


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("extends: own", "found neither at 'own'"),
        ("extends: own.yaml", "expected a chain of extends that ends, got one that comes back to this file"),
        ("extends: [phase]", r"extends: expected the name of one configuration, got \['phase'\]"),
        ("extends: phase\nlog: {axis: [x]}", "unknown key 'log.axis'; did you mean 'axes'"),
    ],
)
def test_an_extension_that_makes_no_sense_is_refused(tmp_path, content, expected):
    path = tmp_path / "own.yaml"
    path.write_text(content)
    with pytest.raises(ConfigurationError, match=expected):
        load_config(path)


def test_file_of_ones_own(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text("training: {restarts: 7}\n")
    assert load_config(path).training.restarts == 7
    path.write_text("")
    assert load_config(path) == Config()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"a: [1", r"own\.yaml: expected YAML, got: while parsing"),
        (b"\xff\xfe\x00", r"own\.yaml: expected a readable UTF-8 YAML file, got: 'utf-8' codec"),
        (b"a: 2020-13-01", r"own\.yaml: expected YAML, got: month must be in 1\.\.12"),
        (b"- 1\n- 2\n", r"own\.yaml: expected a mapping of sections, got list"),
        (b"5", r"own\.yaml: expected a mapping of sections, got int"),
        (b"a: &b [*b]", r"own\.yaml: unknown key 'a'"),
        (b"[" * 5000, r"own\.yaml: expected YAML"),
    ],
)
def test_file_that_is_no_configuration(tmp_path, content, expected):
    path = tmp_path / "own.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=expected) as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_folder_is_no_configuration(tmp_path):
    with pytest.raises(ConfigurationError, match="expected a YAML file or the name of a shipped"):
        load_config(tmp_path)


# --- unknown keys --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "key", "nearest"),
    [
        ("modle.noise_sd=1", "modle", "model"),
        ("training.restart=1", "training.restart", "restarts"),
        ("model.stifness.level=1", "model.stifness", "stiffness"),
        ("model.stiffness.length_scale.fase=1", "model.stiffness.length_scale.fase", "phase"),
        ("model.noise_sd.medain=1", "model.noise_sd.medain", "median"),
        ("model.residual.offset=1", "model.residual.offset", "offset_sd"),
        ("preprocessing.smoother.windw=1", "preprocessing.smoother.windw", "window"),
        ("log.columns.positon=p_{axis}", "log.columns.positon", "position"),
    ],
)
def test_unknown_key_names_the_nearest(override, key, nearest):
    expected = f"--set {override}: unknown key '{key}'; did you mean {nearest!r}?"
    assert refusal(override) == expected


def test_unknown_key_without_a_near_one_lists_all():
    assert refusal("shared.qqq=1").endswith("known here: desired_trajectory, residual.")


def test_misspelt_required_key_is_named_rather_than_the_missing_one():
    message = refusal(content={"model": {"noise_sd": {"meadian": 1.0}}})
    assert message == "c.yaml: unknown key 'model.noise_sd.meadian'; did you mean 'median'?"
    assert refusal(content={"model": {"noise_sd": {}}}) == "c.yaml: missing key 'model.noise_sd.median'"


# --- overrides -----------------------------------------------------------------------------------


def test_overrides_apply_in_order_on_top_of_the_file():
    config = load_config("phase", ["training.restarts=5", "training.restarts=6", "model.mass.level.median=2"])
    assert config.training.restarts == 6
    assert config.model.mass.level == Hyperparameter(median=2, log_sd=0.7)
    assert config.model.trajectory_input == "phase"


def test_overrides_reach_into_null_sections():
    config = parse_config(
        {"preprocessing": {"smoother": None}},
        overrides=["preprocessing.smoother.window=0.2", "model.residual.offset_sd.median=2"],
    )
    assert config.preprocessing.smoother is not None
    assert config.preprocessing.smoother.window == 0.2
    assert config.model.residual is not None
    assert config.model.residual.offset_sd == Hyperparameter(median=2)


def test_a_value_is_replaced_and_nothing_else():
    config = load_config("time")
    changed = replace_value(config, "model.noise_sd", {"median": 0.7, "log_sd": 0.4})
    assert changed.model.noise_sd == Hyperparameter(median=0.7, log_sd=0.4)
    assert replace_value(changed, "model.noise_sd", config.model.noise_sd.model_dump()) == config
    with pytest.raises(ConfigurationError, match=r"unknown key 'model\.noise'; did you mean 'noise_sd'"):
        replace_value(config, "model.noise", 0.7)
    with pytest.raises(ConfigurationError, match=r"^model\.stiffness\.log_sd: .*expected at most 0\.5"):
        replace_value(config, "model.stiffness.log_sd", 0.7)


def test_overrides_that_need_each_other_are_judged_together():
    config = parse_config({}, overrides=["model.stiffness.prior=gp", "model.stiffness.sd=50"])
    assert config.model.stiffness.scale == Hyperparameter(median=50, fixed=True)
    back = ["model.trajectory_input=time", "model.desired_trajectory.mean=equilibrium"]
    assert load_config("phase", back).model.trajectory_input == "time"
    assert load_config("phase", back[::-1]) == load_config("phase", back)


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("log.axes=[x, z]", ("x", "z")),
        ("log.axes=null", None),
        ("log.columns.trial=null", None),
        ("log.delimiter='|'", "|"),
        ("log.window.start=-1", -1.0),
        ("log.columns.force='F{axis}'", "F{axis}"),
        ("log.columns.force=F{axis}", "F{axis}"),
        ("preprocessing.rate=1e2", 100.0),
        (" training.seed =4", 4),
        ("model.residual=null", None),
        ("model.desired_trajectory.value={x: 0.1}", {"x": 0.1}),
    ],
)
def test_override_values_are_yaml(override, value):
    found = parse_config({}, overrides=[override])
    for part in override.partition("=")[0].strip().split("."):
        found = getattr(found, part)
    assert found == value


@pytest.mark.parametrize("override", ["", "=", "=1", "training.restarts", "a..b=1", ".a=1", "a.=1", " =2"])
def test_override_of_a_wrong_form(override):
    message = refusal(override)
    assert message == f"--set: expected KEY=VALUE such as training.restarts=5, got {override!r}"


def test_override_that_is_no_yaml():
    assert refusal("log.axes=[x") == "--set log.axes: expected a YAML value, got '[x'"


# --- values --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("training.restarts=0", r"training\.restarts: .*greater than or equal to 1\), got 0"),
        ("training.restarts=101", r"less than or equal to 100\), got 101"),
        ("training.restarts=1.5", r"a number with a fractional part\), got 1\.5"),
        ("training.seed=-1", r"greater than or equal to 0\), got -1"),
        ("engine.jitter=0.1", r"less than or equal to 0\.001\), got 0\.1"),
        ("engine.max_samples=1", r"greater than or equal to 2\), got 1"),
        ("engine.name=kalman", r"got 'kalman'"),
        ("engine.name=markov", r"expected auto, dense or local with impedance: moments, got markov"),
        ("model.desired_trajectory.periodic=true", r"periodic: expected trajectory_input: phase with it"),
        ("preprocessing.rate=0", r"greater than 0\), got 0"),
        ("preprocessing.rate=.nan", r"finite number\), got nan"),
        ("preprocessing.max_gap=.inf", r"finite number\), got inf"),
        ("preprocessing.smoother.polynomial_order=2", r"greater than or equal to 3\), got 2"),
        ("preprocessing.smoother.polynomial_order=8", r"less than or equal to 7\), got 8"),
        ("model.noise_sd=0", r"model\.noise_sd\.median: .*greater than 0\), got 0"),
        ("model.noise_sd=-1", r"greater than 0\), got -1"),
        ("model.noise_sd=soft", r"expected a number or a mapping of keys to values, got 'soft'"),
        ("model.noise_sd=true", r"expected a number or a mapping of keys to values, got True"),
        ("model.noise_sd={median: 1, log_sd: 6}", r"less than or equal to 5\), got 6"),
        ("model=5", r"model: expected a mapping of keys to values, got 5"),
        ("log.axes=[]", r"log\.axes: expected a valid value .*got \[\]"),
        ("log.axes=[q]", r"log\.axes\.0: .*'x', 'y' or 'z'\), got 'q'"),
        ("log.axes=[x, x]", r"axes: expected each axis once, got \['x', 'x'\]"),
        ("log.delimiter=ab", r"log\.delimiter: .*at most 1 character\), got 'ab'"),
        ("log.columns.force=Fx", r"force: expected a column name with \{axis\} or \{index\} in it, got 'Fx'"),
        ("log.window={start: 2, end: 2}", r"expected start < end, got start 2 s and end 2 s"),
        ("log.units.force=lbf", r"log\.units\.force: .*got 'lbf'"),
        ("model.residual.input=[]", r"input: expected at least one of time, phase, position, velocity"),
        ("model.residual.input=[time, time]", r"input: expected each component once"),
        ("model.stiffness.input=[phase, phase]", r"input: expected each component once"),
        ("model.desired_trajectory.mean=middle", r"model\.desired_trajectory\.mean: .*got 'middle'"),
        ("model.desired_trajectory.value={q: 1}", r"'x', 'y' or 'z'\), got 'q'"),
        ("baseline.input=[]", r"baseline\.input: expected a valid value .*got \[\]"),
    ],
)
def test_value_out_of_range(override, expected):
    assert re.search(f"^{re.escape(f'--set {override}: ')}.*{expected}", refusal(override))


@pytest.mark.parametrize("text", ["2", "2.0", "2e0", "{median: 2, fixed: true}"])
def test_number_means_fixed(text):
    assert parse_config({}, overrides=[f"model.noise_sd={text}"]).model.noise_sd == Hyperparameter(
        median=2, fixed=True
    )


def test_mapping_means_learned():
    assert not parse_config({}, overrides=["model.noise_sd={median: 2}"]).model.noise_sd.fixed


@pytest.mark.parametrize("name", ["stiffness", "damping"])
def test_scale_of_gp_and_log_gp(name):
    wrong = refusal(f"model.{name}.sd=5")
    assert wrong.endswith("a log_gp takes its scale as log_sd, not sd: set log_sd, or prior: gp")
    wrong = refusal(f"model.{name}.prior=gp", f"model.{name}.log_sd=.2", f"model.{name}.sd=5")
    assert wrong.endswith("a gp takes its scale as sd, not log_sd: set sd, or prior: log_gp")
    assert refusal(f"model.{name}.prior=gp").endswith(
        "a gp needs its scale: set sd, in the unit of the quantity"
    )
    assert "expected at most 0.5" in refusal(f"model.{name}.log_sd=0.51")
    prior = getattr(parse_config({}, overrides=[f"model.{name}.log_sd=0.5"]).model, name)
    assert prior.scale == Hyperparameter(median=0.5, fixed=True)


@pytest.mark.parametrize("theta", ["time", "phase", "position"])
def test_drop_acceleration_needs_position_velocity(theta):
    message = refusal(f"model.trajectory_input={theta}", "model.drop_acceleration=true")
    assert f"expected trajectory_input: position_velocity with it, got {theta}" in message
    parse_config({}, overrides=["model.trajectory_input=position_velocity", "model.drop_acceleration=true"])


@pytest.mark.parametrize("theta", ["time", "position", "position_velocity"])
def test_trial_average_needs_phase(theta):
    message = refusal(f"model.trajectory_input={theta}", "model.desired_trajectory.mean=trial_average")
    assert f"so it needs trajectory_input: phase, got {theta}" in message


def test_configurations_do_not_change():
    with pytest.raises(ValueError, match="frozen"):
        Config().training = None  # type: ignore[assignment,misc]


@pytest.mark.parametrize(
    ("quantity", "unit", "factor"),
    [
        ("time", "us", 1e-6),
        ("position", "mm", 1e-3),
        ("velocity", "cm/s", 1e-2),
        ("acceleration", "mm/s^2", 1e-3),
        ("force", "kN", 1e3),
        ("force", "mN", 1e-3),
    ],
)
def test_units(quantity, unit, factor):
    config = parse_config({"log": {"units": {quantity: unit}}})
    assert config.log.units.scale(quantity) == factor
    assert Config().log.units.scale(quantity) == 1.0


# --- round trip ----------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(configurations())
def test_dump_and_parse_give_the_same_configuration(content):
    config = parse_config(content)
    text = dump_config(config)
    assert parse_config(yaml.safe_load(text)) == config
    assert dump_config(parse_config(yaml.safe_load(text))) == text


# --- never anything but ConfigurationError -------------------------------------------------------


def problem(read: Callable[[], Config]) -> str | None:
    """The sentence of the refusal; None where the configuration is read, and comes back from its own dump."""
    try:
        config = read()
    except ConfigurationError as error:
        return str(error)
    assert parse_config(yaml.safe_load(dump_config(config))) == config
    return None


@settings(max_examples=150, deadline=None)
@given(st.one_of(yamlish, sections()))
def test_any_content_is_a_configuration_or_refused(content):
    said = problem(lambda: parse_config(content, "here"))
    assert said is None or re.fullmatch("here: .+", said)


@settings(max_examples=150, deadline=None)
@given(
    st.one_of(
        st.text(max_size=20),
        st.builds("{}={}".format, st.sampled_from(sorted(keys(Config))), st.text(max_size=10)),
        st.builds("{}.{}={}".format, st.sampled_from(sorted(keys(Config))), names, st.text(max_size=6)),
    )
)
def test_any_override_is_applied_or_refused(override):
    said = problem(lambda: parse_config({}, overrides=[override]))
    assert said is None or said.startswith("--set")


@settings(max_examples=100, deadline=None)
@given(st.one_of(st.binary(max_size=40), yamlish.map(lambda v: yaml.dump(v).encode("utf-8", "replace"))))
def test_any_file_is_a_configuration_or_refused(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(content)
    said = problem(lambda: load_config(path))
    assert said is None or said.startswith(f"{path}: ")
