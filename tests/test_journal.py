"""A journal of evaluations: a training that was killed at any byte continues from it and ends with the same bits."""

import json
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bayes_impedance import training
from bayes_impedance.config import Config, parse_config
from bayes_impedance.errors import JournalWarning, NotPositiveDefiniteError, OutputError
from bayes_impedance.journal import MAGIC, RECORD, open_journal
from bayes_impedance.model import ImpedanceModel

ABOUT = {"torch": "2.13", "configuration": {"model": {"noise_sd": 0.2, "mass": None}}}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "model.journal"


def fill(path: Path, count: int) -> None:
    with open_journal(path) as journal:
        journal.begin(ABOUT)
        for index in range(count):
            journal.keep(np.array([index, np.pi]), np.array([index + 0.1, -np.inf, np.nan]))


def contents(path: Path) -> list[int]:
    """Which of the points of `fill` are there, with the bits that were kept."""
    with open_journal(path) as journal:
        found = [(index, journal.find(np.array([index, np.pi]))) for index in range(10)]
    for index, values in found:
        if values is not None:
            assert values.tobytes() == np.array([index + 0.1, -np.inf, np.nan]).tobytes()
    return [index for index, values in found if values is not None]


# --- the file ------------------------------------------------------------------------------------


def test_what_was_kept_is_found_again_to_the_bit(path):
    fill(path, 3)
    assert contents(path) == [0, 1, 2]
    with open_journal(path) as journal:
        assert len(journal) == 3
        assert journal.find(np.array([np.nextafter(1.0, 2.0), np.pi])) is None
        journal.begin(ABOUT)
        journal.keep(np.array([3, np.pi]), np.array([3.1, -np.inf, np.nan]))
    assert contents(path) == [0, 1, 2, 3]


def test_torn_at_any_byte_it_keeps_every_whole_record(path):
    fill(path, 3)
    whole = path.read_bytes()
    size = RECORD.size + 8 * 5
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        left = max(0, 3 - -(-(len(whole) - length) // size))
        assert contents(path) == list(range(left))
        # And goes on behind it.
        with open_journal(path) as journal:
            journal.begin(ABOUT)
            journal.keep(np.array([9, np.pi]), np.array([9.1, -np.inf, np.nan]))
        assert contents(path) == [*range(left), 9]


def test_damage_is_noticed(path):
    fill(path, 3)
    content = bytearray(path.read_bytes())
    content[-1 - RECORD.size - 8 * 5] ^= 1
    path.write_bytes(content)
    assert contents(path) == [0]


def test_without_an_evaluation_nothing_is_left(path):
    fill(path, 0)
    assert not path.exists()
    with pytest.raises(ZeroDivisionError), open_journal(path):
        raise ZeroDivisionError
    assert not path.exists()


def test_is_kept_when_the_block_ends_badly(path):
    with pytest.raises(ZeroDivisionError), open_journal(path) as journal:
        journal.begin(ABOUT)
        journal.keep(np.zeros(2), np.zeros(3))
        raise ZeroDivisionError
    assert path.is_file()


def test_is_gone_when_it_is_removed(path):
    with open_journal(path) as journal:
        journal.begin(ABOUT)
        journal.keep(np.zeros(2), np.zeros(3))
        journal.remove()
    assert not path.exists()


@pytest.mark.parametrize("content", [b"years of work", MAGIC[:10] + b"?"])
def test_another_file_is_left_alone(path, content):
    path.write_bytes(content)
    with (
        pytest.raises(
            OutputError, match="expected the journal of a training, found another file; rename it, or "
        ),
        open_journal(path),
    ):
        pytest.fail("not to be used")
    assert path.read_bytes() == content


def test_folder_in_its_place(path):
    path.mkdir()
    with (
        pytest.raises(OutputError, match="found a folder or device; rename it, or train"),
        open_journal(path),
    ):
        pytest.fail("not to be used")


def test_place_that_takes_no_file(tmp_path):
    with (
        pytest.raises(
            OutputError,
            match="could not be written: .*; make room, or train with another --out",
        ),
        open_journal(tmp_path / "missing" / "model.journal"),
    ):
        pytest.fail("not to be used")


def test_one_process_at_a_time(path):
    fill(path, 2)
    with open_journal(path):
        for _ in range(2):
            with (
                pytest.raises(
                    OutputError, match="expected no other training into the same model, found one at work"
                ),
                open_journal(path),
            ):
                pytest.fail("not to be used")
    assert contents(path) == [0, 1]


def test_journal_that_its_owner_removes_while_another_opens_it_is_not_used(path, monkeypatch):
    """Else the other would write into a file that no name leads to."""
    fill(path, 2)
    monkeypatch.setattr("bayes_impedance.journal.lock_descriptor", lambda *_, **__: path.unlink() or True)
    with pytest.raises(OutputError, match="found one at work"), open_journal(path):
        pytest.fail("not to be used")


def test_drive_that_knows_no_locks_is_used_without(path, monkeypatch):
    def unknown(*_: object, **__: object) -> bool:
        raise OSError("No locks available")

    monkeypatch.setattr("bayes_impedance.journal.lock_descriptor", unknown)
    fill(path, 2)
    assert contents(path) == [0, 1]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"torch": "2.14"}, "torch ('2.13', now '2.14')"),
        ({"configuration": {"model": {"noise_sd": 0.3}}}, "configuration.model.noise_sd (0.2, now 0.3)"),
        ({"configuration": {}}, "configuration.model ({'noise_sd': 0.2, 'mass': None}, now None)"),
        ({"recordings": "ab"}, "recordings (None, now 'ab')"),
    ],
)
def test_journal_of_another_training_is_refused(path, change, said):
    fill(path, 1)
    before = path.read_bytes()
    with (
        pytest.raises(
            OutputError, match=re.escape(f"found one of another {said}; continue with what it was")
        ) as caught,
        open_journal(path) as journal,
    ):
        journal.begin(ABOUT | change)
    assert str(caught.value).endswith("or delete the file to start anew")
    assert path.read_bytes() == before


def test_without_an_evaluation_it_is_of_no_training(path):
    fill(path, 1)
    path.write_bytes(path.read_bytes()[:-1])
    with open_journal(path) as journal:
        journal.begin({"torch": "2.14"})
        journal.keep(np.zeros(2), np.zeros(3))
    with open_journal(path) as journal:
        journal.begin({"torch": "2.14"})
        assert len(journal) == 1


def test_full_disk_before_the_work_begins(path, full_disk):
    long = ABOUT | {"recordings": "x" * 5000}
    with (
        pytest.raises(OutputError, match="could not be written: File too large; make room"),
        full_disk(),
        open_journal(path) as journal,
    ):
        journal.begin(long)
    assert not path.exists()


def test_full_disk_later_is_one_warning(path, full_disk):
    with full_disk(), warnings.catch_warnings(record=True) as caught, open_journal(path) as journal:
        warnings.simplefilter("always")
        journal.begin(ABOUT)
        for index in range(200):
            journal.keep(np.array([index, np.pi]), np.array([index + 0.1, -np.inf, np.nan]))
        # What was computed is known to the end of this run.
        assert len(journal) == 200
    (warning,) = caught
    assert warning.category is JournalWarning
    assert f"{path}: could not be written: File too large; training goes on, but if it" in str(
        warning.message
    )
    assert contents(path) == list(range(10))
    with open_journal(path) as journal:
        assert len(journal) == (4096 - len(MAGIC) - len(json.dumps(ABOUT)) - 1) // (RECORD.size + 8 * 5)


def test_interrupted_in_the_middle_of_a_record_it_goes_on_behind_the_last_whole_one(path):
    class Interrupting:
        """A file that takes ten bytes, and then Ctrl-C comes."""

        def __init__(self, file):
            self.file, self.calls = file, 0

        def write(self, content):
            self.calls += 1
            if self.calls == 2:
                raise KeyboardInterrupt
            return self.file.write(content[:10])

        def __getattr__(self, name):
            return getattr(self.file, name)

    fill(path, 2)
    with open_journal(path) as journal:
        journal.begin(ABOUT)
        file, journal._file = journal._file, Interrupting(journal._file)
        with pytest.raises(KeyboardInterrupt):
            journal.keep(np.array([2, np.pi]), np.array([2.1, -np.inf, np.nan]))
        journal._file = file
        journal.keep(np.array([3, np.pi]), np.array([3.1, -np.inf, np.nan]))
    assert contents(path) == [0, 1, 3]


# --- training ------------------------------------------------------------------------------------


@pytest.fixture
def config(tiny) -> Config:
    content = tiny.config.model_dump(mode="json")
    content["training"] |= {"restarts": 2, "max_iterations": 3}
    return parse_config(content)


@pytest.fixture
def computed(monkeypatch) -> Iterator[list[int]]:
    """Counts how often the objective is computed."""
    counter = [0]
    objective = training.objective

    def counted(*arguments: object):
        counter[0] += 1
        return objective(*arguments)

    monkeypatch.setattr(training, "objective", counted)
    return counter


def state(model: ImpedanceModel) -> str:
    """Hyperparameters and report to the bit, but for the times."""
    report = replace(
        model.report, restarts=tuple(replace(restart, seconds=0.0) for restart in model.report.restarts)
    )
    return repr(([entry.raw.detach().numpy().tobytes() for entry in model.hyperparameters], report))


def fit(tiny, config: Config, path: Path) -> ImpedanceModel:
    with open_journal(path) as journal:
        return ImpedanceModel(config).fit(tiny.fitted.fitted.log, journal=journal)


def test_training_is_the_same_with_a_journal_and_the_second_time_computes_nothing(
    tiny, config, path, computed
):
    plain = state(ImpedanceModel(config).fit(tiny.fitted.fitted.log))
    assert state(fit(tiny, config, path)) == plain
    computed[0] = 0
    assert state(fit(tiny, config, path)) == plain
    assert computed[0] == 0


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.5, 0.7, 0.99])
def test_training_continues_from_any_point_to_the_same_bits(tiny, config, path, computed, share):
    """In the middle of a restart, between two, in the middle of the Laplace step; in the middle of a record."""
    expected = state(fit(tiny, config, path))
    total = computed[0]
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with open_journal(path) as journal:
        known = len(journal)
    computed[0] = 0
    assert state(fit(tiny, config, path)) == expected
    assert computed[0] == total - known
    assert path.read_bytes() == content


def test_more_restarts_go_on_from_what_fewer_computed(tiny, config, path, computed):
    longer = parse_config(config.model_dump(mode="json"), overrides=["training.restarts=3"])
    expected = state(ImpedanceModel(longer).fit(tiny.fitted.fitted.log))
    first = fit(tiny, config, path).report.restarts
    computed[0] = 0
    continued = fit(tiny, longer, path)
    assert state(continued) == expected
    assert continued.report.restarts[1].evaluations == first[1].evaluations
    assert computed[0] <= continued.report.restarts[2].evaluations + 2 * sum(
        int(entry.free.sum()) for entry in continued.hyperparameters
    )


def test_stopped_by_hand_it_continues(tiny, config, path):
    def stop(restart: int, iteration: int, _: float) -> None:
        if (restart, iteration) == (1, 2):
            raise KeyboardInterrupt

    expected = state(ImpedanceModel(config).fit(tiny.fitted.fitted.log))
    with open_journal(path) as journal:
        half = ImpedanceModel(config).fit(tiny.fitted.fitted.log, stop, journal=journal)
    assert half.report.interrupted
    assert state(fit(tiny, config, path)) == expected


def test_an_evaluation_that_failed_fails_again(tiny, config, path, monkeypatch):
    objective = training.objective
    calls = 0

    def failing(*arguments: object):
        nonlocal calls
        calls += 1
        if calls == 3:
            raise NotPositiveDefiniteError("not positive definite, for a test")
        return objective(*arguments)

    monkeypatch.setattr(training, "objective", failing)
    first = fit(tiny, config, path)
    assert first.report.restarts[0].outcome.startswith("stopped: not positive")
    # It is the third again: the first two are known.
    calls = 2
    assert state(fit(tiny, config, path)) == state(first)


def test_other_recordings_and_settings_are_not_continued(tiny, config, path):
    fit(tiny, config, path)
    other = parse_config(config.model_dump(mode="json"), overrides=["model.noise_sd=0.3"])
    with pytest.raises(OutputError, match=r"found one of another configuration\.model\.noise_sd"):
        fit(tiny, other, path)
    with (
        pytest.raises(OutputError, match=r"found one of another recordings \('\w{16}', now '\w{16}'\)"),
        open_journal(path) as journal,
    ):
        ImpedanceModel(config).fit(tiny.fitted.fitted.log.select([0]), journal=journal)


def test_full_disk_does_not_stop_training(tiny, config, path, full_disk):
    expected = state(ImpedanceModel(config).fit(tiny.fitted.fitted.log))
    # Room for the configuration, which begins the journal, and a few evaluations.
    with full_disk(5120), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert state(fit(tiny, config, path)) == expected
    assert [entry.category for entry in caught] == [JournalWarning]
    assert state(fit(tiny, config, path)) == expected
