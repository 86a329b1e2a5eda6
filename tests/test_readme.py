"""The README's code, commands, configurations and figures are true."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from bayes_impedance.config import parse_config, shipped_configurations
from bayes_impedance.demo import experiment
from bayes_impedance.simulation.experiment import simulate
from bayes_impedance.writer import write_log

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder like the one that `make demo` leaves, with a smaller experiment in it."""
    folder = tmp_path_factory.mktemp("readme")
    (folder / "demo").mkdir()
    log = simulate(experiment(trials=3, round_duration=2.0), seed=0)
    write_log(log.select([0, 1]), folder / "demo" / "training.csv")
    write_log(log.select([2]), folder / "demo" / "testing.csv")
    return folder


def run(code: str, place: Path) -> str:
    """What a block of Python prints."""
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=place, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_python_example_runs_and_prints_a_verdict(place: Path) -> None:
    code, _ = blocks("python")
    assert len([line for line in code.splitlines() if line]) == 5
    assert "stiffness xx:" in run(code, place)


def test_control_loop_predicts_where_the_arm_has_been(place: Path) -> None:
    _, code = blocks("python")
    assert run(code, place).split()[-1] == "LEARNED"


def test_commands_run_in_the_order_shown(place: Path) -> None:
    commands = [
        line for block in blocks("sh") for line in block.splitlines() if line.startswith("bayes-impedance")
    ]
    assert [command.split()[1] for command in commands] == [
        "simulate",
        "inspect",
        "train",
        "infer",
        "sample",
        "evaluate",
        "evaluate",
        "show",
        "plan",
    ]
    for command in commands:
        arguments = [sys.executable, "-m", "bayes_impedance", *shlex.split(command)[1:]]
        result = subprocess.run(arguments, cwd=place, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
    assert (place / "figures" / "impedance.png").is_file()
    assert json.loads((place / "scores.json").read_text())["axes"]["x"]["naive"]["n"] > 0


def test_configuration_is_valid() -> None:
    for block in blocks("yaml"):
        parse_config(yaml.safe_load(block))


def test_every_shipped_configuration_is_listed() -> None:
    for name in shipped_configurations():
        assert f"`{name}`" in README


def test_make_targets_and_links_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"make ([a-z]+)", README):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / link).is_file(), link


def figures_of(name: str) -> dict[str, Any]:
    return json.loads((ROOT / "results" / f"{name}.json").read_text(encoding="utf-8"))["figures"]


def coupled_figures() -> list[str]:
    """Of results/coupled.json and benchmarks/results.json, as the table has them."""
    coupled = figures_of("coupled")

    def errors(model: str, entry: str) -> np.ndarray:
        found = coupled["identification"][model][entry]
        return np.array(found["estimate"]) / np.array(found["truth"]) - 1.0

    names = ("stiffness", "damping", "mass")
    largest = {
        model: [max(abs(errors(model, f"{name}_{e}")).max() for e in ("xx", "yy")) for name in names]
        for model in ("coupled", "independent")
    }
    held = [np.mean([coupled["coverage"][f"{name}_{e}"] for e in ("xx", "yy", "xy")]) for name in names]
    coupling = coupled["identification"]["coupled"]["mass_xy"]
    off = np.abs(np.array(coupling["estimate"]) - np.array(coupling["truth"])).max()
    low = [-errors("independent", f"mass_{e}").mean() for e in ("xx", "yy")]
    times = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))["figures"]
    beside = times["markov_value_and_gradient_n100000_over_tinygp"]
    million = times["markov_value_and_gradient"]["n1000000_seconds"]
    return [
        ", ".join(f"{error:.1%}" for error in largest["coupled"]),
        ", ".join(f"{error:.0%}" for error in largest["independent"]),
        f"within {off:.2f} kg",
        ", ".join(f"{share:.0%}" for share in held),
        f"mass {low[0]:.0%} and {low[1]:.0%} too low",
        f"{beside['ours_seconds']:.2f} s; {million:.1f} s",
        f"{beside['theirs_seconds']:.2f} s",
    ]


def sampled_figures() -> list[str]:
    """Of results/sampling.json and results/calibration.json, as the table has them."""
    sampling, calibration = figures_of("sampling"), figures_of("calibration")
    recovery = [sampling["recovery"][name] for name in ("stiffness", "damping", "mass")]
    low, high = sampling["robot"]["reference"]["stiffness"]["interval"]
    held = sampling["arm"]["stiffness_coverage"]
    least = min(entry["p"] for entry in calibration["nuts"]["quantities"].values())
    return [
        ", ".join(f"{entry['error_median']:.1%}" for entry in recovery),
        ", ".join(f"{entry['coverage_mean']:.0%}" for entry in recovery),
        f"90 % interval {low:.1f}–{high:.1f} N/m; unknown: {sampling['robot']['no_reference']['stiffness']['support']}",
        f"hold | {held['nuts']:.0%} | {held['mode']:.0%}",
        f"of uniformity | {least:.2f}",
    ]


def benchmarked_figures() -> list[str]:
    """Of benchmarks/results.json and results/human_experiment.json, as the table has them."""
    times = json.loads((ROOT / "benchmarks" / "results.json").read_text(encoding="utf-8"))["figures"]
    rates = [
        (times[name]["ess_per_cpu_second"], times[name]["ess_per_cpu_second_after_warmup"])
        for name in (
            "nuts_n200",
            "nuts_n200_plain",
            "nuts_n200_numpyro",
            "nuts_n200_numpyro_in_our_coordinates",
        )
    ]
    over_draws = times["nuts_n200_over_plain"]["ess_per_cpu_second_after_warmup_over_draws"]
    loop, groups = (
        times["online_update_and_predict"],
        times["infer_64_groups_phase_over_calls_of_one_2_threads"],
    )
    study = figures_of("human_experiment")
    people = study["subjects"]["unperturbed"].values()
    twelve = study["recordings"]["twelve_folds"]
    return [
        f"{rates[0][0]:.1f}; {rates[0][1]:.0f} |",
        f"{rates[1][0]:.3f}; {rates[1][1]:.3f}, plain",
        f"{over_draws:.0f} times slower",
        *(f"{all_of:.1f}; {after:.0f}, NumPyro" for all_of, after in rates[2:]),
        f"{loop['median_milliseconds']:.2f} ms, {loop['p99_milliseconds']:.2f} ms",
        f"{groups['ours_seconds']:.2f} s | {groups['theirs_seconds']:.2f} s",
        *(
            "; ".join(
                ", ".join(f"{one['unseen']['axes'][axis][model]['msll']:.2f}" for axis in "xy")
                for one in people
            )
            for model in ("impedance", "naive")
        ),
        f"{twelve['impedance']['msll']:.2f}; {twelve['impedance']['folds_won']} of 12 runs won",
        f"{twelve['naive']['msll']:.2f}, naive GP",
    ]


def test_quoted_figures_are_those_of_the_results() -> None:
    names = ("core", "closed_loop", "recordings", "simulated_arm")
    core, loop, recordings, arm = (figures_of(name) for name in names)
    table = README.split("<!-- figures:")[1].split("<!-- end of figures -->")[0]
    iiwa, scores = core["known_equilibrium"], core["demo"]["scores"]["axes"]
    stiffness, late = iiwa["stiffness"], iiwa["reference_one_second_late"]
    known = recordings["iiwa_known_equilibrium"]["last_third"]["axes"]["z"]
    pushed = recordings["delta_robot"]["last_third"]["axes"]
    models = ("impedance", "naive", "impedance_without_residual")
    coverages = [rows[model]["coverage90"] for rows in pushed.values() for model in models]
    quoted = [
        f"{stiffness['mean']:.1f} N/m, 90 % interval {stiffness['q05']:.1f}–{stiffness['q95']:.1f}",
        f"{iiwa['least_squares_stiffness']:.1f} N/m, least-squares",
        f"{late['log_likelihood']:.1f}, {late['residual_rms']:.2f} N rms",
        f"{iiwa['log_likelihood']:.1f}, {iiwa['residual_rms']:.2f} N rms",
        *(f"{known[model]['msll']:.2f}" for model in models),
        *(", ".join(f"{pushed[axis][model]['msll']:.2f}" for axis in "xyz") for model in models),
        f"{min(coverages):.0%} to {max(coverages):.0%}",
        ", ".join(f"{scores[axis]['impedance']['msll']:.2f}" for axis in "xy"),
        ", ".join(f"{scores[axis]['naive']['msll']:.2f}" for axis in "xy"),
        *(
            ", ".join(f"{loop[way][size][name]['mean']:{form}}" for size in ("1 N", "2 N", "5 N"))
            for way in ("jacobian", "without_jacobian")
            for name, form in (("mass", ".2f"), ("stiffness", ".0f"))
        ),
        *(
            ", ".join(f"{core['coverage'][theta][latent]:.0%}" for theta in ("time", "phase", "position"))
            for latent in ("force", "desired_position")
        ),
    ]
    reading = figures_of("reading")
    traced = reading["panda_comanipulation"]["left_out_in_turn"]["axes"]
    quoted += [
        ", ".join(f"{traced[axis][model]['msll']:.2f}" for axis in "xy") for model in ("impedance", "naive")
    ]
    quoted += [
        ", ".join(f"{traced[axis][model]['coverage90']:.0%}" for axis in "xy")
        for model in ("impedance", "naive")
    ]
    losses = [traced[axis][model]["smse"] for axis in "xy" for model in ("impedance", "naive")]
    quoted += [f"SMSE {min(losses):.1f} to {max(losses):.1f}"]
    quoted += [", ".join(f"{reading['gp_mpc'][f'rail/{run}']['pooled_r_squared']:.2f}" for run in (1, 2, 3))]
    rivals = ("ensemble_coupled", "recursive_least_squares", "extended_kalman_filter")
    for task in ("flower", "figure_eight"):
        for model in ("impedance", "naive", *rivals):
            settings = [arm["force"][setting][task]["phase"]["axes"] for setting in ("low", "high")]
            pairs = [", ".join(f"{axes[axis][model]['msll']:.2f}" for axis in "xy") for axes in settings]
            quoted.append("; stiff ".join(pairs) if model == "impedance" else "; ".join(pairs))
    for posture in ("uncoupled", "paper"):
        found = arm["estimators"]["low"][posture]
        ours = arm["identification"]["low"][posture]["repetitions, 2 N"]["0"]
        pairs = [(found[model]["value"][0], found[model]["value"][-1]) for model in rivals]
        pairs += [(ours["stiffness_xx"]["mean"], ours["stiffness_yy"]["mean"])]
        pairs += [(found["truth"][0], found["truth"][3])]
        quoted += [f"{xx:.0f}, {yy:.0f}" for xx, yy in pairs]
    quoted += coupled_figures() + sampled_figures() + benchmarked_figures()
    plain = table.replace("−", "-").replace(" %", "%")
    for figure in quoted:
        assert figure.replace(" %", "%") in plain, figure
    told = " ".join(README.split("<!-- figures:")[0].split())
    relative, absolute = core["demo"]["mean_relative_error"], core["demo"]["mean_absolute_error"]
    for name in ("stiffness", "damping", "mass"):
        assert (
            f"{relative[f'{name}_xx']:.1%} and {relative[f'{name}_yy']:.1%} for {name}".replace("%", " %")
            in told
        )
    assert "{stiffness_xy:.2g} N/m, {damping_xy:.2g} Ns/m and {mass_xy:.2g} kg".format(**absolute) in told
    faults = json.loads((ROOT / "results" / "faults.json").read_text(encoding="utf-8"))
    generated = f"{faults['generated']:,}".replace(",", " ")
    assert f"{generated} generated configurations" in " ".join(README.split())
