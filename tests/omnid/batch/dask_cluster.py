"""A dask scheduler on this machine with two workers, as programs of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def dask_cluster(folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """Run a scheduler and two workers; yield its address and the workers."""
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with ExitStack() as ends:
        known = folder / "scheduler.json"
        scheduler = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "distributed.cli.dask_scheduler",
                "--host",
                "127.0.0.1",
                "--port",
                "0",
                "--no-dashboard",
                "--scheduler-file",
                str(known),
            ],
            **quiet,
        )
        ends.callback(scheduler.wait)
        ends.callback(scheduler.kill)
        while not known.exists():
            assert scheduler.poll() is None, "the scheduler has ended"
            time.sleep(0.1)
        address = json.loads(known.read_text())["address"]
        workers = [
            subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "distributed.cli.dask_worker",
                    address,
                    "--nthreads",
                    "1",
                    "--no-dashboard",
                    "--no-nanny",
                    "--local-directory",
                    str(folder),
                ],
                **quiet,
            )
            for _ in range(2)
        ]
        for worker in workers:
            ends.callback(worker.wait)
            ends.callback(worker.kill)
        yield address, workers
