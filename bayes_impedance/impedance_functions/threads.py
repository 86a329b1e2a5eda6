"""How many threads small tensors get."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Within `with one_thread():` torch computes on one thread; afterwards on as many as before.

    Finding functions is thousands of operations of microseconds, which wait for each other's threads where these have
    to share cores: ten times as long, on a busy machine with two.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
