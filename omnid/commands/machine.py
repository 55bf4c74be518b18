"""Commands about settings and this machine: `omnid config`, `listen`, `web`, `doctor`, `cameras`, `motor test`,
`install-service`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from contextlib import closing
from itertools import chain, islice
from pathlib import Path

from calib.rig_file import png
from drivers.cameras.v4l2_camera import V4l2Camera
from drivers.cameras.v4l2_device import V4l2Settings, capture_devices
from drivers.frame import CAMERAS as SIDES
from drivers.frame import Camera, gray
from drivers.motors.serial_motor import motor_protocol
from omnid.calibration import snapshot
from omnid.calibration.images import Image
from omnid.commands import options
from omnid.config import FIRST_SETTINGS
from omnid.doctor import checks
from omnid.doctor.wheel_wiring import tested_drive
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.light.exposure import USUAL_HZ
from omnid.monitor.robot_state import listen as listen_to
from omnid.service import install
from omnid.settings import dump
from omnid.transport.session import zenoh_config


@options.command(options.SETTINGS)
def print_config(args: argparse.Namespace) -> int:
    """Print all settings with their defaults as TOML; or check a file.

    action [print|check]=print  what to do
    file [FILE]                 of check
    --minimal                   print only what differs from the defaults, and what a new robot needs; all other
        defaults stay those of the installed version

    examples:
      config --minimal > omnid.toml
      config check omnid.toml
    """
    if args.action == "check" and args.file is None:
        raise OmnidError("omnid config check: name the file")
    args.config = args.file or args.config
    config = options.settings_of(args)
    if args.action == "print":
        print(dump(config, FIRST_SETTINGS if args.minimal else None), end="")
        return 0
    # Texts that only the start of the daemon would refuse.
    zenoh_config(config.bus)
    motor_protocol(config.motor.protocol)
    print(f"{args.file}: good")
    return 0


@options.command(options.ROBOT, options.SECONDS, options.SETTINGS)
def listen(args: argparse.Namespace) -> int:
    """Show pose, state, rates and latencies of a robot; exit code 1: no pose was received.

    examples:
      listen
      listen --robot rover --connect tcp/robot:7447 --seconds 60
    """
    return listen_to(options.settings_of(args).bus, args.seconds)


PAGE = ("starlette", "uvicorn")


@options.command(options.ROBOT, options.SETTINGS)
def web(args: argparse.Namespace) -> int:
    """Serve a page about a robot: state, path, map, warnings with their remedy, a stop and an arm button.

    /metrics is for Prometheus. It prints the address with a token: who knows it may stop and arm the robot.

    --listen HOST:PORT=127.0.0.1:8447  where browsers connect, this machine only; 0.0.0.0:8447 for its network
    --token-file FILE       the token; the file is made if it is missing; default: a new token at each start
    --stop-token-file FILE  a second token, which may see and stop, not arm; the file is made if it is missing; default:
        none
    --host NAME...          a further name of this machine, in addresses of browsers; without --listen on the network:
        localhost only

    examples:
      web
      web --connect tcp/robot:7447
      web --listen 0.0.0.0:8447 --token-file /etc/omnid/web-token --config /etc/omnid/omnid.toml
    """
    options.require("web", *PAGE)
    from omnid.web.server import serve

    serve(options.settings_of(args).bus, args.listen, args.token_file, args.stop_token_file, tuple(args.host))
    return 0


ROOT = Path("/")  # folder of sys, dev and proc
BYTES_PER_PIXEL = 0.2  # of a JPEG of quality 90 from below a mirror


@options.command(options.SETTINGS)
def doctor(args: argparse.Namespace) -> int:
    """Check cameras, motor, rig, rights, bus and disk, a line each; exit code 1: something is wrong.

    examples:
      doctor --config /etc/omnid/omnid.toml
    """
    config, found = options.settings_of(args), list[checks.Finding]()
    camera, wanted = config.cameras, config.realtime
    images_hz = min(camera.rate_hz or USUAL_HZ, config.record.images_hz or math.inf)
    rate = 2 * camera.width_px * camera.height_px * BYTES_PER_PIXEL * images_hz
    for finding in chain(
        checks.cameras({name: camera.settings(name) for name in SIDES}, capture_devices(ROOT), ROOT),
        checks.rig(Path(camera.rig), (camera.width_px, camera.height_px), config.obstacles.scan.floor_m),
        checks.motor(config.motor, ROOT),
        checks.disk(checks.STATE / config.record.folder, config.record, rate),
        [checks.rights(max(wanted.motor_priority, wanted.capture_priority)), checks.bus(config.bus)],
    ):
        print(finding, flush=True)
        found.append(finding)
    counts = Counter(finding.level for finding in found)
    print(f"{counts['error']} errors, {counts['warning']} warnings, {counts['ok']} ok")
    return int(counts["error"] > 0)


@options.command(options.SETTINGS)
def show_cameras(args: argparse.Namespace) -> int:
    """List cameras and the persistent names of their ports.

    With --snapshot write an image of each configured camera with the mirror's rim, and print a measure of its focus,
    which is highest where the lens is set best. Exit code 1: there is no camera.

    --snapshot DIR  write DIR/lower.png and DIR/upper.png

    examples:
      cameras
      cameras --snapshot views --config /etc/omnid/omnid.toml
    """
    if args.snapshot is not None:
        return _snapshot(args)
    devices = capture_devices(ROOT)
    if not devices:
        return options.failed("no cameras: the kernel has no capture device; check the cables, and `dmesg`")
    for device in devices:
        print(f"{device.node}  {device.name}")
        for line in filter(None, (device.by_path, device.problem)):
            print(f"  {line}")
    print(f"\nThe modes of a camera: v4l2-ctl -d {devices[0].node} --list-formats-ext")
    print("Set cameras.lower and cameras.upper to names by-path, or enter these ports in udev/rules.d/90-omnid.rules")
    return 0


def _snapshot(args: argparse.Namespace) -> int:
    config = options.settings_of(args)
    args.snapshot.mkdir(parents=True, exist_ok=True)
    for camera in SIDES:
        found = _images(config.cameras.settings(camera), camera)
        if not found:
            raise OmnidError(f"the {camera} camera gave no image: check its cable, and see `omnid doctor`")
        view = snapshot.view_of(found)
        path = args.snapshot / f"{camera}.png"
        write_whole(path, png(snapshot.annotated(view)))
        print(f"{path}: {snapshot.described(view)}")
    return 0


def _images(settings: V4l2Settings, camera: Camera) -> list[Image]:
    """Return images of a camera once its exposure has adapted; fewer where it gives none in time."""

    def end_when_lost(_: int, __: str) -> None:
        if source.state.status == "lost":
            source.close()

    with closing(V4l2Camera(settings, camera, on_event=end_when_lost)) as source:
        return [gray(frame) for frame in islice(source.frames(), snapshot.IMAGES, 2 * snapshot.IMAGES)]


@options.command(options.SETTINGS)
def test_motor(args: argparse.Namespace) -> int:
    """Turn each wheel, ask what moved, print the settings for that.

    It turns each motor forwards and back, and asks which wheel moved and which way. It prints the lines of the
    configuration that make the wheels turn as commanded.

    --motor PORT [motor.port]  serial port of the controller, or 'simulated'; default: motor.port of the settings
    --speed MPS=0.1            of a wheel, m/s

    examples:
      motor test --motor /dev/omnid/motor --config /etc/omnid/omnid.toml
      motor test --motor simulated --set motor.protocol=roboteq
    """
    config = options.settings_of(args).motor
    if not config.port:
        raise OmnidError("no motor controller is configured: name its port by --motor, or set motor.port")
    motor_protocol(config.protocol)  # known before anybody is asked to raise the robot
    drive = tested_drive(config, ask, speed_mps=args.speed)
    keys = ("swapped", "reverse_left", "reverse_right")
    print("\n[motor.drive]", *(f"{key} = {str(getattr(drive, key)).lower()}" for key in keys), sep="\n")
    print("as it was set" if drive == config.drive else "different from the settings so far")
    return 0


def ask(question: str) -> str:
    """Print a question and return the answer. Raise OmnidError at the end of the input."""
    try:
        return input(question).strip()
    except EOFError:
        raise OmnidError("no answer: nothing more is done, and the wheels are stopped") from None


@options.command()
def install_service(args: argparse.Namespace) -> int:
    """Install the systemd unit for this program, example udev rules and a minimal configuration.

    Files that people edit are kept where they exist. Exit code 1: the answer to the question was no.

    --page     also the unit of the page (`omnid web`), for this machine only
    --dry-run  list what would be done, change nothing
    --yes      do not ask

    examples:
      install-service --dry-run
      install-service --page
    """
    if args.page:
        options.require("web", *PAGE)
    program = Path(sys.prefix) / "bin" / "omnid"
    texts = install.files_to_write(program, page=args.page)
    for path in texts:
        print(f"write {path}")
    if args.dry_run:
        return 0
    if not texts:
        print("nothing to do")
        return 0
    if not args.yes and ask("Do this? [y/N] ").lower() not in ("y", "yes"):
        print("nothing was changed")
        return 1
    install.write(texts)
    print(install.NEXT_STEPS.format(program=program, units="omnid omnid-web" if args.page else "omnid"))
    return 0
