"""`omnid web`: a page about a robot, for browsers on this machine or in its network."""

from __future__ import annotations

import argparse
from pathlib import Path

from omnid.commands.options import ROBOT, SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

PACKAGES = ("prometheus_client", "starlette", "uvicorn")


@command(
    *ROBOT,
    option(
        "--listen",
        default="127.0.0.1:8447",
        metavar="HOST:PORT",
        help="where browsers connect; default %(default)s, this machine only; 0.0.0.0:8447 for its network",
    ),
    option(
        "--token-file",
        type=Path,
        metavar="FILE",
        help="the token; the file is made if it is missing; default: a new token at each start",
    ),
    option(
        "--stop-token-file",
        type=Path,
        metavar="FILE",
        help="a second token, which may see and stop, not arm; the file is made if it is missing; default: none",
    ),
    option(
        "--host",
        action="append",
        default=[],
        metavar="NAME",
        help="a further name of this machine, in addresses of browsers; without --listen on the network: "
        "localhost only",
    ),
    option("--tls-certificate", type=Path, metavar="FILE", help="serve over TLS; PEM"),
    option("--tls-key", type=Path, metavar="FILE", help="the private key of the certificate, PEM"),
    *SETTINGS,
    examples=(
        "web",
        "web --connect tcp/robot:7447",
        "web --listen 0.0.0.0:8447 --token-file /etc/omnid/web-token --config /etc/omnid/omnid.toml",
    ),
    description="Serve a page about a robot: state, path, map, warnings with their remedy, a stop and an "
    "arm button; /metrics for Prometheus. It prints the address with a token: who knows it may stop and arm the robot.",
)
def run(args: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
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
    import sys
    from importlib.util import find_spec

    missing = [name for name in PACKAGES if find_spec(name) is None]
    if missing:
        raise OmnidError(
            f"omnid web needs {', '.join(missing)}, not installed: {sys.executable} -m pip install {' '.join(missing)}"
        )
