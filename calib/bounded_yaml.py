"""YAML of bounded size, plain data only: no anchors and aliases, with which a short text describes a huge value."""

from __future__ import annotations

from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.events import AliasEvent, CollectionEndEvent, CollectionStartEvent, NodeEvent, ScalarEvent

MAX_BYTES: Final = 1 << 15  # enough for MAX_NODES of 16 characters
# Values and lists, because a camera has about 60.
MAX_NODES: Final = 2000
MAX_DEPTH: Final = 16  # Lists and mappings within each other: enough, as those of a camera are four deep.
MAX_SCALAR: Final = 1000  # Characters of a value: enough for names of topics and paths.


def parse_yaml(text: str) -> Any:
    """Parse a YAML text; raise ValueError for one beyond the limits, and ruamel.yaml's error for a malformed one."""
    if len(text) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} characters, found {len(text)}")
    depth = nodes = 0
    # 1. The events name anchors and aliases without resolving them.
    for event in YAML(typ="safe", pure=True).parse(text):
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            raise ValueError(f"expected no anchors and aliases, found {str(event.anchor)[:40]}; write the values out")
        depth += isinstance(event, CollectionStartEvent)
        depth -= isinstance(event, CollectionEndEvent)
        nodes += isinstance(event, NodeEvent)
        if depth > MAX_DEPTH or nodes > MAX_NODES:
            raise ValueError(f"expected at most {MAX_DEPTH} levels and {MAX_NODES} values, found more")
        if isinstance(event, ScalarEvent) and len(event.value) > MAX_SCALAR:
            raise ValueError(f"expected values of at most {MAX_SCALAR} characters, found {len(event.value)}")
    # 2. The values.
    return YAML(typ="safe", pure=True).load(text)
