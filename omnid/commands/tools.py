"""Commands about settings and runs: `omnid config`, `listen`, `web`."""

from __future__ import annotations

import argparse
import sys
from importlib.util import find_spec

from drivers.motors.protocols.protocol_registry import motor_protocol
from omnid.commands.options import ROBOT, SECONDS, SETTINGS, command, settings_of
from omnid.config import FIRST_SETTINGS, Config
from omnid.errors import OmnidError
from omnid.monitor.listen import listen as listen_to
from omnid.settings import changed, dump, dump_minimal, value_at
from omnid.transport.session import zenoh_config


@command(SETTINGS)
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
    config = settings_of(args)
    if args.action == "print":
        print(dump_minimal(config, FIRST_SETTINGS) if args.minimal else dump(config), end="")
        return 0
    # Words that only the daemon's start would refuse.
    zenoh_config(config.bus)
    motor_protocol(config.motor.protocol)
    paths = changed(config)
    print(f"{args.file}: good; {len(paths)} settings differ from their defaults")
    for path in paths:
        print(f"{path} = {value_at(config, path)!r}, default {value_at(Config(), path)!r}")
    return 0


@command(ROBOT, SECONDS, SETTINGS)
def listen(args: argparse.Namespace) -> int:
    """Show pose, state, rates and latencies of a robot; exit code 1: no pose was received.

    examples:
      listen
      listen --robot rover --connect tcp/robot:7447 --seconds 60
    """
    return listen_to(settings_of(args).bus, args.seconds)


PACKAGES = ("prometheus_client", "starlette", "uvicorn")


@command(ROBOT, SETTINGS)
def web(args: argparse.Namespace) -> int:
    """Serve a page about a robot: state, path, map, warnings with their remedy, a stop and an arm button.

    /metrics is for Prometheus. It prints the address with a token: who knows it may stop and arm the robot.

    --listen HOST:PORT=127.0.0.1:8447  where browsers connect, this machine only; 0.0.0.0:8447 for its network
    --token-file FILE       the token; the file is made if it is missing; default: a new token at each start
    --stop-token-file FILE  a second token, which may see and stop, not arm; the file is made if it is missing; default:
        none
    --host NAME...          a further name of this machine, in addresses of browsers; without --listen on the network:
        localhost only
    --tls-certificate FILE  serve over TLS; PEM
    --tls-key FILE          the private key of the certificate, PEM

    examples:
      web
      web --connect tcp/robot:7447
      web --listen 0.0.0.0:8447 --token-file /etc/omnid/web-token --config /etc/omnid/omnid.toml
    """
    require_packages()
    from omnid.web.server import WebSettings, serve

    if (args.tls_certificate is None) != (args.tls_key is None):
        raise OmnidError("--tls-certificate and --tls-key belong together: name both")
    config = settings_of(args)
    tls = (args.tls_certificate, args.tls_key) if args.tls_key else None
    serve(config.bus, WebSettings(args.listen, args.token_file, args.stop_token_file, tuple(args.host), tls))
    return 0


def require_packages() -> None:
    """Raise OmnidError where a package of the page is missing."""
    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise OmnidError(
            f"omnid web needs {', '.join(missing)}, not installed: {sys.executable} -m pip install {' '.join(missing)}"
        )
