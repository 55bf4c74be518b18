"""The policy of a page: nothing is loaded, and only its own script runs."""

from __future__ import annotations

import base64
import hashlib

from omnid.report.page_script import chart_script, policy


def test_only_the_script_with_this_digest_is_allowed() -> None:
    digest = base64.b64encode(hashlib.sha256(b"a()").digest()).decode()
    assert policy("a()") == f"{policy('')}; script-src 'sha256-{digest}'"
    assert policy("").startswith("default-src 'none'; ") and "script-src" not in policy("")


def test_the_script_can_stand_in_a_page() -> None:
    assert "</script" not in chart_script() and "addEventListener" in chart_script()
