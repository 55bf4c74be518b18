"""Code run in a process of its own with limited memory and time, for inputs that must not fill the memory."""

from __future__ import annotations

import resource
import subprocess
import sys
from functools import partial

MEMORY_BYTES = 1 << 30
TIMEOUT_S = 60.0


def run_limited(code: str, memory_bytes: int = MEMORY_BYTES) -> tuple[str, int]:
    """Run code, then return what it printed and its largest resident memory [MB]; fail where it does not succeed."""
    # Not ru_maxrss: that contains what this process had when it forked.
    code += "\nprint(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1])"
    limit = partial(resource.setrlimit, resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        preexec_fn=limit,
        check=False,
        env={"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    *printed, memory = done.stdout.splitlines()
    return "\n".join(printed), int(memory) // 1024
