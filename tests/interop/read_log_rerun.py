"""Print every message of an MCAP log as Rerun's viewer reads it, one line of JSON each. For rerun-sdk 0.41.

    python read_log_rerun.py FILE.mcap
Bytes are printed as length and SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import sys
from typing import Any

import pyarrow
from rerun.chunk import McapReader

TIME = "message_log_time"


def plain(values: Any) -> Any:
    """Return the values of a cell, bytes as their digest."""
    if pyarrow.types.is_uint8(values.type.value_type if hasattr(values.type, "value_type") else values.type):
        data = bytes(values.as_py())
        return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return values.as_py()


def cell(scalar: Any) -> Any:
    """Return the entries of a column for one message: one, or one per instance."""
    return [plain(value) for value in scalar.values] if scalar.is_valid else None


for chunk in McapReader(sys.argv[1]).stream():
    batch = chunk.to_record_batch()
    names = batch.schema.names
    if TIME in names:
        parts = [name for name in names if pyarrow.types.is_list(batch.schema.field(name).type)]
        for row in range(batch.num_rows):
            row_parts = {name: cell(batch.column(name)[row]) for name in parts}
            print(json.dumps({"topic": chunk.entity_path, "log_ns": batch.column(TIME)[row].value, "parts": row_parts}))
