"""A robot, over the bus: `omnid arm`, `stop`, `drive`, `goto`, `route`, `map save`; `route list` is of this machine."""

from __future__ import annotations

import argparse
import math
import select
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from omnid.client import Answer, Driver, NavigationReport, Robot
from omnid.commands.options import ROBOT, SETTINGS, command, settings_of
from omnid.core.navigation.requests import NavigationState, route_name
from omnid.engine.logging_setup import HANDLER
from omnid.engine.process import handle_stop_signals
from omnid.errors import OmnidError
from omnid.formats.route_file import RouteFolder
from omnid.monitor import robot_state
from omnid.monitor.teleop import teleoperate
from omnid.plain_text import utc

NAME: Final = "name NAME  letters, digits, '-' and '_'"


@command(ROBOT, SETTINGS)
def arm(args: argparse.Namespace) -> int:
    """Let the wheels turn, after the robot's start, a stop or a fault; exit code 1: the robot refuses.

    examples:
      arm
      arm --robot rover --connect tcp/robot:7447
    """
    with Robot(settings=settings_of(args).bus) as robot:
        answer = robot.driver().arm()
    print(f"{robot.name} is {answer.text}" if answer.done else f"{robot.name} refuses: {answer.text}")
    return int(not answer.done)


@command(ROBOT, SETTINGS)
def stop(args: argparse.Namespace) -> int:
    """Stop the wheels until `omnid arm`; everyone who can connect may. Exit code 1: it has not confirmed that.

    examples:
      stop
      stop --robot rover --connect tcp/robot:7447
    """
    bus = settings_of(args).bus
    if robot_state.stop(bus):
        print(f"{bus.robot} stops: its wheels stay stopped until `omnid arm`")
        return 0
    print(f"{bus.robot} has not confirmed the stop: use the emergency stop if it drives")
    return 1


@command(ROBOT, SETTINGS)
def drive(args: argparse.Namespace) -> int:
    """Drive a robot by the arrow keys.

    A motion lasts as long as its key is held: terminals repeat keys, and 0.6 s after the last one the wheels stop.
    Space stops them until `a` arms the robot. Speeds are shares of the robot's own limits.

    examples:
      drive
      drive --robot rover --connect tcp/robot:7447
    """
    return teleoperate(settings_of(args).bus)


@command(ROBOT, SETTINGS)
def goto(args: argparse.Namespace) -> int:
    """Drive an armed robot to a pose of its base and wait for the end.

    Ctrl-C, or a terminal that closes, cancels, and it stops. Exit code 0: reached, 1: not reached, 2: refused, as
    by a robot that is not armed.

    pose [X]...            X Y [YAW]: m, m, and deg counter-clockwise; without YAW the heading stays as it comes
    --frame odom|map=odom  frame of the pose: odom begins at the robot's start, map is that of its saved map

    one of:
    --cancel  end what is under way
    --pause   stop until --resume
    --resume  go on after a pause or a fault; it arms the robot, too

    examples:
      goto 3 1.5 90
      goto -1.2 0.5 --frame map --robot rover --connect tcp/robot:7447
      goto --cancel
    """
    verb = next((verb for verb in ("cancel", "pause", "resume") if getattr(args, verb)), None)
    if len(args.pose) not in ((0,) if verb else (2, 3)):
        raise OmnidError("goto: expected X Y [YAW], or one of --cancel, --pause and --resume alone")
    if verb is None:
        heading_rad = math.radians(args.pose[2]) if len(args.pose) == 3 else None
        return _drive(args, lambda driver: driver.goal(args.pose[0], args.pose[1], heading_rad, args.frame))
    return ask(args, *([lambda driver: driver.arm()] if verb == "resume" else []), lambda driver: driver.navigate(verb))


@command(NAME, ROBOT, SETTINGS)
def teach(args: argparse.Namespace) -> int:
    """Record a route while somebody drives (`omnid drive`, a joystick): Enter writes it, Ctrl-C drops it.

    --replace  in the place of a route of that name, which stays until the new one is written; without it an existing
        name is refused

    examples:
      route teach morning
      route teach morning --replace
    """
    name = route_name(args.name)
    with Robot(settings=settings_of(args).bus) as robot:
        # 1. Begin.
        driver = robot.driver()
        granted(robot, driver.route(f"teach {name} replace" if args.replace else f"teach {name}"))
        reports = robot.subscribe(NavigationReport)
        print(f"records {name}: drive it; Enter writes it, Ctrl-C drops it", flush=True)
        # 2. Show its length until Ctrl-C, or until Enter finds it long enough.
        try:
            while True:
                while not select.select([sys.stdin], [], [], 0)[0]:
                    report = reports.wait(robot_state.REPEAT_S)
                    if report is not None and report.teaching != name:
                        raise OmnidError(f"the recording of {name} has ended: {report.refusal or 'by another program'}")
                    if report is not None:
                        HANDLER.show(f"{report.taught_m:.1f} m")
                is_open, finished = bool(sys.stdin.readline()), driver.route("finish")
                if finished.done or not is_open:
                    granted(robot, finished)
                    outcome, code = "written", 0
                    break
                print(finished.text, flush=True)
        except KeyboardInterrupt:
            driver.route("stop")
            outcome, code = "dropped", 130
    HANDLER.show("")
    print(f"{name} is {outcome}")
    return code


@command(NAME, ROBOT, SETTINGS)
def repeat(args: argparse.Namespace) -> int:
    """Repeat a route, from where the robot is on it, within 1.5 m; exit code 1: its end was not reached, 2: it refuses.

    --reverse             from its end to its start
    --loops N=1 1..10000  a closed route is driven in rounds, another there and back, N times in all

    examples:
      route repeat morning
      route repeat morning --reverse --loops 5
    """
    words = ["repeat", route_name(args.name), *(["reverse"] if args.reverse else [])]
    text = " ".join([*words, f"loops={args.loops}"])
    return _drive(args, lambda driver: driver.route(text))


@command(ROBOT, SETTINGS)
def end_route(args: argparse.Namespace) -> int:
    """End the repetition, or the recording without a file.

    examples:
      route stop
    """
    return ask(args, lambda driver: driver.route("stop"))


@command(ROBOT, SETTINGS)
def save_map(args: argparse.Namespace) -> int:
    """Ask a robot to save its map now, before it is switched off, and print what became of it.

    examples:
      map save
      map save --robot rover --connect tcp/robot:7447
    """
    return ask(args, lambda driver: driver.save_map())


@command(SETTINGS)
def list_routes(args: argparse.Namespace) -> int:
    """List the routes in navigation.routes, here; exit code 2: a file is damaged.

    examples:
      route list
    """
    folder = RouteFolder(Path(settings_of(args).navigation.routes))
    routes = list(map(folder.read, folder.names()))
    for route in routes:
        print(f"{route.name:<20} {route.length_m:8.1f} m  {utc(route.created_s * 10**9)}  {route.map_name}")
    if not routes:
        print(f"no routes in {folder.folder} (navigation.routes)")
    return 0


def ask(args: argparse.Namespace, *requests: Callable[[Driver], Answer]) -> int:
    """Send requests to the robot, one after the other, and print the last answer. Raise OmnidError with a refusal."""
    with Robot(settings=settings_of(args).bus) as robot:
        driver = robot.driver()
        answers = [granted(robot, request(driver)) for request in requests]
    print(answers[-1])
    return 0


def granted(robot: Robot, answer: Answer) -> str:
    """Return what the answer says. Raise OmnidError with the refusal."""
    if not answer.done:
        raise OmnidError(f"the robot {robot.name} refuses: {answer.text}")
    return answer.text


def _drive(args: argparse.Namespace, request: Callable[[Driver], Answer]) -> int:
    """Ask for a drive and print its states until its end.

    A terminal also shows what is left. Ctrl-C, a terminal that closes and other ends of this program cancel the drive,
    also while the robot has not answered yet.
    """
    report, shown = NavigationReport(), ""
    with Robot(settings=settings_of(args).bus) as robot:
        driver = robot.driver()
        try:
            with handle_stop_signals(signal.default_int_handler):
                granted(robot, request(driver))
                for report in robot_state.reports_of(robot, driver.asked_ns):
                    if report.words != shown and report.command_ns == driver.asked_ns:
                        HANDLER.show("")
                        print(report.words, flush=True)
                    shown = report.words
                    HANDLER.show(f"{report.left_m:.2f} m left" if math.isfinite(report.left_m) else "")
        except KeyboardInterrupt:
            words = granted(robot, driver.navigate("cancel"))  # before a word is printed: the terminal may be gone
            HANDLER.show("")
            print(words)
            return 1
    HANDLER.show("")
    if report.command_ns != driver.asked_ns:
        print(f"not reached: {robot.name} follows another request now: {report.task}")
        return 1
    return int(report.state != NavigationState.REACHED)
