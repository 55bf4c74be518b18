"""The wiring: light comes in at the top and leaves as a pose and a motor command at the bottom."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from drivers.frame import Frame
from drivers.motor import VelocityCommand
from omnid.config import Config
from omnid.controller.link import ControllerLink
from omnid.controller.motor import MotorTick
from omnid.engine.graph import NEWEST, Graph, Sink, Stream
from omnid.messages import FramePair, MapUpdate, OdometryUpdate, Panoramas
from omnid.sinks.encoder import Outgoing
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry
from omnid.stages.guidance import Guidance
from omnid.stages.mapping import Mapping
from omnid.stages.odometry import OdometryStage
from omnid.stages.stereo import Stereo


@dataclass(frozen=True, slots=True)
class Sinks:
    """Where the flow goes; what nobody wants is not computed."""

    poses: dict[str, Sink[OdometryUpdate]] = field(default_factory=dict)
    maps: dict[str, Sink[MapUpdate]] = field(default_factory=dict)
    recorder: Sink[Any] | None = None  # of all that is said, and of the images
    bus: Sink[Outgoing] | None = None
    motor: MotorTick | None = None  # of a replay: guidance asks, the tick sends
    helm: ControllerLink | None = None  # of a live robot: it decides by itself, at its own rate, in its own process
    rig: Sink[Panoramas] | None = None  # looks now and then whether the cameras stand as calibrated
    map_every_s: float = 0.0  # between two maps; 0: one, at the end
    images: tuple[Stream[Frame], ...] = ()  # that are recorded as well
    record_depth: int | None = None  # messages of each kind that may wait for the recorder


class WiredStages(NamedTuple):
    """The stages that know what the input is worth and what was left out."""

    stereo: Stereo
    mapping: Mapping | None


def wire(graph: Graph, pairs: Stream[FramePair], geometry: Geometry, config: Config, ends: Sinks) -> WiredStages:
    """Joins the stages from the pairs on; gives those that are asked at the end."""
    stereo = Stereo(geometry, config.stereo)
    panoramas = graph.stage("dewarp", Dewarp(geometry, config.panorama), pairs)
    if ends.rig:
        graph.sink("rig", ends.rig, panoramas, policy=NEWEST, depth=1)
    depths = graph.stage("stereo", stereo, panoramas)
    odometry = graph.stage("odometry", OdometryStage(geometry, config.odometry), depths)
    spoken: dict[str, Stream[Outgoing]] = {
        "bus": odometry, "bus-drive": _commands(graph, odometry, geometry, config, ends)}
    mapping = Mapping(config.mapping, ends.map_every_s) if ends.maps or ends.recorder or ends.bus else None
    if mapping:
        maps: Stream[MapUpdate] = graph.stage("mapping", mapping, odometry)
        spoken["bus-map"] = maps
        for name, file in ends.maps.items():
            graph.sink(name, file, maps)
    for name, sink in ends.poses.items():
        graph.sink(name, sink, odometry)
    if ends.recorder:
        graph.sink("record", ends.recorder, *ends.images, *spoken.values(), depth=ends.record_depth)
    if ends.bus:
        for name, stream in spoken.items():  # one each, for a map takes longer than a pose may wait
            graph.sink(name, ends.bus, stream, policy=NEWEST)
    return WiredStages(stereo, mapping)


def _commands(graph: Graph, odometry: Stream[OdometryUpdate], geometry: Geometry, config: Config, ends: Sinks
              ) -> Stream[VelocityCommand]:
    """What the wheels are told. Their deadline waits for nobody: the newest pose or command lies in a slot."""
    if ends.helm:
        graph.sink("helm", ends.helm, odometry, policy=NEWEST, depth=1)
        return graph.source("drive", ends.helm.told, wake=ends.helm.end)
    commands = graph.stage("guidance", Guidance(config.guidance, geometry.rig.T_base_rig), odometry)
    if ends.motor:
        graph.sink("commands", ends.motor, commands)
        graph.ticker("motor", 1.0 / config.motor.rate_hz, ends.motor)
    return commands
