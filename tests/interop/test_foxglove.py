"""The layout for Foxglove has the names and values that Foxglove's own SDK writes (foxglove-sdk 0.30)."""

from __future__ import annotations

import inspect
import json
import re
from importlib.resources import files
from typing import Any

import pytest

layouts = pytest.importorskip("foxglove.layouts", reason="needs foxglove-sdk")
pytestmark = pytest.mark.interop

PANELS = {
    "3D": "ThreeDeeConfig",
    "Image": "ImageConfig",
    "DiagnosticSummary": "DiagnosticsSummaryConfig",
    "Plot": "PlotConfig",
}
TOPICS = {
    "map": "RosOccupancyGrid",
    "cloud": "PointCloud",
    "odom": "Pose",
    "plan": "Poses",
    "scan": "LaserScan",
}
OF_THE_APP = {"foxglovePanelTitle"}  # in its exported files, beside the settings of every panel
PARTS = {
    "cameraState": "ThreeDeeCameraState",
    "scene": "BaseRendererSceneSettings",
    "transforms": "BaseRendererTransforms",
    "imageMode": "ImageModeConfig",
    "paths": "PlotSeries",
    "grid": "BaseRendererGridLayerSettings",
}


def names(kind: str) -> dict[str, str]:
    """Return the names of a class's settings in JSON, with their types."""
    found = getattr(layouts, kind)
    source = "".join(inspect.getsource(part) for part in found.__mro__[:-1])
    types = {name: str(field.type) for name, field in found.__dataclass_fields__.items()}
    return {name: types[own] for name, own in re.findall(r'"(\w+)": [^\n]*?self\.(\w+)', source) if own in types}


def check(where: str, settings: dict[str, Any], kind: str) -> list[str]:
    """Return the settings that a class does not have, or not with such a value, in words."""
    known, wrong = names(kind), list[str]()
    for name, value in settings.items():
        choices = re.findall(r"Literal\[(.*?)\]", known.get(name, ""))
        if name in OF_THE_APP:
            continue
        if name not in known:
            wrong.append(f"{where}: {kind} has no {name}")
        elif choices and isinstance(value, str) and f"'{value}'" not in choices[0].replace('"', "'"):
            wrong.append(f"{where}: {name} = {value}: expected {choices[0]}")
        elif name == "topics":
            for topic, more in value.items():
                kind_of_topic = f"BaseRenderer{TOPICS[topic.rpartition('/')[2]]}TopicSettings"
                wrong += check(f"{where} {topic}", more, kind_of_topic)
        elif name == "layers":
            wrong += [text for layer, more in value.items() for text in check(f"{where} {layer}", more, PARTS[layer])]
        elif name in PARTS:
            for part in value if isinstance(value, list) else [value]:
                wrong += check(f"{where} {name}", part, PARTS[name])
    return wrong


def test_all_settings_of_the_layout_are_known_to_foxglove() -> None:
    layout = json.loads((files("omnid.viewer") / "foxglove.json").read_text())
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    wrong = [
        text
        for panel, settings in layout["configById"].items()
        for text in check(panel, settings, PANELS[panel.partition("!")[0]])
    ]
    assert wrong == []
