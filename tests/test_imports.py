"""Data flows one way: every module imports only from layers below its own."""

import ast
from pathlib import Path

import pytest

import bayes_impedance

ROOT = Path(bayes_impedance.__file__).parent

#: Modules of two families, each of which imports only those before it.
BASELINES = (
    "baselines.naive",
    "baselines.without_residual",
    "baselines.phase_basis",
    "baselines.samples",
    "baselines.regression",
    "baselines.instruments",
    "baselines.track",
    "baselines.ensemble",
    "baselines.recursive",
    "baselines.kalman",
    "baselines",
)
SIMULATION = (
    "simulation.interaction",
    "simulation.drawn_latents",
    "simulation.generative",
    "simulation.prior_predictive",
    "simulation.arm",
    "simulation.tasks",
    "simulation.device",
    "simulation.dynamics",
    "simulation.subjects",
    "simulation.experiment",
    "simulation.one_axis",
    "simulation.planning",
    "simulation",
)

CALIBRATION = (
    "calibration.uniformity",
    "calibration.problem",
    "calibration.quantities",
    "calibration.records",
    "calibration.draw",
    "calibration.run",
    "calibration",
)

CONFIG = (
    "config.sections",
    "config.inference",
    "config.log",
    "config.model",
    "config.preprocessing",
    "config.loading",
    "config",
)
READERS = (
    "readers.table",
    "readers.cells",
    "readers.columns",
    "readers.text",
    "readers.parquet",
    "readers.bags.layout",
    "readers.bags.bounded",
    "readers.bags.bag",
    "readers.bags.topics",
    "readers.bags.messages",
    "readers.bags",
    "readers.arrays.tree",
    "readers.arrays.tables",
    "readers.arrays.numpy_archive",
    "readers.arrays.hdf5",
    "readers.arrays.matlab_elements",
    "readers.arrays.matlab_hdf5",
    "readers.arrays.matlab",
    "readers.arrays",
    "readers.times",
    "readers.samples",
    "readers.force",
    "readers.trials",
    "readers.read",
    "readers",
)
PREPROCESSING = (
    "preprocessing.prepared",
    "preprocessing.grid",
    "preprocessing.savitzky_golay",
    "preprocessing.bandwidth",
    "preprocessing.segmentation",
    "preprocessing.phase",
    "preprocessing.warping",
    "preprocessing.prepare",
    "preprocessing",
)
RECORDING = (
    "recording.least_squares",
    "recording.alike",
    "recording.wrench",
    "recording.tool",
    "recording.quality",
    "recording.plausibility",
    "recording.device_law",
    "recording.offset",
    "recording.clock",
    "recording.synchronise",
    "recording.spectra",
    "recording.lag",
    "recording",
)

INSPECTION = (
    "inspection.guess",
    "inspection.findings",
    "inspection.inspect",
    "inspection.draft",
    "inspection",
)


KERNELS = (
    "kernels.stationary",
    "kernels.derivative",
    "kernels.warped",
    "kernels.motion_noise",
    "kernels.impedance",
    "kernels.coupled_terms",
    "kernels.coupled",
    "kernels",
)
ENGINES = (
    "engines.gaussian",
    "engines.dense",
    "engines.closed_loop",
    "engines.coupled_loop",
    "engines.compiled.numbers",
    "engines.compiled.covariance",
    "engines.compiled",
    "engines.pointwise",
    "engines.given_impedance",
    "engines.given_dense",
    "engines.markov.state_space",
    "engines.markov.recursions",
    "engines.markov.reverse",
    "engines.markov.simulate",
    "engines.markov.arrangement",
    "engines.markov.likelihood",
    "engines.markov.observation",
    "engines.markov.prior_draws",
    "engines.markov.engine",
    "engines.markov",
    "engines.lowrank.basis",
    "engines.lowrank.hilbert",
    "engines.lowrank.periodic",
    "engines.lowrank.blocks",
    "engines.lowrank.columns",
    "engines.lowrank.woodbury",
    "engines.lowrank.support",
    "engines.lowrank.prediction",
    "engines.lowrank.engine",
    "engines.lowrank",
    "engines.local.factors",
    "engines.local.cell",
    "engines.local.grid",
    "engines.local.step",
    "engines.local.model",
    "engines.local.build",
    "engines.local",
    "engines.choice",
    "engines",
)
IMPEDANCE_FUNCTIONS = (
    "impedance_functions.threads",
    "impedance_functions.symmetric",
    "impedance_functions.log_matrix",
    "impedance_functions.inducing",
    "impedance_functions.function",
    "impedance_functions.tilted",
    "impedance_functions.density",
    "impedance_functions.laplace",
    "impedance_functions.evidence",
    "impedance_functions.fit",
    "impedance_functions.conditioned",
    "impedance_functions",
)
SAMPLING = (
    "sampling.parameters",
    "sampling.density",
    "sampling.transport",
    "sampling.start",
    "sampling.draws",
    "sampling.program",
    "sampling.exceptions",
    "sampling.kernel",
    "sampling.nuts",
    "sampling.checkpoint",
    "sampling.task",
    "sampling.chains",
    "sampling.importance",
    "sampling.variational",
    "sampling.diagnosis",
    "sampling.diagnostics",
    "sampling.latents",
    "sampling.impedance_draws",
    "sampling.places",
    "sampling.support",
    "sampling.drawn",
    "sampling.dataset",
    "sampling.sample",
    "sampling",
)
#: Training and posteriors of functions give what training and posteriors of moments give.
FITTED_FUNCTIONS = ("impedance_functions.train", "impedance_functions.posterior")
PLOTTING = (
    "plotting.panels",
    "plotting.over_time",
    "plotting.impedance",
    "plotting.ellipses",
    "plotting.plans",
    "plotting.recordings",
    "plotting.draws",
    "plotting.calibration",
    "plotting.files",
    "plotting",
)
POSTERIOR = (
    "posterior.terms",
    "posterior.results",
    "posterior.conditioning",
    "posterior.batches",
    "posterior.collected",
    "posterior.independent",
    "posterior.coupled",
    "posterior.local",
    "posterior.compute",
    "posterior",
)
ONLINE = (
    "online.sample",
    "online.inputs",
    "online.storage",
    "online.predictor",
    "online",
)
COMMANDS = (
    "commands.inspection_tables",
    "commands.inspect",
    "commands.simulate",
    "commands.plan",
    "commands.sample",
    "commands.calibrate",
    "commands",
)

#: From the bottom to the top. Within a layer modules do not know each other, unless FAMILIES says so.
LAYERS: tuple[frozenset[str], ...] = tuple(
    map(
        frozenset,
        (
            {"errors"},
            {*CONFIG, "outputs", "journal"},
            {"log", "evaluation.metrics"},
            RECORDING,
            {*READERS, *PREPROCESSING, "writer"},
            {"trajectory_mean", "device", "sealed", *INSPECTION},
            KERNELS,
            {"features"},
            {"priors"},
            set(ENGINES),
            IMPEDANCE_FUNCTIONS,
            {"training"},
            POSTERIOR,
            set(FITTED_FUNCTIONS),
            {
                "identifiability",
                "evaluation.explained",
                "evaluation.folds",
                *BASELINES,
            },
            set(SAMPLING),
            {"model"},
            {"persistence", "evaluation.contenders", "sensitivity", *ONLINE},
            {"evaluation.held_out"},
            {"evaluation", "evaluation.cross_validation"},
            {"__init__"},
            SIMULATION,
            CALIBRATION,
            {*PLOTTING, "terminal"},
            {"demo", *COMMANDS},
            {"cli"},
            {"__main__"},
        ),
    )
)

#: Modules of a layer that import each other, in one order.
FAMILIES = (
    INSPECTION,
    CONFIG,
    RECORDING,
    PREPROCESSING,
    READERS,
    KERNELS,
    ENGINES,
    IMPEDANCE_FUNCTIONS,
    POSTERIOR,
    FITTED_FUNCTIONS,
    SAMPLING,
    ONLINE,
    BASELINES,
    SIMULATION,
    CALIBRATION,
    PLOTTING,
    COMMANDS,
)

#: Only the command line and its demo show, draw or simulate anything.
PRESENTATION = {"cli", *COMMANDS, "demo", "terminal", *PLOTTING, *SIMULATION, *CALIBRATION}

#: What a kernel may know of this package: other kernels. They are to be taken into other people's code.
FREE = ("kernels.", "evaluation.metrics", "errors")

#: Libraries that only some layers may load, for they are slow or have no place elsewhere.
CONFINED = {
    "typer": {"cli", *COMMANDS} - {"commands", "commands.inspection_tables"},
    "rich": {"cli", "terminal", *COMMANDS} - {"commands"},
    "numba": {
        "simulation.dynamics",
        "engines.markov.state_space",
        "engines.markov.recursions",
        "engines.markov.reverse",
        "engines.markov.simulate",
        "engines.compiled.covariance",
        "engines.local.factors",
        "engines.local.cell",
        "engines.local.grid",
        "engines.local.step",
    },
    "matplotlib": set(PLOTTING) - {"plotting", "plotting.files"},
    "pydantic": set(CONFIG) - {"config"},
    "yaml": {"config.loading"},
    "safetensors": {"persistence", "sealed"},
    "pyro": {
        "sampling.program",
        "sampling.exceptions",
        "sampling.kernel",
        "sampling.task",
        "sampling.variational",
    },
    "xarray": {"sampling.dataset"},
    "arviz_stats": {"sampling.importance", "sampling.diagnostics", "sampling.support"},
    "pyarrow": {"readers.parquet"},
    "h5py": {"readers.arrays.hdf5", "readers.arrays.matlab_hdf5"},
    "filelock": {"journal"},
    "dtaidistance": {"preprocessing.warping"},
    "rosbags": {"readers.bags.bag", "readers.bags.bounded"},
    "lz4": {"readers.bags.bounded"},
}


def name_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


MODULES = {name_of(path): path for path in sorted(ROOT.rglob("*.py"))}


def imported(module: str) -> tuple[set[str], set[str]]:
    """Modules of this package, and names of other packages, that a module imports anywhere."""
    own: set[str] = set()
    foreign: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            # `from bayes_impedance import terminal` imports a module, `from … import Name` one of its names.
            assert node.module is not None
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [
                name if name.removeprefix("bayes_impedance.") in MODULES else node.module for name in inner
            ]
        else:
            continue
        for name in names:
            first, _, rest = name.partition(".")
            if first == "bayes_impedance":
                own.add(rest or "__init__")
            else:
                foreign.add(first)
    return own, foreign


def layer(module: str) -> int:
    return next(index for index, names in enumerate(LAYERS) if module in names)


def may_import(module: str, other: str) -> bool:
    if layer(other) != layer(module):
        return layer(other) < layer(module)
    return any(
        module in family and other in family and family.index(other) < family.index(module)
        for family in FAMILIES
    )


def test_every_module_has_its_layer():
    assert set(MODULES) == set().union(*LAYERS)
    assert sum(map(len, LAYERS)) == len(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_imports_point_downwards(module):
    wrong = [other for other in imported(module)[0] if not may_import(module, other)]
    assert wrong == []


@pytest.mark.parametrize("module", sorted(set(MODULES) - PRESENTATION - {"__main__"}))
def test_nothing_but_the_command_line_shows_draws_or_simulates(module):
    assert not imported(module)[0] & PRESENTATION


@pytest.mark.parametrize(
    "module", ["errors", "evaluation.metrics", *(m for m in MODULES if m.startswith("kernels"))]
)
def test_foundations_stand_alone(module):
    assert all(other.startswith(FREE) for other in imported(module)[0])


@pytest.mark.parametrize("module", CONFIG)
def test_configuration_knows_only_errors(module):
    assert imported(module)[0] <= {"errors", *CONFIG}


def test_errors_know_nothing():
    assert imported("errors") == (set(), set())


@pytest.mark.parametrize("library", CONFINED)
def test_libraries_are_confined(library):
    assert {module for module in MODULES if library in imported(module)[1]} == CONFINED[library]


def test_nothing_is_pickled():
    for module in MODULES:
        assert not imported(module)[1] & {"pickle", "joblib", "dill", "shelve", "marshal"}
        assert "torch.load" not in MODULES[module].read_text(encoding="utf-8")
        assert "torch.save" not in MODULES[module].read_text(encoding="utf-8")
