"""The wheel works outside the checkout and brings its configurations."""

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

SCRIPT = """
import bayes_impedance, pathlib
from bayes_impedance.config import shipped_configurations, load_config
assert pathlib.Path(bayes_impedance.__file__).is_relative_to(pathlib.Path.cwd()), bayes_impedance.__file__
names = shipped_configurations()
for name, path in names.items():
    assert path.is_relative_to(pathlib.Path.cwd()), path
    load_config(name)
print(*names)
"""


def test_wheel_outside_the_checkout(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    installed = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(installed)
    assert "bayes_impedance/py.typed" in names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/"))]
    result = subprocess.run(
        [sys.executable, "-c", SCRIPT], cwd=installed, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.split() == [
        "admittance",
        "arm",
        "coupled",
        "phase",
        "position",
        "position_velocity",
        "recordings/delta_robot",
        "recordings/gp_mpc",
        "recordings/iiwa_known_equilibrium",
        "recordings/panda_comanipulation",
        "time",
    ]
