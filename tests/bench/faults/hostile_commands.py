"""Mutated commands against a live daemon: nothing moves without a valid one, limits hold, each is counted."""

from __future__ import annotations

import random
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from omnid.core.control.heading_controller import VelocityLimits
from omnid.transport import codec
from tests.bench.faults.mutation import mutated
from tests.bench.results import ResultTable, columns
from tests.replay.live import Operator, robot
from tests.waiting import wait_until

MOTIONS: Final = ("cmd/heading", "cmd/twist", "cmd/planner/twist", "cmd/unknown")
MANUAL: Final = ("--set", "controller.arming=manual")
OLD_S: Final = 3600.0
BATCH: Final = 500  # commands between two checks of the daemon
SETTLE_S: Final = 1.0


def command(rng: random.Random, topics: Sequence[str], age_s: float) -> tuple[str, bytes]:
    """Return topic and payload of a command with a stamp of this age, mutated after it was made."""
    stamp_ns = time.time_ns() - round(age_s * 1e9)
    payload = rng.choice(
        (
            codec.encoded(codec.VECTOR_SCHEMA, (stamp_ns, "odom"), (rng.uniform(-3, 3), 0.0, rng.uniform(-9, 9))),
            codec.twist_stamped_cdr(stamp_ns, "base_link", rng.uniform(-3, 3), rng.uniform(-9, 9)),
            codec.header_cdr(stamp_ns),
        )
    )
    return rng.choice(topics), mutated(rng, payload)


def counted(operator: Operator) -> int:
    """Return the number of commands and requests to arm that the daemon has counted: accepted, refused, too many."""
    wheels, bus = operator.values("wheels"), operator.values("bus")
    refused = sum(int(count) for name, count in wheels.items() if name.startswith("refused"))
    return int(wheels["commands"]) + refused + int(bus["floods"])


def attack(operator: Operator, rng: random.Random, count: int, topics: Sequence[str], age_s: float) -> None:
    """Send mutated commands, and wait until the daemon has counted them all, with those of the operator."""
    before = counted(operator)
    for sent in range(1, count + 1):
        operator.send(*command(rng, topics, age_s))
        if sent % BATCH == 0 or sent == count:
            wait_until(lambda sent=sent: counted(operator) >= before + sent, f"the count of {sent} commands")


def run(recorded: Path, folder: Path, count: int, seed: int) -> int:
    """Measure a row for each attack; return the number of attacks that did not hold."""
    rng, limits = random.Random(seed), VelocityLimits()
    own = folder / "commands"
    own.mkdir()
    table = ResultTable("faults_commands", "Mutated commands", columns("mutated commands", "sent", "wheels"))
    with robot(recorded, own, *MANUAL) as (daemon, operator, base):
        try:
            operator.drive()
            attack(operator, rng, count // 2, ("cmd/arm", *MOTIONS), OLD_S)
            assert not base.line.moved_since(0.0), "the wheels turned without a valid cmd/arm"
            table.add("an hour old, an operator sends, not armed", count // 2, "never turn")
            wait_until(lambda: operator.arm() is None and base.drives, "motion")
            operator.stop_sending()
            attack(operator, rng, count // 2, MOTIONS, 0.0)
            fastest = max(abs(sum(note.wheels_mps)) / 2 for note in base.line.notes)
            assert fastest <= limits.velocity_mps + 1e-3, f"{fastest} m/s"
            wait_until(lambda: not base.drives, "the stop")
            time.sleep(SETTLE_S)
            assert not base.drives, "the wheels turn without a command"
            found = f"at most {fastest:.2f} m/s, then at rest"
            table.add("of now, armed, the operator silent", count // 2, found)
            code, err = daemon.end()
            assert code == 0 and "Traceback" not in err, (code, err)
        except AssertionError as error:
            table.add("FAILED", None, " ".join(str(error).split())[:200])
            return 1
    return 0
