"""The script of the charts, and the policy that lets a page run it and nothing else."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib.resources import files


@cache
def chart_script() -> str:
    """Return the script: values at the pointer, zoom."""
    return (files("omnid.report") / "charts.js").read_text("utf-8")


def policy(script: str) -> str:
    """Return the Content-Security-Policy of a page with this script, "" for none.

    A page shows text from logs of unknown origin: it loads nothing, and runs only the script with this digest.
    """
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    allowed = f"; script-src 'sha256-{digest}'" if script else ""
    return f"default-src 'none'; style-src 'unsafe-inline'; img-src data:{allowed}"
