"""Every sentence with which the package refuses something is quoted by a test that provokes it."""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import bayes_impedance
from bayes_impedance import errors

ROOT = Path(bayes_impedance.__file__).parent
ERRORS = {name for name, value in vars(errors).items() if isinstance(value, type)}
#: So many characters in a row of a sentence say which one is meant.
LENGTH = 16


@dataclass(frozen=True)
class Refusal:
    """A place where an error is made, and the constant parts of its sentence."""

    place: str
    parts: tuple[str, ...]

    @property
    def windows(self) -> set[str]:
        """Every run of LENGTH characters; a part that is shorter stands for itself."""
        long = {part[i : i + LENGTH] for part in self.parts for i in range(len(part) - LENGTH + 1)}
        return long or set(self.parts)


def strings(node: ast.AST) -> Iterator[str]:
    for inner in ast.walk(node):
        if isinstance(inner, ast.Constant) and isinstance(inner.value, str):
            yield inner.value


def refusals() -> Iterator[Refusal]:
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ERRORS:
                parts = tuple(part for argument in node.args for part in strings(argument) if part.strip())
                yield Refusal(f"{path.relative_to(ROOT)}:{node.lineno}", parts)


REFUSALS = tuple(refusals())


def quoted() -> str:
    """All strings of the tests, with what a regular expression escapes as it is meant."""
    tests = sorted(set(Path(__file__).parent.rglob("test_*.py")) - {Path(__file__)})
    lines = (text for path in tests for text in strings(ast.parse(path.read_text(encoding="utf-8"))))
    return "\n".join(re.sub(r"\\(\W)", r"\1", line) for line in lines)


QUOTED = quoted()


@pytest.mark.parametrize("refusal", REFUSALS, ids=lambda refusal: refusal.place)
def test_sentence_is_quoted_by_a_test(refusal):
    others = set().union(*(other.windows for other in REFUSALS if other.parts != refusal.parts))
    own = refusal.windows - others or refusal.windows
    assert any(window in QUOTED for window in own), refusal.parts


def test_every_refusal_is_found():
    assert len(REFUSALS) > 90
    assert {place.split(":")[0] for place in (refusal.place for refusal in REFUSALS)} >= {
        "cli.py", "config/loading.py", "journal.py", "log.py", "outputs.py", "persistence.py",
        "preprocessing/prepare.py", "readers/text.py", "training.py", "trajectory_mean.py",
    }  # fmt: skip
