"""Installation of omnid as a service, as steps with a description each."""

from __future__ import annotations

import pwd
import re
import shlex
import subprocess
from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Final, NamedTuple

from omnid.config import FIRST_SETTINGS, Config
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.plain_text import plain
from omnid.settings import dump_minimal

ROOT: Final = Path("/")
SHIPPED_PROGRAM: Final = "/opt/omnid/bin/omnid"  # The path of omnid in the shipped units.
# Folders that the units do not see: ProtectHome=, PrivateTmp=.
HIDDEN: Final = ("/home", "/root", "/tmp", "/run/user")
ADD_USER: Final = ("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", "omnid")
NEXT_STEPS: Final = """\
Now enter your ports in /etc/udev/rules.d/90-omnid.rules (`omnid cameras` prints them), copy rig.toml to /etc/omnid,
describe the hardware in /etc/omnid/omnid.toml, and run
  sudo udevadm control --reload && sudo udevadm trigger
  sudo {program} doctor --config /etc/omnid/omnid.toml
  sudo systemctl daemon-reload && sudo systemctl enable --now {units}"""


class Step(NamedTuple):
    """One change of the system."""

    description: str
    act: Callable[[], None]


def service_file(name: str) -> str:
    """Return the text of a file of the folder systemd/, from the installed package or from a clone."""
    packaged = files("omnid.service") / "systemd" / name
    return packaged.read_text() if packaged.is_file() else (Path(__file__).parents[2] / "systemd" / name).read_text()


def steps(program: Path, *, page: bool = False, root: Path = ROOT) -> list[Step]:
    """Return the steps that are still to be taken; OmnidError for a program that the units cannot start.

    page: install the unit of the page as well. root: the folder that stands for the system.
    """
    if any(program.is_relative_to(folder) for folder in HIDDEN):
        raise OmnidError(
            f"{program} is in a folder that the service cannot see: install omnid elsewhere, "
            "such as `sudo python3 -m venv /opt/omnid && sudo /opt/omnid/bin/pip install .`"
        )
    if not re.fullmatch(r"[\w./+-]+", str(program), re.ASCII):
        raise OmnidError(
            f"{plain(str(program))}: the path has characters that a systemd unit cannot name: install omnid "
            f"elsewhere, such as in {Path(SHIPPED_PROGRAM).parents[1]}"
        )
    # 1. The units follow the program; the files that people edit are kept.
    units = ["omnid.service", "omnid-web.service"] if page else ["omnid.service"]
    texts = {f"etc/systemd/system/{unit}": service_file(unit).replace(SHIPPED_PROGRAM, str(program)) for unit in units}
    kept = {
        "etc/udev/rules.d/90-omnid.rules": service_file("90-omnid.rules"),
        "etc/omnid/omnid.toml": dump_minimal(Config(), FIRST_SETTINGS),
    }
    found = []
    for name, text in {**texts, **kept}.items():
        path = root / name
        if not path.exists() or (name in texts and path.read_text("utf-8", "replace") != text):
            verb = "replace" if path.exists() else "write"
            found.append(Step(f"{verb} {path}", partial(_write, path, text)))
    # 2. The user that the units run as.
    if all(entry.pw_name != "omnid" for entry in pwd.getpwall()):
        found.append(Step("add the system user omnid", _add_user))
    return found


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode())
    except (OSError, OmnidError) as error:
        raise OmnidError(f"{path} cannot be written: {error}; run this command with sudo") from error


def _add_user() -> None:
    done = subprocess.run(ADD_USER, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = " ".join(done.stderr.split())
        raise OmnidError(f"the user omnid cannot be added: {reason}; run this command with sudo")


def next_steps(program: Path, *, page: bool = False) -> str:
    """Return instructions for what only the user knows."""
    units = "omnid omnid-web" if page else "omnid"
    return NEXT_STEPS.format(program=shlex.quote(str(program)), units=units)
