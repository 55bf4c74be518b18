"""The wiring of a live run: cameras, stages, sinks, commands and status of the robot."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from calib.rig_file import rig_toml
from drivers.motor import VelocityCommand
from omnid.controller.link import DriveLink
from omnid.core.control.command_sources import PLANNER
from omnid.diagnostics.floor_status import floor_status
from omnid.diagnostics.images_status import ImagesStatus
from omnid.diagnostics.load_ladder import PERIOD_S, LoadLadder
from omnid.diagnostics.motion_status import motion_status
from omnid.diagnostics.places_status import places_status
from omnid.diagnostics.status import Latency, StatusCollector, StatusSources
from omnid.diagnostics.threads_status import ThreadsStatus
from omnid.engine.graph import NEWEST, Sink
from omnid.engine.logging_setup import Report
from omnid.formats.route_file import RouteFolder
from omnid.light.exposure_control import ExposureControl
from omnid.light.grey_levels import UsefulArea
from omnid.messages import OdometryUpdate
from omnid.refinement.refined_file import RefinedRigFile
from omnid.runs.live_commands import NO_PLANNER, LiveCommands
from omnid.runs.live_robot import LiveRobot
from omnid.runs.live_status import add_status_tickers
from omnid.runs.map_saver import MapSaver
from omnid.runs.pipeline import NavigationParts, RecordingSink, RunParts, Sinks, wheel_state, wire
from omnid.runs.place_maps import RunPlaces
from omnid.runs.record import open_recorder
from omnid.runs.rig_checks import LiveRig, live_health
from omnid.runs.route_files import RouteFiles
from omnid.runs.sensor_sources import SensorSources
from omnid.runs.session import TICKERS, Session
from omnid.sinks.bus_sink import BusSink, PanoramaSink
from omnid.sinks.drive import LiveDrive, PlannerDrive, RingToController
from omnid.sinks.recorder import Recorder
from omnid.stages.floor import ADVICE
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.stages.places import Places
from omnid.stages.synchronise import Synchronise
from omnid.transport.bus import Bus
from omnid.transport.navigation_commands import RequestQueue


class LiveWiring:
    """Joins the parts of one run."""

    def __init__(self, session: Session, geometry: Geometry, refined: RefinedRigFile | None, report: Report) -> None:
        """refined: the file of the refined rig; None where the rig is not refined."""
        self._session, self._geometry, self._refined, self._report = session, geometry, refined, report
        self._latency = Latency(session.clock_ns)

    def wire(self, robot: LiveRobot, run_places: RunPlaces) -> None:
        """Join the robot, stages, sinks and tickers."""
        session, geometry, rig = self._session, self._geometry, self._geometry.rig
        config, graph = session.config, session.graph
        # 1. Connections: the wheels, the bus, wheels' and gyro's samples, the recording.
        controller = robot.connect(session)
        bus = session.open_bus(rig, gives_time=robot.waits)
        pairing = Synchronise(rig, config.pair, config.motion.R_base_imu)
        sensors = SensorSources(
            config, pairing.motion, session, controller, self._report, with_images=robot.brings_samples
        )
        sensors.add_to(graph)
        recorder = self._recorder() if config.record.enabled else None
        # 2. From the cameras to pairs.
        frames = robot.sources(graph, pairing.motion.add)
        pairs = graph.stage("pair", pairing, *frames)
        states = robot.states()
        exposure = ExposureControl(UsefulArea(rig, geometry.cylinder), config.cameras, states)
        graph.sink("exposure", exposure, pairs, policy=NEWEST, depth=1)
        # 3. From pairs to poses, maps and setpoints.
        ladder, requests = LoadLadder(), RequestQueue()
        halts = (lambda: controller.statistics.state.halts) if controller else (lambda: 0)
        files = RouteFiles(RouteFolder(Path(config.navigation.routes)), requests.put, halts=halts)
        front_end = FrontEnd(geometry, config, live_health(geometry, config, self._refined), load=lambda: ladder.level)
        live_rig = LiveRig(session, front_end, ladder, self._refined)
        sinks = self._sinks(live_rig, bus, own_time=robot.waits)
        if recorder is not None:
            sinks = replace(sinks, recording=RecordingSink(recorder, tuple(frames), config.record.queue))
        self._warn_of_unstated_height()
        parts = run_places.known_to(
            RunParts(
                load=lambda: ladder.level,
                map_every_s=config.live.cloud_s,
                map_is_read=lambda: recorder is not None or bus.is_received("cloud"),
            )
        )
        if controller:
            sinks.rings["controller-ring"] = RingToController(controller)
            parts = replace(
                parts,
                drive=LiveDrive(controller, rig.T_base_rig, requests.end),
                navigation=self._navigation(controller, requests, bus, files),
            )
        stages = wire(graph, pairs, front_end, config, sinks, parts)
        if config.live.shed_load and not robot.waits:
            graph.ticker("load", PERIOD_S, partial(ladder.observe, graph.telemetry.of("pair")))
        graph.bound("pair", "odometry")  # images that odometry has no time for are dropped before they are decoded
        saver = self._saver(run_places, stages.places, bus)
        if controller:
            graph.ticker("routes", files.PERIOD_S, files)
        if stages.places:
            files.save_map = stages.places.want_copy
        # 4. From the bus: commands, requests, samples.
        received = LiveCommands(session, bus, controller, files.put, self._report)
        received.subscribe(recorder, sensors, saver)
        # 5. Status.
        images = ImagesStatus(geometry, session.statistics, partial(self._report, logging.WARNING))
        status = [
            ladder.status,
            ThreadsStatus(),
            images,
            exposure.status,
            live_rig.status,
            *([received.navigation.status] if controller else ()),
            motion_status(front_end.odometry, pairing.motion, sensors.receiver, sensors.gyro),
            *([partial(places_status, stages.places)] if stages.places else ()),
            *([partial(floor_status, stages.floor)] if stages.floor else ()),
            *robot.status,
            *(part.status for part in (bus, recorder, saver) if part),
        ]
        sources = StatusSources(
            graph.telemetry,
            states,
            pairing,
            session.statistics,
            self._latency.to_pose,
            controller.statistics if controller else None,
            received.commands,
            TICKERS,
            tuple(status),
            session.clock_ns,
        )
        add_status_tickers(session, StatusCollector(sources), bus, recorder)

    def _sinks(self, live_rig: LiveRig, bus: Bus, *, own_time: bool) -> Sinks:
        """Return the sinks of a run that neither drives nor records; own_time: ticks of its wheels give the time."""
        session, config = self._session, self._session.config
        poses: dict[str, Sink[OdometryUpdate]] = {}
        if config.bus.panorama_hz:
            poses["panorama"] = PanoramaSink(bus, config.bus.panorama_hz, session.offset_ns)
        return Sinks(
            poses={**poses, **live_rig.pose_sinks},
            counters={"statistics": session.statistics, "latency": self._latency},
            bus=BusSink(
                bus,
                session.encoder(self._geometry.rig, config.live.cloud_points),
                clock=VelocityCommand if own_time else None,
            ),
        )

    def _warn_of_unstated_height(self) -> None:
        """Warn where the rig does not state its height: until the images show the floor, nothing is called free."""
        if self._geometry.rig.height_m(self._session.config.obstacles.ring.floor_m) is None:
            self._session.warn(
                "the rig states no height of the cameras: the floor is looked for in the images; "
                f"until it is found, map, grid and obstacles call nothing free; {ADVICE}"
            )

    def _saver(self, run_places: RunPlaces, places: Places | None, bus: Bus) -> MapSaver | None:
        """Return what saves the map of places now and then; None where it stays as it is."""
        if places is None or not run_places.is_extended:
            return None
        saver = MapSaver(run_places, places, self._session.config.places.save_s, bus.answer)
        self._session.graph.ticker("save", saver.PERIOD_S, saver)
        return saver

    def _recorder(self) -> Recorder:
        session, rig = self._session, self._geometry.rig
        encode = session.encoder(rig, session.config.record.cloud_points)
        recorder = open_recorder(
            session.config, rig_toml(rig), self._report, encode=encode, offset_ns=session.offset_ns
        )
        session.outputs.callback(recorder.close)
        return recorder

    def _navigation(
        self, controller: DriveLink, requests: RequestQueue, bus: Bus, files: RouteFiles
    ) -> NavigationParts | None:
        """Return the surroundings of the navigation; None, with a warning, where its source may not drive."""
        config = self._session.config
        if PLANNER not in config.controller.sources.names:
            self._session.warn(NO_PLANNER)
            return None
        return NavigationParts(
            requests,
            lambda: wheel_state(controller.statistics.state),
            PlannerDrive(controller, bus.answer, files),
            config.places.map,
        )
