"""Fixtures for every test."""

from pathlib import Path

import pytest


@pytest.fixture
def shared_data() -> Path:
    """Folder of the real recordings; skips where they are absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not at hand: no folder {folder}")
    return folder
