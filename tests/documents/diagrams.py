"""Diagrams of ARCHITECTURE.md: `python -m tests.documents.diagrams` writes docs/images/*.svg from the tables below."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Final

FOLDER: Final = Path(__file__).parents[2] / "docs" / "images"
LINE_PX: Final = 17
HEAD: Final = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"
height="{height}">
<title>{title}</title>
<style>text{{font:13px system-ui,sans-serif;fill:#222}}.small{{font-size:11.5px;fill:#444}}.box{{fill:#f4f6f8;
stroke:#456;stroke-width:1.3}}.group{{fill:none;stroke:#99a;stroke-dasharray:5 4}}.line{{fill:none;stroke:#234;
stroke-width:1.4;marker-end:url(#end)}}</style>
<defs><marker id="end" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" markerHeight="7" orient="auto">
<path d="M0 0L10 5L0 10z" fill="#234"/></marker></defs>
<rect width="{width}" height="{height}" fill="#fff"/>"""


@dataclass(frozen=True, slots=True)
class Box:
    """A box with lines of text; the first line is its name."""

    x: int
    y: int
    width: int
    text: str

    @property
    def height(self) -> int:
        """Height for the lines."""
        return LINE_PX * (self.text.count("\n") + 1) + 10

    def svg(self) -> str:
        """Return the box and its lines."""
        classes = ["", *[" class='small'"] * self.text.count("\n")]
        texts = [
            f'<text x="{self.x + self.width / 2}" y="{self.y + 18 + LINE_PX * k}" text-anchor="middle"{style}>'
            f"{escape(line)}</text>"
            for k, (line, style) in enumerate(zip(self.text.split("\n"), classes, strict=True))
        ]
        return "\n".join(
            [
                f'<rect class="box" x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="5"/>',
                *texts,
            ]
        )


@dataclass(frozen=True, slots=True)
class Arrow:
    """A line through points (x, y) with a label near one of them."""

    points: tuple[tuple[int, int], ...]
    label: str = ""
    at: tuple[int, int] = (0, 0)

    def svg(self) -> str:
        """Return the line and its label."""
        path = "".join(f"{'L' if k else 'M'}{x} {y}" for k, (x, y) in enumerate(self.points))
        lines = self.label.split("\n") if self.label else []
        texts = [
            f'<text class="small" x="{self.at[0]}" y="{self.at[1] + 14 * k}">{escape(line)}</text>'
            for k, line in enumerate(lines)
        ]
        return "\n".join([f'<path class="line" d="{path}"/>', *texts])


@dataclass(frozen=True, slots=True)
class Group:
    """A dashed frame around what runs together, with its name in the corner."""

    x: int
    y: int
    width: int
    height: int
    text: str

    def svg(self) -> str:
        """Return the frame and its name."""
        return (
            f'<rect class="group" x="{self.x}" y="{self.y}" width="{self.width}" height="{self.height}" rx="8"/>\n'
            f'<text class="small" x="{self.x + 10}" y="{self.y + 16}">{escape(self.text)}</text>'
        )


Part = Box | Arrow | Group
FRAMES: Final[tuple[Part, ...]] = (
    Group(10, 10, 320, 120, "fixed to the world"),
    Group(350, 10, 520, 120, "fixed to the robot"),
    Box(30, 50, 110, "map\nREP 105"),
    Box(200, 50, 110, "odom\nnever jumps"),
    Box(370, 50, 120, "base\nx ahead, z up"),
    Box(560, 50, 120, "rig\nas calibrated"),
    Box(740, 50, 115, "rect\nz: to the upper"),
    Arrow(((140, 72), (200, 72)), "T_map_odom: places", (115, 118)),
    Arrow(((310, 72), (370, 72)), "T_odom_rig: odometry", (275, 162)),
    Arrow(((490, 72), (560, 72)), "T_base_rig: rig file", (470, 118)),
    Arrow(((680, 72), (740, 72)), "T_rig_rect: Geometry", (655, 118)),
    Arrow(((340, 148), (340, 78))),
    Box(
        200,
        180,
        620,
        "covariance of a pose T_a_b: body-fixed, of a small motion [t; r] of b in its own axes\n"
        "turned once into the axes of a, by those who write it for others (core/frames.py: in_outer_axes)",
    ),
)
PAIR: Final[tuple[Part, ...]] = (
    Group(10, 10, 250, 150, "a thread each, SCHED_FIFO; or a log"),
    Box(30, 40, 210, "lower camera"),
    Box(30, 95, 210, "upper camera"),
    Group(290, 10, 190, 210, "one thread"),
    Box(305, 60, 160, "synchronise\nwheels and gyro too"),
    Box(305, 150, 160, "dewarp\nlight, tiles, rig check"),
    Arrow(((240, 56), (305, 74)), "Frame", (262, 48)),
    Arrow(((240, 110), (305, 92))),
    Arrow(((385, 104), (385, 150)), "FramePair", (392, 131)),
    Box(520, 150, 170, "odometry\nkeyframes afterwards"),
    Arrow(((465, 172), (520, 172)), "Panoramas", (486, 145)),
    Box(760, 20, 170, "mapping\ncloud"),
    Box(760, 90, 170, "places\npose in the map"),
    Box(760, 160, 170, "obstacles\nring, moving ones"),
    Box(970, 90, 90, "grid\nmap"),
    Box(760, 235, 170, "navigation\ngoals, paths, routes"),
    Arrow(((690, 160), (725, 160), (725, 42), (760, 42))),
    Arrow(((690, 165), (760, 112))),
    Arrow(((690, 178), (760, 182))),
    Arrow(((690, 188), (725, 188), (725, 257), (760, 257))),
    Arrow(((930, 112), (970, 112))),
    Arrow(((930, 120), (950, 120), (950, 245), (930, 245))),
    Arrow(((845, 204), (845, 235))),
    Box(520, 235, 170, "requests from the bus\nroute files: a ticker"),
    Arrow(((690, 275), (760, 268))),
    Group(290, 300, 790, 125, ""),
    Box(330, 345, 240, "heading, limits, safety rules\ncollision monitor"),
    Box(680, 345, 150, "serial port\nwatchdog"),
    Box(890, 345, 160, "wheels\nstop without commands"),
    Arrow(((605, 194), (605, 222), (490, 222), (490, 345)), "poses", (448, 330)),
    Arrow(((845, 279), (845, 316), (525, 316), (525, 345)), "setpoints", (640, 312)),
    Arrow(((930, 190), (1072, 190), (1072, 332), (545, 332), (545, 345)), "rings", (960, 184)),
    Arrow(((570, 367), (680, 367)), "fixed rate", (596, 361)),
    Arrow(((830, 367), (890, 367))),
    Arrow((), "the controller process: one thread, SCHED_FIFO, which waits for no other", (310, 412)),
    Box(30, 235, 210, "bus, recorder, TUM, PLY, PNG\na thread each"),
    Arrow(((520, 185), (500, 185), (500, 257), (240, 257)), "each message that leaves a stage", (252, 250)),
)
STATES: Final[tuple[Part, ...]] = (
    Box(20, 105, 130, "unchecked\nat the start"),
    Box(360, 20, 130, "fits"),
    Box(360, 85, 130, "drifted"),
    Box(360, 150, 130, "broken\ndegraded at best"),
    Box(360, 235, 130, "exchanged\ndegraded at best"),
    Arrow(((150, 115), (360, 34)), "one round of the first pairs", (60, 60)),
    Arrow(((150, 125), (360, 99))),
    Arrow(((150, 135), (360, 168)), "two rounds in a row that agree", (60, 215)),
    Arrow(((150, 145), (360, 253))),
    Arrow((), "a pose that is lost: rounds as at the start, from any state", (20, 290)),
    Box(650, 75, 220, "check while driving\n16 views of 6 places or more;\nfor broken also the 3 newest alone"),
    Arrow(((650, 95), (490, 34)), "whichever of the three,", (510, 30)),
    Arrow(((650, 105), (490, 99))),
    Arrow(((650, 120), (490, 168)), "or unchecked, it was", (570, 160)),
)
DIAGRAMS: Final[dict[str, tuple[str, int, int, tuple[Part, ...]]]] = {
    "frames": ("Frames of the robot and who gives the transforms between them", 880, 240, FRAMES),
    "pair": ("The way of a pair of images to poses, maps and wheels", 1090, 435, PAIR),
    "rig_states": ("States of the rig", 880, 300, STATES),
}


def diagram(name: str) -> str:
    """Return the SVG of a diagram."""
    title, width, height, parts = DIAGRAMS[name]
    head = HEAD.format(width=width, height=height, title=title)
    return "\n".join([head, *(part.svg() for part in parts), "</svg>\n"])


if __name__ == "__main__":
    for each in DIAGRAMS:
        (FOLDER / f"{each}.svg").write_text(diagram(each))
