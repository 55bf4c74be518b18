"""What lies where in the viewer."""

from __future__ import annotations

from typing import Any, Final

import rerun.blueprint as rrb

CLOCK: Final = "stamp"  # the timeline
ROBOT: Final = "odom/base_link"  # which the eye goes along with
EYE_M: Final = (-5.0, -4.0, 8.0)  # from behind, the right and above


def layout(image: str, depth: bool) -> Any:
    """The world at the left, what there is of images at the right, plots below them.

    image: the title of the images, '' where there are none.
    """
    seen = [_image("panorama", image)] * bool(image) + [_image("depth", "Depth")] * depth
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(_world(), rrb.Vertical(*seen, _told()), column_shares=[5, 4]),
            rrb.Horizontal(
                rrb.Vertical(_plot("speed"), _plot("turn")),
                rrb.Vertical(_plot("landmarks"), _plot("deviation")),
                _plot("latency", "Latency, ms"),
            ),
            row_shares=[5, 3],
        ),
        rrb.TimePanel(timeline=CLOCK, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False, auto_views=False,
    )


def _world() -> Any:
    """The whole way up to the present, and all else as it is now."""
    until_now = rrb.VisibleTimeRanges(rrb.VisibleTimeRange(
        CLOCK, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()))
    return rrb.Spatial3DView(origin="odom", name="World", overrides={"odom/path": [until_now]},
                             eye_controls=rrb.EyeControls3D(position=EYE_M, look_target=(0.0, 0.0, 0.0),
                                                            eye_up=(0.0, 0.0, 1.0), tracking_entity=ROBOT))


def _image(name: str, title: str) -> Any:
    return rrb.Spatial2DView(origin=name, name=title)


def _told() -> Any:
    return rrb.Tabs(rrb.StateTimelineView(origin="state", name="State"), rrb.TextLogView(origin="log", name="Log"),
                    rrb.TextDocumentView(origin="legend", name="Legend"))


def _plot(name: str, title: str = "") -> Any:
    return rrb.TimeSeriesView(origin=name, name=title or name.capitalize())
