"""Model folders: the same bits come back, and nothing that was damaged, changed or is too new is trusted."""

import errno
import hashlib
import json
import os
import pickletools
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from bayes_impedance import persistence
from bayes_impedance.errors import ConfigurationError, ModelFolderError, OutputError
from bayes_impedance.model import ImpedanceModel
from bayes_impedance.persistence import FILES, METADATA, SCHEMA_VERSION, load_model, save_model
from bayes_impedance.posterior import Posterior
from bayes_impedance.readers import read_log

ALL = sorted((*FILES, METADATA))


@pytest.fixture
def folder(tiny, tmp_path):
    """A model folder to spoil."""
    return Path(shutil.copytree(tiny.model, tmp_path / "model"))


def bits(posterior: Posterior) -> str:
    """Digest of every number of a posterior."""
    total = hashlib.sha256()
    for latent, marginal in posterior.marginals.items():
        total.update(latent.value.encode())
        for name in ("location", "scale", "prior_location", "prior_scale"):
            total.update(np.ascontiguousarray(getattr(marginal, name)).tobytes())
    return total.hexdigest()


def patch_metadata(folder: Path, change: Callable[[dict], object]) -> None:
    metadata = json.loads((folder / METADATA).read_text())
    change(metadata)
    (folder / METADATA).write_text(json.dumps(metadata))


def accept(folder: Path) -> None:
    """Bring the digests in line with the files, as somebody would who knows them."""
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in FILES}
    patch_metadata(folder, lambda metadata: metadata.update(files=digests))


def refused(folder: Path, expected: str) -> None:
    with pytest.raises(ModelFolderError, match=expected) as caught:
        load_model(folder)
    assert str(caught.value).startswith(str(folder))
    assert "\n" not in str(caught.value)


# --- the same bits -------------------------------------------------------------------------------


def test_loaded_model_is_the_saved_one(tiny):
    loaded = load_model(tiny.model)
    assert loaded.config == tiny.config
    assert loaded.fitted.log.fingerprint() == tiny.fitted.fitted.log.fingerprint()
    assert loaded.fitted.log.header() == tiny.fitted.fitted.log.header()
    # NaN for hyperparameters that are fixed, so == will not do.
    assert repr(loaded.report) == repr(tiny.fitted.report)
    for mine, its in zip(loaded.hyperparameters, tiny.fitted.hyperparameters, strict=True):
        assert mine.name == its.name
        assert mine.raw.detach().numpy().tobytes() == its.raw.detach().numpy().tobytes()
        assert mine.raw.requires_grad == its.raw.requires_grad


@pytest.mark.parametrize("given", ["both", "training", "log"])
def test_loaded_model_predicts_the_same_bits(tiny, given):
    log = read_log(tiny.other, tiny.config.log)
    assert bits(load_model(tiny.model).posterior(log, given)) == bits(tiny.fitted.posterior(log, given))


def test_loaded_model_predicts_the_same_bits_in_another_process(tiny):
    program = (
        "import sys, pathlib; sys.path.insert(0, sys.argv[1])\n"
        "from test_persistence import bits\n"
        "from bayes_impedance.persistence import load_model\n"
        "from bayes_impedance.readers import read_log\n"
        "model = load_model(sys.argv[2])\n"
        "print(bits(model.posterior(read_log(sys.argv[3], model.config.log))))\n"
    )
    here = str(Path(__file__).parent)
    done = subprocess.run(
        [sys.executable, "-B", "-c", program, here, str(tiny.model), str(tiny.other)],
        capture_output=True,
        text=True,
        check=True,
    )
    expected = bits(tiny.fitted.posterior(read_log(tiny.other, tiny.config.log)))
    assert done.stdout.strip() == expected


def test_saved_again_it_is_the_same_folder(tiny, tmp_path):
    save_model(load_model(tiny.model), tmp_path / "again")
    for name in ALL:
        assert (tmp_path / "again" / name).read_bytes() == (tiny.model / name).read_bytes()


def test_folder_holds_what_it_says_and_no_pickle(tiny):
    assert sorted(path.name for path in tiny.model.iterdir()) == ALL
    for path in tiny.model.iterdir():
        with pytest.raises(ValueError, match=r".*"):
            list(pickletools.genops(path.read_bytes()))
    metadata = json.loads((tiny.model / METADATA).read_text())
    assert metadata["schema_version"] == SCHEMA_VERSION
    assert metadata["package_version"]
    assert metadata["data_fingerprint"] == tiny.fitted.fitted.log.fingerprint()
    assert metadata["log"]["axes"] == ["x", "y"]
    assert set(metadata["files"]) == set(FILES)


def test_model_without_training_cannot_be_saved(tiny, tmp_path):
    with pytest.raises(ConfigurationError, match=r"expected a fitted model.*; call fit\(log\) first"):
        save_model(ImpedanceModel(tiny.config), tmp_path / "model")
    assert not (tmp_path / "model").exists()


# --- what cannot be loaded -----------------------------------------------------------------------


def test_no_folder(tmp_path):
    refused(tmp_path / "model", "expected a model folder, found nothing; name the folder that `bayes-imp")


def test_file_instead_of_a_folder(tmp_path):
    (tmp_path / "model").write_text("")
    refused(tmp_path / "model", "expected a model folder, found a file; name the folder")


def test_other_folder(tmp_path):
    refused(tmp_path, r"expected a model folder with metadata\.json, found none; name the folder")


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"{",
        b"not JSON",
        b"\xff\xfe",
        b"[]",
        b"5",
        b"null",
        b"{}",
        b'{"schema_version": 1}',
        b'{"schema_version": "one", "files": {}}',
        b'{"schema_version": null, "files": {}}',
        b'{"schema_version": 1e999, "files": {}}',
        b'{"schema_version": 1, "files": null}',
        b'{"schema_version": 1, "files": [1]}',
        b"[" * 100_000,
    ],
)
def test_metadata_that_is_not_what_training_wrote(folder, text):
    (folder / METADATA).write_bytes(text)
    refused(folder, r"metadata\.json: expected the JSON that training wrote, found it truncated or changed")


def test_truncated_metadata(folder):
    text = (folder / METADATA).read_bytes()
    for length in range(0, len(text) - 2, 97):
        (folder / METADATA).write_bytes(text[:length])
        refused(folder, "found it truncated or changed .*; copy the whole folder again, or train again")


def test_newer_schema(folder):
    def newer(metadata: dict) -> None:
        metadata.update(schema_version=SCHEMA_VERSION + 1, package_version="9.9.0")

    patch_metadata(folder, newer)
    refused(
        folder,
        r"expected a model of schema 1 or older, found schema 2, written by bayes_impedance 9\.9\.0; update",
    )
    patch_metadata(folder, lambda metadata: metadata.pop("package_version"))
    refused(folder, "written by bayes_impedance of unknown version; update bayes_impedance")


@pytest.mark.parametrize("name", FILES)
def test_missing_file(folder, name):
    (folder / name).unlink()
    refused(folder, f"expected the files .*, found no {name}; copy the whole folder again, or train again")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.5, 0.999])
def test_changed_byte(folder, name, share):
    content = bytearray((folder / name).read_bytes())
    content[int(share * len(content))] ^= 1
    (folder / name).write_bytes(content)
    refused(folder, f"{name}: expected the content that training wrote, found it changed; restore it")


@pytest.mark.parametrize("name", FILES)
def test_truncated_file(folder, name):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: len(content) // 2])
    refused(folder, "found it changed")


def test_edited_configuration_says_how_to_change_settings(folder):
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("seed: 0", "seed: 1"))
    refused(folder, r"found it changed; .*settings are changed with train --config or --set")


@pytest.mark.parametrize("name", ["hyperparameters.safetensors", "data.safetensors"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_tensors_with_a_matching_digest(folder, name, share):
    content = (folder / name).read_bytes()
    (folder / name).write_bytes(content[: int(share * len(content))])
    accept(folder)
    refused(folder, "expected a model folder of schema 1, found inconsistent content .*; train again")


def test_another_configuration_with_a_matching_digest(folder):
    path = folder / "config.yaml"
    path.write_text(path.read_text().replace("trajectory_input: phase", "trajectory_input: fase"))
    accept(folder)
    refused(folder, r"found inconsistent content \(.*model\.trajectory_input.*'fase'\); train again")


def test_tensors_of_another_model_with_a_matching_digest(folder):
    path = folder / "hyperparameters.safetensors"
    tensors = load_file(path)
    name = "stiffness.level"
    save_file({**tensors, name: tensors[name][:1]}, path)
    accept(folder)
    refused(folder, "found inconsistent content .stiffness.level of another shape or type.; train again")
    save_file({**tensors, name: tensors[name].astype(np.float32)}, path)
    accept(folder)
    refused(folder, "stiffness.level of another shape or type")
    tensors.pop(name)
    save_file(tensors, path)
    accept(folder)
    refused(folder, "found inconsistent content .*stiffness.level")


def test_data_of_another_log_with_a_matching_digest(folder):
    path = folder / "data.safetensors"
    arrays = load_file(path)
    arrays.pop("trials.0.position")
    save_file(arrays, path)
    accept(folder)
    refused(folder, r"expected an array trials\.0\.position, found none")


@pytest.mark.parametrize(
    "change",
    [
        lambda metadata: metadata["log"]["trials"][0].update(group="other"),
        lambda metadata: metadata["log"].update(axes=["y", "x"]),
        lambda metadata: metadata.update(data_fingerprint="0" * 64),
        lambda metadata: metadata.pop("data_fingerprint"),
        lambda metadata: metadata.pop("log"),
        lambda metadata: metadata.pop("report"),
        lambda metadata: metadata.update(report=[]),
        lambda metadata: metadata["report"].update(restarts=[1]),
        lambda metadata: metadata["report"].update(unknown=1),
        lambda metadata: metadata["report"].pop("samples"),
    ],
)
def test_metadata_that_contradicts_the_files(folder, change):
    patch_metadata(folder, change)
    refused(folder, "found inconsistent content .*; train again")


# --- writing -------------------------------------------------------------------------------------


def test_model_takes_the_place_of_another(tiny, folder):
    patch_metadata(folder, lambda metadata: metadata.update(schema_version=99))
    save_model(tiny.fitted, folder)
    assert bits(load_model(folder).posterior(tiny.fitted.fitted.log)) == bits(
        tiny.fitted.posterior(tiny.fitted.fitted.log)
    )
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


@pytest.mark.parametrize("function", ["dump_config", "save", "version", "_digest"])
def test_failure_while_writing_leaves_the_old_model(tiny, folder, monkeypatch, function):
    def no_space(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    before = bits(load_model(folder).posterior(tiny.fitted.fitted.log))
    with monkeypatch.context() as patched, pytest.raises(OutputError) as caught:
        patched.setattr(persistence, function, no_space)
        save_model(tiny.fitted, folder)
    assert str(caught.value) == f"{folder}: could not be written: No space left on device"
    assert bits(load_model(folder).posterior(tiny.fitted.fitted.log)) == before
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_full_disk(tiny, tmp_path, full_disk):
    with pytest.raises(OutputError) as caught, full_disk():
        save_model(tiny.fitted, tmp_path / "model")
    assert str(caught.value) == f"{tmp_path / 'model'}: could not be written: File too large"
    assert list(tmp_path.iterdir()) == []


def test_interruption_while_writing_leaves_the_old_model(tiny, folder, monkeypatch):
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(persistence, "_digest", interrupted)
        save_model(tiny.fitted, folder)
    load_model(folder)
    assert [path.name for path in folder.parent.iterdir()] == ["model"]


def test_folder_that_is_no_model_is_not_replaced(tiny, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter").write_text("years of work")
    with pytest.raises(OutputError, match="found a folder with other content; choose another name"):
        save_model(tiny.fitted, tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter").read_text() == "years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["thesis"]


def test_interrupted_model_is_saved_too(tiny, tmp_path):
    """Without a Laplace approximation: `log_sd` is empty then."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    model = ImpedanceModel(tiny.config).fit(tiny.fitted.fitted.log, stop)
    assert model.report.interrupted
    save_model(model, tmp_path / "model")
    assert load_model(tmp_path / "model").report == model.report
