"""Time two functions in turn, A B A B …, so that a machine whose speed drifts treats both alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable


def paired(
    ours: Callable[[], object], theirs: Callable[[], object], rounds: int, calls: int = 1
) -> dict[str, float]:
    """Median seconds a call of both, and the median over rounds of ours / theirs."""
    a, b = [], []
    for _ in range(rounds):
        a.append(_seconds(ours, calls))
        b.append(_seconds(theirs, calls))
    return {
        "ours_seconds": statistics.median(a),
        "theirs_seconds": statistics.median(b),
        "ratio": statistics.median(x / y for x, y in zip(a, b, strict=True)),
    }


def _seconds(function: Callable[[], object], calls: int) -> float:
    # The first call after the other function pays for the threads and the cache that it left behind.
    function()
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls
