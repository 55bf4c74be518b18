"""`omnid install-service`: put the systemd unit, the udev rules and a first configuration in their places."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from omnid.commands.options import command, option
from omnid.commands.web import require_packages


@command(
    option("--page", action="store_true", help="also the unit of the page (`omnid web`), for this machine only"),
    option("--dry-run", action="store_true", help="list what would be done, change nothing"),
    option("--yes", action="store_true", help="do not ask"),
    examples=("install-service --dry-run", "install-service --page"),
    description="Install the systemd unit for this program, example udev rules, a minimal configuration and the user "
    "that it runs as. Files that people edit are kept where they exist.",
)
def run(args: argparse.Namespace) -> int:
    """List the steps, ask, and take them; return 1 where the answer is no."""
    from omnid.service import install

    if args.page:
        require_packages()
    program = Path(sys.prefix) / "bin" / "omnid"
    steps = install.steps(program, page=args.page)
    for step in steps:
        print(step.description)
    if args.dry_run:
        return 0
    if not steps:
        print("nothing to do")
        return 0
    if not (args.yes or _agrees()):
        print("nothing was changed")
        return 1
    for step in steps:
        step.act()
    print(install.next_steps(program, page=args.page))
    return 0


def _agrees() -> bool:
    try:
        return input("Do this? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False
