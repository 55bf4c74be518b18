"""Commands to a robot over the bus: `omnid arm`, `stop`, `drive`, `goto`, `route`."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Final

from omnid.client import Answer, Driver
from omnid.commands.options import ROBOT, SETTINGS, command, settings_of
from omnid.core.navigation.requests import route_name
from omnid.errors import OmnidError
from omnid.monitor import navigation
from omnid.monitor.navigation import connected, drive_to_end, granted, record_until_enter
from omnid.monitor.teleop import teleoperate

NAME: Final = "name NAME  letters, digits, '-' and '_'"
NO_WAIT: Final = "--no-wait  end as soon as the robot has accepted it"


@command(ROBOT, SETTINGS)
def arm(args: argparse.Namespace) -> int:
    """Let the wheels turn, after the robot's start, a stop or a fault; exit code 1: the robot refuses.

    examples:
      arm
      arm --robot rover --connect tcp/robot:7447
    """
    with connected(settings_of(args).bus) as robot:
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
    if navigation.stop(bus):
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


@command(NO_WAIT, ROBOT, SETTINGS)
def goto(args: argparse.Namespace) -> int:
    """Drive an armed robot to a pose of its base and wait for the end.

    Ctrl-C, or a terminal that closes, cancels, and it stops. Exit code 0: reached, 1: not reached, 2: refused, as
    by a robot that is not armed.

    pose [X]...            X Y [YAW]: m, m, and deg counter-clockwise; without YAW the heading stays as it comes
    --frame odom|map=odom  frame of the pose: odom begins at the robot's start, map is that of its saved map

    one of:
    --cancel  end what is under way
    --pause   halt
    --resume  go on after a halt or a fault; it arms the robot, too

    examples:
      goto 3 1.5 90
      goto -1.2 0.5 --frame map --robot rover --connect tcp/robot:7447
      goto --cancel
    """
    verb = next((verb for verb in ("cancel", "pause", "resume") if getattr(args, verb)), None)
    if verb and args.pose:
        raise OmnidError(f"goto: --{verb} takes no pose: leave one of them out")
    if verb is None and len(args.pose) not in (2, 3):
        raise OmnidError(f"goto: expected X Y [YAW], numbers found: {len(args.pose)}")
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
    with connected(settings_of(args).bus) as robot:
        granted(robot, robot.driver().route(f"teach {name} replace" if args.replace else f"teach {name}"))
        return record_until_enter(robot, name)


@command(NAME, NO_WAIT, ROBOT, SETTINGS)
def repeat(args: argparse.Namespace) -> int:
    """Repeat a route, from where the robot is on it; exit code 1: its end was not reached, 2: it refuses.

    --reverse               from its end to its start
    --loops N=1 1..10000    a closed route is driven in rounds, another there and back, N times in all
    --from here|start=here  here: from where the robot is on the route, anywhere within 1.5 m of it; start: the whole
        route, refused elsewhere

    examples:
      route repeat morning
      route repeat morning --reverse --loops 5 --no-wait
    """
    words = ["repeat", route_name(args.name), *(["reverse"] if args.reverse else [])]
    text = " ".join([*words, f"loops={args.loops}", f"from={vars(args)['from']}"])
    return _drive(args, lambda driver: driver.route(text))


@command(ROBOT, SETTINGS)
def end_route(args: argparse.Namespace) -> int:
    """End the repetition, or the recording without a file.

    examples:
      route stop
    """
    return ask(args, lambda driver: driver.route("stop"))


def ask(args: argparse.Namespace, *requests: Callable[[Driver], Answer]) -> int:
    """Send requests to the robot, one after the other, and print the last answer. Raise OmnidError with a refusal."""
    with connected(settings_of(args).bus) as robot:
        driver = robot.driver()
        answers = [granted(robot, request(driver)) for request in requests]
    print(answers[-1])
    return 0


def _drive(args: argparse.Namespace, request: Callable[[Driver], Answer]) -> int:
    """Ask for a drive and show it until its end, or with --no-wait until the robot has accepted it."""
    with connected(settings_of(args).bus) as robot:
        driver = robot.driver()
        if not args.no_wait:
            return drive_to_end(robot, driver, lambda: request(driver))
        granted(robot, request(driver))
        return 0
