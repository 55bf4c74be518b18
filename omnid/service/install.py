"""Steps that install omnid as a service; each has a description that is printed before it is taken."""

from __future__ import annotations

import pwd
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final, NamedTuple

from omnid.config import FIRST_SETTINGS, Config
from omnid.errors import OmnidError
from omnid.plain_text import plain
from omnid.service.file_below import text_below, write_below
from omnid.settings_dump import dump_minimal

USER: Final = "omnid"
SHIPPED_PROGRAM: Final = "/opt/omnid/bin/omnid"  # The path of omnid in the shipped unit.
# Folders that the unit does not see: ProtectHome=, PrivateTmp=.
HIDDEN: Final = ("/home", "/root", "/tmp", "/run/user")
ADD_USER: Final = ("useradd", "--system", "--no-create-home", "--shell", "/usr/sbin/nologin", USER)
_REFUSED: Final = frozenset("\"'\\")
_PLAIN: Final = re.compile(r"[\w./+-]+")  # a path that needs no quotes


class Step(NamedTuple):
    """One change of the system."""

    description: str
    act: Callable[[], None]


def service_file(name: str) -> str:
    """Return the text of a file of the folder systemd/, from the installed package or from a clone."""
    packaged = files("omnid.service") / "systemd" / name
    if packaged.is_file():
        return packaged.read_text()
    return (Path(__file__).parents[2] / "systemd" / name).read_text()


@dataclass(frozen=True, slots=True)
class Installation:
    """The service below `root`, run by `program`."""

    root: Path
    program: Path
    page: bool = False  # the page's unit as well

    def steps(self) -> list[Step]:
        """Return the steps that are still to be taken; OmnidError for a program that the unit cannot start."""
        if any(self.program.is_relative_to(folder) for folder in HIDDEN):
            raise OmnidError(
                f"{self.program} is in a folder that the service cannot see: install omnid elsewhere, "
                "such as `sudo python3 -m venv /opt/omnid && sudo /opt/omnid/bin/pip install .`"
            )
        return list(self._steps())

    @property
    def next_steps(self) -> str:
        """Instructions for what only the user knows."""
        units = "omnid omnid-web" if self.page else "omnid"
        return (
            "Now enter your ports in /etc/udev/rules.d/90-omnid.rules (`omnid cameras` prints the lines), copy "
            "rig.toml to /etc/omnid, describe the hardware in /etc/omnid/omnid.toml, and run\n"
            "  sudo udevadm control --reload && sudo udevadm trigger\n"
            f"  sudo {shlex.quote(str(self.program))} doctor --config /etc/omnid/omnid.toml\n"
            f"  sudo systemctl daemon-reload && sudo systemctl enable --now {units}"
        )

    def _steps(self) -> Iterator[Step]:
        program = exec_word(self.program)
        unit = service_file("omnid.service").replace(SHIPPED_PROGRAM, program)
        yield from self._file("etc/systemd/system/omnid.service", unit, replace=True)
        if self.page:
            page = service_file("omnid-web.service").replace(SHIPPED_PROGRAM, program)
            yield from self._file("etc/systemd/system/omnid-web.service", page, replace=True)
        yield from self._file("etc/udev/rules.d/90-omnid.rules", service_file("90-omnid.rules"), replace=False)
        yield from self._file("etc/omnid/omnid.toml", dump_minimal(Config(), FIRST_SETTINGS), replace=False)
        if self.root == Path("/") and not _user_exists():
            yield Step(f"add the system user {USER}", _add_user)

    def _file(self, name: str, text: str, *, replace: bool) -> Iterator[Step]:
        found = text_below(self.root, name)
        if found is not None and (not replace or found == text):
            return
        verb = "write" if found is None else "replace"
        yield Step(f"{verb} {self.root / name}", lambda: write_below(self.root, name, text))


def exec_word(program: Path) -> str:
    """Return a program's path as the first word of ExecStart=; OmnidError for one that no unit can contain.

    systemd.service(5), "Command lines", and systemd.unit(5), "Specifiers": a path with blanks is written in double
    quotes, and a percent sign is doubled. A line ends at its line feed, whatever the quotes. Quotes and backslashes are
    refused: systemd 252 does not start a program whose name has them.
    """
    path = str(program)
    if not path.isprintable() or not _REFUSED.isdisjoint(path):
        raise OmnidError(
            f"{plain(path)}: the path has characters that a systemd unit cannot name: install omnid "
            f"elsewhere, such as in {Path(SHIPPED_PROGRAM).parents[1]}"
        )
    escaped = path.replace("%", "%%")
    return escaped if _PLAIN.fullmatch(path) else f'"{escaped}"'


def _user_exists() -> bool:
    return any(entry.pw_name == USER for entry in pwd.getpwall())


def _add_user() -> None:
    done = subprocess.run(ADD_USER, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = " ".join(done.stderr.split())
        raise OmnidError(f"the user {USER} cannot be added: {reason}; run this command with sudo")
