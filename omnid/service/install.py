"""Installation of omnid as a service: the files that are written, and what the user does then."""

from __future__ import annotations

import re
from importlib.resources import files
from pathlib import Path
from typing import Final

from omnid.config import FIRST_SETTINGS, Config
from omnid.errors import OmnidError
from omnid.formats.exports import write_whole
from omnid.plain_text import plain
from omnid.settings import dump

SHIPPED_PROGRAM: Final = "/opt/omnid/bin/omnid"  # The path of omnid in the shipped units.
# Folders that the units do not see: ProtectHome=, PrivateTmp=.
HIDDEN: Final = ("/home", "/root", "/tmp", "/run/user")
NEXT_STEPS: Final = """\
Now enter your ports in /etc/udev/rules.d/90-omnid.rules (`omnid cameras` prints them), copy rig.toml to /etc/omnid,
describe the hardware in /etc/omnid/omnid.toml, and run
  id omnid || sudo useradd --system --no-create-home --shell /usr/sbin/nologin omnid
  sudo udevadm control --reload && sudo udevadm trigger
  sudo {program} doctor --config /etc/omnid/omnid.toml
  sudo systemctl daemon-reload && sudo systemctl enable --now {units}"""


def service_file(name: str) -> str:
    """Return the text of a file of the folder systemd/, from the installed package or from a clone."""
    packaged = files("omnid.service") / "systemd" / name
    return packaged.read_text() if packaged.is_file() else (Path(__file__).parents[2] / "systemd" / name).read_text()


def files_to_write(program: Path, *, page: bool = False, root: Path = Path("/")) -> dict[Path, str]:
    """Return the texts of missing files and of units that differ; OmnidError for a program that units cannot start.

    page: the unit of the page as well. root: the folder that stands for the system.
    """
    if any(program.is_relative_to(folder) for folder in HIDDEN):
        raise OmnidError(f"{program} is in a folder that the service cannot see: install omnid in /opt/omnid")
    if not re.fullmatch(r"[\w./+-]+", str(program), re.ASCII):
        raise OmnidError(f"{plain(str(program))}: the path has characters that a systemd unit cannot name")
    # The units follow the program; the files that people edit are kept.
    units = ["omnid.service", "omnid-web.service"] if page else ["omnid.service"]
    texts = {f"etc/systemd/system/{unit}": service_file(unit).replace(SHIPPED_PROGRAM, str(program)) for unit in units}
    wanted = {root / name: text for name, text in texts.items()}
    found = {path: text for path, text in wanted.items() if not path.exists() or path.read_text() != text}
    rules = service_file("90-omnid.rules")
    kept = {"udev/rules.d/90-omnid.rules": rules, "omnid/omnid.toml": dump(Config(), FIRST_SETTINGS)}
    return found | {root / "etc" / name: text for name, text in kept.items() if not (root / "etc" / name).exists()}


def write(texts: dict[Path, str]) -> None:
    """Write the files. Raises OmnidError."""
    for path, text in texts.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, text.encode())
        except (OSError, OmnidError) as error:
            raise OmnidError(f"{path} cannot be written: {error}; run this command with sudo") from error
