"""The lines of a running training: the metrics of the steps since the last line, and the clock."""

from __future__ import annotations

import time
from typing import Any

import jax

from ciassd_jax.training import distributed
from ciassd_jax.training.metrics import describe_metrics, summarise
from ciassd_jax.training.record import Record


class Progress:
    """Collects the metrics of steps of `scenes` scenes each, and writes a line on them to the record.

    `step` and `skipped` are those of the state at the start. The time to the end is estimated by the mean pace since
    the first step of this call, in which saving and evaluation take part. Only process 0 has a record.
    """

    def __init__(self, record: Record | None, step: int, total: int, scenes: int, skipped: int) -> None:
        self._record, self._first, self._total, self._scenes = record, step, total, scenes
        self._skipped, self.skipped_in_a_row = skipped, 0
        self._pending: list[dict[str, Any]] = []
        self._start = self._since = time.perf_counter()

    def start(self) -> None:
        """Start the clock of the first step."""
        self._start = self._since = time.perf_counter()

    def skip_pause(self) -> None:
        """Leave the time since the last line out of the time per step."""
        self._since = time.perf_counter()

    def add(self, metrics: dict[str, Any]) -> None:
        """Add the metrics of a step, when the step before is finished: at most one step runs ahead of the host."""
        jax.block_until_ready(self._pending[-1:])
        self._pending.append(metrics)

    def write(self, step: int, epoch: float) -> None:
        """Write and log one line on the steps since the last line, if there is any."""
        if not self._pending:
            return
        rows, self._pending = jax.device_get(self._pending), []
        skipped, self._skipped = int(rows[-1]["skipped"]) - self._skipped, int(rows[-1]["skipped"])
        self.skipped_in_a_row = self.skipped_in_a_row + skipped if skipped == len(rows) else 0
        now = time.perf_counter()
        numbers = summarise(rows) | {"epoch": epoch, "seconds": (now - self._since) / len(rows)}
        remaining = (now - self._start) / (step - self._first) * (self._total - step)
        self._since = now

        def tell(record: Record) -> None:
            record.write(step, numbers)
            record.log(describe_metrics(step, self._total, numbers, scenes=self._scenes, remaining=remaining))

        distributed.on_process_0(lambda: tell(self._record) if self._record is not None else None)
