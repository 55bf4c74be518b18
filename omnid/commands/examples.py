"""Examples at the end of each command's help; a test parses them all."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

# Words after `omnid` of a command without subcommands -> its examples, without `omnid`.
EXAMPLES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "run": (
            "run --config /etc/omnid/omnid.toml",
            "run --log drive.mcap --rig rig.toml --motor simulated",
            "run --lower /dev/video0 --upper /dev/video2 --rig rig.toml",
        ),
        "simulate": ("simulate room", "simulate corridor --light 0.5 --map corridor.omap --set bus.robot=rover"),
        "replay": (
            "replay drive.mcap --rig rig.toml --tum est.txt --cloud map.ply --plan plan.png",
            "replay drive.mcap --record out.mcap --method paper",
            "replay drive.mcap --start-s 60 --seconds 20",
        ),
        "batch": (
            "batch logs/ --out results --rig rig.toml",
            "batch 'logs/2026-*/*.mcap' --out results --jobs 2 --record",
            "batch s3://bucket/*.mcap --out results --dask tcp://scheduler:8786",
        ),
        "demo": ("demo", "demo --drive", "demo --output /tmp/demo --quiet"),
        "eval": (
            "eval est.txt truth.txt",
            "eval est.txt truth.txt --align rigid --json",
            "eval est.txt truth.txt --score hilti",
            "eval map.txt truth.txt --live live.txt",
        ),
        "accept": (
            "accept",
            "accept drive.mcap --rig rig.toml --distance-m 12.34 -o accept.html",
            "accept est.txt --distance-m 12.34 --marks 12.5 60 110",
            "accept --keys marks.txt",
        ),
        "calibrate board": (
            "calibrate board --corners 6x7 --square-mm 25 -o board.pdf",
            "calibrate board --board charuco --corners 5x7 --square-mm 30 --marker-mm 22 "
            "--dictionary 5X5_100 -o board.pdf",
        ),
        "calibrate live": (
            "calibrate live boards/ --corners 6x7 --square-mm 30 --config /etc/omnid/omnid.toml",
            "calibrate live --log boards.mcap --corners 6x7 --square-mm 30",
        ),
        "calibrate camera": ("calibrate camera boards/*.png --corners 6x7 --square-mm 30 -o camera.toml",),
        "calibrate rig": (
            "calibrate rig boards.mcap --corners 6x7 --square-mm 30 -o rig.toml",
            "calibrate rig DIR --board aprilgrid --tags 6x6 --tag-mm 88 --tag-spacing 0.3 -o rig.toml",
        ),
        "calibrate check": ("calibrate check drive.mcap --rig rig.toml",),
        "calibrate drive": ("calibrate drive drive.mcap --rig rig.toml -o better.toml",),
        "calibrate height": ("calibrate height drive.mcap --rig rig.toml --ruler-m 0.92 -o rig.toml",),
        "calibrate mask": ("calibrate mask turn.mcap --rig rig.toml -o rig.toml",),
        "calibrate import": (
            "calibrate import camchain.yaml -o rig.toml",
            "calibrate import --equirectangular 3840x1920 --baseline 0.2 -o rig.toml",
        ),
        "calibrate export": ("calibrate export rig.toml --format kalibr -o camchain.yaml",),
        "cameras": (
            "cameras",
            "cameras --snapshot views --config /etc/omnid/omnid.toml",
            "cameras --snapshot views --log drive.mcap",
        ),
        "arm": ("arm", "arm --robot rover --connect tcp/robot:7447"),
        "stop": ("stop", "stop --robot rover --connect tcp/robot:7447"),
        "drive": ("drive", "drive --robot rover --connect tcp/robot:7447"),
        "goto": ("goto 3 1.5 90", "goto -1.2 0.5 --frame map --robot rover --connect tcp/robot:7447", "goto --cancel"),
        "route teach": ("route teach morning", "route teach morning --replace"),
        "route finish": ("route finish",),
        "route repeat": ("route repeat morning", "route repeat morning --reverse --loops 5 --no-wait"),
        "route stop": ("route stop",),
        "route list": ("route list", "route list --json"),
        "route show": ("route show morning --tum morning.txt",),
        "route delete": ("route delete morning",),
        "listen": (
            "listen",
            "listen --robot rover --connect tcp/robot:7447 --tum path.txt --mcap received.mcap",
        ),
        "view": ("view out.mcap", "view out.mcap -o out.rrd", "view out.mcap --web --port 9090"),
        "web": (
            "web",
            "web --connect tcp/robot:7447",
            "web --listen 0.0.0.0:8447 --token-file /etc/omnid/web-token --config /etc/omnid/omnid.toml",
        ),
        "record": ("record recordings/ --rig rig.toml", "record boards/ --lower /dev/video0 --upper /dev/video2"),
        "report": ("report out.mcap -o report.html",),
        "log info": ("log info recordings/*.mcap",),
        "map build": (
            "map build monday.mcap tuesday.mcap -o place.omap --rig rig.toml",
            "map build wednesday.mcap -o place.omap --extend",
            "map build logs/*.mcap -o site.omap --jobs 4",
        ),
        "map info": ("map info place.omap",),
        "map show": ("map show place.omap -o place.html",),
        "map merge": ("map merge east.omap west.omap -o place.omap",),
        "map tags": (
            "map tags place.omap",
            "map tags drive.mcap --tag 5=0.16 --tag 6=0.16 --map place.omap --localize-only --write tags.toml",
        ),
        "map align": ("map align place.omap --known plan.toml -o building.omap",),
        "map export": ("map export place.omap --grid place.yaml --ply place.ply --plan place.png",),
        "map save": ("map save", "map save --robot rover --connect tcp/robot:7447"),
        "diff": ("diff yesterday.mcap today.mcap",),
        "doctor": ("doctor --config /etc/omnid/omnid.toml",),
        "motor test": (
            "motor test --motor /dev/omnid/motor --config /etc/omnid/omnid.toml",
            "motor test --motor simulated --set motor.protocol=roboteq --write omnid.toml",
        ),
        "config": ("config --minimal > omnid.toml", "config check omnid.toml", "config migrate old.toml > new.toml"),
        "install-service": ("install-service --dry-run", "install-service --page"),
    }
)
_EXAMPLES: Final = "examples:"  # the first line of an epilog


class _ExamplesFormatter(argparse.HelpFormatter):
    """Leaves the lines of the examples as they are, so that they can be copied; wraps all other text."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith(_EXAMPLES):
            return "".join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


def add_examples(parser: argparse.ArgumentParser, words: str = "") -> None:
    """Give a parser and those of its subcommands a description, which is their help, and examples."""
    if words in EXAMPLES:
        parser.formatter_class = _ExamplesFormatter
        parser.epilog = "\n".join((_EXAMPLES, *(f"  omnid {example}" for example in EXAMPLES[words])))
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help or "" for choice in action._choices_actions}
            for name, below in action.choices.items():
                below.description = below.description or f"{helps[name][:1].upper()}{helps[name][1:]}."
                add_examples(below, f"{words} {name}".strip())
