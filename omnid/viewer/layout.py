"""Layout of the viewer."""

from __future__ import annotations

from typing import Any, Final

import rerun.blueprint as rrb

TIMELINE: Final = "stamp"
EYE_M: Final = (-5.0, -4.0, 8.0)  # behind the start, to the right and above; an eye that follows an entity falls to 1 m


def layout(image: str, depth: bool) -> Any:
    """Return the blueprint: the world on the left, images on the right, plots below.

    image: title of the images, "" where there are none.
    """
    images = [_image("panorama", image)] if image else []
    if depth:
        images.append(_image("depth", "Depth"))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(_world(), rrb.Vertical(*images, _texts()), column_shares=[5, 4]),
            rrb.Horizontal(
                rrb.Vertical(_plot("speed", "Speed"), _plot("yaw_rate", "Yaw rate")),
                rrb.Vertical(_plot("landmarks", "Landmarks"), _plot("sigma", "Standard deviation")),
                rrb.Vertical(_plot("latency", "Latency, ms"), _plot("correction", "Correction by the map")),
            ),
            row_shares=[5, 3],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _world() -> Any:
    """The path up to the current time, and everything else as of that time."""
    until_now = rrb.VisibleTimeRanges(
        rrb.VisibleTimeRange(
            TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
        )
    )
    return rrb.Spatial3DView(
        origin="odom",
        name="World",
        overrides={"odom/path": [until_now]},
        eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=(0.0, 0.0, 0.0), eye_up=(0.0, 0.0, 1.0)),
    )


def _image(name: str, title: str) -> Any:
    return rrb.Spatial2DView(origin=name, name=title)


def _texts() -> Any:
    return rrb.Tabs(
        rrb.StateTimelineView(origin="state", name="State"),
        rrb.TextLogView(origin="log", name="Log"),
        rrb.TextDocumentView(origin="legend", name="Legend"),
    )


def _plot(name: str, title: str) -> Any:
    return rrb.TimeSeriesView(origin=name, name=title)
